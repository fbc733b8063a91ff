"""The registry as a whole: its index, which cannot be stale, and its exports."""

import os
from pathlib import Path
from typing import Any

import pytest

from hma_data.registry.catalog import entries
from hma_data.registry.embodiment import Embodiment, find
from hma_data.registry.export import component_names, lerobot_features, modality, packed_components

YAML = """id: {id}
kind: real
robot: Arm
frequency_hz: {hz}
action: {{space: eef_delta, components: [{{key: a, dims: 3}}]}}
cameras: [{{name: front, key: image}}]
source: {{format: rlds}}
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HMA_CACHE", str(tmp_path / "cache"))
    (tmp_path / "registry").mkdir()
    return tmp_path / "registry"


def put(folder: Path, name: str, id: str | None = None, hz: Any = 10) -> Path:
    path = folder / f"{name}.yaml"
    path.parent.mkdir(exist_ok=True)
    path.write_text(YAML.format(id=id or name, hz=hz))
    return path


def own(folder: Path) -> dict[str, Any]:
    return {
        entry.path.stem: entry.facts or [problem.fault for problem in entry.problems]
        for entry in entries()
        if folder in entry.path.parents
    }


def test_a_rewritten_file_is_seen_though_size_and_times_are_the_same(folder: Path) -> None:
    path = put(folder, "arm", hz=10)
    stamps = path.stat()
    assert own(folder)["arm"]["frequency_hz"] == 10
    put(folder, "arm", hz=20)
    os.utime(path, ns=(stamps.st_atime_ns, stamps.st_mtime_ns))
    assert path.stat().st_size == stamps.st_size
    assert own(folder)["arm"]["frequency_hz"] == 20


def test_a_warm_index_says_what_a_cold_one_says(folder: Path) -> None:
    put(folder, "good")
    put(folder, "bad", hz=-1)
    (folder / "broken.yaml").write_text("a: [")
    cold = own(folder)
    assert list((folder.parent / "cache").glob("registry-*.json"))
    assert own(folder) == cold
    assert (
        cold["good"]["id"] == "good" and "0 and 100000" in cold["bad"][0] and "not valid" in cold["broken"][0]
    )


@pytest.mark.parametrize("content", ["{", "", "\x00"])
def test_a_damaged_cache_is_only_slower(folder: Path, content: str) -> None:
    put(folder, "arm")
    before = own(folder)
    (kept,) = (folder.parent / "cache").glob("registry-*.json")
    kept.write_text(content)
    assert own(folder) == before


def test_a_cache_that_cannot_be_written_is_only_slower(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    put(folder, "arm")
    monkeypatch.setenv("HMA_CACHE", "/dev/null/cache")
    assert own(folder)["arm"]["id"] == "arm"


def test_two_files_with_one_id_are_named(folder: Path) -> None:
    put(folder, "arm")
    put(folder / "more", "arm")
    put(folder, "other", id="arm")
    found = [entry for entry in entries() if entry.name == "arm"]
    assert sum(entry.facts is not None for entry in found) == 1
    faults = [problem.fault for entry in found for problem in entry.problems]
    assert len(faults) == 2 and all(fault.startswith("is also the id of") for fault in faults)


def test_a_file_that_its_id_does_not_find_is_named(folder: Path) -> None:
    put(folder, "arm", id="leg")
    assert "does not find its file arm.yaml" in own(folder)["arm"][0]


def test_the_first_folder_wins_over_later_ones(folder, tmp_path, monkeypatch) -> None:
    later = tmp_path / "later"
    later.mkdir()
    put(folder, "arm", hz=10)
    put(later, "arm", hz=20)
    monkeypatch.setenv("HMA_REGISTRY", str(later))
    assert not [problem for entry in entries() for problem in entry.problems]
    assert find("arm").frequency_hz == 10


def test_what_is_no_file_is_refused_and_the_rest_listed(folder: Path) -> None:
    put(folder, "arm")
    os.mkfifo(folder / "pipe.yaml")
    (folder / "huge.yaml").write_bytes(b"#" * 10_000_000)
    (folder / "gone.yaml").symlink_to("nowhere")
    found = own(folder)
    assert found["arm"]["id"] == "arm"
    assert [found[name][0] for name in ("pipe", "huge", "gone")] == [
        "is not a file",
        "is larger than 1,000,000 bytes",
        "no such file",
    ]


def robot(format: str, **changes: Any) -> Embodiment:
    part = {"key": "action", "unit": "rad"}
    values: dict[str, Any] = {
        "id": "arm",
        "kind": "real",
        "frequency_hz": 10,
        "action": {
            "space": "joint_position",
            "components": [
                {**part, "slice": [2, 5], "dims": 3, "names": ["a", "b", "c"]},
                {"key": "action", "slice": [6, 7], "dims": 1, "range": [0, 1], "gripper": "open_is_high"},
            ],
        },
        "state": {
            "components": [
                {"key": "pose", "dims": 4, "representation": "quaternion_xyzw"},
                {"key": "x.y", "dims": 2},
            ]
        },
        "cameras": [
            {"name": "front", "key": "images.front", "size": [480, 640]},
            {"name": "w", "key": "images.w"},
        ],
        "source": {"format": format},
    }
    return Embodiment.from_values(values | changes, "arm.yaml")


def test_modality_of_a_lerobot_recording_speaks_of_its_own_features() -> None:
    said = modality(robot("lerobot"))
    joints, gripper = said["action"].values()
    assert (joints["original_key"], joints["start"], joints["end"]) == ("action", 2, 5)
    assert (gripper["start"], gripper["end"], gripper["range"], gripper["absolute"]) == (6, 7, [0, 1], True)
    assert said["video"] == {"front": {"original_key": "images.front"}, "w": {"original_key": "images.w"}}
    assert said["state"]["rotation"]["rotation_type"] == "quaternion"
    assert said["annotation"] == {"human.task_description": {"original_key": "task_index"}}


def test_modality_of_another_recording_speaks_of_what_a_conversion_makes() -> None:
    said = modality(robot("hdf5"))
    places = [(place["start"], place["end"]) for place in said["action"].values()]
    assert places == [(0, 3), (3, 4)]
    assert {place["original_key"] for place in said["state"].values()} == {"observation.state"}
    assert said["video"]["front"] == {"original_key": "observation.images.front"}
    assert "annotation" not in said


@pytest.mark.parametrize(
    ("space", "gripper", "absolute"),
    [
        ("joint_position", "open_is_high", [True, True]),
        ("eef_delta", "open_is_low", [False, True]),
        ("joint_delta", "closing_is_high", [False, False]),
    ],
)
def test_deltas_are_not_absolute(space: str, gripper: str, absolute: list[bool]) -> None:
    parts = [{"key": "a", "dims": 3}, {"key": "g", "dims": 1, "gripper": gripper}]
    said = modality(robot("hdf5", action={"space": space, "components": parts}))
    assert [place["absolute"] for place in said["action"].values()] == absolute


def test_component_names_are_never_the_same() -> None:
    parts = [{"key": "a/x", "dims": 1}, {"key": "b/x", "dims": 1}, {"key": "c", "dims": 2}]
    vector = robot("hdf5", action={"space": "mixed", "components": parts}).action
    assert component_names(vector) == ["x_1", "x_2", "c"]


def test_packed_components_keep_what_the_values_mean() -> None:
    pose = {"key": "pose", "dims": 4, "representation": "quaternion_xyzw", "sign": -1.0, "unit": "rad"}
    (packed,) = packed_components({"components": [pose]}, "state")
    assert packed == {
        "key": "state", "dims": 4, "slice": [0, 4], "representation": "quaternion_xyzw", "unit": "rad"
    }  # fmt: skip


def test_lerobot_features_have_the_widths_names_and_picture_sizes() -> None:
    features = lerobot_features(robot("lerobot"))
    assert features["action"] == {"dtype": "float32", "shape": (4,), "names": ["a", "b", "c", "action.0"]}
    assert features["observation.state"]["shape"] == (6,)
    assert features["images.front"]["shape"] == (480, 640, 3) and features["images.w"]["shape"] == (
        256,
        256,
        3,
    )
    assert features["images.front"]["names"] == ["height", "width", "channels"]
    assert list(lerobot_features(robot("rlds"))) == [
        "action",
        "observation.state",
        "observation.images.front",
        "observation.images.w",
    ]


@pytest.mark.slow
def test_lerobot_makes_a_dataset_of_the_features(tmp_path: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    made = LeRobotDataset.create(
        "here/arm", fps=10, features=lerobot_features(robot("hdf5")), root=tmp_path / "set", use_videos=True
    )
    assert made.meta.features["action"]["shape"] == (4,)
