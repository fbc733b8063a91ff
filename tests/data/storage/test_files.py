"""Folders appear whole or not at all; what killed writers left is deleted by the next one."""

import os
import pickle
import platform
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from hma_data.errors import OutputError
from hma_data.sources.base import EpisodeRef
from hma_data.storage.files import PARTIAL, new_folder
from hma_data.storage.kept import SETTINGS, KeptParts, keep_arrays, kept_arrays
from hma_data.storage.records import Records


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


def test_a_link_to_a_folder_stays_and_the_folder_is_replaced(tmp_path: Path) -> None:
    left(tmp_path, "disk")
    (tmp_path / "out").symlink_to("disk")
    with new_folder(tmp_path / "out") as folder:
        (folder / "file").write_text("new")
    assert (tmp_path / "out").is_symlink() and (tmp_path / "disk" / "file").read_text() == "new"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["disk", "out"]


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


def test_arrays_come_back_and_damaged_ones_do_not(tmp_path: Path) -> None:
    path = tmp_path / "part 1.npz"
    assert kept_arrays(path) is None
    values = np.random.default_rng(0).integers(0, 9, 400)
    keep_arrays(path, {"values": values, "words": np.array("{}")})
    found = kept_arrays(path)
    assert found is not None and (found["values"] == values).all()
    with np.load(path) as arrays:  # as any reader of .npz
        assert (arrays["values"] == values).all()
    whole = path.read_bytes()
    for cut in (0, 1, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:cut])
        assert kept_arrays(path) is None, cut
    for place in range(0, len(whole), 7):  # the zip's own sums miss some: a member is lost, or "encrypted"
        flipped = bytearray(whole)
        flipped[place] ^= 1
        path.write_bytes(bytes(flipped))
        assert kept_arrays(path) is None, place
    np.savez(path, values=values)  # as another version may have kept them
    assert kept_arrays(path) is None


@pytest.mark.parametrize("damaged", [b"", b"\xff\xfe", b'{"seed": 1}', None])
def test_parts_without_their_settings_are_not_taken(tmp_path: Path, damaged: bytes | None) -> None:
    KeptParts(tmp_path / "parts", {"seed": 0}).part("one", lambda: {"values": np.ones(2)})
    (tmp_path / "parts" / SETTINGS).unlink()
    if damaged is not None:
        (tmp_path / "parts" / SETTINGS).write_bytes(damaged)
    with pytest.raises(OutputError, match="started with other settings — .* or delete .*parts"):
        KeptParts(tmp_path / "parts", {"seed": 0})


def test_a_part_is_sent_without_the_rest() -> None:
    records = Records.of(EpisodeRef, [EpisodeRef(str(i), i) for i in range(5_000)])
    assert len(pickle.dumps(records[7:9])) < 1_000


def test_missing_fields_have_their_default_and_needed_ones_must_be_there() -> None:
    expected = [EpisodeRef("a", 3)]
    assert list(Records.of_json(EpisodeRef, [{"id": "a", "frames": 3}])) == expected
    assert list(Records.of_table(EpisodeRef, pa.table({"frames": [3], "id": ["a"]}))) == expected
    with pytest.raises(KeyError, match="frames"):
        Records.of_json(EpisodeRef, [{"id": "a"}])
    with pytest.raises((TypeError, ValueError)):
        Records.of_json(EpisodeRef, [{"id": "a", "frames": "many"}])
