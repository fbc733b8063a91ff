"""HDF5 recordings against h5py itself, in the layouts that are met, whole and damaged."""

import json
import os
import shutil
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import h5py
import numpy as np
import pytest

from hma_data.episodes.align import to_clip
from hma_data.errors import EpisodeError, SourceError
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import open_source
from hma_data.sources.detect import detect
from hma_data.sources.hdf5 import file as hdf5_file
from hma_data.sources.hdf5.file import OPEN_FILES
from tests.data.fresh import run_fresh
from tests.data.hdf5_files import H, T, W, embodiment, fill
from tests.data.hub_cache import as_snapshot


@pytest.fixture
def demos(tmp_path: Path) -> Path:
    path = tmp_path / "demos.hdf5"
    with h5py.File(path, "w") as file:
        for i in range(12):
            fill(file.create_group(f"data/demo_{i}"), T + i, i)
        arguments = {"env_name": "Lift", "env_kwargs": {"control_freq": 20, "robots": ["Panda"]}}
        file["data"].attrs["env_args"] = json.dumps(arguments)
    return path


def test_values_and_pictures_equal_h5py(demos: Path) -> None:
    episode = open_source("hdf5").read(str(demos), "demo_7", embodiment())
    with h5py.File(demos) as file:
        np.testing.assert_array_equal(
            episode.actions[0].values, file["data/demo_7/actions"][()].astype(np.float32)
        )
        stored = file["data/demo_7/obs/agentview_image"][()]
    stream = episode.streams["front"]
    np.testing.assert_array_equal(stream.frames(range(len(stored))), stored)
    np.testing.assert_array_equal(stream.frames([9, 2, 2, 15]), stored[[9, 2, 2, 15]])
    np.testing.assert_allclose(stream.timestamps, np.arange(16) / 20)


def test_a_folder_names_episodes_by_file(demos: Path, tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    with h5py.File(tmp_path / "b" / "run 2.h5", "w") as file:
        fill(file.create_group("data/demo_0"))
    source = open_source("hdf5")
    ids = [ref.id for ref in source.index(str(tmp_path))]
    assert ids[0] == "b/run_2/demo_0"
    assert ids[1:] == [f"demos/demo_{i}" for i in range(12)]
    for episode_id in ids:
        assert source.read(str(tmp_path), episode_id, embodiment()).id == episode_id


def test_libero_robocasa_and_robomind_say_what_was_asked(demos: Path) -> None:
    with h5py.File(demos, "a") as file:
        said = {"problem_name": "x", "language_instruction": '"pick up the bowl"'}
        file["data"].attrs["problem_info"] = json.dumps(said)
        file["data/demo_1"].attrs["language_instruction"] = "pick up the cup"
        file["data/demo_2"].attrs["ep_meta"] = json.dumps({"layout_id": 1, "lang": "open the drawer"})
        file["data/demo_3/language_raw"] = np.array([b"put the cup away"])
    read = open_source("hdf5").read
    found = [read(str(demos), f"demo_{i}", embodiment()).instruction for i in range(4)]
    assert found == ["pick up the bowl", "pick up the cup", "open the drawer", "put the cup away"]


def test_the_instruction_is_where_the_yaml_says(demos: Path) -> None:
    with h5py.File(demos, "a") as file:
        file["data/demo_0/goal"] = "stack"
        file["data/demo_2"].create_dataset("goal", shape=(0,), dtype="S8")
    arm = embodiment(source__instruction="goal")
    read = open_source("hdf5").read
    assert [read(str(demos), f"demo_{i}", arm).instruction for i in (0, 2)] == ["stack", ""]
    with pytest.raises(EpisodeError, match="has no 'goal'"):
        open_source("hdf5").read(str(demos), "demo_1", arm)


def test_success_is_the_last_reward_then_the_last_done(demos: Path) -> None:
    with h5py.File(demos, "a") as file:
        file["data/demo_1/rewards"][-1] = 1
        del file["data/demo_2/rewards"]
        del file["data/demo_3/rewards"], file["data/demo_3/dones"]
        file["data/demo_4/rewards"][:] = 0.3  # dense: it says how near the goal is
        file["data/demo_5/rewards"][:-1] = -1  # of each step but the last
        file["data/demo_6"].attrs["success"], file["data/demo_7"].attrs["success"] = "False", "True"
    read = open_source("hdf5").read
    found = [read(str(demos), f"demo_{i}", embodiment()).success for i in range(8)]
    assert found == [False, True, True, None, None, None, False, True]


def test_the_file_that_macos_writes_beside_each_is_no_recording(demos: Path) -> None:
    before = open_source("hdf5").episode_ids(str(demos.parent))
    (demos.parent / f"._{demos.name}").write_bytes(b"\x00\x05\x16\x07 Mac OS X")
    assert open_source("hdf5").episode_ids(str(demos.parent)) == before


def test_success_and_instruction_are_not_read_from_another_file(demos: Path) -> None:
    with h5py.File(demos.parent / "other.bin", "w") as other:
        other["rewards"], other["instruction"] = np.ones(3), "of another file"
    with h5py.File(demos, "a") as file:
        demo = file["data/demo_0"]
        del demo["rewards"], demo["dones"]
        for name in ("rewards", "instruction"):
            demo[name] = h5py.ExternalLink("other.bin", f"/{name}")
    episode = open_source("hdf5").read(str(demos), "demo_0", embodiment())
    assert episode.success is None and episode.instruction != "of another file"


@pytest.fixture(params=["raw", "padded", "vlen"])
def aloha(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Two ACT episodes, one a file; pictures raw, as padded rows of JPEG, or as JPEGs of their own length."""
    for i in range(2):
        with h5py.File(tmp_path / f"episode_{i}.hdf5", "w") as file:
            file["action"] = np.full((T, 14), i, np.float32)
            file["observations/qpos"] = np.full((T, 14), -i, np.float64)
            frames = np.repeat(np.arange(T, dtype=np.uint8) * 20, H * W * 3).reshape(T, H, W, 3)
            jpegs = [cv2.imencode(".jpg", frame)[1].reshape(-1) for frame in frames]
            key = "observations/images/top"
            if request.param == "raw":
                file[key] = frames
            elif request.param == "padded":
                longest = max(map(len, jpegs)) + 30
                file[key] = np.stack([np.pad(jpeg, (0, longest - len(jpeg))) for jpeg in jpegs])
            else:
                stored = file.create_dataset(key, (T,), h5py.vlen_dtype(np.uint8))
                for row, jpeg in enumerate(jpegs):
                    stored[row] = jpeg
    return tmp_path


def aloha_arm(**changes: Any) -> Embodiment:
    return embodiment(
        frequency_hz=50,
        action={"space": "joint_position", "components": [{"key": "/action", "dims": 14}]},
        state={"components": [{"key": "/observations/qpos", "dims": 14}]},
        cameras=[{"name": "top", "key": "/observations/images/top"}],
        **changes,
    )


def test_aloha_is_one_file_an_episode(aloha: Path) -> None:
    source = open_source("hdf5")
    assert source.episode_ids(str(aloha)) == ["episode_0", "episode_1"]
    clip = to_clip(source.read(str(aloha), "episode_1", aloha_arm()), aloha_arm())
    assert clip.actions.shape == (T, 14) and clip.actions[0, 0] == 1
    assert clip.states is not None and clip.states[0, 0] == -1
    shown = clip.episode.streams["top"].frames([0, 3, 8])
    assert np.abs(shown.astype(int).mean(axis=(1, 2, 3)) - [0, 60, 160]).max() < 3
    alone = str(aloha / "episode_1.hdf5")
    assert source.episode_ids(alone) == ["episode_1"]
    assert source.read(alone, "episode_1", aloha_arm()).actions[0].values[0, 0] == 1


def test_a_layout_names_groups_and_times(tmp_path: Path) -> None:
    path = tmp_path / "lab.h5"
    with h5py.File(path, "w") as file:
        for day in ("mon", "tue"):
            for run in (10, 9):
                fill(file.create_group(f"{day}/runs/{run}"), seed=run)
                file[f"{day}/runs/{run}/clock"] = np.arange(T) * 0.3 + 100
    layout = {"episodes": "*/runs/*", "timestamps": "clock"}
    arm = embodiment(source__layout=layout, frequency_hz=None, stride=2)
    source = open_source("hdf5")
    ids = [ref.id for ref in source.index(str(path), arm)]
    assert ids == ["mon/runs/9", "mon/runs/10", "tue/runs/9", "tue/runs/10"]
    np.testing.assert_allclose(
        source.read(str(path), ids[1], arm).streams["front"].timestamps, 100 + np.arange(T) * 0.3
    )


@pytest.mark.parametrize(
    ("key", "origin", "unit"),
    [
        ("clock", 1_700_000_000_000_000_000, 1e-9),
        ("time_us", 1_700_000_000_000_000, 1e-6),
        ("t_ms", 0, 1e-3),
        ("stamp_ns", 0, 1e-9),
    ],
)
def test_times_of_any_unit_are_read_as_seconds(tmp_path: Path, key: str, origin: int, unit: float) -> None:
    uneven = np.cumsum([0.0, *([0.1, 0.3] * T)])[:T]
    with h5py.File(tmp_path / "lab.h5", "w") as file:
        fill(file.create_group("data/demo_0"))
        file[f"data/demo_0/{key}"] = origin + np.round(uneven / unit).astype(np.int64)
    arm = embodiment(source__layout={"timestamps": key}, frequency_hz=5)
    times = open_source("hdf5").read(str(tmp_path / "lab.h5"), "demo_0", arm).streams["front"].timestamps
    np.testing.assert_allclose(times - times[0], uneven, atol=1e-3)


def test_an_unknown_rate_can_still_be_looked_at(demos: Path) -> None:
    episode = open_source("hdf5").read(str(demos), "demo_0", embodiment(frequency_hz="unknown"))
    assert len(episode.streams["front"].timestamps) == T


def test_only_the_chunks_of_the_frames_asked_for_are_read(demos: Path) -> None:
    with h5py.File(demos, "a") as file:
        stored = file["data/demo_9/obs/agentview_image"]
        stored.id.write_direct_chunk((12, 0, 0, 0), b"not gzip")
    frames = open_source("hdf5").read(str(demos), "demo_9", embodiment()).streams["front"].frames
    frames([0, 5, 11])
    with pytest.raises(EpisodeError, match=r"demo_9: cannot be read as HDF5"):
        frames([13])


@pytest.mark.parametrize(("chunks", "most"), [(None, 64), ((1, H, W, 3), 5)])
def test_datasets_of_images_stay_open_up_to_a_number_and_a_size(tmp_path, monkeypatch, chunks, most) -> None:
    monkeypatch.setattr(hdf5_file, "CHUNK_CACHE", 1 << 20)
    monkeypatch.setattr(hdf5_file, "HELD_BYTES", 5 << 20)
    count, path = 70, tmp_path / "demos.hdf5"
    with h5py.File(path, "w") as file:
        for i in range(count):
            shown = np.full((2, H, W, 3), i, np.uint8)
            file.create_dataset(f"demo_{i}/image", data=shown, chunks=chunks)
    files = hdf5_file.OpenFiles()
    handle = files.get(path)
    for _ in range(2):
        for i in range(count):
            assert (files.cached(path, handle[f"demo_{i}"], "image", "x")[:] == i).all()
        assert h5py.h5f.get_obj_count(handle.id, h5py.h5f.OBJ_DATASET) == most
    handle.close()  # as a file is that is not read for long
    with h5py.File(path) as handle:
        assert (files.cached(path, handle["demo_69"], "image", "x")[:] == 69).all()


FORKING = """
import os, sys
import numpy as np
from hma_data.sources.base import open_source
from tests.data.sources.hdf5.test_hdf5 import embodiment

stream = open_source("hdf5").read(sys.argv[1], "demo_3", embodiment()).streams["front"]
first = stream.frames([1])
child = os.fork()
if child == 0:
    os._exit(0 if np.array_equal(stream.frames([1]), first) else 1)
assert np.array_equal(stream.frames([1]), first)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
"""


def test_a_forked_child_reads_what_its_parent_opened(demos: Path) -> None:
    run_fresh(FORKING, demos)


@pytest.mark.parametrize("locking", [None, False])
def test_a_file_held_open_by_another_with_or_without_locks_is_read(demos: Path, locking: bool | None) -> None:
    with h5py.File(demos, locking=locking) as other:
        assert len(open_source("hdf5").index(str(demos))) == len(other["data"])


def test_a_file_that_changed_is_read_anew(demos: Path) -> None:
    source = open_source("hdf5")
    assert len(source.index(str(demos))) == 12
    with h5py.File(demos.with_name("new.hdf5"), "w") as file:
        fill(file.create_group("data/demo_0"))
    demos.with_name("new.hdf5").replace(demos)
    assert len(source.index(str(demos))) == 1


def test_the_fingerprint_follows_the_bytes(demos: Path) -> None:
    before = open_source("hdf5").index(str(demos))
    os.utime(demos, (1, 1))
    assert open_source("hdf5").index(str(demos)) == before
    assert len({ref.fingerprint for ref in before}) == 12
    with h5py.File(demos, "a") as file:
        file["more"] = np.arange(1000)
    assert open_source("hdf5").index(str(demos))[0].fingerprint != before[0].fingerprint


def test_a_snapshot_in_the_hubs_cache_is_read_where_it_lies(demos: Path, tmp_path: Path) -> None:
    folder = tmp_path / "plain"
    folder.mkdir()
    shutil.copy(demos, folder)
    snapshot = as_snapshot(folder, tmp_path / "cache")
    source = open_source("hdf5")
    assert source.episode_ids(str(snapshot)) == source.episode_ids(str(folder))


def test_indexing_opens_each_of_many_files_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for i in range(2 * OPEN_FILES):
        with h5py.File(tmp_path / f"episode_{i}.h5", "w") as file:
            fill(file)
    opened = Mock(wraps=hdf5_file._open)
    monkeypatch.setattr(hdf5_file, "_open", opened)
    assert len(open_source("hdf5").index(str(tmp_path))) == opened.call_count == 2 * OPEN_FILES


def test_an_unknown_episode_is_a_source_error(demos: Path) -> None:
    with pytest.raises(SourceError, match="no episode 'demo_99'"):
        open_source("hdf5").read(str(demos), "demo_99", embodiment())


def test_inspect_lists_keys_rate_and_lengths(demos: Path) -> None:
    found = open_source("hdf5").inspect(str(demos))
    keys = {info.key: info for info in found.keys}
    assert detect(str(demos)) == "hdf5" and found.episodes == 12
    assert found.frames == sum(found.lengths) == sum(T + i for i in range(12))
    assert found.hz == 20 and found.robot == "Panda"
    camera = keys["obs/agentview_image"]
    assert (camera.kind, camera.shape, camera.codec, camera.hz) == ("camera", (H, W, 3), "raw", 20)
    assert (keys["actions"].kind, keys["actions"].shape) == ("vector", (3,))
    assert found.problems == ()
    assert json.loads(json.dumps(found.to_json()))["episodes"] == 12


def test_inspect_tells_of_values_that_are_not_one_a_frame(demos: Path) -> None:
    with h5py.File(demos, "a") as file:
        file["data/demo_2/rewards"].parent["extra"] = 1
        del file["data/demo_3/rewards"]
        file["data/demo_3/rewards"] = np.zeros(2)
    said = " | ".join(open_source("hdf5").inspect(str(demos)).problems)
    assert "demo_3: of 12 frames, rewards has 2" in said and "extra" not in said


@pytest.mark.real
def test_the_rendered_lift_equals_h5py(real_data: Path) -> None:
    from hma_data.registry.embodiment import find

    path, arm = real_data / "hdf5" / "lift_rendered.hdf5", find("robosuite_lift")
    source = open_source("hdf5")
    refs = source.index(str(path), arm)
    assert [(ref.id, ref.frames, ref.split) for ref in refs] == [
        ("demo_0", 137, "train"),
        ("demo_1", 137, "train"),
        ("demo_2", 138, "val"),
    ]
    episode = source.read(str(path), "demo_2", arm)
    clip = to_clip(episode, arm)
    with h5py.File(path) as file:
        stored = file["data/demo_2"]
        np.testing.assert_array_equal(clip.actions, stored["actions"][()].astype(np.float32))
        wanted = [3, 50, 137]
        for camera in arm.cameras:
            np.testing.assert_array_equal(
                episode.streams[camera.name].frames(wanted), stored[camera.key][wanted]
            )
    assert episode.success is True
    assert source.read(str(path), "demo_0", arm).success is False


@pytest.mark.real
@pytest.mark.parametrize(("task", "length"), [("lift", 412), ("door", 261)])
def test_raw_robosuite_is_listed(real_data: Path, task: str, length: int) -> None:
    found = open_source("hdf5").inspect(str(real_data / "hdf5" / f"robosuite_{task}"))
    assert found.episodes == 1 and found.lengths == (length,) and found.robot == "Panda"
    assert {info.key for info in found.keys} == {"states", "actions", "joint_torques"}


def test_an_inspection_goes_on_after_a_first_episode_whose_times_cannot_be_read(tmp_path):
    path = tmp_path / "demos.hdf5"
    with h5py.File(path, "w") as file:
        for i in range(3):
            fill(file.create_group(f"data/demo_{i}"), seed=i)
            file[f"data/demo_{i}/time"] = np.arange(T) / 20
        del file["data/demo_0/time"]
        file.create_dataset("data/demo_0/time", shape=(1 << 27,), dtype="f8", chunks=(1 << 10,))
    seen = open_source("hdf5").inspect(path)
    [fault] = [found for found in seen.findings if found.check == "rows"]
    assert fault.message == "demo_0: of 9 frames, time has 134217728"
    assert seen.hz == 20 and seen.lengths == (T, T, T)
