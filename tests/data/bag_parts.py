"""Bags that hold several episodes: a camera, commands, a rare gripper, and what marks the episodes.

The camera ticks at 10 Hz with header stamps, received 5 ms late; everything else has no header.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.writer import CompressionType, IndexType
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from hma_data.registry.embodiment import Embodiment
from tests.data import ros2
from tests.data.bag_files import START_NS, arm
from tests.hostile import without_index

LATE_NS = 5_000_000
CAMERA, COMMAND, GRIPPER, STATE, TASK = "/cam", "/command", "/gripper", "/state", "/task"
TYPES = {
    CAMERA: "sensor_msgs/msg/Image",
    COMMAND: "std_msgs/msg/Float64",
    GRIPPER: "std_msgs/msg/Float64",
    STATE: "std_msgs/msg/Bool",
    TASK: "std_msgs/msg/String",
}


class Said(NamedTuple):
    """A message: received so many seconds after the start."""

    topic: str
    at_s: float
    value: Any


@dataclass(frozen=True)
class Run:
    """The content of a bag.

    Attributes:
        times: (T,) of the pictures, seconds after the start; their stamps too.
        pictures: (T, 8, 8, 3).
        said: the other messages.
        stamps: of the pictures where they are not their times.
    """

    times: np.ndarray
    pictures: np.ndarray
    said: list[Said] = field(default_factory=list)
    stamps: np.ndarray | None = None

    def messages(self) -> list[Said]:
        pictures = [Said(CAMERA, float(t) + LATE_NS / 1e9, i) for i, t in enumerate(self.times)]
        return sorted([*pictures, *self.said], key=lambda item: item.at_s)


def make_run(frames: int = 60, pause_after: tuple[int, ...] = (), side: int = 8, **more: Any) -> Run:
    times = np.arange(frames) / 10
    for i in pause_after:
        times[i:] += 3.0
    pictures = np.random.default_rng(0).integers(0, 256, (frames, side, side, 3), dtype=np.uint8)
    said = [Said(COMMAND, t, t) for t in np.arange(0, times[-1] + 0.1, 0.04).round(3).tolist()]
    said += [Said(GRIPPER, -0.05, 0.7), *more.pop("said", [])]
    return Run(times, pictures, said, **more)


def _ns(at_s: float) -> int:
    return START_NS + round(at_s * 1e9)


def _message(store: Any, run: Run, item: Said) -> Any:
    kind = store.types[TYPES[item.topic]]
    if item.topic != CAMERA:
        return kind(item.value)
    stamps = run.times if run.stamps is None else run.stamps
    header = ros2.header(_ns(float(stamps[item.value])), store)
    side = run.pictures.shape[1]
    return kind(header, side, side, "rgb8", 0, side * 3, run.pictures[item.value].reshape(-1))


def _send(writer: Ros1Writer | Ros2Writer, run: Run, store: Any) -> None:
    sent = ((item.topic, _message(store, run, item), _ns(item.at_s)) for item in run.messages())
    ros2.send(writer, sent, store)


def ros1(folder: Path, run: Run, compression: str | None = None, chunk: int = 4096) -> Path:
    writer = Ros1Writer(folder / "run.bag")
    writer.chunk_threshold = chunk
    if compression:
        writer.set_compression(Ros1Writer.CompressionFormat[compression])
    _send(writer, run, get_typestore(Stores.ROS1_NOETIC))
    return folder / "run.bag"


def ros1_without_index(folder: Path, run: Run) -> Path:
    path = ros1(folder, run)
    path.write_bytes(without_index(path.read_bytes()))
    return path


def sqlite(folder: Path, run: Run) -> Path:
    _send(Ros2Writer(folder / "run", version=9, storage_plugin=StoragePlugin.SQLITE3), run, ros2.TYPES)
    return folder / "run"


def mcap(
    folder: Path, run: Run, more: Iterable[tuple[str, str, str, float, bytes]] = (), **options: Any
) -> Path:
    """An MCAP file; `more` are messages already encoded: topic, type, definition, seconds, bytes."""
    messages = []
    for item in run.messages():
        message = _message(ros2.TYPES, run, item)
        messages.append((item.topic, ros2.kind_of(message), _ns(item.at_s), ros2.cdr(message)))
    for topic, name, text, at_s, data in more:
        messages.append((topic, ros2.Kind(name, "ros2msg", text.encode(), "cdr"), _ns(at_s), data))
    messages.sort(key=lambda message: message[2])
    return ros2.write_mcap(folder / "run.mcap", messages, **{"chunk_size": 4096} | options)


PLAIN, ZSTD = CompressionType.NONE, CompressionType.ZSTD
KINDS: dict[str, Callable[[Path, Run], Path]] = {
    "ros1": ros1,
    "ros1-lz4": lambda d, r: ros1(d, r, "LZ4"),
    "ros1-without-index": ros1_without_index,
    "sqlite": sqlite,
    "mcap-zstd": lambda d, r: mcap(d, r, compression=ZSTD),
    "mcap-plain": lambda d, r: mcap(d, r, compression=PLAIN),
    "mcap-without-chunks": lambda d, r: mcap(d, r, use_chunking=False),
    "mcap-without-indexes": lambda d, r: mcap(
        d,
        r,
        index_types=IndexType.NONE,
        repeat_channels=False,
        use_summary_offsets=False,
        use_statistics=False,
    ),
}


def parted(segments: str, more: str = "") -> Embodiment:
    return arm(f"""
id: parted
kind: real
frequency_hz: 10
action:
  space: mixed
  components: [{{key: {COMMAND}.data, dims: 1}}, {{key: {GRIPPER}.data, dims: 1}}]
cameras: [{{name: cam, key: {CAMERA}}}]
source: {{format: rosbag, segments: {segments}{more}}}
""")
