"""Name the arrays that several packages take and give; choose evenly spaced items."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Float32s = NDArray[np.float32]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Images = NDArray[np.uint8]  # one or many, (…, H, W, 3) RGB


def evenly(count: int, most: int) -> Ints:
    """Return the numbers of at most so many of `count` items, evenly spaced."""
    return np.linspace(0, count - 1, min(count, most)).astype(np.int64)
