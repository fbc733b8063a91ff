"""A recording that is not what was said, or is linked elsewhere: the error tells what to do."""

import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from hma_data.conversion.job import convert
from hma_data.errors import HMAError, OutputError, SourceError, StorageError, UsageError
from hma_data.inspection.inspect import examine, inspect_recording
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import Inspection, open_source
from hma_data.sources.detect import detect, of_another_format
from hma_model.cli import app
from tests.conftest import ARM_YAML, BlockTokenizer, write_toy
from tests.data.bag_files import arm as bag_robot
from tests.data.bag_files import make_recording, write_ros1, write_ros2
from tests.data.sources.rlds.test_rlds import embodiment as rlds_robot
from tests.data.sources.rlds.test_rlds import toy
from tests.data.videos import encode, make_v3


def converted(robot: Embodiment, source: str, out: Path) -> str:
    with pytest.raises(HMAError) as refused:
        convert(robot, source, BlockTokenizer(), out)
    assert not out.exists() or not list(out.iterdir())
    return str(refused.value)


def test_another_format_than_the_yaml_says_is_named(toy_arm: Embodiment, tmp_path: Path) -> None:
    toy(tmp_path / "rlds")
    write_toy(tmp_path / "toy.hdf5", [3])
    make_v3(tmp_path / "lerobot", (3,))
    said = "it looks like {}, source.format in the YAML says {}"
    for robot, name, other in (
        (toy_arm, "rlds", "rlds"),
        (toy_arm, "lerobot", "lerobot"),
        (rlds_robot(), "toy.hdf5", "hdf5"),
        (bag_robot(), "toy.hdf5", "hdf5"),
    ):
        expected = said.format(other, robot.source.format)
        assert converted(robot, str(tmp_path / name), tmp_path / "out").endswith(expected)
    (tmp_path / "arm.yaml").write_text(ARM_YAML)
    (found,) = examine(str(tmp_path / "lerobot"), str(tmp_path / "arm.yaml"))
    assert found.check == "readable" and said.format("lerobot", "hdf5") in found.message
    with pytest.raises(SourceError, match=said.format("lerobot", "hdf5")):
        inspect_recording(str(tmp_path / "lerobot"), str(tmp_path / "arm.yaml"))


@pytest.mark.parametrize("uri", ["no/such", "hf://datasets/team/set", "s3://bucket/toy"])
def test_of_a_place_that_is_not_here_no_format_is_guessed(uri: str) -> None:
    fault = SourceError(uri, "does not exist", "check it")
    assert of_another_format(uri, "hdf5", fault) is fault


@pytest.mark.parametrize(("uri", "name"), [("s3://bucket/a.hdf5", "hdf5"), ("https://host/b.h5", "hdf5")])
def test_what_is_read_from_files_alone_says_so_of_a_store(uri: str, name: str) -> None:
    assert detect(uri) == name
    with pytest.raises(SourceError, match=f"^{uri}: is not on this machine — copy it here"):
        open_source(name).index(uri)


def test_an_empty_path_is_told_and_the_yamls_is_not_taken_for_it(toy_arm: Embodiment, tmp_path: Path) -> None:
    robot = toy_arm.model_copy(update={"source": toy_arm.source.model_copy(update={"uri": "elsewhere"})})
    with pytest.raises(UsageError, match="--source: is empty"):
        convert(robot, "", BlockTokenizer(), tmp_path / "out")
    with pytest.raises(SourceError, match="the recording's path is empty"):
        detect("")


def test_the_same_fault_of_many_episodes_is_told_once(tmp_path: Path) -> None:
    folder = make_v3(tmp_path / "set", (3, 4, 5))
    data = next((folder / "data").rglob("*.parquet"))
    data.write_bytes(b"")
    found = [one for one in open_source("lerobot").inspect(str(folder)).findings if one.check == "readable"]
    assert len(found) == 1 and found[0].message.startswith("3 of 3 sampled episodes, such as episode_000000:")
    assert str(data) in found[0].message


def test_doctor_names_an_episode_it_could_not_use_and_the_keys_there_are(tmp_path: Path) -> None:
    write_toy(tmp_path / "toy.hdf5", [60, 60])
    (tmp_path / "arm.yaml").write_text(ARM_YAML.replace("key: obs/image", "key: obs/nothing"))
    (first, *_) = examine(str(tmp_path / "toy.hdf5"), str(tmp_path / "arm.yaml"))
    assert first.message.startswith("2 of 2 sampled episodes, such as demo_0: has no 'obs/nothing'")
    toy(tmp_path / "rlds")
    changed = rlds_robot(cameras=[{"name": "primary", "key": "observation/none"}])
    (tmp_path / "rlds.yaml").write_text(changed.to_yaml())
    (first, *_) = examine(str(tmp_path / "rlds"), str(tmp_path / "rlds.yaml"))
    assert first.check == "usable" and "observation/image" in first.remedy


def test_a_bag_folder_without_its_files_is_known_as_one(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "run", make_recording(), "SQLITE3")
    assert detect(str(folder / "metadata.yaml")) == "rosbag"
    assert inspect_recording(str(folder / "metadata.yaml"))["episodes"] == 1
    next(folder.glob("*.db3")).unlink()
    with pytest.raises(SourceError, match="metadata.yaml: names run.db3, which is not in the folder"):
        inspect_recording(str(folder))


def test_a_reason_of_one_episode_alone_names_it(toy_arm: Embodiment, tmp_path: Path) -> None:
    write_toy(tmp_path / "toy.hdf5", [5, 6, 7, 8])
    with h5py.File(tmp_path / "toy.hdf5", "a") as file:
        del file["data/demo_1/obs"]
        for i in (2, 3):
            del file[f"data/demo_{i}/actions"]
    summary = convert(toy_arm, str(tmp_path / "toy.hdf5"), BlockTokenizer(), tmp_path / "out")
    (one, count), (many, counts) = sorted(summary.reasons.items(), key=lambda item: item[1])
    assert (count, counts) == (1, 2)
    assert "data/demo_1: has no 'obs/image'" in one and "data/<episode>: has no 'actions'" in many


@pytest.mark.parametrize("out", ["s3://", "s3:", "hf://", "gs:///"])
def test_a_store_without_a_bucket_is_no_folder_of_this_machine(out, toy_arm, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_toy(tmp_path / "toy.hdf5", [5])
    with pytest.raises(StorageError, match="names no bucket"):
        convert(toy_arm, "toy.hdf5", BlockTokenizer(), Path(out))
    assert [item.name for item in tmp_path.iterdir()] == ["toy.hdf5"]


def test_an_out_that_cannot_be_named_is_one_clear_error(toy_arm: Embodiment, tmp_path: Path) -> None:
    write_toy(tmp_path / "toy.hdf5", [5])
    with pytest.raises(OutputError, match="cannot be written: File name too long — choose another --out"):
        convert(toy_arm, str(tmp_path / "toy.hdf5"), BlockTokenizer(), tmp_path / ("n" * 300))


def test_options_that_cannot_be_meant_are_wrong_usage(tmp_path: Path) -> None:
    options = ["--out", str(tmp_path / "out"), "--extend", "--overwrite"]
    result = CliRunner().invoke(app, ["convert", "-e", "x", *options])
    assert isinstance(result.exception, UsageError) and "give one of them" in str(result.exception)


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


# -- packed recordings


@pytest.mark.parametrize(
    ("name", "tool"),
    [("run.bag.gz", "gunzip"), ("x.h5.gz", "gunzip"), ("a.mcap.GZ", "gunzip"), ("all.zip", "unzip"),
     ("all.tar", "tar xf"), ("all.tar.gz", "tar xf"), ("all.tgz", "tar xf"), ("run.bag.zst", "unzstd")],
)  # fmt: skip
def test_a_packed_recording_is_to_be_unpacked(tmp_path: Path, name: str, tool: str) -> None:
    (tmp_path / "notes.txt").write_text("day one")
    (tmp_path / name).write_bytes(b"\x1f\x8b\x08" + bytes(40))
    for uri in (tmp_path, tmp_path / name):
        with pytest.raises(SourceError) as told:
            detect(str(uri))
        assert f"{name} is packed: unpack it first, as with `{tool} {name}`" in str(told.value)
