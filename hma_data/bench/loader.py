"""Measure the loader: windows read from shards a second, the time to open the shards, and memory.

The shards hold random tokens. Only one shard of each embodiment is written; the others are hard links to it,
so that a large set is made at once and stays in the page cache. Each case runs in a process of its own.
"""

import os
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

ABOUT = "windows of a shuffled mixture out of cached local shards: speed, opening, memory"
DEFAULTS: dict[str, Any] = {
    "windows": 40_000,  # measured in each run
    "frames": 1_000_000,  # of an embodiment
    "embodiments": 4,
    "window": 12,  # T
    "grid": [16, 16],
    "vocabulary": 262_144,
    "action_dims": 7,
    "stride": 5,
    "episode": 200,  # frames
    "shard_frames": 100_000,
    "batch": 32,
    "draw": "per_sample",
    "cases": ["mixture", "random"],
    "workers": 0,
    "runs": 3,
}

_ROBOT = """
id: bench_{number}
kind: simulation
frequency_hz: {hz}
target_hz: 1
action: {{space: joint_delta, components: [{{key: actions, dims: {dims}}}]}}
cameras: [{{name: top, key: obs/image}}]
source: {{format: hdf5}}
"""


def run(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Run the cases: `mixture` streams shuffled batches of all sets; `random` reads one set in any order."""
    with tempfile.TemporaryDirectory() as folder:
        sets = [make_set(Path(folder) / str(i), i, settings) for i in range(settings["embodiments"])]
        results = []
        for case in settings["cases"]:
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as fresh:
                results.append(fresh.submit(_CASES[case], sets, settings).result())
        return results


def make_set(folder: Path, number: int, settings: dict[str, Any]) -> Path:
    """Write a shard set of random tokens and actions; only its first shard is a file of its own."""
    from hma_data.registry.embodiment import Embodiment
    from hma_data.shards.manifest import Derived, Gathered, Manifest, ShardFile, plan_hash, split_totals
    from hma_data.shards.schema import Footer, read_footer
    from hma_data.storage.files import file_sha256
    from hma_data.tokenizers.base import TokenizerSpec

    h, w = settings["grid"]
    robot = Embodiment.from_yaml(
        _ROBOT.format(number=number, hz=settings["stride"], dims=settings["action_dims"])
    )
    spec = TokenizerSpec("random", 1, "discrete", 16 * h, (h, w), settings["vocabulary"])
    facts = {
        "embodiment": robot.id,
        "embodiment_hash": robot.digest,
        "tokenizer": spec.to_json(),
        "cameras": ["top"],
        "frames": "all",
        "frame_stride": 1,
    }
    plan = {**facts, "hash": plan_hash(facts)}
    episodes = max(1, settings["frames"] // settings["episode"])
    each = max(1, settings["shard_frames"] // settings["episode"])
    first = folder / _name(0)
    _write_shard(first, robot, spec, plan, min(each, episodes), settings["episode"], number)
    footer, row_groups = read_footer(first)
    sha256, size = file_sha256(first), first.stat().st_size
    gathered, files = Gathered("generated"), []
    for shard in range(-(-episodes // each)):
        name = _name(shard)
        if shard:
            os.link(first, folder / name)
        rows = tuple(
            replace(row, episode_index=shard * each + i, id=str(shard * each + i), shard=name)
            for i, row in enumerate(footer.episodes)
        )
        gathered.add(Footer(plan, name, "train", rows, (), footer.stats))
        total = sum(row_groups)
        files.append(ShardFile(name, "train", total, len(rows), size, sha256, tuple(row_groups)))
    table = gathered.episodes()
    splits = {split: split_totals(table, files, split) for split in ("train", "val")}
    stats = gathered.summaries()
    manifest = Manifest(plan, robot, spec, tuple(files), splits, stats, 0, "generated")
    Derived(manifest, table, "").write(folder)
    return folder


def _name(shard: int) -> str:
    return f"train/shard-{shard:05d}.parquet"


def _write_shard(
    path: Path, robot: Any, spec: Any, plan: dict[str, Any], episodes: int, length: int, seed: int
) -> None:
    from hma_data.shards.schema import EpisodeRow, Footer, arrow_schema
    from hma_data.shards.stats import Stats
    from hma_data.shards.writer import EpisodeRows, ShardWriter

    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    schema = arrow_schema(spec, robot.action_dim, 0, 1)
    stats = Stats.empty(robot.action_dim)
    rows = []
    with ShardWriter(path, schema, spec) as writer:
        for i in range(episodes):
            tokens = rng.integers(0, spec.vocab_size, (length, *spec.grid), dtype=np.uint32)
            actions = rng.standard_normal((length, robot.action_dim), dtype=np.float32)
            stats.merge(Stats.of(actions))
            row = EpisodeRow(
                episode_index=i,
                id=str(i),
                split="train",
                shard=_name(0),
                row_start=writer.rows,
                rows=length,
                length=length,
                instruction="",
                success=None,
                fingerprint="",
                skew_p50_ms=0.0,
                skew_p95_ms=0.0,
                skew_max_ms=0.0,
                skew="{}",
                trimmed=0,
                flags="",
            )
            writer.add(EpisodeRows(i, np.arange(length) / robot.rate_hz, tokens, actions, None, "top"))
            rows.append(row)
        writer.close(Footer(plan, _name(0), "train", tuple(rows), (), {"action": stats}))


def _mixture(sets: list[Path], settings: dict[str, Any]) -> dict[str, Any]:
    from hma_data.loading.dataset import MixtureDataset

    before = _memory()
    began = time.perf_counter()
    data = MixtureDataset(sets, settings["batch"], settings["window"], draw=settings["draw"])
    opened = time.perf_counter() - began
    after = _memory()
    batches = data.batches(settings["workers"])
    next(batches)
    first = time.perf_counter() - began
    return {
        "case": "mixture",
        **_opening(settings, opened, first, before, after),
        **_speed(batches, settings),
        **_peak(),
    }


def _random(sets: list[Path], settings: dict[str, Any]) -> dict[str, Any]:
    from hma_data.loading.dataset import WindowDataset

    before = _memory()
    began = time.perf_counter()
    data = WindowDataset(sets[0], "train", settings["window"])
    opened = time.perf_counter() - began
    after = _memory()
    rng = np.random.default_rng(0)
    near = min(len(data), 8 * 2048)  # as many as the cache holds: small data

    def batches() -> Iterator[Any]:
        while True:
            yield data.batch(rng.integers(0, near, settings["batch"]))

    found = batches()
    next(found)
    first = time.perf_counter() - began
    return {
        "case": "random",
        **_opening(settings, opened, first, before, after, sets=1),
        **_speed(found, settings),
        **_peak(),
    }


_CASES = {"mixture": _mixture, "random": _random}


def _opening(
    settings: dict[str, Any],
    opened: float,
    first: float,
    before: float,
    after: float,
    sets: int | None = None,
) -> dict[str, Any]:
    return {
        "embodiments": sets or settings["embodiments"],
        "frames": settings["frames"] * (sets or settings["embodiments"]),
        "open_seconds": round(opened, 4),
        "first_batch_seconds": round(first, 3),
        "open_rss_mib": round(after - before, 1),
    }


def _speed(batches: Iterator[Any], settings: dict[str, Any]) -> dict[str, Any]:
    """Return the best of several runs, because other work on the machine only ever slows a run down."""
    wall, cpu = [], []
    for _ in range(settings["runs"]):
        made, began, worked = 0, time.perf_counter(), time.process_time()
        while made < settings["windows"]:
            made += len(next(batches))
        wall.append(made / (time.perf_counter() - began))
        cpu.append(made / (time.process_time() - worked))
    figures: dict[str, Any] = {"windows_per_second": round(max(wall))}
    if not settings["workers"]:
        figures["windows_per_cpu_second"] = round(max(cpu))
    return figures


def _peak() -> dict[str, Any]:
    from hma_data.bench import peak_rss_mib

    return {"peak_rss_mib": peak_rss_mib()}


def _memory() -> float:
    """Return the resident memory in MiB."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
