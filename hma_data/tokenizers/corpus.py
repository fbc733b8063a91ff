"""Pictures to train a tokenizer on, out of packages and simulators anyone can install.

A recipe lists sources: folders of pictures and videos (each said with the package it is from),
renderings of gym-pusht, and drawn scenes. They are held as uint8 RGB at a few sizes; a training
crop is one of them, scaled, turned, mirrored and recoloured. A crop is decided by (seed, step,
index in the batch) alone.

N crops, S side of a crop.
"""

import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from hma_data.errors import RecipeError

Picture = NDArray[np.uint8]
VIDEOS = {".mp4", ".avi", ".mkv", ".webm", ".gif"}
LARGEST, SMALLEST = 768, 48  # short side of what is kept, pixels
SHARES, SHARE_ODDS = ((0.42, 0.6), (0.3, 1.0), (1.0, 1.0)), (0.45, 0.35, 0.2)  # of a picture's short side


class FileSource(BaseModel):
    """Pictures and videos under a folder of the corpus.

    Attributes:
        path: folder below the recipe's `corpus`.
        glob: which files.
        origin: the package and version they come from.
        weight: how often a crop is from this source, relative to the others.
        frames: taken from each video, evenly.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    kind: Literal["files"]
    path: str
    glob: list[str]
    origin: str
    weight: float = Field(gt=0, default=1.0)
    frames: int = Field(gt=0, default=40)


class PushtSource(BaseModel):
    """Renderings of gym-pusht under random actions."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    kind: Literal["pusht"]
    pictures: int = Field(gt=0, default=200)
    weight: float = Field(gt=0, default=1.0)


class DrawnSource(BaseModel):
    """Scenes drawn from polygons, discs, lines and smooth noise."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    kind: Literal["drawn"]
    pictures: int = Field(gt=0, default=200)
    weight: float = Field(gt=0, default=1.0)


Source = FileSource | PushtSource | DrawnSource


def read_pictures(path: Path, frames: int) -> Iterator[Picture]:
    """The picture in a file, or `frames` evenly taken from a video; nothing where neither is."""
    import cv2

    if path.suffix.lower() in VIDEOS:
        yield from _read_video(path, frames)
        return
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is not None:
        yield np.ascontiguousarray(picture[:, :, ::-1])


def _read_video(path: Path, frames: int) -> Iterator[Picture]:
    import av

    with av.open(str(path)) as container:
        count = sum(1 for _ in container.decode(video=0))
    wanted = set(np.linspace(0, count - 1, min(frames, count)).astype(int).tolist())
    with av.open(str(path)) as container:
        for index, frame in enumerate(container.decode(video=0)):
            if index in wanted:
                yield frame.to_ndarray(format="rgb24")


def shrink(picture: Picture, short_side: int) -> Picture:
    """The picture with at most that short side, by area averaging."""
    import cv2

    height, width = picture.shape[:2]
    scale = short_side / min(height, width)
    if scale >= 1:
        return picture
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def push_pictures(count: int, seed: int) -> Iterator[Picture]:
    """Frames of gym-pusht, 256×256, the agent wandering towards random points."""
    import gym_pusht  # noqa: F401  registers the environment
    import gymnasium

    rng = np.random.default_rng([seed, 1])
    env = gymnasium.make(
        "gym_pusht/PushT-v0",
        obs_type="state",
        render_mode="rgb_array",
        max_episode_steps=40,
        observation_width=256,
        observation_height=256,
    )
    made = 0
    while made < count:
        env.reset(seed=int(rng.integers(2**31)))
        goal = rng.uniform(50, 460, 2)
        for step in range(24):
            if step % 6 == 0:
                goal = rng.uniform(50, 460, 2)
            env.step(goal.astype(np.float32))
            if step % 6 == 5 and made < count:
                whole = bool(rng.random() < 0.5)  # at 680 pixels with the target of the action, or at 256
                yield np.asarray(env.unwrapped._render(visualize=whole), np.uint8)
                made += 1
    env.close()


def draw_scene(rng: np.random.Generator, size: int = 384) -> Picture:
    """A scene of smooth and sharp parts: gradients, noise of several scales, shapes, bars."""
    import cv2

    def colour() -> tuple[float, float, float]:
        grey = rng.uniform(0, 255)
        spread = rng.choice([8.0, 40.0, 120.0])
        r, g, b = np.clip(grey + rng.normal(0, spread, 3), 0, 255)
        return float(r), float(g), float(b)

    corners = np.array([[colour(), colour()], [colour(), colour()]], np.float32)
    canvas = cv2.resize(corners, (size, size), interpolation=cv2.INTER_LINEAR)
    for grain in (4, 16, 64, 192):
        if rng.random() < 0.35:
            noise = rng.normal(0, rng.uniform(2, 25), (grain, grain, 1)).astype(np.float32)
            canvas = canvas + cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC)[:, :, None]
    canvas = np.ascontiguousarray(np.clip(canvas, 0, 255).astype(np.uint8))
    for _ in range(int(rng.integers(3, 28))):
        _draw_shape(canvas, rng, colour())
    if rng.random() < 0.3:
        canvas = np.asarray(cv2.GaussianBlur(canvas, (0, 0), rng.uniform(0.5, 2.0)), np.uint8)
    return canvas


def _draw_shape(canvas: Picture, rng: np.random.Generator, colour: tuple[float, float, float]) -> None:
    import cv2

    size = canvas.shape[0]
    x, y = (int(v) for v in rng.integers(0, size, 2))
    reach = int(math.exp(rng.uniform(math.log(5), math.log(size / 2.5))))
    kind = rng.integers(0, 4)
    if kind == 0:
        points = rng.integers(-reach, reach, (int(rng.integers(3, 7)), 2)) + np.array([x, y])
        cv2.fillPoly(canvas, [np.asarray(points, np.int32)], colour, cv2.LINE_AA)
    elif kind == 1:
        axes = (max(2, reach // 2), max(2, int(reach * rng.uniform(0.15, 0.5))))
        cv2.ellipse(canvas, (x, y), axes, rng.uniform(0, 180), 0, 360, colour, -1, cv2.LINE_AA)
    elif kind == 2:
        other = rng.integers(-2 * reach, 2 * reach, 2) + np.array([x, y])
        thick = int(rng.integers(1, max(2, reach // 4) + 1))
        cv2.line(canvas, (x, y), (int(other[0]), int(other[1])), colour, min(thick, 60), cv2.LINE_AA)
    else:
        box = cv2.boxPoints(((x, y), (reach, reach * rng.uniform(0.2, 1.0)), rng.uniform(0, 90)))
        cv2.fillPoly(canvas, [np.asarray(box, np.int32)], colour, cv2.LINE_AA)


@dataclass
class Pool:
    """The pictures of one source, each at several sizes, largest first."""

    name: str
    weight: float
    pictures: list[list[Picture]]


def _levels(picture: Picture) -> list[Picture]:
    levels = [shrink(picture, LARGEST)]
    while min(levels[-1].shape[:2]) > 160:
        levels.append(shrink(levels[-1], min(levels[-1].shape[:2]) // 2))
    return levels


def _source_pictures(source: Source, corpus: Path, seed: int) -> Iterator[Picture]:
    if isinstance(source, PushtSource):
        yield from push_pictures(source.pictures, seed)
    elif isinstance(source, DrawnSource):
        rng = np.random.default_rng([seed, 2])
        for _ in range(source.pictures):
            yield draw_scene(rng)
    else:
        folder = corpus / source.path
        files = sorted({path for glob in source.glob for path in folder.glob(glob)})
        if not files:
            raise RecipeError(
                folder, f"no file matches {', '.join(source.glob)}", f"unpack {source.origin} there"
            )
        for file in files:
            yield from read_pictures(file, source.frames)


def load_pools(sources: list[Source], corpus: Path, seed: int) -> tuple[list[Pool], str]:
    """Everything the sources hold, in memory, and a digest of the pixels.

    Raises:
        RecipeError: a source has no picture.
    """
    digest = hashlib.sha256()
    pools = []
    for source in sources:
        name = source.path if isinstance(source, FileSource) else source.kind
        pictures = []
        for picture in _source_pictures(source, corpus, seed):
            if min(picture.shape[:2]) >= SMALLEST:
                pictures.append(_levels(picture))
                digest.update(pictures[-1][-1].tobytes())
        if not pictures:
            raise RecipeError(corpus / name, "holds no readable picture")
        pools.append(Pool(name, source.weight, pictures))
    return pools, digest.hexdigest()


def draw_batch(pools: list[Pool], side: int, count: int, seed: int, step: int) -> NDArray[np.float32]:
    """(N, S, S, 3) float32 in [-1, 1]: the crops of a training step, the same whenever asked for."""
    weights = np.array([pool.weight for pool in pools])
    crops = np.empty((count, side, side, 3), np.float32)
    for index in range(count):
        rng = np.random.default_rng([seed, step, index])
        pool = pools[int(rng.choice(len(pools), p=weights / weights.sum()))]
        crop = _crop(pool.pictures[int(rng.integers(len(pool.pictures)))], side, rng)
        crops[index] = _recolour(crop, rng)
    return np.clip(crops, -1, 1, out=crops)


def _crop(levels: list[Picture], side: int, rng: np.random.Generator) -> Picture:
    """A square of the picture, turned and mirrored, brought to `side`."""
    import cv2

    short = min(levels[0].shape[:2])
    # A crop of 128 holds half a side of a frame at 256², and the whole side of one at 128².
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
    """Brightness, contrast, gamma, saturation, colour cast, blur and noise; float32 in about [-1, 1]."""
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
