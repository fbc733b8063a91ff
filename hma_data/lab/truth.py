"""Simulate a laboratory robot for as long as needed, with the places of its parts in each picture.

The simulators, starts and drivers are those of the recorders, but episodes have any length: a pusher that
has put the T onto its goal wanders on, and the clock of `pusht_slow` does not jitter.

The state is where things are in the picture, so that it has one unit for every robot: the centre of each
moving part, in px of a picture of 128 by 128. It tells joint angles, places, headings and an open gripper;
it does not tell a hoist, a lift and a magnet.

T frames a chunk apart, S pixels a side, K = stride * action dim, P parts.
"""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from hma_data.errors import UsageError
from hma_data.lab import FAMILY, family, pendulum, planar_arm, pusht
from hma_data.lab.family import bodies, world
from hma_data.lab.family.driver import Driver
from hma_data.lab.family.look import SIZE
from hma_data.lab.pusher import Wandering, rotation
from hma_data.registry.embodiment import Embodiment, find

Floats = NDArray[np.float64]
Step = tuple[Callable[[], NDArray[np.uint8]], Floats, int, NDArray[np.float32]]
SIMPLE = ("pendulum", "planar_arm", "pusht_fast", "pusht_slow")
PX = SIZE / planar_arm.ARENA  # px of a picture of SIZE in one of an arena; gym-pusht's is as large
ROD = 26.0  # px from the pendulum's axle to the middle of its rod
STEM = np.array([0.0, 70.0])  # a point on the T's stem, px of the arena


@dataclass(frozen=True)
class Episode:
    """An episode and its state.

    Attributes:
        pictures: (T, S, S, 3) uint8, as the recorder draws them, or only those asked for.
        chunks: (T, K) float32, the commands from each picture to the next.
        parts: (T, P, 2) x, y of the parts in px of a picture of 128 by 128.
        driven: how many of the parts, the first ones, are the robot's own; the others lie loose.
    """

    pictures: NDArray[np.uint8]
    chunks: NDArray[np.float32]
    parts: Floats
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
    robot: str, frames: int, stride: int, seed: int, number: int, drawn: Collection[int] | None = None
) -> Episode:
    """Simulate an episode; the same seed and number give the same one, and a longer one begins like it.

    Args:
        robot: a laboratory robot.
        frames: T.
        stride: control steps a frame.
        seed, number: as the recorders take them.
        drawn: frames of which the picture is drawn; by default all.
    """
    pictures, parts, commands, driven = [], [], [], 0
    steps = islice(_steps(robot, seed, number), frames * stride)
    for step, (picture, places, driven, command) in enumerate(steps):  # noqa: B007
        if step % stride == 0:
            parts.append(places)
            if drawn is None or step // stride in drawn:
                pictures.append(picture())
        commands.append(command)
    chunks = np.stack(commands).reshape(frames, -1)
    return Episode(np.stack(pictures), chunks, np.stack(parts), driven)


def _steps(robot: str, seed: int, number: int) -> Iterator[Step]:
    """Yield each control step: what draws the picture, places (P, 2), how many are driven, the command."""
    makers = {"pendulum": _pendulum, "planar_arm": _planar_arm, "pusht_fast": _fast, "pusht_slow": _slow}
    return makers[robot](seed, number) if robot in makers else _family(robot, seed, number)


def _family(robot: str, seed: int, number: int) -> Iterator[Step]:
    body = bodies.Body.of(robot)
    table, rng = world.start(body, seed, number)
    drive = Driver(body, table.pose, rng)
    while True:
        command = drive(table.pose, table.blocks, table.held >= 0).astype(np.float32)
        own = np.stack([shape.points.mean(axis=0) for shape in body.mechanism.shapes(table.pose)])
        yield table.picture, np.concatenate([own, table.blocks]), len(own), command
        table.advance(command.astype(np.float64))


def _planar_arm(seed: int, number: int) -> Iterator[Step]:
    arm, rng = planar_arm.start(seed, number)
    drive = planar_arm.driver(rng)
    while True:
        command = drive(arm).astype(np.float32)
        elbow, tip = planar_arm.elbow_and_tip(arm.joints)
        own = np.stack([planar_arm.BASE + elbow, elbow + tip]) / 2
        yield arm.picture, PX * np.concatenate([own, arm.blocks[:, :2]]), len(own), command
        arm.advance(command)


def _pendulum(seed: int, number: int) -> Iterator[Step]:
    rod, rng = pendulum.start(seed, number)
    _, driver = pendulum.DRIVERS[number % len(pendulum.DRIVERS)]
    drive = driver(rng)
    while True:
        torque = np.clip(drive(rod.angle, rod.speed), -pendulum.TORQUE, pendulum.TORQUE)
        command = np.array([torque], dtype=np.float32)
        middle = SIZE / 2 - ROD * np.array([[np.sin(rod.angle), np.cos(rod.angle)]])
        yield rod.picture, middle, 1, command
        rod.advance(command)


def _fast(seed: int, number: int) -> Iterator[Step]:
    arena, policy, rng = pusht.begin(pusht.FAST_LOOK, 0, seed, number, fly=False)
    period, setpoint = 0.1, arena.agent
    while True:
        if arena.success and not isinstance(policy, Wandering):
            policy = Wandering(arena.agent, False, rng)
        ahead, _ = policy.act(arena.pose, arena.agent, period)
        command = pusht.fast_command(setpoint, ahead, period)
        setpoint = ahead
        yield arena.picture, _on_table(arena), 1, command
        arena.advance(command.astype(np.float64), 10)


def _slow(seed: int, number: int) -> Iterator[Step]:
    arena, policy, rng = pusht.begin(pusht.SLOW_LOOK, 1, seed, number, fly=True)
    velocity: Floats = np.zeros(2)
    setpoint, up = arena.agent, False
    while True:
        if arena.ticks % 20 == 2:  # a command every 200 ms, a picture every 80 ms
            if arena.success and not isinstance(policy, Wandering):
                policy = Wandering(arena.agent, True, rng)
            ahead, up = policy.act(arena.pose, arena.agent, 0.2)
            velocity = (ahead - setpoint) / 0.2
            arena.lift(up)
        if arena.ticks % 8 == 3:
            yield arena.picture, _on_table(arena), 1, np.array([*velocity, up], dtype=np.float32)
        ticks = min(every - (arena.ticks - first) % every for first, every in ((2, 20), (3, 8)))
        setpoint = pusht.within(setpoint + velocity * ticks * pusht.TICK_S)
        lead = pusht.LAG_S - ticks * pusht.TICK_S / 2
        arena.advance(pusht.within(setpoint + velocity * lead), ticks)


def _on_table(arena: pusht.Arena) -> Floats:
    """Return (3, 2) places of the pusher, the T's frame and a point on its stem."""
    stem = arena.pose[:2] + rotation(arena.pose[2]) @ STEM
    return PX * np.stack([arena.agent, arena.pose[:2], stem])
