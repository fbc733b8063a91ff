"""Infer: the YAML of every format says what the recording says, asks the rest, and then reads it."""

import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from hma_data.episodes.align import to_clip
from hma_data.errors import HMAError, SourceError, UsageError
from hma_data.inspection.infer import from_inspection, infer
from hma_data.registry.embodiment import Embodiment, find
from hma_data.sources.base import open_source
from hma_data.sources.common.checks import seconds_a_unit
from hma_data.sources.common.inspection import Inspection, KeyInfo, TopicInfo
from hma_data.storage.yaml_io import parse_yaml
from tests.command import ROOT, hma
from tests.conftest import problems
from tests.data import rlds_files
from tests.data.inferring import H, T, W, answered, first_clip, inferred, keys, numbers, pictures, questions
from tests.data.rlds_files import TEXT, features_dict, image, png, tensor
from tests.data.videos import CAMERA, STILL, make_v2, make_v3


def test_of_a_whole_and_its_parts_one_is_the_action(tmp_path: Path) -> None:
    path, vector = tmp_path / "two_arms.hdf5", numbers(T, 6).astype(np.float32)
    with h5py.File(path, "w") as file:
        file["observation/head/rgb"] = np.stack(pictures(0))
        file["joint_action/vector"] = vector
        for name, part in (
            ("left", slice(0, 2)),
            ("left_gripper", 2),
            ("right", slice(3, 5)),
            ("right_gripper", 5),
        ):
            file[f"joint_action/{name}"] = vector[:, part]
    values = inferred(path)
    assert sum(part["dims"] for part in values["action"]["components"]) == 6
    assert "also recorded: joint_action/vector?" in values["provenance"]["action"]


@pytest.mark.parametrize("image", ["obs/sensor_data/base_camera/rgb", "observations"])
def test_the_observation_after_the_last_action_does_not_hide_the_action(tmp_path: Path, image: str) -> None:
    """As ManiSkill and Minari record."""
    path = tmp_path / "trajectory.h5"
    with h5py.File(path, "w") as file:
        for episode in ("traj_0", "traj_1"):
            file[f"{episode}/actions"] = numbers(T, 3)
            file[f"{episode}/{image}"] = np.stack(pictures(length=T + 1))
            if image != "observations":
                file[f"{episode}/obs/agent/qpos"] = numbers(T + 1, 2)
    values = inferred(path)
    assert keys(values, "action") == ["actions"] and "action" not in values["provenance"]
    assert values["source"]["layout"] == {"last_observation": "drop"}
    assert len(first_clip(path, values)) == T


# -- RLDS


def rlds(folder: Path, action: dict[str, Any], observation: dict[str, Any], **more: Any) -> Path:
    found = {f"action/{key}": item for key, item in action.items()}
    found |= {f"observation/{key}": item for key, item in observation.items()} | more
    steps: dict[str, Any] = {
        "action": features_dict({key: feature for key, (feature, _) in action.items()}),
        "observation": features_dict({key: feature for key, (feature, _) in observation.items()}),
    } | {key: feature for key, (feature, _) in more.items()}
    record = {f"steps/{key}": values for key, (_, values) in found.items()}
    return rlds_files.write(folder, {"toy-train.tfrecord-00000-of-00001": [record]}, steps)


def picture_feature(seed: int = 0) -> tuple[Any, list[bytes]]:
    return image((H, W, 3)), [png(picture) for picture in pictures(seed)]


def three_cameras(folder: Path, black: tuple[str, ...]) -> Path:
    """A dataset of the cameras front, side and top, some black, side frozen."""
    feature, seen = picture_feature()
    shown = {"front": seen, "side": seen[:1] * T, "top": seen}
    dark = [png(np.zeros((H, W, 3), np.uint8))] * T
    cameras = {name: (feature, dark if name in black else shown[name]) for name in shown}
    return rlds(folder / "toy" / "0.1.0", {"move": (tensor((2,)), numbers(T, 2).astype(np.float32))}, cameras)


def test_a_camera_that_is_always_black_is_left_out_and_a_frozen_one_noted(tmp_path: Path) -> None:
    values = inferred(three_cameras(tmp_path, black=("front",)))
    assert keys(values, "cameras") == ["observation/top", "observation/side"]
    said = values["provenance"]["cameras"]
    assert "observation/front: shows only one colour in 1 of 1 sampled episodes, and is left out" in said
    assert "observation/side: 100% of neighbouring images are equal" in said and "top" not in said


def test_cameras_that_are_all_black_are_kept_and_noted(tmp_path: Path) -> None:
    values = inferred(three_cameras(tmp_path, black=("front", "side", "top")))
    assert len(keys(values, "cameras")) == 3 and "left out" not in values["provenance"]["cameras"]


def oxe(folder: Path) -> Path:
    """A dataset with actions in parts, as those of Open X-Embodiment have them."""
    grey = [png(picture[..., 0]) for picture in pictures()]
    return rlds(
        folder / "toy" / "0.1.0",
        action={
            "gripper_closedness_action": (tensor((1,)), numbers(T, 1).astype(np.float32)),
            "rotation_delta": (tensor((3,)), numbers(T, 3).astype(np.float32)),
            "terminate_episode": (tensor((3,), "int32"), np.zeros((T, 3), np.int64)),
            "world_vector": (tensor((3,), "float64"), numbers(T, 3)),
            "base_displacement_vector": (tensor((2,)), np.zeros((T, 2), np.float32)),
        },
        observation={
            "hand_image": picture_feature(1),
            "front_rgb": picture_feature(0),
            "depth": (image((H, W, 1)), grey),
            "object_mask": (image((H, W, 3)), picture_feature(2)[1]),
            "natural_language_instruction": (TEXT, [b"lift"] * T),
            "natural_language_embedding": (tensor((512,)), np.zeros((T, 512), np.float32)),
            "joint_pos": (tensor((7,)), numbers(T, 7).astype(np.float32)),
            "joint_vel": (tensor((7,)), numbers(T, 7).astype(np.float32)),
            "gripper_closedness_commanded": (tensor((1,)), numbers(T, 1).astype(np.float32)),
        },
        reward=(tensor(), [0.0] * T),
        is_last=(tensor((), "bool"), [0] * T),
    )


def test_rlds_actions_in_parts_come_in_order_and_read_back(tmp_path: Path) -> None:
    path = oxe(tmp_path)
    values = inferred(path)
    assert keys(values, "action") == [
        "action/world_vector",
        "action/rotation_delta",
        "action/gripper_closedness_action",
    ]
    assert values["action"]["components"][2]["normalize"] is False
    clip = first_clip(path, values)
    want = np.concatenate([numbers(T, 3), numbers(T, 3), numbers(T, 1)], axis=1).astype(np.float32)
    np.testing.assert_allclose(clip.actions, want, rtol=1e-6)
    assert clip.episode.instruction == "lift"


def test_rlds_cameras_states_and_questions(tmp_path: Path) -> None:
    values = inferred(oxe(tmp_path))
    assert [(c["name"], c["key"], c["size"]) for c in values["cameras"]] == [
        ("front", "observation/front_rgb", [H, W]),
        ("wrist", "observation/hand_image", [H, W]),
    ]
    assert keys(values, "state") == ["observation/joint_pos"]
    assert values["source"]["instruction"] == "observation/natural_language_instruction"
    assert "split" not in values["source"] and values["source"]["episodes"] == 1
    asked = questions(values)
    assert asked.keys() == {
        "robot", "kind", "frequency_hz", "action.space", "provenance.frequency_hz", "provenance.action",
    }  # fmt: skip
    assert "base_displacement_vector never changes" in asked["provenance.action"]
    assert "observation/depth" in values["notes"] and "terminate_episode" in values["notes"]


def test_several_encodings_of_one_command_are_a_question(tmp_path: Path) -> None:
    action = {name: (tensor((7,)), numbers(T, 7).astype(np.float32)) for name in ("actions", "rel_actions")}
    path = rlds(tmp_path / "d", action, {"image": picture_feature()})
    values = inferred(path)
    assert keys(values, "action") == ["action/actions"]
    assert "action/rel_actions" in questions(values)["provenance.action"]
    assert "joint_velocity, " in questions(values)["action.space"]
    first_clip(path, values)


def listed_datasets() -> Iterator[Any]:
    """Those whose features are listed and whose embodiment ships, judged by people."""
    for file in sorted((Path(__file__).parents[1] / "rlds_features").glob("*.yaml")):
        for name, facts in yaml.safe_load(file.read_text()).items():
            yield pytest.param(name, facts["steps"], id=name)


# Read otherwise by a person, who knew more than the names of the keys; the question names the other key.
OTHERWISE = {"droid", "taco_play", "fractal20220817_data", "kuka"}


@pytest.mark.parametrize(("name", "steps"), list(listed_datasets()))
def test_listed_datasets_get_the_keys_that_a_person_chose(name: str, steps: dict[str, str]) -> None:
    values = parse_yaml(from_inspection(listed(name, steps), "mine"), name)
    robot = find(name)
    assert all("still TODO" in problem for problem in problems(values))
    assert {camera.key for camera in robot.cameras} <= set(keys(values, "cameras"))
    if name not in OTHERWISE:
        assert list(dict.fromkeys(part.key for part in robot.action.components)) == keys(values, "action")
    assert values["source"].get("instruction") == robot.source.instruction


def listed(name: str, steps: dict[str, str]) -> Inspection:
    """The inspection of a dataset whose features are `float32[7]` and the like."""
    found = []
    for key, text in steps.items():
        dtype, _, sides = text.rstrip("]").partition("[")
        shape = tuple(int(side) if side.strip().isdigit() else 0 for side in sides.split(",") if side)
        kinds = {"image": "camera", "text": "text"}
        info = KeyInfo(key, kinds.get(dtype, "vector"), shape, {"image": "uint8"}.get(dtype, dtype), count=9)
        found.append(info)
    return Inspection("rlds", name, 1, tuple(found))


# -- HDF5


ROBOMIMIC = {
    "env_name": "Lift",
    "type": 1,
    "env_kwargs": {"control_freq": 20, "robots": ["Panda"], "controller_configs": {"type": "OSC_POSE"}},
}


def robomimic(path: Path, arguments: dict[str, Any]) -> Path:
    with h5py.File(path, "w") as file:
        file.create_group("data").attrs["env_args"] = json.dumps(arguments)
        demo = file.create_group("data/demo_0")
        demo["actions"], demo["rewards"], demo["states"] = numbers(T, 7), np.zeros(T), numbers(T, 32)
        for group in ("obs", "next_obs"):
            demo[f"{group}/robot0_eye_in_hand_image"], demo[f"{group}/agentview_image"] = (
                pictures(1),
                pictures(),
            )
            demo[f"{group}/agentview_depth"] = numbers(T, H, W, 1).astype(np.float32)
            demo[f"{group}/agentview_segmentation"] = pictures(2)[..., 0]
            demo[f"{group}/object"] = numbers(T, 10)
            for name, width in (("eef_pos", 3), ("eef_quat", 4), ("gripper_qpos", 2), ("joint_pos_cos", 7)):
                demo[f"{group}/robot0_{name}"] = numbers(T, width)
            demo[f"{group}/robot0_joint_vel"] = numbers(T, 7)
    return path


def test_robomimic_is_a_simulation_with_its_rate(tmp_path: Path) -> None:
    path = robomimic(tmp_path / "demo.hdf5", ROBOMIMIC)
    values = inferred(path)
    assert questions(values).keys() == {"action.space"}
    assert values["action"]["components"] == [{"key": "actions", "dims": 7}]
    assert (values["kind"], values["robot"], values["frequency_hz"]) == ("simulation", "Panda", 20)
    assert keys(values, "cameras") == ["obs/agentview_image", "obs/robot0_eye_in_hand_image"]
    assert keys(values, "state") == [f"obs/robot0_{n}" for n in ("eef_pos", "eef_quat", "gripper_qpos")]
    np.testing.assert_array_equal(first_clip(path, values).actions, numbers(T, 7).astype(np.float32))


def test_libero_states_once_and_no_embedding(tmp_path: Path) -> None:
    path = tmp_path / "libero.hdf5"
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({**ROBOMIMIC, "env_name": "Libero_Tabletop_Manipulation"})
        data.attrs["problem_info"] = json.dumps({"language_instruction": "open the drawer"})
        demo = data.create_group("demo_0")
        demo["actions"], demo["states"], demo["robot_states"] = numbers(T, 7), numbers(T, 40), numbers(T, 9)
        demo["obs/agentview_rgb"], demo["obs/eye_in_hand_rgb"] = pictures(), pictures(1)
        for name, width in (("ee_ori", 3), ("ee_pos", 3), ("ee_states", 6), ("joint_states", 7)):
            demo[f"obs/{name}"] = numbers(T, width)
        demo["obs/gripper_states"] = numbers(T, 2)
    values = inferred(path)
    assert keys(values, "state") == ["obs/ee_states", "obs/joint_states", "obs/gripper_states"]
    assert [camera["name"] for camera in values["cameras"]] == ["agentview", "wrist"]
    assert first_clip(path, values).episode.instruction == "open the drawer"


def aloha(folder: Path, compressed: bool, **attributes: Any) -> Path:
    folder.mkdir()
    for i in range(2):
        with h5py.File(folder / f"episode_{i}.hdf5", "w") as file:
            for name, value in attributes.items():
                file.attrs[name] = value
            file["action"], file["base_action"] = numbers(T, 14), numbers(T, 2)
            for name in ("qpos", "qvel", "effort"):
                file[f"observations/{name}"] = numbers(T, 14)
            for name in ("cam_left_wrist", "cam_high"):
                shots = pictures()
                if compressed:
                    coded = [cv2.imencode(".jpg", shot)[1].ravel() for shot in shots]
                    longest = max(map(len, coded))
                    shots = np.stack([np.pad(code, (0, longest - len(code))) for code in coded])
                file[f"observations/images/{name}"] = shots
            file["compress_len"] = np.zeros((2, T))
    return folder


@pytest.mark.parametrize("compressed", [False, True])
def test_aloha_asks_for_colours_and_for_the_base(tmp_path: Path, compressed: bool) -> None:
    path = aloha(tmp_path / "aloha", compressed)
    values = inferred(path)
    assert [(c["name"], c["size"]) for c in values["cameras"]] == [("cam_high", [H, W]), ("wrist", [H, W])]
    assert keys(values, "action") == ["action"] and keys(values, "state") == ["observations/qpos"]
    asked = questions(values)
    assert "bgr" in asked["cameras[0].color"] and "base_action" in asked["provenance.action"]
    assert values["source"]["episodes"] == 2
    np.testing.assert_array_equal(first_clip(path, values).actions, numbers(T, 14).astype(np.float32))
    said = open_source("hdf5").inspect(str(path)).findings
    assert not [found for found in said if "compress_len" in str(found)]  # (cameras, T) by design


@pytest.mark.parametrize(("stored", "color"), [("rgb", None), ("bgr", "bgr")])
def test_images_that_once_were_jpeg_answer_the_question_of_colours(tmp_path, stored, color) -> None:
    soft = [cv2.GaussianBlur(shot, (0, 0), 1) // 2 + 64 for shot in pictures()]
    shots = np.stack([cv2.imdecode(cv2.imencode(".jpg", shot)[1], cv2.IMREAD_COLOR) for shot in soft])
    with h5py.File(tmp_path / "run.hdf5", "w") as file:
        file["observations/images/cam"] = shots if stored == "bgr" else shots[..., ::-1]
        file["action"] = numbers(T, 3)
    values = inferred(tmp_path / "run.hdf5")
    assert values["cameras"][0].get("color") == color
    assert ("red and blue are swapped" in values["provenance"].get("cameras", "")) == (color == "bgr")


def test_a_simulators_state_is_not_the_robots(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "run.hdf5", "w") as file:
        demo = file.create_group("data/demo_0")
        demo.attrs["model_file"] = "panda.xml"
        demo["images/front"], demo["states"] = pictures(), numbers(T, 40)
        demo["joint_velocities"], demo["gripper_actuations"] = numbers(T, 7), numbers(T, 1)
    values = inferred(tmp_path / "run.hdf5")
    assert "state" not in values and values["kind"] == "simulation"
    assert keys(values, "action") == ["joint_velocities", "gripper_actuations"]
    first_clip(tmp_path / "run.hdf5", values)


def test_a_simulated_aloha_has_no_doubt_about_colours(tmp_path: Path) -> None:
    values = inferred(aloha(tmp_path / "aloha", False, sim=True))
    assert values["kind"] == "simulation" and "color" not in values["cameras"][0]


def test_other_hdf5_takes_rate_and_times_from_the_recording(tmp_path: Path) -> None:
    path = tmp_path / "run.hdf5"
    stamps = 1.7e9 + np.arange(T) / 15
    with h5py.File(path, "w") as file:
        file["front/rgb"], file["front/stamps"] = pictures(), stamps
        file["teleop/joint_velocity"] = numbers(T, 6)
        file["teleop/gripper"] = numbers(T)
        file["proprio/joint_position"] = numbers(T, 6)
        file["lidar"] = numbers(5 * T, 3)
        file["arm/stamps"] = 1_700_000_000.0 + np.arange(5 * T) / 75  # of another sensor
        file["language_instruction"] = "stack the cups"
    values = inferred(path)
    assert values["frequency_hz"] == 15
    assert values["provenance"]["frequency_hz"] == "measured from front/stamps"
    assert values["source"]["layout"] == {"timestamps": "front/stamps"}
    assert values["source"]["instruction"] == "language_instruction"
    assert keys(values, "action") == ["teleop/joint_velocity", "teleop/gripper"]
    assert values["action"]["components"][1] == {"key": "teleop/gripper", "dims": 1, "normalize": False}
    assert "teleop" in questions(values)["provenance.action"]
    clip = first_clip(path, values)
    np.testing.assert_allclose(clip.timestamps, stamps - stamps[0], atol=1e-6)
    assert clip.episode.instruction == "stack the cups"


@pytest.mark.parametrize(
    ("factor", "dtype", "axes", "pixels"),
    [(1 / 255, "f4", "THWC", "0-1"), (1, "f8", "TCHW", "0-255"), (257, "u2", "THWC", "0-65535")],
)
def test_colours_of_other_numbers_than_bytes_are_cameras_with_their_range(
    tmp_path: Path, factor: float, dtype: str, axes: str, pixels: str
) -> None:
    path, seen = tmp_path / "run.hdf5", np.random.default_rng(0).integers(0, 256, (T, 24, 32, 3))
    seen[[0, -1], 0, 0] = 255
    stored = (seen * factor).astype(dtype)
    with h5py.File(path, "w") as file:
        file["front"] = stored if axes == "THWC" else stored.transpose(0, 3, 1, 2)
        file["points"] = stored / stored.max() - 0.5  # x, y, z of each pixel
        file["action"] = numbers(T, 3)
    values = inferred(path)
    assert [(one["key"], one["size"]) for one in values["cameras"]] == [("front", [24, 32])]
    assert values["source"]["layout"] == {"pixels": pixels}
    clip = first_clip(path, values)
    (name,) = clip.frame_indices
    np.testing.assert_array_equal(clip.frames_at(name, np.arange(T)), seen)


@pytest.mark.parametrize(
    ("attributes", "times", "hz"),
    [
        ({"fps": 12}, None, 12),
        ({"fps": "fast"}, None, None),
        ({"fps": "12.5 Hz"}, None, 12.5),
        ({"fps": "1" * 60_000 + "x"}, None, None),  # a pattern that tries every split takes an hour
        ({"hz": np.array([b"15"])}, None, 15),
        ({"control_freq": "0", "rate": "-3", "frequency": "1e3"}, None, None),
        ({}, np.arange(T) * 50_000_000 + 1_700_000_000_000_000_000, 20),
        ({}, np.arange(T), None),  # counts frames
        ({}, np.arange(T) * 0.1, 10),
    ],
)
def test_rates_of_attributes_and_of_times_in_any_unit(tmp_path, attributes, times, hz) -> None:
    path = tmp_path / "run.hdf5"
    with h5py.File(path, "w") as file:
        for name, value in attributes.items():
            file.attrs[name] = value
        file["image"], file["action"] = pictures(), numbers(T, 3)
        if times is not None:
            file["timestamp"] = times
    values = inferred(path)
    assert (values["frequency_hz"] == hz) if hz else ("frequency_hz" in questions(values))
    first_clip(path, values)


@pytest.mark.parametrize("hz", [5, 30, 1000])
@pytest.mark.parametrize("since", [10, 3_600, 100_000])
def test_times_since_a_machine_was_started_are_of_the_unit_that_their_key_names(since: int, hz: int) -> None:
    seconds = since + np.arange(T) / hz
    for key, unit in (("timestamp_ns", 1e-9), ("time_us", 1e-6), ("obs/time_ms", 1e-3)):
        assert seconds_a_unit(np.rint(seconds / unit).astype(np.int64), key) == unit
    assert (
        seconds_a_unit(np.rint(seconds * 1e9).astype(np.int64), "timestamp") is None
    )  # not of µs since 1973


@pytest.mark.parametrize(
    ("place", "stated"),
    [("", 12), ("data/demo_0", np.float32(12)), ("", b"12"), ("", "12 fps"), ("data/demo_0", [12])],
)
def test_a_rate_may_be_a_dataset_of_one_value(tmp_path: Path, place: str, stated: Any) -> None:
    path = tmp_path / "run.hdf5"
    with h5py.File(path, "w") as file:
        file["data/demo_0/image"], file["data/demo_0/action"] = pictures(), numbers(T, 3)
        file[f"{place}/fps"] = stated
    values = inferred(path)
    assert values["frequency_hz"] == 12 and not open_source("hdf5").inspect(str(path)).problems
    assert values["provenance"]["frequency_hz"] == f"fps in /{place}"


def test_a_recording_without_commands_proposes_its_own_position_as_a_question(tmp_path: Path) -> None:
    path = tmp_path / "run.hdf5"
    with h5py.File(path, "w") as file:
        file["data/demo_0/obs/image"], file["data/demo_0/obs/qpos"] = pictures(), numbers(T, 6)
        file["data/demo_0/obs/qvel"] = numbers(T, 6)
    values = inferred(path)
    assert keys(values, "action") == ["obs/qpos"] and values["sync"] == {"action_shift": 1}
    assert "obs/qvel" in questions(values)["provenance.action"]
    np.testing.assert_array_equal(first_clip(path, values).actions, numbers(T, 6).astype(np.float32)[1:])


# -- LeRobot


def with_features(folder: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """A dataset whose info.json states other features than its files have."""
    file = make_v2(folder) / "meta/info.json"
    info = json.loads(file.read_text())
    change(info["features"])
    file.write_text(json.dumps(info))
    return folder


def test_the_size_of_frames_is_measured_whatever_info_json_states(tmp_path: Path) -> None:
    path = with_features(tmp_path / "set", lambda features: features[CAMERA].update(shape=[480, 640, 4]))
    assert [camera["size"] for camera in inferred(path)["cameras"]] == [[64, 96]] * 2


@pytest.mark.parametrize("make", [make_v2, make_v3])
def test_lerobot_names_rate_words_and_robot(tmp_path: Path, make: Callable[..., Path]) -> None:
    path = make(tmp_path / "set")
    values = inferred(path)
    assert values["action"]["components"] == [{"key": "action", "dims": 2, "names": ["which", "row"]}]
    assert keys(values, "state") == ["observation.state"]
    assert keys(values, "cameras") == [CAMERA, STILL] and values["cameras"][0]["size"] == [64, 96]
    assert (values["frequency_hz"], values["robot"]) == (10, "testbot")
    assert values["source"] | {"uri": ""} == {
        "format": "lerobot",
        "uri": "",
        "episodes": 3,
        "instruction": "task",
    }
    assert questions(values).keys() == {"kind", "action.space"}
    clip = first_clip(path, values)
    np.testing.assert_array_equal(clip.actions[:, 1], np.arange(12))


@pytest.mark.parametrize(
    ("stated", "names"),
    [
        ({"left": ["a.pos"], "right": ["b.pos"]}, ["a.pos", "b.pos"]),
        ({"left": ["wrist.pos"], "right": ["wrist.pos"]}, ["left_wrist.pos", "right_wrist.pos"]),
        ({"x": 1, "y": 0}, ["y", "x"]),
        ([["a"], ["b"]], ["a", "b"]),
        (["a", 3], None),
        (["a", "b", "c"], None),
        (None, None),
    ],
)
def test_lerobot_names_in_every_form(tmp_path: Path, stated: Any, names: list[str] | None) -> None:
    path = with_features(tmp_path / "set", lambda features: features["action"].update(names=stated))
    assert inferred(path)["action"]["components"][0].get("names") == names


def test_the_currents_of_motors_are_no_state(tmp_path: Path) -> None:  # as AgiBot World has them
    def change(features: dict[str, Any]) -> None:
        state = features.pop("observation.state")
        features |= {f"observation.states.joint.{name}": state for name in ("current_value", "position")}

    path = with_features(tmp_path / "set", change)
    assert keys(inferred(path), "state") == ["observation.states.joint.position"]


def test_lerobot_depth_and_grey_features_are_left_out(tmp_path: Path) -> None:
    def change(features: dict[str, Any]) -> None:
        features[STILL]["shape"] = [64, 96, 1]
        features["observation.images.depth_high"] = features[CAMERA]
        features["observation.images.far"] = features[CAMERA] | {"info": {"video.is_depth_map": True}}

    assert keys(inferred(with_features(tmp_path / "set", change)), "cameras") == [CAMERA]


# -- real recordings


def test_real_bridge(real_data: Path) -> None:
    path = real_data / "rlds/bridge_dataset/1.0.0"
    values = inferred(path)
    assert keys(values, "cameras") == [f"observation/image_{i}" for i in range(3)]
    assert "image_3: shows only one colour" in values["provenance"]["cameras"]  # black in all episodes
    assert (keys(values, "action"), keys(values, "state")) == (["action"], ["observation/state"])
    assert values["source"]["episodes"] == 50 and values["source"]["instruction"] == "language_instruction"
    assert first_clip(path, values).episode.instruction


def test_real_rendered_robomimic(real_data: Path) -> None:
    path = real_data / "hdf5/lift_rendered.hdf5"
    values = inferred(path)
    assert (values["robot"], values["kind"], values["frequency_hz"]) == ("Panda", "simulation", 20)
    assert [camera["size"] for camera in values["cameras"]] == [[128, 128], [64, 64]]
    assert questions(values).keys() == {"action.space"}
    with h5py.File(path) as file:
        want = file["data/demo_0/actions"][()].astype(np.float32)
    np.testing.assert_array_equal(first_clip(path, values).actions, want)


def test_real_g1(real_data: Path) -> None:
    path = real_data / "lerobot/g1_v21"
    values = inferred(path)
    assert "# The registry has g1_inspire with these keys" in infer(str(path), "mine")
    robot = find("g1_inspire")
    assert values["action"]["components"][0]["names"] == robot.action.names()
    assert values["frequency_hz"] == 30 and values["source"]["episodes"] == 100
    ready = Embodiment.from_values(answered(values), "inferred")
    with_video = next(path.glob("videos/*/*/*.mp4")).stem
    clip = to_clip(open_source("lerobot").read(str(path), with_video, ready), ready)
    assert clip.frames_at(ready.cameras[0].name, np.arange(1)).shape == (1, 480, 640, 3)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("mcap/custom-camera-model.mcap", ("/image/compressed", "nothing that could be an action")),
        ("hdf5/robosuite_lift/demo.hdf5", ("no colour camera", "joint_torques")),
        ("ros1/fake_joint_state.bag", ("no colour camera", "/fake_joints_state.position")),
        ("ros1/foxglove/fixtures/example.bag", ("no colour camera", "/turtle1/cmd_vel.linear")),
        ("ros1/foxglove/fixtures/empty-file.bag", ("is empty",)),
        ("ros1/foxglove/fixtures/no-messages.bag", ("no bag holds a message",)),
    ],
)
def test_real_recordings_of_no_use_say_what_is_there(real_data, name, words) -> None:
    with pytest.raises(SourceError) as caught:
        infer(str(real_data / name), "mine")
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 900
    for word in words:
        assert word in str(caught.value)


# -- robots that the registry has


def test_a_robot_of_the_registry_is_named_by_its_recording_or_its_keys(tmp_path: Path) -> None:
    path = tmp_path / "run.hdf5"
    with h5py.File(path, "w") as file:
        demo = file.create_group("data/demo_0")
        demo["actions"], demo["obs/front"] = numbers(T, 5), pictures()

    def told() -> str:
        done = hma("registry", "infer", path, "--id", "mine", "--out", tmp_path / "mine.yaml", cwd=tmp_path)
        (tmp_path / "mine.yaml").unlink()
        return done.stdout

    assert "The registry" not in told()
    values = answered(inferred(path)) | {"id": "ours"}
    known = tmp_path / "registry" / "ours.yaml"
    known.parent.mkdir()
    known.write_text(yaml.safe_dump(values))
    line = "The registry has ours for this recording: hma registry show ours"
    assert line in told()
    cut = [{"key": "actions", "dims": 2, "slice": [0, 2]}, {"key": "actions", "dims": 3, "slice": [2, 5]}]
    values["action"]["components"], values["source"]["uri"] = cut, None
    known.write_text(yaml.safe_dump(values))
    assert line.replace("for this recording:", "with these keys and dims; is it this robot?") in told()
    values["cameras"][0]["key"] = "obs/wrist"
    known.write_text(yaml.safe_dump(values))
    assert "The registry" not in told()


# -- bad input


def test_what_is_no_recording_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("no robot")
    with pytest.raises(SourceError, match="not a recording of a known format — expected RLDS"):
        infer(str(tmp_path), "mine")
    with pytest.raises(SourceError, match="does not exist"):
        infer(str(tmp_path / "nowhere"), "mine")
    for name in ("take/images/0.png", "take/images/1.png", "take/actions.csv"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("x")
    with pytest.raises(SourceError, match=r"\(2 \.png, 1 \.csv\) can be packed into HDF5"):
        infer(str(tmp_path), "mine")


def test_the_script_that_packs_pictures_and_tables_makes_episodes(tmp_path: Path) -> None:
    seen = np.random.default_rng(0).integers(0, 256, (2, 5, 24, 32, 3), np.uint8)
    for take in range(2):
        (folder := tmp_path / f"recordings/take_{take}" / "images").mkdir(parents=True)
        for i, picture in enumerate(seen[take]):
            cv2.imwrite(str(folder / f"{i:06d}.png"), picture[..., ::-1])
        rows = [f"{i / 5},{i},{take}\n" for i in range(5)]
        (folder.parent / "actions.csv").write_text("t,x,y\n" + "".join(rows))
    page = (ROOT / "docs/adding-a-robot.md").read_text()
    script = re.search(r"```python\n(# pack\.py.*?)```", page, re.DOTALL)
    assert script
    subprocess.run([sys.executable, "-c", script[1]], cwd=tmp_path, check=True)
    path = tmp_path / "arm.hdf5"
    source = open_source("hdf5")
    assert source.inspect(str(path)).lengths == (5, 5)
    values = inferred(path)
    assert values["frequency_hz"] == 5 and values["source"]["layout"] == {"timestamps": "time"}
    clip = first_clip(path, values)
    np.testing.assert_array_equal(clip.frames_at(next(iter(clip.frame_indices)), np.arange(5)), seen[0])
    np.testing.assert_array_equal(clip.actions, [[i, 0] for i in range(5)])
    with pytest.raises(UsageError, match="not an id"):
        infer(str(tmp_path), "a..b")


def test_arrays_of_another_length_are_no_action(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "run.hdf5", "w") as file:
        file["image"], file["action"] = pictures(), numbers(3 * T, 4)
    with pytest.raises(SourceError, match=r"image of 12 rows.*action \(36 rows\)"):
        infer(str(tmp_path / "run.hdf5"), "mine")


def test_grey_cameras_are_taken_with_a_question_where_there_is_no_colour() -> None:
    grey = KeyInfo("observation/image", "camera", (64, 64, 1), "uint8")
    found = Inspection("rlds", "d", 1, (grey, KeyInfo("action", "vector", (3,), "float32")))
    values = parse_yaml(from_inspection(found, "mine"), "d")
    assert "grey" in questions(values)["provenance.cameras"]


@pytest.mark.parametrize(
    ("hz", "lengths", "rate"),
    [
        (30, (300, 400, 500), 2),
        (30, (90, 96, 120), 7.5),
        (10, (12, 20, 20), 10),
        (50, (1000,), 2),
        (30, (), 2),
    ],
)
def test_short_episodes_get_a_rate_at_which_a_model_sees_enough_of_them(hz, lengths, rate) -> None:
    keys = KeyInfo("image", "camera", (64, 64, 3), "uint8"), KeyInfo("action", "vector", (3,), "float32")
    found = Inspection("hdf5", "d", max(len(lengths), 1), keys, lengths=lengths, hz=hz)
    values = parse_yaml(from_inspection(found, "mine"), "d")
    assert values["target_hz"] == rate
    assert ("target_hz" in values["provenance"]) == (rate != 2)


# -- inspections of any content


HOSTILE = [
    "action", "a: b", "'", '"', "x\n---\ny", "#", "- ", "{a}", "[", "&x", "*x", "!!int 3", "null", "1e3",
    "TODO", "~", "é/状态", "\ufeff", "action/" + "long" * 3000, "%", "@",
    "yes", "action/pos", "obs/image", "/cmd_vel.linear", "observation/state", "/cam/image/compressed",
]  # fmt: skip
PRINTED = st.characters(exclude_categories=("Cc", "Cs", "Zl", "Zp"))
NASTY = st.one_of(st.sampled_from(HOSTILE), st.text(PRINTED, max_size=30))
RATES = st.one_of(st.none(), st.floats())
KEYS = st.builds(
    KeyInfo,
    key=NASTY,
    kind=st.sampled_from(["camera", "vector", "text", "other"]),
    shape=st.lists(st.integers(-1, 5000), max_size=4).map(tuple)
    | st.sampled_from([(64, 64, 3), (64, 64, 1), (7,), ()]),
    dtype=st.sampled_from(["float32", "float64", "int64", "bool", "uint8", ""]),
    hz=RATES,
    names=st.none() | st.lists(NASTY, max_size=8).map(tuple),
    codec=st.sampled_from([None, "raw", "jpeg"]),
    count=st.none() | st.integers(0, 100),
    jitter_ms=RATES,
    topic=st.none()
    | st.builds(TopicInfo, NASTY, NASTY, gap_ms=RATES, delay_ms=RATES, goes_back=st.booleans()),
    constant=st.booleans(),
)
FACTS = ["dataset", "simulator", "controller", "layout", "instruction", "timestamps", "rate", "tasks"]


@pytest.mark.slow
@given(
    found=st.builds(
        Inspection,
        format=st.sampled_from(["rlds", "hdf5", "rosbag", "lerobot"]),
        uri=NASTY,
        episodes=st.integers(0, 10),
        keys=st.lists(KEYS, max_size=8).map(tuple),
        hz=RATES,
        robot=st.none() | NASTY,
        facts=st.dictionaries(st.sampled_from([*FACTS, "episode keys"]), NASTY, max_size=4),
    )
)
def test_whatever_is_inspected_gives_a_yaml_with_questions_alone_or_one_line(found: Inspection) -> None:
    try:
        text = from_inspection(found, "mine")
    except HMAError as fault:
        assert "\n" not in str(fault)
        return
    values = parse_yaml(text, "inferred")
    assert [problem for problem in problems(values) if "still TODO" not in problem] == []
    assert {part["key"] for part in values["action"]["components"]} <= {key.key for key in found.keys}
    assert text.encode("utf-8")
