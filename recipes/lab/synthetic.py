"""Train policies on few real episodes with and without synthetic ones, and score them in the true simulator.

    python recipes/lab/synthetic.py build/synthetic --seeds 3
    python recipes/lab/synthetic.py --table build/synthetic

Table 6 of the paper: 10 real episodes with 0, 10, 50 and 90 synthetic ones, beside 100 real ones. A row is a
policy of ours (objective `policy`), trained from scratch for the same CPU seconds on its episodes. The world
model that makes the synthetic ones has seen the 10 real episodes of the robot alone: it is fine-tuned on them
from `--world`, whose trunk must not have seen the robot. By default that is `embedded`, and the robot one
that it lacks. Every result is a line of OUT/results.csv; those that are there are not computed again.
"""

import argparse
import csv
import statistics
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hma_data import lab
from hma_data.console import run_script
from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.conversion.rewrite import merge
from hma_data.lab import family, truth
from hma_data.registry.embodiment import Embodiment, find
from hma_data.shards.manifest import MANIFEST
from hma_model.policies.acting import Acting
from hma_model.policies.arenas import Scenes, TrueArena
from hma_model.policies.base import Policy
from hma_model.policies.catalog import read_policy
from hma_model.policies.judge import task_of
from hma_model.policies.scores import run
from hma_model.synthetic.augment import Augmentation, augment
from hma_model.synthetic.recorder import described_as
from hma_model.training.loop import finetune, train
from hma_model.training.recipe import load_recipe
from hma_model.worlds.world import World, load_world

FEW, MANY, SYNTHETIC = 10, 100, (0, 10, 50, 90)
COLUMNS = ("seed", "row", "episodes", "success", "policy_cpu_s", "world_cpu_s")


def shards(out: Path, robot: str, episodes: int, seed: int) -> Path:
    """Record and convert real episodes, without the state that synthetic ones lack."""
    made = out / f"real{episodes}-{seed}"
    if not (made / MANIFEST).is_file():
        own: Embodiment = find(robot) if robot in lab.RECORDERS else family.embodiment(robot)
        recording = lab.record(robot, out / f"recording{episodes}-{seed}", episodes, seed)
        settings = Settings(val_fraction=0.1, frames="strided")
        convert(described_as(own, f"recorded of {robot}"), recording, "fsq-lab", made, settings=settings)
    return made


def imagined(given: argparse.Namespace, real: Path, seed: int, count: int) -> Path:
    """Return shards of synthetic episodes that begin with the real ones."""
    world, made = given.out / f"world-{seed}", given.out / f"synthetic{count}-{seed}"
    if not (world / "checkpoints").is_dir():
        words = [f"cpu_seconds={given.world_cpu_seconds}", "steps=1000000", "report=false", f"seed={seed}"]
        finetune(given.world, [real], out=world, overrides=words)
    settings = Augmentation(
        given.robot, real.name, 2 * count, given.frames, f"perturb={given.perturb}", 0.5, seed=seed
    )
    augment(made, settings, checkpoint=world, shards=real)
    return made


def trained(given: argparse.Namespace, data: Path, row: str, seed: int) -> World:
    """Return a world of the policy trained on shards."""
    out = given.out / f"policy-{row.replace(' ', '')}-{seed}"
    words = [
        "objectives={policy: 1.0}", f"cpu_seconds={given.policy_cpu_seconds}", "steps=1000000",
        "eval_every=0", "checkpoint_every=0", "report=false", "pictures=0", "batch_size=8",
        f"seed={seed}", f"data=[{data}]", "short=pad",
    ]  # fmt: skip
    if not (out / "checkpoints").is_dir():
        train(load_recipe("discrete_tiny", [*words, f"out={out}"]))
    return load_world(out)


def success(name: str, policy: Policy, scenes: Scenes, frames: int, task: str) -> float:
    """Return the share of true episodes that succeed."""
    arena = TrueArena(scenes, 128)
    driven, _ = truth.parts_of(arena.scenes.begin()[0].simulator.simulation)
    run(name, policy, arena, frames)
    wanted = task_of(scenes.name, task)
    return float((wanted.score(np.stack(arena.parts, axis=1), driven) >= wanted.limit).mean())


def rows(given: argparse.Namespace, seed: int) -> Iterator[tuple[str, Path]]:
    """Yield the name and the shards of each row."""
    few = shards(given.out, given.robot, FEW, seed)
    for count in SYNTHETIC:
        data = few
        if count:
            data = given.out / f"mixed{count}-{seed}"
            if not (data / MANIFEST).is_file():
                merge([few, imagined(given, few, seed, count)], data)
        yield f"{FEW} real + {count} synthetic", data
    yield f"{MANY} real", shards(given.out, given.robot, MANY, seed)


def main() -> None:
    """Compute the rows that are not there, and print the table."""
    parser = argparse.ArgumentParser(description="Policies on real and synthetic episodes")
    parser.add_argument("out", type=Path)
    parser.add_argument("--table", action="store_true", help="only print what is there")
    parser.add_argument("--robot", default=family.HELD_OUT[0])
    parser.add_argument("--world", default="embedded", help="checkpoint that is fine-tuned")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--episodes", type=int, default=32, help="of the true simulator")
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--task", default="moved")
    parser.add_argument("--perturb", type=float, default=0.3, help="noise of the synthetic commands")
    parser.add_argument("--policy-cpu-seconds", type=float, default=300)
    parser.add_argument("--world-cpu-seconds", type=float, default=120)
    given = parser.parse_args()
    path = given.out / "results.csv"
    given.out.mkdir(parents=True, exist_ok=True)
    known = list(csv.DictReader(path.open())) if path.is_file() else []
    done = {(int(row["seed"]), row["row"]) for row in known}
    for seed in range(0 if given.table else given.seeds):
        for name, data in rows(given, seed):
            if (seed, name) in done:
                continue
            world = trained(given, data, name, seed)
            scenes = Scenes.of(world, given.robot, given.episodes, 7)
            share = success(name, Acting(world, scenes), scenes, given.frames, given.task)
            known.append(dict(zip(COLUMNS, map(str, (seed, name, given.episodes, share,
                              given.policy_cpu_seconds, given.world_cpu_seconds)))))  # fmt: skip
            with path.open("w", newline="") as file:
                writer = csv.DictWriter(file, COLUMNS)
                writer.writeheader()
                writer.writerows(known)
            if name.startswith(str(MANY)) and seed == 0:
                for other in ("random", "scripted"):
                    found = success(other, read_policy(other, scenes), scenes, given.frames, given.task)
                    print(f"{other}: {found:.0%}")
    table(known)


def table(known: list[dict[str, str]]) -> None:
    """Print the mean over seeds of each row, and its deviation."""
    for name in dict.fromkeys(row["row"] for row in known):
        found = [float(row["success"]) for row in known if row["row"] == name]
        spread = f" ± {statistics.stdev(found):.1%}" if len(found) > 1 else ""
        print(f"{name:>24}  {statistics.mean(found):.1%}{spread} over {len(found)} seeds")


if __name__ == "__main__":
    run_script(main)
