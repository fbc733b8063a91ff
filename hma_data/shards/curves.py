"""Draw actions as curves, one strip for each value, with OpenCV so that a video of them is quick to make.

T rows, A values. Each strip spans the range of its value. A line marks zero; grey marks the rows whose values
are not known.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.images import opencv
from hma_data.episodes.sheets import INK, PAPER, Images, write_text

LINE, CURSOR, ZERO, UNKNOWN = (0, 114, 178), (213, 94, 0), (200, 200, 200), (225, 225, 225)
MOST = 16  # strips; of further values only the number is shown
LABELS, FOOT = 136, 16  # pixels left of the strips and below them


@dataclass(frozen=True)
class Curves:
    """The actions of one episode, and how to draw them.

    Attributes:
        values: (T, A).
        known: (T,) bool, or None.
        low, high: (A,) range of each value, over the whole set.
        names: A names.
        seconds: time from the first row to the last.
        width, height: size of the picture in pixels.
    """

    values: NDArray[np.float32]
    known: NDArray[np.bool_] | None
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    names: list[str]
    seconds: float
    width: int
    height: int

    @cached_property
    def panel(self) -> Images:
        """Draw all curves without a cursor; (height, width, 3)."""
        picture = np.full((self.height, self.width, 3), PAPER, np.uint8)
        shown = min(self.values.shape[1], MOST)
        rest = self.values.shape[1] - shown
        tall = (self.height - FOOT) // max(shown, 1)
        for dim in range(shown):
            self._strip(picture, dim, dim * tall, tall)
        text = f"0 to {self.seconds:.1f} s" + (f", {rest} more values" if rest else "")
        write_text(picture, text, (LABELS, self.height - 4), 0.36)
        return picture

    def at(self, row: int) -> Images:
        """Return the panel with a cursor at a row."""
        picture = self.panel.copy()
        x = self._x(np.array([row]))[0]
        picture[: self.height - FOOT, max(x - 1, 0) : x + 1] = CURSOR
        return picture

    def marked(self, rows: NDArray[np.int64]) -> Images:
        """Return the panel with a tick below each of these rows."""
        picture = self.panel.copy()
        for x in self._x(rows):
            picture[self.height - FOOT - 2 : self.height - FOOT + 3, x - 1 : x + 2] = CURSOR
        return picture

    def _x(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        last = max(len(self.values) - 1, 1)
        return (LABELS + rows / last * (self.width - LABELS - 6)).round().astype(np.int64)

    def _strip(self, picture: Images, dim: int, top: int, tall: int) -> None:
        cv2 = opencv()
        inner = max(tall - 5, 3)
        span = self.high[dim] - self.low[dim]
        scale = 1 / span if span > 0 else 0.0

        def y(values: NDArray[np.floating]) -> NDArray[np.int64]:
            share = np.clip((values - self.low[dim]) * scale, 0, 1) if span > 0 else np.full(len(values), 0.5)
            return (top + 2 + (1 - share) * inner).round().astype(np.int64)

        x = self._x(np.arange(len(self.values)))
        if self.known is not None:
            for at in x[~self.known]:
                picture[top + 2 : top + 3 + inner, max(at - 1, 0) : at + 2] = UNKNOWN
        if self.low[dim] <= 0 <= self.high[dim]:
            picture[y(np.zeros(1))[0], LABELS : self.width - 6] = ZERO
        points = np.stack([x, y(self.values[:, dim])], axis=1).astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(picture, [points], False, LINE, 1, cv2.LINE_AA)
        picture[top + 2 : top + 3 + inner, LABELS - 1] = INK
        if tall >= 10:
            write_text(picture, self.names[dim][:10], (4, top + tall // 2 + 4), 0.36)
            write_text(picture, f"{self.low[dim]:.2g}..{self.high[dim]:.2g}", (66, top + tall // 2 + 4), 0.26)
