"""Guess what a recording does not state: whether pictures are grey, and the unit of times; for `inspect`."""

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

HEAD = 65536  # bytes that are searched for a JPEG's start of frame
UNITS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3), (1e8, 1.0))  # least time since 1970, seconds a unit
TIMES = re.compile(r"(.*/)?(time_?stamps?|times?|stamps?|t)(_s|_sec|_ns)?")
STEPS_S = (1e-4, 5.0)  # between samples of a recording


def one_channel(data: bytes) -> bool:
    """Check whether a JPEG or PNG is grey, by its header."""
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return data[25:26] in (b"\0", b"\4")
    at, head = 2, data[:HEAD]
    while head[:2] == b"\xff\xd8" and at + 10 <= len(head) and head[at] == 0xFF:
        marker = head[at + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # a start of frame
            return head[at + 9] == 1
        at += 2 + (0 if marker == 0xFF else int.from_bytes(head[at + 2 : at + 4], "big"))
    return False


def seconds_a_unit(values: NDArray[Any]) -> float | None:
    """Return the length in seconds of one unit of a column of times; None where it is not clear.

    The unit follows from the size of the times and from their steps.

    Args:
        values: (T,) as recorded.
    """
    times = np.asarray(values, np.float64).reshape(-1)
    steps = np.diff(times)
    if len(times) < 3 or not np.isfinite(times).all() or steps.min() < 0 or not steps.max() > 0:
        return None
    step = float(np.median(steps))
    for least, unit in UNITS:
        if times[0] >= least:
            return unit if STEPS_S[0] <= step * unit <= STEPS_S[1] else None
    counted = np.array_equal(times, np.round(times))  # frame numbers, or times in another unit
    return 1.0 if not counted and STEPS_S[0] <= step <= STEPS_S[1] else None


def is_times(key: str, shape: tuple[int, ...]) -> bool:
    """Check whether a key holds one number a sample and is named like a column of times."""
    return shape in ((), (1,)) and bool(TIMES.fullmatch(key.lower()))


def seconds_of(values: NDArray[Any]) -> NDArray[np.float64] | None:
    """Return a column of times (T,) in seconds; None where its unit is not clear.

    Stamps may repeat or go back. The unit is found from the sorted, distinct stamps.
    """
    times = np.asarray(values).reshape(-1)
    if times.dtype.kind not in "fiu" or len(times) < 3:
        return None
    rising = np.unique(times[np.isfinite(times)] if times.dtype.kind == "f" else times)
    unit = seconds_a_unit(rising)
    if unit is None:
        return None
    origin = rising[0]  # subtracted while they are integers: float64 cannot hold nanoseconds since 1970
    shifted = times - origin if times.dtype.kind == "f" else times.astype(np.int64) - np.int64(origin)
    return shifted.astype(np.float64) * unit
