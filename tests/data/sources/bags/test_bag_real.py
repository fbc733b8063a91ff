"""Bags against real recordings and the formats' own readers."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import NonSeekingReader, make_reader
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.typesys import Stores, get_typestore

from hma_data.episodes.align import to_clip
from hma_data.errors import EpisodeError, SourceError
from hma_data.sources.bags.bag import Bag
from hma_data.sources.bags.container import RecordFilter
from hma_data.sources.bags.messages import decode, numbers
from tests.data.bag_files import SOURCE, arm, read


@pytest.mark.real
def test_the_three_compressions_of_a_real_bag_are_equal(real_data: Path) -> None:
    folder = real_data / "ros1" / "foxglove" / "fixtures"
    contents = []
    for name in ("example", "example-bz2", "example-lz4"):
        records = [record for _, record in Bag(folder / f"{name}.bag").records()]
        contents.append(sorted((r.channel.topic, r.log_ns, bytes(r.data)) for r in records))
    with Ros1Reader(folder / "example.bag") as reader:
        expected = sorted((c.topic, t, bytes(data)) for c, t, data in reader.messages())
    assert len(expected) == 8647
    assert contents == [expected] * 3


@pytest.mark.real
def test_real_joint_states_are_those_of_rosbags(real_data: Path) -> None:
    path = real_data / "ros1" / "fake_joint_state.bag"
    store = get_typestore(Stores.ROS1_NOETIC)
    with Ros1Reader(path) as reader:
        expected = [store.deserialize_ros1(data, c.msgtype).position for c, _, data in reader.messages()]
    found = [numbers(decode(record.channel, record.data, "").position) for _, record in Bag(path).records()]
    np.testing.assert_array_equal(found, expected)
    assert len(found) == 2725


@pytest.mark.real
def test_real_ros2_bags_hold_as_many_messages_as_their_metadata_says(real_data: Path) -> None:
    import yaml

    seen = 0
    for path in sorted((real_data / "ros2").rglob("metadata.yaml")):
        stated = yaml.safe_load(path.read_text())["rosbag2_bagfile_information"]
        found = sum(1 for _ in Bag(path.parent).records())
        assert found == stated["message_count"] == Bag(path.parent).counts().total(), path
        seen += 1
    assert seen >= 15


@pytest.mark.real
def test_ros2_twins_in_sqlite_and_mcap_hold_the_same_values(real_data: Path) -> None:
    folder = real_data / "ros2" / "rosbag2" / "rosbag2_tests" / "resources"
    store = get_typestore(Stores.ROS2_JAZZY)
    raw = [
        sorted(
            (r.channel.topic, r.log_ns, bytes(r.data)) for _, r in Bag(folder / kind / "cdr_test").records()
        )
        for kind in ("mcap", "sqlite3")
    ]
    assert raw[0] == raw[1] and store
    values = [
        decode(record.channel, record.data, "").float64_values.tolist()
        for _, record in Bag(folder / "mcap" / "cdr_test").records(RecordFilter(frozenset({"/array_topic"})))
    ]
    assert len(values) == 4 and all(len(value) == 3 for value in values)


@pytest.mark.real
def test_the_conformance_suite_of_mcap_reads_as_its_json_says(real_data: Path) -> None:
    folder = real_data / "mcap" / "conformance" / "data"
    paths = sorted(folder.rglob("*.mcap"))
    assert len(paths) == 416
    for path in paths:
        stated = json.loads(path.with_suffix(".json").read_text())["records"]
        fields = [dict(record["fields"]) for record in stated if record["type"] == "Message"]
        expected = [(int(f["log_time"]), bytes(int(b) for b in f["data"])) for f in fields]
        bag = Bag(path)
        found = [(place, record) for place, record in bag.records()]
        assert [(r.log_ns, bytes(r.data)) for _, r in found] == expected, path.name
        assert [*map(bytes, bag.payloads([place for place, _ in found]))] == [data for _, data in expected]
        assert bag.counts().total() == len(expected), path.name
        with path.open("rb") as file:
            messages = NonSeekingReader(file).iter_messages(log_time_order=False)
            assert [(r.channel.topic, r.log_ns) for _, r in found] == [
                (c.topic, m.log_time) for _, c, m in messages
            ]


CALIBRATION = """
id: camera_model
kind: real
frequency_hz: 10
action:
  space: mixed
  components:
    - {key: "/camera_calibration.K", dims: 9}
    - {key: "/camera_calibration/custom.D[0:2]", dims: 2}
state: {components: [{key: /camera_calibration.width, dims: 1}]}
cameras: [{name: cam, key: /image/compressed}]
sync: {max_skew_ms: 20}
source: {format: rosbag}
"""


@pytest.mark.real
def test_a_real_recording_with_pictures_becomes_a_clip(real_data: Path) -> None:
    path = real_data / "mcap" / "custom-camera-model.mcap"
    with path.open("rb") as file:
        messages = [(c.topic, json.loads(m.data)) for _, c, m in make_reader(file).iter_messages()]
    embodiment = arm(CALIBRATION)
    assert SOURCE.index(str(path), embodiment)[0].frames == 10
    clip = to_clip(read(path, embodiment), embodiment)
    calibrations = [m for topic, m in messages if topic == "/camera_calibration"]
    np.testing.assert_array_equal(clip.actions[:, :9], np.float32([m["K"] for m in calibrations]))
    np.testing.assert_array_equal(clip.actions[:, 9:], np.float32([[-0.2, 0.1]] * 10))
    np.testing.assert_array_equal(clip.states, np.float32([[m["width"]] for m in calibrations]))
    frames = clip.frames_at("cam", np.arange(len(clip)))
    assert frames.shape == (10, 360, 520, 3)
    import base64

    first = base64.b64decode(next(m["data"] for topic, m in messages if topic == "/image/compressed"))
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    expected = cv2.imdecode(np.frombuffer(first, np.uint8), flags)[..., ::-1]
    np.testing.assert_array_equal(frames[0], expected)


@pytest.mark.real
def test_an_empty_bag_and_one_without_messages_are_told(real_data: Path) -> None:
    folder = real_data / "ros1" / "foxglove" / "fixtures"
    with pytest.raises(SourceError, match="is empty"):
        SOURCE.inspect(str(folder / "empty-file.bag"))
    with pytest.raises(SourceError, match="no bag holds a message"):
        SOURCE.inspect(str(folder / "no-messages.bag"))
    with pytest.raises(EpisodeError, match="it has no topics"):
        read(folder / "no-messages.bag", arm())
