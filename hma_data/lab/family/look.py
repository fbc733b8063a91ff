"""Draw the frames of the family's robots: colours, backgrounds, shapes and blocks.

Lengths are pixels of the SIZE × SIZE frame with y downward; colours are RGB. Frames are drawn at twice
the size and shrunk.
"""

import colorsys
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hma_data.arrays import Floats, Images

Color = tuple[int, int, int]

SIZE, SCALE, SHIFT = 128, 2, 4  # of the frame; of the drawing; its coordinates' fractional bits
DARK: Color = (35, 35, 42)
LIGHT: Color = (240, 240, 235)
BACKGROUNDS = ("plain", "two-tone", "gradient", "tiles")


class Shape(NamedTuple):
    """A part of a robot: a disc round one point, a capsule between two, or a convex polygon of more."""

    points: Floats  # (N, 2)
    radius: float  # half the width; of a polygon, the radius of the disc that pushes for it
    color: Color
    pushes: bool = False  # whether it pushes blocks out of its way


class Block(NamedTuple):
    """A loose block; for pushing it is a disc."""

    form: str  # disc, box or tee
    radius: float
    angle: float
    color: Color


def contrast(one: Color, other: Color) -> float:
    """Return the distance of two colours, weighted as the eye does; 255 between black and white."""
    difference = np.subtract(one, other, dtype=np.float64)
    return float(np.sqrt((2, 4, 3) @ difference**2) / 3)


def vivid(rng: np.random.Generator, against: Sequence[Color], chosen: Sequence[Color] = ()) -> Color:
    """Draw a saturated colour that contrasts with the background's and differs from those chosen."""
    best, color = -999.0, DARK
    for _ in range(120):
        red, green, blue = colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.75, 1.0), rng.uniform(0.35, 1.0))
        candidate = (round(255 * red), round(255 * green), round(255 * blue))
        margin = min(contrast(candidate, seen) for seen in against) - 95
        apart = min((contrast(candidate, seen) for seen in chosen), default=999.0) - 70
        if min(margin, apart, 0.0) > best:
            best, color = min(margin, apart, 0.0), candidate
        if best >= 0:
            break
    return color


def background(rng: np.random.Generator) -> tuple[Images, tuple[Color, Color]]:
    """Draw a background at the drawing's size, and return it with its two extreme colours."""
    hue, dark = rng.random(), rng.random() < 0.25
    saturation = rng.uniform(0.2, 0.5) if dark else rng.uniform(0.03, 0.3)
    value = rng.uniform(0.10, 0.22) if dark else rng.uniform(0.84, 0.97)
    step = 0.1 if dark else -0.12
    tones = [colorsys.hsv_to_rgb(hue, saturation, value + more) for more in (0.0, step)]
    first, second = (np.rint(255 * np.array(tone)) for tone in tones)
    side = SIZE * SCALE
    y, x = np.mgrid[:side, :side] / side
    across = x if rng.random() < 0.5 else y
    kind, edge, tiles = rng.choice(BACKGROUNDS), rng.uniform(0.35, 0.65), int(rng.choice((4, 6, 8)))
    mix = {
        "plain": np.zeros_like(x),
        "two-tone": (across > edge).astype(np.float64),
        "gradient": across,
        "tiles": (np.floor(x * tiles) + np.floor(y * tiles)) % 2,
    }[str(kind)]
    image = first + mix[..., None] * (second - first)
    extremes = [(int(r), int(g), int(b)) for r, g, b in (first, second)]
    return np.rint(image).astype(np.uint8), (extremes[0], extremes[1])


def draw(image: Images, shapes: Iterable[Shape]) -> None:
    """Draw shapes into an image at the drawing's size, the first lowest."""
    for points, radius, color, _ in shapes:
        fixed = _fixed(points)
        if len(points) == 1:
            cv2.circle(image, fixed[0], round(radius * SCALE * 2**SHIFT), color, -1, cv2.LINE_AA, SHIFT)
        elif len(points) == 2:
            width = max(1, round(2 * radius * SCALE))
            cv2.line(image, fixed[0], fixed[1], color, width, cv2.LINE_AA, SHIFT)
        else:
            cv2.fillConvexPoly(image, fixed, color, cv2.LINE_AA, SHIFT)


def block_shapes(block: Block, place: Floats) -> list[Shape]:
    """Return the shapes of a block whose centre is at a point (2,)."""
    r = block.radius
    if block.form == "disc":
        return [Shape(place[None], r, block.color)]
    if block.form == "box":
        return [Shape(box(place, block.angle, r * 0.9, r * 0.9), r, block.color)]
    along = direction(block.angle)
    bar, stem = (
        box(place - along * r * 0.5, block.angle, r * 0.45, r),
        box(place + along * r * 0.3, block.angle, r * 0.7, r * 0.45),
    )
    return [Shape(part, r, block.color) for part in (bar, stem)]


def direction(angle: Any) -> Floats:
    """Return the unit vectors (..., 2) at angles (...,)."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def wrapped(angle: Any) -> Any:
    """Return angles within ±π."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def box(place: Floats, angle: float, length: float, width: float) -> Floats:
    """Return the (4, 2) corners of a box from half its length along an angle, and half its width."""
    along = direction(angle)
    side = np.array([-along[1], along[0]])
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    corners: Floats = place + signs @ np.stack([along * length, side * width])
    return corners


def shrunk(image: Images) -> Images:
    """Return a drawing as a frame (SIZE, SIZE, 3)."""
    small: Images = cv2.resize(image, (SIZE, SIZE), interpolation=cv2.INTER_AREA).astype(np.uint8)
    return small


def _fixed(points: Floats) -> NDArray[np.int32]:
    """Convert coordinates to the drawing's, in OpenCV's fixed point; pixel centres are whole there."""
    return np.rint((points * SCALE - 0.5) * 2**SHIFT).astype(np.int32)
