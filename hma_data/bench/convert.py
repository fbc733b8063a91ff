"""What `hma convert` costs beside its tokenizer, and whether its workers' memory stays flat."""

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
    """The tokenizer alone over as many frames, then the conversion, watched from outside."""
    from hma_data.convert import convert
    from hma_data.embodiment import Embodiment
    from hma_data.engines.base import Limits
    from hma_data.plan import Settings

    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "recording.hdf5"
        _record(recording, settings)
        rows = settings["episodes"] * settings["frames"]
        alone, alone_cpu = _tokenizer_alone(settings, rows)
        watch = _Watch()
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
        starting = watch.first_frame_s - began if watch.first_frame_s else 0.0
        working = (seconds - starting) * max(settings["workers"], 1)
        working_cpu = watch.cpu_s - watch.starting_cpu_s
        return [
            {
                "engine": settings["engine"],
                "workers": settings["workers"],
                "tokenizer": settings["tokenizer"],
                "seconds": round(seconds, 2),
                "start_seconds": round(starting, 2),
                "frames_per_second": round(rows / (seconds - starting), 1),
                "tokenizer_seconds": round(alone, 2),
                "overhead_share": round(1 - alone / working, 4),
                "tokenizer_cpu_seconds": round(alone_cpu, 2),
                "worker_cpu_seconds": round(working_cpu, 2),
                "overhead_cpu_share": round(1 - alone_cpu / working_cpu, 4) if working_cpu else None,
                "worker_rss_mib_at_a_tenth": watch.at(0.1),
                "worker_rss_mib_at_half": watch.at(0.5),
                "worker_rss_mib_at_the_end": watch.at(1.0),
                "parent_rss_mib_at_a_tenth": watch.at(0.1, parent=True),
                "parent_rss_mib_at_the_end": watch.at(1.0, parent=True),
                "episodes": sum(split["episodes"] for split in summary.manifest.splits.values()),
                "bytes_per_frame": round(summary.manifest.to_json()["totals"]["bytes"] / rows, 1),
            }
        ]


def _record(path: Path, settings: dict[str, Any]) -> None:
    """Episodes of JPEG pictures: a texture that moves, so that they compress as pictures do."""
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
    """Seconds and CPU seconds for `rows` frames in a worker's batches, measured on a part of them."""
    import sys

    from hma_data.engines.local import usable_cores
    from hma_data.shard_work import BATCH
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


@dataclass
class _Watch:
    """Resident memory of this process and of its children, while the conversion goes on."""

    share: float = 0.0
    first_frame_s: float = 0.0
    starting_cpu_s: float = 0.0  # of the workers until their first frame
    cpu_s: float = 0.0  # of the workers, as last seen
    samples: list[tuple[float, float, float]] = field(default_factory=list)  # share done, workers, parent
    _stop: threading.Event = field(default_factory=threading.Event)

    def mark(self, progress: Any) -> None:
        """Where the conversion stands."""
        if progress.frames and not self.first_frame_s:
            self.first_frame_s, self.starting_cpu_s = time.perf_counter(), self.cpu_s
        self.share = progress.frames / max(progress.total_frames, 1)

    def __enter__(self) -> "_Watch":
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def at(self, share: float, parent: bool = False) -> float | None:
        """MiB at that share of the work; the largest of the workers."""
        if not self.samples:
            return None
        nearest = min(self.samples, key=lambda sample: abs(sample[0] - share))
        return round(nearest[2 if parent else 1], 1)

    def _look(self) -> None:
        import os

        while not self._stop.wait(0.2):
            mine = _rss_mib(os.getpid())
            found = _workers(os.getpid())
            if found:
                self.cpu_s = max(self.cpu_s, sum(map(_cpu_s, found)))
            elif self.samples:
                continue  # the workers are gone, the manifest is being written
            self.samples.append((self.share, max(map(_rss_mib, found), default=mine), mine))


def _workers(pid: int) -> list[int]:
    """Worker processes on this machine: our children, and Ray's actors."""
    found: list[int] = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            command = (entry / "cmdline").read_bytes()
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
        ours = parent == pid and b"spawn_main" in command
        if ours or command.startswith((b"ray::Worker", b"ray::_Worker")):
            found.append(int(entry.name))
    return found


def _cpu_s(pid: int) -> float:
    """CPU seconds of a process, its threads included."""
    import os

    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _rss_mib(pid: int) -> float:
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except OSError:
        return 0.0
    return pages * 4096 / 2**20
