"""Bags against the formats' own writers and readers, and against damage."""

import contextlib
import json
import re
import shutil
import sqlite3
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader, make_reader
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.typesys import Stores, get_typestore

from hma_data.align import to_clip
from hma_data.embodiment import Embodiment
from hma_data.errors import EpisodeError, HMAError, SourceError
from hma_data.sources.bags.bag import Bag
from hma_data.sources.bags.messages import decode, numbers
from hma_data.sources.bags.pictures import picture
from hma_data.sources.base import detect, open_source
from tests.data.bag_files import (
    CAMERA,
    COMMAND,
    JOINTS,
    KINDS,
    LATE_NS,
    STATE,
    Recording,
    make_recording,
    write_ros1,
)

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


@pytest.fixture(scope="module")
def recording() -> Recording:
    return make_recording()


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory, recording: Recording) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("bags")
    made = {}
    for kind, write in KINDS.items():
        (folder / kind).mkdir()
        made[kind] = write(folder / kind, recording)
    return made


SOURCE = open_source("rosbag")


def read(path: Path, embodiment: Embodiment) -> Any:
    return SOURCE.read(str(path), SOURCE.episode_ids(str(path))[0], embodiment)


# -- the same recording in every container and encoding


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_bag_gives_what_was_written(
    kind: str, bags: dict[str, Path], recording: Recording
) -> None:
    episode = read(bags[kind], arm())
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


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_recognised_and_counted_without_decoding(
    kind: str, bags: dict[str, Path], recording: Recording
) -> None:
    if "file" not in kind:
        assert detect(str(bags[kind])) == "rosbag"
    (ref,) = SOURCE.index(str(bags[kind]), arm())
    assert (ref.id, ref.frames) == ("run", len(recording.pictures))
    assert ref.fingerprint


def test_pictures_come_in_any_order_and_repeated(bags: dict[str, Path], recording: Recording) -> None:
    stream = read(bags["mcap-json"], arm()).streams["front"]
    order = [7, 0, 7, 3, 9]
    np.testing.assert_array_equal(stream.frames(order), recording.pictures[order])
    assert stream.frames([]).shape[0] == 0


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
def test_stamps_that_are_no_clock_give_way_to_log_times(
    tmp_path: Path, recording: Recording, stamps: str
) -> None:
    shift = {"zero": -recording.picture_ns, "never moving": recording.picture_ns[4] - recording.picture_ns}
    path = write_ros1(tmp_path / "bag.bag", replace(recording, stamp_shift_ns=shift[stamps]))
    episode = read(path, arm())
    late = (recording.picture_ns + LATE_NS) / 1e9
    np.testing.assert_allclose(episode.streams["front"].timestamps, late, atol=1e-6)
    assert episode.metadata["clocks"] == {CAMERA: "receive", COMMAND: "receive", STATE: "header"}


def test_a_clip_of_a_bag_pairs_each_picture_with_the_command_in_force(
    bags: dict[str, Path], recording: Recording
) -> None:
    clip = to_clip(read(bags["ros2-mcap"], arm()), arm())
    in_force = [np.flatnonzero(recording.command_ns <= t)[-1] for t in recording.picture_ns[: len(clip)]]
    np.testing.assert_array_equal(clip.actions[:, :2], recording.commands[in_force].astype(np.float32))
    np.testing.assert_array_equal(clip.frames_at("front", np.arange(3)), recording.pictures[:3])


def test_a_bag_without_index_is_read_to_its_end(
    bags: dict[str, Path], recording: Recording, tmp_path: Path
) -> None:
    data = bytearray(bags["ros1-lz4"].read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data = data[: int.from_bytes(data[at : at + 8], "little")]  # a recorder that was killed
    data[at : at + 8] = bytes(8)
    path = tmp_path / "killed.bag.active"
    path.write_bytes(data)
    assert SOURCE.index(str(path), arm())[0].frames == len(recording.pictures)
    np.testing.assert_array_equal(read(path, arm()).actions[0].values, recording.commands.astype(np.float32))


def test_messages_out_of_order_come_in_order_of_receipt(tmp_path: Path) -> None:
    from mcap.writer import Writer

    path = tmp_path / "shuffled.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=200)
        writer.start()
        channel = writer.register_channel("/n", "json", 0)
        for i in np.random.default_rng(1).permutation(50):
            writer.add_message(channel, int(i) * 1000 + 1, json.dumps({"value": int(i)}).encode(), 0)
        writer.finish()
    with path.open("rb") as file:
        expected = [json.loads(message.data)["value"] for _, _, message in make_reader(file).iter_messages()]
    from hma_data.sources.bags.track import Track

    track, values = Track("/n"), []
    for place, record in Bag(path).records():
        message = decode(record.channel, record.data, "")
        track.add(record.channel, record.log_ns, place, message)
        values.append(message["value"])
    assert [values[i] for i in track.order()] == expected == list(range(50))


# -- keys


@pytest.fixture
def numbers_bag(tmp_path: Path) -> Path:
    """Topics whose names contain one another, nested messages, and a second publisher of joints."""
    store = get_typestore(Stores.ROS1_NOETIC)
    vector, twist = store.types["geometry_msgs/msg/Vector3"], store.types["geometry_msgs/msg/Twist"]
    joint_state = store.types["sensor_msgs/msg/JointState"]
    header = store.types["std_msgs/msg/Header"](0, store.types["builtin_interfaces/msg/Time"](0, 0), "")
    image = store.types["sensor_msgs/msg/Image"]
    path = tmp_path / "numbers.bag"
    from rosbags.rosbag1 import Writer

    with Writer(path) as writer:
        topics = {
            "/cmd": "geometry_msgs/msg/Twist",
            "/cmd.linear": "geometry_msgs/msg/Vector3",
            "/joints": "sensor_msgs/msg/JointState",
            "/cam": "sensor_msgs/msg/Image",
            "/text": "std_msgs/msg/String",
        }
        made = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in topics.items()}
        none = np.zeros(0)
        for i in range(4):
            values = {
                "/cmd": twist(vector(i, 1, 2), vector(3, 4, 5)),
                "/cmd.linear": vector(-i, -1, -2),
                "/cam": image(header, 2, 2, "mono8", 0, 2, np.full(4, i, np.uint8)),
                "/text": store.types["std_msgs/msg/String"]("pick the cube"),
                "/joints": joint_state(header, ["a", "b"], np.array([i, 10.0]), none, none),
            }
            for topic, value in values.items():
                writer.write(made[topic], i * 10**8 + 1, store.serialize_ros1(value, topics[topic]))
            gripper = joint_state(header, ["gripper"], np.array([float(i)]), none, none)
            data = store.serialize_ros1(gripper, topics["/joints"])
            writer.write(made["/joints"], i * 10**8 + 50_000_000, data)
    return path


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
        ("/cmdd.linear", 3, "", "did you mean /cmd"),
        ("/nothing.like.it", 3, "", "/cam, /cmd, /cmd.linear, /joints, /text"),
        ("/cmd.lineer", 3, "", "no field 'lineer'.*linear, angular"),
        ("/cmd.angular.x.y", 1, "", "no field 'y'"),
        ("/cmd.angular[0]", 1, "", "not a list"),
        ("/joints.position[5]", 1, "", "list has 2 values"),
        ("/joints.position[0:2]", 2, "", "list has 1 values"),
        ("/joints.position", 2, "", "has 2 values, then 1"),
        ("/joints.position", 2, ", names: [a, z]", "lacks z.*names a, b"),
        ("/joints.position", 1, ", names: [z]", "no message names z.*a, b, gripper"),
        ("/joints.velocity", 1, "", "is empty in message 0"),
        ("/joints", 1, "", "text in frame_id of header.*name a field of it: header, name"),
        ("/text.data", 1, "", "holds text"),
        ("/cmd.angular", 2, "", "has 3 values, the embodiment says 2"),
        ("/cmd.angular[x]", 1, "", "is not a path"),
    ],
)
def test_a_wrong_key_is_told_with_what_there_is(
    numbers_bag: Path, key: str, dims: int, more: str, says: str
) -> None:
    with pytest.raises(EpisodeError) as fault:
        read(numbers_bag, keyed(key, dims, more))
    assert re.search(says, str(fault.value)), fault.value
    assert "\n" not in str(fault.value)


def test_a_missing_camera_or_one_without_pictures_is_told(numbers_bag: Path) -> None:
    with pytest.raises(EpisodeError, match=r"no topic for /camera.*did you mean /cam"):
        read(numbers_bag, arm(**{CAMERA: "/camera"}))
    text = keyed("/cmd.angular", 3).to_yaml().replace("key: /cam\n", "key: /cmd\n")
    with pytest.raises(EpisodeError, match="Twist, not pictures"):
        read(numbers_bag, Embodiment.from_yaml(text))


# -- pictures


def image(encoding: str, data: np.ndarray, width: int, height: int, step: int) -> dict[str, Any]:
    flat = np.frombuffer(data.tobytes(), np.uint8)
    return {"encoding": encoding, "width": width, "height": height, "step": step, "data": flat}


def smooth(height: int = 16, width: int = 24) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 8, y * 12, 255 - x * 5 - y * 4], -1).astype(np.uint8)


@pytest.mark.parametrize("padding", [0, 5])
def test_raw_encodings_become_rgb(padding: int) -> None:
    rgb = smooth()
    height, width = rgb.shape[:2]
    alpha = np.full((height, width, 1), 7, np.uint8)
    for encoding, pixels in {
        "rgb8": rgb,
        "bgr8": rgb[..., ::-1],
        "rgba8": np.concatenate([rgb, alpha], -1),
        "bgra8": np.concatenate([rgb[..., ::-1], alpha], -1),
    }.items():
        rows = pixels.reshape(height, -1)
        rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=99)
        found = picture(image(encoding, rows, width, height, rows.shape[1]), "raw", "")
        np.testing.assert_array_equal(found, rgb, err_msg=encoding)
    grey = picture(image("mono8", rgb[..., 0], width, height, width), "raw", "")
    np.testing.assert_array_equal(grey, np.repeat(rgb[..., :1], 3, -1))


@pytest.mark.parametrize(
    ("encoding", "corners"), [("rggb", "RGGB"), ("bggr", "BGGR"), ("gbrg", "GBRG"), ("grbg", "GRBG")]
)
def test_bayer_patterns_keep_the_colours_in_place(encoding: str, corners: str) -> None:
    rgb = smooth()
    mosaic = np.zeros(rgb.shape[:2], np.uint8)
    for i, colour in enumerate(corners):
        mosaic[i // 2 :: 2, i % 2 :: 2] = rgb[i // 2 :: 2, i % 2 :: 2, "RGB".index(colour)]
    found = picture(image(f"bayer_{encoding}8", mosaic, 24, 16, 24), "raw", "")
    assert np.abs(found[2:-2, 2:-2].astype(int) - rgb[2:-2, 2:-2]).max() <= 6


@pytest.mark.parametrize(("encoding", "luma"), [("yuv422", 1), ("yuv422_yuy2", 0)])
def test_yuv_is_the_inverse_of_the_standard_conversion(encoding: str, luma: int) -> None:
    """Rec. 601, studio range: grey of luma 126 is 128; a red sample is red."""
    packed = np.zeros((2, 4, 2), np.uint8)
    packed[..., luma], packed[..., 1 - luma] = 126, 128
    grey = picture(image(encoding, packed, 4, 2, 8), "raw", "")
    np.testing.assert_allclose(grey, 128, atol=1)
    packed[..., luma], packed[:, ::2, 1 - luma], packed[:, 1::2, 1 - luma] = 81, 90, 240
    np.testing.assert_allclose(
        picture(image(encoding, packed, 4, 2, 8), "raw", "")[0, 0], [254, 0, 0], atol=2
    )


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1", "mono16", "rgb16", ""])
def test_what_is_no_8_bit_colour_is_refused(encoding: str) -> None:
    with pytest.raises(EpisodeError, match=r"not 8-bit colour.*rgb8"):
        picture(image(encoding, np.zeros(32, np.uint8), 4, 4, 8), "raw", "depth")


@pytest.mark.parametrize(
    "broken",
    [
        {"data": np.zeros(5, np.uint8)},
        {"width": 10**6, "height": 10**6},
        {"step": 3},
        {"height": 0},
        {"width": -4},
        {"width": None},
    ],
)
def test_a_raw_picture_that_does_not_fit_is_refused(broken: dict[str, Any]) -> None:
    message = image("rgb8", np.zeros(48, np.uint8), 4, 4, 12) | broken
    with pytest.raises(EpisodeError):
        picture(message, "raw", "camera")


def test_compressed_depth_is_refused_and_jpeg_is_decoded() -> None:
    jpeg = cv2.imencode(".jpg", smooth())[1]
    found = picture({"format": "rgb8; jpeg compressed bgr8", "data": jpeg.reshape(-1)}, "still", "")
    np.testing.assert_array_equal(found, cv2.imdecode(jpeg, cv2.IMREAD_COLOR)[..., ::-1])
    with pytest.raises(EpisodeError, match="depth"):
        picture({"format": "16UC1; compressedDepth png", "data": jpeg.reshape(-1)}, "still", "")
    for data in (b"no picture", "n@t base64", 5):
        with pytest.raises(EpisodeError):
            picture({"format": "jpeg", "data": data}, "still", "")


def write_video(path: Path, codec: str, name: str, options: dict[str, str], drop: int = 0) -> np.ndarray:
    """An MCAP of CompressedVideo, one frame a message; the pictures that went in."""
    import base64

    import av
    from mcap.writer import Writer

    y, x = np.mgrid[:64, :96]
    pictures = np.stack([np.stack([x * 2, y * 3, np.full_like(x, 8 * i)], -1) for i in range(30)]).astype(
        np.uint8
    )
    encoder = av.CodecContext.create(codec, "w")
    encoder.width, encoder.height, encoder.pix_fmt = 96, 64, "yuv420p"
    encoder.time_base = Fraction(1, 30)
    encoder.options = options
    packets = []
    for i, pixels in enumerate(pictures):
        frame = av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(format="yuv420p")
        frame.pts = i
        packets += encoder.encode(frame)
    packets += encoder.encode(None)
    assert len(packets) == 30
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=4096)
        writer.start()
        schema = writer.register_schema("foxglove.CompressedVideo", "jsonschema", b"{}")
        channel = writer.register_channel("/video", "json", schema)
        number = writer.register_channel("/n", "json", 0)
        for i, packet in list(enumerate(packets))[drop:]:
            text = {
                "timestamp": {"sec": 1 + i, "nsec": 0},
                "format": name,
                "data": base64.b64encode(bytes(packet)).decode(),
            }
            writer.add_message(channel, i + 1, json.dumps(text).encode(), i)
            writer.add_message(number, i + 1, b'{"value": 1}', i)
        writer.finish()
    return pictures


VIDEO_YAML = """
id: video
kind: real
frequency_hz: 30
action: {space: mixed, components: [{key: /n.value, dims: 1}]}
cameras: [{name: cam, key: /video}]
source: {format: rosbag}
"""
LOW_DELAY = {"preset": "ultrafast", "tune": "zerolatency", "g": "10", "crf": "10"}


@pytest.mark.parametrize(("codec", "name"), [("libx264", "h264"), ("libx265", "h265")])
def test_video_gives_the_asked_frames_in_any_order(tmp_path: Path, codec: str, name: str) -> None:
    options = LOW_DELAY | ({"x265-params": "log-level=none:keyint=10:bframes=0"} if name == "h265" else {})
    pictures = write_video(tmp_path / "v.mcap", codec, name, options)
    stream = read(tmp_path / "v.mcap", arm(VIDEO_YAML)).streams["cam"]
    for indices in ([0, 1, 2], [3, 7, 7], [25, 29], [12], [5, 4], [11, 28]):
        found = stream.frames(indices).astype(int)
        assert np.abs(found - pictures[indices]).mean() < 4, indices


def test_video_begins_at_its_first_key_frame(tmp_path: Path) -> None:
    pictures = write_video(tmp_path / "v.mcap", "libx264", "h264", LOW_DELAY, drop=4)
    stream = read(tmp_path / "v.mcap", arm(VIDEO_YAML)).streams["cam"]
    assert stream.timestamps[0] == 11
    assert np.abs(stream.frames([0]).astype(int) - pictures[10]).mean() < 4


def test_unknown_video_is_refused(tmp_path: Path) -> None:
    write_video(tmp_path / "v.mcap", "libx264", "mjpeg2000", LOW_DELAY)
    with pytest.raises(EpisodeError, match=r"'mjpeg2000' cannot be read.*h264"):
        read(tmp_path / "v.mcap", arm(VIDEO_YAML))


# -- folders


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


def test_a_folder_without_bags_and_a_missing_path_are_told(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="holds no bags"):
        SOURCE.index(str(tmp_path))
    with pytest.raises(SourceError, match="does not exist"):
        SOURCE.inspect(str(tmp_path / "nowhere"))


def test_a_link_out_of_the_folder_is_refused(bags: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "leak.bag").symlink_to(bags["ros1"])
    with pytest.raises(EpisodeError, match="link to a file outside"):
        SOURCE.read(str(tmp_path / "set"), "leak", arm())
    folder = tmp_path / "bag"
    shutil.copytree(bags["ros2-sqlite3"], folder)
    (folder / "run.db3").unlink()
    (folder / "run.db3").symlink_to(bags["ros2-sqlite3"] / "run.db3")
    with pytest.raises(EpisodeError, match="link to a file outside"):
        read(folder, arm())


def test_a_ros2_folder_in_several_files_is_one_episode(tmp_path: Path, recording: Recording) -> None:
    folder = tmp_path / "split"
    folder.mkdir()
    for i in range(3):
        part = KINDS["mcap-cdr-zstd"](tmp_path, make_recording(4, seed=i))
        part.rename(folder / f"split_{i}.mcap")
    names = "\n".join(f"    - split/split_{i}.mcap" for i in range(3))
    (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:\n{names}\n")
    episode = read(folder, arm())
    assert SOURCE.index(str(folder), arm())[0].frames == 12
    order = np.argsort(np.tile(np.arange(4), 3), kind="stable")  # the parts were all received at one time
    pictures = np.concatenate([make_recording(4, seed=i).pictures for i in range(3)])[order]
    np.testing.assert_array_equal(episode.streams["front"].frames(range(12)), pictures)


def test_a_listed_file_that_is_missing_is_told(bags: dict[str, Path], tmp_path: Path) -> None:
    shutil.copytree(bags["ros2-mcap"], tmp_path / "bag")
    (tmp_path / "bag" / "run.mcap").unlink()
    with pytest.raises(EpisodeError, match=r"names run\.mcap, which is not in the folder"):
        read(tmp_path / "bag", arm())


# -- damage


def touch_everything(path: Path) -> None:
    """Whatever a job would do with the bag."""
    SOURCE.index(str(path), arm())
    with contextlib.suppress(HMAError):
        SOURCE.inspect(str(path))
    episode = read(path, arm())
    episode.streams["front"].frames(range(len(episode.streams["front"].timestamps)))


SINGLE = {"ros1": "ros1", "ros1-bz2": "ros1", "ros1-lz4": "ros1", "mcap-cdr-zstd": "", "mcap-json": "",
          "mcap-without-chunks": "", "mcap-protobuf": "", "db3": ""}  # fmt: skip
PATIENT = settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))


def single(bags: dict[str, Path], kind: str) -> bytes:
    path = bags["ros2-sqlite3"] / "run.db3" if kind == "db3" else bags[kind]
    return path.read_bytes()


@pytest.mark.parametrize("kind", SINGLE)
@PATIENT
@given(share=st.floats(0, 1, exclude_max=True))
def test_a_bag_cut_off_anywhere_is_refused(
    kind: str, share: float, bags: dict[str, Path], tmp_path: Path
) -> None:
    whole = single(bags, kind)
    path = tmp_path / "cut.bag"
    path.write_bytes(whole[: int(len(whole) * share)])
    with pytest.raises(EpisodeError) as fault:
        touch_everything(path)
    assert "\n" not in str(fault.value)


@pytest.mark.parametrize("kind", SINGLE)
@PATIENT
@given(share=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7), fill=st.booleans())
def test_a_flipped_bit_gives_an_answer_or_our_error(
    kind: str, share: float, bit: int, fill: bool, bags: dict[str, Path], tmp_path: Path
) -> None:
    data = bytearray(single(bags, kind))
    at = int(len(data) * share)
    if fill:
        data[at : at + 8] = b"\xff" * 8
    else:
        data[at] ^= 1 << bit
    path = tmp_path / "flipped.bag"
    path.write_bytes(data)
    try:
        touch_everything(path)
    except HMAError as fault:
        assert "\n" not in str(fault)


def test_a_bag_that_holds_less_than_its_index_counts_is_refused(
    bags: dict[str, Path], tmp_path: Path
) -> None:
    zipped = tmp_path / "zipped"
    shutil.copytree(bags["ros2-sqlite3-file-zstd"], zipped)
    metadata = zipped / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("message_count: 10\n", "message_count: 12\n"))
    with pytest.raises(EpisodeError, match=r"its index counts 12 messages of /cam/image\.raw, it holds 10"):
        read(zipped, arm())


def test_a_chunk_that_unpacks_to_more_than_it_says_is_refused(
    bags: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from hma_data.sources.bags import container

    monkeypatch.setattr(container, "MAX_CHUNK", 4000)
    for kind in ("ros1-bz2", "mcap-cdr-zstd", "mcap-ros1-lz4"):
        with pytest.raises(EpisodeError, match="more than 4,000"):
            read(bags[kind], arm())
    for codec, packed in {"zstd": _zstd(10**6), "bz2": _bz2(10**6), "lz4": _lz4(10**6)}.items():
        with pytest.raises(ValueError, match="unpacks to"):
            container.decompress(codec, packed, 1000)


def _zstd(size: int) -> bytes:
    import zstandard

    return zstandard.compress(bytes(size))


def _bz2(size: int) -> bytes:
    import bz2

    return bz2.compress(bytes(size))


def _lz4(size: int) -> bytes:
    import lz4.frame

    return lz4.frame.compress(bytes(size))


def test_an_sqlite_log_that_was_not_merged_is_read_too(tmp_path: Path, recording: Recording) -> None:
    folder = KINDS["ros2-sqlite3"](tmp_path, recording)
    database = folder / "run.db3"
    base = sqlite3.connect(database)
    base.execute("PRAGMA journal_mode=WAL")
    base.execute(
        "INSERT INTO messages (topic_id, timestamp, data) SELECT topic_id, timestamp + 1, data FROM messages"
    )
    base.commit()
    killed = tmp_path / "killed"
    shutil.copytree(folder, killed)  # as a recorder that was killed leaves it: the rows are in the log
    base.close()
    assert (killed / "run.db3-wal").stat().st_size > 0
    assert SOURCE.index(str(killed), arm())[0].frames == 2 * len(recording.pictures)


def test_reading_leaves_nothing_beside_the_bag(bags: dict[str, Path]) -> None:
    for kind in ("ros2-sqlite3", "ros2-sqlite3-file-zstd"):
        before = sorted(bags[kind].iterdir())
        touch_everything(bags[kind])
        assert sorted(bags[kind].iterdir()) == before


def test_pictures_are_not_kept_in_memory(tmp_path: Path) -> None:
    import tracemalloc

    path = write_ros1(tmp_path / "long.bag", make_recording(400))
    size = path.stat().st_size
    tracemalloc.start()
    stream = read(path, arm()).streams["front"]
    tracemalloc.reset_peak()
    kept = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert kept < size / 2
    assert stream.frames([399]).shape == (1, 24, 32, 3)


# -- inspect


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
        assert (
            read(numbers_bag, keyed(key.key, key.shape[0], names)).actions[0].values.shape[1] == key.shape[0]
        )


def test_inspect_tells_of_stamps_that_repeat_pause_or_go_back(tmp_path: Path) -> None:
    shift = np.zeros(10, np.int64)
    shift[3], shift[5] = -100_000_000, -150_000_000
    shift[6:] = 5_000_000_000
    path = write_ros1(tmp_path / "bad.bag", replace(make_recording(), stamp_shift_ns=shift))
    problems = "\n".join(SOURCE.inspect(str(path)).problems)
    for fault in ("1 stamps are the one before again", "1 stamps go back in time", "pauses for 5.25"):
        assert fault in problems
    with pytest.raises(EpisodeError, match="goes back in time"):
        to_clip(read(path, arm()), arm())


# -- real recordings


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
    import yaml

    seen = 0
    for path in sorted((real_data / "ros2").rglob("metadata.yaml")):
        stated = yaml.safe_load(path.read_text())["rosbag2_bagfile_information"]
        found = sum(1 for _ in Bag(path.parent).records())
        assert found == stated["message_count"] == Bag(path.parent).counts().total(), path
        seen += 1
    assert seen >= 15


@pytest.mark.real
def test_ros2_twins_in_sqlite_and_mcap_hold_the_same_values(real_data: Path) -> None:
    folder = real_data / "ros2" / "rosbag2" / "rosbag2_tests" / "resources"
    store = get_typestore(Stores.ROS2_JAZZY)
    raw = [
        sorted(
            (r.channel.topic, r.log_ns, bytes(r.data)) for _, r in Bag(folder / kind / "cdr_test").records()
        )
        for kind in ("mcap", "sqlite3")
    ]
    assert raw[0] == raw[1] and store
    values = [
        decode(record.channel, record.data, "").float64_values.tolist()
        for _, record in Bag(folder / "mcap" / "cdr_test").records(frozenset({"/array_topic"}))
    ]
    assert len(values) == 4 and all(len(value) == 3 for value in values)


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
        assert [bytes(data) for data in bag.payloads([place for place, _ in found])] == [
            d for _, d in expected
        ]
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
    import base64

    first = base64.b64decode(next(m["data"] for topic, m in messages if topic == "/image/compressed"))
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    expected = cv2.imdecode(np.frombuffer(first, np.uint8), flags)[..., ::-1]
    np.testing.assert_array_equal(frames[0], expected)


@pytest.mark.real
def test_an_empty_bag_and_one_without_messages_are_told(real_data: Path) -> None:
    folder = real_data / "ros1" / "foxglove" / "fixtures"
    with pytest.raises(SourceError, match="is empty"):
        SOURCE.inspect(str(folder / "empty-file.bag"))
    with pytest.raises(SourceError, match="no bag holds a message"):
        SOURCE.inspect(str(folder / "no-messages.bag"))
    with pytest.raises(EpisodeError, match="it has no topics"):
        read(folder / "no-messages.bag", arm())
