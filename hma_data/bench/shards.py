"""Measure shards of random tokens: `shards` writes, reads and verifies them, `loader` draws windows.

Each case runs in a process of its own, so that its memory is measured alone. For `loader` only one shard of
each embodiment is written; the others are hard links to it, so that a large set is made at once and stays in
the page cache.
"""

import os
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hma_data.bench import Bench, in_fresh_process, make_robot, peak_rss_mib, rss_mib

if TYPE_CHECKING:
    from hma_data.registry.embodiment import Embodiment
    from hma_data.shards.manifest import Manifest
    from hma_data.tokenizers.base import TokenizerSpec

Draw = Callable[[np.random.Generator, int], NDArray[np.float32]]  # (rng, length) -> actions (length, A)


def _write_shard(
    folder: Path,
    name: str,
    facts: dict[str, Any],
    robot: "Embodiment",
    spec: "TokenizerSpec",
    episodes: Iterable[tuple[int, str]],
    length: int,
    rng: np.random.Generator,
    draw: Draw,
) -> float:
    """Write a shard of episodes (index, id) of random tokens; return the seconds without drawing them."""
    from hma_data.shards.schema import EpisodeRow, Footer, arrow_schema
    from hma_data.shards.stats import Stats
    from hma_data.shards.writer import EpisodeRows, ShardWriter

    split, path, seconds = Path(name).parent.name, folder / name, 0.0
    path.parent.mkdir(parents=True, exist_ok=True)
    clock = np.arange(length) / robot.rate_hz
    rows, stats = [], Stats.empty(robot.action_dim)
    with ShardWriter(path, arrow_schema(spec, robot.action_dim, 0), spec) as writer:
        for index, episode in episodes:
            tokens = rng.integers(0, spec.vocab_size, (length, *spec.grid), dtype=np.uint32)
            actions = draw(rng, length)
            begun = time.perf_counter()
            place = (episode, split, name, writer.rows, length, length)
            writer.add(EpisodeRows(index, clock, tokens, actions, None))
            stats.merge(Stats.of(actions))
            rows.append(EpisodeRow(index, *place, "", None, "", 0.0, 0.0, 0.0, "{}", 0, ""))
            seconds += time.perf_counter() - begun
        begun = time.perf_counter()
        writer.close(Footer(facts, name, split, tuple(rows), (), {"action": stats}))
    return seconds + time.perf_counter() - begun


# -- shards


def measure_shards(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Run each step in a process of its own."""
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
    from hma_data.sources.base import EpisodeRef
    from hma_data.tokenizers.base import TokenizerSpec

    rng, length = np.random.default_rng(settings["seed"]), settings["episode"]
    robot = make_robot("bench_arm", "hdf5", "actions", "obs/front")
    spec = TokenizerSpec("random-18", 1, "discrete", 256, (16, 16), 2**18, (512, 512))
    refs = [EpisodeRef(f"episode_{i}", length) for i in range(max(2, settings["frames"] // length))]
    plan = make_plan(refs, robot, spec, Settings(shard_frames=25_000), "generated")
    seconds = 0.0
    for unit in plan.units:
        episodes = [(index, ref.id) for index, ref in unit.episodes]
        seconds += _write_shard(
            folder, unit.name, plan.facts, robot, spec, episodes, length, rng, _teleoperated
        )
    begun = time.perf_counter()
    manifest = finish(folder, [unit.name for unit in plan.units], robot, spec, plan.facts, "generated")
    seconds += time.perf_counter() - begun
    frames, size = _totals(manifest)
    return {
        "frames_per_second": frames / seconds,
        "bytes_per_frame": size / frames,
        "token_bytes_per_frame": _token_bytes(folder, manifest) / frames,
    }


def _totals(manifest: "Manifest") -> tuple[int, int]:
    """Return the number of frames and of bytes."""
    frames = sum(split["frames"] for split in manifest.splits.values())
    return frames, sum(shard.bytes for shard in manifest.shards)


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

    frames, size = _totals(ShardSet(folder).manifest)
    begun = time.perf_counter()
    verify(folder, workers=workers, quick=quick)
    seconds = time.perf_counter() - begun
    return {"frames_per_second": frames / seconds, "gigabytes_per_second": size / 1e9 / seconds}


SHARDS = Bench(
    "shards of random 18-bit tokens: write, read, verify; frames a second, bytes a frame, memory",
    {"frames": 100_000, "episode": 200, "workers": 2, "seed": 0},
    measure_shards,
)


# -- loader


def measure_loader(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Run the cases: `mixture` streams shuffled batches of all sets; `random` reads one set in any order."""
    with tempfile.TemporaryDirectory() as folder:
        sets = [make_set(Path(folder) / str(i), i, settings) for i in range(settings["embodiments"])]
        return [in_fresh_process(_load, case, sets, settings) for case in settings["cases"]]


def make_set(folder: Path, number: int, settings: dict[str, Any]) -> Path:
    """Write a shard set of random tokens and actions; only its first shard is a file of its own."""
    from hma_data.shards.manifest import Derived, Gathered, Manifest, ShardFile, plan_hash, split_totals
    from hma_data.shards.schema import Footer, read_footer
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
    inside = [(i, str(i)) for i in range(min(each, episodes))]

    def draw(rng: np.random.Generator, length: int) -> NDArray[np.float32]:
        return rng.standard_normal((length, dims), dtype=np.float32)

    _write_shard(folder, names[0], plan, robot, spec, inside, length, np.random.default_rng(number), draw)
    first = folder / names[0]
    footer, row_groups = read_footer(first)
    sha256, size = file_sha256(first), first.stat().st_size
    gathered, files = Gathered("generated"), []
    for shard, name in enumerate(names):
        if shard:
            os.link(first, folder / name)
        rows = tuple(
            replace(row, episode_index=shard * each + i, id=str(shard * each + i), shard=name)
            for i, row in enumerate(footer.episodes)
        )
        gathered.add(Footer(plan, name, "train", rows, (), footer.stats))
        files.append(ShardFile(name, "train", sum(row_groups), len(rows), size, sha256, tuple(row_groups)))
    table = gathered.episodes()
    splits = {split: split_totals(table, files, split) for split in ("train", "val")}
    manifest = Manifest(plan, robot, spec, tuple(files), splits, gathered.summaries(), 0, "generated")
    Derived(manifest, table, "").write(folder)
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
    figures: dict[str, Any] = {"windows_per_second": round(max(wall))}
    if not settings["workers"]:
        figures["windows_per_cpu_second"] = round(max(cpu))
    return figures


LOADER = Bench(
    "windows of a shuffled mixture out of cached local shards: speed, opening, memory",
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
        "workers": 0,
        "runs": 3,
    },
    measure_loader,
)
