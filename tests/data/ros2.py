"""ROS 2 bags of a camera whose frames carry their number as a level of grey, and of any other messages."""

import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
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
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        for topic, message, received in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=TYPES)
            writer.write(connections[topic], received, TYPES.serialize_cdr(message, kind))
    return path


def stamp(ns: int) -> Any:
    return TYPES.types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)


def header(ns: int) -> Any:
    return TYPES.types["std_msgs/msg/Header"](stamp=stamp(ns), frame_id="x")


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
