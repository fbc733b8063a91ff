"""Measure how fast a LeRobotDataset v3.0 is read: by our source, and by lerobot's own reader over PyAV.

lerobot writes the dataset. Each reader returns every row with its picture, first in order and then in random
order. The start time is the CPU time of a new process that imports the reader and opens the dataset.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.bench import Bench, make_robot
from hma_data.bench.sources import HZ, TASK, scene
from hma_data.lab.writers import LeRobotEpisode, write_lerobot
from hma_data.registry.embodiment import Embodiment

CAMERA, DIMS, BATCH = "observation.images.main", 7, 32  # BATCH: frames requested at once, in order
OPEN = {
    "hma": "from hma_data.sources.base import open_source; open_source('lerobot').index(sys.argv[1])",
    "lerobot": "from lerobot.datasets.lerobot_dataset import LeRobotDataset; "
    "LeRobotDataset('bench/arm', root=sys.argv[1], video_backend='pyav')[0]",
}


def run(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one result for each reader and order."""
    with tempfile.TemporaryDirectory(prefix="hma-bench-") as folder:
        size = [settings["height"], settings["width"]]
        cameras = [{"name": "main", "key": CAMERA, "size": size}]
        state = {"components": [{"key": "observation.state", "dims": DIMS}]}
        robot = make_robot("bench", "lerobot", "action", CAMERA, HZ, DIMS, cameras=cameras, state=state)
        root = Path(folder) / "set"
        write_lerobot(root, robot, _episodes(settings))
        readers = {"hma": _ours(root, robot), "lerobot": _theirs(root)}
        results = []
        for name, read in readers.items():
            start = round(_start_cpu_s(name, root), 2)
            for order, rows in _orders(settings).items():
                results.append({"reader": name, "order": order, "start_cpu_s": start, **_speed(read, rows)})
        return results


def _episodes(settings: dict[str, Any]) -> Iterator[LeRobotEpisode]:
    length = settings["frames"] // settings["episodes"]
    for number in range(settings["episodes"]):
        seed = settings["seed"] + number
        pictures = np.stack(list(scene(settings["height"], settings["width"], length, seed)))
        values = np.random.default_rng(seed).normal(size=(length, DIMS)).astype(np.float32)
        yield LeRobotEpisode({CAMERA: pictures}, values, values, TASK)


def _orders(settings: dict[str, Any]) -> dict[str, list[list[int]]]:
    """Return the rows to read in each order: all in batches in order, and a quarter one by one, shuffled."""
    total = settings["frames"] // settings["episodes"] * settings["episodes"]
    shuffled = np.random.default_rng(settings["seed"]).permutation(total)[: max(1, total // 4)]
    return {
        "in order": [list(range(at, min(at + BATCH, total))) for at in range(0, total, BATCH)],
        "random": [[int(row)] for row in shuffled],
    }


def _ours(root: Path, robot: Embodiment) -> Callable[[list[int]], int]:
    from hma_data.sources.base import open_source

    source = open_source("lerobot")
    episodes = [source.read(str(root), ref.id, robot) for ref in source.index(str(root), robot)]
    length = len(episodes[0].actions[0].values)

    def read(rows: list[int]) -> int:
        for number in sorted({row // length for row in rows}):
            inside = [row % length for row in rows if row // length == number]
            episode = episodes[number]
            pictures = episode.streams["main"].frames(inside)
            assert len(pictures) == len(episode.actions[0].values[inside])
        return len(rows)

    return read


def _theirs(root: Path) -> Callable[[list[int]], int]:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("bench/arm", root=root, video_backend="pyav", return_uint8=True)
    return lambda rows: len([dataset[row][CAMERA] for row in rows])


def _start_cpu_s(name: str, root: Path) -> float:
    """Return the CPU seconds that a process takes to import a reader and open the dataset."""
    program, before = f"import sys; {OPEN[name]}", os.times()
    subprocess.run([sys.executable, "-c", program, str(root)], check=True, capture_output=True)
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


def _speed(read: Callable[[list[int]], int], batches: Iterable[list[int]]) -> dict[str, Any]:
    read([0])
    began, cpu = time.monotonic(), time.process_time()
    frames = sum(read(rows) for rows in batches)
    wall, used = time.monotonic() - began, time.process_time() - cpu
    return {
        "frames": frames,
        "frames_per_second": round(frames / wall, 1),
        "frames_per_cpu_second": round(frames / used, 1),
    }


BENCH = Bench(
    "a LeRobotDataset read by our source and by lerobot's own reader",
    {"episodes": 4, "frames": 400, "height": 480, "width": 640, "seed": 0},
    run,
)
