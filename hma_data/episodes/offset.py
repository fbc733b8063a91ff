"""Measure how commands lie between the pictures of a recording, and choose how to pair the two.

A control loop takes a picture, computes and sends its command, so the command of frame t may be stamped just
after picture t. `hold` alone would then give picture t the command before it:

    pictures     |         |         |
    before     c |       c |       c |      hold
    after        | c       | c       | c    hold with tolerance_ms
    unrelated    | c  c  c  c  c  c  c      hold

Commands belong to pictures where they come at a steady time between them. Of two pictures, a command belongs
to the one before it unless it comes in the last 40 % of the interval.

Times are float64 seconds. C commands, T pictures.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hma_data.arrays import Floats
from hma_data.episodes.align import hold

STEADY_SHARE = 0.9  # least share of actions near their usual place between frames
NEAR_PART = 0.25  # part of an interval within which an action is near it
LATEST_PART = 0.6  # part of the interval after which an action belongs to the next frame
UNCLEAR_PART = 0.4  # from this part on, it may as well belong to the next frame
MIN_COMMANDS = 5  # actions between frames
AFTER_SHARE = 0.01  # share of actions after their frame, from which `hold` needs a tolerance
PAUSE_INTERVALS = 1.5  # a longer interval, in median intervals, is a pause of the camera


@dataclass(frozen=True)
class Offset:
    """The place of the commands of a topic between the pictures of a camera.

    A spread is half the distance from the 5th to the 95th percentile.

    Attributes:
        camera: its topic.
        age_ms: median and spread of the age of the last command at each picture.
        delay_ms: median and spread of the time from each picture to the first command after it.
        after_ms: median and spread of the time from a picture to its command, negative where the command
            comes first; None where commands come at no steady time.
        period_ms: median interval of the pictures.
        tolerance_ms: of the `hold` that gives each picture its command; 0 where plain `hold` does.
    """

    camera: str
    age_ms: tuple[float, float]
    delay_ms: tuple[float, float]
    after_ms: tuple[float, float] | None
    period_ms: float
    tolerance_ms: float = 0.0

    @property
    def measured(self) -> str:
        """Return the ages and delays as text."""
        return (
            f"the last one {_ms(self.age_ms)} before each image, the next one {_ms(self.delay_ms)} after it"
        )

    @property
    def said(self) -> str:
        """Return as text how commands come."""
        if self.after_ms is None:
            return f"actions are not tied to images; the last one is {_ms(self.age_ms)} old at each image"
        median, spread = self.after_ms
        side = "before" if median < 0 else "after"
        come = f"actions come {_ms((abs(median), spread))} {side} each image"
        if self.tolerance_ms and median > UNCLEAR_PART * self.period_ms:
            come += ", about midway to the next (remove tolerance_ms if they belong to the next image)"
        return come

    @property
    def pairing(self) -> str:
        """Return the keys of `sync` that follow from it."""
        return "actions: hold" + (f", tolerance_ms: {self.tolerance_ms:g}" if self.tolerance_ms else "")

    def __str__(self) -> str:
        """Return one line: how commands come, and the pairing that follows from it."""
        return f"{self.said}: {self.pairing}"


def _ms(measured: tuple[float, float]) -> str:
    places = 1 if max(measured) >= 0.95 or max(measured) < 0.005 else 2
    return f"{measured[0]:.{places}f} ± {measured[1]:.{places}f} ms"


def measure(runs: Sequence[tuple[Floats, Floats]], camera: str = "") -> Offset | None:
    """Measure the offset over episodes, each given as times of commands (C,) and of pictures (T,).

    Return None where too few commands lie between pictures.
    """
    ages, delays, parts, intervals = [], [], [], []
    for commands, pictures in runs:
        commands, pictures = np.unique(commands), np.unique(pictures)  # messages may arrive twice
        if not len(commands) or len(pictures) < 2:
            continue
        index, age_ms = hold(commands, pictures)
        ages.append(age_ms[age_ms >= 0])
        follows = np.where(age_ms < 0, 0, index + 1)
        followed = follows < len(commands)
        delays.append((commands[follows[followed]] - pictures[followed]) * 1e3)
        last, since_ms = hold(pictures, commands)
        # The last frame has no next one: nothing after it lies between two frames.
        steps = np.append(np.diff(pictures), np.inf)[last] * 1e3
        between = (since_ms >= 0) & (steps < PAUSE_INTERVALS * 1e3 * float(np.median(np.diff(pictures))))
        parts.append(since_ms[between] / steps[between])
        intervals.append(np.diff(pictures) * 1e3)
    if sum(map(len, parts)) < MIN_COMMANDS or not sum(map(len, ages)) or not sum(map(len, delays)):
        return None
    period = float(np.median(np.concatenate(intervals)))
    after = _after(np.concatenate(parts))
    found = Offset(
        camera, _middle(np.concatenate(ages)), _middle(np.concatenate(delays)),
        None if after is None else _middle(after * period), period,
    )  # fmt: skip
    if after is None or np.mean(after > 0) <= AFTER_SHARE:
        return found
    tolerance = float(np.median(after) + 0.5) * period  # as far from this command as from the next
    return replace(found, tolerance_ms=round(tolerance) if tolerance >= 10 else round(tolerance, 1))


def _after(parts: Floats) -> Floats | None:
    """Return the distances of commands from their pictures, in intervals; None without a steady place.

    Args:
        parts: (C,) where each command lies between two pictures, 0 to 1. The interval is a circle: 0.99 and
            0.01 are near to each other.
    """
    # The mean direction on the circle: a plain mean of 0.99 and 0.01 would be 0.5.
    middle = float(np.angle(np.mean(np.exp(2j * np.pi * parts))) / (2 * np.pi)) % 1
    away = (parts - middle + 0.5) % 1 - 0.5
    near = np.abs(away) <= NEAR_PART
    if np.mean(near) < STEADY_SHARE:
        return None
    after = np.asarray((middle if middle <= LATEST_PART else middle - 1) + away[near], np.float64)
    after[np.abs(after) < 1e-9] = 0.0  # what the circle's sines and cosines add
    return after


def _middle(values: Floats) -> tuple[float, float]:
    low, median, high = np.percentile(values, [5, 50, 95])
    return float(median), float(high - low) / 2
