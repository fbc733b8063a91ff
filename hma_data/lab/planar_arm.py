"""Record a two-joint arm seen from above: physics by pymunk, driven by joint velocities at 30 Hz.

`planar_arm` is recorded to HDF5; `planar_arm_lerobot`, the same arm, to a LeRobotDataset.

The arm stands in the middle of a walled square and pushes three loose blocks. Each joint has a motor of
limited torque, and the elbow has stops; friction with the table slows the blocks. The velocities in a
frame are applied between its frame and the next. Joint angles and velocities are recorded beside them.
The reward is the distance that the blocks moved, in px. An episode is a success if some block ends 20 px
or more from its first place. A driver runs random manoeuvres one after another.

Lengths are pixels of the 512 × 512 arena with y downward, angles radians (the shoulder's clockwise from
+x, the elbow's from the upper arm on), velocities rad/s. J = 2 joints, B = 3 blocks, T frames.
"""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hma_data.arrays import Float32s, Floats, Images
from hma_data.lab import imported
from hma_data.lab.family.look import SCALE, SIZE, Color, Shape, box, direction, draw, shrunk, wrapped
from hma_data.lab.writers import Demo, block_demo, write_hdf5
from hma_data.registry.embodiment import find
from hma_data.sources.lerobot.writer import LeRobotEpisode, write_lerobot

if TYPE_CHECKING:
    import pymunk

Manoeuvre = Callable[["PlanarArm"], Floats]  # returns velocities (J,)

TASK = "shove the blocks about"
STEPS, HZ, TICKS = 96, 30, 8  # frames of an episode, their rate, ticks of the physics a frame
ARENA, BASE = 512.0, np.array([256.0, 256.0])
UPPER, FORE, RADIUS = 122.0, 102.0, 21.0  # lengths of the links, and half their width
BLOCK = 46.0  # edge
SPEED = 2.6  # fastest action
ELBOW_STOP, ELBOW_TURN = 2.5, 2.2  # angles: limit of the elbow, and where drivers turn it back
MOVED = 20.0  # distance that a block must move for success

PX = SIZE / ARENA  # px of the frame in one of the arena
TABLE, DARK = (226, 226, 220), (45, 45, 50)  # colours are RGB
UPPER_COLOR, FORE_COLOR = (40, 90, 200), (240, 145, 30)
BLOCK_COLORS = ((200, 40, 50), (30, 150, 90), (140, 60, 170))


def record(part: Path, robot: str, episodes: Iterable[int], seed: int) -> None:
    """Record the arm as a file of robomimic's layout, or as a LeRobotDataset; see `hma_data.lab`."""
    begun = (begin(robot, seed, episode) for episode in episodes)
    demos = (block_demo(arm, drive, STEPS, MOVED, seed) for arm, drive in begun)
    if robot == "planar_arm":
        write_hdf5(part, demos, {"env_name": robot, "type": 2, "env_kwargs": {"control_freq": HZ}})
    else:
        write_lerobot(part, find(robot), map(_as_lerobot, demos))


def _as_lerobot(demo: Demo) -> LeRobotEpisode:
    state = demo.states[:, :4].astype(np.float32)  # joint angles and velocities
    return LeRobotEpisode({"observation.images.top": demo.observations["image"]}, demo.actions, state, TASK)


class PlanarArm:
    """The arm and its blocks, at start with joint angles (J,) and blocks (B, 3): x, y, angle of each.

    Raises:
        MissingDependencyError: pymunk is not installed.
    """

    def __init__(self, joints: Floats, blocks: Floats) -> None:
        with imported("pymunk"):
            import pymunk
        self._munk: Any = pymunk
        self._space = pymunk.Space()
        self._space.iterations = 20
        self._space.damping = 0.02
        elbow, _ = elbow_and_tip(joints)
        self._upper = self._link(BASE, joints[0], UPPER)
        self._fore = self._link(elbow, joints[0] + joints[1], FORE)
        self._motors = self._joints()
        self._blocks = [self._block(pose) for pose in blocks]
        corners = [(0.0, 0.0), (ARENA, 0.0), (ARENA, ARENA), (0.0, ARENA)]
        for here, there in zip(corners, corners[1:] + corners[:1], strict=True):
            self._space.add(pymunk.Segment(self._space.static_body, here, there, 4))

    def _link(self, start: Floats, angle: float, length: float) -> "pymunk.Body":
        munk = self._munk
        body = munk.Body(1.0, munk.moment_for_segment(1.0, (-length / 2, 0), (length / 2, 0), RADIUS))
        body.center_of_gravity = (length / 2, 0)  # rotation is about it, so the position is set last
        body.angle, body.position = float(angle), (float(start[0]), float(start[1]))
        shape = munk.Segment(body, (0, 0), (length, 0), RADIUS)
        shape.filter, shape.friction = munk.ShapeFilter(group=1), 0.4
        self._space.add(body, shape)
        return body

    def _joints(self) -> "list[pymunk.SimpleMotor]":
        munk, ground = self._munk, self._space.static_body
        shoulder = munk.PivotJoint(ground, self._upper, tuple(BASE), (0, 0))
        elbow = munk.PivotJoint(self._upper, self._fore, (UPPER, 0), (0, 0))
        stop = munk.RotaryLimitJoint(self._upper, self._fore, -ELBOW_STOP, ELBOW_STOP)
        motors = [munk.SimpleMotor(ground, self._upper, 0), munk.SimpleMotor(self._upper, self._fore, 0)]
        for motor, torque in zip(motors, (2e6, 8e5), strict=True):
            motor.max_force = torque
        self._space.add(shoulder, elbow, stop, *motors)
        return motors

    def _block(self, pose: Floats) -> "pymunk.Body":
        munk = self._munk
        body = munk.Body(0.05, munk.moment_for_box(0.05, (BLOCK, BLOCK)))
        body.position, body.angle = (float(pose[0]), float(pose[1])), float(pose[2])
        shape = munk.Poly.create_box(body, (BLOCK, BLOCK))
        shape.friction = 0.4
        self._space.add(body, shape)
        return body

    @property
    def angles(self) -> Floats:
        """Return the (J,) angles; the shoulder's is within ±π."""
        return np.array([wrapped(self._upper.angle), self._fore.angle - self._upper.angle])

    @property
    def velocities(self) -> Floats:
        """Return the (J,) velocities of the joints."""
        upper, fore = self._upper.angular_velocity, self._fore.angular_velocity
        return np.array([upper, fore - upper])

    @property
    def joints(self) -> dict[str, Floats]:
        """Return the angles (J,) and velocities (J,)."""
        return {"joint_pos": self.angles, "joint_vel": self.velocities}

    @property
    def observed(self) -> Float32s:
        """Return (2·J,) joint angles and velocities, as recorded."""
        return np.concatenate([self.angles, self.velocities]).astype(np.float32)

    @property
    def own(self) -> Floats:
        """Return the middles (J, 2) of the links in the frame."""
        return link_middles(self.angles)

    @property
    def loose(self) -> Floats:
        """Return the middles (B, 2) of the blocks in the frame."""
        return PX * self.blocks[:, :2]

    @property
    def blocks(self) -> Floats:
        """Return (B, 3) x, y, angle of each block."""
        return np.array([[*body.position, body.angle] for body in self._blocks])

    @property
    def state(self) -> Floats:
        """Return (2·J + 3·B,): joint angles and velocities, poses of the blocks."""
        return np.concatenate([self.angles, self.velocities, self.blocks.ravel()])

    def advance(self, action: Float32s) -> None:
        """Simulate one frame with the motors set to velocities (J,)."""
        for motor, velocity in zip(self._motors, action, strict=True):
            motor.rate = -float(velocity)  # pymunk's rate is that of the first body relative to the second
        for _ in range(TICKS):
            self._space.step(1 / (HZ * TICKS))

    def picture(self) -> Images:
        """Draw the arm and the blocks; (SIZE, SIZE, 3) RGB."""
        shapes = []
        for pose, color in zip(self.blocks, BLOCK_COLORS, strict=True):
            shapes.append(Shape(PX * box(pose[:2], pose[2], BLOCK / 2, BLOCK / 2), 0, color))
        elbow, tip = elbow_and_tip(self.angles)
        shapes += [*_link(BASE, elbow, UPPER_COLOR), *_link(elbow, tip, FORE_COLOR)]
        shapes += [_disc(BASE, RADIUS * 0.7, DARK), _disc(elbow, RADIUS * 0.45, DARK)]
        image = np.full((SIZE * SCALE, SIZE * SCALE, 3), TABLE, dtype=np.uint8)
        draw(image, shapes)
        return shrunk(image)


def elbow_and_tip(joints: Floats) -> tuple[Floats, Floats]:
    """Return the positions of the elbow and the tip, (2,) each."""
    shoulder, whole = joints[0], joints[0] + joints[1]
    elbow = BASE + UPPER * direction(shoulder)
    return elbow, elbow + FORE * direction(whole)


def link_middles(joints: Floats) -> Floats:
    """Return the middles (J, 2) of the links in the frame at joint angles (J,)."""
    elbow, tip = elbow_and_tip(joints)
    return PX * np.stack([BASE + elbow, elbow + tip]) / 2


def joints_at(tip: Floats, bend: int) -> Floats:
    """Return (J,) angles that bring the tip to a point (2,), or as near as possible, bent +1 or -1."""
    x, y = tip - BASE
    cos = (x * x + y * y - UPPER**2 - FORE**2) / (2 * UPPER * FORE)
    elbow = bend * np.arccos(np.clip(cos, np.cos(ELBOW_TURN), 1.0))
    shoulder = np.arctan2(y, x) - np.arctan2(FORE * np.sin(elbow), UPPER + FORE * np.cos(elbow))
    return np.array([shoulder, elbow])


def start(seed: int, episode: int) -> tuple[PlanarArm, np.random.Generator]:
    """Return the arm at the start of an episode, with the blocks apart, and the generator of its driver."""
    rng = np.random.default_rng((seed, 3, episode))
    joints = np.array([rng.uniform(-np.pi, np.pi), rng.uniform(-ELBOW_TURN, ELBOW_TURN)])
    elbow, tip = elbow_and_tip(joints)
    taken = np.concatenate([np.linspace(BASE, elbow, 9), np.linspace(elbow, tip, 9)])
    blocks: list[Floats] = []
    while len(blocks) < len(BLOCK_COLORS):
        angle, far = rng.uniform(-np.pi, np.pi), rng.uniform(80, 225)
        place = BASE + far * direction(angle)
        if np.linalg.norm(taken - place, axis=1).min() > BLOCK * 0.75 + RADIUS + 8:
            blocks.append(np.array([*place, rng.uniform(-np.pi, np.pi)]))
            taken = np.concatenate([taken, place[None]])
    return PlanarArm(joints, np.stack(blocks)), rng


def begin(robot: str, seed: int, episode: int) -> tuple[PlanarArm, Callable[[], Float32s]]:
    """Return the simulation of an episode at its start, and the recorder's driver."""
    arm, rng = start(seed, episode)
    return arm, driver(arm, rng)


def _disc(place: Floats, radius: float, color: Color) -> Shape:
    return Shape(PX * place[None], PX * radius, color)


def _link(here: Floats, there: Floats, color: Color) -> list[Shape]:
    side = (there - here)[::-1] * (1, -1) * RADIUS / np.linalg.norm(there - here)
    outline = np.array([here + side, there + side, there - side, here - side])
    return [Shape(PX * outline, 0, color), _disc(here, RADIUS, color), _disc(there, RADIUS, color)]


# -- driver


def driver(arm: PlanarArm, rng: np.random.Generator) -> Callable[[], Float32s]:
    """Return the recorder's driver, which returns the next velocities (J,).

    It runs manoeuvres of 0.3 to 1.5 s, and turns the elbow back before its stops.
    """
    left = 0
    manoeuvre: Manoeuvre = _rest

    def drive() -> Float32s:
        nonlocal left, manoeuvre
        if left == 0:
            kind = rng.choice(4, p=(0.45, 0.25, 0.2, 0.1))
            manoeuvre = (_go, _weave, _hold)[kind](arm, rng) if kind < 3 else _rest
            left = int(rng.integers(9, 25 if kind == 3 else 46))
        left -= 1
        velocities = np.clip(manoeuvre(arm), -SPEED, SPEED)
        elbow = arm.angles[1]
        if abs(elbow) > ELBOW_TURN and elbow * velocities[1] > 0:
            velocities[1] = -velocities[1]
        return velocities.astype(np.float32)

    return drive


def _rest(arm: PlanarArm) -> Floats:
    return np.zeros(2)


def _go(arm: PlanarArm, rng: np.random.Generator) -> Manoeuvre:
    """Return a manoeuvre that goes to a block, and through it, or to any point in reach."""
    angle, far = rng.uniform(-np.pi, np.pi), rng.uniform(60, 220)
    point = BASE + far * direction(angle)
    if rng.random() < 0.6:
        _, tip = elbow_and_tip(arm.angles)
        block = arm.blocks[rng.integers(len(BLOCK_COLORS)), :2]
        point = block + (block - tip) * 0.3
    goal, gain = joints_at(point, int(rng.choice((-1, 1)))), rng.uniform(3, 7)

    def drive(arm: PlanarArm) -> Floats:
        error = goal - arm.angles
        error[0] = wrapped(error[0])
        return gain * error

    return drive


def _weave(arm: PlanarArm, rng: np.random.Generator) -> Manoeuvre:
    strength, hz, phase = rng.uniform(0.8, 2.4, 2), rng.uniform(0.2, 0.9, 2), rng.uniform(0, 2 * np.pi, 2)
    seconds = iter(np.arange(STEPS) / HZ)
    return lambda arm: strength * np.sin(2 * np.pi * hz * next(seconds) + phase)


def _hold(arm: PlanarArm, rng: np.random.Generator) -> Manoeuvre:
    velocities = rng.uniform(-SPEED, SPEED, 2)
    if rng.random() < 0.4:
        velocities[rng.integers(2)] = 0.0
    return lambda arm: velocities.copy()
