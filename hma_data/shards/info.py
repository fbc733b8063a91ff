"""Describe a shard set in figures from its manifest and episodes.parquet, without opening a shard."""

from typing import Any

import numpy as np
import pyarrow.compute as pc

from hma_data.shards.reader import ShardSet
from hma_data.shards.schema import flag_counts
from hma_data.shards.windows import WindowIndex
from hma_data.storage.paths import StrPath

WINDOW = 12  # frames of the model's window


def describe(folder: StrPath) -> dict[str, Any]:
    """Return plain values for `hma shards info --json`.

    Args:
        folder: str or path of the set, or its URI.

    Raises:
        ShardError: the manifest or episodes.parquet is missing or damaged.
    """
    shards = ShardSet(folder)
    manifest, robot = shards.manifest, shards.embodiment
    values = manifest.to_json()
    totals = values["totals"]
    rows = sum(split["rows"] for split in manifest.splits.values())
    row_hz = robot.rate_hz / manifest.frame_stride
    return {
        "folder": str(shards.folder),
        "embodiment": {
            "id": robot.id,
            "robot": robot.robot,
            "action_dim": robot.action_dim,
            "state_dim": robot.state.dims if robot.state else 0,
            "stride": robot.stride,
            "rows_hz": row_hz,
            "effective_hz": robot.effective_hz,
            "cameras": manifest.cameras,
        },
        "tokenizer": values["tokenizer"],
        "source": manifest.source,
        "totals": totals | {"hours": totals["frames"] / row_hz / 3600},
        "bytes_per_frame": totals["bytes"] / max(rows, 1),
        "shards": len(manifest.shards),
        "splits": manifest.splits,
        "windows": {
            split: {"windows": index.count, "short_episodes": index.short_episodes}
            for split in manifest.splits
            for index in [WindowIndex.of(shards, split, WINDOW)]
        },
        "episodes": _episodes(shards),
        "names": {"action": robot.action.names(), "state": robot.state.names() if robot.state else []},
        "stats": manifest.stats,
        "plan": manifest.plan,
    }


def _episodes(shards: ShardSet) -> dict[str, Any]:
    table = shards.episodes
    lengths = np.sort(table["length"].to_numpy())
    flags: dict[str, int] = {}
    for text in table["flags"].to_pylist():
        for name, count in flag_counts(text or "").items():
            flags[name] = flags.get(name, 0) + count
    reasons: dict[str, int] = {}
    for item in shards.refused():
        reasons[str(item.get("type"))] = reasons.get(str(item.get("type")), 0) + 1
    told = pc.value_counts(table["success"].combine_chunks()).to_pylist()
    success = {item["values"]: item["counts"] for item in told}
    return {
        "shortest": int(lengths[0]) if len(lengths) else 0,
        "median": float(np.median(lengths)) if len(lengths) else 0.0,
        "longest": int(lengths[-1]) if len(lengths) else 0,
        "instructions": len(set(table["instruction"].to_pylist()) - {"", None}),
        "success": success.get(True, 0),
        "failure": success.get(False, 0),
        "not_told": success.get(None, 0),
        "worst_skew_ms": pc.max(table["skew_max_ms"]).as_py() or 0.0,
        "flags": flags,
        "quarantine": reasons,
    }
