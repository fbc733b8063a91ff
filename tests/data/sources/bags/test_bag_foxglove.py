"""Foxglove's messages in every encoding, and bags against the formats' own readers."""

import base64
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from mcap.reader import NonSeekingReader, make_reader
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hma_data.episodes.align import to_clip
from hma_data.errors import EpisodeError, SourceError
from hma_data.inspection.inspect import examine, inspect_recording
from hma_data.sources.bags.bag import Bag
from hma_data.sources.bags.container import Channel
from hma_data.sources.bags.messages import decode, numbers
from hma_data.tokenizers import get_tokenizer
from hma_data.tokenizers.training.frames import recording_films
from tests.data import bag_parts, ros2
from tests.data.bag_files import (
    BLOB,
    CAMERA,
    ONE,
    SOURCE,
    TEXT,
    UINT32,
    arm,
    as_cdr,
    make_recording,
    protobuf_types,
    read,
    ros_message,
    write_mcap,
)
from tests.data.sources.bags.test_bag_pictures import LOW_DELAY, VIDEO_YAML, gradients

PICTURES = np.random.default_rng(3).integers(0, 256, (6, 10, 14, 3), np.uint8)
FIELDS = {
    "CompressedImage": "string frame_id\nuint8[] data\nstring format\n",
    "RawImage": "string frame_id\nuint32 width\nuint32 height\nstring encoding\nuint32 step\nuint8[] data\n",
    "CompressedVideo": "string frame_id\nuint8[] data\nstring format\n",
}


def png(picture: np.ndarray) -> np.ndarray:
    return cv2.imencode(".png", picture[..., ::-1])[1].reshape(-1)


def values(name: str, pictures: np.ndarray) -> list[dict[str, Any]]:
    if name == "RawImage":
        height, width = pictures.shape[1:3]
        about = {"width": width, "height": height, "encoding": "rgb8", "step": width * 3}
        return [about | {"data": picture.reshape(-1)} for picture in pictures]
    if name == "CompressedImage":
        return [{"data": png(picture), "format": "png"} for picture in pictures]
    return [
        {"data": np.frombuffer(data, np.uint8), "format": "h264"}
        for _, data in ros2.packets(pictures, "libx264", LOW_DELAY, gop=10)
    ]


def ros_encoder(name: str, encoding: str) -> tuple[str, str, bytes, Callable[[int, dict[str, Any]], bytes]]:
    one = encoding == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if one else Stores.ROS2_HUMBLE)
    text = ("time timestamp\n" if one else "builtin_interfaces/Time timestamp\n") + FIELDS[name]
    kind = f"foxglove_msgs/msg/{name}"
    store.register(get_types_from_msg(text, kind))
    write = store.serialize_ros1 if one else store.serialize_cdr

    def encode(i: int, fields: dict[str, Any]) -> bytes:
        stamp = store.types["builtin_interfaces/msg/Time"](sec=1 + i, nanosec=500)
        return bytes(write(store.types[kind](timestamp=stamp, frame_id="cam", **fields), kind))

    schema = text if one else store.generate_msgdef(kind, ros_version=2)[0]
    return (
        kind.replace("/msg/", "/") if one else kind,
        f"ros{encoding[-1] if one else 2}msg",
        schema.encode(),
        encode,
    )


def protobuf_encoder(name: str) -> tuple[str, str, bytes, Callable[[int, dict[str, Any]], bytes]]:
    kinds = {"string": TEXT, "uint32": UINT32, "uint8[]": BLOB}
    lines = [line.split() for line in FIELDS[name].splitlines()]
    schema, types = protobuf_types({name: [(field, kinds[kind], ONE) for kind, field in lines]})

    def encode(i: int, fields: dict[str, Any]) -> bytes:
        message = types[name](**(fields | {"data": fields["data"].tobytes(), "frame_id": "cam"}))
        message.timestamp.FromNanoseconds((1 + i) * 10**9 + 500)
        return bytes(message.SerializeToString())

    return f"foxglove.{name}", "protobuf", schema, encode


def write(path: Path, name: str, encoding: str, pictures: np.ndarray) -> Path:
    made = protobuf_encoder(name) if encoding == "protobuf" else ros_encoder(name, encoding)
    kind, encode = ros2.Kind(*made[:3], encoding), made[3]
    messages = []
    for i, fields in enumerate(values(name, pictures)):
        messages.append(("/video", kind, (i + 1) * 10**9 + 900, encode(i, fields)))
        messages.append(("/n", ros2.Kind(), (i + 1) * 10**9, b'{"value": 1}'))
    return ros2.write_mcap(path, messages, chunk_size=4096)


@pytest.mark.parametrize("encoding", ["cdr", "ros1", "protobuf"])
@pytest.mark.parametrize("name", ["CompressedImage", "RawImage"])
def test_foxglove_pictures_in_every_encoding(tmp_path: Path, name: str, encoding: str) -> None:
    episode = read(write(tmp_path / "run.mcap", name, encoding, PICTURES), arm(VIDEO_YAML))
    stream = episode.streams["cam"]
    np.testing.assert_array_equal(stream.frames(range(6)), PICTURES)
    np.testing.assert_allclose(stream.timestamps, np.arange(1, 7) + 500e-9, atol=1e-9)


@pytest.mark.parametrize("encoding", ["cdr", "ros1", "protobuf"])
def test_foxglove_video_in_every_encoding(tmp_path: Path, encoding: str) -> None:
    pictures = gradients(24)
    path = write(tmp_path / "run.mcap", "CompressedVideo", encoding, pictures)
    stream = read(path, arm(VIDEO_YAML)).streams["cam"]
    for indices in ([0, 5], [23], [11, 4]):
        assert np.abs(stream.frames(indices).astype(int) - pictures[indices]).mean() < 4, indices


def test_big_endian_messages_are_read(tmp_path: Path) -> None:
    recording = make_recording(4)
    store = get_typestore(Stores.ROS2_HUMBLE)
    how = as_cdr()
    for topic, encoded in how.items():

        def encode(item: Any, kind: str = encoded.type) -> bytes:
            message = ros_message(store, item)
            if item.topic == CAMERA:
                message.is_bigendian = 1  # it says so of pixels of several bytes, which rgb8 has not
            return bytes(store.serialize_cdr(message, kind, little_endian=False))

        how[topic] = encoded._replace(encode=encode)
    episode = read(write_mcap(tmp_path / "run.mcap", recording, how), arm())
    stream = episode.streams["front"]
    np.testing.assert_array_equal(stream.frames(range(4)), recording.pictures)
    np.testing.assert_allclose(stream.timestamps, recording.picture_ns / 1e9, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(episode.actions[0].values, recording.commands.astype(np.float32))


def test_inspect_doctor_and_eval_look_at_the_embodiments_episodes(tmp_path, monkeypatch) -> None:
    path = bag_parts.mcap(tmp_path, bag_parts.make_run(60, pause_after=(20, 40)))
    robot = bag_parts.parted("{gap_s: 1}")
    where = tmp_path / "robot.yaml"
    where.write_text(robot.to_yaml())
    facts = inspect_recording(str(path), str(where))["embodiment"]
    assert facts["first episode"].startswith("run/0000: 20 frames")
    asked: list[str] = []
    plain = type(SOURCE).read

    def spy(self: Any, uri: str, name: str, embodiment: Any) -> Any:
        asked.append(name)
        return plain(self, uri, name, embodiment)

    monkeypatch.setattr(type(SOURCE), "read", spy)
    examine(str(path), str(where))
    list(recording_films(robot, str(path), get_tokenizer("raw").spec, frames=2))
    assert asked == ["run/0000", "run/0001", "run/0002"] * 2


@pytest.mark.parametrize("left_out", [(), ("google/protobuf/timestamp.proto",)])
def test_a_schema_may_list_its_files_in_any_order(left_out: tuple[str, ...]) -> None:
    from google.protobuf import descriptor_pb2

    name, encoding, schema, encode = protobuf_encoder("CompressedImage")
    files, turned = descriptor_pb2.FileDescriptorSet(), descriptor_pb2.FileDescriptorSet()
    files.ParseFromString(schema)
    turned.file.extend(item for item in reversed(files.file) if item.name not in left_out)
    message = {"frame_id": "cam", "data": np.frombuffer(b"jpeg", np.uint8), "format": "jpeg"}
    decoded = decode(
        Channel("/cam", name, encoding, "protobuf", turned.SerializeToString()), encode(7, message), ""
    )
    assert decoded.frame_id == "cam" and bytes(decoded.data) == b"jpeg"


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
    seen = 0
    for path in sorted((real_data / "ros2").rglob("metadata.yaml")):
        stated = yaml.safe_load(path.read_text())["rosbag2_bagfile_information"]
        found = sum(1 for _ in Bag(path.parent).records())
        assert found == stated["message_count"] == Bag(path.parent).counts().total(), path
        seen += 1
    assert seen >= 15


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
    first = base64.b64decode(next(m["data"] for topic, m in messages if topic == "/image/compressed"))
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    expected = cv2.imdecode(np.frombuffer(first, np.uint8), flags)[..., ::-1]
    np.testing.assert_array_equal(frames[0], expected)


@pytest.mark.real
def test_a_bag_without_messages_is_told(real_data: Path) -> None:
    folder = real_data / "ros1" / "foxglove" / "fixtures"
    with pytest.raises(SourceError, match="no bag holds a message"):
        SOURCE.inspect(str(folder / "no-messages.bag"))
    with pytest.raises(EpisodeError, match="it has no topics"):
        read(folder / "no-messages.bag", arm())
