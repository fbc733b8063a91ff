"""Measure the cost of `hma convert` beside its tokenizer, and whether its workers' memory stays constant."""

import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

ABOUT = "hma convert over many short episodes: overhead beside the tokenizer, memory of its workers over time"
DEFAULTS: dict[str, Any] = {
    "episodes": 10_000,
    "frames": 8,  # an episode
    "pixels": 128,  # height and width of the recorded pictures, JPEG
    "tokenizer": "fsq-8",
    "workers": 1,
    "engine": "local",
    "shard_frames": 4_096,
}

_ROBOT = """
id: bench_arm
kind: simulation
frequency_hz: 10
action: {{space: joint_delta, components: [{{key: actions, dims: 7}}]}}
cameras: [{{name: top, key: obs/image}}]
source: {{format: hdf5, uri: {uri}}}
"""


def run(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Time the tokenizer alone on as many frames, then run the conversion and measure its processes."""
    from hma_data.conversion.engines.base import Limits
    from hma_data.conversion.job import convert
    from hma_data.conversion.plan import Settings
    from hma_data.registry.embodiment import Embodiment

    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "recording.hdf5"
        _record(recording, settings)
        rows = settings["episodes"] * settings["frames"]
        alone, alone_cpu = _tokenizer_alone(settings, rows)
        watch = _Watch(settings["workers"], settings["engine"])
        with watch:
            began = time.perf_counter()
            summary = convert(
                Embodiment.from_yaml(_ROBOT.format(uri=recording)),
                None,
                settings["tokenizer"],
                Path(folder) / "out",
                settings=Settings(shard_frames=settings["shard_frames"]),
                workers=settings["workers"],
                engine=settings["engine"],
                limits=Limits(quiet_s=None),
                on_progress=watch.mark,
            )
            seconds = time.perf_counter() - began
        after = 1 - watch.starting.frames / rows  # share of frames made after the first report
        working_s = (seconds - watch.starting.seconds) * max(settings["workers"], 1)
        working_cpu_s = watch.worker_cpu_s - watch.starting.worker_cpu_s
        return [
            {
                "engine": settings["engine"],
                "workers": settings["workers"],
                "tokenizer": settings["tokenizer"],
                "seconds": round(seconds, 2),
                "start_seconds": round(watch.starting.seconds, 2),
                "frames_per_second": round(rows * after / (seconds - watch.starting.seconds), 1),
                "tokenizer_seconds": round(alone, 2),
                "overhead_share": round(1 - alone * after / working_s, 4),
                "tokenizer_cpu_seconds": round(alone_cpu * after, 2),
                "worker_cpu_seconds": round(working_cpu_s, 2),
                "overhead_cpu_share": round(1 - alone_cpu * after / working_cpu_s, 4)
                if working_cpu_s
                else None,
                "parent_cpu_seconds": round(watch.parent_cpu_s - watch.starting.parent_cpu_s, 2),
                "other_cpu_seconds": round(watch.other_cpu_s - watch.starting.other_cpu_s, 2),
                **watch.memory(),
                "episodes": sum(split["episodes"] for split in summary.manifest.splits.values()),
                "bytes_per_frame": round(summary.manifest.to_json()["totals"]["bytes"] / rows, 1),
            }
        ]


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


def _tokenizer_alone(settings: dict[str, Any], rows: int) -> tuple[float, float]:
    """Return seconds and CPU seconds for `rows` frames in a worker's batches, measured on a part of them."""
    import sys

    from hma_data.conversion.worker import BATCH
    from hma_data.cpu import usable_cores
    from hma_data.tokenizers.base import get_tokenizer

    tokenizer = get_tokenizer(settings["tokenizer"])
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(max(1, usable_cores() // max(settings["workers"], 1)))
    size = tokenizer.spec.image_size
    frames = np.random.default_rng(1).integers(0, 256, (BATCH, size, size, 3), np.uint8)
    tokenizer.encode(frames)
    done, began, used = 0, time.perf_counter(), time.process_time()
    while done < min(rows, 4_096):
        tokenizer.encode(frames)
        done += BATCH
    return (time.perf_counter() - began) * rows / done, (time.process_time() - used) * rows / done


@dataclass(frozen=True)
class _Starting:
    """The figures at the first report of finished frames."""

    seconds: float = 0.0
    frames: int = 0
    worker_cpu_s: float = 0.0
    parent_cpu_s: float = 0.0
    other_cpu_s: float = 0.0


@dataclass
class _Watch:
    """Memory and CPU time of this process and of those it started, sampled while the conversion runs."""

    workers: int
    engine: str
    share: float = 0.0  # of the frames that are done
    starting: _Starting = field(default_factory=_Starting)
    worker_cpu_s: float = 0.0  # last sample; Ray's actors count as workers
    parent_cpu_s: float = 0.0  # without the CPU time of the sampling itself
    other_cpu_s: float = 0.0  # Ray's own processes
    samples: list[tuple[float, dict[str, float]]] = field(default_factory=list)  # share, MiB by role
    _stop: threading.Event = field(default_factory=threading.Event)

    def mark(self, progress: Any) -> None:
        """Record the progress of the conversion."""
        if progress.frames and not self.starting.frames:
            self.starting = _Starting(
                time.perf_counter() - self._began,
                progress.frames,
                self.worker_cpu_s,
                self.parent_cpu_s,
                self.other_cpu_s,
            )
        self.share = progress.frames / max(progress.total_frames, 1)

    def __enter__(self) -> "_Watch":
        self._began = time.perf_counter()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def memory(self) -> dict[str, float | None]:
        """Return the resident MiB of the largest worker, the largest of Ray's actors, and this process."""
        points = {"a_tenth": 0.1, "half": 0.5, "the_end": 1.0}
        return {
            f"{role}_rss_mib_at_{name}": self._at(role, share)
            for role in ("worker", "actor", "parent")
            for name, share in points.items()
            if any(role in found for _, found in self.samples)
        }

    def _at(self, role: str, share: float) -> float:
        having = [sample for sample in self.samples if role in sample[1]]
        return round(min(having, key=lambda sample: abs(sample[0] - share))[1][role], 1)

    def _look(self) -> None:
        import os

        pid = os.getpid()
        while not self._stop.wait(0.2):
            roles = _roles(pid, self.engine)
            if not roles["worker"] and self.workers == 0:
                roles["worker"] = [pid]
            if not roles["worker"] and self.samples and "worker" in self.samples[-1][1]:
                continue  # the workers have ended; the manifest is being written
            self.worker_cpu_s = max(self.worker_cpu_s, _cpu_s(roles["worker"] + roles["actor"]))
            self.other_cpu_s = max(self.other_cpu_s, _cpu_s(roles["other"]))
            self.parent_cpu_s = time.process_time() - time.thread_time()
            roles["parent"] = [pid]
            memory = {role: max(map(_rss_mib, pids)) for role, pids in roles.items() if pids}
            self.samples.append((self.share, memory))


def _roles(pid: int, engine: str) -> dict[str, list[int]]:
    """Group processes by role: workers, the actors that watch over them, and others that `pid` started."""
    parents: dict[int, int] = {}
    commands: dict[int, bytes] = {}
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            commands[int(entry.name)] = (entry / "cmdline").read_bytes()
        except OSError:
            continue
    ours = _descendants(pid, parents)
    actors = {other for other, command in commands.items() if command.startswith(b"ray::Worker")}
    if engine != "ray" or actors & ours:  # actors of a running cluster are not descendants
        actors &= ours
    workers = {
        other
        for other, command in commands.items()
        if b"spawn_main" in command and parents[other] in {pid, *actors}
    }
    return {"worker": [*workers], "actor": [*actors], "other": [*(ours - workers - actors)]}


def _descendants(pid: int, parents: dict[int, int]) -> set[int]:
    found: set[int] = set()
    newest = {pid}
    while newest:
        newest = {child for child, parent in parents.items() if parent in newest} - found
        found |= newest
    return found


def _cpu_s(pids: list[int]) -> float:
    """Return the CPU seconds of processes, including their threads."""
    import os

    ticks = 0
    for pid in pids:
        try:
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def _rss_mib(pid: int) -> float:
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except OSError:
        return 0.0
    return pages * 4096 / 2**20
