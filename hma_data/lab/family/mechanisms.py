"""The mechanisms of the family: axes that actions move, and where the parts are at a pose.

A mechanism has Q axes; a pose (Q,) holds a number for each. An action (A,) gives each axis a velocity or a
target; only a car's actions, speed and turn rate, are not axes of its pose (x, y, heading). A maker draws a
mechanism from a generator, for a model frame of so many seconds.

Lengths are px of the 128 × 128 frame with y downward, angles radians clockwise from +x, times seconds.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np

from hma_data.arrays import Floats
from hma_data.lab.family.look import SIZE, Color, Shape, box, direction

FINGER = 3.6  # half the width of a finger


@dataclass(frozen=True)
class Axis:
    """One number of a pose or of an action."""

    name: str
    unit: str  # of its pose: rad, px, or none
    low: float
    high: float
    speed: float  # fastest motion, unit/s
    target: bool = False  # whether the action is a position, which the axis follows with a lag
    lag: float = 0.0
    turns: bool = False  # without end, and the angle is kept within ±π

    @property
    def range(self) -> tuple[float, float]:
        """Return the lowest and the highest action."""
        return (self.low, self.high) if self.target else (-self.speed, self.speed)

    @property
    def command_unit(self) -> str:
        """Return the unit of the action."""
        return self.unit if self.target or not self.unit else f"{self.unit}/s"


@dataclass(frozen=True)
class Mechanism(ABC):
    """The moving parts of a kind."""

    axes: tuple[Axis, ...]  # the Q axes of the pose

    @property
    def commands(self) -> tuple[Axis, ...]:
        """Return the A axes of the action."""
        return self.axes

    def fixed(self) -> list[Shape]:
        """Return the parts that never move, drawn below everything else."""
        return []

    @abstractmethod
    def shapes(self, pose: Floats) -> list[Shape]:
        """Return the moving parts, the lowest first."""

    @abstractmethod
    def tip(self, pose: Floats) -> tuple[Floats, float]:
        """Return the point (2,) that pushes or holds blocks, and its direction."""


def _axis(name: str, unit: str, low: float, high: float, speed: float, turns: bool = False) -> Axis:
    digits = 1 if unit == "px" else 2
    low, high = (-np.pi, np.pi) if turns else (round(float(low), digits), round(float(high), digits))
    return Axis(name, unit, low, high, round(float(speed), digits), turns=turns)


def _targets(rng: np.random.Generator, axes: list[Axis], low: float = 0.15, high: float = 0.4) -> list[Axis]:
    lag = rng.uniform(low, high)
    return [replace(axis, target=True, lag=lag) for axis in axes]


# -- arms


@dataclass(frozen=True)
class Arm(Mechanism):
    """J links in a chain seen from above, and perhaps a gripper of two fingers at its tip."""

    base: Floats  # (2,)
    facing: float  # direction of the first link at angle 0
    lengths: Floats  # (J,)
    radii: Floats  # (J,) half the width of each link
    colors: tuple[Color, ...]  # of the links, then of the fingers
    joint: Color

    def points(self, pose: Floats) -> tuple[Floats, Floats]:
        """Return the (J + 1, 2) ends of the links and their (J,) directions."""
        angles = self.facing + np.cumsum(pose[: len(self.lengths)])
        links = self.lengths[:, None] * direction(angles)
        return np.concatenate([self.base[None], self.base + np.cumsum(links, axis=0)]), angles

    def fixed(self) -> list[Shape]:
        return [Shape(self.base[None], self.radii[0] * 1.35, self.joint)]

    def shapes(self, pose: Floats) -> list[Shape]:
        points, angles = self.points(pose)
        parts = [
            Shape(np.stack(ends), radius, color, True)
            for ends, radius, color in zip(pairwise(points), self.radii, self.colors, strict=False)
        ]
        parts += [
            Shape(point[None], radius * 0.5, self.joint)
            for point, radius in zip(points[:-1], self.radii, strict=True)
        ]
        if len(pose) > len(self.lengths):
            ahead = direction(angles[-1])
            side = np.array([-ahead[1], ahead[0]]) * (FINGER + 0.6 + 8.0 * pose[-1])
            color = self.colors[len(self.lengths)]
            for root in (points[-1] + side, points[-1] - side):
                parts.append(Shape(np.stack([root + ahead * 2, root + ahead * 13]), FINGER, color))
            parts.append(Shape(box(points[-1] + ahead, float(angles[-1]), 3.6, 12.5), 3.6, color))
        return parts

    def tip(self, pose: Floats) -> tuple[Floats, float]:
        points, angles = self.points(pose)
        ahead = direction(angles[-1])
        beyond = 10.0 if len(pose) > len(self.lengths) else 0.0
        return points[-1] + ahead * beyond, float(angles[-1])


def _arm(
    joints: int, rng: np.random.Generator, frame: float, colors: list[Color], joint: Color
) -> tuple[Arm, str]:
    grips = joints > 1 and rng.random() < 0.5
    edge = rng.random() < (0.15, 0.3, 0.5, 0.6)[joints - 1]
    if edge:
        facing, along = float(rng.integers(4) * np.pi / 2), rng.uniform(-12, 12)
        inward = direction(facing)
        base = SIZE / 2 - inward * 57 + inward[::-1] * along
        reach = rng.uniform(76, 90)
    else:
        facing, base = 0.0, rng.uniform(50, 78, 2)
        reach = min(base.min(), SIZE - base.max()) + rng.uniform(-2, 8)
    reach -= 12.0 if grips else 0.0
    shares = np.array([0.82**i for i in range(joints)]) * rng.uniform(0.9, 1.1, joints)
    lengths = reach * shares / shares.sum()
    thick = rng.uniform(6.0, 9.0) if joints < 3 else rng.uniform(5.5, 7.0)
    radii = np.maximum(3.8, thick * rng.uniform(0.82, 0.92) ** np.arange(joints))
    target = rng.random() < 0.4
    axes = []
    for j in range(joints):
        lever = lengths[j:].sum() + (10.0 if grips else 0.0)
        speed = rng.uniform(8, 12) * joints**-0.3 / lever / frame
        limit = rng.uniform(1.8, 2.4) if j else 1.0 if edge else 2.9 if target else np.pi
        turns = not (j or edge or target)
        axes.append(_axis(f"joint_{j + 1}", "rad", -limit, limit, speed, turns))
    if target:
        axes = _targets(rng, axes)
    if grips:
        axes.append(replace(_axis("gripper", "", 0, 1, 0.5 / frame), target=True, lag=0.12))
    arm = Arm(tuple(axes), base, facing, lengths, radii, tuple(colors[: joints + 1]), joint)
    what = "joint position targets" if target else "joint velocities"
    text = f"planar arm with {joints} joint{'s' * (joints > 1)}{' and a gripper' * grips}, {what}"
    return arm, text


# -- mover


@dataclass(frozen=True)
class Mover(Mechanism):
    """A disc, square or triangle that moves in the plane."""

    driven: tuple[Axis, ...]  # the axes of the action
    form: str
    radius: float
    colors: tuple[Color, ...]

    @property
    def commands(self) -> tuple[Axis, ...]:
        return self.driven

    def shapes(self, pose: Floats) -> list[Shape]:
        heading, place, r = float(pose[2]) if len(pose) > 2 else -np.pi / 2, pose[:2], self.radius
        corners = {"square": 4, "triangle": 3}.get(self.form)
        if corners is None:
            parts = [Shape(place[None], r, self.colors[0], True)]
        else:
            angles = heading + 2 * np.pi * (np.arange(corners) + (0.5 if corners == 4 else 0)) / corners
            far = r * (1.2 if corners == 4 else 1.35)
            parts = [Shape(place + far * direction(angles), r, self.colors[0], True)]
        if len(pose) > 2:
            ahead = direction(heading)
            parts.append(
                Shape(np.stack([place + ahead * r * 0.2, place + ahead * r * 0.75]), r * 0.42, self.colors[1])
            )
        else:
            parts.append(Shape(place[None], r * 0.4, self.colors[1]))
        return parts

    def tip(self, pose: Floats) -> tuple[Floats, float]:
        return pose[:2], 0.0


def _mover(rng: np.random.Generator, frame: float, colors: list[Color], joint: Color) -> tuple[Mover, str]:
    form, radius = str(rng.choice(("disc", "square", "triangle"))), rng.uniform(9, 13)
    speed = rng.uniform(7, 12) / frame
    low, high = radius * 1.2, SIZE - radius * 1.2
    axes = [_axis(name, "px", low, high, speed) for name in "xy"]
    way = str(rng.choice(("velocity", "position target", "speed and turn rate")))
    if way == "position target":
        axes = _targets(rng, axes, 0.2, 0.4)
        commands = axes
    elif way == "velocity":
        commands = [replace(axis, name=f"v{axis.name}") for axis in axes]
    else:
        axes.append(_axis("heading", "rad", -np.pi, np.pi, rng.uniform(0.3, 0.5) / frame, turns=True))
        commands = [_axis("speed", "px", 0, 0, speed), replace(axes[-1], name="turn")]
    mover = Mover(tuple(axes), tuple(commands), form, radius, tuple(colors[:2]))
    return mover, f"{form} that moves in the plane, {way}"


# -- gantry


@dataclass(frozen=True)
class Gantry(Mechanism):
    """A bridge over the whole width, a trolley on it, and perhaps a hook that is lowered to push."""

    upright: bool  # whether the bridge spans from top to bottom, and moves along x
    width: float  # half that of the bridge
    trolley: float  # half the side of the trolley
    colors: tuple[Color, ...]
    joint: Color

    def _place(self, pose: Floats) -> Floats:
        return pose[:2] if self.upright else pose[1::-1]

    def fixed(self) -> list[Shape]:
        ends = np.array([[0.0, 3.0], [SIZE, 3.0]])
        rails = [ends, SIZE - ends]
        return [Shape(rail if self.upright else rail[:, ::-1], 2.0, self.joint) for rail in rails]

    def shapes(self, pose: Floats) -> list[Shape]:
        place = self._place(pose)
        way = np.array([0.0, 1.0] if self.upright else [1.0, 0.0])
        ends = np.stack([place * (1 - way), place * (1 - way) + way * SIZE])
        hoist = float(pose[2]) if len(pose) > 2 else 0.0
        block = Shape(box(place, 0.0, self.trolley, self.trolley), self.trolley, self.colors[1], hoist < 0.5)
        hook = Shape(place[None], 3.6 + (self.trolley - 3.0) * hoist, self.colors[2])
        return [Shape(ends, self.width, self.colors[0]), block, hook]

    def tip(self, pose: Floats) -> tuple[Floats, float]:
        return self._place(pose), 0.0


def _gantry(rng: np.random.Generator, frame: float, colors: list[Color], joint: Color) -> tuple[Gantry, str]:
    trolley, hoist = rng.uniform(8.5, 11.5), rng.random() < 0.5
    axes = [
        _axis(name, "px", trolley + 3, SIZE - trolley - 3, rng.uniform(6, 11) / frame)
        for name in ("bridge", "trolley")
    ]
    if hoist:
        axes.append(_axis("hoist", "", 0, 1, rng.uniform(0.25, 0.4) / frame))
    upright, width = bool(rng.random() < 0.5), rng.uniform(4, 6)
    text = f"gantry with a trolley{' and a hoist' * hoist}, velocities"
    return Gantry(tuple(axes), upright, width, trolley, tuple(colors[:3]), joint), text


# -- rails


@dataclass(frozen=True)
class Rails(Mechanism):
    """Sliders on parallel rails."""

    upright: bool
    places: Floats  # (J,) of the rails
    size: tuple[float, float]  # half the length and half the width of a slider
    colors: tuple[Color, ...]
    joint: Color

    def fixed(self) -> list[Shape]:
        rails = [np.array([[6.0, place], [SIZE - 6.0, place]]) for place in self.places]
        return [Shape(rail[:, ::-1] if self.upright else rail, 1.6, self.joint) for rail in rails]

    def shapes(self, pose: Floats) -> list[Shape]:
        centers = np.stack([self.places, pose] if self.upright else [pose, self.places], axis=1)
        angle = np.pi / 2 if self.upright else 0.0
        return [
            Shape(box(center, angle, *self.size), min(self.size), color, True)
            for center, color in zip(centers, self.colors, strict=True)
        ]

    def tip(self, pose: Floats) -> tuple[Floats, float]:
        center = np.array([pose[0], self.places[0]])
        return (center[::-1] if self.upright else center), 0.0


def _rails(rng: np.random.Generator, frame: float, colors: list[Color], joint: Color) -> tuple[Rails, str]:
    count, upright, target = int(rng.integers(2, 6)), bool(rng.random() < 0.5), rng.random() < 0.5
    gap = float(rng.uniform(0.8, 1.0) * 100 / (count - 1) if count > 2 else rng.uniform(40, 70))
    places = SIZE / 2 + gap * (np.arange(count, dtype=np.float64) - (count - 1) / 2)
    size = (rng.uniform(7, 10), min(rng.uniform(7, 10), gap * 0.38))
    speeds = rng.uniform(7, 12, count) / frame
    axes = [
        _axis(f"slider_{i + 1}", "px", size[0] + 4, SIZE - size[0] - 4, speed)
        for i, speed in enumerate(speeds)
    ]
    axes = _targets(rng, axes) if target else axes
    text = f"{count} sliders on rails, {'position targets' if target else 'velocities'}"
    return Rails(tuple(axes), upright, places, size, tuple(colors[:count]), joint), text


# -- crane


@dataclass(frozen=True)
class Crane(Mechanism):
    """A jib that slews about a mast, a trolley along it, and perhaps a magnet."""

    base: Floats  # (2,)
    length: float
    width: float  # half that of the jib
    trolley: float  # radius
    colors: tuple[Color, ...]
    joint: Color

    def fixed(self) -> list[Shape]:
        return [Shape(self.base[None], self.width * 2.2, self.joint)]

    def shapes(self, pose: Floats) -> list[Shape]:
        along = direction(pose[0])
        place = self.base + along * pose[1]
        magnet = len(pose) > 2
        parts = [
            Shape(
                np.stack([self.base - along * 14, self.base + along * self.length]),
                self.width,
                self.colors[0],
            ),
            Shape(box(self.base - along * 14, float(pose[0]), 5.0, self.width * 2), 5.0, self.colors[2]),
            Shape(self.base[None], self.width * 0.6, self.joint),
            Shape(place[None], self.trolley, self.colors[1], not magnet),
        ]
        if magnet:
            on, off = np.array(self.colors[3]), np.array(self.joint)
            red, green, blue = np.rint(off + (on - off) * pose[2]).astype(int).tolist()
            parts.append(Shape(place[None], self.trolley * (0.4 + 0.4 * float(pose[2])), (red, green, blue)))
        return parts

    def tip(self, pose: Floats) -> tuple[Floats, float]:
        return self.base + direction(pose[0]) * pose[1], float(pose[0])


def _crane(rng: np.random.Generator, frame: float, colors: list[Color], joint: Color) -> tuple[Crane, str]:
    base = rng.uniform(52, 76, 2)
    length = min(base.min(), SIZE - base.max()) + rng.uniform(0, 6)
    trolley, magnet = rng.uniform(7.0, 8.5), rng.random() < 0.5
    axes = [
        _axis("slew", "rad", -np.pi, np.pi, rng.uniform(8, 12) / length / frame, turns=True),
        _axis("trolley", "px", 15, length - 3, rng.uniform(6, 9) / frame),
    ]
    if magnet:
        axes.append(replace(_axis("magnet", "", 0, 1, 0.6 / frame), target=True, lag=0.12))
    crane = Crane(tuple(axes), base, length, rng.uniform(4, 5.5), trolley, tuple(colors[:4]), joint)
    return crane, f"crane with a jib and a trolley{' and a magnet' * magnet}, velocities"


MAKERS: dict[str, Callable[[np.random.Generator, float, list[Color], Color], tuple[Mechanism, str]]] = {
    **{f"arm{joints}": partial(_arm, joints) for joints in range(1, 5)},
    "mover": _mover,
    "gantry": _gantry,
    "rails": _rails,
    "crane": _crane,
}  # kind -> maker, which returns the mechanism and a description
