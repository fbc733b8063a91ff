"""Find what moves in frames: which pixels, in which part of an image, and how much of it a tokenizer keeps.

What moves may be few of the pixels, and is all that actions change. n frames, H×W pixels, uint8 RGB. A box is
[x, y, width, height] in pixels, as `crop` of a camera's YAML.
"""

import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from hma_data.arrays import Bools, Images, Ints
from hma_data.episodes.images import opencv
from hma_data.registry.components import Camera

Box = tuple[int, int, int, int]
MOVING_THRESHOLD = 24  # of 255: by more a channel of a moving pixel differs
LONG_SIDE = 320  # pixels of the images in which the moving part is searched
STRAYS = 0.002  # share of the moving pixels that may lie beyond each side of the box: noise
FEWEST = 8  # moving pixels of such an image, below which there is no moving part
MARGIN = 0.2  # of the box's longer side, added on each side of a crop
SMALL = 0.6  # a crop of at most this share of the side that is seen is worth it
ALL = 0.9  # share of both sides from which a box says nothing about a robot
CUT_OFF = 0.05  # share of the moving part that may lie beyond what is seen
NARROWEST = 48  # pixels: least side of a proposed crop
LOST_SHARE = 0.5  # the robot is lost where decoded frames show less than this share of the change


def moving(film: Images) -> Bools:
    """Return which pixels of (n, H, W, 3) frames move, (n, H, W): unlike the frame before or after."""
    masks = np.zeros(film.shape[:3], np.bool_)
    changed = np.abs(np.diff(film.astype(np.int16), axis=0)).max(axis=-1) > MOVING_THRESHOLD
    masks[1:] |= changed
    masks[:-1] |= changed
    return masks


# -- where it moves


class MovingPart:
    """The part of a camera's images that changes: where the robot and what it moves are seen.

    Images of several episodes belong together: objects and goals lie elsewhere in each.

    Attributes:
        size: (height, width) of the images.
    """

    def __init__(self) -> None:
        self.size = (0, 0)
        self._low: Images | None = None
        self._high: Images | None = None

    def add(self, frames: Images) -> None:
        """Add images (n, H, W, 3)."""
        cv2 = opencv()
        height, width = frames.shape[1:3]
        if (height, width) != self.size:  # images of several sizes cannot be compared
            self.size, self._low, self._high = (height, width), None, None
        scale = min(1.0, LONG_SIDE / max(height, width))
        shape = max(1, round(width * scale)), max(1, round(height * scale))
        for frame in frames:
            small = cv2.resize(np.ascontiguousarray(frame), shape, interpolation=cv2.INTER_AREA)
            small = cv2.blur(small, (3, 3))  # the noise of a sensor or codec does not move
            self._low = small if self._low is None else np.minimum(self._low, small)
            self._high = small if self._high is None else np.maximum(self._high, small)

    @property
    def box(self) -> Box | None:
        """Return the box that holds what moves; None where nothing does."""
        if self._low is None or self._high is None:
            return None
        moved = (self._high - self._low).max(axis=-1) > MOVING_THRESHOLD
        if moved.sum() < FEWEST:
            return None
        left, right = _ends(moved.sum(axis=0))
        top, bottom = _ends(moved.sum(axis=1))
        scale = self.size[1] / moved.shape[1]
        x, y = int(left * scale), int(top * scale)
        wide = min(math.ceil(right * scale), self.size[1]) - x
        tall = min(math.ceil(bottom * scale), self.size[0]) - y
        return x, y, wide, tall


def _ends(counts: Ints) -> tuple[int, int]:
    """Return the first place that counts and the one after the last, without the strays."""
    share = np.cumsum(counts) / counts.sum()
    return int(np.searchsorted(share, STRAYS, "right")), int(np.searchsorted(share, 1 - STRAYS)) + 1


@dataclass(frozen=True)
class Framing:
    """What is wrong with the part of a camera's images that a tokenizer sees, and the keys that mend it."""

    fault: str
    keys: dict[str, Any]
    cut_off: bool

    @property
    def words(self) -> str:
        """Return the keys as a YAML has them."""
        return ", ".join(f"{key}: {json.dumps(value)}" for key, value in self.keys.items())


def seen_box(camera: Camera, height: int, width: int) -> Box:
    """Return the part of an upright image (after flip and rotate) that the tokenizer sees."""
    x, y, width, height = camera.crop or (0, 0, width, height)
    if camera.resize == "short_side_crop":
        side = min(width, height)
        x, y, width, height = x + (width - side) // 2, y + (height - side) // 2, side, side
    return x, y, width, height


def framing(camera: Camera, box: Box | None, height: int, width: int) -> Framing | None:
    """Return what is wrong with the part of its images that a tokenizer sees of a camera; None if nothing.

    Args:
        box: holds what moves, in the upright image.
        height, width: of the upright image in pixels.
    """
    if box is None:
        return None
    x, y, wide, tall = box
    if wide > ALL * width and tall > ALL * height:  # the camera moves, or the light changes
        return None
    left, top, shown_wide, shown_tall = seen_box(camera, height, width)
    inside_wide = max(min(x + wide, left + shown_wide) - max(x, left), 0)
    inside_tall = max(min(y + tall, top + shown_tall) - max(y, top), 0)
    outside = 1 - inside_wide * inside_tall / (wide * tall)
    side = max(round(max(wide, tall) * (1 + 2 * MARGIN)), NARROWEST)
    cut_off = outside > CUT_OFF
    fault = f"the moving region is {wide}×{tall} of {width}×{height} pixels"
    if cut_off:
        how = "crop" if camera.crop else f"resize: {camera.resize}"
        fault += f", and {how} cuts off {outside:.0%} of that"
    elif side <= SMALL * min(shown_wide, shown_tall):
        fault += f", {wide * tall / (shown_wide * shown_tall):.1%} of what the tokenizer sees"
    else:
        return None
    short = min(height, width)
    if max(wide, tall) > short:
        whole: dict[str, Any] = {"crop": None} if camera.crop else {}
        return Framing(fault, whole | {"resize": "letterbox"}, cut_off)
    side = min(side, short)
    crop = [
        min(max(x + (wide - side) // 2, 0), width - side),
        min(max(y + (tall - side) // 2, 0), height - side),
        side,
        side,
    ]
    return Framing(fault, {"crop": crop}, cut_off)


# -- what a tokenizer keeps of it


def bounded_psnr_db(error: float) -> float:
    """Return the peak signal-to-noise ratio of a mean square error of uint8, at most 99 dB."""
    return min(10 * math.log10(255.0**2 / error), 99.0) if error else 99.0


@dataclass
class Kept:
    """How much of what moves in recorded frames is in the frames decoded from their tokens.

    Attributes:
        pixels, moved: of all recorded frames together, and those that move (see `moving`).
        error: summed square error of the moving pixels, over three channels.
        change, missed: summed squares, where the recorded frames change from one to the next, of that change,
            and of its difference from the change in the decoded frames.
    """

    pixels: int = 0
    moved: int = 0
    error: float = 0.0
    change: float = 0.0
    missed: float = 0.0

    def add(self, recorded: Images, decoded: Images) -> None:
        """Add frames (n, S, S, 3) of one episode that follow one another."""
        masks = moving(recorded)
        self.pixels, self.moved = self.pixels + masks.size, self.moved + int(masks.sum())
        self.error += float(np.square(recorded[masks].astype(np.float64) - decoded[masks]).sum())
        steps, made = (np.diff(film.astype(np.float64), axis=0) for film in (recorded, decoded))
        changed = np.abs(steps).max(axis=-1) > MOVING_THRESHOLD
        self.change += float(np.square(steps[changed]).sum())
        self.missed += float(np.square(steps[changed] - made[changed]).sum())

    @property
    def psnr_db(self) -> float:
        """Return the peak signal-to-noise ratio of the pixels that move, at most 99."""
        return bounded_psnr_db(self.error / (3 * max(self.moved, 1)))

    @property
    def share(self) -> float:
        """Return the share of the pixels that move."""
        return self.moved / max(self.pixels, 1)

    @property
    def change_shown(self) -> float:
        """Return the share of the recorded change that decoded frames show; 0 where they show another."""
        return max(0.0, 1 - self.missed / self.change) if self.change else 1.0

    @property
    def lost(self) -> bool:
        """Check whether the decoded frames show too little of what moves for a model to see it."""
        return self.change_shown < LOST_SHARE

    def __str__(self) -> str:
        if not self.moved:
            return "nothing moves in the sampled frames"
        share = format(100 * self.share, ".2g" if self.share < 0.1 else ".0f")
        return (
            f"moving pixels ({share} % of the image) are decoded at {self.psnr_db:.1f} dB: "
            f"decoded frames show {self.change_shown:.0%} of the recorded change"
        )
