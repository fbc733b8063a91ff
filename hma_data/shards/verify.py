"""Check a shard set: every hash, row count and invariant. Nothing is changed.

Shards are checked a few at a time by threads (hashing and parquet leave the interpreter alone), a row
group in memory for each, so memory does not grow with the set.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from hma_data.engines.local import usable_cores
from hma_data.errors import HMAError
from hma_data.files import PART, file_sha256
from hma_data.output import WORKING
from hma_data.shards.check import Checked, check_shard, plan_problem, same_stats
from hma_data.shards.manifest import (
    EMBODIMENT,
    EPISODES,
    MANIFEST,
    QUARANTINE,
    SPLITS,
    Gathered,
    Manifest,
    seal_problem,
    split_totals,
    stored_embodiment,
)
from hma_data.stats import Stats
from hma_data.store import parquet_input, place

BESIDE = {"README.md", ".gitattributes"}  # what a hub adds
OnProgress = Callable[[int, int], None]


def verify(
    folder: Path,
    *,
    workers: int | None = None,
    quick: bool = False,
    on_progress: OnProgress = lambda done, total: None,
) -> list[str]:
    """Everything wrong with a shard set, a line each; empty when it is sound.

    Args:
        workers: threads; None takes the cores.
        quick: sizes and footers only: seconds for any set, but a flipped bit in a shard stays unseen.
        on_progress: called with (bytes checked, bytes in all) after each shard.
    """
    folder = place(folder)
    restat = f"hma shards restat {folder} writes it anew from the shards"
    try:
        manifest = Manifest.load(folder)
        seal = seal_problem((folder / MANIFEST).read_bytes())
    except HMAError as fault:
        return [str(fault)]
    except OSError as fault:
        return [f"{folder / MANIFEST}: cannot be read: {fault.strerror} — check its permissions"]
    fault_of_plan = seal or plan_problem(manifest)
    found = [f"{folder / MANIFEST}: {fault_of_plan} — {restat}"] if fault_of_plan else []
    gathered, rows = Gathered(manifest.source), dict[str, Stats]()
    whole = True
    for checked in _checked(folder, manifest, workers or usable_cores(), quick, on_progress):
        found += checked.problems
        if checked.footer is None or checked.problems:
            whole = False
            continue
        gathered.add(checked.footer)
        _merge_train(rows, checked)
    found += _foreign(folder, manifest)
    found += _other_files(folder, manifest)
    if whole:
        found += _set_problems(folder, manifest, gathered, rows, restat)
    return found


def check_rows(
    folder: Path, manifest: Manifest, workers: int | None, on_progress: OnProgress
) -> tuple[list[str], dict[str, Stats]]:
    """What is wrong with the shards, and the statistics of the train shards' rows."""
    found: list[str] = []
    rows: dict[str, Stats] = {}
    for checked in _checked(folder, manifest, workers or usable_cores(), False, on_progress):
        found += checked.problems
        _merge_train(rows, checked)
    return found, rows


def _merge_train(rows: dict[str, Stats], checked: Checked) -> None:
    if checked.footer and checked.footer.split == "train":
        for name, stats in checked.stats.items():
            rows.setdefault(name, Stats.empty(len(stats.mean))).merge(stats)


def _checked(
    folder: Path, manifest: Manifest, workers: int, quick: bool, on_progress: OnProgress
) -> Iterator[Checked]:
    """Each shard checked, in the manifest's order."""
    total = sum(shard.bytes for shard in manifest.shards)
    done, batch = 0, 4 * workers
    with ThreadPoolExecutor(workers) as pool:
        for start in range(0, len(manifest.shards), batch):
            shards = manifest.shards[start : start + batch]
            results = pool.map(lambda shard: check_shard(folder, shard, manifest, quick), shards)
            for shard, checked in zip(shards, results):
                done += shard.bytes
                on_progress(done, total)
                yield checked


def _foreign(folder: Path, manifest: Manifest) -> Iterator[str]:
    """Files that are not of the set."""
    known = {shard.path for shard in manifest.shards} | {MANIFEST, EPISODES, QUARANTINE, EMBODIMENT} | BESIDE
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if name in known or name.startswith(WORKING) or (path.is_dir() and name in SPLITS):
            continue
        if path.name.endswith(PART):
            yield f"{path}: is left of a job that runs or was killed — run the same hma convert again"
        else:
            yield f"{path}: is not in the manifest — move it out of the shard set"


def _other_files(folder: Path, manifest: Manifest) -> Iterator[str]:
    """What the manifest says about the files that are no shards."""
    remedy = f"hma shards restat {folder} writes it anew from the shards"
    for name in (EPISODES, QUARANTINE, EMBODIMENT):
        path = folder / name
        try:
            if name not in manifest.files:
                yield f"{folder / MANIFEST}: states no sha256 of {name} — {remedy}"
            elif file_sha256(path) != manifest.files[name]:
                yield f"{path}: its bytes changed since the manifest was written (sha256 differs) — {remedy}"
            elif name == EMBODIMENT and stored_embodiment(folder) != manifest.embodiment:
                yield f"{path}: is another embodiment than the manifest's — {remedy}"
        except FileNotFoundError:
            yield f"{path}: is missing — {remedy}"
        except OSError as fault:
            yield f"{path}: cannot be read: {fault.strerror} — {remedy}"
        except HMAError as fault:
            yield " ".join(str(fault).split())


def _set_problems(
    folder: Path, manifest: Manifest, gathered: Gathered, rows: dict[str, Stats], restat: str
) -> Iterator[str]:
    """The files derived from the footers still say what the footers say, and episodes stand in one split."""
    expected = gathered.episodes()
    yield from _episode_problems(folder, expected)
    with suppress(OSError, pa.ArrowException):  # unreadable is unlike its sha256, which was said already
        if not pq.read_table(parquet_input(folder / EPISODES)).equals(expected):
            yield f"{folder / EPISODES}: differs from the shards' footers — {restat}"
    with suppress(OSError):
        if (folder / QUARANTINE).read_bytes() != gathered.quarantine().encode():
            yield f"{folder / QUARANTINE}: differs from the shards' footers — {restat}"
    where = folder / MANIFEST
    for split in SPLITS:
        if manifest.splits.get(split) != split_totals(expected, manifest.shards, split):
            yield f"{where}: its counts of split {split} are not those of the shards — {restat}"
    if manifest.quarantined != len(gathered.refused):
        counted = f"says {manifest.quarantined} are in quarantine, the shards {len(gathered.refused)}"
        yield f"{where}: {counted} — {restat}"
    footers = gathered.summaries()
    own = {name: stats.summary() for name, stats in rows.items()} or footers
    for name in footers.keys() | manifest.stats.keys():
        said = manifest.stats.get(name)
        if not said or not any(name in s and same_stats(said, s[name]) for s in (footers, own)):
            yield f"{where}: its statistics of {name} are not those of the train shards — {restat}"


def _episode_problems(folder: Path, episodes: pa.Table) -> Iterator[str]:
    """No episode twice, none in both splits, nor recordings that belong together."""
    for column, said in (("id", "stands in it twice"), ("episode_index", "is the number of two episodes")):
        counts = pc.value_counts(episodes[column].combine_chunks())
        for item in counts.filter(pc.greater(counts.field("counts"), 1)).to_pylist()[:3]:
            remedy = "convert again with --overwrite"
            yield f"{folder}: episode {column} {item['values']!r} {said} — {remedy}"
    if "group" not in episodes.column_names:
        return
    grouped = episodes.filter(pc.not_equal(episodes["group"], ""))
    pairs = grouped.group_by("group").aggregate([("split", "count_distinct")])
    for name in pairs.filter(pc.greater(pairs["split_count_distinct"], 1))["group"].to_pylist()[:3]:
        yield (
            f"{folder}: episodes of one recording, {name!r}, stand in both splits — "
            "hma shards split makes a set where they do not"
        )
