"""Measure `loader`: drawing windows out of shards of random tokens.

Each case runs in a process of its own, so that its memory is measured alone. Only one shard of each
embodiment is written; the others are hard links to it, so that a large set is made at once and stays in the
page cache.
"""

import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from hma_data.loading.mixture import Draw
from recipes.bench.harness import Bench, in_fresh_process, make_robot, peak_rss_mib, rss_mib

PEERS = ("datasets", "lance", "litdata", "streaming")  # of recipes/bench/peers.py


def run(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Run the cases, then the peers: `mixture` streams batches of all sets, `random` reads one set anyhow."""
    with tempfile.TemporaryDirectory() as folder:
        sets = [make_set(Path(folder) / str(i), i, settings) for i in range(settings["embodiments"])]
        results = [_timed(_load, case, sets, settings) for case in settings["cases"]]
        for name in settings["peers"]:
            from recipes.bench.peers import run_peer  # its rivals are optional packages

            results.append(_timed(run_peer, name, sets[0], settings))
        return results


def _timed(work: Callable[..., dict[str, Any]], name: str, *given: Any) -> dict[str, Any]:
    """Return the figures of a case out of a process of its own; say how long it took."""
    began = time.monotonic()
    figures = in_fresh_process(work, name, *given)
    print(f"{name}: {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    return figures


def make_set(folder: Path, number: int, settings: dict[str, Any]) -> Path:
    """Write a shard set of random tokens and actions; only its first shard is a file of its own."""
    from hma_data.shards.manifest import Derived, ShardFile, plan_hash
    from hma_data.shards.schema import EpisodeRow, Footer, arrow_schema, read_footer
    from hma_data.shards.stats import Stats
    from hma_data.shards.writer import ShardWriter
    from hma_data.storage.files import file_sha256
    from hma_data.tokenizers.base import TokenizerSpec

    (h, w), dims, length = settings["grid"], settings["action_dims"], settings["episode"]
    rate = {"hz": settings["stride"], "target_hz": 1}
    robot = make_robot(f"bench_{number}", "hdf5", "actions", "obs/image", dims=dims, **rate)
    spec = TokenizerSpec("random", 1, "discrete", 16 * h, (h, w), settings["vocabulary"])
    facts = {
        "embodiment": robot.id,
        "embodiment_hash": robot.digest,
        "tokenizer": spec.to_json(),
        "cameras": ["main"],
        "frames": "all",
        "frame_stride": 1,
    }
    plan = {**facts, "hash": plan_hash(facts)}
    episodes = max(1, settings["frames"] // length)
    each = max(1, settings["shard_frames"] // length)
    names = [f"train/shard-{shard:05d}.parquet" for shard in range(-(-episodes // each))]
    rng, schema = np.random.default_rng(number), arrow_schema(spec, dims, 0)
    inside: list[EpisodeRow] = []
    stats = Stats.empty(dims)
    (folder / "train").mkdir(parents=True)
    with ShardWriter(folder / names[0], schema, spec) as writer:
        for i in range(min(each, episodes)):
            tokens = rng.integers(0, spec.vocab_size, (length, *spec.grid), dtype=np.uint32)
            actions = rng.standard_normal((length, dims), dtype=np.float32)
            place = (str(i), "train", names[0], writer.rows, length, length)
            clock = np.arange(length) / robot.rate_hz
            writer.add(i, {"timestamp": clock, "tokens": tokens, "action": actions})
            stats.merge(Stats.of(actions))
            inside.append(EpisodeRow(i, *place, "", None, "", 0.0, 0.0, 0.0, "{}", 0, ""))
        writer.close(Footer(plan, names[0], "train", tuple(inside), (), {"action": stats}))
    first = folder / names[0]
    footer, row_groups = read_footer(first)
    sha256, size = file_sha256(first), first.stat().st_size
    derived = Derived(plan, robot, "generated")
    for shard, name in enumerate(names):
        if shard:
            os.link(first, folder / name)
        rows = tuple(
            replace(row, episode_index=shard * each + i, id=str(shard * each + i), shard=name)
            for i, row in enumerate(footer.episodes)
        )
        file = ShardFile(name, "train", sum(row_groups), len(rows), size, sha256, tuple(row_groups))
        derived.add(file, Footer(plan, name, "train", rows, (), footer.stats))
    derived.write(folder)
    return folder


def _load(case: str, sets: list[Path], settings: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of a case: opening, the first batch, speed and memory."""
    from hma_data.loading.dataset import MixtureDataset, WindowDataset

    mixed = case == "mixture"
    sets = sets if mixed else sets[:1]
    before, began = rss_mib(), time.perf_counter()
    data: Any
    if mixed:
        data = MixtureDataset(sets, settings["batch"], settings["window"], draw=settings["draw"])
    else:
        data = WindowDataset(sets[0], "train", settings["window"])
    opened, after = time.perf_counter() - began, rss_mib()
    batches = data.batches(settings["workers"]) if mixed else _random(data, settings["batch"])
    next(batches)
    first = time.perf_counter() - began
    return {
        "case": case,
        "embodiments": len(sets),
        "frames": settings["frames"] * len(sets),
        "open_seconds": round(opened, 4),
        "first_batch_seconds": round(first, 3),
        "open_rss_mib": round(after - before, 1),
        **_speed(batches, settings),
        "peak_rss_mib": peak_rss_mib(),
    }


def _random(windows: Any, count: int) -> Iterator[Any]:
    """Yield batches of random windows, of as many as the cache holds: small data."""
    rng = np.random.default_rng(0)
    near = min(len(windows), 8 * 2048)
    while True:
        yield windows.batch(rng.integers(0, near, count))


def _speed(batches: Iterator[Any], settings: dict[str, Any]) -> dict[str, Any]:
    """Return the best of several runs, because other work on the machine only ever slows a run down."""
    wall, cpu = [], []
    for _ in range(settings["runs"]):
        made, began, worked = 0, time.perf_counter(), time.process_time()
        while made < settings["windows"]:
            made += len(next(batches))
        wall.append(made / (time.perf_counter() - began))
        cpu.append(made / (time.process_time() - worked))
    return {"windows_per_second": round(max(wall)), "windows_per_cpu_second": round(max(cpu))}


BENCH = Bench(
    "windows of a shuffled mixture from cached local shards: rate, opening time, memory",
    {
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
        "peers": [],  # datasets, lance, litdata, streaming: random windows of the first set
        "peer_windows": 4_000,  # measured of each peer
        "workers": 0,
        "runs": 3,
    },
    run,
    choices={"draw": get_args(Draw), "cases": ("mixture", "random"), "peers": PEERS},
)
