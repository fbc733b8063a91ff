"""Files that have grown: their known episodes are recognised, new ones are added, changed ones refused."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import pytest

from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.conversion.report import Summary
from hma_data.conversion.rewrite import merge
from hma_data.errors import OutputError
from hma_data.inspection.inspect import examine
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.manifest import Manifest
from hma_data.shards.verify import verify
from hma_model.hub.datasets import push_data
from tests.conftest import BlockTokenizer, write_toy
from tests.conftest import convert_toy as run
from tests.data.sources.lerobot.test_lerobot import embodiment as lerobot_robot
from tests.data.sources.rlds.test_rlds import embodiment as rlds_robot
from tests.data.sources.rlds.test_rlds import toy
from tests.data.videos import make_v3

Change = Callable[[h5py.File], None]


def shards(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.glob("*/shard-*")}


def grow(path: Path, lengths: list[int], begun: int) -> None:
    beside = path.with_name("more.hdf5")
    write_toy(beside, [1] * begun + lengths)
    with h5py.File(beside) as source, h5py.File(path, "a") as file:
        for i in range(begun, begun + len(lengths)):
            source.copy(f"data/demo_{i}", file["data"])
    beside.unlink()


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "toy.hdf5"
    write_toy(path, [20, 21, 22])
    return path


def check_extended(robot: Embodiment, recording: Path, out: Path, before: dict, count: int) -> None:
    summary = run(robot, recording, out, extend=True)
    assert summary.made_shards and verify(out) == []
    assert shards(out).items() > before.items(), "the old shards stay as they are"
    assert sum(split["episodes"] for split in summary.manifest.splits.values()) == count
    assert run(robot, recording, out).made_shards == 0


def test_demos_added_to_a_file_extend_the_set_again_and_again(toy_arm, recording, tmp_path) -> None:
    out = tmp_path / "out"
    run(toy_arm, recording, out)
    for begun, lengths in ((3, [23, 24]), (5, [25])):
        before = shards(out)
        grow(recording, lengths, begun)
        with pytest.raises(OutputError, match="--extend adds"):
            run(toy_arm, recording, out)
        check_extended(toy_arm, recording, out, before, begun + len(lengths))


def test_strided_rows_of_two_cameras_are_recognised(toy_arm, recording, tmp_path) -> None:
    settings = Settings(frames="strided", cameras=tuple(c.name for c in toy_arm.cameras), shard_frames=60)
    run(toy_arm, recording, tmp_path / "out", settings)
    grow(recording, [23], 3)
    summary = run(toy_arm, recording, tmp_path / "out", settings, extend=True)
    assert summary.made_shards == 1 and verify(tmp_path / "out") == []


def set_value(key: str, index: int) -> Change:
    def change(file: h5py.File) -> None:
        data = file[f"data/demo_1/{key}"]
        data[index] = data[index] + 1

    return change


CHANGES = {
    "an action": set_value("actions", 7),
    "its first picture": set_value("obs/image", 0),
    "its last picture": set_value("obs/image", 20),
    "its instruction": lambda file: file["data/demo_1"].attrs.update(language_instruction="another task"),
    "its pictures, which cannot be read": lambda file: file["data/demo_1"].pop("obs"),
}


@pytest.mark.parametrize("what", CHANGES)
def test_a_known_episode_that_changed_is_refused_by_its_name(what, toy_arm, recording, tmp_path) -> None:
    out = tmp_path / "out"
    run(toy_arm, recording, out)
    before = shards(out)
    grow(recording, [23], 3)
    with h5py.File(recording, "a") as file:
        CHANGES[what](file)
    with pytest.raises(OutputError, match="1 of its episodes were re-recorded, first 'demo_1'"):
        run(toy_arm, recording, out, extend=True)
    with pytest.raises(OutputError, match="cannot be extended; different: embodiment"):
        run(toy_arm.model_copy(update={"id": "other"}), recording, out, extend=True)
    assert shards(out) == before


@pytest.mark.parametrize(
    ("name", "damage", "extend"),
    [
        ("episodes.parquet", "gone", True),
        ("episodes.parquet", "other", False),
        ("quarantine.jsonl", "blank", True),
        ("embodiment.yaml", "gone", False),
        ("embodiment.yaml", "blank", True),
    ],
)
def test_what_follows_from_the_shards_is_written_anew(
    name: str, damage: str, extend: bool, toy_arm: Embodiment, recording: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    run(toy_arm, recording, out)
    before, shards_before = (out / name).read_bytes(), shards(out)
    (out / name).unlink()
    if damage != "gone":
        (out / name).write_bytes(b"\n" if damage == "blank" else b'{"id": 3}\n' + before)
    assert run(toy_arm, recording, out, extend=extend).made_shards == 0
    assert (out / name).read_bytes() == before and shards(out) == shards_before and verify(out) == []


def test_a_shard_that_is_missing_is_told_before_the_set_is_extended(toy_arm, recording, tmp_path) -> None:
    out = tmp_path / "out"
    run(toy_arm, recording, out)
    whole = shards(out)
    first = out / sorted(whole)[0]
    first.write_bytes(b"PAR1")
    with pytest.raises(OutputError, match=r"is missing, or does not have the [\d,]+ bytes"):
        run(toy_arm, recording, out, extend=True)
    first.unlink()
    with pytest.raises(OutputError, match="shard-00000.parquet: is missing, or does not have"):
        run(toy_arm, recording, out, extend=True)
    assert run(toy_arm, recording, out).made_shards == 1 and shards(out) == whole
    grow(recording, [23], 3)
    run(toy_arm, recording, out, extend=True)
    first.unlink()
    for extend in (False, True):
        with pytest.raises(OutputError, match="is missing, or does not have .* restore it from a copy"):
            run(toy_arm, recording, out, extend=extend)


def test_doctor_tells_a_set_that_is_not_finished_from_a_recording(toy_arm, recording, tmp_path) -> None:
    run(toy_arm, recording, tmp_path / "out")
    (tmp_path / "out" / "manifest.json").unlink()
    (found,) = examine(str(tmp_path / "out"))
    assert found.check == "integrity" and "its conversion has not finished" in found.message


@pytest.mark.parametrize(("make", "robot"), [(make_v3, lerobot_robot), (toy, rlds_robot)])
def test_episodes_added_to_a_lerobot_datasets_videos_or_a_split_of_rlds(make, robot, tmp_path) -> None:
    folder, out = tmp_path / "set", tmp_path / "out"
    make(folder, (12, 9, 15))
    run(robot(), folder, out)
    before = shards(out)
    shutil.rmtree(folder)
    make(folder, (12, 9, 15, 11))
    check_extended(robot(), folder, out, before, 4)


def test_records_in_another_order_are_refused(tmp_path: Path) -> None:
    folder, out = tmp_path / "set", tmp_path / "out"
    toy(folder, (4, 3, 5))
    run(rlds_robot(), folder, out)
    shutil.rmtree(folder)
    toy(folder, (6, 4, 3, 5))
    with pytest.raises(OutputError, match="re-recorded, first 'train/000000'"):
        run(rlds_robot(), folder, out, extend=True)
    assert json.loads((out / "manifest.json").read_text())["totals"]["episodes"] == 3


def test_files_of_a_hub_and_of_macos_may_lie_beside_a_set(tmp_path: Path, toy_arm: Embodiment) -> None:
    recording, out = tmp_path / "toy.hdf5", tmp_path / "out"
    write_toy(recording, [20, 21])

    def make(**options) -> Summary:
        return convert(toy_arm, recording, BlockTokenizer(), out, **options)

    make()
    beside = {"README.md": "my notes", ".gitattributes": "*.parquet filter=lfs", ".DS_Store": "finder"}
    for name, text in beside.items():
        (out / name).write_text(text)
    (out / "train/.DS_Store").write_text("finder")
    assert make().made_shards == 0
    assert verify(out) == []
    write_toy(recording, [20, 21, 22])
    assert make(extend=True).made_shards == 1
    assert verify(out) == []
    merge([out], tmp_path / "merged")
    assert push_data(out, tmp_path / "pushed")
    (tmp_path / "pushed/.DS_Store").write_text("finder")
    (tmp_path / "pushed/val/.DS_Store").write_text("finder")
    assert push_data(out, tmp_path / "pushed")
    make(overwrite=True)
    assert {name: (out / name).read_text() for name in beside} == beside
    assert Manifest.load(out).splits["train"]["episodes"] + Manifest.load(out).splits["val"]["episodes"] == 3
    assert verify(out) == []


@pytest.mark.parametrize("options", [{}, {"extend": True}, {"overwrite": True}])
def test_a_foreign_file_in_a_set_is_named_and_kept(options, tmp_path, toy_arm) -> None:
    recording, out = tmp_path / "toy.hdf5", tmp_path / "out"
    write_toy(recording, [20, 21])
    convert(toy_arm, recording, BlockTokenizer(), out)
    (out / "thesis.tex").write_text("years of work")
    with pytest.raises(OutputError, match=r"holds what is not of a shard set: thesis\.tex — move it out"):
        convert(toy_arm, recording, BlockTokenizer(), out, **options)
    (out / "notes.txt").write_text("more")
    with pytest.raises(OutputError, match=r"holds what is not of a shard set: notes\.txt, thesis\.tex — "):
        convert(toy_arm, recording, BlockTokenizer(), out, **options)
    assert (out / "thesis.tex").read_text() == "years of work"
    assert (out / "manifest.json").is_file()
