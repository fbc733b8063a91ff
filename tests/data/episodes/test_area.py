"""`area` is OpenCV's INTER_AREA bit for bit, also where it is computed by exact sums."""

import cv2
import numpy as np
import pytest

from hma_data.episodes import images
from hma_data.episodes.images import resize

SIZES = [(480, 640, 256), (480, 640, 128), (480, 640, 64), (720, 1280, 256), (360, 640, 224), (240, 320, 64)]


def pictures(height: int, width: int) -> np.ndarray:
    """Return noise, and edges of black and white, whose sums are the largest."""
    noise = np.random.default_rng(height + width).integers(0, 256, (2, height, width, 3), np.uint8)
    return np.stack([noise[0], (noise[1] > 127) * np.uint8(255)])


def by_opencv(frames: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return frames resized to (height, width)."""
    whole = np.ascontiguousarray(frames)
    return np.stack([cv2.resize(one, size[::-1], interpolation=cv2.INTER_AREA) for one in whole])


@pytest.mark.parametrize(("height", "width", "size"), SIZES)
def test_bytes_are_those_of_inter_area(height: int, width: int, size: int) -> None:
    assert images._takes_sums(height, height, size, size)
    frames = pictures(height, width)
    left = (width - height) // 2
    middle = frames[:, :, left : left + height]
    np.testing.assert_array_equal(resize(frames, size), by_opencv(middle, (size, size)))


def test_both_axes_may_shrink_by_different_ratios() -> None:
    frames = pictures(480, 640)
    assert images._takes_sums(480, 640, 256, 256)
    np.testing.assert_array_equal(resize(frames, 256, "stretch"), by_opencv(frames, (256, 256)))
    boxed = resize(frames, 256, "letterbox")
    np.testing.assert_array_equal(boxed[:, 32:224], by_opencv(frames, (192, 256)))
    assert not boxed[:, :32].any() and not boxed[:, 224:].any()


def test_views_of_any_layout_are_resized() -> None:
    frames = pictures(480, 480)
    for view in (frames[..., ::-1], frames[:, ::-1], np.rot90(frames, 1, (1, 2))):
        np.testing.assert_array_equal(resize(view, 256), by_opencv(view, (256, 256)))


def test_sums_are_left_where_a_mean_may_be_half_a_level_or_opencv_less_exact() -> None:
    assert not images._takes_sums(512, 512, 320, 320)  # 8/5: even
    assert not images._takes_sums(1080, 1080, 256, 256)  # 135/32: 36,450ths of a level
    assert not images._takes_sums(1365, 1365, 1364, 1364)
    assert not images._takes_sums(768, 768, 256, 256)  # OpenCV is fast at whole ratios
    assert not images._takes_sums(240, 240, 256, 256)
    assert not images._takes_sums(84, 84, 64, 64)  # small
