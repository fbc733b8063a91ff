"""What a file holds but an episode does not get: linked demos, rows never recorded, videos of others."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import open_source

ROWS = 12


def robot() -> Embodiment:
    values: dict[str, Any] = {
        "id": "testbot",
        "kind": "simulation",
        "frequency_hz": 20,
        "action": {"space": "joint_position", "components": [{"key": "actions", "dims": 2}]},
        "cameras": [{"name": "top", "key": "obs/image"}],
        "source": {"format": "hdf5"},
    }
    return Embodiment.from_values(values, "test")


def fill(group: h5py.Group, first: int, actions: int = ROWS, images: int = ROWS) -> None:
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
        fill(file.create_group("x"), 20)
    with h5py.File(folder / "demo.hdf5", "w") as file:
        for number in (0, 2):
            fill(file.create_group(f"data/demo_{number}"), 40 * number)
        fill(file.create_group("store/x"), 40)
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


def test_a_mask_that_names_an_absent_demo_is_named(tmp_path: Path) -> None:
    path = linked(tmp_path, h5py.SoftLink("/store/x"))
    with h5py.File(path, "a") as file:
        del file["data/demo_1"]
    assert "mask/train names demo_1, which demo.hdf5 does not have" in problems(path)


@pytest.mark.parametrize("stated", ["num_samples", "episode_length"])
@pytest.mark.parametrize(
    ("actions", "images"), [(40, 40), (40, 41), (ROWS, 40)], ids=["all", "more", "images"]
)
def test_rows_of_buffers_that_were_never_recorded_are_left_out(tmp_path, stated, actions, images) -> None:
    path, source = tmp_path / "demo.hdf5", open_source("hdf5")
    with h5py.File(path, "w") as file:
        fill(file.create_group("data/demo_0"), 5, actions, images)
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
        fill(file.create_group("data/demo_0"), 5)
        file["data/demo_0"].attrs["num_samples"] = ROWS
    episode = open_source("hdf5").read(str(path), "demo_0", robot())
    assert len(episode.actions[0].values) == ROWS and "flags" not in episode.metadata
