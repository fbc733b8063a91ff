"""Messages of ROS, and bags of them; frames of a camera carry their number as a level of grey."""

import shutil
from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import av
import cv2
import numpy as np
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hma_data.episodes.episode import Clip

START_NS = 1_700_000_000 * 10**9
LEVELS = 4  # of grey from a frame to the next
TYPES = get_typestore(Stores.ROS2_HUMBLE)
Sent = tuple[str, Any, int]  # topic, message, time of receipt


def define(name: str, text: str) -> Any:
    TYPES.register(get_types_from_msg(text, name))
    return TYPES.types[name]


def write(path: Path, messages: Iterable[Sent], mcap: bool = False) -> Path:
    shutil.rmtree(path, ignore_errors=True)
    plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    send(Writer(path, version=9, storage_plugin=plugin), messages)
    return path


def send(writer: Ros1Writer | Writer, messages: Iterable[Sent], store: Any = TYPES) -> None:
    """Write messages, of that store's types, with a writer of rosbags."""
    serialize = store.serialize_ros1 if isinstance(writer, Ros1Writer) else store.serialize_cdr
    connections: dict[str, Any] = {}
    with writer:
        for topic, message, received in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], received, serialize(message, kind))


class Kind(NamedTuple):
    """The type of an MCAP channel's messages; without a schema, JSON."""

    type: str = ""
    schema_encoding: str = ""
    schema: bytes = b""
    encoding: str = "json"


def kind_of(message: Any) -> Kind:
    """Return the kind of a message of ROS 2."""
    text = TYPES.generate_msgdef(message.__msgtype__, ros_version=2)[0]
    return Kind(message.__msgtype__, "ros2msg", text.encode(), "cdr")


def cdr(message: Any) -> bytes:
    return bytes(TYPES.serialize_cdr(message, message.__msgtype__))


def write_mcap(path: Path, messages: Iterable[tuple[str, Kind, int, bytes]], **options: Any) -> Path:
    """An MCAP file by mcap's writer, of topics, kinds, times of receipt and encoded messages."""
    with path.open("wb") as file:
        writer = McapWriter(file, **options)
        writer.start()
        channels: dict[tuple[str, Kind], int] = {}
        for topic, kind, received, data in messages:
            if (topic, kind) not in channels:
                schema = writer.register_schema(*kind[:3]) if kind.type else 0
                channels[topic, kind] = writer.register_channel(topic, kind.encoding, schema)
            writer.add_message(channels[topic, kind], received, data, received)
        writer.finish()
    return path


def stamp(ns: int, store: Any = TYPES) -> Any:
    return store.types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)


def header(ns: int, store: Any = TYPES) -> Any:
    kind = store.types["std_msgs/msg/Header"]
    more = {"seq": 0} if "seq" in kind.__dataclass_fields__ else {}
    return kind(stamp=stamp(ns, store), frame_id="x", **more)


def pixels(number: int, side: int = 32) -> np.ndarray:
    """An image of one grey, darker in a corner so that it is not blank."""
    found = np.full((side, side, 3), 40 + LEVELS * number, np.uint8)
    found[: side // 4, : side // 4] = 0
    return found


def image(ns: int, number: int) -> Any:
    data = cv2.imencode(".png", pixels(number))[1]
    return compressed(ns, "png", data.tobytes())


def compressed(ns: int, format_: str, data: bytes) -> Any:
    kind = TYPES.types["sensor_msgs/msg/CompressedImage"]
    return kind(header=header(ns), format=format_, data=np.frombuffer(data, np.uint8))


def joints(ns: int, names: Sequence[str], positions: Sequence[float]) -> Any:
    none = np.zeros(0)
    kind = TYPES.types["sensor_msgs/msg/JointState"]
    return kind(header(ns), list(names), np.asarray(positions, np.float64), none, none)


def array(values: Sequence[float]) -> Any:
    layout = TYPES.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    kind = TYPES.types["std_msgs/msg/Float64MultiArray"]
    return kind(layout=layout, data=np.asarray(values, np.float64))


def numbers(clip: Clip, camera: str = "cam") -> list[int]:
    frames = clip.episode.streams[camera].frames(clip.frame_indices[camera])
    return [round((float(np.median(frame)) - 40) / LEVELS) for frame in frames]


def packets(
    pictures: Iterable[np.ndarray], encoder: str, options: dict[str, str], gop: int, pixels: str = "yuv420p"
) -> list[tuple[int, bytes]]:
    """Return what an encoder makes of pictures of one size: the number of the picture, and its bytes."""
    context = None
    found = []
    for i, picture in enumerate(pictures):
        if context is None:
            context = av.CodecContext.create(encoder, "w")
            context.height, context.width = picture.shape[:2]
            context.pix_fmt, context.gop_size, context.options = pixels, gop, options
            context.time_base, context.framerate = Fraction(1, 10), Fraction(10, 1)
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
        frame.pts = i
        found += context.encode(frame.reformat(format=pixels))
    return [(packet.pts, bytes(packet)) for packet in found + context.encode(None)]
