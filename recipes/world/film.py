"""Film a robot that is driven in `hma play`: the world model and the truth under the same actions.

    python recipes/world/film.py arm2_07 --scenes 1 --out film.webp
    python recipes/world/film.py fetch --shards OUT/shards --scenes 2 5 10 --out film.webp  # README

The truth is the robot's simulator, driven by its own driver, or held-out recordings of --shards. Each scene
begins with the last frame of the prompt.
"""

import argparse
from pathlib import Path

import numpy as np

from hma_data.console import run_script
from hma_data.episodes.sheets import webp_bytes
from hma_data.errors import UsageError
from hma_data.shards.reader import ShardSet
from hma_data.storage.files import write_atomic
from hma_model.checkpoint.folder import EMBEDDED_NAME, Checkpoint
from hma_model.play.save import panels
from hma_model.play.session import Session
from hma_model.worlds.scenes import drivable
from hma_model.worlds.world import load_world

SIDE = 256  # pixels of a panel


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("robot")
    parser.add_argument("--checkpoint", default=EMBEDDED_NAME)
    parser.add_argument("--shards", type=Path, help="recordings to replay; default: the robot's simulator")
    parser.add_argument("--scenes", type=int, nargs="+", default=[0])
    parser.add_argument("--seconds", type=float, default=6.0, help="at most, in each scene")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    world = load_world(given.checkpoint, [given.robot])
    checkpoint = Checkpoint.open(given.checkpoint, [given.robot])
    sets = [ShardSet(given.shards)] if given.shards else []
    robot = next(iter(drivable(checkpoint, sets, lambda: world.tokenizer).values()))
    if robot.source == "images":
        raise UsageError(given.robot, "has no simulator", "give its recordings, --shards")
    hz, label = robot.embodiment.effective_hz, "recording" if given.shards else "simulator"
    frames, scores = [], []
    for scene in given.scenes:
        session = Session(given.robot, robot, scene, robot.scene(scene), world, world.decoding)
        session.replays = True
        for _ in range(round(given.seconds * hz)):
            chunk = session.next_chunk()
            if chunk is None:
                break
            session.take(world.step({session.row: chunk})[session.row], 0.0, 0.0)
        frames += list(panels(session.film(), SIDE, label))
        scores += [frame.psnr for frame in session.frames if frame.psnr is not None]
    write_atomic(given.out, webp_bytes(np.stack(frames), hz))
    print(f"{given.out}: {len(frames)} frames at {hz:g} Hz, mean PSNR {np.mean(scores):.1f} dB")


if __name__ == "__main__":
    run_script(main)
