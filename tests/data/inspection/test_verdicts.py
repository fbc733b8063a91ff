"""What hma inspect and hma doctor say of recordings and shards that cannot be used, and their exit codes."""

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import h5py
import pytest

from hma_data.conversion.job import convert
from hma_data.errors import HMAError
from hma_data.inspection.folder import several
from hma_data.inspection.inspect import examine
from hma_data.loading.dataset import WindowDataset
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.preview import preview
from hma_data.storage.kinds import LFS
from tests.command import fails, hma
from tests.conftest import ARM_YAML, BlockTokenizer, write_toy
from tests.data.inspection.test_inspect import FORMATS
from tests.data.tokenizer_files import write_magvit2

DATA = ("*.hdf5", "*.tfrecord*", "*.mcap", "*.parquet", "*.mp4")
POINTER = LFS + b"v1\noid sha256:" + b"0" * 64 + b"\nsize 12345\n"


def data_files(recording: Path) -> list[Path]:
    files = [recording] if recording.is_file() else sorted(recording.rglob("*"))
    return [file for file in files if any(file.match(pattern) for pattern in DATA)]


@pytest.fixture
def visible() -> Iterator[Path]:
    """A folder that other users may look into, and no rights of root while the test runs in it."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    yield folder
    os.seteuid(os.getuid())
    shutil.rmtree(folder)


@pytest.mark.parametrize("name", FORMATS)
def test_a_git_lfs_pointer_is_called_one(name: str, tmp_path: Path) -> None:
    recording = FORMATS[name](tmp_path)
    for file in data_files(recording):
        file.write_bytes(POINTER)
    first = examine(str(recording))[0]
    assert first.severity == "error"
    said = " ".join(map(str, examine(str(recording))))
    assert "is a Git LFS pointer" in said and "run git lfs pull" in said


@pytest.mark.parametrize("name", FORMATS)
def test_an_empty_file_is_called_empty(name: str, tmp_path: Path) -> None:
    recording = FORMATS[name](tmp_path)
    for file in data_files(recording):
        file.write_bytes(b"")
    assert examine(str(recording))[0].severity == "error"
    assert "empty" in " ".join(map(str, examine(str(recording))))


def test_weights_that_are_a_git_lfs_pointer_are_called_one(tmp_path: Path) -> None:
    from hma_data.tokenizers import get_tokenizer

    weights = tmp_path / "magvit2.safetensors"
    write_magvit2(weights)
    weights.write_bytes(POINTER)
    with pytest.raises(HMAError, match="is a Git LFS pointer instead of the file — run git lfs pull"):
        get_tokenizer("magvit2", weights=weights)


@pytest.mark.parametrize("name", FORMATS)
def test_missing_permission_is_called_that(name: str, visible: Path) -> None:
    recording = FORMATS[name](visible)
    examine(str(recording))  # with the rights of root, modules are imported
    for file in data_files(recording):
        file.chmod(0)
    if os.getuid() == 0:
        os.seteuid(65534)
    found = examine(str(recording))
    assert found[0].severity == "error"
    assert "permission denied" in " ".join(map(str, found)).lower()
    assert "damaged" not in " ".join(map(str, found))


def test_a_preview_that_may_not_be_written_is_one_line(visible: Path, toy_arm: Embodiment) -> None:
    write_toy(visible / "toy.hdf5", [14, 15])
    convert(toy_arm, str(visible / "toy.hdf5"), BlockTokenizer(), visible / "set")
    preview(visible / "set", visible / "first", tokenizer=BlockTokenizer())
    (visible / "kept").mkdir(mode=0o555)
    if os.getuid() == 0:
        os.seteuid(65534)
    for out in (visible / "kept", visible / "kept" / "new"):
        with pytest.raises(HMAError, match="cannot be written: Permission denied — .*--out"):
            preview(visible / "set", out, tokenizer=BlockTokenizer())


@pytest.fixture
def things(tmp_path: Path, toy_arm: Embodiment) -> Path:
    write_toy(tmp_path / "toy.hdf5", [14, 15])
    (tmp_path / "toy_arm.yaml").write_text(ARM_YAML)
    convert(toy_arm, str(tmp_path / "toy.hdf5"), BlockTokenizer(), tmp_path / "shards")
    (tmp_path / "model").mkdir()
    (tmp_path / "model/trunk.safetensors").write_bytes(b"")
    return tmp_path


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("shards info toy.hdf5", "toy.hdf5: is a recording, not a shard set — hma inspect shows it"),
        ("shards info model", "model: is a checkpoint, not a shard set"),
        ("shards info toy_arm.yaml", "toy_arm.yaml: is a YAML file, not a shard set"),
        ("inspect shards", "shards: is a shard set, not a recording — hma shards info shows it"),
        ("inspect model", "model: is a checkpoint, not a recording"),
        ("inspect toy_arm.yaml", "toy_arm.yaml: is a YAML file, not a recording"),
        ("inspect shards -e toy_arm.yaml", "shards: is a shard set, not a recording"),
        ("inspect toy.hdf5 -e ./toy.hdf5", "toy.hdf5: is a recording, not a YAML file"),
        ("inspect toy.hdf5 -e shards", "shards: is a shard set, not a YAML file"),
        ("registry infer shards --id x", "shards: is a shard set, not a recording"),
        ("evaluate ./shards shards", "shards: is a shard set, not a checkpoint"),
        ("evaluate ./model toy.hdf5", "toy.hdf5: is a recording, not a shard set"),
        ("convert -e toy_arm.yaml --source shards --out o", "shards: is a shard set, not a recording"),
    ],
)
def test_what_is_given_in_the_wrong_place_is_called_what_it_is(things: Path, command: str, said: str) -> None:
    fails(hma(*command.split(), cwd=things), 1, said)


def test_doctor_and_validate_call_it_what_it_is(things: Path) -> None:
    (told,) = examine(str(things / "model"))
    assert (told.severity, told.check) == ("error", "readable") and "is a checkpoint" in told.message
    done = hma("registry", "validate", "toy.hdf5", cwd=things)
    assert done.returncode == 1 and "toy.hdf5: is a recording, not a YAML file" in done.stdout


def test_shards_without_a_window_are_an_error(tmp_path: Path, toy_arm: Embodiment) -> None:
    write_toy(tmp_path / "toy.hdf5", [14, 15, 16])
    convert(toy_arm, str(tmp_path / "toy.hdf5"), BlockTokenizer(), tmp_path / "shards")
    first = examine(str(tmp_path / "shards"))[0]
    assert (first.check, first.severity) == ("windows", "error")
    assert "12 frames need 24 rows, the longest episode has 1" in first.message


@pytest.mark.parametrize(("length", "short"), [(23, True), (24, False)])
def test_doctor_counts_the_rows_of_a_window_as_the_loader_does(length, short, tmp_path, toy_arm) -> None:
    write_toy(tmp_path / "toy.hdf5", [length] * 3)
    (tmp_path / "arm.yaml").write_text(toy_arm.to_yaml())
    found = [one for one in examine(tmp_path / "toy.hdf5", tmp_path / "arm.yaml") if one.check == "length"]
    assert bool(found) is short and (not short or "a window, 24 frames" in found[0].message)
    convert(toy_arm, str(tmp_path / "toy.hdf5"), BlockTokenizer(), tmp_path / "shards")
    assert bool(len(WindowDataset(tmp_path / "shards", "train", 12))) is not short


def test_faults_that_differ_in_numbers_alone_are_one_group_that_counts_all(tmp_path: Path) -> None:
    write_toy(tmp_path / "toy.hdf5", range(30, 50))
    with h5py.File(tmp_path / "toy.hdf5", "a") as file:
        for demo in file["data"].values():
            actions = demo["actions"][:-2]
            del demo["actions"]
            demo["actions"] = actions
    (tmp_path / "arm.yaml").write_text(ARM_YAML)
    usable = [
        one
        for one in examine(str(tmp_path / "toy.hdf5"), str(tmp_path / "arm.yaml"))
        if one.check == "usable"
    ]
    assert len(usable) == 1 and usable[0].severity == "error"
    assert usable[0].message.startswith("20 of 20 sampled episodes, such as demo_0: ")


def test_a_set_of_which_no_picture_can_be_read_is_an_error_for_both_commands(tmp_path: Path) -> None:
    recording = FORMATS["lerobot"](tmp_path)
    for file in recording.rglob("*.mp4"):
        file.write_bytes(b"no video")
    (one, *_) = examine(str(recording))
    assert one.severity == "warn"  # the still pictures in parquet are another camera
    for file in recording.rglob("*.parquet"):
        file.write_bytes(b"no parquet")
    (one, *_) = examine(str(recording))
    assert one.severity == "error"
    assert hma("inspect", recording).returncode == hma("doctor", recording).returncode == 1


def test_inspect_exits_as_doctor_does(tmp_path: Path) -> None:
    write_toy(tmp_path / "toy.hdf5", [40, 40])
    with h5py.File(tmp_path / "toy.hdf5", "a") as file:
        for demo in file["data"].values():
            demo["actions"][3] = float("nan")
    for limit, code in (("error", 0), ("warn", 1)):
        assert hma("inspect", tmp_path / "toy.hdf5", "--fail-on", limit).returncode == code


@pytest.fixture
def mixed(tmp_path: Path) -> Path:
    folder = tmp_path / "from the lab"
    (folder / "monday").mkdir(parents=True)
    write_toy(folder / "monday" / "toy.hdf5", [5, 6])
    (folder / "broken.mcap").write_bytes(b"\x89MCAP0\r\n and nothing more")
    (folder / "notes.txt").write_text("unknown")
    (folder / "empty.dat").touch()
    return folder


def test_each_recording_has_its_format_count_and_command(mixed: Path, monkeypatch) -> None:
    done = hma("inspect", mixed, "--json")
    assert done.returncode == 0, done.stderr
    rows = {Path(row["path"]).name: row for row in json.loads(done.stdout)["recordings"]}
    assert {name: row["format"] for name, row in rows.items()} == {
        "toy.hdf5": "hdf5",
        "broken.mcap": "rosbag",
    }
    assert rows["toy.hdf5"]["episodes"] == 2
    assert rows["toy.hdf5"]["command"] == f"hma inspect '{mixed}/monday/toy.hdf5'"
    monkeypatch.setenv("HOME", str(mixed.parent))
    assert several(f"~/{mixed.name}") == several(mixed)
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
