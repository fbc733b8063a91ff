"""Move the pusher: by a planner that pushes the T to its goal, or by smooth random motion.

The planner chooses a contact on the T's outline and a push length. It takes those whose predicted outcome
brings the T nearest to its goal for the time they cost. Then the pusher walks round the T (or flies over
it, if it can lift) and pushes. Contact is quasi-static and frictionless as in gym-pusht: the arena damps
all velocity, so a push at point c along the inward normal n with speed s moves the T by

    v = n·j/m,  ω = (r × n)·j/I,  j = s / (1/m + (r × n)²/I),  r = c − centre of mass.

Lengths are pixels of the 512 × 512 arena, angles radians. C contacts, N nodes, L push lengths.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from hma_data.arrays import Floats, Ints

LOW, HIGH = 22.0, 490.0  # range of the pusher's centre: its radius inside the walls
GAP = 11.0  # distance between pusher and T before a push
CLEARANCE = 3.0  # distance kept when walking past the T
STEPS = np.array([1.0, 1.0, 1.5, 1.5, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7, 8, 8, 8, 8])  # of a predicted push
LENGTHS = np.cumsum(STEPS)


def rotation(angle: float) -> Floats:
    """Return the (2, 2) matrix that rotates a column vector by `angle`."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


@dataclass(frozen=True)
class Tee:
    """The T in its own frame, as the environment built it."""

    boxes: Floats  # (2, 2, 2) lower and upper corner of its two bars
    center: Floats  # (2,) centre of mass
    mass: float
    moment: float  # of inertia
    radius: float  # of the pusher

    def distance(self, points: Floats) -> Floats:
        """Return the (...,) signed distance of points (..., 2) to the outline, negative inside."""
        middle, half = self.boxes.mean(axis=1), (self.boxes[:, 1] - self.boxes[:, 0]) / 2
        over = np.abs(points[..., None, :] - middle) - half
        outside = np.linalg.norm(np.maximum(over, 0), axis=-1)
        nearest: Floats = (outside + np.minimum(over.max(axis=-1), 0)).min(axis=-1)
        return nearest

    @cached_property
    def keypoints(self) -> Floats:
        """Return the (8, 2) corners of the bars; their mean distance from the goal is the planner's cost."""
        return np.array([[box[i, 0], box[j, 1]] for box in self.boxes for i in (0, 1) for j in (0, 1)])

    @cached_property
    def contacts(self) -> tuple[Floats, Floats]:
        """Return points (C, 2) on the outline with room for a pusher, and their inward normals (C, 2)."""
        points, normals = [], []
        for low, high in self.boxes:
            for axis in (0, 1):
                along = np.linspace(low[1 - axis] + 4, high[1 - axis] - 4, 9)
                for edge, inward in ((low[axis], 1.0), (high[axis], -1.0)):
                    side = np.empty((len(along), 2))
                    side[:, axis], side[:, 1 - axis] = edge, along
                    points.append(side)
                    normals.append(np.tile(np.eye(2)[axis] * inward, (len(along), 1)))
        point, normal = np.concatenate(points), np.concatenate(normals)
        reach = self.radius + GAP
        free = self.distance(point - normal * reach) > reach - 1.0
        return point[free], normal[free]

    @cached_property
    def standoffs(self) -> Floats:
        """Return (C, 2) places where the pusher's centre waits before each contact."""
        points, normals = self.contacts
        return points - normals * (self.radius + GAP)

    @cached_property
    def corners(self) -> Floats:
        """Return (N, 2) way points round the T."""
        signs = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
        nodes = self.keypoints + np.tile(signs, (2, 1)) * (self.radius + GAP) * 0.9
        return nodes[self.distance(nodes) > self.radius + CLEARANCE]

    @cached_property
    def from_corners(self) -> tuple[Floats, Floats]:
        """Return the lengths from corners to corners (N, N) and to standoffs (N, C), see `legs`."""
        return self.legs(self.corners, self.corners), self.legs(self.corners, self.standoffs)

    def legs(self, start: Floats, stop: Floats) -> Floats:
        """Return the (len(start), len(stop)) length of each straight way, infinite if the T blocks it."""
        share = np.linspace(0, 1, 20)[:, None]
        way = start[:, None, None] * (1 - share) + stop[None, :, None] * share
        clear = self.distance(way).min(axis=-1) > self.radius + CLEARANCE
        return np.where(clear, np.linalg.norm(start[:, None] - stop, axis=-1), np.inf)

    def placed(self, pose: Floats) -> Floats:
        """Return the (8, 2) keypoints in the arena, for a pose of the T."""
        return self.keypoints @ rotation(pose[2]).T + pose[:2]


Phases = list[tuple[Floats, bool]]  # way points (n, 2), and whether the pusher is up


def plan(
    tee: Tee, pose: Floats, goal: Floats, agent: Floats, speed: float, fly: bool, rng: np.random.Generator
) -> Phases:
    """Return the next push, the one with the most progress for its time: walk, push, step back.

    One push in ten is a blunder: any that is reachable.

    Args:
        pose, goal: (3,) x, y, angle of the T's frame.
        agent: (2,) centre of the pusher.
        speed: px/s.
        fly: whether the pusher passes over the T instead of round it.
    """
    turn = rotation(pose[2])
    standoffs = tee.standoffs @ turn.T + pose[:2]
    if fly:
        lengths, before = np.linalg.norm(standoffs - agent, axis=1), None
    else:
        lengths, before = _walks(tee, agent, pose)
    lengths = np.where(_inside(standoffs), lengths, np.inf)
    reachable = np.flatnonzero(np.isfinite(lengths))
    if not len(reachable):  # no standoff is reachable: go somewhere else first
        away = rng.uniform(LOW, HIGH, (1, 2))
        return [(away, fly), (away, False), (away, False)]

    now = np.linalg.norm(tee.placed(pose) - tee.placed(goal), axis=-1).mean()
    seconds = (lengths[:, None] + 3 * GAP + LENGTHS) / speed + 0.4
    rate = (now - predicted_costs(tee, pose, goal)) / seconds
    contact, length = divmod(int(rate.argmax()), len(LENGTHS))
    if rng.random() < 0.1:
        contact, length = int(rng.choice(reachable)), int(rng.integers(8, 16))

    corners = [] if before is None else [tee.corners[i] @ turn.T + pose[:2] for i in before(contact)]
    inward = tee.contacts[1][contact] @ turn.T
    end = np.clip(standoffs[contact] + inward * (GAP + LENGTHS[length]), LOW, HIGH)
    retreat = np.clip(end - inward * 2 * GAP, LOW, HIGH)
    return [(np.array([*corners, standoffs[contact]]), fly), (end[None], False), (retreat[None], False)]


def predicted_costs(tee: Tee, pose: Floats, goal: Floats) -> Floats:
    """Return the (C, L) mean distance of the keypoints from the goal after each contact's pushes."""
    points, normals = tee.contacts
    home = tee.placed(goal)
    push = normals @ rotation(pose[2]).T  # the direction in the arena is constant, the T turns
    angle = np.full(len(points), pose[2])
    center = np.tile(rotation(pose[2]) @ tee.center + pose[:2], (len(points), 1))
    touch = points - tee.center
    costs = np.empty((len(points), len(STEPS)))
    for column, step in enumerate(STEPS):
        normal = _turned(normals, angle)
        arm = touch[:, 0] * normals[:, 1] - touch[:, 1] * normals[:, 0]
        speed = step * (push * normal).sum(axis=1, keepdims=True)
        impulse = speed[:, 0] / (1 / tee.mass + arm**2 / tee.moment)
        touch = touch + _turned(step * push - speed * normal, -angle)  # the contact slides along its edge
        center = center + normal * (impulse / tee.mass)[:, None]
        angle = angle + arm * impulse / tee.moment
        moved = _turned(tee.keypoints - tee.center, angle[:, None]) + center[:, None]
        costs[:, column] = np.linalg.norm(moved - home, axis=-1).mean(axis=1)
    return costs


def _walks(tee: Tee, agent: Floats, pose: Floats) -> tuple[Floats, Callable[[int], list[int]]]:
    """Return the (C,) length of the shortest walk to each standoff, and a function that lists its corners."""
    turn = rotation(pose[2])
    local = ((agent - pose[:2]) @ turn)[None]
    usable = _inside(tee.corners @ turn.T + pose[:2])
    reach = np.where(usable, tee.legs(local, tee.corners)[0], np.inf)
    previous: Ints = np.full(len(reach), -1)
    to_corners, to_standoffs = tee.from_corners
    for _ in range(len(reach)):
        longer = reach[:, None] + to_corners
        better = (longer.min(axis=0) < reach - 1e-9) & usable
        previous = np.where(better, longer.argmin(axis=0), previous)
        reach = np.where(better, longer.min(axis=0), reach)
    direct = tee.legs(local, tee.standoffs)[0]
    around = reach[:, None] + to_standoffs

    def corners(contact: int) -> list[int]:
        if direct[contact] <= around[:, contact].min():
            return []
        chain = [int(around[:, contact].argmin())]
        while previous[chain[0]] >= 0:
            chain.insert(0, int(previous[chain[0]]))
        return chain

    return np.minimum(direct, around.min(axis=0)), corners


def _turned(vectors: Floats, angle: Floats) -> Floats:
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def _inside(points: Floats) -> Any:
    return np.all((points > LOW) & (points < HIGH), axis=-1)


class Planned:
    """A driver that plans a push, walks, pushes, steps back, and plans again."""

    def __init__(
        self, tee: Tee, goal: Floats, agent: Floats, speed: float, fly: bool, rng: np.random.Generator
    ) -> None:
        self._tee, self._goal, self._speed, self._fly, self._rng = tee, goal, speed, fly, rng
        self._setpoint = agent.copy()
        self._phases: Phases = []

    def act(self, pose: Floats, agent: Floats, seconds: float) -> tuple[Floats, bool]:
        """Return the setpoint (2,) `seconds` from now, at the next call, and whether the pusher is up."""
        if not self._phases:
            self._phases = plan(self._tee, pose, self._goal, agent, self._speed, self._fly, self._rng)
        way, up = self._phases[0]
        self._setpoint, way = advance(self._setpoint, way, self._speed * seconds)
        if len(way):
            self._phases[0] = (way, up)
        elif np.linalg.norm(agent - self._setpoint) < 6.0:
            self._phases.pop(0)
        return self._setpoint + self._rng.normal(0, 0.7, 2), up


class Wandering:
    """A driver that moves smoothly from one random point to the next, often through the T."""

    def __init__(self, agent: Floats, fly: bool, rng: np.random.Generator) -> None:
        self._setpoint, self._fly, self._rng = agent.copy(), fly, rng
        self._way: Floats = np.empty((0, 2))
        self._speed, self._up = 0.0, False

    def act(self, pose: Floats, agent: Floats, seconds: float) -> tuple[Floats, bool]:
        """Return the setpoint and whether the pusher is up; see Planned.act."""
        if not len(self._way):
            near = self._rng.random() < 0.7
            point = pose[:2] + self._rng.normal(0, 60, 2) if near else self._rng.uniform(LOW, HIGH, 2)
            self._way = np.clip(point, LOW, HIGH)[None]
            self._speed = self._rng.uniform(80, 300)
            self._up = self._fly and self._rng.random() < 0.4
        self._setpoint, self._way = advance(self._setpoint, self._way, self._speed * seconds)
        return self._setpoint.copy(), self._up


def advance(point: Floats, way: Floats, length: float) -> tuple[Floats, Floats]:
    """Return the point `length` further along the way (n, 2), at most its end, and the rest of the way."""
    while len(way):
        step = way[0] - point
        distance = float(np.linalg.norm(step))
        if distance > length:
            return point + step * (length / distance), way
        point, way, length = way[0], way[1:], length - distance
    return point.copy(), way
