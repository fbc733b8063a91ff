"""Name the arrays that several packages take and give; choose evenly spaced items."""

import numpy as np

from hma_data.arrays import Bools as Bools
from hma_data.arrays import Float32s as Float32s
from hma_data.arrays import Floats as Floats
from hma_data.arrays import Images as Images
from hma_data.arrays import Ints as Ints


def evenly(count: int, most: int) -> Ints:
    """Return the numbers of at most so many of `count` items, evenly spaced."""
    return np.linspace(0, count - 1, min(count, most)).astype(np.int64)
