"""Simulate a laboratory robot for as long as needed, with the places of its parts in each frame.

The simulators and drivers are those of the recorders. Of the pushers' episodes only those are taken that
wander: the others end when the T lies on its goal.

The state is where things are in the frame, so that it has one unit for every robot: the centre of each
moving part, in px of an image of 128 by 128. It tells joint angles, places, headings and an open gripper;
it does not tell a hoist, a lift and a magnet.

T frames a chunk apart, S pixels a side, K = stride * action dim, P parts.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hma_data.errors import UsageError
from hma_data.lab import FAMILY, family, pendulum, planar_arm, pusht
from hma_data.lab.family.look import SIZE
from hma_data.lab.family.world import World
from hma_data.lab.pusher import rotation
from hma_data.lab.simulator import LabSimulator, Simulation
from hma_data.registry.embodiment import Embodiment, find

Floats = NDArray[np.float64]
PUSHERS = ("pusht_fast", "pusht_slow")
SIMPLE = ("pendulum", "planar_arm", *PUSHERS)
PX = SIZE / planar_arm.ARENA  # px of an image of SIZE in one of an arena; gym-pusht's is as large
ROD = 26.0  # px from the pendulum's axle to the middle of its rod
STEM = np.array([0.0, 70.0])  # a point on the T's stem, px of the arena


@dataclass(frozen=True)
class Episode:
    """An episode and its state.

    Attributes:
        pictures: (T, S, S, 3) uint8, as the recorder draws them, or only those asked for.
        chunks: (T, K) float32, the actions from each frame to the next.
        parts: (T, P, 2) x, y of the parts in px of an image of 128 by 128.
        states: (T, S) float32, as the recorder stores them.
        driven: how many of the parts, the first ones, are the robot's own; the others lie loose.
    """

    pictures: NDArray[np.uint8]
    chunks: NDArray[np.float32]
    parts: Floats
    states: NDArray[np.float32]
    driven: int


def embodiment(robot: str) -> Embodiment:
    """Return the embodiment of a laboratory robot.

    Raises:
        UsageError: there is no such robot here.
    """
    if robot not in SIMPLE and not FAMILY.fullmatch(robot):
        remedy = f"name one of {', '.join(SIMPLE)}, or of the family, such as {family.TRUNK[0]}"
        raise UsageError(robot, "is no simulator of the laboratory", remedy)
    return find(robot) if robot in SIMPLE else family.embodiment(robot)


def episode(
    robot: str,
    frames: int,
    stride: int,
    seed: int,
    number: int,
    drawn: Collection[int] | None = None,
    commands: Floats | None = None,
    wander: bool = True,
) -> Episode:
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
    return Episode(np.stack(pictures), chunks, np.stack(parts), np.stack(states), driven)


def own_places(robot: str) -> Callable[[Floats], Floats]:
    """Return a function from a pose (Q,) to the places (P, 2) of a robot's own parts.

    A pose is that of the family, or the joint angles of `planar_arm`.
    """
    if FAMILY.fullmatch(robot):
        shapes = family.Body.of(robot).mechanism.shapes
        return lambda pose: np.stack([shape.points.mean(axis=0) for shape in shapes(pose)])
    return _links


def parts_of(simulation: Simulation) -> tuple[int, Floats]:
    """Return how many parts are driven, and the places (P, 2) of all, the driven ones first."""
    if isinstance(simulation, World):
        own = own_places(simulation.body.name)(simulation.pose)
        return len(own), np.concatenate([own, simulation.blocks])
    if isinstance(simulation, planar_arm.Arm):
        return 2, np.concatenate([_links(simulation.joints), PX * simulation.blocks[:, :2]])
    if isinstance(simulation, pendulum.Pendulum):
        return 1, SIZE / 2 - ROD * np.array([[np.sin(simulation.angle), np.cos(simulation.angle)]])
    assert isinstance(simulation, pusht.FastPusher | pusht.SlowPusher)
    arena = simulation.arena
    return 1, np.concatenate([PX * arena.agent[None], tee_places(arena.pose)])


def goal_of(robot: str) -> Floats | None:
    """Return the places (2, 2) of the T of a pusher when it lies on its goal; other robots have no goal."""
    return tee_places(np.array(pusht.GOAL)) if robot in PUSHERS else None


def tee_pose(places: Floats) -> Floats:
    """Return the pose (3,) x, y, angle of a pusher's T, in px of its arena, whose places (2, 2) these are."""
    along = places[1] - places[0]
    return np.append(places[0] / PX, np.arctan2(along[1], along[0]) - np.arctan2(STEM[1], STEM[0]))


def tee_places(pose: Floats) -> Floats:
    """Return the places (2, 2) of a pusher's T at a pose (3,) in px of its arena."""
    return PX * np.stack([pose[:2], pose[:2] + rotation(pose[2]) @ STEM])


def _links(joints: Floats) -> Floats:
    elbow, tip = planar_arm.elbow_and_tip(joints)
    return PX * np.stack([planar_arm.BASE + elbow, elbow + tip]) / 2
