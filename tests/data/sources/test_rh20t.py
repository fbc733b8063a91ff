"""RH20T's scenes: every number and frame at its own time, and each defect named."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from hma_data.conversion.plan import read_clip
from hma_data.episodes.align import to_clip
from hma_data.errors import EpisodeError, RegistryError, SourceError
from hma_data.inspection.infer import infer
from hma_data.registry.embodiment import find
from hma_data.sources.base import open_source
from hma_data.sources.detect import detect
from tests.data.rh20t_files import CAMERAS, LATE_MS, pose, robot, stamps, tables, write_scene
from tests.data.videos import encode
from tests.hostile import Edit, Row, check_refused, cut, linked_away, of, whole

SCENE = "task_0001_user_0001_scene_0001_cfg_0001"


@pytest.fixture
def recording(tmp_path):
    folder = tmp_path / "RH20T_cfg1"
    folder.mkdir()
    write_scene(folder)
    return folder


def read(folder, name=SCENE, embodiment=None):
    return open_source("rh20t").read(folder, name, embodiment or robot())


def test_numbers_and_frames_lie_at_their_times(recording):
    episode = read(recording)
    assert not episode.rate_stamped and episode.success is True
    for camera, name in enumerate(("c0", "c1")):
        assert np.array_equal(episode.streams[name].timestamps, np.array(stamps(camera, 12)) / 1e3)
    tcp, width = episode.actions
    assert np.array_equal(tcp.timestamps, np.array(stamps(0, 12))[:-1] / 1e3)
    assert np.array_equal(tcp.values, np.stack([pose(0, i + 1) for i in range(11)]).astype(np.float32))
    assert width.values[:, 0].tolist() == [100 - i for i in range(1, 12)]
    clip = to_clip(episode, robot())
    assert len(clip) == 12 and clip.skew_ms["c1"].max() == pytest.approx(LATE_MS, abs=1)
    assert np.array_equal(clip.states[:, 7:], np.arange(14) + np.arange(12)[:, None])
    # the last frame has no next sample: the last command stays in force
    assert clip.actions[:, 0].tolist() == [*range(1, 12), 11]


def test_the_task_is_found_in_a_folder_above(recording):
    assert read(recording).instruction == ""
    told = {"task_0001": {"task_description_english": "press it", "task_description_chinese": "按"}}
    (recording.parent / "task_description.json").write_text(json.dumps(told))
    assert read(recording).instruction == "press it"
    source = {"format": "rh20t", "instruction": "task_description_chinese"}
    assert read(recording, embodiment=robot(source=source)).instruction == "按"


@pytest.mark.parametrize(("rating", "success"), [(0, False), (1, False), (2, True), (9, True)])
def test_a_rating_tells_success(rating, success, tmp_path):
    write_scene(tmp_path, rating=rating)
    assert read(tmp_path).success is success


def test_scenes_are_found_in_nested_folders_and_films_of_people_are_not(recording):
    source = open_source("rh20t")
    assert source.episode_ids(recording) == [SCENE]
    write_scene(recording, 2)
    shutil.copytree(recording / SCENE, recording / f"{SCENE}_human")
    other = recording.parent / "RH20T_cfg2"
    shutil.copytree(recording, other)
    second = SCENE.replace("0001", "0002", 1)
    assert source.episode_ids(recording) == [SCENE, second]
    assert source.episode_ids(recording.parent) == [
        f"RH20T_cfg{n}/{scene}" for n in (1, 2) for scene in (SCENE, second)
    ]
    assert open_source("rh20t").episode_ids(recording / SCENE) == [SCENE]
    assert {detect(path) for path in (recording, recording.parent, recording / SCENE)} == {"rh20t"}
    shutil.rmtree(recording / SCENE)
    shutil.rmtree(recording / second)
    with pytest.raises(SourceError, match="videos of people"):
        open_source("rh20t").index(recording)


def test_a_film_with_fewer_frames_than_times_is_counted_and_one_with_more_refused(tmp_path):
    write_scene(tmp_path, films=10)
    episode = read(tmp_path)
    assert len(episode.streams["c0"].timestamps) == 10 and episode.metadata["flags"] == {"frames_missing": 4}
    assert len(to_clip(episode, robot())) == 10
    write_scene(tmp_path, 2, films=13)
    with pytest.raises(EpisodeError, match="has 13 frames, .* only 12 times"):
        read(tmp_path, SCENE.replace("0001", "0002", 1))


def table(name: str, change: Callable[[Any], object]) -> Edit:
    def edit(path: Path) -> None:
        content = tables(12)[name]
        change(content)
        np.save(path, content)

    return of(f"{SCENE}/transformed/{name}.npy", edit)


def tcp(row: int, **values: Any) -> Edit:
    return table("tcp_base", lambda content: content[CAMERAS[0]][row].update(values))


FAR = dict.fromkeys(stamps(0, 12), np.zeros(9000))
JOINT, TCP = f"{SCENE}/transformed/joint.npy", f"{SCENE}/transformed/tcp_base.npy"
FILM, TIMES = (f"{SCENE}/cam_{CAMERAS[0]}/{name}" for name in ("color.mp4", "timestamps.npy"))
FEW = r"no timestamps in whole milliseconds"
ONE: dict[str, Row] = {
    "no joints": (of(JOINT, Path.unlink), r"has no transformed/joint\.npy — transformed has"),
    "no camera": (table("tcp_base", lambda t: t.pop(CAMERAS[0])), "no samples of camera .* — it has"),
    "no pose": (table("tcp_base", lambda t: t[CAMERAS[0]][3].pop("tcp")), "no 'tcp' — it has timestamp"),
    "another width": (tcp(3, tcp=np.zeros(6)), "changes its number of values"),
    "lists for numbers": (tcp(3, tcp=[[1], [2]]), "holds list values, not numbers"),
    "words for times": (tcp(3, timestamp="x"), FEW),
    "a time of 400 digits": (tcp(3, timestamp=10**400), FEW),
    "no samples": (table("tcp_base", lambda t: t.update({CAMERAS[0]: []})), FEW),
    "many values": (table("joint", lambda t: t[CAMERAS[0]].update(FAR)), "more than"),
    "a spoilt table": (of(TCP, whole("spoilt")), r"tcp_base\.npy: "),
    "no film": (of(FILM, Path.unlink), rf"has no cam_{CAMERAS[0]}/color\.mp4"),
    "a film that is a link": (of(FILM, linked_away), "outside its folder"),
    "a film cut short": (of(FILM, cut(900)), r"color\.mp4: .* cut off"),
    "no times": (of(TIMES, Path.unlink), "there is no such file"),
    "times of depth": (of(TIMES, lambda path: np.save(path, {"depth": [1]})), "color holds NoneType"),
    "metadata cut short": (of(f"{SCENE}/metadata.json", cut(1)), "is not valid JSON.* copy it again"),
}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    for task in (1, 2):
        write_scene(folder, task)
    return folder


@pytest.mark.parametrize("case", ONE)
def test_a_hostile_scene_goes_to_quarantine_and_the_other_becomes_shards(case, scenes, tmp_path):
    folder = shutil.copytree(scenes, tmp_path / "set")
    check_refused(ONE[case], folder, robot(), tmp_path / "out", one=True)


def test_every_file_that_is_used_changes_the_fingerprint(recording):
    def told():
        return open_source("rh20t").index(recording, robot())[0].fingerprint

    seen = {told()}
    for place in ("transformed/joint.npy", f"cam_{CAMERAS[0]}/timestamps.npy", "metadata.json"):
        path = recording / SCENE / place
        path.write_bytes(path.read_bytes() + b" ")
        seen.add(told())
    assert len(seen) == 4 and told() == told()
    (recording / SCENE / "audio").mkdir()
    assert told() in seen


def test_inspection_measures_the_cameras_and_lists_the_tables(recording):
    found = open_source("rh20t").inspect(recording)
    keys = {key.key: key for key in found.keys}
    assert set(keys) == {
        *(f"cam_{serial}" for serial in CAMERAS), "tcp_base/tcp", "tcp_base/robot_ft",
        "gripper/gripper_command", "gripper/gripper_info", "joint",
    }  # fmt: skip
    assert found.hz == pytest.approx(10, abs=0.15) and found.frames == 12
    assert keys["tcp_base/tcp"].shape == (7,) and keys[f"cam_{CAMERAS[0]}"].codec == "h264"
    assert keys[f"cam_{CAMERAS[0]}"].skew_ms is not None
    (recording / SCENE / "transformed/joint.npy").write_bytes(b"")
    assert any("joint" in str(finding) for finding in open_source("rh20t").inspect(recording).findings)


def test_an_inferred_robot_takes_the_next_pose_as_its_command(recording):
    values = yaml.safe_load(infer(recording, "mine"))
    keys = [part["key"] for part in values["action"]["components"]]
    assert sorted(keys) == ["gripper/gripper_info/next", "tcp_base/tcp/next"]
    assert "action_shift" not in values.get("sync", {}) and values["frequency_hz"] == 10


def test_a_shift_in_steps_is_refused():
    with pytest.raises(RegistryError, match="keys may end in /next"):
        robot(sync={"action_shift": 1})


@pytest.mark.parametrize("number", range(1, 8))
def test_the_registry_reads_scenes_of_its_cameras(number, tmp_path):
    own = find(f"rh20t_cfg{number}")
    scene = write_scene(tmp_path)
    serials = [camera.key.removeprefix("cam_") for camera in own.cameras]
    first = shutil.move(scene / f"cam_{CAMERAS[0]}", tmp_path / "camera")
    for serial in serials:
        shutil.copytree(first, scene / f"cam_{serial}", dirs_exist_ok=True)
    content = {name: dict.fromkeys(serials, table[CAMERAS[0]]) for name, table in tables(12).items()}
    for name, table in content.items():
        np.save(scene / "transformed" / f"{name}.npy", table)
    clip = to_clip(read(tmp_path, embodiment=own), own)
    assert clip.actions.shape == (12, 8) and clip.states.shape == (12, 8) and len(clip.frame_indices) == 6


def test_a_camera_that_is_not_stored_shortens_no_episode(recording):
    place = recording / SCENE / f"cam_{CAMERAS[1]}"
    np.save(place / "timestamps.npy", {"color": stamps(1, 12)[:4]})
    encode(place / "color.mp4", range(4))
    source = open_source("rh20t")
    assert len(read_clip(source, str(recording), SCENE, robot(), ["c0"])) == 12
    assert len(read_clip(source, str(recording), SCENE, robot(), ["c0", "c1"])) < 6
    other = read_clip(source, str(recording), SCENE, robot(), ["c1"])  # on the frames of the primary one
    assert set(other.frame_indices) == {"c0", "c1"} and len(other) < 6
