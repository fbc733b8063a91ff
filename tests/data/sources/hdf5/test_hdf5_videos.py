"""HDF5 whose images are in video files beside it, as in DROID's raw recordings."""

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.episodes.align import to_clip
from hma_data.errors import EpisodeError
from hma_data.registry.components import Camera, Hdf5Layout
from hma_data.registry.embodiment import Embodiment, find
from hma_data.shards.reader import ShardSet
from hma_data.sources.base import open_source
from hma_data.sources.detect import detect
from hma_data.sources.hdf5.videos import video_path
from tests.conftest import BlockTokenizer
from tests.data.hdf5_files import embodiment
from tests.data.inferring import answered, first_clip, inferred, keys
from tests.data.videos import encode, number_of
from tests.hostile import Edit, Row, check_refused, cut, linked_away, of, values, whole

T = 12
SERIALS = {"wrist": "11", "ext1": "22", "ext2": "33"}
FIRST = {"wrist": 0, "ext1": 20, "ext2": 40}  # the number that a camera's first frame shows
HDF5 = open_source("hdf5")


def droid(root: Path, name: str, frames: int = T, **record: Any) -> Path:
    """Write an episode as DROID's trajectory_writer.py, schema.py and svo2mp4.py do; return its folder."""
    folder = root / "success" / "2023-07-07" / name
    folder.mkdir(parents=True)
    with h5py.File(folder / "trajectory.h5", "w") as file:
        file.attrs["current_task"], file.attrs["success"] = "Move the mug", True
        for place, width in {
            "action/cartesian_position": 6, "action/gripper_position": 0, "action/joint_velocity": 7,
            "observation/robot_state/cartesian_position": 6, "observation/robot_state/gripper_position": 0,
            "observation/robot_state/joint_positions": 7,
        }.items():  # fmt: skip
            shape = (T, width) if width else (T,)
            data = np.arange(np.prod(shape), dtype=float).reshape(shape) / 100
            file.create_dataset(place, data=data, maxshape=(None, *shape[1:]), chunks=(1, *shape[1:]))
        file["observation/timestamp/skip_action"] = np.arange(T) < 2
        for serial in SERIALS.values():
            file[f"observation/camera_type/{serial}"] = np.full(T, 0 if serial == "11" else 1)
    with h5py.File(folder / "trajectory_im128.h5", "w") as file:
        file["observation/image"] = np.zeros((T, 2, 2, 3), np.uint8)
    for camera, serial in SERIALS.items():
        numbers = range(FIRST[camera], FIRST[camera] + frames)
        encode(folder / "recordings" / "MP4" / f"{serial}.mp4", numbers, fps=60)
        encode(folder / "recordings" / "MP4" / f"{serial}-stereo.mp4", [0], fps=60)
    facts = {f"{camera}_cam_serial": serial for camera, serial in SERIALS.items()}
    facts |= {"wrist_mp4_path": f"success/2023-07-07/{name}/recordings/MP4/11.mp4", "scene_id": 3}
    (folder / f"metadata_LAB+ab12+{name}.json").write_text(json.dumps(facts | record))
    return folder


def frames(count: int) -> Edit:
    return lambda path: encode(path, range(count), fps=60)


@pytest.fixture
def robot() -> Embodiment:
    return find("droid_raw")


def test_each_row_has_the_frame_of_its_number_by_the_yaml_alone(robot, tmp_path: Path) -> None:
    droid(tmp_path, "Fri_Jul__7_09:42:23_2023")
    droid(tmp_path, "Fri_Jul__7_09:50:00_2023")
    assert detect(str(tmp_path)) == "hdf5"
    names = [ref.id for ref in HDF5.index(str(tmp_path), robot) if ref.id.endswith("/trajectory")]
    assert len(names) == 2
    episode = HDF5.read(str(tmp_path), names[0], robot)
    cameras = {"primary": "ext1", "exterior_2": "ext2", "wrist": "wrist"}
    for name, camera in cameras.items():
        shown = [number_of(frame) for frame in episode.streams[name].frames([0, 5, 11, 2])]
        assert shown == [FIRST[camera] + i for i in (0, 5, 11, 2)]
    assert (episode.instruction, episode.success) == ("Move the mug", True)
    clip = to_clip(episode, robot)
    assert len(clip) == T and clip.states.shape == (T, 14)
    np.testing.assert_allclose(clip.actions[3], [*np.arange(18, 24) / 100, 0.03], rtol=1e-6)


def test_the_shipped_yaml_converts_a_folder_of_episodes(robot, tmp_path: Path) -> None:
    for minute in range(3):
        droid(tmp_path / "raw", f"Fri_Jul__7_09:4{minute}:00_2023", frames=T - (minute == 1))
    summary = convert(
        robot, str(tmp_path / "raw"), BlockTokenizer(), tmp_path / "out", settings=Settings(val_fraction=0)
    )
    shards = ShardSet(tmp_path / "out")
    assert shards.episodes["rows"].to_pylist() == [T, T - 1, T] and not summary.reasons
    assert all(name.endswith("/trajectory") for name in shards.episodes["id"].to_pylist())


def test_another_video_is_another_recording(robot, tmp_path) -> None:
    folder = droid(tmp_path, "a")
    before = HDF5.index(str(tmp_path), robot)[0].fingerprint
    encode(folder / "recordings" / "MP4" / "22.mp4", range(5, 5 + T), fps=60)
    assert HDF5.index(str(tmp_path), robot)[0].fingerprint != before


@pytest.mark.parametrize("flat", [True, False])
def test_a_yaml_is_inferred_from_numbers_with_a_video_beside_them(tmp_path: Path, flat: bool) -> None:
    for take in (1, 10):  # the name of the first is part of the other's
        folder = tmp_path / "lab" if flat else tmp_path / "lab" / f"run_{take}"
        folder.mkdir(parents=True, exist_ok=True)
        with h5py.File(folder / (f"run_{take}.h5" if flat else "numbers.h5"), "w") as file:
            file["actions"] = np.random.default_rng(take).normal(size=(T, 3))
        encode(folder / (f"run_{take}_front.mp4" if flat else "front.mp4"), range(take, take + T), fps=60)
    values = inferred(tmp_path / "lab")
    key = "{file}_front.mp4" if flat else "front.mp4"
    assert values["cameras"] == [{"name": "front", "key": key, "size": values["cameras"][0]["size"]}]
    arm = Embodiment.from_values(answered(values), "inferred")
    for name in HDF5.episode_ids(str(tmp_path / "lab")):
        first = HDF5.read(str(tmp_path / "lab"), name, arm).streams["front"].frames([0])[0]
        assert number_of(first) == (10 if "10" in name else 1)


@pytest.mark.parametrize("counts", [[T - 1], [T, T - 1], [T - 1, T - 1]])
def test_a_video_that_lacks_its_last_frame_hides_no_action(tmp_path: Path, counts: list[int]) -> None:
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file["action"], file["qpos"] = np.ones((T, 3)), np.ones((T, 2))
    for number, count in enumerate(counts):
        encode(tmp_path / f"cam{number}.mp4", range(count), fps=60)
    values = inferred(tmp_path)
    assert (keys(values, "action"), keys(values, "state")) == (["action"], ["qpos"])
    assert keys(values, "cameras") == [f"cam{number}.mp4" for number in range(len(counts))]
    assert values["source"]["layout"] == {"frames_missing": 1}
    assert len(first_clip(tmp_path, values)) == T - 1


def test_a_folder_of_many_episodes_is_listed_once_for_a_pattern(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "films").mkdir()
    for take in range(3):
        with h5py.File(tmp_path / f"run_{take}.h5", "w") as file:
            file["actions"] = np.zeros((T, 3))
        encode(tmp_path / f"films/run_{take}_{take}99_front.mp4", range(take, take + T), fps=60)
    ids = HDF5.episode_ids(str(tmp_path))
    listed: list[Path] = []

    def counted(ask: Any) -> Any:
        return lambda path: listed.append(Path(path)) or ask(path)

    for name in ("listdir", "scandir"):
        monkeypatch.setattr(os, name, counted(getattr(os, name)))
    arm = embodiment(cameras=[{"name": "front", "key": "films/{file}_*_front.mp4"}])
    for take, name in enumerate(ids):
        first = HDF5.read(str(tmp_path), name, arm).streams["front"].frames([0])[0]
        assert number_of(first) == take
    assert listed.count(tmp_path / "films") == 1
    shutil.copy(tmp_path / "films/run_0_099_front.mp4", tmp_path / "films/run_0_1_front.mp4")
    with pytest.raises(EpisodeError, match=r"2 files match films/run_0_\*_front\.mp4"):
        HDF5.read(str(tmp_path), "run_0", arm)


@pytest.mark.parametrize("key", ["*/{file}_front.mp4", "gone/{file}_*.mp4", "f?lms/{file}.mp4"])
def test_a_missing_video_is_told_without_listing_thousands_of_files(tmp_path, monkeypatch, key) -> None:
    monkeypatch.setattr("hma_data.sources.hdf5.videos.MAX_LISTED", 20)
    seen: list[Path] = []
    walk = Path.rglob

    def counted(folder: Path, pattern: str) -> Iterator[Path]:
        for path in walk(folder, pattern):
            seen.append(path)
            yield path

    monkeypatch.setattr(Path, "rglob", counted)
    (tmp_path / "films").mkdir()
    for i in range(50):
        (tmp_path / f"films/other_{i}.mp4").touch()
    with pytest.raises(EpisodeError, match=r"there is no .* — next to it are films/other_\d+\.mp4, "):
        video_path(tmp_path / "run_0.h5", Camera(name="front", key=key), Hdf5Layout())
    assert len(seen) == 20
    (tmp_path / "films/run_0.mp4").touch()
    found = video_path(tmp_path / "run_0.h5", Camera(name="front", key="f?lms/{file}*.mp4"), Hdf5Layout())
    assert found == tmp_path / "films/run_0.mp4"


MP4, FACTS = "**/MP4/22.mp4", "**/metadata_*.json"
HOSTILE: dict[str, Row] = {
    "no video": (of(MP4, Path.unlink), r"is no recordings/MP4/22\.mp4 — next to it are .*33\.mp4"),
    "no metadata": (of(FACTS, Path.unlink), r"there is no metadata_\*\.json"),
    "two metadata": (of(FACTS, lambda path: shutil.copy(path, f"{path}_2.json")), "2 files match metadata_"),
    "no serial": (of(FACTS, whole('{"wrist_cam_serial": "1"}')), "has no 'ext1_cam_serial' for .* — it has"),
    "metadata cut short": (of(FACTS, cut(1)), "cannot be read as JSON"),
    "a serial outside": (of(FACTS, values(ext1_cam_serial="../../../../other")), "leads out of its folder"),
    "a link": (of(MP4, linked_away), "is a link to a file outside"),
    "zeros": (of(MP4, whole(bytes(900))), r"22\.mp4: cannot be decoded as video"),
    "few frames": (of(MP4, frames(T - 2)), rf"actions {T}, .*serial.*\.mp4 {T - 2} — .*frames_missing"),
    "many frames": (of(MP4, frames(T + 1)), rf"actions {T}, .*serial.*\.mp4 {T + 1} — .*last_observation"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_recording_is_one_line(case: str, robot: Embodiment, tmp_path: Path) -> None:
    droid(tmp_path / "set", "a")
    check_refused(HOSTILE[case], tmp_path / "set", robot, tmp_path / "out", one=False)


def test_inspect_names_the_videos_as_a_key_would(tmp_path) -> None:
    droid(tmp_path, "a")
    assert "recordings/MP4/22.mp4" in HDF5.inspect(str(tmp_path)).facts["videos beside it"]
