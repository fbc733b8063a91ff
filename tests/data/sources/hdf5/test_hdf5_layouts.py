"""HDF5 as other projects write it: ManiSkill, RoboMIND, robosuite, pictures of other numbers and axes."""

import json
import os
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest

from hma_data.episodes.align import to_clip
from hma_data.errors import EpisodeError, SourceError
from hma_data.inspection.inspect import inspect_recording
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import open_source
from tests.data.hdf5_files import H, T, W, embodiment, fill, pictures


def one(path: Path, key: str = "obs/agentview_image", **written: Any) -> Path:
    with h5py.File(path / "a.h5", "w") as file:
        group = file.create_group("data/demo_0")
        fill(group)
        del group["obs/agentview_image"]
        group.create_dataset(key, **written)
    return path / "a.h5"


def shown(path: Path, indices: Any = range(T), **layout: str) -> np.ndarray:
    robot = embodiment(source={"format": "hdf5"} | ({"layout": layout} if layout else {}))
    return open_source("hdf5").read(str(path), "demo_0", robot).streams["front"].frames(indices)


@pytest.fixture
def maniskill(tmp_path: Path) -> Path:
    path = tmp_path / "trajectory.rgb.pd_ee_delta_pose.h5"
    with h5py.File(path, "w") as file:
        for i in range(2):
            group = file.create_group(f"traj_{i}")
            group["actions"] = np.full((T, 3), i, np.float32)
            group["success"] = np.arange(T) > T - 2 + i
            group["terminated"] = group["truncated"] = np.zeros(T, bool)
            group["obs/agent/qpos"] = np.arange(2 * (T + 1)).reshape(T + 1, 2)
            group["obs/sensor_data/base_camera/rgb"] = pictures(T + 1, i)
            group["obs/sensor_data/base_camera/depth"] = np.zeros((T + 1, H, W, 1), np.int16)
    path.with_suffix(".json").write_text("{}")
    return path


def maniskill_arm(**layout: str) -> Any:
    return embodiment(
        cameras=[{"name": "base", "key": "obs/sensor_data/base_camera/rgb"}],
        state={"components": [{"key": "obs/agent/qpos", "dims": 2}]},
        source={"format": "hdf5", "layout": layout} if layout else {"format": "hdf5"},
    )


def test_the_observation_after_the_last_action_is_dropped(maniskill: Path) -> None:
    arm, source = maniskill_arm(last_observation="drop"), open_source("hdf5")
    assert [(ref.id, ref.frames) for ref in source.index(str(maniskill), arm)] == [
        ("traj_0", T),
        ("traj_1", T),
    ]
    clip = to_clip(source.read(str(maniskill), "traj_1", arm), arm)
    assert len(clip) == T and clip.states is not None
    np.testing.assert_array_equal(clip.states, np.arange(2 * T).reshape(T, 2))
    np.testing.assert_array_equal(clip.frames_at("base", np.arange(T)), pictures(T + 1, 1)[:T])
    assert [source.read(str(maniskill), f"traj_{i}", arm).success for i in range(2)] == [True, False]


def test_as_many_observations_as_actions_need_nothing_dropped(tmp_path: Path) -> None:
    np.testing.assert_array_equal(shown(one(tmp_path, data=pictures()), last_observation="drop"), pictures())


def test_a_mask_that_names_an_absent_demo_is_named(tmp_path: Path) -> None:
    path = linked(tmp_path, h5py.SoftLink("/store/x"))
    with h5py.File(path, "a") as file:
        del file["data/demo_1"]
    assert "mask/train names demo_1, which demo.hdf5 does not have" in problems(path)


@pytest.mark.parametrize(
    ("dtype", "pixels", "factor"),
    [
        ("f4", "0-1", 1 / 255),
        ("f2", "0-1", 1 / 255),
        ("f8", "0-255", 1),
        ("i8", "0-255", 1),
        ("u2", "0-65535", 257),
    ],
)
def test_other_numbers_become_bytes_by_the_range_named(tmp_path, dtype, pixels, factor) -> None:
    path = one(tmp_path, data=(pictures().astype(float) * factor).astype(dtype))
    np.testing.assert_array_equal(shown(path, [5, 2, 7], pixels=pixels), pictures()[[5, 2, 7]])


def test_to_find_their_range_images_are_read_one_by_one(tmp_path: Path, monkeypatch) -> None:
    from hma_data.sources.hdf5 import images

    path, read = one(tmp_path, data=np.linspace(0, 1, T * 768).reshape(T, 16, 16, 3)), images.rows
    asked: list[int] = []
    monkeypatch.setattr(
        images, "rows", lambda found, wanted: asked.append(len(wanted)) or read(found, wanted)
    )
    with h5py.File(path) as file:
        assert images.pixels_of(file["data/demo_0/obs/agentview_image"], [0, 4, 8]) == "0-1"
    assert asked == [1, 1, 1]


@pytest.mark.parametrize("axes", ["TCHW", None])
@pytest.mark.parametrize("channels", [1, 3])
def test_channels_may_come_first(tmp_path: Path, axes: str | None, channels: int) -> None:
    stored = pictures()[..., :channels]
    path = one(tmp_path, data=stored.transpose(0, 3, 1, 2))
    found = shown(path, **({"axes": axes} if axes else {}))
    np.testing.assert_array_equal(found, np.broadcast_to(stored, (T, H, W, 3)))


def test_grey_images_become_rgb_and_transparency_is_left_out(tmp_path: Path) -> None:
    four = np.concatenate([pictures(), pictures()[..., :1]], axis=3)
    for stored in (four, four[..., :1], four[..., 0]):
        expected = np.broadcast_to(stored.reshape(T, H, W, -1)[..., :3], (T, H, W, 3))
        np.testing.assert_array_equal(shown(one(tmp_path, data=stored)), expected)


def test_axes_that_could_be_either_are_refused_until_said(tmp_path: Path) -> None:
    path = one(tmp_path, data=np.arange(T * 36, dtype=np.uint8).reshape(T, 3, 4, 3))
    with pytest.raises(EpisodeError, match=r"first or last.*layout\.axes"):
        shown(path)
    assert shown(path, axes="THWC").shape == (T, 3, 4, 3) and shown(path, axes="TCHW").shape == (T, 4, 3, 3)


def test_signed_bytes_and_opaque_rows_are_pictures(tmp_path: Path) -> None:
    pngs = [cv2.imencode(".png", picture[..., ::-1])[1].tobytes() for picture in pictures()]
    longest = max(map(len, pngs))
    opaque = np.array([np.void(png.ljust(longest, b"\0")) for png in pngs])
    np.testing.assert_array_equal(shown(one(tmp_path, data=opaque), [3, 8]), pictures()[[3, 8]])
    np.testing.assert_array_equal(shown(one(tmp_path, data=np.array(pngs)), [3]), pictures()[[3]])
    path = one(tmp_path, shape=(T,), dtype=h5py.vlen_dtype(np.int8))
    with h5py.File(path, "a") as file:
        for row, png in enumerate(pngs):
            file["data/demo_0/obs/agentview_image"][row] = np.frombuffer(png, np.int8)
    np.testing.assert_array_equal(shown(path, [0, 8]), pictures()[[0, 8]])


@pytest.mark.parametrize(
    ("masks", "expected"),
    [
        ({"train": [0], "valid": [1]}, ["train", "val", None]),
        ({"train": [0, 2], "val": [1]}, ["train", "val", "train"]),
        ({"20_percent_train": [0], "20_percent_valid": [1]}, [None] * 3),
        ({"train": [0, 1], "valid": []}, ["train", "train", None]),
    ],
)
def test_masks_by_their_names(tmp_path, masks, expected) -> None:
    path = tmp_path / "demos.hdf5"
    with h5py.File(path, "w") as file:
        for i in range(3):
            fill(file.create_group(f"data/demo_{i}"))
        for name, demos in masks.items():
            file[f"mask/{name}"] = np.array([f"data/demo_{i}".encode() for i in demos], "S16")
    refs = open_source("hdf5").index(str(path))
    assert [(ref.split, ref.frames) for ref in refs] == [(split, T) for split in expected]
    with pytest.raises(SourceError, match=f"no mask 'rest'.*{', '.join(sorted(masks))}"):
        open_source("hdf5").index(str(path), embodiment(source__split="rest"))
    for name, demos in masks.items():
        chosen = open_source("hdf5").index(str(path), embodiment(source__split=name))
        assert [ref.id for ref in chosen] == [f"demo_{i}" for i in demos]


@pytest.mark.parametrize("chunks", [(T, H, W, 3), (4, H, W, 3), (5, 5, 7, 1), (1, H, W, 3), None])
def test_batches_in_any_order_are_the_frames_whatever_the_chunks(tmp_path, chunks) -> None:
    options = {"chunks": chunks, "compression": "gzip", "shuffle": True} if chunks else {}
    path = one(tmp_path, data=pictures(), **options)
    stream = open_source("hdf5").read(str(path), "demo_0", embodiment()).streams["front"]
    for batch in ([0, 1, 2], [3, 4, 8], [8, 0], [5, 5], [], [2, 6, 7]):
        np.testing.assert_array_equal(stream.frames(batch), pictures()[batch])


def test_a_chunk_larger_than_the_usual_cache_is_read_once(tmp_path, monkeypatch) -> None:
    from hma_data.sources.hdf5 import file as hdf5_file

    monkeypatch.setattr(hdf5_file, "CHUNK_CACHE", 1000)
    path = one(tmp_path, data=pictures(), chunks=(T, H, W, 3), compression="gzip")
    stream = open_source("hdf5").read(str(path), "demo_0", embodiment()).streams["front"]
    np.testing.assert_array_equal(stream.frames([0, 1]), pictures()[:2])
    content = bytearray(path.read_bytes())
    with h5py.File(path) as file:
        place = file["data/demo_0/obs/agentview_image"].id.get_chunk_info(0)
    status = path.stat()
    content[place.byte_offset : place.byte_offset + place.size] = bytes(place.size)
    with path.open("r+b") as file:  # in place, so that the open file sees it
        file.write(content)
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    np.testing.assert_array_equal(stream.frames([5, 8]), pictures()[[5, 8]])


def test_a_group_that_holds_itself_ends(tmp_path: Path) -> None:
    path = one(tmp_path, data=pictures())
    with h5py.File(path, "a") as file:
        file["data/demo_0/loop"] = file["data/demo_0"]
        file["data/demo_0/soft"] = h5py.SoftLink("/data/demo_0/soft")
    assert shown(path).shape == (T, H, W, 3)
    assert open_source("hdf5").inspect(str(path)).episodes == 1


def test_a_json_of_the_simulator_may_be_anything(tmp_path: Path) -> None:
    path = one(tmp_path, data=pictures())
    for value in ("[", json.dumps([1]), json.dumps({"env_kwargs": 3}), "[" * 5_000, "1" * 5_000):
        with h5py.File(path, "a") as file:
            file["data"].attrs["env_args"] = value
            file["data"].attrs["problem_info"] = value
        assert open_source("hdf5").inspect(str(path)).episodes == 1
        assert shown(path, [0]).shape == (1, H, W, 3)


DAYS = ["day_1/t0", "day_1/t1", "day_2/t0", "day_2/t1"]
TASKS = ["pick/t0", "pick/t1", "place/t0", "place/t1"]
BESIDE = ["meta/camera", "version"]  # of other groups, which are no episodes
GROUPS: dict[str, tuple[list[str], list[str]]] = {  # episodes that are written, and what the file holds
    **{
        names: (
            [names.format(i) for i in range(8, 12)],
            [names.split("/")[-1].format(i) for i in range(8, 12)],
        )
        for names in ("trials/t{:03}", "t{:03}", "episodes/{}", "a/run_b/{}", "2026-11-{}")
    },
    **{
        parts: ([parts.format(i) for i in range(3)], ["a"])
        for parts in ("arm_{}", "robots/{}", "wrist_cam{}")
    },
    "one below": (["trials/t0", "trials/t1", *BESIDE], ["t0", "t1"]),
    "one at the top": (["t0", "t1", *BESIDE], ["t0", "t1"]),
    "days": ([*DAYS, *BESIDE], DAYS),
    "tasks": ([*TASKS, "version"], TASKS),
    "cameras": (["cam_0/rgb", "cam_1/rgb"], ["a"]),
    "arms": (["arm_0/q", "arm_1/q"], ["a"]),
    "both": (["cam_0/rgb", "cam_1/rgb", "cam_0/pose", "cam_1/pose", "cmd"], ["a"]),
    "a robot": (["cam_0/rgb", "cam_1/rgb", "robot/q"], ["a"]),
    "one alone": (["t0/rgb", "t0/q"], ["a"]),
}


@pytest.mark.parametrize("case", GROUPS)
def test_numbered_groups_with_pictures_and_commands_are_episodes_unless_parts_of_one(tmp_path, case) -> None:
    written, ids = GROUPS[case]
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for key in written:
            if key in BESIDE:
                file[key] = np.eye(3)
            elif key.endswith(("rgb", "/q", "pose", "cmd")):
                file[key] = pictures(T) if key.endswith("rgb") else np.zeros((T, 3), np.float32)
            else:
                fill(file.create_group(key))
    assert open_source("hdf5").episode_ids(tmp_path / "a.h5") == ids


def test_an_episode_that_was_broken_off_is_one_of_the_others(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for number in range(3):
            fill(file.create_group(f"trials/t{number}"))
        file.create_group("trials/t3")
    found = open_source("hdf5").inspect(tmp_path / "a.h5")
    assert found.episodes == 4 and "t3: has no frames" in found.problems[0]


def test_a_recording_is_inspected_by_the_layout_of_its_robot(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in ("pick", "place", "push"):
            fill(file.create_group(f"trials/{name}"))
    source = open_source("hdf5")
    assert source.inspect(tmp_path / "a.h5").episodes == 1
    robot = embodiment(source={"format": "hdf5", "layout": {"episodes": "/trials/*"}})
    found = source.inspect_as(tmp_path / "a.h5", robot)  # type: ignore[attr-defined]
    assert found.episodes == 3 and "actions" in [key.key for key in found.keys]
    path = tmp_path / "robot.yaml"
    path.write_text(robot.to_yaml())
    assert inspect_recording(tmp_path / "a.h5", path)["episodes"] == 3


# -- what is left out, and what is not


ROWS = 12


def robot() -> Embodiment:
    return embodiment(
        action={"space": "joint_position", "components": [{"key": "actions", "dims": 2}]},
        cameras=[{"name": "top", "key": "obs/image"}],
    )


def counted(group: h5py.Group, first: int, actions: int = ROWS, images: int = ROWS) -> None:
    """Write an episode whose actions and images count on from a number; rows after ROWS are zeros."""
    numbers = first + np.arange(ROWS)
    group["actions"] = np.zeros((actions, 2), np.float32)
    group["obs/image"] = np.zeros((images, 16, 16, 3), np.uint8)
    group["actions"][:ROWS] = numbers[:, None]
    group["obs/image"][:ROWS] = numbers[:, None, None, None]


def problems(path: Path) -> str:
    return "\n".join(map(str, open_source("hdf5").inspect(str(path)).findings))


def linked(folder: Path, link: Any) -> Path:
    """A file of demos 0 and 2, and a link in the place of demo_1, which mask/train names."""
    with h5py.File(folder / "other.part", "w") as file:
        counted(file.create_group("x"), 20)
    with h5py.File(folder / "demo.hdf5", "w") as file:
        for number in (0, 2):
            counted(file.create_group(f"data/demo_{number}"), 40 * number)
        counted(file.create_group("store/x"), 40)
        file["data/demo_1"] = link
        file["mask/train"] = np.array(["demo_0", "demo_1"], "S8")
        file["mask/valid"] = np.array(["demo_2"], "S8")
    return folder / "demo.hdf5"


def test_a_link_within_the_file_is_an_episode(tmp_path: Path) -> None:
    path, source = linked(tmp_path, h5py.SoftLink("/store/x")), open_source("hdf5")
    refs = source.index(str(path), robot())
    assert [(ref.id, ref.split) for ref in refs] == [
        ("demo_0", "train"),
        ("demo_1", "train"),
        ("demo_2", "val"),
    ]
    assert source.read(str(path), "demo_1", robot()).actions[0].values[:, 0].tolist() == [*range(40, 52)]
    assert source.inspect(str(path)).problems == ()


def test_a_mask_in_another_file_counts_for_nothing(tmp_path: Path) -> None:
    path = linked(tmp_path, h5py.SoftLink("/store/x"))
    with h5py.File(tmp_path / "other.part", "a") as other, h5py.File(path, "a") as file:
        other["names"] = file["mask/train"][()]
        del file["mask/train"]
        file["mask/train"] = h5py.ExternalLink("other.part", "/names")
    assert [ref.split for ref in open_source("hdf5").index(str(path), robot())] == [None] * 3


@pytest.mark.parametrize("stated", ["num_samples", "episode_length"])
@pytest.mark.parametrize(
    ("actions", "images"), [(40, 40), (40, 41), (ROWS, 40)], ids=["all", "more", "images"]
)
def test_rows_of_buffers_that_were_never_recorded_are_left_out(tmp_path, stated, actions, images) -> None:
    path, source = tmp_path / "demo.hdf5", open_source("hdf5")
    with h5py.File(path, "w") as file:
        counted(file.create_group("data/demo_0"), 5, actions, images)
        file["data/demo_0"].attrs[stated] = ROWS
    episode = source.read(str(path), "demo_0", robot())
    assert episode.actions[0].values[:, 0].tolist() == [*range(5, 5 + ROWS)]
    shown = episode.streams["top"].frames(range(len(episode.streams["top"].timestamps)))
    assert shown[:, 0, 0, 0].tolist() == [*range(5, 5 + ROWS)]
    assert episode.metadata["flags"] == {"rows_without_record": max(actions, images) - ROWS}
    assert source.index(str(path), robot())[0].frames == ROWS == source.inspect(str(path)).frames
    assert f"{max(actions, images) - ROWS} rows beyond the {ROWS} that it states are left out" in problems(
        path
    )


def test_a_stated_number_that_fits_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "demo.hdf5"
    with h5py.File(path, "w") as file:
        counted(file.create_group("data/demo_0"), 5)
        file["data/demo_0"].attrs["num_samples"] = ROWS
    episode = open_source("hdf5").read(str(path), "demo_0", robot())
    assert len(episode.actions[0].values) == ROWS and not any(episode.metadata["flags"].values())
