"""Check a shard set: every hash, row count and invariant. Nothing is changed.

Each shard is checked against its manifest, its footer and itself. Then the files that are derived from the
shards are checked. Threads check a few shards at a time (hashing and parquet release the interpreter lock).
Each thread holds one row group of tokens in memory, so memory does not grow with the set.

N rows of a shard, A values of an action.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from hma_data.cpu import usable_cores
from hma_data.errors import HMAError
from hma_data.shards.manifest import (
    EMBODIMENT,
    EPISODES,
    MANIFEST,
    QUARANTINE,
    SPLITS,
    WORKING,
    Gathered,
    Manifest,
    ShardFile,
    plan_hash,
    seal_problem,
    split_totals,
    stored_embodiment,
)
from hma_data.shards.schema import (
    Footer,
    arrow_schema,
    mask_columns,
    read_footer,
    to_numpy,
    token_column,
)
from hma_data.shards.stats import Stats
from hma_data.storage.files import PART, file_sha256
from hma_data.storage.paths import StrPath
from hma_data.storage.remote import parquet_file, parquet_input, place

REMAKE = "delete it and run the same hma convert again"
KNOWN = {"action": "action_known", "state": "state_known"}  # bool columns of sets whose values can be missing


@dataclass
class Checked:
    """The result of checking one shard.

    Attributes:
        problems: one line for each problem.
        footer: None if it cannot be read.
        stats: statistics of its rows, "action" and "state"; empty for a quick check.
    """

    problems: list[str] = field(default_factory=list)
    footer: Footer | None = None
    stats: dict[str, Stats] = field(default_factory=dict)


def check_shard(folder: Path, shard: ShardFile, manifest: Manifest, quick: bool) -> Checked:
    """Return everything wrong with one shard; `quick` checks size and footer only."""
    path = folder / shard.path
    try:
        if not path.is_file():
            return Checked([f"{path}: is missing — run the same hma convert again"])
        size = path.stat().st_size
        if size != shard.bytes:
            fault = f"has {size:,} bytes, the manifest says {shard.bytes:,}"
            return Checked([f"{path}: {fault}{_whose(path, manifest)} — {REMAKE}"])
        if not quick and file_sha256(path) != shard.sha256:
            fault = "its bytes changed since the manifest was written (sha256 differs)"
            return Checked([f"{path}: {fault}{_whose(path, manifest)} — {REMAKE}"])
        footer, row_groups = read_footer(path, str(path))
        checked = Checked(_footer_problems(path, shard, footer, row_groups, manifest), footer)
        if not quick and not checked.problems:
            _check_rows(path, footer, manifest, checked)
        return checked
    except HMAError as fault:
        return Checked([str(fault)])
    except (pa.ArrowException, OSError, ValueError) as fault:
        reason = " ".join(str(fault).split())[:300]
        return Checked([f"{path}: cannot be read: {reason} — {REMAKE}"])


def _whose(path: Path, manifest: Manifest) -> str:
    """Return a phrase that marks a shard of another run; empty if it is of this run or cannot be read."""
    try:
        plan = read_footer(path, str(path))[0].plan
    except HMAError:
        return ""
    return "" if _belongs(plan, manifest) else f", and {_another_plan(plan, manifest)}"


def _belongs(plan: dict[str, Any], manifest: Manifest) -> bool:
    """Check whether a shard's plan is the set's, or one that the set extends."""
    own = manifest.plan
    if plan.get("hash") not in own.get("extends", ()):
        return plan == own
    same = ("embodiment", "embodiment_hash", "tokenizer", "cameras", "frames", "frame_stride")
    return all(plan.get(key) == own.get(key) for key in same)


def _another_plan(plan: dict[str, Any], manifest: Manifest) -> str:
    return f"was made by another plan ({plan.get('hash')}) than the manifest's ({manifest.plan['hash']})"


def _footer_problems(
    path: Path, shard: ShardFile, footer: Footer, row_groups: list[int], manifest: Manifest
) -> list[str]:
    if not _belongs(footer.plan, manifest):
        return [f"{path}: {_another_plan(footer.plan, manifest)} — {REMAKE}"]
    found: list[str] = []
    if (footer.name, footer.split) != (shard.path, shard.split):
        found.append(f"{path}: its footer calls it {footer.name} of split {footer.split}")
    if tuple(row_groups) != shard.row_groups or sum(row_groups) != shard.rows:
        found.append(f"{path}: row groups of {row_groups} rows are not those of the manifest")
    if len(footer.episodes) != shard.episodes:
        found.append(f"{path}: holds {len(footer.episodes)} episodes, the manifest says {shard.episodes}")
    if any((row.shard, row.split) != (footer.name, footer.split) for row in footer.episodes):
        found.append(f"{path}: its episodes name another shard or split")
    starts = np.cumsum([0, *(row.rows for row in footer.episodes)])
    if any(row.row_start != start for row, start in zip(footer.episodes, starts)) or starts[-1] != shard.rows:
        found.append(f"{path}: its episodes do not follow one another row by row")
    cameras = len(manifest.cameras)
    if any(row.rows != row.length * cameras or row.length < 1 for row in footer.episodes):
        found.append(f"{path}: an episode has not one row a frame and camera")
    found += _column_problems(path, manifest)
    return [f"{problem} — {REMAKE}" for problem in found]


def _column_problems(path: Path, manifest: Manifest) -> list[str]:
    embodiment = manifest.embodiment
    strided = manifest.plan.get("frames") == "strided"
    expected = arrow_schema(
        manifest.tokenizer,
        embodiment.chunk_dim if strided else embodiment.action_dim,
        embodiment.state.dims if embodiment.state else 0,
        len(manifest.cameras),
        mask_columns(embodiment),
    )
    actual = pq.read_schema(parquet_input(path))
    if actual.equals(expected, check_metadata=False):
        return []
    wrong = [f"{column.name} {column.type}" for column in actual if column not in list(expected)]
    missing = [f"{column.name} {column.type}" for column in expected if column not in list(actual)]
    said = f"has {', '.join(wrong) or 'no others'}; missing {', '.join(missing) or 'none'}"
    return [f"{path}: its columns are not those of the manifest's embodiment and tokenizer: {said}"]


def _check_rows(path: Path, footer: Footer, manifest: Manifest, checked: Checked) -> None:
    """Check rows against the footer: whole episodes, frames counting up, tokens in range, finite numbers."""
    found, kept = checked.problems, _read_rows(path, manifest, checked.problems)
    cameras = len(manifest.cameras)
    length = np.array([row.length for row in footer.episodes], np.int64)
    episodes = np.repeat([row.episode_index for row in footer.episodes], length * cameras)
    counting = [np.tile(np.arange(n), cameras) for n in length] or [np.zeros(0)]
    if not np.array_equal(kept["episode_index"], episodes):
        found.append(f"{path}: column episode_index is not what its footer says — {REMAKE}")
    if not np.array_equal(kept["frame_index"], np.concatenate(counting)):
        found.append(f"{path}: column frame_index does not count up from 0 in every episode — {REMAKE}")
    if cameras > 1:
        names = [camera for n in length for camera in np.repeat(manifest.cameras, n)]
        if kept["camera"].tolist() != names:
            found.append(f"{path}: column camera is not {', '.join(manifest.cameras)} in turn — {REMAKE}")
    times = kept["timestamp"]
    if not np.isfinite(times).all():
        found.append(f"{path}: column timestamp has values that are not finite — {REMAKE}")
    elif (np.diff(times)[np.diff(kept["frame_index"]) > 0] < 0).any():
        found.append(f"{path}: timestamps go back within an episode — {REMAKE}")
    for name, mask in KNOWN.items():
        if mask in kept and kept[name][~kept[mask]].any():
            found.append(f"{path}: column {name} is not 0 where {mask} is false — {REMAKE}")
    if found:
        return
    checked.stats = _row_stats(kept, footer, manifest)
    masked = {name: int((~kept[mask]).sum()) for name, mask in KNOWN.items() if mask in kept}
    faults = _stats_problems(footer, checked.stats, masked, manifest)
    found += [f"{path}: {fault} — {REMAKE}" for fault in faults]


def _read_rows(path: Path, manifest: Manifest, found: list[str]) -> dict[str, NDArray[Any]]:
    """Return all columns except the tokens; check tokens and numbers one row group at a time."""
    name = token_column(manifest.tokenizer)[0]
    size = manifest.tokenizer.vocab_size
    parts: dict[str, list[NDArray[Any]]] = {}
    with parquet_file(path, page_checksum_verification=True) as file:
        columns = file.schema_arrow.names
        for group in range(file.metadata.num_row_groups):
            table = file.read_row_group(group, use_threads=False)
            where = f"{path}: row group {group}"
            if any(table[column].null_count for column in columns):
                found.append(f"{where} has nulls — {REMAKE}")
            tokens = to_numpy(table[name])
            if size and tokens.size and tokens.max() >= size:
                said = f"has token {tokens.max()}, the vocabulary ends at {size - 1}"
                found.append(f"{where} {said} — {REMAKE}")
            for column in columns:
                if column != name:
                    parts.setdefault(column, []).append(to_numpy(table[column]))
                    values = parts[column][-1]
                else:
                    values = tokens
                if column != "timestamp" and values.dtype.kind == "f" and not np.isfinite(values).all():
                    found.append(f"{where} has {column} values that are not finite — {REMAKE}")
        empty = file.schema_arrow.empty_table()
    return {
        column: np.concatenate(parts[column]) if column in parts else to_numpy(empty[column])
        for column in columns
        if column != name
    }


def _row_stats(kept: dict[str, NDArray[Any]], footer: Footer, manifest: Manifest) -> dict[str, Stats]:
    """Return statistics of the rows of the first camera, computed as a conversion computes them."""
    widths = {"action": manifest.embodiment.action_dim}
    if manifest.embodiment.state:
        widths["state"] = manifest.embodiment.state.dims
    stats = {}
    for name, width in widths.items():
        stats[name] = Stats.empty(width)
        for row in footer.episodes:
            own = slice(row.row_start, row.row_start + row.length)
            values = kept[name][own]
            if KNOWN[name] in kept:
                values = values[kept[KNOWN[name]][own]]
            stats[name].merge(Stats.of(values.reshape(-1, width)))
    return stats


def _stats_problems(
    footer: Footer, rows: dict[str, Stats], masked: dict[str, int], manifest: Manifest
) -> list[str]:
    """Return where the footer's statistics are not those of its rows.

    The footer's statistics of a strided set count steps that its rows lack: a few steps at an episode's end,
    states between the rows, and the known steps of a chunk that is not wholly known.
    """
    found = []
    strided = manifest.plan.get("frames") == "strided"
    stride = manifest.embodiment.stride if strided else 1
    for name, own in rows.items():
        said = footer.stats.get(name)
        if said is None or len(said.mean) != len(own.mean):
            found.append(f"its footer has no statistics of {name}")
        elif strided:
            most = own.count * stride + stride * (len(footer.episodes) + masked.get(name, 0))
            if not own.count <= said.count <= most:
                found.append(
                    f"{name} statistics in its footer count {said.count} steps, its rows {own.count}"
                )
            elif own.count and ((own.min < said.min).any() or (own.max > said.max).any()):
                found.append(f"{name} statistics in its footer are narrower than its rows")
        elif not same_stats(said.summary(), own.summary(), quantiles=False):
            found.append(f"{name} statistics in its footer are not those of its rows")
    return found


def same_stats(a: dict[str, Any], b: dict[str, Any], quantiles: bool = True) -> bool:
    """Check whether two summaries are equal up to the rounding of sums; quantiles must be equal exactly."""
    if a.get("count") != b.get("count") or a.get("min") != b.get("min") or a.get("max") != b.get("max"):
        return False
    scale = np.maximum(np.abs(a["min"]), np.abs(a["max"]))
    for name in ("mean", "std"):
        if np.shape(a[name]) != np.shape(b[name]):
            return False
        if not (np.abs(np.subtract(a[name], b[name])) <= 1e-9 * scale + 1e-300).all():
            return False
    return not quantiles or bool(a["quantiles"] == b["quantiles"])


def plan_problem(manifest: Manifest) -> str:
    """Return what is wrong with the manifest's plan in itself; empty if nothing is wrong."""
    plan, embodiment, spec = manifest.plan, manifest.embodiment, manifest.tokenizer
    if plan.get("hash") != plan_hash(plan):
        return "its plan's hash is not that of the plan"
    if plan.get("embodiment_hash") != embodiment.digest or plan.get("embodiment") != embodiment.id:
        return "its plan is of another embodiment than it holds"
    if plan.get("tokenizer") != spec.to_json():
        return "its plan is of another tokenizer than it holds"
    return ""


BESIDE = {"README.md", ".gitattributes"}  # files that a hub adds
OnProgress = Callable[[int, int], None]


def verify(
    folder: StrPath,
    *,
    workers: int | None = None,
    quick: bool = False,
    on_progress: OnProgress = lambda done, total: None,
) -> list[str]:
    """Return everything wrong with a shard set, one line for each problem; empty if the set is sound.

    Args:
        folder: str or path of the set, or its URI.
        workers: number of threads; None takes the number of cores.
        quick: check sizes and footers only. This takes seconds for any set, but does not detect a flipped
            bit in a shard.
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
    """Return what is wrong with the shards, and the statistics of the train shards' rows."""
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
    """Check each shard and yield the results in the manifest's order."""
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
    """Yield a problem for each file that does not belong to the set."""
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
    """Yield a problem for each file, other than shards, that differs from what the manifest states."""
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
    """Yield problems: derived files that differ from the footers, episodes twice or in both splits."""
    expected = gathered.episodes()
    yield from _episode_problems(folder, expected)
    with suppress(OSError, pa.ArrowException):  # its sha256 differs and is reported already
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
    """Yield problems: episodes that occur twice, and recordings whose episodes are in both splits."""
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
