"""Measure how fast each format becomes 256×256 pictures, by the steps of `hma convert` without the tokenizer.

Every process opens the source for itself and takes its share of the episodes: read, align, decode, resize.
Timing starts when every process has read one frame, so imports do not count.
"""

import os
import shutil
import tempfile
import time
from multiprocessing import get_context
from multiprocessing.queues import Queue
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.bench import machine, peak_rss_mib
from hma_data.bench.recordings import CASES
from hma_data.errors import UsageError

ABOUT = "recordings of every format to 256×256 RGB, with one process and with all cores"
DEFAULTS: dict[str, Any] = {"formats": ["all"], "frames": 600, "episodes": 6, "seed": 0}
SIZE, BATCH = 256, 32  # pixels of a side; frames requested at once
DEADLINE_S = 1800


def run(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one result for each format and number of processes.

    Raises:
        UsageError: there is no such format.
    """
    wanted = list(CASES) if settings["formats"] == ["all"] else settings["formats"]
    unknown = [name for name in wanted if name not in CASES]
    if unknown:
        raise UsageError("bench sources", f"there is no format {unknown[0]!r}", f"known: {', '.join(CASES)}")
    episodes = max(1, min(settings["episodes"], settings["frames"]))
    length = max(2, settings["frames"] // episodes)
    results: list[dict[str, Any]] = []
    os.environ.setdefault("SVT_LOG", "1")  # otherwise the AV1 encoder prints its settings
    for name in wanted:
        folder = Path(tempfile.mkdtemp(prefix="hma-bench-"))
        try:
            uri = CASES[name].write(folder, episodes, length, settings["seed"])
            size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
            for processes in dict.fromkeys((1, min(int(machine()["cores"]), episodes))):
                figures = measure(name, str(uri), processes)
                about = {"format": name, "processes": processes, "stride": CASES[name].stride}
                bytes_a_frame = round(size / (episodes * length))
                results.append({**about, **figures, "recorded_bytes_per_frame": bytes_a_frame})
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    return results


def measure(name: str, uri: str, processes: int) -> dict[str, Any]:
    """Return frames per second of wall time and of CPU time, and the most memory that one process held.

    Raises:
        UsageError: a process died or never answered.
    """
    context = get_context("spawn")
    start, answers = context.Barrier(processes), context.Queue()
    jobs = [
        context.Process(target=_work, args=(name, uri, i, processes, start, answers), daemon=True)
        for i in range(processes)
    ]
    for job in jobs:
        job.start()
    found: list[dict[str, float]] = []
    deadline = time.monotonic() + DEADLINE_S
    while len(found) < processes:
        if answers.empty() and (time.monotonic() > deadline or any(job.exitcode for job in jobs)):
            raise UsageError(f"bench sources {name}", "a process ended without an answer", "see above")
        if answers.empty():
            time.sleep(0.02)
            continue
        found.append(answers.get())
    for job in jobs:
        job.join()
    frames = sum(one["frames"] for one in found)
    wall = max(one["stop"] for one in found) - min(one["start"] for one in found)
    return {
        "frames": frames,
        "frames_per_second": round(frames / wall, 1),
        "frames_per_cpu_second": round(frames / sum(one["cpu"] for one in found), 1),
        "peak_rss_mib": max(one["peak_rss_mib"] for one in found),
    }


def _work(
    name: str, uri: str, share: int, shares: int, start: Barrier, answers: "Queue[dict[str, float]]"
) -> None:
    """Read every `shares`th episode from the `share`th on, and put the figures into `answers`."""
    import cv2

    from hma_data.sources.base import open_source

    cv2.setNumThreads(1)
    robot = CASES[name].embodiment()
    source = open_source(robot.source.format)
    names = [ref.id for ref in source.index(uri, robot)]
    _episode(source, uri, names[share % len(names)], robot, limit=1)
    start.wait(DEADLINE_S)
    began, cpu = time.monotonic(), time.process_time()
    frames = sum(_episode(source, uri, one, robot) for one in names[share::shares])
    stop, used = time.monotonic(), time.process_time() - cpu
    answers.put({"frames": frames, "start": began, "stop": stop, "cpu": used, "peak_rss_mib": peak_rss_mib()})


def _episode(source: Any, uri: str, name: str, robot: Any, limit: int | None = None) -> int:
    """Bring one episode to pictures of the tokenizer's size; return the number of frames."""
    from hma_data.episodes.align import to_clip
    from hma_data.episodes.images import prepared

    clip = to_clip(source.read(uri, name, robot), robot)
    grid = np.arange(0, len(clip), robot.stride)[:limit]
    camera = robot.primary_camera
    for at in range(0, len(grid), BATCH):
        indices = clip.frame_indices[camera.name][grid[at : at + BATCH]]
        prepared(clip.episode.streams[camera.name], indices, camera, SIZE)
    return len(grid)
