"""The two clocks of a bag: header stamps against receipt, order of messages, and what is advised."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hma_data.errors import EpisodeError
from hma_data.sources.bags.clocks import MessageTimes, sorted_by
from tests.data.bag_files import arm, make_recording, read, write_ros1

FRAMES = 20
SECOND = 10**9


def shifted(tmp_path: Path, shift_s: np.ndarray) -> Path:
    shift = np.round(shift_s * SECOND).astype(np.int64)
    return write_ros1(tmp_path / "run.bag", replace(make_recording(FRAMES), stamp_shift_ns=shift))


def test_one_stamp_of_zero_is_no_shift(tmp_path: Path) -> None:
    times = np.arange(FRAMES) * SECOND // 10
    order = sorted_by(np.where(np.arange(FRAMES) == 0, 0, times + SECOND), np.zeros(FRAMES, np.int64))
    np.testing.assert_array_equal(order, np.arange(FRAMES))


def test_messages_swapped_on_arrival_take_the_order_of_their_stamps() -> None:
    times = np.arange(FRAMES) * SECOND // 10
    times[[4, 5]] = times[[5, 4]]
    times[[10, 11, 12]] = times[[12, 10, 11]]
    order = sorted_by(times, np.zeros(FRAMES, np.int64))
    assert order is not None and (np.diff(times[order]) > 0).all()


@pytest.mark.parametrize("back_s", [0.75, 5, 3600])
def test_a_clock_that_is_set_back_is_never_sorted(back_s: float) -> None:
    times = np.arange(40) * SECOND // 10
    times[20:] -= round(back_s * SECOND)
    assert sorted_by(times, np.zeros(40, np.int64)) is None
    files = np.zeros(40, np.int64)
    fault = MessageTimes("/cam", times, None, files).set_back_error("receive", "").fault
    assert f"go back by {back_s - 0.1:.3g} s at message 20" in fault
    parts = np.repeat([1, 0], 20)  # the parts of one recording may be stored in any order
    if back_s > 2:
        assert sorted_by(times, parts) is not None


def test_the_advice_for_a_clock_set_back_never_mixes_the_two_runs(tmp_path: Path) -> None:
    shift = np.where(np.arange(FRAMES) < FRAMES // 2, 0.0, -60.0)
    with pytest.raises(EpisodeError, match=r"go back by 59\.9 s at message 10.*gap_s.*stamp: receive"):
        read(shifted(tmp_path, shift), arm())
