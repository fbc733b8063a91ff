"""Find cameras that show nothing: one colour, one picture, or the same picture again and again.

A picture is judged by the mean colours of blocks: 16×16 blocks for what changes over time, 8×8 for what
differs at all. A mean leaves little of a sensor's noise and of a codec's errors, while a thing that is seen,
or moves, changes the mean of its block. A picture repeats the one before only where all pixels are equal.

n pictures of S×S pixels; levels are those of uint8, 0 to 255.
"""

import numpy as np

from hma_data.episodes.images import Images, opencv
from hma_data.errors import EpisodeError
from hma_data.registry.components import Quality

FINE, COARSE = (16, 16), (8, 8)  # blocks
BLANK = 8  # levels from the darkest to the brightest coarse block: 3 % of full scale
STILL = 4  # levels by which a fine block changes


class PictureCheck:
    """The check of one camera in one episode; its pictures are added in their order.

    Attributes:
        pictures: number of pictures added.
        repeated: number of pictures that show the same as the picture before.
    """

    def __init__(self) -> None:
        self.pictures = self.repeated = 0
        self._low, self._high = np.full((*FINE, 3), 255, np.uint8), np.zeros((*FINE, 3), np.uint8)
        self._darkest, self._brightest = np.full(3, 255, np.uint8), np.zeros(3, np.uint8)
        self._last: Images | None = None

    def add(self, frames: Images) -> None:
        """Add the next pictures (n, S, S, 3)."""
        for frame in frames:
            if self._last is not None and np.array_equal(frame, self._last):
                self.repeated += 1
            else:
                self._note(frame)
            self.pictures, self._last = self.pictures + 1, frame

    def _note(self, frame: Images) -> None:
        cv2 = opencv()
        fine = cv2.resize(frame, FINE, interpolation=cv2.INTER_AREA)
        coarse = cv2.resize(fine, COARSE, interpolation=cv2.INTER_AREA)
        self._low, self._high = np.minimum(self._low, fine), np.maximum(self._high, fine)
        self._darkest = np.minimum(self._darkest, coarse.min(axis=(0, 1)))
        self._brightest = np.maximum(self._brightest, coarse.max(axis=(0, 1)))

    @property
    def blank(self) -> bool:
        """Check whether all pictures show one colour, the same throughout; one picture does not count."""
        return self.contrast <= BLANK and self.pictures > 1

    @property
    def contrast(self) -> int:
        """Return the levels from the darkest to the brightest coarse block of all pictures."""
        return int((self._brightest - self._darkest).max())

    @property
    def still(self) -> bool:
        """Check whether all pictures show the same; one picture does not count."""
        return int((self._high - self._low).max()) <= STILL and self.pictures > 1


def picture_flags(seen: PictureCheck, rule: Quality, episode_id: str, camera: str) -> dict[str, int]:
    """Return the flags of one camera in one episode: name -> number of pictures.

    The first that applies counts: a blank camera is also still, and a still one repeats its pictures.

    Raises:
        EpisodeError: the rule refuses the episode.
    """
    share = seen.repeated / max(seen.pictures - 1, 1)
    for name, met, count, said in (
        ("blank", seen.blank, seen.pictures, "shows one colour throughout"),
        ("still", seen.still, seen.pictures, "shows one picture throughout"),
        ("repeated", share > rule.repeated_share, seen.repeated, "repeats pictures"),
    ):
        if met and getattr(rule, name) == "refuse":
            remedy = f"quality: {{{name}: flag}} in the YAML keeps such episodes"
            raise EpisodeError(episode_id, f"camera {camera} {said}", remedy)
        if met:
            return {f"{name}_pictures:{camera}": count}
    return {}
