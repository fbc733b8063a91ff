"""`hma inspect FOLDER` lists recordings that are not one recording, each with its command."""

import json
import shutil
from pathlib import Path

import pytest

from hma_data.inspection.folder import several
from tests.command import hma
from tests.conftest import write_toy


@pytest.fixture
def mixed(tmp_path: Path) -> Path:
    """A folder of an HDF5 recording, a damaged bag, and files of no known format."""
    folder = tmp_path / "from the lab"
    (folder / "monday").mkdir(parents=True)
    write_toy(folder / "monday" / "toy.hdf5", [5, 6])
    (folder / "broken.mcap").write_bytes(b"\x89MCAP0\r\n and nothing more")
    (folder / "notes.txt").write_text("unknown")
    (folder / "empty.dat").touch()
    return folder


def test_each_recording_has_its_format_count_and_command(mixed: Path) -> None:
    done = hma("inspect", mixed, "--json")
    assert done.returncode == 0, done.stderr
    rows = {Path(row["path"]).name: row for row in json.loads(done.stdout)["recordings"]}
    assert {name: row["format"] for name, row in rows.items()} == {
        "toy.hdf5": "hdf5",
        "broken.mcap": "rosbag",
    }
    assert rows["toy.hdf5"]["episodes"] == 2
    assert rows["toy.hdf5"]["command"] == f"hma inspect '{mixed}/monday/toy.hdf5'"
    shown = hma("inspect", mixed)
    assert "notes.txt" not in shown.stdout
    assert "'" + str(mixed) in shown.stdout


def test_a_folder_that_is_one_recording_is_inspected_as_one(mixed: Path) -> None:
    (mixed / "broken.mcap").unlink()
    assert several(mixed) == []
    shutil.copy(mixed / "monday" / "toy.hdf5", mixed / "tuesday.hdf5")
    (mixed / "films").mkdir()
    (mixed / "films" / "toy.mp4").touch()  # a film of the recordings
    assert several(mixed) == []
    assert "4 episodes" in hma("inspect", mixed).stdout


def test_real_recordings_of_every_format(real_data: Path) -> None:
    found = [one.counted() for one in several(real_data)]
    by_format = {one.format: one.episodes for one in found}
    assert by_format.keys() == {"hands", "hdf5", "lerobot", "rlds", "rosbag"}
    assert (by_format["rlds"], by_format["lerobot"], by_format["hands"]) == (50, 100, 2)
    assert not any(one.problem for one in found)
