"""Record and convert the robots on which the small world model is pre-trained: the made-up family's trunk.

    python recipes/world/record.py OUT [--episodes 80] [--further 28] [--tokenizer fsq-lab] [--workers 2]

Each robot is recorded, converted to OUT/shards/<id> and described by OUT/embodiments/<id>.yaml; then its
recording is deleted. With --further, that many more robots of the family are recorded; they widen the
trunk's experience and are not published. The same command continues where it was: robots whose shards are
complete are skipped. Two robots of the family are for the demo and never among these:
`hma_data.lab.family.HELD_OUT`.
"""

import argparse
import shutil
import time
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from hma_data import lab
from hma_data.console import run_script
from hma_data.conversion.engines import Attempt, Report, Work
from hma_data.conversion.engines.local import run
from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.cpu import usable_cores
from hma_data.lab import family
from hma_data.lab.family.bodies import Body
from hma_data.lab.family.driver import PUSHING
from hma_data.registry.embodiment import find
from hma_data.shards.manifest import MANIFEST
from hma_data.storage.files import atomic_path
from hma_data.tokenizers.base import Tokenizer

OTHERS = ("pendulum", "planar_arm", "pusht_fast", "pusht_slow")


def make_work(
    out: Path,
    episodes: int,
    seed: int,
    tokenizer: str | Tokenizer,
    settings: Settings,
    device: str,
    pushing: bool,
    workers: int,
) -> Work:
    """Return the function that records and converts a robot, and returns a line that tells what was made."""
    import torch

    torch.set_num_threads(max(1, usable_cores() // workers))

    def work(robot: str, report: Report, attempt: Attempt) -> str:
        begun = time.monotonic()
        embodiment = find(robot) if robot in lab.RECORDERS else family.embodiment(robot)
        (out / "embodiments").mkdir(parents=True, exist_ok=True)
        (out / "embodiments" / f"{robot}.yaml").write_text(embodiment.to_yaml())
        folder = out / "recordings"
        recording = next(iter(sorted(folder.glob(f"{robot}*"))), None)
        if recording is None:
            if pushing and robot not in lab.RECORDERS:
                recording = record_pushes(robot, folder, counted(episodes, report), seed)
            else:
                recording = lab.record(robot, folder, episodes, seed, lambda done, total: report(done))
        recorded = time.monotonic()
        summary = convert(
            embodiment, recording, tokenizer, out / "shards" / robot, settings=settings, device=device,
            on_progress=lambda state: report(state.episodes),
        )  # fmt: skip
        shutil.rmtree(recording) if recording.is_dir() else recording.unlink()
        splits, refused = summary.manifest.splits, summary.manifest.quarantined
        counts = ", ".join(f"{name} {split['episodes']}" for name, split in splits.items())
        frames = sum(split["frames"] for split in splits.values())
        took = f"{recorded - begun:.0f} s recording, {time.monotonic() - recorded:.0f} s converting"
        return f"{robot}: {counts} episodes, {frames:,} frames, {refused} in quarantine; {took}"

    return work


def counted(episodes: int, report: Report) -> Iterator[int]:
    """Yield the numbers of the episodes, and report each that is done."""
    for number in range(episodes):
        yield number
        report(number + 1)


def record_pushes(robot: str, folder: Path, episodes: Iterable[int], seed: int) -> Path:
    """Record a robot of the family that goes to its blocks twice as often, and holds keys down."""
    body, recording = Body.of(robot), folder / f"{robot}.hdf5"
    with atomic_path(recording) as part:
        demos = (family.episode(body, seed, number, chances=PUSHING) for number in episodes)
        family.write_file(part, body, demos)
    return recording


def main() -> None:
    """Make the shards of all robots asked for, and report each."""
    parser = argparse.ArgumentParser(description="Record and convert the robots of the small world model")
    parser.add_argument("out", type=Path)
    parser.add_argument("--episodes", type=int, default=80, help="of each robot")
    parser.add_argument("--robots", nargs="+", default=[*family.TRUNK, *OTHERS], help="the trunk by default")
    parser.add_argument("--further", type=int, default=0, help="more robots of the family")
    parser.add_argument("--workers", type=int, default=2, help="robots at the same time")
    parser.add_argument("--tokenizer", default="fsq-lab")
    parser.add_argument("--device", default="cpu", help="of the tokenizer, as hma convert's")
    parser.add_argument("--frames", choices=("all", "strided"), default="strided", help="as hma convert's")
    parser.add_argument("--pushing", action="store_true", help="go to blocks twice as often, and hold keys")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    robots = [*given.robots, *family.further(given.further)]
    todo = [robot for robot in robots if not (given.out / "shards" / robot / MANIFEST).is_file()]
    print(f"{len(robots)} robots, {len(robots) - len(todo)} of them done already", flush=True)
    settings = Settings(val_fraction=0.05, frames=given.frames)
    work = partial(
        make_work,
        given.out,
        given.episodes,
        given.seed,
        given.tokenizer,
        settings,
        given.device,
        given.pushing,
    )
    for done, line in enumerate(run(todo, work, given.workers, _ignore), start=1):
        print(f"{done}/{len(todo)} {line}", flush=True)


def _ignore(number: int, event: Any) -> None:
    """Take the reports of a robot's work, which only show that it lives."""


if __name__ == "__main__":
    run_script(main)
