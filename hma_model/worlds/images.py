"""Read images to begin from: files, and the sample of a checkpoint; fit them to a model.

P images, H×W pixels, S pixels a side of the tokenizer's images, V views side by side.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hma_data.arrays import Float32s, Images
from hma_data.episodes.images import decode_image, resize
from hma_data.episodes.sheets import cell_scale, first_of_grid
from hma_data.errors import EpisodeError, HMAError, UsageError
from hma_data.loading.views import FIRST_CAMERA, Cameras
from hma_data.registry.components import Camera
from hma_data.registry.embodiment import Embodiment
from hma_data.storage.kinds import misplaced
from hma_data.storage.paths import StrPath, as_path
from hma_data.tokenizers.base import TokenizerSpec
from hma_model.checkpoint.folder import SAMPLE, Checkpoint
from hma_model.config import HMAConfig


class Prompt(NamedTuple):
    """The frames that a session starts from.

    Attributes:
        frames: images (P, H, W, 3) uint8, or tokens or latents as stored, at the rate of the model's frames.
        chunks: (P - 1, K) actions between them, NaN where they are unknown.
    """

    frames: NDArray[Any]
    chunks: Float32s


REMEDY = "give a PNG, a JPEG or another still image"


def read_image(path: StrPath, remedy: str = REMEDY) -> Images:
    """Return the image (H, W, 3) RGB of a file.

    Args:
        remedy: what the error says can be given.

    Raises:
        UsageError: it cannot be read, or is no image.
    """
    path = as_path(path)
    try:
        return decode_image(path.read_bytes(), str(path))
    except OSError as fault:
        text = "is a folder, not an image" if path.is_dir() else f"cannot be read: {fault.strerror}"
        raise UsageError(path, *(misplaced(path, "an image") or (text, remedy))) from fault
    except EpisodeError as fault:
        raise UsageError(path, *(misplaced(path, "an image") or ("is not an image", remedy))) from fault


def as_chunks(values: ArrayLike) -> Float32s:
    """Return the chunks that a caller gives as an array; raise HMAError if they are none of numbers."""
    try:
        return np.asarray(values, np.float32)
    except (TypeError, ValueError) as fault:
        raise HMAError("prompt", "its chunks are no array of numbers", "give rows of one length") from fault


def image_shape(config: HMAConfig) -> tuple[int, int, int]:
    """Return (S, V·S, 3) of a model's images."""
    size = config.spec.image_size
    return size, config.views * size, 3


def seen_cameras(cameras: Cameras, stored: Sequence[str]) -> list[str]:
    """Return the names of the V cameras that a model's image shows.

    Args:
        cameras: those that it was trained on, see `hma_data.loading.views`.
        stored: those that are there. Its first one stands for `first`, `drawn`, and names that are not there.
    """
    names = [cameras] if isinstance(cameras, str) else cameras
    return [name if name in stored else stored[0] for name in names]


def recorded_cameras(robot: Embodiment) -> list[str]:
    """Return the names of a robot's cameras, the primary one first."""
    primary = robot.primary_camera.name
    return [primary, *(camera.name for camera in robot.cameras if camera.name != primary)]


def fitted(
    images: NDArray[Any], config: HMAConfig, robot: Embodiment | None, cameras: Cameras = FIRST_CAMERA
) -> Images:
    """Return images (P, H, W, 3) uint8 as (P, S, V·S, 3), cropped and resized as in a conversion.

    They are upright and RGB already, so the camera's flip, rotation and colour order do not count. Its crop
    counts for images of the camera's size, or where that is not stated, for those that it fits in.

    Args:
        robot: whose images they are; None crops them to squares.
        cameras: that the model was trained on; they are of its camera if it sees only one.

    Raises:
        HMAError: they are no such images, or show several views in another size.
    """
    if images.ndim != 4 or images.shape[-1] != 3 or images.dtype != np.uint8 or not len(images):
        fault = f"frames are {images.dtype} of the shape {images.shape}"
        raise HMAError("prompt", fault, "give images (P, H, W, 3) uint8, or stored tokens")
    spec = config.spec
    shape = image_shape(config)
    if images.shape[1:] == shape:
        return images
    if config.views > 1:
        fault = f"images are {images.shape[2]}×{images.shape[1]}"
        raise HMAError("prompt", fault, f"give {config.views} views side by side, {shape[1]}×{shape[0]}")
    if robot is None:
        return resize(images, spec.image_size, resize_filter=spec.resize_filter)
    return fitted_view(images, spec, robot.camera(seen_cameras(cameras, recorded_cameras(robot))[0]))


def fitted_view(images: Images, spec: TokenizerSpec, camera: Camera) -> Images:
    """Return images (P, H, W, 3) of a camera as (P, S, S, 3); `fitted` says how."""
    size = images.shape[1:3]
    if size == (spec.image_size, spec.image_size):
        return images
    x, y, width, height = camera.crop or (0, 0, size[1], size[0])
    stated = camera.size and camera.size[:: -1 if camera.rotate in (90, 270) else 1]
    if stated in (None, size) and y + height <= size[0] and x + width <= size[1]:
        images = images[:, y : y + height, x : x + width]
    return resize(images, spec.image_size, camera.resize, spec.resize_filter)


def sample_image(checkpoint: Checkpoint, embodiment: str) -> Images | None:
    """Return the first true image (S, V·S, 3) of an embodiment's sample sheet; None without a sheet."""
    path = checkpoint.folder / "embodiments" / embodiment / SAMPLE
    if not path.is_file():
        return None
    side, views = image_shape(checkpoint.config)[0], checkpoint.config.views
    scale, every = cell_scale(side)
    cell = side * scale // every
    shown = first_of_grid(read_image(path), cell, views * cell)
    if shown is None:
        return None
    return np.concatenate([*resize(np.stack(np.split(shown, views, axis=1)), side)], axis=1)
