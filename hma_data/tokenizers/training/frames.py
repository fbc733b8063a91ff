"""Read the images that tokenizers are measured on, and draw the crops that they are trained on.

Frames to measure on come from images, videos, recordings or a shard set's source. Training crops come
from the images and videos that a recipe lists: these are held in memory at a few sizes, and a crop is a
part of one image, scaled, rotated, mirrored and recoloured. It depends only on (seed, step, index in the
batch).

A film (n, S, S, 3) holds frames of one video, or of one camera in an episode, in order; a lone image is
a film of one. N crops, S side of a crop or of the square that the tokenizer takes. Images are uint8 RGB.
"""

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hma_data.arrays import Float32s, Images
from hma_data.episodes.images import Filter, prepare, resize
from hma_data.errors import EpisodeError, RecipeError, SourceError, TokenizerError
from hma_data.sources.common.survey import sampled
from hma_data.sources.common.video_file import VideoFile
from hma_data.storage.paths import StrPath, as_path, as_text
from hma_data.tokenizers.base import TokenizerSpec
from hma_data.tokenizers.training.recipe import DrawnSource, FileSource

if TYPE_CHECKING:
    from hma_data.registry.embodiment import Embodiment

Skip = Callable[[str], object]  # is told why a file or an episode is left out
VIDEOS = {".mp4", ".avi", ".mkv", ".webm", ".gif"}
PICTURES = {".png", ".jpg", ".jpeg", ".webp", ".bmp"}
EPISODES = 16  # number of episodes taken from a recording, evenly spaced
LARGEST, SMALLEST = 768, 48  # short side of the training images that are kept, pixels
SHARES, SHARE_ODDS = ((0.42, 0.6), (0.3, 1.0), (1.0, 1.0)), (0.45, 0.35, 0.2)  # of an image's short side


# -- frames to measure on


def films_of(
    data: StrPath,
    spec: TokenizerSpec,
    *,
    embodiment: "Embodiment | None" = None,
    frames: int = 64,
    on_skip: Skip = str,
) -> Iterator[Images]:
    """Return an iterator over films (n, S, S, 3) of a recording, a shard set's source, images or videos.

    With an embodiment, the data is a recording (a path or URI). Without one, it is a shard set, whose
    source is read, or an image, a video or a folder of them.

    Args:
        data: str or path of the data, or the URI of a recording.

    Raises:
        TokenizerError: nothing there can be measured.
        SourceError: the recording cannot be read.
    """
    from hma_data.shards.manifest import MANIFEST, Manifest

    path, uri = as_path(data), as_text(data)
    if embodiment is None and (path / MANIFEST).is_file():
        manifest = Manifest.load(path)
        embodiment, uri = manifest.embodiment, manifest.source
    if embodiment is not None:
        return recording_films(embodiment, uri, spec, frames=frames, on_skip=on_skip)
    size, resize_filter = spec.image_size, spec.resize_filter
    return read_films(path, size, frames=frames, resize_filter=resize_filter, on_skip=on_skip)


def read_films(
    path: StrPath,
    size: int,
    *,
    frames: int = 64,
    resize_filter: Filter = "area",
    on_skip: Skip = str,
) -> Iterator[Images]:
    """Yield a film (n, S, S, 3) of an image, a video, or every image and video below a folder.

    Args:
        path: str or path of the file or folder.
        frames: number of frames taken from each video, evenly spaced.
        on_skip: called with the reason for each file that cannot be decoded.

    Raises:
        TokenizerError: the path does not exist, holds no image and no video, or none can be decoded.
    """
    path = as_path(path)
    if not path.exists():
        raise TokenizerError(path, "no such file or folder")
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    found, skipped = False, ""
    for file in files:
        if file.suffix.lower() not in VIDEOS | PICTURES:
            continue
        try:
            pictures = read_pictures(file, frames)
            film = [resize(picture[None], size, "short_side_crop", resize_filter) for picture in pictures]
        except TokenizerError as fault:
            skipped = f": {fault.where}: {fault.fault}"
            on_skip(str(fault))
            continue
        if film:
            found = True
            yield np.concatenate(film)
    if not found:
        remedy = "name a file or folder of png, jpg, mp4; a recording needs --embodiment"
        raise TokenizerError(path, f"holds no image and no video that can be decoded{skipped}", remedy)


def read_pictures(path: Path, frames: int) -> Iterator[Images]:
    """Yield the image in a file, or `frames` evenly spaced frames of a video.

    Raises:
        TokenizerError: the file cannot be decoded.
    """
    import cv2

    if path.suffix.lower() not in VIDEOS:
        picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if picture is None:
            raise TokenizerError(path, "cannot be decoded as an image")
        yield np.ascontiguousarray(picture[:, :, ::-1])
        return
    try:
        video = VideoFile(path)
        for index in sampled(len(video), frames):
            yield video.frames([index])[0]
    except EpisodeError as fault:
        raise TokenizerError(path, fault.fault, fault.remedy) from fault


def recording_films(
    embodiment: "Embodiment",
    uri: StrPath,
    spec: TokenizerSpec,
    *,
    frames: int = 64,
    on_skip: Skip = str,
) -> Iterator[Images]:
    """Yield films (n, S, S, 3) of a recording as a conversion would tokenize it: every camera, by the YAML.

    Args:
        uri: str or path of the recording, or its URI.
        frames: number of frames taken from each of up to 16 episodes, evenly spaced.
        on_skip: called with the reason for each episode that cannot be read.

    Raises:
        SourceError: the recording cannot be read, or none of its episodes can be read.
    """
    from hma_data.sources.base import open_source

    source = open_source(embodiment.source.format)
    ids = [ref.id for ref in source.index(uri, embodiment)]
    read, fault = False, "it holds no episode"
    for index in sampled(len(ids), EPISODES):
        try:
            episode = source.read(uri, ids[index], embodiment)
            for camera in embodiment.cameras:
                stream = episode.streams[camera.name]
                drawn = (stream.frames([at]) for at in sampled(len(stream.timestamps), frames))
                film = [prepare(frame, camera, spec.image_size, spec.resize_filter) for frame in drawn]
                yield np.concatenate(film)
            read = True
        except (EpisodeError, SourceError) as problem:
            fault = str(problem)
            on_skip(fault)
    if not read:
        raise SourceError(as_text(uri), f"no frame could be read: {fault}")


# -- crops to train on


@dataclass
class Pool:
    """The images of one source, each at several sizes, largest first."""

    name: str
    weight: float
    pictures: list[list[Images]]


def _levels(picture: Images) -> list[Images]:
    """Return the image shrunk by area averaging to LARGEST, then to halves down to about 160 pixels."""
    import cv2

    levels, wanted = list[Images](), LARGEST
    while not levels or min(picture.shape[:2]) > 160:
        height, width = picture.shape[:2]
        scale = wanted / min(height, width)
        if scale < 1:
            size = round(width * scale), round(height * scale)
            picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
        levels.append(picture)
        wanted = min(picture.shape[:2]) // 2
    return levels


def load_pools(sources: Sequence[FileSource | DrawnSource], corpus: Path) -> tuple[list[Pool], str]:
    """Read all images of the sources into memory; return them and a SHA-256 of their pixels.

    Raises:
        RecipeError: a source has no image, or another number of drawn ones than the recipe says.
    """
    digest = hashlib.sha256()
    pools = []
    for source in sources:
        folder, pictures = corpus / source.path, []
        files = sorted({path for glob in source.glob for path in folder.glob(glob)})
        if isinstance(source, DrawnSource) and len(files) != source.pictures:
            fault = f"holds {len(files)} images, the recipe says {source.pictures}"
            raise RecipeError(folder, fault, f"recipes/tokenizer/draw.py {corpus} makes them")
        for file in files:
            with suppress(TokenizerError):  # a glob may match a file that is no image
                for picture in read_pictures(file, source.frames):
                    if min(picture.shape[:2]) >= SMALLEST:
                        pictures.append(_levels(picture))
                        digest.update(pictures[-1][-1].tobytes())
        if not pictures:
            fault = f"holds no image of {SMALLEST} pixels a side or more as {', '.join(source.glob)}"
            raise RecipeError(folder, fault, f"unpack {source.origin} there")
        pools.append(Pool(source.path, source.weight, pictures))
    return pools, digest.hexdigest()


def draw_batch(pools: list[Pool], side: int, count: int, seed: int, step: int) -> Float32s:
    """Return the crops of a training step, (N, S, S, 3) float32 in [-1, 1]; the arguments decide them."""
    weights = np.array([pool.weight for pool in pools])
    crops = np.empty((count, side, side, 3), np.float32)
    for index in range(count):
        rng = np.random.default_rng([seed, step, index])
        pool = pools[int(rng.choice(len(pools), p=weights / weights.sum()))]
        crop = _crop(pool.pictures[int(rng.integers(len(pool.pictures)))], side, rng)
        crops[index] = _recolour(crop, rng)
    return np.clip(crops, -1, 1, out=crops)


def _crop(levels: list[Images], side: int, rng: np.random.Generator) -> Images:
    """Cut a square out of the image, rotate and mirror it, and scale it to `side`."""
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


def _recolour(crop: Images, rng: np.random.Generator) -> Float32s:
    """Return the crop in [-1, 1] with changed brightness, contrast and colour, with blur and noise."""
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
