"""Simulate a laboratory robot for as long as needed, with the places of its parts in each frame.

The simulators and drivers are those of the recorders. Of the pushers' episodes only those are taken that
wander: the others end when the T lies on its goal.

The state is where things are in the frame, so that it has one unit for every robot: the centre of each
moving part, in px of an image of 128 by 128. It tells joint angles, places, headings and an open gripper;
it does not tell a hoist, a lift and a magnet.

T frames a chunk apart, S pixels a side, K = stride * action dim, P parts.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from hma_data.arrays import Float32s, Floats, Images
from hma_data.lab import pusht
from hma_data.lab.family.look import SIZE as SIZE
from hma_data.lab.simulator import LabSimulator, Simulation

PUSHERS = ("pusht_fast", "pusht_slow")


@dataclass(frozen=True)
class TrueEpisode:
    """An episode and its state.

    Attributes:
        pictures: (T, S, S, 3) uint8, as the recorder draws them, or only those asked for.
        chunks: (T, K) float32, the actions from each frame to the next.
        parts: (T, P, 2) x, y of the parts in px of an image of 128 by 128.
        states: (T, S) float32, as the recorder stores them.
        driven: how many of the parts, the first ones, are the robot's own; the others lie loose.
    """

    pictures: Images
    chunks: Float32s
    parts: Floats
    states: Float32s
    driven: int


def episode(
    robot: str,
    frames: int,
    stride: int,
    seed: int,
    number: int,
    drawn: Collection[int] | None = None,
    commands: Floats | None = None,
    wander: bool = True,
) -> TrueEpisode:
    """Simulate an episode; the same seed and number give the same one, and a longer one begins like it.

    Args:
        robot: a laboratory robot.
        frames: T.
        stride: control steps a frame.
        seed, number: as the recorders take them.
        drawn: numbers of the frames to draw; by default all.
        commands: (T * stride, A) to give it; by default its own driver's.
        wander: of a pusher's episodes, take only those that wander; the others end at the goal.
    """
    simulator = LabSimulator(robot)
    if wander and robot in PUSHERS:
        number = number * len(pusht.STARTS) + pusht.STARTS.index("random")
    simulator.reset(seed, number)
    pictures, parts, states, given, driven = [], [], [], [], 0
    for step in range(frames * stride):
        if step % stride == 0:
            driven, places = parts_of(simulator.simulation)
            parts.append(places)
            states.append(simulator.state)
            if drawn is None or step // stride in drawn:
                pictures.append(simulator.simulation.picture())
        own = simulator.recorded() if commands is None else commands[step].astype(np.float32)
        given.append(own)
        simulator.advance(own)
    chunks = np.stack(given).reshape(frames, -1)
    return TrueEpisode(np.stack(pictures), chunks, np.stack(parts), np.stack(states), driven)


def parts_of(simulation: Simulation) -> tuple[int, Floats]:
    """Return how many parts are driven, and the places (P, 2) of all, the driven ones first."""
    own = simulation.own
    return len(own), np.concatenate([own, simulation.loose])


def goal_of(robot: str) -> Floats | None:
    """Return the places (2, 2) of the T of a pusher when it lies on its goal; other robots have no goal."""
    return pusht.tee_places(np.array(pusht.GOAL)) if robot in PUSHERS else None
