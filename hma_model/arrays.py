"""Choose evenly spaced items."""

import numpy as np

from hma_data.arrays import Ints


def evenly(count: int, most: int) -> Ints:
    """Return the numbers of at most so many of `count` items, evenly spaced."""
    return np.linspace(0, count - 1, min(count, most)).astype(np.int64)
