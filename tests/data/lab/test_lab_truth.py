"""The laboratory's simulators as truth beside a model: the recorders' pictures, commands and places."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from hma_data.lab import pendulum, planar_arm, record, simulator, truth
from hma_data.lab.family.look import SIZE

STRIDE = 3


@pytest.mark.parametrize("robot", ["arm2_07", "planar_arm", "pusht_fast"])
def test_an_episode_is_the_one_that_the_recorder_writes(robot: str, tmp_path: Path) -> None:
    number = 1 if robot == "pusht_fast" else 0  # its first episode that wanders
    with h5py.File(record(robot, tmp_path, number + 1, seed=4)) as file:
        recorded = file[f"data/demo_{number}"]
        pictures, actions = recorded["obs/image"][:30:STRIDE], recorded["actions"][:30]
    found = truth.episode(robot, 10, STRIDE, seed=4, number=0)
    np.testing.assert_array_equal(found.pictures, pictures)
    np.testing.assert_array_equal(found.chunks.reshape(actions.shape), actions)


ROBOTS = ("pendulum", "planar_arm", *truth.PUSHERS, "mover_10", "gantry_04", "crane_01", "rails_09")


@pytest.mark.parametrize("robot", ROBOTS)
def test_episodes_are_repeatable_and_of_any_length(robot: str) -> None:
    own = simulator.embodiment(robot)
    short, long = (truth.episode(robot, frames, own.stride, 2, 3) for frames in (4, 30))
    np.testing.assert_array_equal(short.pictures, long.pictures[:4])
    np.testing.assert_array_equal(short.parts, long.parts[:4])
    some = truth.episode(robot, 4, own.stride, 2, 3, drawn={1, 3})
    np.testing.assert_array_equal(some.pictures, short.pictures[[1, 3]])
    assert long.chunks.shape == (30, own.chunk_dim) and long.chunks.dtype == np.float32
    assert long.pictures.shape[:2] == (30, long.pictures.shape[2]) and 1 <= long.driven <= long.parts.shape[1]
    moved = np.ptp(long.parts[:, : long.driven], axis=0).max()
    assert 4 < moved < SIZE


def test_an_episode_is_longer_than_a_recording() -> None:
    smooth = 1  # of the pendulum's drivers; its torques are a function of time
    assert len(truth.episode("pendulum", 60, 2, 0, smooth).parts) * 2 > pendulum.STEPS


def test_parts_are_where_their_colours_are() -> None:
    found = truth.episode("planar_arm", 40, STRIDE, 1, 0)
    rows, (_, fore) = np.arange(40), found.parts[:, :2].transpose(1, 0, 2).round().astype(int)
    assert (np.abs(found.pictures[rows, fore[:, 1], fore[:, 0]] - np.array(planar_arm.FORE_COLOR)) < 8).all()
    tee = truth.episode("pusht_slow", 40, 5, 1, 2)
    x, y = (tee.parts[:, 2] * tee.pictures.shape[2] / SIZE).round().astype(int).T
    assert (np.abs(tee.pictures[rows, y, x].astype(int) - (246, 160, 76)).max(axis=-1) < 30).mean() > 0.8
