"""Drive the family's robots by random manoeuvres of 0.3 to 1.5 s, or straight to a block.

A manoeuvre goes to a pose (to a block, or anywhere), holds a velocity, weaves, or rests. Axes commanded by
velocity turn back at their limits, unless keys are held down: then they press on there, as in `hma play`. A
gripper closes round a block in its reach, and opens again later.
`Reacher` has one aim, the block that lies nearest, and looks at each step: a task that can be learned.
"""

from collections.abc import Callable, Sequence

import numpy as np

from hma_data.arrays import Floats
from hma_data.lab.family.bodies import Body
from hma_data.lab.family.look import SIZE, wrapped

MANOEUVRES = ("block", "anywhere", "hold", "weave", "rest", "keys")
CHANCES = (0.27, 0.26, 0.22, 0.15, 0.1, 0.0)
PUSHING = (0.45, 0.11, 0.11, 0.05, 0.03, 0.25)  # blocks move half as often again, or twice; and held keys
LONGEST = {"rest": 0.8, "keys": 2.5}  # seconds
Manoeuvre = Callable[[Floats], Floats]  # pose (Q,) -> velocities (A,)
GAIN, NUDGE, DAMPING = 2.0, 1e-4, 1.0  # of a reach: 1/s; of a pose, in widths of its limits; px²


class Driver:
    """The commander of a body in one episode."""

    def __init__(
        self, body: Body, pose: Floats, rng: np.random.Generator, chances: Sequence[float] = CHANCES
    ) -> None:
        self._body, self._rng, self._chances = body, rng, chances
        self._tops = np.array([axis.speed for axis in body.commands])
        self._follows = np.array([axis.target for axis in body.commands])
        self._turns = body.each("turns")
        self._sign = np.ones(len(body.commands))
        self._setpoint = pose[: len(body.commands)].copy()
        self._left = 0
        self._goal: Floats | None = None
        self._keys = False
        self._opening = float(pose[-1])
        self._manoeuvre = self._rest()

    def __call__(self, pose: Floats, blocks: Floats, holding: bool) -> Floats:
        """Return the next action (A,) at a pose (Q,) among blocks (B, 2)."""
        lost = self._goal is None and not self._keys and not self._visible(pose)
        if self._left == 0 or lost:
            kind = "anywhere" if lost else str(self._rng.choice(MANOEUVRES, p=self._chances))
            self._begin(pose, blocks, holding, kind)
        self._left -= 1
        velocity = np.clip(self._manoeuvre(pose) * self._sign, -self._tops, self._tops)
        if not self._body.car and not self._keys:
            self._turn_back(pose, velocity)
        return self._command(velocity)

    def _command(self, velocity: Floats) -> Floats:
        low, high = self._body.ranges
        if self._goal is not None and not self._body.car:
            self._setpoint = np.where(self._follows, self._goal, self._setpoint)
        else:
            self._setpoint = self._setpoint + velocity / self._body.hz
        self._setpoint = np.clip(self._setpoint, *self._body.limits[:, : len(low)])
        action = np.where(self._follows, self._setpoint, velocity)
        if self._body.grip:
            action[-1] = self._opening
        return np.clip(action, low, high)

    def _turn_back(self, pose: Floats, velocity: Floats) -> None:
        """Turn round the axes that leave the inner nine tenths of their limits, if a velocity is held."""
        low, high = self._body.limits
        margin = 0.05 * (high - low)
        at = np.where(self._follows, self._setpoint, pose)
        outward = ((at < low + margin) & (velocity < 0)) | ((at > high - margin) & (velocity > 0))
        outward &= ~self._turns
        if self._goal is None:
            self._sign[outward] *= -1
            velocity[outward] *= -1

    def _begin(self, pose: Floats, blocks: Floats, holding: bool, kind: str) -> None:
        """Begin a manoeuvre; choose how long it lasts, and what the gripper does in it."""
        rng, hz = self._rng, self._body.hz
        self._left = max(1, round(hz * rng.uniform(0.3, LONGEST.get(kind, 1.5))))
        self._keys = kind == "keys"
        self._sign[:] = 1
        self._setpoint = np.where(self._follows, self._setpoint, pose[: len(self._setpoint)])
        self._goal = self._pose_near(blocks, pose) if kind == "block" else None
        if kind == "anywhere":
            self._goal = self._random_pose()
        if self._goal is not None:
            self._manoeuvre = self._steer if self._body.car else self._approach(self._goal)
        else:
            others = {"hold": self._hold, "weave": self._weave, "rest": self._rest, "keys": self._press}
            self._manoeuvre = others[kind]()
        if self._body.grip:
            tip, _ = self._body.mechanism.tip(pose)
            near = bool((np.linalg.norm(blocks - tip, axis=1) < 8.0).any())
            chance = 0.65 if holding else 0.9 if near else 0.25
            closed = float(rng.random() < chance)
            self._opening = 1 - closed if self._body.grip == "gripper" else closed

    def _visible(self, pose: Floats) -> bool:
        """Check whether the tip is well inside the frame."""
        tip, _ = self._body.mechanism.tip(pose)
        return bool(tip.min() > 4 and tip.max() < SIZE - 4)

    def _random_pose(self) -> Floats:
        low, high = self._body.limits
        for _ in range(8):
            pose = self._rng.uniform(low, high)
            if self._visible(pose):
                break
        return pose

    def _pose_near(self, blocks: Floats, pose: Floats) -> Floats:
        """Return the one of some random poses that brings the tip nearest to a block, or a step beyond it."""
        here, _ = self._body.mechanism.tip(pose)
        block = blocks[self._rng.integers(len(blocks))]
        point = block if self._body.grip else block + (block - here) * 0.3
        spread = 0.5 * (self._body.limits[1] - self._body.limits[0])
        best: Floats = pose
        least = np.inf
        for trial in range(60):  # forty anywhere, twenty near the best of them
            other = (
                best + self._rng.normal(0, 0.1, len(pose)) * spread if trial >= 40 else self._random_pose()
            )
            other = np.clip(other, *self._body.limits)
            far = float(np.linalg.norm(self._body.mechanism.tip(other)[0] - point))
            if far < least:
                best, least = other, far
        return best

    def _approach(self, goal: Floats) -> Manoeuvre:
        gain = self._rng.uniform(3, 7)

        def drive(pose: Floats) -> Floats:
            error = goal - pose
            return gain * np.where(self._turns, wrapped(error), error)

        return drive

    def _steer(self, pose: Floats) -> Floats:
        assert self._goal is not None
        return steered(self._body, pose, self._goal[:2])

    def _hold(self) -> Manoeuvre:
        count = len(self._tops)
        velocity = self._tops * self._rng.uniform(0.4, 1.0, count) * self._rng.choice((-1, 1), count)
        if count > 1 and self._rng.random() < 0.4:
            velocity[self._rng.integers(count)] = 0.0
        return lambda pose: velocity

    def _weave(self) -> Manoeuvre:
        count, rng = len(self._tops), self._rng
        strength, hz = self._tops * rng.uniform(0.5, 1.0, count), rng.uniform(0.3, 1.0, count)
        phase, seconds = rng.uniform(0, 2 * np.pi, count), iter(np.arange(10_000) / self._body.hz)
        return lambda pose: strength * np.sin(2 * np.pi * hz * next(seconds) + phase)

    def _press(self) -> Manoeuvre:
        velocity = self._tops * self._rng.integers(-1, 2, len(self._tops)).astype(float)
        return lambda pose: velocity

    def _rest(self) -> Manoeuvre:
        return lambda pose: np.zeros(len(self._tops))


class Reacher:
    """The commander of a body whose tip goes to the block that lies nearest, and stays there.

    Blocks lie where they were when it first looked: a block that is pushed away is not followed.
    """

    def __init__(self, body: Body) -> None:
        self._body = body
        self._width = body.limits[1] - body.limits[0]
        self._aim: Floats | None = None

    def __call__(self, pose: Floats, blocks: Floats, holding: bool) -> Floats:
        """Return the next action (A,) at a pose (Q,) among blocks (B, 2)."""
        body, (tip, _) = self._body, self._body.mechanism.tip(pose)
        if self._aim is None:
            self._aim = blocks[np.linalg.norm(blocks - tip, axis=1).argmin()].copy()
        low, high = body.ranges
        if body.car:
            return np.clip(steered(body, pose, self._aim), low, high)
        velocity = GAIN * self._way(pose, self._aim - tip)
        action = np.where(body.each("target"), pose + velocity * body.each("lag"), velocity)
        if body.grip:
            action[-1] = float(body.grip == "gripper")  # open, or off
        return np.clip(action, low, high)

    def _way(self, pose: Floats, miss: Floats) -> Floats:
        """Return the change of the pose (Q,) that brings the tip nearer by (2,): damped least squares."""
        here, _ = self._body.mechanism.tip(pose)
        nudges = np.diag(self._width * NUDGE)
        slope = np.stack([(self._body.mechanism.tip(pose + n)[0] - here) / NUDGE for n in nudges], axis=1)
        change: Floats = slope.T @ np.linalg.solve(slope @ slope.T + DAMPING * np.eye(2), miss)
        return change * self._width


def steered(body: Body, pose: Floats, point: Floats) -> Floats:
    """Return the speed and turn rate of a car that goes to a point (2,)."""
    way = point - pose[:2]
    far = float(np.hypot(*way))
    bearing = float(wrapped(np.arctan2(way[1], way[0]) - pose[2]))
    ahead = body.commands[0].speed * min(1.0, far / 12) * max(0.25, np.cos(bearing))
    return np.array([ahead, 4.0 * bearing if far > 3 else 0.0])
