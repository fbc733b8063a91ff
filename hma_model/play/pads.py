"""Say how a person drives a robot on its image: where to press, and what a drag does.

A pad is a part of the image in which dragging gives one or two values of an action. Every robot has at
least one pad, unless all its values are switches. Keys and gamepads follow the same pads: a value that moves
something up and down in the image has keys for up and down.
"""

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from hma_data.lab import FAMILY
from hma_data.lab.family.bodies import Body
from hma_data.lab.family.mechanisms import Arm, Gantry, Rails
from hma_data.lab.simulator import SIZE
from hma_model.worlds.scenes import Dimension, Drivable

PLANE_SIDES = {"pusht_fast": 512.0}  # side of the image in units of the action, for targets in the plane
EDGE_TURN = 1.0  # rad: farthest that the first joint of an arm turns that stands at the image's edge
# Keys for down and up, and those for left and right; FURTHER for a value that no pad has.
ACROSS = (("ArrowLeft", "ArrowRight"), ("a", "d"), ("j", "l"), ("f", "h"))
ALONG = (("ArrowDown", "ArrowUp"), ("s", "w"), ("k", "i"), ("g", "t"))
FURTHER = ("q", "e")
MAX_SHARED_PADS = 2  # pads side by side for values that no image shows


@dataclass(frozen=True)
class Pad:
    """A part of the image to drag on.

    Attributes:
        x, y: the numbers of the values that a drag sideways and a drag up or down give; None for none.
        flips: whether the values of x and y shrink to the right and downward.
        low, high: the values of x and y at the image's left and upper, right and lower edges, if the
            pointer itself is the target; None if the way from where it was pressed counts.
        zone: left, top, right and bottom of the part, as shares of the image.
    """

    x: int | None
    y: int | None
    flips: tuple[bool, bool] = (False, False)
    low: tuple[float, float] | None = None
    high: tuple[float, float] | None = None
    zone: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)


def pads(robot: Drivable) -> list[Pad]:
    """Return the pads of a robot; the first ones have the keys that are nearest at hand."""
    dims = robot.dimensions
    names = [dim.name for dim in dims]
    for x, y, up in (("x", "y", False), ("vx", "vy", False), ("turn", "speed", True)):
        if x in names and y in names:
            return [_plane(robot, names.index(x), names.index(y), up)]
    mechanism = Body.of(robot.embodiment.id).mechanism if FAMILY.fullmatch(robot.embodiment.id) else None
    if isinstance(mechanism, Rails):
        return _rails(mechanism, dims)
    if isinstance(mechanism, Gantry):
        return [Pad(0, 1) if mechanism.upright else Pad(1, 0)]
    found = _shared([i for i, dim in enumerate(dims) if dim.kind != "switch"])
    return _arm(mechanism, found) if isinstance(mechanism, Arm) else found


def _plane(robot: Drivable, x: int, y: int, up: bool) -> Pad:
    flips = (False, up)
    dims = robot.dimensions[x], robot.dimensions[y]
    if dims[0].kind == "rate":
        return Pad(x, y, flips)
    side = PLANE_SIDES.get(robot.embodiment.id, float(SIZE))
    if robot.embodiment.id in PLANE_SIDES or FAMILY.fullmatch(robot.embodiment.id):
        return Pad(x, y, flips, (0.0, 0.0), (side, side))
    return Pad(x, y, flips, (dims[0].low, dims[1].low), (dims[0].high, dims[1].high))


def _rails(mechanism: Rails, dims: Sequence[Dimension]) -> list[Pad]:
    """Return a pad around each rail; of two upright ones the right one first, which has the arrow keys."""
    middles = (mechanism.places[1:] + mechanism.places[:-1]) / 2 / SIZE
    ends = np.array([0.0, *middles, 1.0]).round(4).tolist()
    found = []
    for number, (start, end) in enumerate(pairwise(ends)):
        low, high = ((0.0, 0.0), (float(SIZE),) * 2) if dims[number].kind == "target" else (None, None)
        if mechanism.upright:
            found.append(Pad(None, number, low=low, high=high, zone=(start, 0.0, end, 1.0)))
        else:
            found.append(Pad(number, None, low=low, high=high, zone=(0.0, start, 1.0, end)))
    return found[::-1] if mechanism.upright and len(found) == 2 else found


def _shared(values: Sequence[int]) -> list[Pad]:
    """Return pads side by side for values of which nobody knows where the image shows them."""
    pairs = [values[start : start + 2] for start in range(0, len(values), 2)][:MAX_SHARED_PADS]
    width = 1 / max(1, len(pairs))
    zones = [(n * width, 0.0, (n + 1) * width, 1.0) for n in range(len(pairs))]
    return [
        Pad(pair[0], pair[1] if len(pair) > 1 else None, (False, True), zone=zone)
        for pair, zone in zip(pairs, zones, strict=True)
    ]


def _arm(mechanism: Arm, found: list[Pad]) -> list[Pad]:
    """Return pads in which a drag moves the first link the way that it goes, if the arm stands at an edge."""
    if mechanism.axes[0].high > EDGE_TURN:
        return found  # it turns about: no way is its own
    first = found[0]
    across = -np.sin(mechanism.facing)
    along = np.cos(mechanism.facing)
    if abs(across) > abs(along):
        return [replace(first, flips=(bool(across < 0), first.flips[1])), *found[1:]]
    return [replace(first, x=first.y, y=first.x, flips=(False, bool(along < 0))), *found[1:]]


def driving_keys(robot: Drivable) -> list[list[str]]:
    """Return the keys of each value, as browsers name them: down and up, one for a switch, or none."""
    across, along = list(ACROSS), list(ALONG)
    found = [[" "] if dim.kind == "switch" else [] for dim in robot.dimensions]

    def turned(pair: tuple[str, str], flips: bool) -> list[str]:
        return list(pair[::-1] if flips else pair)

    for pad in pads(robot):
        if pad.x is not None and across:
            found[pad.x] = turned(across.pop(0), pad.flips[0])
        if pad.y is not None and along:
            found[pad.y] = turned(along.pop(0), not pad.flips[1])
    rest = [FURTHER]
    for number in range(max(len(across), len(along))):
        rest += [*across[number : number + 1], *along[number : number + 1]]
    for number, own in enumerate(found):
        if not own and rest:
            found[number] = list(rest.pop(0))
    return found


def hint(robot: Drivable) -> str:
    """Return what a drag on the image does, as a sentence without its full stop."""
    found = pads(robot)
    shown = labels(robot)
    if not found:
        return "Use the sliders"
    if found[0].low is not None:
        return "Drag on the image to move the target" + "s" * (len(found) > 1)
    if len(found) > 1:
        ordered = sorted(found, key=lambda pad: pad.zone)  # from left to right, else from above
        said = [" and ".join(shown[i] for i in (pad.x, pad.y) if i is not None) for pad in ordered]
        return f"Drag on the image, one area each: {', '.join(said)}"
    ways = (("sideways", found[0].x), ("up or down", found[0].y))
    return f"Drag on the image: {', '.join(f'{way} for {shown[i]}' for way, i in ways if i is not None)}"


def labels(robot: Drivable) -> list[str]:
    """Return a readable label of each value: its name in the YAML, else the end of its key and a number."""
    parts = robot.embodiment.action.components
    found = []
    ends = {part.key: part.key.rstrip("/").rpartition("/")[2] for part in parts}
    for part in parts:
        names = part.names
        if names is None:
            end = ends[part.key]
            if list(ends.values()).count(end) > 1:  # only whole keys tell these values apart
                end = part.key
            first = part.slice[0] if part.slice else 0
            alone = part.dims == 1 and not part.slice
            names = (end,) if alone else tuple(f"{end} {first + i}" for i in range(part.dims))
        found += [re.sub(r"[/_.\s]+", " ", name).strip() or name for name in names]
    return found


def describe(robot: Drivable) -> dict[str, Any]:
    """Return what the page shows of a robot, as plain values."""
    text = re.sub(r"^A made-up ", "", robot.embodiment.description)
    return {
        "key": robot.key,
        "id": robot.embodiment.id,
        "about": text[:1].upper() + text[1:],
        "source": robot.source,
        "hz": robot.embodiment.rate_hz,
        "stride": robot.embodiment.stride,
        "dimensions": [
            vars(dim) | {"label": label} for dim, label in zip(robot.dimensions, labels(robot), strict=True)
        ],
        "pads": [asdict(pad) for pad in pads(robot)],
        "keys": driving_keys(robot),
        "hint": hint(robot),
    }
