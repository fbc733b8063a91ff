"""Film a robot that is driven in `hma play`: the world model and the true simulator under the same actions.

    python recipes/world/film.py arm2_07 --scene 1 --out docs/drive.webp    # the film of the README

The simulator's own driver acts. The film begins with the last frame of the prompt.
"""

import argparse
from pathlib import Path

import numpy as np

from hma_data.episodes.sheets import webp_bytes
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
    parser.add_argument("--scene", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    world = load_world(given.checkpoint, [given.robot])
    checkpoint = Checkpoint.open(given.checkpoint, [given.robot])
    robot = drivable(checkpoint, (), lambda: world.tokenizer)[given.robot]
    session = Session(given.robot, robot, given.scene, world, world.decoding, 0.0)
    session.replays = True
    hz = robot.embodiment.effective_hz
    for _ in range(round(given.seconds * hz)):
        chunk = session.next_chunk()
        if chunk is None:
            break
        session.take(world.step({session.row: chunk})[session.row], 0.0, 0.0)
    frames = np.stack(list(panels(session.film(), SIDE, "simulator")))
    write_atomic(given.out, webp_bytes(frames, hz))
    scores = [frame.psnr for frame in session.frames if frame.psnr is not None]
    print(f"{given.out}: {len(frames)} frames at {hz:g} Hz, mean PSNR {np.mean(scores):.1f} dB")


if __name__ == "__main__":
    main()
