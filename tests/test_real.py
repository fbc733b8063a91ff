"""Real recordings through the whole data road, each by a YAML alone."""

import json
from pathlib import Path

import numpy as np
import pytest

from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.episodes.images import prepare
from hma_data.inspection.inspect import inspect_recording
from hma_data.registry.embodiment import Embodiment, find
from hma_data.shards.preview import tokenizer_of
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.sources.base import open_source

pytestmark = pytest.mark.real

CAMERA_BAG = """
id: camera_model
kind: real
frequency_hz: null
stride: 1
action: {space: mixed, components: [{key: "/image/calib.K", dims: 9}]}
cameras: [{name: main, key: /image/image}]
sync: {actions: nearest}
source: {format: rosbag}
"""


@pytest.mark.parametrize(
    ("robot", "recording", "limit"),
    [
        ("bridge_data_v2", "rlds/bridge_dataset", 3),
        pytest.param("robosuite_lift", "hdf5/lift_rendered.hdf5", 2, marks=pytest.mark.slow),
        pytest.param("g1_inspire", "lerobot/g1_v21", 3, marks=pytest.mark.slow),
    ],
)
def test_inspect_and_convert(real_data: Path, tmp_path: Path, robot: str, recording: str, limit: int) -> None:
    uri = str(real_data / recording)
    report = inspect_recording(uri, robot)
    assert report["episodes"] >= limit
    assert {"camera", "vector"} <= {key["kind"] for key in report["keys"]}
    assert not [problem for problem in report["problems"] if "does not fit" in problem]

    summary = convert(
        find(robot), uri, "fsq-8", tmp_path / "o", settings=Settings(limit=limit), max_quarantine=0.5
    )
    assert not summary.too_many
    assert verify(tmp_path / "o") == []
    shards = ShardSet(tmp_path / "o")
    row = shards.episodes.to_pylist()[0]
    decoded = tokenizer_of(shards).decode(
        shards.tokens(shards.episode_rows(row["episode_index"])["tokens"][:4])
    )
    robot_of = find(robot)
    episode = open_source(robot_of.source.format).read(uri, row["id"], robot_of)
    camera = robot_of.primary_camera
    recorded = prepare(episode.streams[camera.name].frames(np.arange(4)), camera, 128)
    error = np.mean((decoded.astype(float) - recorded) ** 2)
    assert 10 * np.log10(255**2 / error) > 16  # the same picture, however coarse the tokens


@pytest.mark.slow
def test_an_episode_whose_video_is_missing_is_quarantined(real_data: Path, tmp_path: Path) -> None:
    uri = str(real_data / "lerobot/g1_v21")
    summary = convert(find("g1_inspire"), uri, "fsq-8", tmp_path / "o", settings=Settings(limit=2))
    refused = [json.loads(line) for line in (tmp_path / "o" / "quarantine.jsonl").read_text().splitlines()]
    assert [item["id"] for item in refused] == ["episode_000000"]
    assert "episode_000000.mp4" in refused[0]["message"]
    assert summary.too_many  # one of two is more than one in a hundred


def test_a_bag_with_pictures(real_data: Path, tmp_path: Path) -> None:
    uri = str(real_data / "mcap/custom-camera-model.mcap")
    report = inspect_recording(uri)
    cameras = [key for key in report["keys"] if key["kind"] == "camera"]
    assert [camera["count"] for camera in cameras] == [10]
    vectors = {tuple(key["shape"]): key["key"] for key in report["keys"] if key["kind"] == "vector"}
    numbers = vectors[(9,)]
    yaml = CAMERA_BAG.replace("/image/image", cameras[0]["key"]).replace("/image/calib.K", numbers)
    summary = convert(Embodiment.from_yaml(yaml), uri, "fsq-8", tmp_path / "o")
    assert summary.manifest.splits["train"]["frames"] >= 9
    assert verify(tmp_path / "o") == []
