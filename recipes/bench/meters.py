"""Calibrate the uncertainty of a bundled model's robots, and record the meters in its cards.

    python recipes/bench/meters.py embedded-lab   # all robots, or name some

The measurement is that of `hma benchmark`, which records the meters of other checkpoints itself.
"""

import argparse

from hma_data.console import run_script
from hma_model.benchmark.measures import choose, frame_errors
from hma_model.benchmark.run import NOISE
from hma_model.checkpoint.folder import BUNDLED, Checkpoint
from hma_model.checkpoint.io import record_evaluation
from hma_model.evaluation.calibration import calibration
from hma_model.evaluation.probe import train_probe
from hma_model.policies.arenas import Scenes
from hma_model.policies.scripted import Scripted
from hma_model.worlds.world import load_world

FRAMES = 20


def main() -> None:
    """Calibrate robots one by one; each is recorded as it is finished."""
    parser = argparse.ArgumentParser(description="Calibrate a bundled model's uncertainty")
    parser.add_argument("checkpoint", choices=BUNDLED)
    parser.add_argument("robots", nargs="*")
    parser.add_argument("--scenes", type=int, default=32)
    parser.add_argument("--sequences", type=int, default=2, help="of actions in each scene")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    bundled, world = Checkpoint.open(given.checkpoint), load_world(given.checkpoint)
    for robot in given.robots or bundled.embodiments:
        scenes = Scenes.of(world, robot, given.scenes, given.seed)
        probe = train_probe(robot, world.tokenizer, scenes.stride, given.seed)
        arrays = frame_errors(choose(world, scenes, probe, Scripted(NOISE), FRAMES, given.sequences))
        found = calibration(
            arrays["uncertainty"], arrays["error_px"], arrays["pixel_rmse"],
            unmask_steps=world.decoding.unmask_steps, temperature=world.decoding.temperature, seed=given.seed,
        )  # fmt: skip
        record_evaluation(bundled, robot, found["meter"], "meter")
        print(f"{robot}: {found['meter']['verdict']}", flush=True)


if __name__ == "__main__":
    run_script(main)
