"""Draw training crops for a tokenizer from the pictures and videos that a recipe lists.

Pictures are held as uint8 RGB at a few sizes. A training crop is a part of one picture: scaled,
rotated, mirrored and recoloured. A crop depends only on (seed, step, index in the batch).

N crops, S side of a crop.
"""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hma_data.errors import RecipeError
from hma_data.tokenizers.training.frames import read_pictures
from hma_data.tokenizers.training.recipe import DrawnSource, FileSource

Picture = NDArray[np.uint8]
LARGEST, SMALLEST = 768, 48  # short side of the pictures that are kept, pixels
SHARES, SHARE_ODDS = ((0.42, 0.6), (0.3, 1.0), (1.0, 1.0)), (0.45, 0.35, 0.2)  # of a picture's short side


@dataclass
class Pool:
    """The pictures of one source, each at several sizes, largest first."""

    name: str
    weight: float
    pictures: list[list[Picture]]


def shrink(picture: Picture, short_side: int) -> Picture:
    """Return the picture shrunk by area averaging to at most that short side."""
    import cv2

    height, width = picture.shape[:2]
    scale = short_side / min(height, width)
    if scale >= 1:
        return picture
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def _levels(picture: Picture) -> list[Picture]:
    levels = [shrink(picture, LARGEST)]
    while min(levels[-1].shape[:2]) > 160:
        levels.append(shrink(levels[-1], min(levels[-1].shape[:2]) // 2))
    return levels


def _source_files(source: FileSource | DrawnSource, corpus: Path) -> list[Path]:
    folder = corpus / source.path
    files = sorted({path for glob in source.glob for path in folder.glob(glob)})
    if isinstance(source, DrawnSource):
        if len(files) != source.pictures:
            raise RecipeError(
                folder,
                f"holds {len(files)} pictures, the recipe says {source.pictures}",
                f"recipes/tokenizer/draw.py {corpus} makes them",
            )
    elif not files:
        raise RecipeError(
            folder, f"no file matches {', '.join(source.glob)}", f"unpack {source.origin} there"
        )
    return files


def load_pools(sources: Sequence[FileSource | DrawnSource], corpus: Path) -> tuple[list[Pool], str]:
    """Read all pictures of the sources into memory; return them and a SHA-256 of their pixels.

    Raises:
        RecipeError: a source has no picture.
    """
    digest = hashlib.sha256()
    pools = []
    for source in sources:
        pictures = []
        for file in _source_files(source, corpus):
            for picture in read_pictures(file, source.frames):
                if min(picture.shape[:2]) >= SMALLEST:
                    pictures.append(_levels(picture))
                    digest.update(pictures[-1][-1].tobytes())
        if not pictures:
            raise RecipeError(corpus / source.path, "holds no readable picture")
        pools.append(Pool(source.path, source.weight, pictures))
    return pools, digest.hexdigest()


def draw_batch(pools: list[Pool], side: int, count: int, seed: int, step: int) -> NDArray[np.float32]:
    """Return the crops of a training step, (N, S, S, 3) float32 in [-1, 1].

    The same arguments always give the same crops.
    """
    weights = np.array([pool.weight for pool in pools])
    crops = np.empty((count, side, side, 3), np.float32)
    for index in range(count):
        rng = np.random.default_rng([seed, step, index])
        pool = pools[int(rng.choice(len(pools), p=weights / weights.sum()))]
        crop = _crop(pool.pictures[int(rng.integers(len(pool.pictures)))], side, rng)
        crops[index] = _recolour(crop, rng)
    return np.clip(crops, -1, 1, out=crops)


def _crop(levels: list[Picture], side: int, rng: np.random.Generator) -> Picture:
    """Cut a square out of the picture, rotate and mirror it, and scale it to `side`."""
    import cv2

    short = min(levels[0].shape[:2])
    # A crop of 128 covers half the side of a frame at 256², and the whole side of a frame at 128².
    low, high = SHARES[int(rng.choice(len(SHARES), p=SHARE_ODDS))]
    share = math.exp(rng.uniform(math.log(low), math.log(high)))
    wanted = max(short * share, side / 3)
    level = max((n for n, p in enumerate(levels) if min(p.shape[:2]) * share >= side), default=0)
    picture = levels[level]
    height, width = picture.shape[:2]
    scale = min(height, width) / short
    span = min(wanted * scale, min(height, width))
    angle = rng.normal(0, 0.12) + (math.pi / 2) * rng.integers(0, 4) * (rng.random() < 0.3)
    x = rng.uniform(span / 2, width - span / 2) if width > span else width / 2
    y = rng.uniform(span / 2, height - span / 2) if height > span else height / 2
    stretch = math.exp(rng.normal(0, 0.08))
    flip = -1.0 if rng.random() < 0.5 else 1.0
    zoom = span / side
    cos, sin = math.cos(angle) * zoom, math.sin(angle) * zoom
    back = np.array([[cos * flip * stretch, -sin / stretch], [sin * flip * stretch, cos / stretch]])
    centre = np.array([x, y]) - back @ np.array([(side - 1) / 2, (side - 1) / 2])
    matrix = np.hstack([back, centre[:, None]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    crop = cv2.warpAffine(picture, matrix, (side, side), flags=flags, borderMode=cv2.BORDER_REFLECT_101)
    return np.asarray(crop, np.uint8)


def _recolour(crop: Picture, rng: np.random.Generator) -> NDArray[np.float32]:
    """Change brightness, contrast, gamma, saturation and colour cast, and add blur and noise.

    Returns:
        float32 in [-1, 1].
    """
    import cv2

    x = crop.astype(np.float32) / 255.0
    if rng.random() < 0.15:
        x = cv2.GaussianBlur(x, (0, 0), rng.uniform(0.4, 1.4))
    if rng.random() < 0.5:
        x = x ** np.float32(math.exp(rng.normal(0, 0.2)))
        grey = x.mean(axis=2, keepdims=True)
        x = grey + (x - grey) * np.float32(math.exp(rng.normal(-0.1, 0.3)))
        cast = np.exp(rng.normal(0, 0.06, 3)).astype(np.float32)
        x = (x - 0.5) * np.float32(math.exp(rng.normal(0, 0.15))) * cast + np.float32(
            0.5 + rng.normal(0, 0.06)
        )
    if rng.random() < 0.06:
        x = x[:, :, rng.permutation(3)]
    if rng.random() < 0.05:
        x = x + rng.normal(0, rng.uniform(0.004, 0.02), x.shape).astype(np.float32)
    return np.clip(x, 0, 1) * np.float32(2) - np.float32(1)
