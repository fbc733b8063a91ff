"""Name the arrays that several packages take and give."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]  # numbers of any dtype
Floats = NDArray[np.float64]
Float32s = NDArray[np.float32]
Ints = NDArray[np.int64]
Indices = Sequence[int] | Ints
Bools = NDArray[np.bool_]
Images = NDArray[np.uint8]  # one or many, (…, H, W, 3) RGB
