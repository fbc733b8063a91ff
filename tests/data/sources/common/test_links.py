"""Linked folders among recordings: what is not followed is told."""

import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from hma_data.errors import SourceError
from hma_data.sources.base import Inspection, open_source
from hma_data.sources.detect import detect
from tests.data.bag_files import make_recording, write_ros1
from tests.data.videos import encode


def episode(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["actions"] = np.random.default_rng(0).normal(size=(8, 3))


MADE: dict[str, Callable[[Path], object]] = {
    "hdf5": lambda folder: episode(folder / "a.h5"),
    "rosbag": lambda folder: write_ros1(folder / "a.bag", make_recording()),
    "hands": lambda folder: encode(folder / "a.mp4", range(12)),
}
each_format = pytest.mark.parametrize("name", MADE)


@pytest.fixture
def elsewhere(tmp_path: Path, name: str) -> Path:
    found = tmp_path / "elsewhere"
    found.mkdir()
    MADE[name](found)
    return found


@pytest.fixture
def root(tmp_path: Path) -> Path:
    found = tmp_path / "set"
    found.mkdir()
    return found


def said(found: Inspection) -> dict[str, str]:
    return {one.message: one.severity for one in found.findings if one.check == "files"}


@pytest.mark.parametrize(
    ("link", "below", "said"),
    [
        (
            "day1",
            ".",
            "day1 is a link to a folder outside {root}, not followed — give the path of that folder",
        ),
        ("gone", "no/such", "gone is a link to .*such, which is not there — copy the file in"),
    ],
)
@each_format
def test_a_folder_of_links_alone_is_told(name, elsewhere, root, link, below, said) -> None:
    (root / link).symlink_to(elsewhere / below)
    for look in (detect, open_source(name).episode_ids):
        with pytest.raises(SourceError, match=said.format(root=root)):
            look(str(root))


@each_format
def test_inspect_tells_of_linked_folders_and_of_links_to_nothing(name, elsewhere, root, tmp_path) -> None:
    shutil.copytree(elsewhere, root / "day0")
    source = open_source(name)
    assert said(source.inspect(str(root))) == {}
    (root / "day1").symlink_to(elsewhere)
    (root / "day2").symlink_to(tmp_path / "elsewhere")
    (root / "day3").symlink_to(tmp_path / "lost")
    (root / ".#lock").symlink_to("me@host.1")
    (root / "today").symlink_to("day0")
    found = source.inspect(str(root))
    assert found.episodes == 1
    assert said(found) == {
        f"{root}/day1 is a link to a folder outside {root}, not followed (and 1 more such links)": "warn",
        f"{root}/day3 is a link to {tmp_path}/lost, which is not there": "warn",
    }
    assert source.inspect(str(root / "day1")).episodes == 1
