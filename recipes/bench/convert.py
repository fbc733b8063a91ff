"""Measure `hma convert`: overhead beside the tokenizer, and memory of its workers over time."""

import multiprocessing
import os
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.errors import UsageError
from recipes.bench.harness import Bench, make_robot, rss_mib


def run(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Time the tokenizer alone on as many frames, then run the conversion and measure its processes."""
    from hma_data.conversion.engines import Limits
    from hma_data.conversion.job import convert
    from hma_data.conversion.plan import Settings

    workers = settings["workers"]
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        if wait := settings["wait_ms"]:
            if settings["tokenizer"] != BENCH.defaults["tokenizer"]:
                raise UsageError("wait_ms", "stands for a tokenizer", "leave tokenizer out")
            from recipes.bench import waiting_tokenizer as waiting

            settings = settings | {"tokenizer": waiting.NAME}
            stack.enter_context(waiting.offered(Path(folder) / "path", wait))
        stack.enter_context(_cluster(settings["engine"], settings["nodes"]))
        recording = Path(folder) / "recording.hdf5"
        _record(recording, settings)
        rows = settings["episodes"] * settings["frames"]
        alone_cpu = 0.0 if wait else _tokenizer_alone(settings, rows)
        watch = _Watch(workers, settings["engine"])
        summary = convert(
            make_robot("bench_arm", "hdf5", "actions", "obs/image"),
            recording,
            settings["tokenizer"],
            Path(folder) / "out",
            settings=Settings(shard_frames=settings["shard_frames"]),
            workers=workers,
            engine=settings["engine"],
            worker_cpus=settings["worker_cpus"],
            limits=Limits(quiet_s=None),
            on_progress=watch.mark,
        )
        watch.stop()
    after = 1 - watch.start_frames / rows  # share of frames made after the first report
    used = watch.cpu_s - watch.start_cpu_s
    return [
        {
            "engine": settings["engine"],
            "workers": workers,
            "tokenizer": settings["tokenizer"],
            "seconds": round(watch.seconds, 2),
            "start_seconds": round(watch.start_seconds, 2),
            "frames_per_second": round(rows * after / (watch.seconds - watch.start_seconds), 1),
            "tokenizer_cpu_seconds": None if wait else round(alone_cpu * after, 2),
            "worker_cpu_seconds": round(used, 2),
            "overhead_cpu_share": round(1 - alone_cpu * after / used, 4) if used and not wait else None,
            "frames_per_second_limit": 1e3 * max(workers, 1) / wait if wait else None,
            "ray_cpu_seconds": round(watch.others_cpu_s, 2),
            **watch.memory(),
            "episodes": summary.manifest.episodes,
            "bytes_per_frame": round(summary.manifest.to_json()["totals"]["bytes"] / rows, 1),
        }
    ]


@contextmanager
def _cluster(engine: str, nodes: int) -> Iterator[None]:
    """Start a Ray cluster of several nodes on this machine, one CPU each, if the engine is Ray."""
    if engine != "ray":
        yield
        return
    from hma_data.conversion.engines.ray import import_ray

    ray = import_ray()
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    for _ in range(nodes - 1):
        cluster.add_node(num_cpus=1)
    ray.init(address=cluster.address, log_to_driver=False, logging_level="error")
    try:
        yield
    finally:
        ray.shutdown()
        cluster.shutdown()


def _record(path: Path, settings: dict[str, Any]) -> None:
    """Write episodes of JPEG pictures: crops of a texture, so that they compress as real pictures do."""
    import cv2
    import h5py

    rng = np.random.default_rng(0)
    size, length = settings["pixels"], settings["frames"]
    texture = cv2.GaussianBlur(rng.integers(0, 256, (3 * size, 3 * size, 3), np.uint8), (0, 0), 3)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    pictures = []
    for _ in range(64):
        y, x = rng.integers(0, 2 * size, 2)
        pictures.append(cv2.imencode(".jpg", texture[y : y + size, x : x + size])[1].ravel())
    with h5py.File(path, "w", libver="latest") as file:
        for i in range(settings["episodes"]):
            group = file.create_group(f"data/demo_{i}")
            group["actions"] = rng.normal(size=(length, 7)).astype(np.float32)
            kind = h5py.vlen_dtype(np.uint8)
            images = group.create_dataset("obs/image", (length,), dtype=kind)
            for t in range(length):
                images[t] = pictures[(7 * i + t) % len(pictures)]


def _tokenizer_alone(settings: dict[str, Any], rows: int) -> float:
    """Return the CPU seconds for `rows` frames in a worker's batches, measured on a part of them."""
    from hma_data.conversion.worker import FRAMES_A_BATCH
    from hma_data.cpu import usable_cores
    from hma_data.tokenizers.base import get_tokenizer

    tokenizer = get_tokenizer(settings["tokenizer"])
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(max(1, usable_cores() // max(settings["workers"], 1)))
    size = tokenizer.spec.image_size
    frames = np.random.default_rng(1).integers(0, 256, (FRAMES_A_BATCH, size, size, 3), np.uint8)
    tokenizer.encode(frames)
    done, began = 0, time.process_time()
    while done < min(rows, 4_096):
        tokenizer.encode(frames)
        done += FRAMES_A_BATCH
    return (time.process_time() - began) * rows / done


class _Watch:
    """Memory of this process and its workers, and CPU time of the workers, sampled while the conversion runs.

    `start_*` are the figures at the first report of finished frames. `samples` hold the share of the frames
    that are done, and MiB of the largest worker and of this process.
    """

    def __init__(self, workers: int, engine: str) -> None:
        self.workers, self._engine = workers, engine
        self.others_cpu_s = 0.0  # of Ray's own processes
        self.seconds = self.start_seconds = self.cpu_s = self.start_cpu_s = self._share = 0.0
        self.start_frames = 0
        self.samples: list[tuple[float, dict[str, float]]] = []
        self._began, self._stop = time.perf_counter(), threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def mark(self, progress: Any) -> None:
        """Record the progress of the conversion."""
        if progress.frames and not self.start_frames:
            self.start_seconds = time.perf_counter() - self._began
            self.start_frames, self.start_cpu_s = progress.frames, self.cpu_s
        self._share = progress.frames / max(progress.total_frames, 1)

    def stop(self) -> None:
        """End the sampling."""
        self.seconds = time.perf_counter() - self._began
        self._stop.set()
        self._thread.join()

    def memory(self) -> dict[str, float]:
        """Return the resident MiB of the largest worker and of this process, over the run."""
        return {
            f"{role}_rss_mib_at_{name}": round(min(self.samples, key=lambda s: abs(s[0] - at))[1][role], 1)
            for role in ("worker", "parent")
            for name, at in {"a_tenth": 0.1, "half": 0.5, "the_end": 1.0}.items()
            if self.samples
        }

    def _look(self) -> None:
        while not self._stop.wait(0.2):
            if self._engine == "ray":
                children, others = _ray_processes()
                self.others_cpu_s = max(self.others_cpu_s, _cpu_s(others))
            else:
                children = [child.pid for child in multiprocessing.active_children() if child.pid]
            pids = children if self.workers else [os.getpid()]
            if pids:  # none when the workers have ended, and the manifest is being written
                self.cpu_s = max(self.cpu_s, _cpu_s(pids))
                memory = {"worker": max(map(rss_mib, pids)), "parent": rss_mib()}
                self.samples.append((self._share, memory))


def _ray_processes() -> tuple[list[int], list[int]]:
    """Return the actors of the engine, and the other processes that this one started."""
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            parent = (entry / "stat").read_text().rpartition(")")[2].split()[1]
            children.setdefault(int(parent), []).append(int(entry.name))
    actors: list[int] = []
    others: list[int] = []
    found = list(children.get(os.getpid(), []))
    for pid in found:  # grows while it is read
        found += children.get(pid, [])
        with suppress(OSError):
            name = Path(f"/proc/{pid}/cmdline").read_bytes()  # empty once the process has ended
            if name:
                (actors if name.startswith(b"ray::Worker") else others).append(pid)
    return actors, others


def _cpu_s(pids: list[int]) -> float:
    """Return the CPU seconds of processes, including their threads."""
    ticks = 0
    for pid in pids:
        with suppress(OSError):  # it has ended
            user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
            ticks += int(user) + int(system)
    return ticks / os.sysconf("SC_CLK_TCK")


BENCH = Bench(
    "hma convert on many short episodes: time apart from the tokenizer's, memory of the workers over time",
    {
        "episodes": 10_000,
        "frames": 8,  # an episode
        "pixels": 128,  # height and width of the recorded pictures, JPEG
        "tokenizer": "fsq-8",
        "wait_ms": 0.0,  # a frame, instead of the tokenizer: as if it ran on a GPU
        "workers": 1,
        "engine": "local",  # or ray, on a cluster of so many nodes of one CPU on this machine
        "nodes": 1,
        "worker_cpus": 1.0,  # that an actor of Ray reserves
        "shard_frames": 4_096,
    },
    run,
)
