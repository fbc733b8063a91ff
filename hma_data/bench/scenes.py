"""Draw pictures that are as hard for a codec as real ones: textures at every scale, sensor noise, motion."""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.images import Images

NOISE = 2.0  # standard deviation of the sensor's noise, of 255
QUALITY = 92  # of JPEG; gives 0.20 to 0.28 bytes a pixel; photographs give 0.11 to 0.26


def scene(height: int, width: int, frames: int, seed: int) -> Iterator[Images]:
    """Yield (H, W, 3) pictures of a still camera; two textured things move in front of it."""
    draw = np.random.default_rng(seed)
    back = texture(draw, height, width)
    size = height // 3
    things = [texture(draw, size, size) for _ in range(2)]
    for i in range(frames):
        picture = back.copy()
        for n, thing in enumerate(things):
            phase = 2 * np.pi * (i / (60 + 25 * n) + 0.37 * n)
            y = int((height - size) * (0.5 + 0.45 * np.sin(phase)))
            x = int((width - size) * (0.5 + 0.45 * np.cos(0.7 * phase)))
            picture[y : y + size, x : x + size] = thing
        noise = draw.normal(scale=NOISE, size=(height, width, 1)).astype(np.float32)
        yield np.clip(picture + noise, 0, 255).astype(np.uint8)


def texture(draw: np.random.Generator, height: int, width: int) -> NDArray[np.float32]:
    """Return (height, width, 3) with power at every scale, less at finer scales, mostly of one hue."""
    total = np.zeros((height, width, 3), np.float32)
    cells, strength = 3, 60.0
    while cells < min(height, width):
        grey = draw.normal(size=(cells, cells, 1)) + 0.25 * draw.normal(size=(cells, cells, 3))
        coarse = (strength * grey).astype(np.float32)
        total += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        cells, strength = cells * 2, strength * 0.55
    return np.clip(total + np.array([138, 126, 112], np.float32), 0, 255)


def encoded(pictures: Iterator[Images], codec: str) -> list[bytes]:
    """Encode pictures as JPEG or PNG files."""
    options = [cv2.IMWRITE_JPEG_QUALITY, QUALITY] if codec == "jpeg" else []
    ending = ".jpg" if codec == "jpeg" else ".png"
    return [cv2.imencode(ending, picture[..., ::-1], options)[1].tobytes() for picture in pictures]
