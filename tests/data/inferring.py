"""What the tests of infer share: a YAML inferred, answered and read back; bags of chosen topics."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from hma_data.episodes.align import to_clip
from hma_data.episodes.episode import Clip
from hma_data.inspection.infer import infer
from hma_data.registry.embodiment import TODO, Embodiment, todos
from hma_data.sources.base import open_source
from hma_data.storage.yaml_io import parse_yaml
from tests.conftest import problems
from tests.data.bag_files import START_NS
from tests.data.rlds_files import png

T, H, W = 12, 24, 32
ANSWERS = {"robot": "arm", "kind": "real", "frequency_hz": 10, "space": "mixed", "color": "rgb"}


def inferred(path: Path) -> dict[str, Any]:
    """The values of the YAML, whose only problems are questions."""
    values = parse_yaml(infer(str(path), "mine"), "inferred")
    assert all("still TODO" in problem for problem in problems(values)), problems(values)
    return dict(values)


def questions(values: dict[str, Any]) -> dict[str, str]:
    return dict(todos(values))


def answered(values: Any) -> Any:
    if isinstance(values, dict):
        return {key: _answer(key, value) for key, value in values.items()}
    return [answered(value) for value in values] if isinstance(values, list) else values


def _answer(key: str, value: Any) -> Any:
    asked = isinstance(value, str) and value.startswith(TODO)
    if key == "provenance":
        return dict.fromkeys(value, "the one who recorded it")
    return ANSWERS.get(key, "the one who recorded it") if asked else answered(value)


def first_clip(path: Path, values: dict[str, Any]) -> Clip:
    """The first episode as the answered YAML reads it, all of it finite and of the size it states."""
    robot = Embodiment.from_values(answered(values), "inferred")
    source = open_source(robot.source.format)
    clip = to_clip(source.read(str(path), source.episode_ids(str(path))[0], robot), robot)
    assert clip.actions.shape[1] == robot.action_dim and np.isfinite(clip.actions).all()
    for camera in robot.cameras:
        assert clip.frames_at(camera.name, np.arange(1)).shape[1:3] == camera.size
    return clip


def keys(values: dict[str, Any], section: str) -> list[str]:
    found = values[section] if section == "cameras" else values[section]["components"]
    return [item["key"] for item in found]


def pictures(seed: int = 0, length: int = T) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (length, H, W, 3), dtype=np.uint8)


def numbers(*shape: int) -> np.ndarray:
    return np.random.default_rng(len(shape)).normal(size=shape)


# -- bags of chosen topics


Message = tuple[str, Callable[[Any, int], Any]]  # its type, and (typestore, ns) -> message


def header(store: Any, ns: int) -> Any:
    stamp = store.types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
    kind = store.types["std_msgs/msg/Header"]
    return kind(stamp=stamp, frame_id="", **({"seq": 0} if "seq" in kind.__dataclass_fields__ else {}))


def picture_of(encoding: str = "rgb8", shift_ns: int = 0) -> Message:
    def make(store: Any, ns: int) -> Any:
        shot = pictures(1, 1)[0] if encoding == "rgb8" else pictures(1, 1)[0, ..., 0]
        if encoding == "mono16":
            shot = (shot.astype("<u2") * 16).view(np.uint8)  # 12 bits
        about = (header(store, ns + shift_ns), H, W, encoding, 0, shot[0].nbytes, shot.reshape(-1))
        return store.types["sensor_msgs/msg/Image"](*about)

    return "sensor_msgs/msg/Image", make


def compressed_of() -> Message:
    def make(store: Any, ns: int) -> Any:
        data = np.frombuffer(png(pictures(1, 1)[0]), np.uint8)
        return store.types["sensor_msgs/msg/CompressedImage"](header(store, ns), "png", data)

    return "sensor_msgs/msg/CompressedImage", make


def joints_of(*names: str) -> Message:
    def make(store: Any, ns: int) -> Any:
        values = np.arange(len(names)) + ns % 7
        kind = store.types["sensor_msgs/msg/JointState"]
        return kind(header(store, ns), list(names), values * 1.0, values * 0.5, values * 0.1)

    return "sensor_msgs/msg/JointState", make


def twist() -> Message:
    def make(store: Any, ns: int) -> Any:
        vector = store.types["geometry_msgs/msg/Vector3"]
        return store.types["geometry_msgs/msg/Twist"](vector(0.1, 0.0, 0.0), vector(0.0, 0.0, 0.2))

    return "geometry_msgs/msg/Twist", make


def pose() -> Message:
    def make(store: Any, ns: int) -> Any:
        point = store.types["geometry_msgs/msg/Point"](0.1, 0.2, 0.3)
        turn = store.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        inner = store.types["geometry_msgs/msg/Pose"](point, turn)
        return store.types["geometry_msgs/msg/PoseStamped"](header(store, ns), inner)

    return "geometry_msgs/msg/PoseStamped", make


def floats(count: int) -> Message:
    def make(store: Any, ns: int) -> Any:
        layout = store.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
        return store.types["std_msgs/msg/Float64MultiArray"](layout, np.arange(count) * 1.0)

    return "std_msgs/msg/Float64MultiArray", make


def switch(low: float, high: float) -> Message:
    kind, make = floats(1)

    def turn(store: Any, ns: int) -> Any:
        message = make(store, ns)
        message.data[:] = high if ns // 50_000_000 % 2 else low
        return message

    return kind, turn


def trajectory() -> Message:
    def make(store: Any, ns: int) -> Any:
        none = np.zeros(0)
        later = store.types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0)
        point = store.types["trajectory_msgs/msg/JointTrajectoryPoint"](np.ones(2), none, none, none, later)
        kind = store.types["trajectory_msgs/msg/JointTrajectory"]
        return kind(header(store, ns), ["a", "b"], [point])

    return "trajectory_msgs/msg/JointTrajectory", make


def bag(path: Path, topics: dict[str, tuple[Message, float]], form: str = "ros2", seconds: float = 1) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC if form == "ros1" else Stores.ROS2_HUMBLE)
    writer: Any = Ros1Writer(path) if form == "ros1" else None
    plugin = StoragePlugin.SQLITE3 if form == "sqlite" else StoragePlugin.MCAP
    writer = writer or Ros2Writer(path, version=9, storage_plugin=plugin)
    serialize = store.serialize_ros1 if form == "ros1" else store.serialize_cdr
    sent: list[tuple[int, str]] = []
    for topic, (_, hz) in topics.items():
        sent += [(START_NS + round(i * 1e9 / hz), topic) for i in range(max(1, round(seconds * hz)))]
    with writer:
        lines = {
            topic: writer.add_connection(topic, kind, typestore=store)
            for topic, ((kind, _), _) in topics.items()
        }
        for ns, topic in sorted(sent):
            kind, make = topics[topic][0]
            writer.write(lines[topic], ns, serialize(make(store, ns), kind))
    return path
