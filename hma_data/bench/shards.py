"""Measure writing, reading and verifying shards of generated tokens: speed, size and memory."""

import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hma_data.bench import in_fresh_process, make_robot, peak_rss_mib

if TYPE_CHECKING:
    from hma_data.shards.manifest import Manifest

ABOUT = "shards of random 18-bit tokens: write, read, verify; frames a second, bytes a frame, memory"
DEFAULTS: dict[str, Any] = {"frames": 100_000, "episode": 200, "workers": 2, "seed": 0}


def run(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Run each step in a process of its own, so that its memory is measured alone."""
    with tempfile.TemporaryDirectory() as folder:
        steps = ("write", "read", "verify", "verify --quick")
        return [in_fresh_process(_step, step, Path(folder), settings) for step in steps]


def _step(step: str, folder: Path, settings: dict[str, Any]) -> dict[str, Any]:
    if step == "write":
        figures = _write(folder, settings)
    elif step == "read":
        figures = _read(folder)
    else:
        figures = _verify(folder, settings["workers"], step.endswith("--quick"))
    figures["peak_rss_mib"] = peak_rss_mib()
    return {"step": step, **{name: float(f"{value:.4g}") for name, value in figures.items()}}


def _teleoperated(rng: np.random.Generator, length: int) -> NDArray[np.float32]:
    """Return (length, 7) commands like a person's: smooth, in hundredths, zero for half of the time."""
    smooth = np.cumsum(rng.normal(scale=0.05, size=(length, 7)), axis=0)
    moving = np.repeat(rng.random((length // 10 + 1, 7)) < 0.5, 10, axis=0)[:length]
    return np.where(moving, np.clip(smooth, -1, 1), 0).round(2).astype(np.float32)


def _write(folder: Path, settings: dict[str, int]) -> dict[str, float]:
    from hma_data.conversion.plan import Settings, make_plan
    from hma_data.shards.manifest import finish
    from hma_data.shards.schema import EpisodeRow, Footer, arrow_schema
    from hma_data.shards.stats import Stats
    from hma_data.shards.writer import EpisodeRows, ShardWriter
    from hma_data.sources.base import EpisodeRef
    from hma_data.tokenizers.base import TokenizerSpec

    rng, length = np.random.default_rng(settings["seed"]), settings["episode"]
    robot = make_robot("bench_arm", "hdf5", "actions", "obs/front")
    spec = TokenizerSpec("random-18", 1, "discrete", 256, (16, 16), 2**18, (512, 512))
    refs = [EpisodeRef(f"episode_{i}", length) for i in range(max(2, settings["frames"] // length))]
    plan = make_plan(refs, robot, spec, Settings(shard_frames=25_000), "generated")
    seconds = 0.0
    clock = np.arange(length) / 10
    for unit in plan.units:
        rows, stats = [], {"action": Stats.empty(7)}
        with ShardWriter(folder / unit.name, arrow_schema(spec, 7, 0), spec) as writer:
            for index, ref in unit.episodes:
                tokens = rng.integers(0, 2**18, (length, 16, 16), dtype=np.uint32)
                actions = _teleoperated(rng, length)
                begun = time.perf_counter()
                place = (ref.id, unit.split, unit.name, writer.rows, length, length)
                writer.add(EpisodeRows(index, clock, tokens, actions, None))
                stats["action"].merge(Stats.of(actions))
                rows.append(EpisodeRow(index, *place, "", None, "", 0.0, 0.0, 0.0, "{}", 0, ""))
                seconds += time.perf_counter() - begun
            begun = time.perf_counter()
            writer.close(Footer(plan.facts, unit.name, unit.split, tuple(rows), (), stats))
        seconds += time.perf_counter() - begun
    begun = time.perf_counter()
    manifest = finish(folder, [unit.name for unit in plan.units], robot, spec, plan.facts, "generated")
    seconds += time.perf_counter() - begun
    frames = sum(split["frames"] for split in manifest.splits.values())
    size = sum(shard.bytes for shard in manifest.shards)
    return {
        "frames_per_second": frames / seconds,
        "bytes_per_frame": size / frames,
        "token_bytes_per_frame": _token_bytes(folder, manifest) / frames,
    }


def _token_bytes(folder: Path, manifest: "Manifest") -> int:
    import pyarrow.parquet as pq

    total = 0
    for shard in manifest.shards:
        metadata = pq.read_metadata(folder / shard.path)
        for group in range(metadata.num_row_groups):
            columns = (metadata.row_group(group).column(i) for i in range(metadata.num_columns))
            total += sum(c.total_compressed_size for c in columns if c.path_in_schema.startswith("tokens"))
    return total


def _read(folder: Path) -> dict[str, float]:
    from hma_data.shards.reader import ShardSet

    shards, rows = ShardSet(folder), 0
    begun = time.perf_counter()
    for shard in shards.manifest.shards:
        for group in range(len(shard.row_groups)):
            rows += len(shards.read(shard.path, [group], shards.columns())["tokens"])
    return {"frames_per_second": rows / (time.perf_counter() - begun)}


def _verify(folder: Path, workers: int, quick: bool) -> dict[str, float]:
    from hma_data.shards.reader import ShardSet
    from hma_data.shards.verify import verify

    manifest = ShardSet(folder).manifest
    begun = time.perf_counter()
    verify(folder, workers=workers, quick=quick)
    seconds = time.perf_counter() - begun
    frames = sum(split["frames"] for split in manifest.splits.values())
    size = sum(shard.bytes for shard in manifest.shards)
    return {"frames_per_second": frames / seconds, "gigabytes_per_second": size / 1e9 / seconds}
