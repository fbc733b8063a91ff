"""Write an episode to MCAP as a ROS 2 recorder would: CDR messages, and the definitions of their types.

A message has two times: its header's stamp, which is the time of the event, and the later time at which the
recorder received it. Messages are in the file in the order of receipt.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

DISTRO = "jazzy"


@dataclass(frozen=True)
class Message:
    """A message to write.

    Attributes:
            topic: name with leading slash.
            stamp_ns, received_ns: nanoseconds since 1970.
            type: e.g. sensor_msgs/msg/JointState.
            content: value of that type, from `picture`, `joints` or `twist`.
    """

    topic: str
    stamp_ns: int
    received_ns: int
    type: str
    content: Any


def picture(topic: str, stamp_ns: int, received_ns: int, image: NDArray[np.uint8], frame: str) -> Message:
    """Return a sensor_msgs/CompressedImage; image (H, W, 3) RGB is stored as PNG, without loss."""
    import cv2

    _, png = cv2.imencode(".png", image[..., ::-1])
    kind = "sensor_msgs/msg/CompressedImage"
    content = _types().types[kind](header=_header(stamp_ns, frame), format="png", data=png.reshape(-1))
    return Message(topic, stamp_ns, received_ns, kind, content)


def joints(
    topic: str,
    stamp_ns: int,
    received_ns: int,
    names: Sequence[str],
    position: NDArray[np.float64],
    velocity: NDArray[np.float64],
    frame: str,
) -> Message:
    """Return a sensor_msgs/JointState of (n,) positions and velocities."""
    kind = "sensor_msgs/msg/JointState"
    content = _types().types[kind](
        header=_header(stamp_ns, frame),
        name=list(names),
        position=position,
        velocity=velocity,
        effort=np.empty(0),
    )
    return Message(topic, stamp_ns, received_ns, kind, content)


def twist(topic: str, stamp_ns: int, received_ns: int, linear: NDArray[np.float64], frame: str) -> Message:
    """Return a geometry_msgs/TwistStamped with linear (3,) and no rotation."""
    kind, types = "geometry_msgs/msg/TwistStamped", _types().types
    vector = types["geometry_msgs/msg/Vector3"]
    x, y, z = (float(value) for value in linear)
    still = vector(x=0.0, y=0.0, z=0.0)
    motion = types["geometry_msgs/msg/Twist"](linear=vector(x=x, y=y, z=z), angular=still)
    content = types[kind](header=_header(stamp_ns, frame), twist=motion)
    return Message(topic, stamp_ns, received_ns, kind, content)


def write_messages(path: Path, messages: Sequence[Message], facts: Mapping[str, str]) -> None:
    """Write one MCAP file in the ROS 2 profile; `facts` become its metadata record "episode"."""
    store = _types()
    channels: dict[str, int] = {}
    schemas: dict[str, int] = {}
    sequence: dict[str, int] = {}
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=256 * 1024, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="hma_data.lab")
        writer.add_metadata("rosbag2", {"ROS_DISTRO": DISTRO})
        writer.add_metadata("episode", dict(facts))
        for message in sorted(messages, key=lambda item: (item.received_ns, item.topic)):
            if message.type not in schemas:
                definition, _ = store.generate_msgdef(message.type, ros_version=2)
                schemas[message.type] = writer.register_schema(message.type, "ros2msg", definition.encode())
            if message.topic not in channels:
                channels[message.topic] = writer.register_channel(
                    message.topic, "cdr", schemas[message.type], {"offered_qos_profiles": ""}
                )
            sequence[message.topic] = sequence.get(message.topic, 0) + 1
            writer.add_message(
                channels[message.topic],
                log_time=message.received_ns,
                data=bytes(store.serialize_cdr(message.content, message.type)),
                publish_time=message.stamp_ns,
                sequence=sequence[message.topic],
            )
        writer.finish()


@cache
def _types() -> Any:
    return get_typestore(Stores(f"ros2_{DISTRO}"))


def _header(stamp_ns: int, frame: str) -> Any:
    types = _types().types
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)
