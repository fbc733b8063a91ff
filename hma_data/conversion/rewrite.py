"""Make a shard set of shards that exist: merge sets, divide a set anew, write a lost manifest anew.

The plan is made as in a conversion, so the result depends only on the episodes and the settings. A shard
is complete or absent, and the manifest is written last. To continue after an interruption, run it again.

T frames of an episode, A values of an action.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from hma_data.conversion.output import ShardHolder
from hma_data.conversion.plan import Plan, Settings, ShardUnit, make_plan
from hma_data.cpu import in_order
from hma_data.errors import HMAError, ShardError, UsageError
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.manifest import (
    EMBODIMENT,
    EPISODES,
    MANIFEST,
    SPLITS,
    Derived,
    Manifest,
    derive,
    digest,
    plan_hashes,
    seal_problem,
    shard_sizes,
    stored_embodiment,
)
from hma_data.shards.reader import EpisodeReader, ShardSet
from hma_data.shards.schema import (
    EpisodeRow,
    Footer,
    Refused,
    read_footer,
    to_numpy,
)
from hma_data.shards.verify import REMAKE, OnProgress, checked_shards
from hma_data.shards.writer import ShardWriter
from hma_data.sources.base import EpisodeRef
from hma_data.storage.locks import locked
from hma_data.storage.paths import StrPath
from hma_data.storage.records import Records, with_columns
from hma_data.storage.remote import parquet_input, place

CONVERT_AGAIN = "run the same hma convert again"
SYNTHETIC_MARKS = (
    "synthetic",
    "inferred_actions",
)  # of sets that no robot recorded, in `made_by` of their plans


@dataclass(frozen=True)
class _NewSet:
    """The description of a shard set to make of others, which share embodiment, tokenizer and row layout.

    Attributes:
        embodiment: of the new set; it may lack the state that some of the sets have.
        episodes: in the order of their new numbers: the fields of `EpisodeRow`, with the place in the old
            set, and `set`, which of the sets. A split is kept; an empty one is chosen anew.
        together: episodes that share this text go into one split; empty means the episode's own id.
        refused: the episodes that its quarantine lists.
        made_by: the operation that made the set, recorded in the plan; empty if a conversion could have
            made the same set.
    """

    sets: Sequence[ShardSet]
    embodiment: Embodiment
    settings: Settings
    episodes: pa.Table
    together: pa.Array
    source: str
    refused: Sequence[Refused]
    made_by: Mapping[str, Any]

    def plan(self) -> Plan:
        first = self.sets[0]
        stride = first.manifest.frame_stride
        own = self.episodes
        refs = pa.table(
            {
                "id": own["id"],
                "frames": pc.multiply(own["length"], pa.scalar(stride, pa.int64())),
                "split": own["split"],
                "fingerprint": own["fingerprint"],
                "group": self.together,
            }
        )
        plan = make_plan(
            Records.of_table(EpisodeRef, refs), self.embodiment, first.spec, self.settings, self.source
        )
        return plan.with_origin(self.made_by)

    def run(self, out: StrPath, workers: int, on_progress: OnProgress) -> Manifest:
        """Write the set; keep shards that are already there."""
        plan, holder = self.plan(), ShardHolder(place(out), self.embodiment, self.source)
        whole = replace(self, episodes=self.episodes.combine_chunks())  # else each `take` combines them
        with locked(holder.folder):
            done = holder.finished(plan, None, False)
            todo = [unit for unit in plan.units if unit.name not in done]
            written = plan.frames - sum(unit.frames for unit in todo)

            def make(unit: ShardUnit) -> None:
                refused = self.refused if unit is plan.units[0] else ()
                _make_shard(whole, plan, holder.folder, unit, refused)

            for unit, _ in in_order(make, todo, workers):
                written += unit.frames
                on_progress(written, plan.frames)
            return holder.finish(plan, None, bool(todo)).manifest


def _make_shard(job: _NewSet, plan: Plan, out: Path, unit: ShardUnit, refused: Sequence[Refused]) -> None:
    readers = [EpisodeReader(shards, shards.columns()) for shards in job.sets]
    layout = replace(job.sets[0].manifest.layout, embodiment=job.embodiment)
    stats = layout.empty_stats()
    rows: list[EpisodeRow] = []
    with ShardWriter(out / unit.name, layout.schema, layout.tokenizer) as writer:
        for index, item in zip(unit.numbers.to_pylist(), job.episodes.take(unit.numbers).to_pylist()):
            number, start = item.pop("set"), writer.rows
            old = EpisodeRow(**item)
            columns = readers[number].rows(old.shard, old.row_start, old.length)
            if (columns["episode_index"] != old.episode_index).any():
                fault = f"its rows from {old.row_start} on are not episode {old.episode_index}"
                remedy = "hma shards verify shows what is damaged"
                raise ShardError(job.sets[number].folder / old.shard, fault, remedy)
            writer.add(index, columns)
            for name, own in layout.stats(columns, slice(old.length)).items():
                stats[name].merge(own)
            source = "" if old.source == job.source else old.source
            rows.append(
                replace(
                    old,
                    episode_index=index,
                    split=unit.split,
                    shard=unit.name,
                    row_start=start,
                    rows=old.length,
                    source=source,
                )
            )
        writer.close(Footer(plan.facts, unit.name, unit.split, tuple(rows), tuple(refused), stats))


# -- from shard sets


def merge(
    folders: Sequence[StrPath],
    out: StrPath,
    workers: int = 1,
    on_progress: OnProgress = lambda done, total: None,
) -> Manifest:
    """Merge several sets of the same embodiment and tokenizer into one; every episode keeps its split.

    If one of the sets has no state, such as a synthetic one, the merged set has none. An id that occurs in
    several sets is prefixed with the number of its set: `2/demo_0`.

    Args:
        folders: str or path of each set, or its URI.
        out: str or path of the new set, or its URI.

    Raises:
        ShardError: the sets cannot be merged, or an episode would be in train and in val.
        OutputError: `out` holds something else, or another job is writing it.
    """
    sets = [ShardSet(folder) for folder in folders]
    _check_out(out, folders)
    first = sets[0]
    for other in sets[1:]:
        _check_alike(first, other)
    episodes, refused = _joined([_rows(shards) for shards in sets], [_refused(shards) for shards in sets])
    _refuse_leak(out, episodes)
    made_by: dict[str, Any] = {"merge": [shards.manifest.plan["hash"] for shards in sets]}
    for mark in SYNTHETIC_MARKS:  # of some of the episodes is of the set
        if any(shards.manifest.plan.get("made_by", {}).get(mark) for shards in sets):
            made_by[mark] = True
    stateless = any(shards.embodiment.state is None for shards in sets)
    embodiment = _stateless(first) if stateless else first.embodiment
    sources = list(dict.fromkeys(shards.manifest.source for shards in sets))
    source = sources[0] if len(sources) == 1 else f"merged of {len(sources)} recordings, first {sources[0]}"
    settings = replace(_settings(first), limit=None, only=(), exclude=())
    job = _NewSet(
        sets, embodiment, settings, episodes, pa.repeat("", len(episodes)), source, refused, made_by
    )
    return job.run(out, workers, on_progress)


def _refuse_leak(out: StrPath, episodes: pa.Table) -> None:
    """Raise ShardError if an episode of val is in train too, from another of the sets."""
    known = episodes.filter(pc.not_equal(episodes["content"], ""))
    held = pc.equal(known["split"], "val")
    twice = pc.is_in(known["content"], known["content"].filter(held))
    if ids := known["id"].filter(pc.and_not(twice, held)).to_pylist():
        fault = f"would have {len(ids):,} episodes in train that are also in val, first {ids[0]!r}"
        raise ShardError(out, fault, "leave them out of one of the sets: hma convert --exclude")


def _joined(
    tables: Sequence[pa.Table], refused: Sequence[Sequence[Refused]]
) -> tuple[pa.Table, list[Refused]]:
    """Return the episodes and the refused of several sets, with ids that are unique; see `merge`."""
    lost = (pa.array([item.id for item in some], pa.string()) for some in refused)
    counts = pa.chunked_array(chain(lost, *(t["id"].chunks for t in tables)), pa.string()).value_counts()
    again = counts.field("values").filter(pc.greater(counts.field("counts"), pa.scalar(1, pa.int64())))
    found = []
    for number, table in enumerate(tables):
        ids, groups = table["id"], table["group"]
        named = pc.and_(pa.scalar(len(tables) > 1), pc.not_equal(groups, ""))
        own = {
            "id": pc.if_else(pc.is_in(ids, again), _numbered(number, ids), ids),
            "group": pc.if_else(named, _numbered(number, groups), groups),
            "set": pa.repeat(number, len(table)),
        }
        found.append(with_columns(table, **own))
    twice = set(again.to_pylist())
    listed = [
        replace(item, id=f"{number + 1}/{item.id}") if item.id in twice else item
        for number, some in enumerate(refused)
        for item in some
    ]
    return pa.concat_tables(found), listed


def split(
    folder: StrPath,
    out: StrPath,
    *,
    val_fraction: float | None = None,
    seed: int = 0,
    by: str = "episode",
    workers: int = 1,
    on_progress: OnProgress = lambda done, total: None,
) -> Manifest:
    """Divide the episodes of a set anew into train and val, as a conversion divides them.

    Args:
        folder: str or path of the set, or its URI.
        out: str or path of the new set, or its URI.
        val_fraction, seed: as of a conversion.
        by: what stays together: episode (and its recording), instruction or source.

    Raises:
        UsageError: the fraction is not allowed.
        OutputError: `out` holds something else, or another job is writing it.
    """
    shards = ShardSet(folder)
    _check_out(out, [folder])
    rows = _rows(shards)
    settings = replace(_settings(shards), val_fraction=val_fraction, seed=seed)
    if settings.limit is not None and settings.limit < len(rows):
        settings = replace(settings, limit=None)  # the set was extended beyond its limit
    together = rows["group"] if by == "episode" else _together(rows, by)
    episodes = with_columns(rows, split=pa.repeat("", len(rows)), set=pa.repeat(0, len(rows)))
    made_by = {} if by == "episode" else {"split_by": by}
    refused, source = _refused(shards), shards.manifest.source
    job = _NewSet([shards], shards.embodiment, settings, episodes, together, source, refused, made_by)
    return job.run(out, workers, on_progress)


def _together(rows: pa.Table, by: str) -> pa.Array:
    """Return a name for each episode; episodes linked through `by` or through their recording share it."""
    leader: dict[tuple[str, str], tuple[str, str]] = {}

    def find(key: tuple[str, str]) -> tuple[str, str]:
        while leader.setdefault(key, key) != key:
            leader[key] = leader[leader[key]]
            key = leader[key]
        return key

    values, groups = (rows[name].combine_chunks().dictionary_encode() for name in (by, "group"))
    kinds, recordings = values.dictionary.to_pylist(), groups.dictionary.to_pylist()
    pairs = to_numpy(values.indices) * np.int64(len(recordings)) + to_numpy(groups.indices)
    distinct, first, codes = np.unique(pairs, return_index=True, return_inverse=True)
    keys: dict[int, tuple[str, str] | None] = {}
    for pair in distinct[np.argsort(first)].tolist():
        value, group = kinds[pair // len(recordings)], recordings[pair % len(recordings)]
        if value and group:
            leader[find((by, value))] = find(("group", group))
        keys[pair] = (by, value) if value else ("group", group) if group else None
    shared = ["/".join(find(key)) if key else None for key in map(keys.__getitem__, distinct.tolist())]
    alone = pc.binary_join_element_wise("id", rows["id"].combine_chunks(), "/")
    return pc.coalesce(pa.array(shared, pa.string()).take(pa.array(codes)), alone)


def _check_out(out: StrPath, folders: Sequence[StrPath]) -> None:
    for folder in folders:
        mine, theirs = place(out).resolve(), place(folder).resolve()
        if mine == theirs or mine in theirs.parents or theirs in mine.parents:
            fault = f"is {out}, which holds the shard set {folder} or lies in it"
            raise UsageError("--out", fault, "give a new folder")


def _stateless(shards: ShardSet) -> Embodiment:
    values = {key: value for key, value in shards.embodiment.to_dict().items() if key != "state"}
    return Embodiment.from_values(values, f"embodiment {shards.embodiment.id}")


def _check_alike(first: ShardSet, other: ShardSet) -> None:
    same = [shards.embodiment for shards in (first, other)]
    if any(embodiment.state is None for embodiment in same):
        same = [_stateless(shards) for shards in (first, other)]
    pairs = {
        "embodiment": (first.embodiment.id, other.embodiment.id),
        "content of the embodiment's YAML": (same[0].digest, same[1].digest),
        "stride": (first.embodiment.stride, other.embodiment.stride),
        "tokenizer": (f"{first.spec.name} {first.spec.digest}", f"{other.spec.name} {other.spec.digest}"),
        "cameras": (first.manifest.cameras, other.manifest.cameras),
        "frame stride": (first.manifest.frame_stride, other.manifest.frame_stride),
    }
    for what, (mine, theirs) in pairs.items():
        if mine != theirs:
            fault = f"cannot be merged with {first.folder}: its {what} is {theirs}, there it is {mine}"
            remedy = "merge sets of one embodiment, one tokenizer and one choice of --frames"
            raise ShardError(other.folder, fault, remedy)


def _settings(shards: ShardSet) -> Settings:
    """Return the settings that the set was made with."""
    said = shards.manifest.plan.get("settings", {})
    return Settings(**{**said, "cameras": shards.manifest.cameras})


def _rows(shards: ShardSet) -> pa.Table:
    """Return the rows of episodes.parquet as they were in the footers, each with its own source."""
    return Records.of_table(EpisodeRow, shards.episodes).table


def _numbered(number: int, names: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return the names, each after the number of its set: `2/demo_0`."""
    return pc.binary_join_element_wise(str(number + 1), names, "/")


def _refused(shards: ShardSet) -> list[Refused]:
    return [
        Refused(**{key: value for key, value in item.items() if key != "uri"}) for item in shards.refused()
    ]


# -- a manifest anew


def restat(
    folder: StrPath, *, workers: int | None = None, on_progress: OnProgress = lambda done, total: None
) -> Manifest:
    """Write the manifest and the other derived files from the shards; do not change the shards.

    An undamaged manifest states which shards belong to the set and their hashes. Without one, the shards
    themselves must show that none is missing.

    Args:
        folder: str or path of the set, or its URI.

    Raises:
        ShardError: a shard is missing or damaged, or nothing shows whether all are there; nothing is written.
    """
    folder = place(folder)
    if not folder.is_dir():
        raise ShardError(folder, "is not a folder", "name the --out folder of an hma convert")
    with locked(folder):
        known: Manifest | None = None
        with suppress(HMAError, OSError):
            if not seal_problem((folder / MANIFEST).read_bytes()):
                known = Manifest.load(folder)
        if known:
            hashes = {shard.path: shard.sha256 for shard in known.shards}
            derived = derive(folder, list(hashes), known.embodiment, known.plan, known.source, hashes)
        else:
            derived = _as_found(folder)
        checked = checked_shards(folder, derived.manifest, workers, False, on_progress)
        if problems := [problem for _, some, _ in checked for problem in some]:
            more = f", and {len(problems) - 1} more problems" if len(problems) > 1 else ""
            raise ShardError("", problems[0] + more)
        return derived.write(folder)


def _as_found(folder: Path) -> Derived:
    """Derive the files of a set without a manifest to trust; its shards must show that none is missing."""
    names = sorted(shard_sizes(folder))
    if not names:
        raise ShardError(folder, "holds no shards", "name the --out folder of an hma convert")
    footers = [read_footer(folder / name)[0] for name in names]
    plan = max((footer.plan for footer in footers), key=lambda plan: len(plan.get("extends", ())))
    for name, footer in zip(names, footers):
        if footer.plan["hash"] not in plan_hashes(plan) or footer.name != name:
            raise ShardError(folder / name, "belongs to another conversion than the other shards", REMAKE)
    embodiment, listed = stored_embodiment(folder), _listed(folder)
    own = {row.episode_index for footer in footers for row in footer.episodes if not row.source}
    said = (row["source"] for row in listed.to_pylist() if row["episode_index"] in own) if listed else ()
    derived = derive(folder, names, embodiment, plan, next(iter(said), "unknown"))
    counts = Counter(footer.split for footer in footers)
    gapless = names == [f"{split}/shard-{i:05d}.parquet" for split in SPLITS for i in range(counts[split])]
    # the plan's digest holds unless an episode is in quarantine
    cut = [(name, footer.table["episode_index"].to_pylist()) for name, footer in zip(names, footers)]
    is_listed = listed is not None and listed.equals(derived.episodes)
    if not gapless or not (plan["shards"] == digest(cut) or is_listed):
        raise ShardError(folder, "cannot tell from its files whether all its shards are there", CONVERT_AGAIN)
    if embodiment.digest != plan["embodiment_hash"]:
        fault = "is not the embodiment the shards were made with"
        raise ShardError(folder / EMBODIMENT, fault, CONVERT_AGAIN)
    return derived


def _listed(folder: Path) -> pa.Table | None:
    """Read episodes.parquet, which alone states the URI of the recordings; None where it cannot be read."""
    with suppress(OSError, pa.ArrowException):
        return pq.read_table(parquet_input(folder / EPISODES))
    return None
