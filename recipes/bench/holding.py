"""Measure how long the robots of a checkpoint stay with the truth, as `hma play` sees it.

    python recipes/bench/holding.py embedded-lab          # into hma_model/play/holding.json

Each robot with a simulator replays the recorder's actions in the model until model and truth have parted
(`hma_model.play.session`), in several scenes; one without replays held-out recordings of --shards, to their
end. The lower median over scenes is the time that it holds.
"""

import argparse
import json
import statistics
from pathlib import Path

import hma_model.play
from hma_data.console import run_script
from hma_data.shards.reader import ShardSet
from hma_data.storage.files import write_atomic
from hma_model.checkpoint.folder import BUNDLED, Checkpoint
from hma_model.play.holding import MEASURED
from hma_model.play.session import Session
from hma_model.worlds.scenes import drivable
from hma_model.worlds.world import load_world


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkpoint")
    parser.add_argument("--out", type=Path, default=Path(hma_model.play.__file__).parent / MEASURED)
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--shards", nargs="*", default=[], help="recordings of robots without a simulator")
    parser.add_argument("--device", default="cpu")
    given = parser.parse_args()
    checkpoint = Checkpoint.open(given.checkpoint)
    world = load_world(given.checkpoint, device=given.device)
    robots = drivable(checkpoint, map(ShardSet, given.shards), lambda: world.tokenizer)
    sessions: dict[str, list[Session]] = {}
    for robot in robots.values():
        if robot.source != "images":
            name = robot.embodiment.id
            sessions[name] = [
                Session(name, robot, n, robot.scene(n), world, world.decoding) for n in range(given.scenes)
            ]
    every = [session for some in sessions.values() for session in some]
    for session in every:
        session.replays = True
    for frame in range(given.frames):
        live = [session for session in every if session.parted is None]
        chunks = {session.row: session.next_chunk() for session in live}
        images = world.step({row: chunk for row, chunk in chunks.items() if chunk is not None})
        for session in live:
            if session.row in images:
                session.take(images[session.row], 0.0, 0.0)
        print(f"frame {frame + 1}: {len(images)} sessions", flush=True)
    found = {}
    for name, some in sessions.items():
        hz = some[0].robot.embodiment.effective_hz
        frames, at_least = statistics.median_low(
            (one.parted or one.frames[-1].number, one.parted is None) for one in some
        )
        found[name] = {"seconds": round(frames / hz, 1), "at_least": at_least}
    bundled = {Checkpoint.open(part).trunk_sha256 for part in BUNDLED.values()}
    before = json.loads(given.out.read_text()) if given.out.exists() else {}
    kept = {trunk: robots for trunk, robots in before.items() if trunk in bundled}
    write_atomic(given.out, json.dumps(kept | {checkpoint.trunk_sha256: found}, indent=1) + "\n")


if __name__ == "__main__":
    run_script(main)
