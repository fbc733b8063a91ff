"""`hma bench drift`: its figures on rollouts whose errors are known, its settings, and one run of it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from hma_data.errors import HMAError, UsageError
from recipes.bench import drift

BATCH, FRAMES = 3, 50
FRAME_NUMBERS = drift.looked_at(FRAMES, False)[1]


class Reader:
    own, loose = np.array([0]), np.array([], int)
    spread, error = np.array([40.0]), np.array([1.0])

    def read(self, pictures):
        return pictures[..., 0, :1, :2].astype(float)

    def areas(self, pictures):
        return np.where(pictures[..., 1, 1, :1] == 0, 100.0, 0.0)


def found(*errors, whole=True):
    """A robot that goes round, and rollouts of it that are so many px away at each frame (W,)."""
    angle = np.array(FRAME_NUMBERS) * 0.7 + np.arange(BATCH)[:, None]
    parts = 64 + 30 * np.stack([np.cos(angle), np.sin(angle)], -1)[:, :, None].round()
    blank = np.zeros((BATCH, len(FRAME_NUMBERS), 4, 4, 3), np.uint8)

    def pictures(shift):
        made = blank.copy()
        made[:, :, 0, 0, :2] = parts[:, :, 0] + np.stack([shift, np.zeros_like(shift)], -1)
        return made

    true = pictures(np.zeros(len(FRAME_NUMBERS)))
    cases = [drift.Case(f"way {i}", pictures(shift), judged=True) for i, shift in enumerate(errors)]
    if not whole:
        cases = [
            replace(case, pictures=case.pictures + np.uint8(1) * (np.arange(4) > 0)[:, None, None])
            for case in cases
        ]
    copy = drift.Case("copy", np.repeat(true[:, :1], true.shape[1], axis=1))
    return drift.Found("toy", Reader(), FRAME_NUMBERS, true, parts, (*cases, copy))


def late(error):
    return np.where(np.array(FRAME_NUMBERS) > 10, error, 4.0)


def test_errors_are_distances_at_the_marks_and_as_shares_of_the_spread():
    table = drift.rows(found(late(6.0)), seed=0)
    assert [row["frame"] for row in table] == [5, 10, 25, 50] * 2
    _, first, _, last = table[:4]
    assert (first["error_px"], last["error_px"], last["median_px"]) == (4.0, 6.0, 6.0)
    assert (last["low_px"], last["high_px"], last["share"]) == (6.0, 6.0, 0.15)
    assert last["motion"] == 1.0 and first["psnr_db"] > last["psnr_db"]
    copy = table[-1]
    assert copy["motion"] is None and copy["error_px"] > 20 and "verdict" not in copy


@pytest.mark.parametrize(
    ("error", "whole", "said"),
    [
        (late(7.0), True, "holds, error ×1.8; whole"),
        (late(9.0), True, "drifts, error ×2.2; whole"),
        (late(4.0), False, "holds, error ×1.0; dissolved"),
        (np.full(len(FRAME_NUMBERS), 25.0), True, "lost by frame 10, error ×1.0"),
    ],
)
def test_the_verdict_compares_the_end_with_frame_ten(error, whole, said):
    assert drift.rows(found(error, whole=whole), seed=0)[3]["verdict"].startswith(said)


def test_a_robot_that_the_probe_cannot_read_gets_no_verdict():
    unread = found(late(4.0))
    unread.probe.own = np.array([], int)
    last = drift.rows(unread, seed=0)[3]
    assert last["verdict"] == "none: no part of the robot can be read" and "error_px" not in last


def test_motion_of_other_commands_does_not_correlate():
    own = found(late(4.0))
    other = replace(own, cases=(replace(own.cases[0], pictures=own.truth[::-1]), *own.cases[1:]))
    assert drift.rows(other, seed=0)[0]["motion"] < 0.9


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"robots": "bridge"}, "bridge: has no simulator in the toolkit"),
        ({"frames": 5}, "frames=5 is not allowed — give at least 10"),
        ({"rollouts": 1}, "rollouts=1 is not allowed — give at least 2"),
        ({"sampling": "unmask_steps=2/speed=3"}, "'speed=3' is no option of a rollout — .*unmask_steps, "),
    ],
)
def test_a_wrong_setting_is_named(change, message):
    with pytest.raises(UsageError, match=message):
        drift.run(drift.BENCH.defaults | change)


def test_ways_of_sampling_are_told_apart_by_the_words_that_differ() -> None:
    ways = drift._samplings("unmask_steps=2,temperature=0.5/unmask_steps=2, temperature=0.5, sample_steps=4")
    assert list(ways) == ["unmask_steps=2,temperature=0.5", "sample_steps=4"]
    assert ways["sample_steps=4"] == {"unmask_steps": 2, "temperature": 0.5, "sample_steps": 4}


@pytest.mark.slow
def test_rollouts_are_measured_and_drawn_and_repeat_themselves(tmp_path) -> None:
    robot = next(iter(drift_robots()))
    changes = {"robots": robot, "frames": 12, "rollouts": 2, "sampling": "unmask_steps=1/temperature=1.0"}
    settings = drift.BENCH.defaults | changes | {"sheet": str(tmp_path / "sheet.png")}
    table = drift.run(settings)
    names = ["unmask_steps=1", "unmask_steps=1, shuffled", "temperature=1.0", "copy"]
    assert [(row["rollout"], row["frame"]) for row in table] == [(n, f) for n in names for f in (5, 10, 12)]
    assert all(0 < row["probe_px"] < 3 and row["error_px"] > 0 for row in table)
    assert [row["rollout"] for row in table if row.get("verdict")] == [names[0], names[2]]
    assert cv2.imread(str(tmp_path / "sheet.png")).shape[0] > 6 * 64
    assert drift.run(settings) == table


@pytest.mark.slow
def test_a_robot_that_the_checkpoint_lacks_is_named() -> None:
    with pytest.raises(HMAError, match="mover_52"):
        drift.run(drift.BENCH.defaults | {"robots": "mover_52"})


def drift_robots():
    from hma_model.checkpoint.folder import Checkpoint

    return Checkpoint.open("embedded").embodiments
