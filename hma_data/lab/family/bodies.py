"""The bodies of the family: what a name stands for, and how actions move it.

Everything about a body is drawn from its name, `<kind>_<number>`: mechanism, size, speeds, rate, blocks,
colours, background.

Lengths are px of the 128 × 128 frame with y downward, angles radians clockwise from +x, times seconds.
Q axes of a pose, A actions, B blocks.
"""

import zlib
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np

from hma_data.arrays import Floats, Images
from hma_data.errors import UsageError
from hma_data.lab.family.look import (
    DARK,
    LIGHT,
    Block,
    Color,
    background,
    contrast,
    direction,
    draw,
    vivid,
    wrapped,
)
from hma_data.lab.family.mechanisms import MAKERS, Axis, Mechanism

STRIDES = {10: (1, 2), 15: (3,), 20: (2, 4), 25: (5,), 30: (3, 5), 50: (5, 10)}  # rate -> model strides
GRIP = 0.6  # opening below which a gripper holds


@dataclass(frozen=True, eq=False)
class Body:
    """A robot of the family, and the table that it stands on."""

    name: str
    kind: str
    hz: int
    stride: int  # control steps a model frame
    mechanism: Mechanism
    blocks: tuple[Block, ...]
    canvas: Images  # the background with the fixed parts, at the drawing's size
    description: str

    @staticmethod
    @cache
    def of(name: str) -> "Body":
        """Return the body of a name.

        Raises:
            UsageError: the name is not a kind of MAKERS, an underscore and a number.
        """
        kind, _, number = name.partition("_")
        if kind not in MAKERS or not number.isdecimal():
            known = ", ".join(MAKERS)
            raise UsageError(name, "is not a robot of the family", f"write <kind>_<number>; kinds: {known}")
        rng = np.random.default_rng(zlib.crc32(name.encode()))
        hz = int(rng.choice(list(STRIDES)))
        stride = int(rng.choice(STRIDES[hz]))
        canvas, tones = background(rng)
        colors: list[Color] = []
        for _ in range(8):
            colors.append(vivid(rng, tones, colors))
        frame = stride / hz
        joint = DARK if contrast(DARK, tones[0]) > 60 else LIGHT
        mechanism, text = MAKERS[kind](rng, frame, colors, joint)
        grips = mechanism.axes[-1].name == "gripper"
        blocks = tuple(
            Block(
                str(rng.choice(("disc", "box", "tee"))),
                rng.uniform(5.2, 5.7) if grips else rng.uniform(6.0, 8.5),
                rng.uniform(-np.pi, np.pi),
                colors[-1 - i],
            )
            for i in range(int(rng.integers(1, 4)))
        )
        draw(canvas, mechanism.fixed())
        return Body(name, kind, hz, stride, mechanism, blocks, canvas, text)

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Return the Q axes of the pose."""
        return self.mechanism.axes

    @property
    def commands(self) -> tuple[Axis, ...]:
        """Return the A axes of the action."""
        return self.mechanism.commands

    def each(self, fact: str) -> Any:
        """Return a fact of each axis of the pose (Q,), such as speed."""
        return np.array([getattr(axis, fact) for axis in self.axes])

    @cached_property
    def limits(self) -> Floats:
        """Return the (2, Q) limits of the pose."""
        return np.stack([self.each("low"), self.each("high")])

    @cached_property
    def ranges(self) -> Floats:
        """Return the (2, A) lowest and highest actions."""
        return np.array([a.range for a in self.commands]).T

    @property
    def car(self) -> bool:
        """Return whether it is driven like a car."""
        return self.axes[-1].name == "heading"

    @property
    def grip(self) -> str:
        """Return what carries blocks: gripper, magnet, or an empty string."""
        return self.axes[-1].name if self.axes[-1].name in ("gripper", "magnet") else ""

    def holds(self, pose: Floats) -> bool:
        """Return whether the gripper is closed, or the magnet on."""
        return bool(self.grip) and bool((pose[-1] < GRIP) == (self.grip == "gripper"))

    def own(self, pose: Floats) -> Floats:
        """Return the middles (P, 2) of the moving parts at a pose (Q,)."""
        return np.stack([shape.points.mean(axis=0) for shape in self.mechanism.shapes(pose)])

    def moved(self, pose: Floats, action: Floats) -> Floats:
        """Return the pose (Q,) one control step later."""
        step, action = 1 / self.hz, np.clip(action, *self.ranges)
        if self.car:
            heading = pose[2] + action[1] * step
            ahead = direction(heading) * action[0] * step
            pose = np.array([*(pose[:2] + ahead), heading])
        else:
            lag = np.array([a.lag or 1.0 for a in self.axes])
            velocity = np.where(self.each("target"), (action - pose) / lag, action)
            pose = pose + np.clip(velocity, -self.each("speed"), self.each("speed")) * step
        return self.bounded(pose)

    def bounded(self, pose: Floats) -> Floats:
        """Return a pose (Q,) within the limits; angles that turn without end are kept within ±π."""
        return np.where(self.each("turns"), wrapped(pose), np.clip(pose, *self.limits))
