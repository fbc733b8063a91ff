"""Make a shard set from episodes that are already tokenized: merge sets, or divide a set anew.

The plan is made as in a conversion, so the result depends only on the episodes and the settings. A shard
is complete or absent, and the manifest is written last. To continue after an interruption, run it again.

T frames of an episode, A values of an action.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.conversion.output import finished_shards, locked, remove_notes
from hma_data.conversion.plan import Plan, Settings, ShardUnit, digest, make_plan
from hma_data.errors import ShardError, UsageError
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.manifest import EPISODES, MANIFEST, Manifest, finish
from hma_data.shards.reader import EpisodeReader, ShardSet
from hma_data.shards.schema import (
    EpisodeRow,
    Footer,
    Refused,
    arrow_schema,
    mask_columns,
    token_column,
)
from hma_data.shards.stats import Stats
from hma_data.shards.writer import EpisodeRows, ShardWriter
from hma_data.sources.base import EpisodeRef
from hma_data.storage.paths import StrPath
from hma_data.storage.remote import place
from hma_data.tokenizers.base import TokenizerSpec

OnProgress = Callable[[int, int], None]
Read = Callable[["Ready"], dict[str, NDArray[Any]]]


@dataclass(frozen=True)
class Ready:
    """An episode whose tokens exist.

    Attributes:
        row: its row of episodes.parquet. A split in it is kept; its shard and its place there are set anew.
        key: value by which the function of `Job.open` finds it.
        together: episodes that share this text go into one split; empty means the episode's own id.
    """

    row: EpisodeRow
    key: Any
    together: str = ""


@dataclass(frozen=True)
class Job:
    """The description of a shard set to make.

    Attributes:
        episodes: in the order of their new numbers.
        open: called once for each shard; returns a function that maps an episode to its columns, (N,) or
            (N, width).
        refused: the episodes that its quarantine lists.
        made_by: the operation that made the set, recorded in the plan; empty if a conversion could have
            made the same set.
    """

    embodiment: Embodiment
    tokenizer: TokenizerSpec
    settings: Settings
    episodes: Sequence[Ready]
    open: Callable[[], Read]
    source: str
    refused: Sequence[Refused] = ()
    made_by: Mapping[str, Any] = field(default_factory=dict)

    @property
    def cameras(self) -> list[str]:
        """Return the names of the cameras, in row order within an episode."""
        return list(self.settings.cameras) or [self.embodiment.primary_camera.name]

    @property
    def frame_stride(self) -> int:
        """Return the number of recorded steps a row."""
        return self.embodiment.stride if self.settings.frames == "strided" else 1


def remake(
    job: Job, out: StrPath, workers: int = 1, on_progress: OnProgress = lambda done, total: None
) -> Manifest:
    """Write the set; keep shards that are already there.

    Args:
        out: str or path of the new set, or its URI.
        workers: threads, each of which writes its own shard.
        on_progress: called with (frames written, frames in all) after each shard.

    Raises:
        OutputError: `out` holds something else, or another job is writing it.
        ShardError: an input is damaged.
    """
    plan, out = _plan(job), place(out)
    with locked(out):
        done = finished_shards(out, plan, None, False)
        todo = [unit for unit in plan.units if unit.name not in done]
        if not todo and (out / MANIFEST).is_file() and (out / EPISODES).is_file():
            return Manifest.load(out)
        written = plan.frames - sum(unit.frames for unit in todo)
        first = plan.units[0].name

        def make(unit: ShardUnit) -> int:
            _make_shard(job, plan, out, unit, job.refused if unit.name == first else ())
            return unit.frames

        with ThreadPoolExecutor(workers) as pool:
            for frames in pool.map(make, todo):
                written += frames
                on_progress(written, plan.frames)
        names = [unit.name for unit in plan.units]
        manifest = finish(out, names, job.embodiment, job.tokenizer, plan.facts, job.source)
        remove_notes(out)
        return manifest


def _plan(job: Job) -> Plan:
    refs = [
        EpisodeRef(
            item.row.id,
            item.row.length * job.frame_stride,
            item.row.split or None,
            item.row.fingerprint,
            item.together,
        )
        for item in job.episodes
    ]
    plan = make_plan(refs, job.embodiment, job.tokenizer, job.settings, job.source)
    if not job.made_by:
        return plan
    facts = {key: value for key, value in plan.facts.items() if key != "hash"} | {
        "made_by": dict(job.made_by)
    }
    return Plan(plan.units, {**facts, "hash": digest(facts)})


def _make_shard(job: Job, plan: Plan, out: Path, unit: ShardUnit, refused: Sequence[Refused]) -> None:
    embodiment, cameras, read = job.embodiment, job.cameras, job.open()
    state_width = embodiment.state.dims if embodiment.state else 0
    width = embodiment.action_dim * job.frame_stride
    schema = arrow_schema(job.tokenizer, width, state_width, len(cameras), mask_columns(embodiment))
    stats = {"action": Stats.empty(embodiment.action_dim)}
    if state_width:
        stats["state"] = Stats.empty(state_width)
    rows: list[EpisodeRow] = []
    with ShardWriter(out / unit.name, schema, job.tokenizer) as writer:
        for index, _ in unit.episodes:
            item, start = job.episodes[index], writer.rows
            columns = read(item)
            for piece in _pieces(index, columns, cameras, token_column(job.tokenizer)[0]):
                writer.add(piece)
            count = writer.rows - start
            for name, merged in stats.items():
                merged.merge(_stats(columns, name, count // len(cameras), len(merged.mean)))
            place: dict[str, Any] = {
                "episode_index": index,
                "split": unit.split,
                "shard": unit.name,
                "row_start": start,
            }
            own = "" if item.row.source == job.source else item.row.source
            rows.append(replace(item.row, **place, rows=count, length=count // len(cameras), source=own))
        writer.close(Footer(plan.facts, unit.name, unit.split, tuple(rows), tuple(refused), stats))


def _pieces(
    index: int, columns: dict[str, NDArray[Any]], cameras: list[str], tokens: str
) -> Iterator[EpisodeRows]:
    length = len(columns["timestamp"]) // len(cameras)
    for number, camera in enumerate(cameras):
        own = {name: values[number * length : (number + 1) * length] for name, values in columns.items()}
        yield EpisodeRows(
            episode_index=index,
            timestamps=own["timestamp"],
            tokens=own[tokens],
            actions=own["action"],
            states=own.get("state"),
            camera=camera,
            action_known=own.get("action_known"),
            state_known=own.get("state_known"),
        )


def _stats(columns: dict[str, NDArray[Any]], name: str, length: int, width: int) -> Stats:
    values, known = columns[name][:length], columns.get(f"{name}_known")
    if known is not None:
        values = values[known[:length]]
    return Stats.of(values.reshape(-1, width))


# -- from shard sets


def merge(
    folders: Sequence[StrPath],
    out: StrPath,
    workers: int = 1,
    on_progress: OnProgress = lambda done, total: None,
) -> Manifest:
    """Merge several sets of the same embodiment and tokenizer into one; every episode keeps its split.

    An id that occurs in several sets is prefixed with the number of its set: `2/demo_0`.

    Args:
        folders: str or path of each set, or its URI.
        out: str or path of the new set, or its URI.

    Raises:
        ShardError: the sets cannot be merged.
        OutputError: see `remake`.
    """
    sets = [ShardSet(folder) for folder in folders]
    _check_out(out, folders)
    first = sets[0]
    for other in sets[1:]:
        _check_alike(first, other)
    counts: dict[str, int] = {}
    for shards in sets:
        for name in [*shards.episodes["id"].to_pylist(), *(item["id"] for item in shards.refused())]:
            counts[name] = counts.get(name, 0) + 1

    def unique(number: int, name: str) -> str:
        return f"{number + 1}/{name}" if counts[name] > 1 else name

    episodes, refused = [], []
    for number, shards in enumerate(sets):
        for row in _rows(shards):
            group = f"{number + 1}/{row.group}" if row.group and len(sets) > 1 else row.group
            changed = replace(row, id=unique(number, row.id), group=group)
            episodes.append(Ready(changed, (number, row)))
        refused += [replace(item, id=unique(number, item.id)) for item in _refused(shards)]
    _check_unique([item.row.id for item in episodes])
    made_by = {"merge": [shards.manifest.plan["hash"] for shards in sets]}
    sources = list(dict.fromkeys(shards.manifest.source for shards in sets))
    source = sources[0] if len(sources) == 1 else f"merged of {len(sources)} recordings, first {sources[0]}"
    settings = replace(_settings(first), limit=None)
    job = Job(first.embodiment, first.spec, settings, episodes, _opener(sets), source, refused, made_by)
    return remake(job, out, workers, on_progress)


def split(
    folder: StrPath,
    out: StrPath,
    *,
    val_fraction: float = 0.05,
    seed: int = 0,
    by: str = "episode",
    workers: int = 1,
    on_progress: OnProgress = lambda done, total: None,
) -> Manifest:
    """Divide the episodes of a set anew into train and val, as a conversion divides them.

    Args:
        folder: str or path of the set, or its URI.
        out: str or path of the new set, or its URI.
        by: what stays together: episode (and its recording), instruction or source.

    Raises:
        UsageError: a fraction or `by` is not allowed.
        OutputError: see `remake`.
    """
    shards = ShardSet(folder)
    _check_out(out, [folder])
    rows = [replace(row, split="") for row in _rows(shards)]
    if by not in ("episode", "instruction", "source"):
        raise UsageError("--by", f"{by!r} is not known", "allowed: episode, instruction, source")
    settings = replace(_settings(shards), val_fraction=val_fraction, seed=seed)
    if settings.limit is not None and settings.limit < len(rows):
        settings = replace(settings, limit=None)  # the set was extended beyond its limit
    together = [row.group for row in rows] if by == "episode" else _together(rows, by)
    episodes = [Ready(row, (0, old), key) for row, old, key in zip(rows, _rows(shards), together)]
    made_by = {} if by == "episode" else {"split_by": by}
    source = shards.manifest.source
    job = Job(
        shards.embodiment,
        shards.spec,
        settings,
        episodes,
        _opener([shards]),
        source,
        list(_refused(shards)),
        made_by,
    )
    return remake(job, out, workers, on_progress)


def _together(rows: Sequence[EpisodeRow], by: str) -> list[str]:
    """Return a name for each episode; episodes linked through `by` or through their recording share it."""
    leader: dict[tuple[str, str], tuple[str, str]] = {}

    def find(key: tuple[str, str]) -> tuple[str, str]:
        while leader.setdefault(key, key) != key:
            leader[key] = leader[leader[key]]
            key = leader[key]
        return key

    for row in rows:
        for kind, value in ((by, getattr(row, by)), ("group", row.group)):
            if value:
                leader[find(("id", row.id))] = find((kind, value))
    return ["/".join(find(("id", row.id))) for row in rows]


def _check_out(out: StrPath, folders: Sequence[StrPath]) -> None:
    for folder in folders:
        mine, theirs = place(out).resolve(), place(folder).resolve()
        if mine == theirs or mine in theirs.parents or theirs in mine.parents:
            raise UsageError(
                "--out", f"{out} and the shard set {folder} lie in each other", "give a new folder"
            )


def _check_alike(first: ShardSet, other: ShardSet) -> None:
    pairs = {
        "embodiment": (first.embodiment.id, other.embodiment.id),
        "content of the embodiment's YAML": (first.embodiment.digest, other.embodiment.digest),
        "stride": (first.embodiment.stride, other.embodiment.stride),
        "tokenizer": (f"{first.spec.name} {first.spec.digest}", f"{other.spec.name} {other.spec.digest}"),
        "cameras": (first.manifest.cameras, other.manifest.cameras),
        "--frames": (_settings(first).frames, _settings(other).frames),
    }
    for what, (mine, theirs) in pairs.items():
        if mine != theirs:
            fault = f"cannot be merged with {first.folder}: its {what} is {theirs}, there it is {mine}"
            raise ShardError(other.folder, fault, "merge sets of one embodiment and one tokenizer")


def _check_unique(ids: Sequence[str]) -> None:
    seen: set[str] = set()
    for name in ids:
        if name in seen:
            raise ShardError("merge", f"two episodes would be called {name!r}", "merge fewer sets at a time")
        seen.add(name)


def _settings(shards: ShardSet) -> Settings:
    """Return the settings that the set was made with."""
    plan = shards.manifest.plan
    said = plan.get("settings", {})
    known = {key: said[key] for key in ("val_fraction", "seed", "limit", "shard_frames") if key in said}
    return Settings(frames=plan.get("frames", "all"), cameras=tuple(shards.manifest.cameras), **known)


def _rows(shards: ShardSet) -> list[EpisodeRow]:
    """Return the rows of episodes.parquet as they were in the footers, each with its own source."""
    return [EpisodeRow(**row) for row in shards.episodes.to_pylist()]


def _refused(shards: ShardSet) -> Iterator[Refused]:
    for item in shards.refused():
        yield Refused(**{key: value for key, value in item.items() if key != "uri"})


def _opener(sets: Sequence[ShardSet]) -> Callable[[], Read]:
    """Return a function that opens a reader of episodes of several sets, called once for each shard."""

    def open_sets() -> Read:
        readers = [EpisodeReader(shards, shards.columns()) for shards in sets]

        def read(item: Ready) -> dict[str, NDArray[Any]]:
            number, row = item.key
            columns = readers[number].rows(row.shard, row.row_start, row.rows)
            if not np.array_equal(columns.pop("episode_index"), np.full(row.rows, row.episode_index)):
                where = sets[number].folder / row.shard
                fault = f"its rows from {row.row_start} on are not episode {row.episode_index}"
                raise ShardError(where, fault, "hma shards verify tells what is damaged")
            return columns

        return read

    return open_sets
