"""Folders appear whole or not at all; what killed writers left is deleted by the next one."""

import os
import platform
from pathlib import Path

import pytest

from hma_data.storage.files import PARTIAL, new_folder


def left(tmp_path: Path, name: str) -> Path:
    (tmp_path / name).mkdir()
    (tmp_path / name / "file").write_text("left")
    return tmp_path / name


def mark(tmp_path: Path) -> str:
    with new_folder(tmp_path / "any") as folder:
        name = folder.name
    (tmp_path / "any").rmdir()
    return name.removeprefix(".any").rsplit(".", 2)[0] + "."


@pytest.mark.parametrize("there", [True, False])
def test_the_next_writer_deletes_what_a_killed_one_left(tmp_path: Path, there: bool) -> None:
    dead, own = 1 << 22, mark(tmp_path)  # above the highest process id
    left(tmp_path, f".out{own}{dead}.abc")
    old = left(tmp_path, f".out{own}{dead}.abc-old")
    others = [
        f".out{own}{os.getppid()}.abc",
        f".other{own}{dead}.abc",
        f".out{own}mine.abc",
        f".out{PARTIAL}abc",
    ]
    for name in others:
        left(tmp_path, name)
    if there:
        (tmp_path / "out").mkdir()
    with new_folder(tmp_path / "out") as folder:
        assert old.exists() != there  # all that is left of the folder, if it is not there
        (folder / "file").write_text("new")
    with new_folder(tmp_path / "out") as folder:
        (folder / "file").write_text("new")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*others, "out"])


def test_an_error_leaves_the_older_folder(tmp_path: Path) -> None:
    left(tmp_path, "out")
    with pytest.raises(KeyError), new_folder(tmp_path / "out") as folder:
        (folder / "file").write_text("new")
        raise KeyError
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert (tmp_path / "out" / "file").read_text() == "left"


def test_what_another_machine_writes_on_a_shared_disk_stays(tmp_path: Path, monkeypatch) -> None:
    dead = left(tmp_path, f".out{mark(tmp_path)}{1 << 22}.abc")
    monkeypatch.setattr(platform, "node", lambda: "elsewhere")
    with new_folder(tmp_path / "out"):
        assert dead.exists()
    monkeypatch.undo()
    with new_folder(tmp_path / "out"):
        assert not dead.exists()
