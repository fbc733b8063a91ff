"""Model and truth have parted when other frames than those of now would do as well."""

import math
from collections.abc import Callable

import numpy as np

from hma_model.play.session import DivergenceDetector

SECOND = 10  # frames


def pendulum(angle: float, blur: float = 0.0) -> np.ndarray:
    """Return an image (64, 64, 3) of a pendulum; its pixels are a share `blur` of grey."""
    image = np.full((64, 64, 3), 230.0)
    for step in np.linspace(0, 26, 40):
        x, y = 32 + step * math.sin(angle), 32 + step * math.cos(angle)
        image[int(y) - 2 : int(y) + 3, int(x) - 2 : int(x) + 3] = (180, 40, 40)
    return ((1 - blur) * image + blur * 200).astype(np.uint8)


def parted(made: Callable[[int], np.ndarray], frames: int, true: Callable[[int], np.ndarray]) -> int | None:
    detector = DivergenceDetector(true(0), true(0), SECOND)
    for number in range(1, frames + 1):
        detector.look(number, made(number), true(number))
    return detector.parted


def swing(number: int) -> np.ndarray:
    return pendulum(2.5 * math.sin(0.21 * number))


def test_a_model_that_moves_unrelated_to_the_truth_has_parted() -> None:
    """No still is as near to the truth for a second: only other moments show it."""
    found = parted(lambda number: pendulum(2.5 * math.sin(0.34 * number + 1)), 200, swing)
    assert found is not None and found < 60


def test_a_model_that_is_wrong_from_a_frame_on_has_parted_soon_after() -> None:
    found = parted(lambda number: swing(number if number < 40 else 2 * number), 120, swing)
    assert found is not None and 40 <= found < 80


def test_a_model_that_follows_has_not_parted_though_it_is_blurred_or_late() -> None:
    assert parted(lambda number: pendulum(2.5 * math.sin(0.21 * number), blur=0.5), 300, swing) is None
    assert parted(lambda number: swing(number - 2), 300, swing) is None
    assert parted(lambda number: swing(0), 100, lambda number: swing(0)) is None  # nothing moves


def test_a_model_that_moves_while_nothing_happens_has_parted() -> None:
    assert parted(swing, 60, lambda number: swing(0)) is not None
