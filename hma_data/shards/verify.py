"""Check a shard set: every hash, row count and invariant. Nothing is changed.

Each shard is checked against its manifest, its footer and itself. Then the files that are derived from the
shards are checked. Threads check a few shards at a time (hashing and parquet release the interpreter lock).
Each thread holds one row group of tokens in memory, so memory does not grow with the set.

N rows of a shard, A values of an action.
"""

from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from hma_data.arrays import Array
from hma_data.cpu import in_order, usable_cores
from hma_data.errors import HMAError
from hma_data.shards.manifest import (
    EMBODIMENT,
    EPISODES,
    FILES_BESIDE,
    FINDER,
    MANIFEST,
    QUARANTINE,
    SPLITS,
    WORKING,
    Derived,
    Manifest,
    ShardFile,
    damaged_files,
    plan_hash,
    restat_remedy,
    seal_problem,
    stored_embodiment,
)
from hma_data.shards.schema import Footer, read_footer, to_numpy
from hma_data.storage.files import PART, file_sha256
from hma_data.storage.kinds import one_line
from hma_data.storage.paths import StrPath
from hma_data.storage.remote import parquet_file, parquet_input, place

REMAKE = "delete it and run the same hma convert again"
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
    try:
        manifest = Manifest.load(folder)
        fault = seal_problem((folder / MANIFEST).read_bytes()) or _plan_problem(manifest)
    except (HMAError, OSError) as unreadable:
        return [_line(unreadable, folder / MANIFEST)]
    restat = restat_remedy(folder)
    found = [f"{folder / MANIFEST}: {fault} — {restat}"] if fault else []
    derived = Derived(manifest.plan, manifest.embodiment, manifest.source)
    for shard, problems, footer in checked_shards(folder, manifest, workers, quick, on_progress):
        found += problems
        if footer is not None and not problems:
            derived.add(shard, footer)
    found += _foreign(folder, manifest)
    damaged = damaged_files(folder, manifest)
    found += [
        f"{path}: is missing, or its bytes changed since the manifest was written — {restat}"
        for path in damaged
    ]
    try:
        if folder / EMBODIMENT not in damaged and stored_embodiment(folder) != manifest.embodiment:
            found.append(f"{folder / EMBODIMENT}: is another embodiment than the manifest's — {restat}")
        if len(derived.shards) == len(manifest.shards) and not damaged:
            found += _set_problems(folder, manifest, derived, restat)
    except (HMAError, OSError, pa.ArrowException) as unreadable:
        found.append(_line(unreadable, folder))
    return found


# -- one shard


def check_shard(
    folder: Path, shard: ShardFile, manifest: Manifest, quick: bool
) -> tuple[list[str], Footer | None]:
    """Return everything wrong with one shard, and its footer, None where it cannot be read.

    A `quick` check looks at size and footer only.
    """
    path = folder / shard.path
    try:
        if not path.is_file():
            return [f"{path}: is missing — run the same hma convert again"], None
        if (size := path.stat().st_size) != shard.bytes:
            return [f"{path}: has {size:,} bytes, the manifest says {shard.bytes:,} — {REMAKE}"], None
        if not quick and file_sha256(path) != shard.sha256:
            fault = "its bytes changed since the manifest was written (sha256 differs)"
            return [f"{path}: {fault} — {REMAKE}"], None
        footer, row_groups = read_footer(path)
        found = _footer_problems(path, shard, footer, row_groups, manifest)
        if not quick and not found:
            columns, found = _read_rows(path, manifest)
            found = found or _row_problems(columns, footer) or _stats_problems(columns, footer, manifest)
        return [f"{path}: {problem} — {REMAKE}" for problem in found], footer
    except (HMAError, pa.ArrowException, OSError, ValueError) as unreadable:
        return [_line(unreadable, path)], None


def _line(fault: Exception, path: Path) -> str:
    text = one_line(fault, 500)
    return text if isinstance(fault, HMAError) else f"{path}: cannot be read: {text} — {REMAKE}"


def _footer_problems(
    path: Path, shard: ShardFile, footer: Footer, row_groups: list[int], manifest: Manifest
) -> list[str]:
    own, hashed = manifest.plan, footer.plan.get("hash")
    if footer.plan != own and hashed not in own.get("extends", ()):
        return [f"was made by another plan ({hashed}) than the manifest's ({own['hash']})"]
    found = []
    stated = replace(
        shard,
        path=footer.name,
        split=footer.split,
        rows=sum(row_groups),
        episodes=len(footer.episodes),
        row_groups=tuple(row_groups),
    )
    if stated != shard:
        facts = asdict(stated).items() - asdict(shard).items()
        said = ", ".join(f"{name} {value}" for name, value in sorted(facts))
        found.append(f"states other facts than the manifest: {said}")
    table = footer.table
    named = table.group_by(["shard", "split"]).aggregate([]).to_pylist()
    if named not in ([], [{"shard": footer.name, "split": footer.split}]):
        found.append("its episodes name another shard or split")
    begun, rows, length = (to_numpy(table[name]) for name in ("row_start", "rows", "length"))
    starts = np.cumsum([0, *rows])
    if (begun != starts[:-1]).any() or starts[-1] != shard.rows:
        found.append("its episodes do not follow one another row by row")
    if ((rows != length) | (length < 1)).any():
        found.append("an episode does not have one row for each frame")
    expected, actual = manifest.layout.schema, pq.read_schema(parquet_input(path))
    if not actual.equals(expected, check_metadata=False):
        others = [f"{column.name} {column.type}" for column in {*actual} ^ {*expected}]
        said = "its columns are not those of the manifest's embodiment and tokenizer"
        found.append(f"{said}; different: {', '.join(sorted(others)) or 'their order'}")
    return found


def _read_rows(path: Path, manifest: Manifest) -> tuple[dict[str, Array], list[str]]:
    """Return all columns except the tokens, and what is wrong with the tokens and numbers."""
    names, size = sorted({*manifest.layout.token_columns.values()}), manifest.tokenizer.vocab_size
    found: list[str] = []
    with parquet_file(path, page_checksum_verification=True) as file:
        tables = [file.schema_arrow.empty_table().drop_columns(names)]
        for group in range(file.metadata.num_row_groups):
            table = file.read_row_group(group, use_threads=False)
            if any(column.null_count for column in table.columns):
                found.append(f"row group {group} has nulls")
            for name in names:
                tokens = to_numpy(table[name])
                if size and tokens.size and tokens.max() >= size:
                    said = f"has token {tokens.max()} in {name}, the vocabulary ends at {size - 1}"
                    found.append(f"row group {group} {said}")
                if tokens.dtype.kind == "f" and not np.isfinite(tokens).all():
                    found.append(f"row group {group} has {name} that are not finite")
            tables.append(table.drop_columns(names))
    rows = pa.concat_tables(tables)
    columns = {column: to_numpy(rows[column]) for column in rows.column_names}
    found += [
        f"column {column} has values that are not finite"
        for column, values in columns.items()
        if values.dtype.kind == "f" and not np.isfinite(values).all()
    ]
    return columns, found


def _row_problems(columns: dict[str, Array], footer: Footer) -> list[str]:
    """Check rows against the footer: whole episodes, frames that count up, zeros where nothing is known."""
    found: list[str] = []
    names = ("row_start", "length", "episode_index")
    start, length, number = (to_numpy(footer.table[name]) for name in names)
    frames = np.arange(length.sum()) - np.repeat(start, length)
    if not np.array_equal(columns["episode_index"], np.repeat(number, length)):
        found.append("column episode_index is not what its footer says")
    if not np.array_equal(columns["frame_index"], frames):
        found.append("column frame_index does not count up from 0 in every episode")
    if (np.diff(columns["timestamp"])[np.diff(columns["frame_index"]) > 0] < 0).any():
        found.append("timestamps go back within an episode")
    for name, mask in (("action", "action_known"), ("state", "state_known")):
        if mask in columns and columns[name][~columns[mask]].any():
            found.append(f"column {name} is not 0 where {mask} is false")
    return found


def _stats_problems(columns: dict[str, Array], footer: Footer, manifest: Manifest) -> list[str]:
    """Return where the footer's statistics are not those of its rows.

    The footer's statistics of a strided set count steps that its rows lack: a few steps at an episode's end,
    states between the rows, and the known steps of a chunk that is not wholly known.
    """
    found, rows = [], manifest.layout.empty_stats()
    for row in footer.episodes:  # as a conversion computes them, each frame once
        own_rows = slice(row.row_start, row.row_start + row.length)
        for name, stats in manifest.layout.stats(columns, own_rows).items():
            rows[name].merge(stats)
    stride = manifest.frame_stride
    for name, own in rows.items():
        said = footer.stats.get(name)
        if said is None or len(said.mean) != len(own.mean):
            found.append(f"its footer has no statistics of {name}")
        elif stride > 1:
            masked = np.count_nonzero(~columns.get(f"{name}_known", np.ones(0, np.bool_)))
            if not own.count <= said.count <= stride * (own.count + len(footer.episodes) + masked):
                counted = f"count {said.count} steps, its rows {own.count}"
                found.append(f"{name} statistics in its footer {counted}")
            elif own.count and ((own.min < said.min).any() or (own.max > said.max).any()):
                found.append(f"{name} statistics in its footer are narrower than its rows")
        elif not _same_stats(said.summary(), own.summary()):
            found.append(f"{name} statistics in its footer are not those of its rows")
    return found


def _same_stats(a: dict[str, Any], b: dict[str, Any]) -> bool:
    """Check whether two summaries are equal up to the rounding of sums, apart from their quantiles."""
    if any(a[key] != b[key] for key in ("count", "min", "max")):
        return False
    scale = 1e-9 * np.maximum(np.abs(a["min"]), np.abs(a["max"])) + 1e-300
    return not any((np.abs(np.subtract(a[name], b[name])) > scale).any() for name in ("mean", "std"))


# -- the set


def _plan_problem(manifest: Manifest) -> str:
    """Return what is wrong with the manifest's plan in itself; empty if nothing is wrong."""
    plan, embodiment = manifest.plan, manifest.embodiment
    if plan["hash"] != plan_hash(plan):
        return "its plan's hash is not that of the plan"
    if (plan["embodiment_hash"], plan["embodiment"]) != (embodiment.digest, embodiment.id):
        return "its plan is of another embodiment than it holds"
    if plan["tokenizer"] != manifest.tokenizer.to_json():
        return "its plan is of another tokenizer than it holds"
    return ""


def checked_shards(
    folder: Path, manifest: Manifest, workers: int | None, quick: bool, on_progress: OnProgress
) -> Iterator[tuple[ShardFile, list[str], Footer | None]]:
    """Yield each shard in the manifest's order, what is wrong with it, and its footer."""
    total = sum(shard.bytes for shard in manifest.shards)
    done = 0

    def check(shard: ShardFile) -> tuple[list[str], Footer | None]:
        return check_shard(folder, shard, manifest, quick)

    for shard, (problems, footer) in in_order(check, manifest.shards, workers or usable_cores()):
        done += shard.bytes
        on_progress(done, total)
        yield shard, problems, footer


def _foreign(folder: Path, manifest: Manifest) -> Iterator[str]:
    """Yield a problem for each file that does not belong to the set."""
    known = {shard.path for shard in manifest.shards} | FILES_BESIDE
    known |= {MANIFEST, EPISODES, QUARANTINE, EMBODIMENT}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if name in known or name.startswith(WORKING) or path.name == FINDER:
            continue
        if name in SPLITS and path.is_dir():
            continue
        if path.name.endswith(PART):
            yield f"{path}: is left of a job that runs or was killed — run the same hma convert again"
        else:
            yield f"{path}: is not in the manifest — move it out of the shard set"


def _set_problems(folder: Path, manifest: Manifest, derived: Derived, restat: str) -> Iterator[str]:
    """Yield problems: derived files that differ from the footers, episodes twice or in both splits."""
    yield from _episode_problems(folder, derived.episodes)
    if not pq.read_table(parquet_input(folder / EPISODES)).equals(derived.episodes):
        yield f"{folder / EPISODES}: differs from the shards' footers — {restat}"
    if (folder / QUARANTINE).read_bytes() != derived.quarantine.encode():
        yield f"{folder / QUARANTINE}: differs from the shards' footers — {restat}"
    own = derived.manifest
    for name in ("splits", "quarantined", "stats"):
        if getattr(manifest, name) != getattr(own, name):
            yield f"{folder / MANIFEST}: its {name} are not those of the shards — {restat}"


def _episode_problems(folder: Path, episodes: pa.Table) -> Iterator[str]:
    """Yield problems: episodes that occur twice, and recordings whose episodes are in both splits."""
    for column, said in (("id", "occurs twice"), ("episode_index", "is the number of two episodes")):
        counts = pc.value_counts(episodes[column].combine_chunks())
        for item in counts.filter(pc.greater(counts.field("counts"), 1)).to_pylist()[:3]:
            remedy = "convert again with --overwrite"
            yield f"{folder}: episode {column} {item['values']!r} {said} — {remedy}"
    grouped = episodes.filter(pc.not_equal(episodes["group"], ""))
    pairs = grouped.group_by("group").aggregate([("split", "count_distinct")])
    for name in pairs.filter(pc.greater(pairs["split_count_distinct"], 1))["group"].to_pylist()[:3]:
        remedy = "hma shards split makes a set where they are in one"
        yield f"{folder}: episodes of one recording, {name!r}, are in both splits — {remedy}"
