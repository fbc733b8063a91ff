"""Write recordings as HDF5, RLDS and MCAP, as their own recorders write them.

Episodes are read one by one, so that only one is in memory.

T frames of an episode, A action dims, S state dims.
"""

import json
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, reduce
from pathlib import Path
from typing import Any, Protocol

import h5py
import numpy as np

from hma_data.arrays import Array, Float32s, Floats, Images
from hma_data.sources.rlds.records import masked_crc

DISTRO = "jazzy"  # of ROS
EPOCH_NS = 1_700_000_000_000_000_000  # start of the first bag's stamps

# -- HDF5


@dataclass(frozen=True)
class Demo:
    """One episode of T frames for HDF5."""

    actions: Float32s  # (T, A)
    observations: Mapping[str, Array]  # key -> (T, …); uint8 (T, H, W, 3) are images
    states: Floats  # (T, S), the states of the simulator
    rewards: Floats  # (T,)
    success: bool  # whether the task was done at the end
    facts: Mapping[str, str | int | float]  # stored as attributes


class BlockWorld(Protocol):
    """A simulated robot among loose blocks, as `block_demo` records it."""

    @property
    def joints(self) -> Mapping[str, Floats]:
        """Return what the robot measures of itself: key -> (n,)."""

    @property
    def blocks(self) -> Floats:
        """Return the places of the blocks: (B, 2), or (B, 3) with their angles."""

    @property
    def state(self) -> Floats:
        """Return the whole state (S,)."""

    def picture(self) -> Images:
        """Draw the scene."""

    def advance(self, action: Float32s, /) -> None:
        """Simulate one control step."""


def block_demo(world: BlockWorld, drive: Callable[[], Float32s], steps: int, moved: float, seed: int) -> Demo:
    """Record `steps` frames; the reward is the way that the blocks moved, success that one moved `moved`."""
    first = before = world.blocks[:, :2].copy()
    rows: list[tuple[Any, ...]] = []
    for _ in range(steps):
        seen = world.picture(), world.state
        joints = {key: values.copy() for key, values in world.joints.items()}
        action = drive()
        world.advance(action)
        after = world.blocks[:, :2].copy()
        rows.append((*seen, action, np.linalg.norm(after - before, axis=1).sum(), joints))
        before = after
    *columns, measured = zip(*rows, strict=True)
    images, states, actions, rewards = map(np.stack, columns)
    return Demo(
        actions=actions,
        observations={"image": images} | {key: np.stack([one[key] for one in measured]) for key in joints},
        states=states,
        rewards=rewards,
        success=bool(np.linalg.norm(before - first, axis=1).max() >= moved),
        facts={"seed": seed},
    )


def write_hdf5(path: Path, demos: Iterable[Demo], env_args: Mapping[str, Any]) -> None:
    """Write one file in robomimic's layout.

        data                    attrs: env_args (JSON), total (frames in all)
          demo_0                attrs: num_samples, and plain facts of the episode
            actions             (T, A) float32
            obs/<key>           (T, …), images (T, H, W, 3) uint8, one compressed chunk a frame
            states rewards dones
        mask/train mask/valid   names of demos

    `obs` at index t was observed before `actions[t]`; `rewards[t]` and `dones[t]` came after it. Every tenth
    demo is for validation; of fewer than fifty, five or a quarter are, and of two or three the last one.
    """
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        total, count = 0, 0
        for count, demo in enumerate(demos, start=1):
            _write_demo(data.create_group(f"demo_{count - 1}"), demo)
            total += len(demo.actions)
        data.attrs["total"] = total
        data.attrs["env_args"] = json.dumps(env_args, sort_keys=True)
        valid = _held_out(count)
        for name, chosen in (("train", set(range(count)) - valid), ("valid", valid)):
            file.create_dataset(f"mask/{name}", data=np.array([f"demo_{i}" for i in sorted(chosen)], "S"))


def _held_out(count: int) -> set[int]:
    """Return the numbers of the demos for validation, spread evenly; the last one is among them."""
    if count >= 50:
        return set(range(9, count, 10))
    held = max(min(5, count // 4), int(count > 1))
    return {(number + 1) * count // held - 1 for number in range(held)}


def _write_demo(group: h5py.Group, demo: Demo) -> None:
    length = len(demo.actions)
    group.create_dataset("actions", data=demo.actions)
    for key, values in demo.observations.items():
        pictures = values.dtype == np.uint8 and values.ndim == 4
        packing = {"chunks": (1, *values.shape[1:]), "compression": "gzip", "compression_opts": 1}
        group.create_dataset(f"obs/{key}", data=values, **(packing if pictures else {}))
    group.create_dataset("states", data=demo.states)
    group.create_dataset("rewards", data=demo.rewards)
    group.create_dataset("dones", data=(np.arange(length) == length - 1).astype(np.int64))
    for name, value in {"num_samples": length, "success": demo.success, **demo.facts}.items():
        group.attrs[name] = value


# -- RLDS


@dataclass(frozen=True)
class RldsEpisode:
    """One episode of T steps for RLDS."""

    pictures: Mapping[str, list[bytes]]  # path inside a step -> T files, JPEG or PNG
    vectors: Mapping[str, Float32s]  # path inside a step -> (T, A)
    instruction: str  # the task in words
    facts: Mapping[str, bool | int | str] = field(default_factory=dict)  # stored as episode_metadata


def write_rlds(
    folder: Path, name: str, sizes: Mapping[str, tuple[int, int]], codec: str, episodes: Iterable[RldsEpisode]
) -> None:
    """Write a folder as TFDS does: one split of one shard, a TFRecord file of tf.train.Example.

        features.json dataset_info.json <name>-train.tfrecord-00000-of-00001

    Args:
        folder: folder to make.
        name: name of the dataset.
        sizes: path of each camera -> (height, width).
        codec: jpeg or png.
        episodes: all have the same keys.
    """
    folder.mkdir(parents=True)
    count, widths = 0, {}
    facts: Mapping[str, bool | int | str] = {}
    with (folder / f"{name}-train.tfrecord-00000-of-00001").open("wb") as file:
        for episode in episodes:
            file.write(_record(_example(episode)))
            widths = {key: values.shape[1] for key, values in episode.vectors.items()}
            facts = episode.facts
            count += 1
    (folder / "features.json").write_text(json.dumps(_features(sizes, codec, widths, facts)))
    splits = [{"name": "train", "shardLengths": [str(count)]}]
    info = {"name": name, "version": "1.0.0", "fileFormat": "tfrecord", "splits": splits}
    (folder / "dataset_info.json").write_text(json.dumps(info))


def _features(
    sizes: Mapping[str, tuple[int, int]], codec: str, widths: Mapping[str, int], facts: Mapping[str, Any]
) -> dict[str, Any]:
    words = _feature("text_feature.Text", "text")
    leaves: dict[str, Any] = {"language_instruction": words}
    for key, (height, width) in sizes.items():
        shape = {"dimensions": [str(height), str(width), "3"]}
        leaves[key] = _feature(
            "image_feature.Image", "image", shape=shape, dtype="uint8", encodingFormat=codec
        )
    for key, width in widths.items():
        shape = {"dimensions": [str(width)]}
        leaves[key] = _feature(
            "tensor_feature.Tensor", "tensor", shape=shape, dtype="float32", encoding="none"
        )
    nested: dict[str, Any] = {}
    for path, leaf in leaves.items():
        *parents, last = path.split("/")
        reduce(lambda at, parent: at.setdefault(parent, {}), parents, nested)[last] = leaf
    steps = _feature("dataset_feature.Dataset", "sequence", feature=_dict(nested), length="-1")
    episode: dict[str, Any] = {"steps": steps}
    if facts:
        episode["episode_metadata"] = {}
    for key, value in facts.items():
        dtype = "bool" if isinstance(value, bool) else "int64"
        number = _feature("scalar.Scalar", "tensor", shape={}, dtype=dtype, encoding="none")
        episode["episode_metadata"][key] = words if isinstance(value, str) else number
    return _dict(episode)


def _feature(kind: str, field_name: str, **values: Any) -> dict[str, Any]:
    return {"pythonClassName": f"tensorflow_datasets.core.features.{kind}", field_name: values}


def _dict(items: dict[str, Any]) -> dict[str, Any]:
    known = {key: value if "pythonClassName" in value else _dict(value) for key, value in items.items()}
    return _feature("features_dict.FeaturesDict", "featuresDict", features=known)


def _example(episode: RldsEpisode) -> bytes:
    """Return a tf.train.Example, a map from names to lists, in protobuf's wire format."""
    length = len(next(iter(episode.pictures.values())))
    lists: dict[str, bytes] = {
        f"steps/{key}": _field(1, b"".join(_field(1, data) for data in files))
        for key, files in episode.pictures.items()
    }
    for key, values in episode.vectors.items():
        lists[f"steps/{key}"] = _field(2, _field(1, np.ascontiguousarray(values, "<f4").tobytes()))
    lists["steps/language_instruction"] = _field(1, _field(1, episode.instruction.encode()) * length)
    for key, fact in episode.facts.items():
        kind, value = (1, fact.encode()) if isinstance(fact, str) else (3, _varint(fact))
        lists[f"episode_metadata/{key}"] = _field(kind, _field(1, value))
    entries = (_field(1, name.encode()) + _field(2, content) for name, content in lists.items())
    return _field(1, b"".join(_field(1, entry) for entry in entries))


def _field(number: int, content: bytes) -> bytes:
    """Return a field of bytes: its number and type, the length as a varint, the content."""
    return bytes([number << 3 | 2]) + _varint(len(content)) + content


def _varint(value: int) -> bytes:
    head = bytearray()
    while value > 0x7F:
        head.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes(head) + bytes([value])


def _record(data: bytes) -> bytes:
    length = struct.pack("<Q", len(data))
    head, tail = struct.pack("<I", masked_crc(length)), struct.pack("<I", masked_crc(data))
    return length + head + data + tail


# -- MCAP


@dataclass(frozen=True)
class Message:
    """A message for MCAP."""

    topic: str  # name with leading slash
    stamp_ns: int  # time of the event, in the message's header; nanoseconds since 1970
    received_ns: int  # the later time at which the recorder received it
    type: str  # one with a header, e.g. sensor_msgs/msg/JointState
    frame: str  # frame_id of the header
    fields: Mapping[str, Any]  # values of the other fields


class BagEpisode:
    """The messages of one episode of a simulated robot; receipt is 0.5 to 20 ms after the event.

    Args:
        number: of the episode; episodes are a minute apart.
        frame: the frame_id of all but images.
        rng: draws the delays.
    """

    def __init__(self, number: int, frame: str, rng: np.random.Generator) -> None:
        self.messages: list[Message] = []
        self._start = EPOCH_NS + number * 60_000_000_000
        self._frame = frame
        self._rng = rng

    def image(self, at_ns: int, picture: Images) -> None:
        """Add a frame (H, W, 3) RGB as a PNG."""
        import cv2

        _, png = cv2.imencode(".png", picture[..., ::-1])
        fields = {"format": "png", "data": png.reshape(-1)}
        late = int(self._rng.integers(12_000_000, 20_000_000))
        self._add(
            "/camera/image/compressed", "sensor_msgs/msg/CompressedImage", at_ns, late, "camera", fields
        )

    def joints(self, at_ns: int, names: list[str], position: Array, velocity: Floats) -> None:
        """Add what the robot measures of itself (n,)."""
        fields = {"name": names, "position": position, "velocity": velocity, "effort": np.empty(0)}
        self._add("/joint_states", "sensor_msgs/msg/JointState", at_ns, self._soon(), self._frame, fields)

    def command(self, at_ns: int, values: Floats) -> None:
        """Add an action of up to three values, as a twist's linear part."""
        linear, angular = (
            ros_value("geometry_msgs/msg/Vector3", *part.tolist())
            for part in (np.pad(values, (0, 3 - len(values))), np.zeros(3))
        )
        twist = ros_value("geometry_msgs/msg/Twist", linear=linear, angular=angular)
        kind = "geometry_msgs/msg/TwistStamped"
        self._add("/command", kind, at_ns, self._soon(), self._frame, {"twist": twist})

    def _soon(self) -> int:
        return int(self._rng.integers(500_000, 2_000_000))

    def _add(
        self, topic: str, kind: str, at_ns: int, late: int, frame: str, fields: Mapping[str, Any]
    ) -> None:
        stamp = self._start + at_ns
        self.messages.append(Message(topic, stamp, stamp + late, kind, frame, fields))


def ros_value(kind: str, *values: Any, **named: Any) -> Any:
    """Return a value of a ROS 2 type, such as geometry_msgs/msg/Vector3."""
    return _types().types[kind](*values, **named)


def write_mcap(path: Path, messages: Sequence[Message], facts: Mapping[str, str]) -> None:
    """Write one MCAP file as a ROS 2 recorder would: CDR messages, and the definitions of their types.

    Messages are in the file in the order of receipt; `facts` become its metadata record "episode".
    """
    from mcap.writer import CompressionType, Writer

    store = _types()
    channels: dict[str, int] = {}
    schemas: dict[str, int] = {}
    sequence: Counter[str] = Counter()
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
            sequence[message.topic] += 1
            stamp = ros_value("builtin_interfaces/msg/Time", *divmod(message.stamp_ns, 1_000_000_000))
            header = ros_value("std_msgs/msg/Header", stamp=stamp, frame_id=message.frame)
            content = ros_value(message.type, header=header, **message.fields)
            writer.add_message(
                channels[message.topic],
                log_time=message.received_ns,
                data=bytes(store.serialize_cdr(content, message.type)),
                publish_time=message.stamp_ns,
                sequence=sequence[message.topic],
            )
        writer.finish()


@cache
def _types() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores(f"ros2_{DISTRO}"))
