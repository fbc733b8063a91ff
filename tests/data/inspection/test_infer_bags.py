"""Infer on bags: which topics command, which measure, which see, and on what clock."""

from pathlib import Path

import numpy as np
import pytest

from tests.data.bag_files import KINDS, Recording
from tests.data.inferring import (
    bag,
    compressed_of,
    first_clip,
    floats,
    inferred,
    joints_of,
    keys,
    picture_of,
    pictures,
    pose,
    questions,
    switch,
    trajectory,
    twist,
)


@pytest.mark.parametrize("kind", list(KINDS)[::3])  # test_rosbag reads all of them
def test_every_kind_of_bag(bags: dict[str, Path], recording: Recording, kind: str) -> None:
    values = inferred(bags[kind])
    assert keys(values, "action") == ["/command.data"] and keys(values, "state") == ["/joint_states.position"]
    assert values["state"]["components"][0]["names"] == ["shoulder", "elbow", "wrist"]
    assert values["cameras"][0]["key"] == "/cam/image.raw"
    assert values["frequency_hz"] == 10 and "25 Hz" in values["provenance"]["frequency_hz"]
    assert values["sync"]["max_skew_ms"] == 60
    clip = first_clip(bags[kind], values)
    held = np.searchsorted(recording.command_ns, recording.picture_ns, side="right") - 1
    np.testing.assert_allclose(clip.actions, recording.commands[held][: len(clip)], rtol=1e-6)


@pytest.mark.parametrize("form", ["ros1", "sqlite", "mcap"])
def test_both_arms_and_their_grippers_form_the_action(tmp_path: Path, form: str) -> None:
    path = bag(
        tmp_path / ("run.bag" if form == "ros1" else "run"),
        {
            "/cam_wrist/image_raw": (picture_of(), 30),
            "/cam_high/image_raw": (picture_of(), 30),
            "/cam_high/image_raw/compressed": (compressed_of(), 30),
            "/cam_high/depth/image_raw": (picture_of("16UC1"), 30),
            "/cam_high/infra1/image_raw": (picture_of("mono8"), 30),
            "/left_arm/command": (joints_of("l1", "l2"), 50),
            "/right_arm/command": (joints_of("r1", "r2"), 50),
            "/left_gripper/command": (floats(1), 10),
            "/left_arm/joint_states": (joints_of("l1", "l2"), 100),
            "/right_arm/joint_states": (joints_of("r1", "r2"), 100),
            "/ee_pose": (pose(), 50),
        },
        form,
    )
    values = inferred(path)
    assert [(c["name"], c["key"]) for c in values["cameras"]] == [
        ("cam_high", "/cam_high/image_raw"),
        ("wrist", "/cam_wrist/image_raw"),
    ]
    assert keys(values, "action") == [
        "/left_arm/command.position",
        "/right_arm/command.position",
        "/left_gripper/command.data",
    ]
    assert values["action"]["components"][1]["names"] == ["r1", "r2"]
    assert keys(values, "state") == [
        "/ee_pose.pose.position",
        "/ee_pose.pose.orientation",
        "/left_arm/joint_states.position",
        "/right_arm/joint_states.position",
    ]
    # Interpolated number by number, a quaternion that changes its sign would pass through 0.
    turned = [part.get("representation") for part in values["state"]["components"]]
    assert turned == [None, "quaternion_xyzw", None, None]
    assert values["frequency_hz"] == 30 and values["sync"]["max_skew_ms"] == 150
    assert questions(values).keys() == {"robot", "kind", "action.space"}
    assert first_clip(path, values).actions.shape[1] == 5


CHOICES = {  # topics; keys of the action; what the question about the action names, if there is one
    "a gripper that is commanded more often does not replace its arm": (
        {"/gripper/command": (joints_of("gripper"), 21), "/servo/command": (twist(), 20)},
        ["/servo/command.linear", "/servo/command.angular", "/gripper/command.position"],
        None,
    ),
    "several commands are a question that names the others": (
        {"/cmd_vel": (twist(), 10), "/desired_pose": (pose(), 10)},
        ["/cmd_vel.linear", "/cmd_vel.angular"],
        "/desired_pose.pose.position",
    ),
    "without a commanding topic joint states are proposed": (
        {"/pose": (pose(), 10)},
        ["/joint_states.position"],
        "no topic holds commands",
    ),
}


@pytest.mark.parametrize("case", CHOICES)
def test_what_commands(tmp_path: Path, case: str) -> None:
    topics, action, question = CHOICES[case]
    seen = {"/camera/image": (picture_of(), 20), "/joint_states": (joints_of("a"), 50)}
    path = bag(tmp_path / "run", seen | topics)
    values = inferred(path)
    assert keys(values, "action") == action and (question or "") in questions(values).get(
        "provenance.action", ""
    )
    first_clip(path, values)


def test_a_gripper_that_opens_and_closes_keeps_its_two_values(tmp_path: Path) -> None:
    for low, high, kept in ((0, 1, True), (-1, 1, True), (0, 0.04, False), (0, 255, False)):
        topics = {
            "/camera/image": (picture_of(), 20),
            "/arm/command": (joints_of("a", "b"), 20),
            "/gripper/command": (switch(low, high), 20),
        }
        arm, gripper = inferred(bag(tmp_path / f"{high}_{low}", topics))["action"]["components"]
        assert gripper["key"] == "/gripper/command.data" and "normalize" not in arm
        assert gripper.get("normalize", True) is not kept


def test_values_of_two_keys_have_own_names_and_a_short_bag_a_rate_at_which_a_model_sees_enough(tmp_path):
    topics = {"/image": (picture_of(), 20), "/cmd_vel": (twist(), 20)}
    values = inferred(bag(tmp_path / "run", topics, seconds=4))
    names = [name for one in values["action"]["components"] for name in one["names"]]
    assert names == ["linear_x", "linear_y", "linear_z", "angular_x", "angular_y", "angular_z"]
    assert values["target_hz"] == 6.667


def test_a_goal_sent_once_or_twice_is_doubted(tmp_path: Path) -> None:
    topics = {"/image": (picture_of(), 10), "/goal_pose": (pose(), 1), "/arm_data": (floats(4), 20)}
    values = inferred(bag(tmp_path / "run", topics, seconds=2))
    assert "/arm_data.data" in questions(values)["provenance.action"]


def test_a_picture_taken_once_is_no_camera(tmp_path: Path) -> None:
    topics = {
        "/calib/image": (picture_of(), 1),
        "/front/image": (picture_of(), 10),
        "/cmd_vel": (twist(), 10),
    }
    path = bag(tmp_path / "run", topics)
    values = inferred(path)
    assert keys(values, "cameras") == ["/front/image"] and len(first_clip(path, values)) == 10


def test_a_leader_commands_and_its_follower_is_the_state(tmp_path: Path) -> None:
    topics = {
        "/image": (picture_of(), 10),
        "/follower/joint_states": (joints_of("a", "b"), 30),
        "/leader/joint_states": (joints_of("a", "b"), 30),
    }
    values = inferred(bag(tmp_path / "run", topics))
    assert keys(values, "action") == ["/leader/joint_states.position"]
    assert keys(values, "state") == ["/follower/joint_states.position"]
    assert "provenance.action" not in questions(values)


def test_a_trajectory_commands_by_its_first_point(tmp_path: Path) -> None:
    topics = {"/image": (picture_of(), 10), "/arm_controller/joint_trajectory": (trajectory(), 10)}
    path = bag(tmp_path / "run", topics)
    values = inferred(path)
    assert values["action"]["components"] == [
        {"key": "/arm_controller/joint_trajectory.points[0].positions", "dims": 2, "names": ["a", "b"]}
    ]
    assert (first_clip(path, values).actions == 1).all()


def test_stamps_of_another_clock_make_it_receive_times(tmp_path: Path) -> None:
    topics = {"/image": (picture_of(shift_ns=-(10**13)), 10), "/cmd_vel": (twist(), 20)}
    path = bag(tmp_path / "run", topics)
    values = inferred(path)
    assert values["sync"]["stamp"] == "receive" and "receipt" in values["provenance"]["stamp"]
    assert len(first_clip(path, values)) == 10


def test_a_rate_is_whole_where_jitter_hides_the_difference(tmp_path: Path) -> None:
    path = bag(tmp_path / "run", {"/image": (picture_of(), 29.97), "/cmd_vel": (twist(), 10)}, seconds=2)
    assert inferred(path)["frequency_hz"] == 29.97


@pytest.mark.parametrize("encoding", ["mono8", "mono16"])
def test_mono_cameras_are_pictures_without_a_question(tmp_path: Path, encoding: str) -> None:
    path = bag(tmp_path / "run", {"/image": (picture_of(encoding), 10), "/cmd_vel": (twist(), 20)})
    values = inferred(path)
    assert keys(values, "cameras") == ["/image"] and "provenance.cameras" not in questions(values)
    assert values["cameras"][0].get("levels") == ([0, 4095] if encoding == "mono16" else None)
    shown = first_clip(path, values).frames_at("primary", np.arange(1))[0]
    grey = pictures(1, 1)[0, ..., 0]
    expected = np.rint(grey * 16.0 / 4095 * 255) if encoding == "mono16" else grey
    np.testing.assert_array_equal(shown, np.repeat(expected[..., None], 3, -1))


def test_mono_cameras_come_after_those_in_colour(tmp_path: Path) -> None:
    topics = {"/a": (picture_of("mono8"), 10), "/b": (picture_of(), 10), "/c": (picture_of("8UC1"), 10)}
    values = inferred(bag(tmp_path / "run", {**topics, "/cmd_vel": (twist(), 20)}))
    assert keys(values, "cameras") == ["/b", "/a"]
