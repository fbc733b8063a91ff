"""Check one shard against its manifest, its footer and itself.

N rows of a shard, A values of an action.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from hma_data.errors import HMAError
from hma_data.files import file_sha256
from hma_data.shards.manifest import Manifest, ShardFile, plan_hash
from hma_data.shards.schema import (
    Footer,
    arrow_schema,
    mask_columns,
    read_footer,
    to_numpy,
    token_column,
)
from hma_data.stats import Stats
from hma_data.store import parquet_file, parquet_input

REMAKE = "delete it and run the same hma convert again"
KNOWN = {"action": "action_known", "state": "state_known"}  # bool columns, where values can be missing


@dataclass
class Checked:
    """What came of one shard.

    Attributes:
        problems: a line each.
        footer: None when it cannot be read.
        stats: of its rows, "action" and "state"; empty for a quick check.
    """

    problems: list[str] = field(default_factory=list)
    footer: Footer | None = None
    stats: dict[str, Stats] = field(default_factory=dict)


def check_shard(folder: Path, shard: ShardFile, manifest: Manifest, quick: bool) -> Checked:
    """Everything wrong with one shard; `quick` looks at size and footer only."""
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
        return Checked([f"{path}: cannot be read: {_one_line(fault)} — {REMAKE}"])


def _one_line(fault: BaseException) -> str:
    return " ".join(str(fault).split())[:300]


def _whose(path: Path, manifest: Manifest) -> str:
    """Tells a shard of another run from a damaged one."""
    try:
        plan = read_footer(path, str(path))[0].plan
    except HMAError:
        return ""
    return "" if _belongs(plan, manifest) else f", and {_another_plan(plan, manifest)}"


def _belongs(plan: dict[str, Any], manifest: Manifest) -> bool:
    """Whether a shard's plan is the set's, or one that the set extends."""
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
    """Rows against the footer: whole episodes, frames counting up, tokens in range, finite numbers."""
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
    """All columns but the tokens, whole; tokens and numbers are checked a row group at a time."""
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
    """Statistics of the rows that the first camera saw, made as a conversion makes them."""
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
    """The footer's statistics are those of its rows.

    Strided rows lack a few steps at an episode's end, states between the rows, and the known steps of a
    chunk that is not wholly known.
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
    """Whether two summaries say the same up to the rounding of sums; quantiles are of equal sketches."""
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
    """What is wrong with the manifest's plan in itself; empty when nothing is."""
    plan, embodiment, spec = manifest.plan, manifest.embodiment, manifest.tokenizer
    if plan.get("hash") != plan_hash(plan):
        return "its plan's hash is not that of the plan"
    if plan.get("embodiment_hash") != embodiment.digest or plan.get("embodiment") != embodiment.id:
        return "its plan is of another embodiment than it holds"
    if plan.get("tokenizer") != spec.to_json():
        return "its plan is of another tokenizer than it holds"
    return ""
