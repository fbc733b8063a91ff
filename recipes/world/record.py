"""Record and convert the robots on which the small world model is pre-trained: the made-up family's trunk.

    python recipes/world/record.py OUT [--episodes 150] [--tokenizer fsq-8] [--workers 2]

Each robot is recorded, converted to OUT/shards/<id> and described by OUT/embodiments/<id>.yaml; then its
recording is deleted. The same command continues where it was: robots whose shards are complete are skipped.
Two robots of the family are for the demo and never among these: `hma_data.lab.family.HELD_OUT`.
"""

import argparse
import shutil
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

import torch

from hma_data import lab
from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.cpu import usable_cores
from hma_data.errors import HMAError
from hma_data.lab import family
from hma_data.registry.embodiment import find
from hma_data.shards.manifest import MANIFEST
from hma_data.tokenizers.base import Tokenizer

OTHERS = ("pendulum", "planar_arm", "pusht_fast", "pusht_slow")
Frames = Literal["all", "strided"]


def make(robot: str, out: Path, episodes: int, seed: int, tokenizer: str | Tokenizer, frames: Frames) -> str:
    """Record and convert one robot; return a line that tells what was made."""
    begun = time.monotonic()
    embodiment = find(robot) if robot in lab.RECORDERS else family.embodiment(robot)
    (out / "embodiments" / f"{robot}.yaml").write_text(embodiment.to_yaml())
    folder = out / "recordings"
    recording = next(iter(sorted(folder.glob(f"{robot}*"))), None)
    recording = recording or lab.record(robot, folder, episodes, seed)
    recorded = time.monotonic() - begun
    shards = out / "shards" / robot
    summary = convert(
        embodiment, recording, tokenizer, shards, settings=Settings(val_fraction=0.05, frames=frames)
    )
    if recording.is_dir():
        shutil.rmtree(recording)
    else:
        recording.unlink()
    splits = summary.manifest.splits
    counts = ", ".join(f"{name} {split['episodes']}" for name, split in splits.items())
    whole = f"{counts} episodes, {sum(split['frames'] for split in splits.values()):,} frames"
    refused = f", {summary.manifest.quarantined} in quarantine" if summary.manifest.quarantined else ""
    converted = time.monotonic() - begun - recorded
    return f"{whole}{refused}; {recorded:.0f} s recording, {converted:.0f} s converting"


def main() -> None:
    """Make the shards of all robots asked for, and report each."""
    parser = argparse.ArgumentParser(description="Record and convert the robots of the small world model")
    parser.add_argument("out", type=Path)
    parser.add_argument("--episodes", type=int, default=150, help="of each robot")
    parser.add_argument("--robots", nargs="+", default=[*family.TRUNK, *OTHERS], help="the trunk by default")
    parser.add_argument("--workers", type=int, default=2, help="robots at the same time")
    parser.add_argument("--tokenizer", default="fsq-8")
    parser.add_argument("--frames", choices=("all", "strided"), default="all", help="rows, as hma convert's")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    out, robots = arguments.out, arguments.robots
    (out / "embodiments").mkdir(parents=True, exist_ok=True)
    todo = [robot for robot in robots if not (out / "shards" / robot / MANIFEST).is_file()]
    print(f"{len(robots)} robots, {len(robots) - len(todo)} of them done already", flush=True)
    threads = max(1, usable_cores() // arguments.workers)
    options = (out, arguments.episodes, arguments.seed, arguments.tokenizer, arguments.frames)
    failed = 0
    with ProcessPoolExecutor(
        arguments.workers, get_context("spawn"), torch.set_num_threads, (threads,)
    ) as pool:
        jobs = {pool.submit(make, robot, *options): robot for robot in todo}
        for done, job in enumerate(as_completed(jobs), start=1):
            try:
                line = job.result()
            except HMAError as fault:
                line, failed = f"failed: {fault}", failed + 1
            print(f"{done}/{len(todo)} {jobs[job]}: {line}", flush=True)
    if failed:
        raise SystemExit(f"{failed} robots failed; the same command tries them again")


if __name__ == "__main__":
    main()
