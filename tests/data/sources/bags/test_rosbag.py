"""Bags against the formats' own writers: every kind, keys, folders."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from hma_data.episodes.align import to_clip
from hma_data.errors import EpisodeError, SourceError
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.bags.bag import Bag
from hma_data.sources.bags.messages import decode
from hma_data.sources.bags.topic_track import TopicTrack
from hma_data.sources.detect import detect
from tests.data import ros2
from tests.data.bag_files import (
    CAMERA,
    COMMAND,
    JOINTS,
    KINDS,
    LATE_NS,
    SOURCE,
    STATE,
    Recording,
    arm,
    make_recording,
    read,
    write_ros1,
)
from tests.data.hub_cache import as_snapshot
from tests.hostile import without_index


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_bag_gives_what_was_written(kind, bags, recording) -> None:
    if "file" not in kind:
        assert detect(str(bags[kind])) == "rosbag"
    (ref,) = SOURCE.index(str(bags[kind]), arm())
    assert (ref.id, ref.frames) == ("run", len(recording.pictures)) and ref.fingerprint
    episode = SOURCE.read(str(bags[kind]), "run", arm())
    stream = episode.streams["front"]
    np.testing.assert_array_equal(stream.frames(range(len(recording.pictures))), recording.pictures)
    np.testing.assert_allclose(stream.timestamps, recording.picture_ns / 1e9, atol=1e-6)
    command, joints = episode.actions
    np.testing.assert_array_equal(command.values, recording.commands.astype(np.float32))
    np.testing.assert_allclose(command.timestamps, recording.command_ns / 1e9, atol=1e-6)
    np.testing.assert_array_equal(joints.values, recording.joints[:, [2, 0]].astype(np.float32))
    np.testing.assert_allclose(joints.timestamps, recording.joint_ns / 1e9, atol=1e-6)
    expected = (-recording.joints[:, :2] + 0.5).astype(np.float32)
    np.testing.assert_array_equal(episode.states[0].values, expected)
    assert not episode.rate_stamped


def test_stamp_receive_takes_log_times(bags: dict[str, Path], recording: Recording) -> None:
    forced = arm(**{"max_skew_ms: 60": "stamp: receive"})
    episode = read(bags["ros1"], forced)
    late = (recording.picture_ns + LATE_NS) / 1e9
    np.testing.assert_allclose(episode.streams["front"].timestamps, late, atol=1e-6)
    one = arm(**{"names: [wrist, shoulder]": "names: [wrist, shoulder], stamp: receive"})
    episode = read(bags["ros1"], one)
    np.testing.assert_allclose(episode.streams["front"].timestamps, recording.picture_ns / 1e9, atol=1e-6)
    np.testing.assert_allclose(episode.actions[1].timestamps, (recording.joint_ns + LATE_NS) / 1e9, atol=1e-6)


@pytest.mark.parametrize("stamps", ["zero", "never moving"])
def test_stamps_that_are_no_clock_give_way_to_log_times(tmp_path, recording, stamps) -> None:
    shift = {"zero": -recording.picture_ns, "never moving": recording.picture_ns[4] - recording.picture_ns}
    path = write_ros1(tmp_path / "bag.bag", replace(recording, stamp_shift_ns=shift[stamps]))
    episode = read(path, arm())
    late = (recording.picture_ns + LATE_NS) / 1e9
    np.testing.assert_allclose(episode.streams["front"].timestamps, late, atol=1e-6)


def test_a_clip_of_a_bag_pairs_each_picture_with_the_command_in_force(bags, recording) -> None:
    clip = to_clip(read(bags["ros2-mcap"], arm()), arm())
    in_force = [np.flatnonzero(recording.command_ns <= t)[-1] for t in recording.picture_ns[: len(clip)]]
    np.testing.assert_array_equal(clip.actions[:, :2], recording.commands[in_force].astype(np.float32))
    np.testing.assert_array_equal(clip.frames_at("front", np.arange(3)), recording.pictures[:3])


def test_a_bag_without_index_is_read_to_its_end(bags, recording, tmp_path) -> None:
    path = tmp_path / "killed.bag.active"
    path.write_bytes(without_index(bags["ros1-lz4"].read_bytes()))
    assert SOURCE.index(str(path), arm())[0].frames == len(recording.pictures)
    np.testing.assert_array_equal(read(path, arm()).actions[0].values, recording.commands.astype(np.float32))


def test_messages_out_of_order_come_in_order_of_receipt(tmp_path: Path) -> None:
    order = np.random.default_rng(1).permutation(50).tolist()
    messages = (("/n", ros2.Kind(), i * 1000 + 1, json.dumps({"value": i}).encode()) for i in order)
    path = ros2.write_mcap(tmp_path / "shuffled.mcap", messages, chunk_size=200)
    with path.open("rb") as file:
        expected = [json.loads(message.data)["value"] for _, _, message in make_reader(file).iter_messages()]
    track, values = TopicTrack("/n", "x.bag"), []
    for place, record in Bag(path).records():
        message = decode(record.channel, record.data, "")
        track.add(record.channel, record.log_ns, place, message)
        values.append(message["value"])
    assert [values[i] for i in track.times.by_receipt()] == expected == list(range(50))


@pytest.fixture
def numbers_bag(tmp_path: Path) -> Path:
    """Topics whose names contain one another, nested messages, and a second publisher of joints."""
    store = get_typestore(Stores.ROS1_NOETIC)
    vector, twist = store.types["geometry_msgs/msg/Vector3"], store.types["geometry_msgs/msg/Twist"]
    joint_state = store.types["sensor_msgs/msg/JointState"]
    header = store.types["std_msgs/msg/Header"](0, store.types["builtin_interfaces/msg/Time"](0, 0), "")
    image = store.types["sensor_msgs/msg/Image"]
    messages, none = [], np.zeros(0)
    for i in range(4):
        gripper = joint_state(header, ["gripper"], np.array([float(i)]), none, none)
        values = {
            "/cmd": twist(vector(i, 1, 2), vector(3, 4, 5)),
            "/cmd.linear": vector(-i, -1, -2),
            "/cam": image(header, 2, 2, "mono8", 0, 2, np.full(4, i, np.uint8)),
            "/text": store.types["std_msgs/msg/String"]("pick the cube" if i else ""),
            "/joints": joint_state(header, ["a", "b"], np.array([i, 10.0]), none, none),
        }
        messages += [(topic, value, i * 10**8 + 1) for topic, value in values.items()]
        messages.append(("/joints", gripper, i * 10**8 + 50_000_000))
    ros2.send(Writer(tmp_path / "numbers.bag"), messages, store)
    return tmp_path / "numbers.bag"


def keyed(key: str, dims: int, more: str = "") -> Embodiment:
    return arm(f"""
id: keyed
kind: real
frequency_hz: 10
action: {{space: mixed, components: [{{key: "{key}", dims: {dims}{more}}}]}}
cameras: [{{name: cam, key: /cam}}]
source: {{format: rosbag, instruction: /text.data}}
""")


@pytest.mark.parametrize(
    ("key", "more", "second"),
    [
        ("/cmd", "", [1, 1, 2, 3, 4, 5]),
        ("/cmd.angular", "", [3, 4, 5]),
        ("/cmd.linear", "", [-1, -1, -2]),
        ("/cmd.linear.y", "", [-1]),
        ("/cmd.angular.z", "", [5]),
        ("/joints.position", ", names: [b, a]", [10, 1]),
        ("/joints.position", ", names: [gripper]", [1]),
    ],
)
def test_keys_find_their_values(numbers_bag: Path, key: str, more: str, second: list[float]) -> None:
    episode = read(numbers_bag, keyed(key, len(second), more))
    np.testing.assert_array_equal(episode.actions[0].values[1], second)
    assert len(episode.actions[0].values) == 4
    assert episode.instruction == "pick the cube"


def test_a_second_publisher_of_joints_keeps_its_own_times(numbers_bag: Path) -> None:
    arm_times = read(numbers_bag, keyed("/joints.position", 1, ", names: [a]")).actions[0].timestamps
    gripper_times = (
        read(numbers_bag, keyed("/joints.position", 1, ", names: [gripper]")).actions[0].timestamps
    )
    np.testing.assert_allclose(gripper_times - arm_times, 0.05, atol=1e-6)


@pytest.mark.parametrize(
    ("key", "dims", "more", "says"),
    [
        ("/cmdd.linear", 3, "", "did you mean '/cmd'"),
        ("/nothing.like.it", 3, "", "/cam, /cmd, /cmd.linear, /joints, /text"),
        ("/cmd.lineer", 3, "", "no field 'lineer'.*linear, angular"),
        ("/cmd.angular.x.y", 1, "", "no field 'y'"),
        ("/cmd.angular[0]", 1, "", "not a list"),
        ("/joints.position[5]", 1, "", "list has 2 values"),
        ("/joints.position[0:2]", 2, "", "list has 1 values"),
        ("/joints.position", 2, "", "is of a, b, then of gripper in message 1 — give the component names"),
        ("/joints.position", 2, ", names: [a, z]", "lacks z.*names a, b"),
        ("/joints.position", 1, ", names: [z]", "no message names z.*a, b, gripper"),
        ("/joints.velocity", 1, "", "is empty in message 0"),
        ("/joints", 1, "", "the type str, not only numbers.*name a field of it: header, name"),
        ("/text.data", 1, "", "holds a value of the type str"),
        ("/cmd.angular", 2, "", "has 3 values, the embodiment says 2"),
        ("/cmd.angular[x]", 1, "", "is not a path"),
    ],
)
def test_a_wrong_key_is_told_with_what_there_is(numbers_bag, key, dims, more, says) -> None:
    with pytest.raises(EpisodeError) as fault:
        read(numbers_bag, keyed(key, dims, more))
    assert re.search(says, str(fault.value)), fault.value
    assert "\n" not in str(fault.value)


def test_a_folder_of_bags_is_many_episodes(bags: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / "day1").mkdir()
    for name, kind in {"day1/a.bag": "ros1", "b.bag": "ros1-lz4", "b.mcap": "mcap-json"}.items():
        shutil.copy(bags[kind], tmp_path / name)
    shutil.copytree(bags["ros2-sqlite3"], tmp_path / "day1" / "run.2")
    (tmp_path / "empty.bag").touch()
    (tmp_path / "notes.txt").write_text("not a bag")
    expected = ["b.bag", "b.mcap", "day1/a", "day1/run.2", "empty"]
    assert SOURCE.episode_ids(str(tmp_path)) == expected
    refs = SOURCE.index(str(tmp_path), arm())
    assert [(ref.id, ref.frames) for ref in refs] == [*((name, 10) for name in expected[:4]), ("empty", 0)]
    for name in expected[:4]:
        assert len(SOURCE.read(str(tmp_path), name, arm()).actions[0].values) == 25
    with pytest.raises(EpisodeError, match="is empty"):
        SOURCE.read(str(tmp_path), "empty", arm())
    with pytest.raises(SourceError, match=r"has no bag '\.\./b'"):
        SOURCE.read(str(tmp_path), "../b", arm())


@pytest.mark.parametrize("kind", ["ros1", "ros2-mcap", "ros2-sqlite3", "ros2-sqlite3-file-zstd"])
def test_links_of_the_hub_cache_are_followed(bags, recording, kind, tmp_path) -> None:
    place = tmp_path / "set" / bags[kind].name
    place.parent.mkdir()
    (shutil.copytree if bags[kind].is_dir() else shutil.copy)(bags[kind], place)
    snapshot = as_snapshot(place.parent, tmp_path / "cache")
    for uri in (snapshot, snapshot / place.name):
        ref = SOURCE.index(str(uri), arm())[0]
        episode = SOURCE.read(str(uri), ref.id, arm())
        np.testing.assert_array_equal(episode.streams["front"].frames([0, 9]), recording.pictures[[0, 9]])


def test_inspect_lists_keys_as_a_yaml_names_them(bags: dict[str, Path]) -> None:
    found = SOURCE.inspect(str(bags["ros2-mcap"]))
    keys = {key.key: key for key in found.keys}
    assert set(keys) == {CAMERA, f"{STATE}.position", f"{COMMAND}.layout.data_offset", f"{COMMAND}.data"}
    camera, joints = keys[CAMERA], keys[f"{STATE}.position"]
    assert (camera.kind, camera.shape, camera.codec, camera.count) == ("camera", (24, 32, 3), "raw", 10)
    assert (joints.kind, joints.shape, joints.names) == ("vector", (3,), JOINTS)
    assert joints.hz == pytest.approx(50, rel=1e-4) and joints.jitter_ms == pytest.approx(0, abs=1e-3)
    assert (found.episodes, found.frames, found.lengths) == (1, 10, (10,))
    assert found.hz == pytest.approx(10, rel=1e-4)
    assert found.problems == ()


def test_every_numeric_key_of_inspect_can_be_converted(numbers_bag: Path) -> None:
    keys = [key for key in SOURCE.inspect(str(numbers_bag)).keys if key.kind == "vector"]
    assert len(keys) >= 4
    for key in keys:
        names = f", names: [{', '.join(key.names)}]" if key.names else ""
        values = read(numbers_bag, keyed(key.key, key.shape[0], names)).actions[0].values
        assert values.shape[1] == key.shape[0]


def test_inspect_tells_of_stamps_that_repeat_pause_or_go_back(tmp_path: Path) -> None:
    shift = np.zeros(10, np.int64)
    shift[3], shift[5] = -100_000_000, -150_000_000
    shift[6:] = 5_000_000_000
    path = write_ros1(tmp_path / "bad.bag", replace(make_recording(), stamp_shift_ns=shift))
    problems = "\n".join(SOURCE.inspect(str(path)).problems)
    for fault in ("1 timestamps equal the previous one", "1 timestamps go back in time", "pauses for 5.25"):
        assert fault in problems
    with pytest.raises(EpisodeError, match=r"header stamps go back by 0\.05 s at message 5"):
        to_clip(read(path, arm()), arm())
