"""hma doctor: each defect is found by its check, and a sound recording gives none."""

import json
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from skimage import data as skimage_data
from typer.testing import CliRunner

from hma_data.conversion.job import convert
from hma_data.episodes.episode import Episode
from hma_data.inspection.inspect import Finding, examine, inspect_recording
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.hdf5.source import Hdf5Source
from hma_model.cli import app
from tests.conftest import ARM_YAML
from tests.hostile import flip

LENGTHS = (40, 45, 50)


def sound(file: h5py.File) -> None:
    draw = np.random.default_rng(0)
    for i, length in enumerate(LENGTHS):
        demo = file.create_group(f"data/demo_{i}")
        demo["actions"] = draw.normal(size=(length, 3)).astype(np.float32)
        for camera in ("image", "side"):
            demo[f"obs/{camera}"] = draw.integers(0, 256, (length, 16, 16, 3), np.uint8)


def set_all(key: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[h5py.File], None]:
    def apply(file: h5py.File) -> None:
        for demo in file["data"].values():
            values = change(demo[key][:])
            del demo[key]
            demo[key] = values

    return apply


def examined(tmp_path: Path, damage: Callable[[h5py.File], None], yaml: str = ARM_YAML) -> list[Finding]:
    with h5py.File(tmp_path / "toy.hdf5", "w") as file:
        sound(file)
        damage(file)
    (tmp_path / "toy_arm.yaml").write_text(yaml)
    return examine(str(tmp_path / "toy.hdf5"), str(tmp_path / "toy_arm.yaml"))


def still(pictures: np.ndarray) -> np.ndarray:
    return np.repeat(pictures[:1], len(pictures), axis=0)


def wild(actions: np.ndarray) -> np.ndarray:
    actions[:, 1] = 0.001 * actions[:, 1]
    actions[3, 1] = 1e4
    return np.concatenate([actions] * 40)[: len(actions)]


def test_a_sound_recording_has_no_finding(tmp_path: Path) -> None:
    assert examined(tmp_path, lambda file: None) == []


@pytest.mark.parametrize(
    ("damage", "check", "severity"),
    [
        (set_all("obs/image", still), "still", "warn"),
        (set_all("obs/image", np.zeros_like), "blank", "warn"),
        (set_all("obs/side", lambda pictures: pictures[:-1]), "usable", "error"),
        (set_all("actions", lambda actions: actions * [1, 0, 1]), "constant", "warn"),
        (set_all("actions", lambda actions: np.full_like(actions, np.nan)), "usable", "error"),
    ],
)
def test_a_defect_is_found_by_its_check(tmp_path, damage, check, severity) -> None:
    found = examined(tmp_path, damage)
    assert (check, severity) in {(finding.check, finding.severity) for finding in found}


@pytest.mark.parametrize(
    ("old", "new", "check"),
    [
        ("dims: 3", "dims: 3, range: [-0.1, 0.1]", "range"),
        ("key: obs/image", "key: obs/image, size: [480, 640]", "size"),
        ("target_hz: 5", "target_hz: 1", "length"),
    ],
)
def test_what_the_yaml_states_is_held_against_the_episodes(tmp_path, old, new, check) -> None:
    assert check in {one.check for one in examined(tmp_path, lambda file: None, ARM_YAML.replace(old, new))}


def test_without_a_yaml_black_pictures_are_a_warning_only_where_no_other_camera_is_left(tmp_path) -> None:
    path = tmp_path / "toy.hdf5"
    with h5py.File(path, "w") as file:
        sound(file)
        set_all("obs/image", np.zeros_like)(file)
    assert {one.severity for one in examine(str(path)) if one.check == "blank"} == {"info"}
    with h5py.File(path, "a") as file:
        set_all("obs/side", np.zeros_like)(file)
    assert {one.severity for one in examine(str(path)) if one.check == "blank"} == {"warn"}


def test_degrees_stated_as_radians_are_noticed(tmp_path: Path) -> None:
    in_degrees = set_all("actions", lambda actions: actions * 90)
    found = examined(tmp_path, in_degrees, ARM_YAML.replace("dims: 3", "dims: 3, unit: rad"))
    assert "are these degrees?" in {finding.remedy for finding in found}


def test_actions_that_are_the_state_of_the_same_frame_are_noticed(tmp_path: Path) -> None:
    def copy(file: h5py.File) -> None:
        for demo in file["data"].values():
            demo["obs/joints"] = demo["actions"][:][:, ::-1]

    stated = ARM_YAML + "state: {components: [{key: obs/joints, dims: 3}]}\n"
    (found,) = examined(tmp_path, copy, stated)
    assert found.check == "action" and found.severity == "warn" and "throughout: a, b, c" in found.message
    (tmp_path / "toy_arm.yaml").write_text(stated + "sync: {action_shift: 1}\n")
    assert not examine(str(tmp_path / "toy.hdf5"), str(tmp_path / "toy_arm.yaml"))


def test_a_yaml_that_says_bgr_of_pictures_in_order_is_noticed(tmp_path: Path) -> None:
    photo = skimage_data.chelsea()[:64, :64]  # it was a JPEG once, and its colours still show it

    def photographs(file: h5py.File) -> None:
        for demo in file["data"].values():
            del demo["obs/image"]
            demo["obs/image"] = np.stack([np.roll(photo, i, axis=1) for i in range(len(demo["actions"]))])

    found = examined(tmp_path, photographs, ARM_YAML.replace("key: obs/image", "key: obs/image, color: bgr"))
    assert [(one.check, one.severity) for one in found] == [("colour", "warn")]


def test_a_camera_that_the_robot_does_not_use_is_left_alone(tmp_path: Path) -> None:
    def damage(file: h5py.File) -> None:
        for demo in file["data"].values():
            demo["obs/spare"] = np.zeros((len(demo["actions"]), 16, 16, 3), np.uint8)

    assert examined(tmp_path, damage) == []


@pytest.mark.parametrize(("limit", "code"), [("error", 0), ("warn", 1), ("never", 0)])
def test_the_exit_code_follows_fail_on(tmp_path: Path, limit: str, code: int) -> None:
    examined(tmp_path, set_all("actions", lambda actions: actions * [1, 0, 1]))
    done = CliRunner().invoke(app, ["doctor", str(tmp_path / "toy.hdf5"), "--fail-on", limit, "--json"])
    finding, unstated = json.loads(done.stdout)["findings"]
    assert (unstated["check"], unstated["message"]) == ("rate", "the recording states no rate")
    assert (done.exit_code, finding["check"], finding["numbers"]["dims"]) == (code, "constant", [1])


def test_the_worst_comes_first(tmp_path: Path) -> None:
    unknown = set_all("actions", lambda actions: np.full_like(actions, np.nan))
    yaml = ARM_YAML.replace("key: obs/image", "key: obs/image, size: [480, 640]")
    order = [finding.severity for finding in examined(tmp_path, unknown, yaml)]
    assert order == sorted(order, key=["error", "warn", "info"].index) and len(set(order)) > 1


def test_an_unreadable_recording_is_one_error(tmp_path: Path) -> None:
    (tmp_path / "no.hdf5").write_bytes(b"nothing")
    (finding,) = examine(str(tmp_path / "no.hdf5"))
    assert (finding.check, finding.severity) == ("readable", "error")


def test_a_shard_set_with_changed_bytes_is_an_error(tmp_path, toy_arm, toy_recording, block_tokenizer):
    convert(toy_arm, str(toy_recording), block_tokenizer, tmp_path / "shards")
    assert not [finding for finding in examine(str(tmp_path / "shards")) if finding.severity == "error"]
    shard = next((tmp_path / "shards" / "train").iterdir())
    flip(20)(shard)
    first = examine(str(tmp_path / "shards"))[0]
    assert first.check == "integrity"
    assert str(first).count(" — ") <= 1  # verify's line says what to do, and nothing else does


def test_episodes_that_are_refused_come_with_what_to_do(tmp_path: Path) -> None:
    yaml = ARM_YAML.replace("dims: 3, names: [a, b, c]", "dims: 2")
    (first, *_) = examined(tmp_path, lambda file: None, yaml)
    assert (first.check, first.severity) == ("usable", "error")
    assert "dims" in first.remedy or "slice" in first.remedy


def test_a_fault_of_the_reader_is_one_of_the_episode(tmp_path: Path, monkeypatch) -> None:
    def read(self: Hdf5Source, uri: str, name: str, robot: Embodiment) -> Episode:
        return {}[name]

    monkeypatch.setattr(Hdf5Source, "read", read)
    (first, *_) = examined(tmp_path, lambda file: None)
    assert first.check == "usable" and "3 of 3 sampled episodes" in first.message
    assert "stops its reader with KeyError: 'demo_0'" in first.message
    report = inspect_recording(tmp_path / "toy.hdf5", tmp_path / "toy_arm.yaml")
    assert any("stops its reader with KeyError" in one["message"] for one in report["findings"])


def test_a_recording_without_a_camera_is_no_robots(tmp_path: Path) -> None:
    examined(tmp_path, lambda file: [file[f"data/{name}"].pop("obs") for name in file["data"]])
    found = [one for one in examine(tmp_path / "toy.hdf5") if one.check == "robot"]
    assert [(one.severity, one.message) for one in found] == [("warn", "the recording has no colour camera")]
