"""Tell when the frames of a model no longer show what truly happens.

A frame is lost if it is much worse than the tokenizer alone would make it, and another frame would do as
well: a still of the beginning, or the truth of another moment. A model that follows its actions is nearest to
the truth of now, however blurred it is. One that does not may still be sharp and move plausibly.

S pixels a side of thumbnails.
"""

import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.images import resize

Image = NDArray[np.uint8]

SIDE = 32  # pixels of thumbnails: where parts are, not how sharp they are
LOST_FACTOR = 4.0  # times the squared error of the tokenizer alone: 6 dB
NEARER = 0.8  # of the squared error: another moment must be nearer by 1 dB
OWN_ERROR = 1.0  # of the tokenizer alone, at least
MEMORY = 300  # moments that are remembered: comparing with them takes a few milliseconds a frame
MIN_ROW = 3  # lost frames in a row, for robots of few frames a second


class DivergenceDetector:
    """Find the first of the frames that were lost for a second.

    Args:
        true: the first true frame (H, W, 3).
        shown: the same as the tokenizer shows it.
        second: frames of a second.

    Attributes:
        parted: number of that frame; None so far.
    """

    def __init__(self, true: Image, shown: Image, second: int) -> None:
        self.parted: int | None = None
        self._second = max(MIN_ROW, second)
        self._first = _thumbnail(true)
        self._own_error = max(OWN_ERROR, float(np.square(_thumbnail(shown) - self._first).mean()))
        self._moments = self._first[None]  # (n, S, S, 3) true ones, the oldest first
        self._lost = 0  # frames in a row

    def look(self, number: int, image: Image, true: Image) -> None:
        """Compare the model's frame of a number with the true one."""
        if self.parted is not None:
            return
        made = _thumbnail(image)
        now = _thumbnail(true)
        self._moments = np.concatenate([self._moments, now[None]])[-MEMORY:]
        errors = np.square(self._moments - made).mean(axis=(1, 2, 3))
        # A frame that is a little late is not lost: it may be of any moment of the last half second.
        error = errors[-max(1, self._second // 2) :].min()
        others = errors[: max(1, len(errors) - self._second)]
        still = np.square(self._first - now).mean()
        replaceable = still <= error or others.min() < NEARER * error
        self._lost = self._lost + 1 if replaceable and error > LOST_FACTOR * self._own_error else 0
        if self._lost == self._second:
            self.parted = number - self._second + 1


def _thumbnail(image: Image) -> NDArray[np.float32]:
    return resize(image[None], SIDE, "stretch")[0].astype(np.float32)
