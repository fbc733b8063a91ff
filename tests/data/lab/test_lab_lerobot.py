"""The laboratory's LeRobotDataset: what lerobot wrote of the planar arm, read by lerobot and by us."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hma_data.episodes.episode import Episode
from hma_data.lab import record
from hma_data.lab.planar_arm import STEPS
from hma_data.registry.embodiment import find
from hma_data.sources.base import open_source

pytestmark = pytest.mark.slow  # of the import of lerobot, and of encoding AV1
EPISODES, SEED = 2, 3


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record("planar_arm_lerobot", tmp_path_factory.mktemp("lab"), EPISODES, SEED)


@pytest.fixture(scope="module")
def theirs(recorded: Path) -> Any:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset("lab/arm", root=recorded, video_backend="pyav", return_uint8=True)


def episodes_of(robot: str, recording: Path) -> list[Episode]:
    embodiment = find(robot)
    source = open_source(embodiment.source.format)
    return [source.read(str(recording), name, embodiment) for name in source.episode_ids(str(recording))]


def test_lerobot_finds_the_robot_and_its_names_in_the_metadata(theirs: Any) -> None:
    robot = find("planar_arm_lerobot")
    assert theirs.meta.info.codebase_version == "v3.0"
    assert (theirs.fps, theirs.meta.robot_type) == (robot.frequency_hz, robot.robot)
    assert theirs.features["action"]["names"] == list(robot.action.names())


def test_statistics_are_in_one_order_in_every_process(recorded: Path) -> None:
    told = json.loads((recorded / "meta/stats.json").read_text())
    assert len(told) > 4 and list(told) == sorted(told)


def test_the_episodes_are_those_of_the_recording_in_hdf5(recorded: Path, tmp_path: Path) -> None:
    same = episodes_of("planar_arm", record("planar_arm", tmp_path, EPISODES, SEED))
    for ours, original in zip(episodes_of("planar_arm_lerobot", recorded), same, strict=True):
        np.testing.assert_array_equal(ours.actions[0].values, original.actions[0].values)
        np.testing.assert_array_equal(ours.states[0].values, np.float32(original.states[0].values))
        shown, drawn = (
            episode.streams["top"].frames(range(0, STEPS, 5)).astype(float) for episode in (ours, original)
        )
        assert 10 * np.log10(255**2 / np.square(shown - drawn).mean()) > 30  # the video is lossy
