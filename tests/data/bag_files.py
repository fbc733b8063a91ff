"""One short recording, written as every kind of bag by the formats' own writers, and its embodiment.

A camera of 10 Hz and joints of 50 Hz with header stamps, received 5 ms late; commands of 25 Hz
without a header.
"""

import base64
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from mcap.writer import CompressionType
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from hma_data.episodes.episode import Episode
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import open_source
from tests.data import ros2
from tests.data.ros2 import START_NS

LATE_NS = 5_000_000
JOINTS = ("shoulder", "elbow", "wrist")
CAMERA, STATE, COMMAND = "/cam/image.raw", "/joint_states", "/command"


@dataclass(frozen=True)
class Recording:
    """The content of the bags: times in ns, (T, H, W, 3) pictures, (S, 3) joints, (C, 2) commands."""

    picture_ns: np.ndarray
    pictures: np.ndarray
    joint_ns: np.ndarray
    joints: np.ndarray
    command_ns: np.ndarray
    commands: np.ndarray
    stamp_shift_ns: np.ndarray | None = None  # (T,) added to the pictures' header stamps alone


class Item(NamedTuple):
    """A message to write: `stamp_ns` None where its type has no header."""

    topic: str
    log_ns: int
    stamp_ns: int | None
    value: np.ndarray


def make_recording(frames: int = 10, seed: int = 0) -> Recording:
    draw = np.random.default_rng(seed)
    return Recording(
        START_NS + np.arange(frames) * 100_000_000,
        draw.integers(0, 256, (frames, 24, 32, 3), dtype=np.uint8),
        START_NS + np.arange(frames * 5) * 20_000_000,
        draw.normal(size=(frames * 5, 3)),
        START_NS + np.arange(frames * 5 // 2) * 40_000_000,
        draw.normal(size=(frames * 5 // 2, 2)),
    )


def items(recording: Recording) -> Iterator[Item]:
    stamps = recording.picture_ns
    if recording.stamp_shift_ns is not None:
        stamps = stamps + recording.stamp_shift_ns
    found = [
        Item(CAMERA, int(t) + LATE_NS, int(stamp), picture)
        for t, stamp, picture in zip(recording.picture_ns, stamps, recording.pictures)
    ]
    found += [Item(STATE, int(t) + LATE_NS, int(t), v) for t, v in zip(recording.joint_ns, recording.joints)]
    found += [Item(COMMAND, int(t), None, v) for t, v in zip(recording.command_ns, recording.commands)]
    return iter(sorted(found, key=lambda item: item.log_ns))


ROS_TYPES = {
    CAMERA: "sensor_msgs/msg/Image",
    STATE: "sensor_msgs/msg/JointState",
    COMMAND: "std_msgs/msg/Float64MultiArray",
}


def ros_message(store: Any, item: Item) -> Any:
    types = store.types
    if item.topic == COMMAND:
        layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
        return types[ROS_TYPES[COMMAND]](layout=layout, data=item.value)
    header = ros2.header(item.stamp_ns, store)
    if item.topic == STATE:
        none = np.zeros(0)
        return types[ROS_TYPES[STATE]](header, list(JOINTS), item.value, velocity=none, effort=none)
    height, width = item.value.shape[:2]
    return types[ROS_TYPES[CAMERA]](header, height, width, "rgb8", 0, width * 3, item.value.reshape(-1))


def send(writer: Ros1Writer | Ros2Writer, recording: Recording, store: Any) -> None:
    sent = ((item.topic, ros_message(store, item), item.log_ns) for item in items(recording))
    ros2.send(writer, sent, store)


def write_ros1(path: Path, recording: Recording, compression: str | None = None) -> Path:
    writer = Ros1Writer(path)
    if compression:
        writer.set_compression(Ros1Writer.CompressionFormat[compression])
    send(writer, recording, get_typestore(Stores.ROS1_NOETIC))
    return path


def write_ros2(
    path: Path, recording: Recording, plugin: str, mode: CompressionMode = CompressionMode.NONE
) -> Path:
    writer = Ros2Writer(path, version=9, storage_plugin=StoragePlugin[plugin])
    writer.set_compression(mode, CompressionFormat.ZSTD)
    send(writer, recording, ros2.TYPES)
    return path


class Encoded(NamedTuple):
    """The way of a topic's messages into an MCAP file: `encode` makes an item's bytes."""

    type: str
    schema_encoding: str
    schema: bytes
    encoding: str
    encode: Callable[[Item], bytes]


def write_mcap(path: Path, recording: Recording, how: dict[str, Encoded], **options: Any) -> Path:
    sent = ((item, how[item.topic]) for item in items(recording))
    messages = ((item.topic, ros2.Kind(*how[:4]), item.log_ns, how.encode(item)) for item, how in sent)
    return ros2.write_mcap(path, messages, chunk_size=8192, **options)


def as_ros1() -> dict[str, Encoded]:
    store = get_typestore(Stores.ROS1_NOETIC)
    names = {kind: kind.replace("/msg/", "/") for kind in ROS_TYPES.values()}
    return as_ros(store, "ros1msg", "ros1", store.serialize_ros1, names)


def as_cdr() -> dict[str, Encoded]:
    store = get_typestore(Stores.ROS2_HUMBLE)
    return as_ros(store, "ros2msg", "cdr", store.serialize_cdr, {}, ros_version=2)


def as_ros(
    store: Any,
    schema: str,
    encoding: str,
    serialize: Callable[..., Any],
    names: dict[str, str],
    **version: int,
) -> dict[str, Encoded]:
    def encode(item: Item) -> bytes:
        return bytes(serialize(ros_message(store, item), ROS_TYPES[item.topic]))

    return {
        topic: Encoded(
            names.get(kind, kind),
            schema,
            store.generate_msgdef(kind, **version)[0].encode(),
            encoding,
            encode,
        )
        for topic, kind in ROS_TYPES.items()
    }


def as_json() -> dict[str, Encoded]:
    return {
        CAMERA: Encoded("foxglove.CompressedImage", "jsonschema", b"{}", "json", _json_picture),
        STATE: Encoded("JointState", "jsonschema", b"{}", "json", _json_joints),
        COMMAND: Encoded(
            "Command", "jsonschema", b"{}", "json", lambda i: json.dumps({"data": i.value.tolist()}).encode()
        ),
    }


def _json_picture(item: Item) -> bytes:
    png = cv2.imencode(".png", item.value[..., ::-1])[1].tobytes()
    seconds, nanoseconds = divmod(item.stamp_ns, 10**9)
    return json.dumps(
        {
            "timestamp": {"sec": seconds, "nsec": nanoseconds},
            "format": "png",
            "data": base64.b64encode(png).decode(),
        }
    ).encode()


def _json_joints(item: Item) -> bytes:
    seconds, nanoseconds = divmod(item.stamp_ns, 10**9)
    return json.dumps(
        {
            "header": {"stamp": {"sec": seconds, "nsec": nanoseconds}},
            "name": JOINTS,
            "position": item.value.tolist(),
        }
    ).encode()


NUMBER, TEXT, UINT32, BLOB, MESSAGE = 1, 9, 7, 12, 11  # field types of descriptor.proto
ONE, MANY = 1, 3  # and labels


def protobuf_types(layout: dict[str, list[tuple[str, int, int]]]) -> tuple[bytes, dict[str, Any]]:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

    files = descriptor_pb2.FileDescriptorSet()
    timestamp_pb2.DESCRIPTOR.CopyToProto(files.file.add())
    own = files.file.add(name="robot.proto", package="foxglove", syntax="proto3")
    own.dependency.append("google/protobuf/timestamp.proto")
    stamp = {"type": MESSAGE, "type_name": ".google.protobuf.Timestamp"}
    for name, fields in layout.items():
        kind = own.message_type.add(name=name)
        kind.field.add(name="timestamp", number=1, **stamp)
        for i, (field, field_type, label) in enumerate(fields):
            kind.field.add(name=field, number=i + 2, type=field_type, label=label)
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    found = {name: pool.FindMessageTypeByName(f"foxglove.{name}") for name in layout}
    types = {name: message_factory.GetMessageClass(one) for name, one in found.items()}
    return files.SerializeToString(), types


def as_protobuf() -> dict[str, Encoded]:
    sizes = [(name, UINT32, ONE) for name in ("width", "height", "step")]
    layout = {
        "RawImage": [*sizes, ("encoding", TEXT, ONE), ("data", BLOB, ONE)],
        "Joints": [("name", TEXT, MANY), ("position", NUMBER, MANY)],
        "Command": [("data", NUMBER, MANY)],
    }
    schema, types = protobuf_types(layout)

    def encode(item: Item) -> bytes:
        if item.topic == COMMAND:
            return types["Command"](data=item.value).SerializeToString()
        if item.topic == STATE:
            made = types["Joints"](name=JOINTS, position=item.value)
        else:
            height, width = item.value.shape[:2]
            made = types["RawImage"](
                width=width, height=height, step=width * 3, encoding="rgb8", data=item.value.tobytes()
            )
        made.timestamp.FromNanoseconds(item.stamp_ns)
        return made.SerializeToString()

    names = {CAMERA: "RawImage", STATE: "Joints", COMMAND: "Command"}
    return {t: Encoded(f"foxglove.{n}", "protobuf", schema, "protobuf", encode) for t, n in names.items()}


LZ4, ZSTD, PLAIN = CompressionType.LZ4, CompressionType.ZSTD, CompressionType.NONE
KINDS: dict[str, Callable[[Path, Recording], Path]] = {
    "ros1": lambda d, r: write_ros1(d / "run.bag", r),
    "ros1-bz2": lambda d, r: write_ros1(d / "run.bag", r, "BZ2"),
    "ros1-lz4": lambda d, r: write_ros1(d / "run.bag", r, "LZ4"),
    "ros2-sqlite3": lambda d, r: write_ros2(d / "run", r, "SQLITE3"),
    "ros2-sqlite3-messages-zstd": lambda d, r: write_ros2(d / "run", r, "SQLITE3", CompressionMode.MESSAGE),
    "ros2-sqlite3-file-zstd": lambda d, r: write_ros2(d / "run", r, "SQLITE3", CompressionMode.FILE),
    "ros2-mcap": lambda d, r: write_ros2(d / "run", r, "MCAP"),
    "ros2-mcap-file-zstd": lambda d, r: write_ros2(d / "run", r, "MCAP", CompressionMode.FILE),
    "ros2-mcap-chunks-zstd": lambda d, r: write_ros2(d / "run", r, "MCAP", CompressionMode.STORAGE),
    "mcap-ros1-lz4": lambda d, r: write_mcap(d / "run.mcap", r, as_ros1(), compression=LZ4),
    "mcap-cdr-zstd": lambda d, r: write_mcap(d / "run.mcap", r, as_cdr(), compression=ZSTD),
    "mcap-json": lambda d, r: write_mcap(d / "run.mcap", r, as_json(), compression=PLAIN),
    "mcap-protobuf": lambda d, r: write_mcap(d / "run.mcap", r, as_protobuf()),
    "mcap-without-chunks": lambda d, r: write_mcap(d / "run.mcap", r, as_cdr(), use_chunking=False),
    "mcap-channels-not-repeated": lambda d, r: write_mcap(d / "run.mcap", r, as_cdr(), repeat_channels=False),
    "mcap-without-statistics": lambda d, r: write_mcap(d / "run.mcap", r, as_cdr(), use_statistics=False),
}  # fmt: skip


YAML = f"""
id: test_arm
kind: real
frequency_hz: 10
action:
  space: joint_position
  components:
    - {{key: {COMMAND}.data, dims: 2}}
    - {{key: {STATE}.position, dims: 2, names: [wrist, shoulder]}}
state: {{components: [{{key: "{STATE}.position[0:2]", dims: 2, sign: -1, offset: 0.5}}]}}
cameras: [{{name: front, key: {CAMERA}}}]
sync: {{max_skew_ms: 60}}
source: {{format: rosbag}}
"""


def arm(text: str = YAML, **changes: str) -> Embodiment:
    for old, new in changes.items():
        text = text.replace(old, new)
    return Embodiment.from_yaml(text)


SOURCE = open_source("rosbag")


def read(path: Path, embodiment: Embodiment) -> Episode:
    return SOURCE.read(str(path), SOURCE.episode_ids(str(path))[0], embodiment)
