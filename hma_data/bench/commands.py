"""Measure two verbs: `hma convert` beside its tokenizer, and `hma registry` over many embodiments.

`convert` also shows whether the memory of its workers stays constant. `registry` runs commands that read
every YAML, with nothing or everything cached.
"""

import os
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.bench import Bench, make_robot, rss_mib


def measure_convert(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Time the tokenizer alone on as many frames, then run the conversion and measure its processes."""
    from hma_data.conversion.engines import Limits
    from hma_data.conversion.job import convert
    from hma_data.conversion.plan import Settings

    workers, engine = settings["workers"], settings["engine"]
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "recording.hdf5"
        _record(recording, settings)
        rows = settings["episodes"] * settings["frames"]
        alone, alone_cpu = _tokenizer_alone(settings, rows)
        watch = _Watch(workers, engine)
        summary = convert(
            make_robot("bench_arm", "hdf5", "actions", "obs/image"),
            recording,
            settings["tokenizer"],
            Path(folder) / "out",
            settings=Settings(shard_frames=settings["shard_frames"]),
            workers=workers,
            engine=engine,
            limits=Limits(quiet_s=None),
            on_progress=watch.mark,
        )
        watch.stop()
    seconds = watch.seconds - watch.start_seconds
    after = 1 - watch.start_frames / rows  # share of frames made after the first report
    cpu = {role: round(used - watch.start_cpu_s[role], 2) for role, used in watch.cpu_s.items()}
    return [
        {
            "engine": engine,
            "workers": workers,
            "tokenizer": settings["tokenizer"],
            "seconds": round(watch.seconds, 2),
            "start_seconds": round(watch.start_seconds, 2),
            "frames_per_second": round(rows * after / seconds, 1),
            "tokenizer_seconds": round(alone, 2),
            "overhead_share": round(1 - alone * after / (seconds * max(workers, 1)), 4),
            "tokenizer_cpu_seconds": round(alone_cpu * after, 2),
            "worker_cpu_seconds": cpu["worker"],
            "overhead_cpu_share": round(1 - alone_cpu * after / cpu["worker"], 4) if cpu["worker"] else None,
            "parent_cpu_seconds": cpu["parent"],
            "other_cpu_seconds": cpu["other"],
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


class _Watch:
    """Memory and CPU time of this process and of those it started, sampled while the conversion runs.

    `cpu_s` counts the workers (and Ray's actors), this process without the sampling, and Ray's other
    processes. `start_*` are the figures at the first report of finished frames. `samples` hold the share of
    the frames that are done, and MiB by role.
    """

    def __init__(self, workers: int, engine: str) -> None:
        self.workers, self.engine = workers, engine
        self.cpu_s = {"worker": 0.0, "parent": 0.0, "other": 0.0}
        self.seconds = self.start_seconds = self._share = 0.0
        self.start_frames, self.start_cpu_s = 0, dict(self.cpu_s)
        self.samples: list[tuple[float, dict[str, float]]] = []
        self._began, self._stop = time.perf_counter(), threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def mark(self, progress: Any) -> None:
        """Record the progress of the conversion."""
        if progress.frames and not self.start_frames:
            self.start_seconds = time.perf_counter() - self._began
            self.start_frames, self.start_cpu_s = progress.frames, dict(self.cpu_s)
        self._share = progress.frames / max(progress.total_frames, 1)

    def stop(self) -> None:
        """End the sampling."""
        self.seconds = time.perf_counter() - self._began
        self._stop.set()
        self._thread.join()

    def memory(self) -> dict[str, float]:
        """Return the resident MiB of the largest worker, the largest of Ray's actors, and this process."""
        figures = {}
        for role in ("worker", "actor", "parent"):
            having = [(share, found[role]) for share, found in self.samples if role in found]
            for name, at in {"a_tenth": 0.1, "half": 0.5, "the_end": 1.0}.items():
                if having:
                    nearest = min(having, key=lambda sample: abs(sample[0] - at))
                    figures[f"{role}_rss_mib_at_{name}"] = round(nearest[1], 1)
        return figures

    def _look(self) -> None:
        pid = os.getpid()
        while not self._stop.wait(0.2):
            roles = _roles(pid, self.engine)
            if not roles["worker"] and self.workers == 0:
                roles["worker"] = [pid]
            if not roles["worker"] and self.samples and "worker" in self.samples[-1][1]:
                continue  # the workers have ended; the manifest is being written
            found = {"worker": _cpu_s(roles["worker"] + roles["actor"]), "other": _cpu_s(roles["other"])}
            found["parent"] = time.process_time() - time.thread_time()
            self.cpu_s = {role: max(used, found[role]) for role, used in self.cpu_s.items()}
            roles["parent"] = [pid]
            memory = {role: max(map(rss_mib, pids)) for role, pids in roles.items() if pids}
            self.samples.append((self._share, memory))


def _roles(pid: int, engine: str) -> dict[str, list[int]]:
    """Group processes by role: workers, the actors that watch over them, and others that `pid` started."""
    parents: dict[int, int] = {}
    commands: dict[int, bytes] = {}
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended
            parents[int(entry.name)] = int(_stat(entry.name)[1])
            commands[int(entry.name)] = (entry / "cmdline").read_bytes()
    ours, newest = set[int](), {pid}
    while newest:
        newest = {child for child, parent in parents.items() if parent in newest} - ours
        ours |= newest
    actors = {other for other, command in commands.items() if command.startswith(b"ray::Worker")}
    if engine != "ray" or actors & ours:  # actors of a running cluster are not descendants
        actors &= ours
    spawned = {other for other, command in commands.items() if b"spawn_main" in command}
    workers = {other for other in spawned if parents[other] in {pid, *actors}}
    return {"worker": [*workers], "actor": [*actors], "other": [*(ours - workers - actors)]}


def _stat(pid: int | str) -> list[str]:
    """Return the fields of a process's state that follow its name; raise OSError if it has ended."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()


def _cpu_s(pids: list[int]) -> float:
    """Return the CPU seconds of processes, including their threads."""
    ticks = 0
    for pid in pids:
        with suppress(OSError):
            user, system = _stat(pid)[11:13]
            ticks += int(user) + int(system)
    return ticks / os.sysconf("SC_CLK_TCK")


CONVERT = Bench(
    "hma convert over many short episodes: overhead beside the tokenizer, memory of its workers over time",
    {
        "episodes": 10_000,
        "frames": 8,  # an episode
        "pixels": 128,  # height and width of the recorded pictures, JPEG
        "tokenizer": "fsq-8",
        "workers": 1,
        "engine": "local",
        "shard_frames": 4_096,
    },
    measure_convert,
)


# -- registry

_YAML = """id: {id}
description: A generated arm for measuring
robot: arm {id}
kind: simulation
frequency_hz: {hz}
action:
  space: eef_delta
  components:
    - {{key: actions, slice: [0, 3], dims: 3, names: [dx, dy, dz], unit: m}}
    - {{key: actions, slice: [3, 6], dims: 3, names: [drx, dry, drz], unit: rad, representation: axis_angle}}
    - {{key: actions, slice: [6, 7], dims: 1, names: [gripper], normalize: false, gripper: open_is_low}}
state: {{components: [{{key: obs/joint_pos, dims: 7, unit: rad}}]}}
cameras:
  - {{name: front, key: obs/front_image, size: [480, 640]}}
  - {{name: wrist, key: obs/wrist_image, size: [480, 640]}}
source: {{format: hdf5, uri: data/{id}.hdf5, episodes: 10}}
provenance: {{frequency_hz: generated, action: generated}}
"""


def measure_registry(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Run each command once cold, then warm, each time in a new process, as a user starts it."""
    with tempfile.TemporaryDirectory() as folder:
        registry = Path(folder) / "registry"
        for i in range(settings["embodiments"]):
            place = registry / f"group_{i // 500}"
            place.mkdir(parents=True, exist_ok=True)
            (place / f"arm_{i}.yaml").write_text(_YAML.format(id=f"arm_{i}", hz=1 + i % 50))
        environment = {**os.environ, "HMA_CACHE": f"{folder}/cache", "HMA_REGISTRY": str(registry)}
        results = []
        for words in (["list", "--json"], ["list"], ["validate"], ["show", "arm_7"]):
            command, seconds = [sys.executable, "-m", "hma_model.cli", "registry", *words], list[float]()
            for _ in range(settings["runs"] + 1):
                start = time.perf_counter()
                subprocess.run(command, cwd=folder, env=environment, check=True, stdout=subprocess.DEVNULL)
                seconds.append(round(time.perf_counter() - start, 3))
            cold = seconds[0] if words == ["list", "--json"] else None
            about = {"command": f"registry {' '.join(words)}", "cold_seconds": cold}
            results.append({**about, "warm_seconds": min(seconds[1:])})
        return results


REGISTRY = Bench(
    "registry list over many generated YAMLs: seconds of the whole command",
    {"embodiments": 10_000, "runs": 3},
    measure_registry,
)
