"""What hma inspect and hma doctor say: of each defect its check, and of what cannot be used why."""

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
from skimage import data as skimage_data
from typer.testing import CliRunner

from hma_data.conversion.job import convert
from hma_data.episodes.episode import Episode
from hma_data.errors import HMAError
from hma_data.inspection.folder import several
from hma_data.inspection.inspect import Finding, examine, inspect_recording
from hma_data.loading.dataset import WindowDataset
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.preview import preview
from hma_data.sources.hdf5.source import Hdf5Source
from hma_data.storage.kinds import LFS
from hma_model.cli import app
from tests.command import fails, hma
from tests.conftest import ARM_YAML, BlockTokenizer, write_toy
from tests.data.inspection.test_inspect import FORMATS
from tests.data.tokenizer_files import write_magvit2
from tests.hostile import flip

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


@pytest.mark.parametrize(
    ("content", "words"), [(POINTER, ("is a Git LFS pointer", "run git lfs pull")), (b"", ("empty",))]
)
@pytest.mark.parametrize("name", FORMATS)
def test_a_git_lfs_pointer_and_an_empty_file_are_called_so(name, content, words, tmp_path: Path) -> None:
    recording = FORMATS[name](tmp_path)
    for file in data_files(recording):
        file.write_bytes(content)
    found = examine(str(recording))
    assert found[0].severity == "error"
    assert all(word in " ".join(map(str, found)) for word in words)


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


# -- each defect by its check


LENGTHS = (40, 45, 50)


def sound(file: h5py.File) -> None:
    draw = np.random.default_rng(0)
    for i, length in enumerate(LENGTHS):
        demo = file.create_group(f"data/demo_{i}")
        demo["actions"] = draw.normal(size=(length, 3)).astype(np.float32)
        for camera in ("image", "side"):
            demo[f"obs/{camera}"] = draw.integers(0, 256, (length, 16, 16, 3), np.uint8)


def set_all(key: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[h5py.File], None]:
    def apply(file: h5py.File) -> None:
        for demo in file["data"].values():
            values = change(demo[key][:])
            del demo[key]
            demo[key] = values

    return apply


def examined(tmp_path: Path, damage: Callable[[h5py.File], None], yaml: str = ARM_YAML) -> list[Finding]:
    with h5py.File(tmp_path / "toy.hdf5", "w") as file:
        sound(file)
        damage(file)
    (tmp_path / "toy_arm.yaml").write_text(yaml)
    return examine(str(tmp_path / "toy.hdf5"), str(tmp_path / "toy_arm.yaml"))


def still(pictures: np.ndarray) -> np.ndarray:
    return np.repeat(pictures[:1], len(pictures), axis=0)


@pytest.mark.parametrize(
    ("damage", "check", "severity"),
    [
        (set_all("obs/image", still), "still", "warn"),
        (set_all("obs/image", np.zeros_like), "blank", "warn"),
        (set_all("obs/side", lambda pictures: pictures[:-1]), "usable", "error"),
        (set_all("actions", lambda actions: actions * [1, 0, 1]), "constant", "warn"),
        (set_all("actions", lambda actions: np.full_like(actions, np.nan)), "usable", "error"),
    ],
)
def test_a_defect_is_found_by_its_check(tmp_path, damage, check, severity) -> None:
    found = examined(tmp_path, damage)
    assert (check, severity) in {(finding.check, finding.severity) for finding in found}


@pytest.mark.parametrize(
    ("old", "new", "check"),
    [
        ("dims: 3", "dims: 3, range: [-0.1, 0.1]", "range"),
        ("key: obs/image", "key: obs/image, size: [480, 640]", "size"),
        ("target_hz: 5", "target_hz: 1", "length"),
    ],
)
def test_what_the_yaml_states_is_held_against_the_episodes(tmp_path, old, new, check) -> None:
    assert check in {one.check for one in examined(tmp_path, lambda file: None, ARM_YAML.replace(old, new))}


def test_without_a_yaml_black_pictures_are_a_warning_only_where_no_other_camera_is_left(tmp_path) -> None:
    path = tmp_path / "toy.hdf5"
    with h5py.File(path, "w") as file:
        sound(file)
        set_all("obs/image", np.zeros_like)(file)
    assert {one.severity for one in examine(str(path)) if one.check == "blank"} == {"info"}
    with h5py.File(path, "a") as file:
        set_all("obs/side", np.zeros_like)(file)
    assert {one.severity for one in examine(str(path)) if one.check == "blank"} == {"warn"}


def test_degrees_stated_as_radians_are_noticed(tmp_path: Path) -> None:
    in_degrees = set_all("actions", lambda actions: actions * 90)
    found = examined(tmp_path, in_degrees, ARM_YAML.replace("dims: 3", "dims: 3, unit: rad"))
    assert "are these degrees?" in {finding.remedy for finding in found}


def test_actions_that_are_the_state_of_the_same_frame_are_noticed(tmp_path: Path) -> None:
    def copy(file: h5py.File) -> None:
        for demo in file["data"].values():
            demo["obs/joints"] = demo["actions"][:][:, ::-1]

    stated = ARM_YAML + "state: {components: [{key: obs/joints, dims: 3}]}\n"
    (found,) = examined(tmp_path, copy, stated)
    assert found.check == "action" and found.severity == "warn" and "throughout: a, b, c" in found.message
    (tmp_path / "toy_arm.yaml").write_text(stated + "sync: {action_shift: 1}\n")
    assert not examine(str(tmp_path / "toy.hdf5"), str(tmp_path / "toy_arm.yaml"))


def test_a_yaml_that_says_bgr_of_pictures_in_order_is_noticed(tmp_path: Path) -> None:
    photo = skimage_data.chelsea()[:64, :64]  # it was a JPEG once, and its colours still show it

    def photographs(file: h5py.File) -> None:
        for demo in file["data"].values():
            del demo["obs/image"]
            demo["obs/image"] = np.stack([np.roll(photo, i, axis=1) for i in range(len(demo["actions"]))])

    found = examined(tmp_path, photographs, ARM_YAML.replace("key: obs/image", "key: obs/image, color: bgr"))
    assert [(one.check, one.severity) for one in found] == [("colour", "warn")]


def test_a_sound_recording_has_no_finding_and_a_camera_that_the_robot_does_not_use_gives_none(tmp_path):
    def damage(file: h5py.File) -> None:
        for demo in file["data"].values():
            demo["obs/spare"] = np.zeros((len(demo["actions"]), 16, 16, 3), np.uint8)

    assert examined(tmp_path, damage) == []


@pytest.mark.parametrize(("limit", "code"), [("error", 0), ("warn", 1), ("never", 0)])
def test_the_exit_code_follows_fail_on(tmp_path: Path, limit: str, code: int) -> None:
    examined(tmp_path, set_all("actions", lambda actions: actions * [1, 0, 1]))
    done = CliRunner().invoke(app, ["doctor", str(tmp_path / "toy.hdf5"), "--fail-on", limit, "--json"])
    finding, unstated = json.loads(done.stdout)["findings"]
    assert (unstated["check"], unstated["message"]) == ("rate", "the recording states no rate")
    assert (done.exit_code, finding["check"], finding["numbers"]["dims"]) == (code, "constant", [1])


def test_the_worst_comes_first(tmp_path: Path) -> None:
    unknown = set_all("actions", lambda actions: np.full_like(actions, np.nan))
    yaml = ARM_YAML.replace("key: obs/image", "key: obs/image, size: [480, 640]")
    order = [finding.severity for finding in examined(tmp_path, unknown, yaml)]
    assert order == sorted(order, key=["error", "warn", "info"].index) and len(set(order)) > 1


def test_a_shard_set_with_changed_bytes_is_an_error(tmp_path, toy_arm, toy_recording, block_tokenizer):
    convert(toy_arm, str(toy_recording), block_tokenizer, tmp_path / "shards")
    assert not [finding for finding in examine(str(tmp_path / "shards")) if finding.severity == "error"]
    shard = next((tmp_path / "shards" / "train").iterdir())
    flip(20)(shard)
    first = examine(str(tmp_path / "shards"))[0]
    assert first.check == "integrity"
    assert str(first).count(" — ") <= 1  # verify's line says what to do, and nothing else does


def test_episodes_that_are_refused_come_with_what_to_do(tmp_path: Path) -> None:
    yaml = ARM_YAML.replace("dims: 3, names: [a, b, c]", "dims: 2")
    (first, *_) = examined(tmp_path, lambda file: None, yaml)
    assert (first.check, first.severity) == ("usable", "error")
    assert "dims" in first.remedy or "slice" in first.remedy


def test_a_fault_of_the_reader_is_one_of_the_episode(tmp_path: Path, monkeypatch) -> None:
    def read(self: Hdf5Source, uri: str, name: str, robot: Embodiment) -> Episode:
        return {}[name]

    monkeypatch.setattr(Hdf5Source, "read", read)
    (first, *_) = examined(tmp_path, lambda file: None)
    assert first.check == "usable" and "3 of 3 sampled episodes" in first.message
    assert "stops its reader with KeyError: 'demo_0'" in first.message
    report = inspect_recording(tmp_path / "toy.hdf5", tmp_path / "toy_arm.yaml")
    assert any("stops its reader with KeyError" in one["message"] for one in report["findings"])


def test_a_recording_without_a_camera_is_no_robots(tmp_path: Path) -> None:
    examined(tmp_path, lambda file: [file[f"data/{name}"].pop("obs") for name in file["data"]])
    found = [one for one in examine(tmp_path / "toy.hdf5") if one.check == "robot"]
    assert [(one.severity, one.message) for one in found] == [("warn", "the recording has no colour camera")]
