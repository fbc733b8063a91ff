"""Choose the cameras of windows: one for all windows, one drawn for each, or several stacked.

    cameras: first          # the first camera of each set
    cameras: drawn          # one camera for each window, drawn
    cameras: wrist          # a camera by its name
    cameras: [top, wrist]   # several views, stacked along the height of the token grid

n windows, T frames, V views, h·w grid, c channels.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hma_data.arrays import Array, Ints
from hma_data.errors import UsageError
from hma_data.registry.embodiment import FIRST_CAMERA
from hma_data.shards.reader import ShardSet
from hma_data.tokenizers.base import TokenizerSpec

Cameras = str | Sequence[str]
DRAWN = "drawn"


def view_count(cameras: Cameras) -> int:
    """Return V, the number of views in a frame of a window."""
    return 1 if isinstance(cameras, str) else len(cameras)


@dataclass(frozen=True)
class Views:
    """The cameras of a shard set that its windows take.

    Attributes:
        numbers: their indices among the cameras of the set.
        drawn: whether a window takes one of them, drawn; otherwise it takes all, stacked.
        columns: the columns that hold their frames.
    """

    numbers: tuple[int, ...]
    drawn: bool
    columns: tuple[str, ...]

    @classmethod
    def of(cls, shards: ShardSet, cameras: Cameras) -> "Views":
        """Return the cameras of a set.

        Raises:
            UsageError: the set lacks one of them, or none or one twice is named.
        """
        layout, robot = shards.manifest.layout, shards.embodiment.id
        names: Sequence[str] = [cameras] if isinstance(cameras, str) else cameras
        if cameras == FIRST_CAMERA:
            names = layout.cameras[:1]
        elif cameras == DRAWN:
            names = layout.cameras
        lacking = [name for name in names if name not in layout.cameras]
        if lacking:
            has = f"{robot} has the cameras {', '.join(layout.cameras)} in {shards.folder}"
            recorded = {camera.name for camera in shards.embodiment.cameras}.issuperset(lacking)
            remedy = "hma convert --cameras all stores every camera" if recorded else "name cameras it has"
            raise UsageError("cameras", f"{has}, not {', '.join(lacking)}", remedy)
        if not names or len(set(names)) < len(names):
            raise UsageError("cameras", f"{list(names)!r} names no camera, or one twice", "name each once")
        drawn = cameras == DRAWN and len(names) > 1
        columns = tuple(layout.token_columns[name] for name in names)
        numbers = tuple(layout.cameras.index(name) for name in names)
        return cls(numbers, drawn, columns)

    def taken(self, draws: Ints) -> tuple[Ints, Ints | None]:
        """Return the camera (n,) of each window, and which of the columns (n,) it takes; None for all.

        Args:
            draws: (n,) a random number of at least 0 for each window.
        """
        if not self.drawn:
            return np.full(len(draws), self.numbers[0]), None
        view = draws % len(self.numbers)
        return np.asarray(self.numbers)[view], view


def by_number(windows: Ints) -> Ints:
    """Return a number (n,) for each window's number, that looks random and is always the same."""
    mixed = windows.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    return (mixed >> np.uint64(33)).astype(np.int64)


def stacked(tokens: Array, spec: TokenizerSpec, views: int) -> Array:
    """Stack the views of frames (n, T, …) along the height: (n, T, V·h, w) or (n, T, c, V·h, w)."""
    *channels, h, w = spec.cells
    split = tokens.reshape(*tokens.shape[:2], views, math.prod(channels), h, w).swapaxes(2, 3)
    return split.reshape(*tokens.shape[:2], *channels, views * h, w)
