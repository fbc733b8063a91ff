"""Tell which HDF5 datasets hold images, and convert their rows to RGB.

T frames of an episode, n of them asked for, H×W pixels, C channels.
"""

from collections.abc import Sequence
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from hma_data.arrays import Array, Floats, Images, Indices
from hma_data.episodes.episode import stacked
from hma_data.episodes.images import decode_image
from hma_data.errors import EpisodeError
from hma_data.registry.components import Hdf5Layout
from hma_data.sources.hdf5.file import EpisodeFinder, EpisodeGroup, dataset, explained, rows

PIXELS = {"0-1": 1.0, "0-255": 255.0, "0-65535": 65535.0}
LEAST_SIDE = 16  # pixels: a smaller array of other numbers than uint8 is not taken for images
CHANNELS = (1, 3, 4)
_SLACK = 1e-3  # share of the range by which values may exceed it, as resizing can cause


def image_kind(found: h5py.Dataset, layout: Hdf5Layout | None = None) -> str | None:
    """Return `raw` or `encoded` by dtype and shape; None where the dataset cannot hold images."""
    shape: tuple[int, ...] = found.shape or ()
    if 0 in shape[1:]:
        return None
    if found.dtype == np.uint8 or (layout and layout.pixels and found.dtype.kind in "fiu"):
        channels_first = layout.axes == "TCHW" if layout and layout.axes else shape[1:2] in ((1,), (3,))
        if len(shape) == 3 or (len(shape) == 4 and (shape[3] in CHANNELS or channels_first)):
            return "raw"
    padded = found.dtype == np.uint8 and len(shape) == 2
    one_a_row = len(shape) == 1 and (found.dtype.kind in "SV" or _is_bytes(found.dtype))
    return "encoded" if padded or one_a_row else None


def pixels_of(found: h5py.Dataset, indices: Sequence[int]) -> str:
    """Return the range of colours that are stored as other numbers than uint8: one of PIXELS.

    The result is empty where the dataset cannot hold colours (T, H, W, 3) or (T, 3, H, W), by its shape and
    by the values of some rows.
    """
    shape: tuple[int, ...] = found.shape or ()
    if found.dtype.kind not in "fiu" or found.dtype == np.uint8 or len(shape) != 4 or not len(indices):
        return ""
    sides = shape[1:3] if shape[3] == 3 else shape[2:] if shape[1] == 3 else (0,)
    if min(sides) < LEAST_SIDE:
        return ""
    shown = (rows(found, [index]) for index in indices)  # one by one: a row may claim gigabytes
    ends = np.array([(image.min(), image.max()) for image in shown], np.float64)
    low, high = float(ends.min()), float(ends.max())
    if not 0 <= low < high:  # false for NaN too
        return ""
    whole = found.dtype.kind != "f"
    return next((name for name, most in PIXELS.items() if high <= most and not (whole and most == 1)), "")


def as_rgb(images: Images, axes: str) -> Images:
    """Convert (n, H, W), (n, H, W, 1|3|4) or (n, 1|3|4, H, W) to (n, H, W, 3); see `axes_of`."""
    if axes == "THW":
        images = images[..., None]
    elif axes == "TCHW":
        images = images.transpose(0, 2, 3, 1)
    if images.shape[3] == 1:
        images = np.repeat(images, 3, axis=3)
    return np.ascontiguousarray(images[..., :3])


def encoded(row: Any) -> NDArray[np.uint8]:
    """Return the bytes of one encoded image, a row of bytes; zeros after its end do no harm."""
    if isinstance(row, np.ndarray):
        return row.view(np.uint8).reshape(-1)
    return np.frombuffer(row.tobytes() if isinstance(row, np.void) else row, np.uint8)


def axes_of(shape: tuple[int, ...], layout: Hdf5Layout, where: str) -> str:
    """Return THW, THWC or TCHW: from the YAML, else by the axis whose size is a number of channels."""
    if len(shape) == 3:
        return "THW"
    last, first = shape[3] in CHANNELS, shape[1] in CHANNELS
    if layout.axes:
        if not (first if layout.axes == "TCHW" else last):
            fault = f"holds images {shape[1:]}, source.layout.axes says {layout.axes}"
            raise EpisodeError(where, fault, "correct source.layout.axes in the YAML")
        return layout.axes
    if last and first:
        fault = f"holds images {shape[1:]}, whose channels may be first or last"
        raise EpisodeError(where, fault, "set source.layout.axes to TCHW or THWC")
    return "THWC" if last else "TCHW"


def as_bytes(images: Array, layout: Hdf5Layout, where: str) -> Images:
    """Convert images of another number type to uint8, by the range in `layout.pixels`."""
    if images.dtype == np.uint8:
        return images
    highest = PIXELS[layout.pixels or "0-255"]
    values = images.astype(np.float32)
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    if not (-_SLACK * highest <= low and high <= highest * (1 + _SLACK)):  # false for NaN too
        fault = f"holds values from {low:g} to {high:g}, source.layout.pixels says {layout.pixels}"
        raise EpisodeError(where, fault, f"set it to one of {', '.join(PIXELS)}")
    return np.rint(np.clip(values, 0, highest) * (255 / highest)).astype(np.uint8)


def _is_bytes(dtype: np.dtype[Any]) -> bool:
    """Check whether rows of varying length are bytes or text, not references or other numbers."""
    inner = h5py.check_vlen_dtype(dtype)
    if inner is None:
        return h5py.check_string_dtype(dtype) is not None
    return np.dtype(inner).kind in "iu" and np.dtype(inner).itemsize == 1


def _remedy(found: h5py.Dataset, layout: Hdf5Layout) -> str:
    shape: tuple[int, ...] = found.shape or ()
    numbers = found.dtype.kind in "fiu" and found.dtype != np.uint8
    if numbers and len(shape) == 4 and 3 in (shape[1], shape[3]) and not layout.pixels:
        return f"if they are colours, set source.layout.pixels to their range: {', '.join(PIXELS)}"
    return "expected (T, H, W, 3) uint8, or encoded images"


class ImageRows:
    """A camera's Stream: the images of one dataset, `rows` in all.

    Args:
        finder: of the source; the dataset is kept open in its files.
        place, key: the episode, and the dataset in it.
        layout: of the source, from the YAML.

    Raises:
        EpisodeError: the dataset is missing, or holds no colour images.
    """

    timestamps: Floats = np.zeros(0)  # (T,) seconds, set by who knows them; rows after the last are not used

    def __init__(self, finder: EpisodeFinder, place: EpisodeGroup, key: str, layout: Hdf5Layout) -> None:
        self._finder, self._place = finder, place
        self._key, self._layout, self._where = key, layout, f"{place} {key}"
        found = dataset(finder.group(place), key, str(place))
        self.rows = len(found)
        kind = image_kind(found, layout)
        if kind is None:
            fault = f"{key!r} holds {found.shape} {found.dtype}, not colour images"
            raise EpisodeError(place, fault, _remedy(found, layout))
        self._axes = axes_of(found.shape, layout, self._where) if kind == "raw" else None

    def each(self, indices: Indices, least: int = 0) -> Images | list[Images]:
        """Return the images of those frames, which may differ in size where each is encoded."""
        with explained(self._place):
            group, where = self._finder.group(self._place), str(self._place)
            found = rows(self._finder.files.cached(self._place.file, group, self._key, where), indices)
        if self._axes:
            return as_rgb(as_bytes(found, self._layout, self._where), self._axes)
        return [
            decode_image(encoded(row), f"{self._where}[{index}]", least)
            for row, index in zip(found, indices, strict=True)
        ]

    def frames(self, indices: Indices) -> Images:
        """See Stream."""
        images = self.each(indices)
        return stacked(images, len(images), self._where) if isinstance(images, list) else images
