"""Which numbers of a message become an action: by name wherever names stand, and those that move."""

import math
import re
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2

from hma_data.errors import EpisodeError, SourceError
from hma_data.inspection.infer import infer
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.bags.container import Channel
from hma_data.sources.bags.messages import decode, field_names, numbers, stamp_ns, value_names
from hma_data.sources.bags.topic_track import TopicTrack, parse_key
from hma_data.storage.yaml_io import parse_yaml
from tests.data import ros2
from tests.data.bag_files import MESSAGE, NUMBER, ONE, SOURCE
from tests.data.sources.bags.test_bag_pairing import at, pairs, robot

FRAMES = 12
NAMES = ("pan", "lift", "elbow")
ros2.define("toy/msg/Named", "string name\nuint8 mode\nfloat32 q\nfloat32 tau\n")
ros2.define("toy/msg/NamedArray", "std_msgs/Header header\ntoy/Named[] motors\n")
ros2.define("toy/msg/Inner", "float64[] values\n")
ros2.define("toy/msg/Above", "std_msgs/Header header\nstring[] actuators\ntoy/Inner inner\n")
ros2.define("toy/msg/MotorCmd", "uint8 mode\nfloat32 q\nfloat32 dq\nfloat32 tau\n")
ros2.define(
    "toy/msg/LowCmd", "uint32[2] version\nuint8 mode_pr\ntoy/MotorCmd[5] motor_cmd\nuint32 tick\nuint32 crc\n"
)
T = ros2.TYPES.types


def trajectory(ns: int, names: list[str], values: list[float]):
    none = np.zeros(0)
    duration = T["builtin_interfaces/msg/Duration"](sec=0, nanosec=0)
    point = T["trajectory_msgs/msg/JointTrajectoryPoint"](np.array(values), none, none, none, duration)
    return T["trajectory_msgs/msg/JointTrajectory"](ros2.header(ns), names, [point])


def named_array(ns: int, names: list[str], values: list[float]):
    motors = [T["toy/msg/Named"](name, 1, value, 0.0) for name, value in zip(names, values, strict=True)]
    return T["toy/msg/NamedArray"](ros2.header(ns), motors)


MESSAGES = {
    "/cmd.position": ros2.joints,
    "/cmd.points[0].positions": trajectory,
    "/cmd.motors.q": named_array,
    "/cmd.inner.values": lambda ns, names, values: T["toy/msg/Above"](
        ros2.header(ns), names, T["toy/msg/Inner"](np.array(values))
    ),
}


def picked(key: str, dims: int, **more: Any) -> Embodiment:
    values = robot().to_dict()
    values["action"]["components"] = [{"key": key, "dims": dims, **more}]
    return Embodiment.from_values(values, "")


def shuffled_bag(path: Path, key: str) -> Path:
    """Joint k has the value 100 k + i in message i; the order of the joints changes from each to the next."""
    messages = []
    for i in range(FRAMES):
        order = np.random.default_rng(i).permutation(3)
        message = MESSAGES[key](at(i), [NAMES[k] for k in order], [100.0 * k + i for k in order])
        messages += [("/cam", ros2.image(at(i), i), at(i)), ("/cmd", message, at(i))]
    return ros2.write(path, messages)


@pytest.mark.parametrize(
    ("key", "part", "dims"),
    [
        *((key, "", 3) for key in MESSAGES),
        ("/cmd.position", "[0:3]", 3),
        ("/cmd.motors.q", "[1:3]", 2),
        ("/cmd.motors.q", "[2]", 1),
    ],
)
def test_joints_that_change_places_are_refused_without_names(key, part, dims, tmp_path: Path) -> None:
    path = shuffled_bag(tmp_path / "run", key)
    key = key.replace(".q", f"{part}.q") if key.endswith(".q") else key + part
    with pytest.raises(EpisodeError, match=r"is of \w+.*, then of \w+.* — give the component names"):
        SOURCE.read(str(path), "run", picked(key, dims))


@pytest.mark.parametrize("key", MESSAGES)
def test_names_pick_the_values_wherever_a_message_has_them_and_infer_names_them(key, tmp_path: Path) -> None:
    path = shuffled_bag(tmp_path / "run", key)
    (found,) = [info for info in SOURCE.inspect(str(path)).keys if info.key == key]
    assert sorted(found.names) == sorted(NAMES)
    for names in (NAMES, ("elbow", "pan")):
        episode = SOURCE.read(str(path), "run", picked(key, len(names), names=list(names)))
        expected = [[100.0 * NAMES.index(name) + i for name in names] for i in range(FRAMES)]
        np.testing.assert_array_equal(episode.actions[0].values, expected)


def test_a_list_of_other_texts_names_nothing() -> None:
    assert value_names([{"values": [1, 2], "joints": ["a"]}], 2) == ()
    assert value_names([{"values": [1, 2], "units": ["rad", "rad"]}], 2) == ()
    assert value_names([{"values": [1, 2]}, {"joint_names": ["a", "b"]}], 2) == ("a", "b")
    assert value_names([[{"name": "a", "q": 1}, {"q": 2}]], 2) == ()  # JSON may leave some out


def motors_bag(path: Path) -> Path:
    messages = []
    for i in range(FRAMES):
        motors = [T["toy/msg/MotorCmd"](1, float(i + k / 100), 0.0, 0.0) for k in range(5)]
        low = T["toy/msg/LowCmd"](np.array([1, 2], np.uint32), 0, motors, i, i * 7919 % 1000)
        messages += [("/cam", ros2.image(at(i), i), at(i)), ("/lowcmd", low, at(i))]
    return ros2.write(path, messages)


def test_infer_takes_the_fields_that_move_not_counters_and_checksums(tmp_path: Path) -> None:
    values = parse_yaml(infer(str(motors_bag(tmp_path / "run")), "x"), "x")
    assert values["action"]["components"] == [{"key": "/lowcmd.motor_cmd.q", "dims": 5}]


def test_a_field_of_a_list_is_read_from_each_and_may_be_sliced(tmp_path: Path) -> None:
    path = motors_bag(tmp_path / "run")
    episode = SOURCE.read(str(path), "run", picked("/lowcmd.motor_cmd[1:3].q", 2))
    expected = [[i + 0.01, i + 0.02] for i in range(FRAMES)]
    np.testing.assert_allclose(episode.actions[0].values, expected, atol=1e-5)


def mcap_of_two_types(path: Path, measured: Sequence[str] = ()) -> Path:
    """JointState with i, and an array with 500 + i a millisecond later, both on /cmd; `measured` has i."""
    messages = []
    for i in range(FRAMES):
        joints = ros2.joints(at(i), ["a"], [i])
        sent = [("/cam", ros2.image(at(i), i)), *((topic, joints) for topic in ("/cmd", *measured))]
        messages += [(topic, ros2.kind_of(one), at(i), ros2.cdr(one)) for topic, one in sent]
        late = ros2.array([500 + i])
        messages.append(("/cmd", ros2.kind_of(late), at(i) + 10**6, ros2.cdr(late)))
    return ros2.write_mcap(path, messages)


def test_a_topic_of_two_types_is_refused(tmp_path: Path) -> None:
    path = mcap_of_two_types(tmp_path / "run.mcap")
    said = "/cmd carries sensor_msgs/msg/JointState and std_msgs/msg/Float64MultiArray"
    with pytest.raises(EpisodeError, match=f"run.mcap: {said} — filter the recording to one of them"):
        pairs(path, robot(action="/cmd.position"))
    assert any(said in problem for problem in SOURCE.inspect(str(path)).problems)
    with pytest.raises(SourceError, match=f"nothing that could be an action.*{said} — filter the recording"):
        infer(str(path), "x")
    text = infer(str(mcap_of_two_types(path, ["/joint_states"])), "x")
    assert re.search(f"may /joint_states.position, as measured, be the action.*{said}", text)


@pytest.mark.parametrize("unit", [1, 10**3, 10**6, 10**9])
def test_a_stamp_may_be_one_number_near_receipt(unit: int) -> None:
    received = 1_700_000_000_250_000_000
    for number in (received // unit, received / unit):
        assert abs(stamp_ns({"timestamp": number}, received + 10**9) - received) < max(unit, 10**3)
    assert stamp_ns({"timestamp": 5 * 10**6}, 7 * 10**9) == 0  # in a simulation's first seconds any unit fits
    for number in (5 * 10**9, math.nan, math.inf, True):  # microseconds since the robot was switched on
        assert stamp_ns({"timestamp": number}, received) == 0


@pytest.mark.parametrize(
    ("stamps", "are_used"),
    [([0, 0, 0.1, 0.2], True), ([0, 0, 1.7e9, 1.7e9 + 1], False), ([0.1, 0, 0.2], False), ([0, 0], False)],
)
def test_a_simulation_may_begin_at_0(stamps: list[float], are_used: bool) -> None:
    track = TopicTrack("/cmd", "x.bag")
    for i, seconds in enumerate(stamps):
        stamp = {"sec": int(seconds), "nsec": round(seconds % 1 * 1e9)}
        track.add(Channel("/cmd", "", "json"), at(i), (0, 0, i), {"header": {"stamp": stamp}})
    assert (track.times.stamps is not None) == are_used


def test_what_a_protobuf_message_leaves_out_is_no_zero() -> None:
    """Of a `oneof` the other part was sent; without this its values would be zeros."""
    files = descriptor_pb2.FileDescriptorSet()
    file = files.file.add(name="toy.proto", package="toy", syntax="proto3")
    part = file.message_type.add(name="Part")
    part.field.add(name="q", number=1, type=NUMBER, label=ONE)
    command = file.message_type.add(name="Command")
    command.oneof_decl.add(name="how")
    for number, name in enumerate(("joint", "pose"), 1):
        about = {"type": MESSAGE, "type_name": ".toy.Part", "label": ONE, "oneof_index": 0}
        command.field.add(name=name, number=number, **about)
    command.field.add(name="force", number=3, type=NUMBER, label=ONE)
    channel = Channel("/cmd", "toy.Command", "protobuf", "protobuf", files.SerializeToString())
    sent = decode(channel, b"\x12\x09\x09" + struct.pack("<d", 0.5), "")  # pose {q: 0.5}
    assert field_names(sent) == ["pose", "force"] and numbers(sent) == [0.5, 0.0]
    assert parse_key("/cmd.pose.q", ["/cmd"], "").value(sent, "") == 0.5
    with pytest.raises(EpisodeError, match="no field 'joint' — the fields there: pose, force"):
        parse_key("/cmd.joint.q", ["/cmd"], "").value(sent, "")
