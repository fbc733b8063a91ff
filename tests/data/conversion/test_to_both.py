"""`hma convert --lerobot`: one pass over a recording writes the shards and the dataset of two runs."""

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from hma_data.conversion.job import Conversion, convert
from hma_data.conversion.output import Share
from hma_data.conversion.plan import Settings
from hma_data.errors import OutputError, SourceError, UsageError
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.hdf5 import images
from tests.conftest import contents
from tests.data.conversion.test_to_lerobot import RECORDINGS, hdf5

BOTH = Settings(shard_frames=12, cameras=("all",), val_fraction=0.3)


def two_runs(
    robot: Embodiment, data: Path, folder: Path, settings: Settings = BOTH, tokenizer: str = "fsq-8"
) -> None:
    wide = {"settings": settings, "max_quarantine": 1}
    convert(robot, str(data), tokenizer, folder / "shards", **wide)
    convert(robot, str(data), tokenizer, folder / "set", to="lerobot", **wide)


def one_run(
    robot: Embodiment, data: Path, folder: Path, settings: Settings = BOTH, tokenizer: str = "fsq-8", **more
) -> None:
    options = {"settings": settings, "max_quarantine": 1, "lerobot": folder / "set", **more}
    convert(robot, str(data), tokenizer, folder / "shards", **options)


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind, frames, tokenizer",
    [("hdf5", "all", "fsq-8"), ("bag", "strided", "raw-64:antialias")],
)
def test_one_pass_writes_the_bytes_of_two_runs(kind, frames, tokenizer, tmp_path) -> None:
    data, robot = RECORDINGS[kind](tmp_path)
    settings = replace(BOTH, frames=frames)
    two_runs(robot, data, tmp_path / "two", settings, tokenizer)
    one_run(robot, data, tmp_path / "one", settings, tokenizer)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_every_frame_is_decoded_once(tmp_path: Path, monkeypatch) -> None:
    data, robot = hdf5(tmp_path)
    decoded: list[int] = []
    each = images.ImageRows.each

    def counted(self, indices, least=0):
        decoded.append(len(indices))
        return each(self, indices, least)

    monkeypatch.setattr(images.ImageRows, "each", counted)
    one_run(robot, data, tmp_path / "one", replace(BOTH, limit=2))
    assert sum(decoded) == 3 * (9 + 8) + 3  # the plan looks at a frame of each camera


@pytest.mark.slow
def test_each_output_refuses_its_own_episodes(tmp_path: Path) -> None:
    data, robot = hdf5(tmp_path)
    with h5py.File(data, "a") as file:
        file["data/demo_1/obs/side"][...] = 7  # one colour throughout
        del file["data/demo_2/obs/side"]
        # Shards have one size for all pictures, a dataset the size of its first episode.
        file["data/demo_2/obs/side"] = np.random.default_rng(0).integers(0, 255, (10, 20, 30, 3), np.uint8)
    values = robot.to_dict() | {"quality": {"blank": "refuse"}}
    robot = Embodiment.from_values(values, "test")
    two_runs(robot, data, tmp_path / "two")
    one_run(robot, data, tmp_path / "one", workers=2)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    refused = [(tmp_path / "one" / out / "quarantine.jsonl").read_text() for out in ("shards", "set")]
    assert [text.count("\n") for text in refused] == [1, 2]
    said = {line["id"]: line["message"] for line in map(json.loads, refused[1].splitlines())}
    assert "one colour throughout" in said["demo_1"]
    assert "30×20 pixels, the dataset's first episode 96×64" in said["demo_2"]
    assert json.loads((tmp_path / "one/set/meta/info.json").read_text())["total_frames"] == 9


@pytest.mark.slow
def test_a_dataset_is_added_to_shards_that_are_there_and_kept(tmp_path: Path) -> None:
    data, robot = hdf5(tmp_path)
    two_runs(robot, data, tmp_path / "two")
    convert(robot, str(data), "fsq-8", tmp_path / "one" / "shards", settings=BOTH)
    one_run(robot, data, tmp_path / "one")
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    own = "belongs to another conversion.* — choose another --out and another --lerobot, or --overwrite"
    with pytest.raises(OutputError, match=own):  # --extend, which adds episodes to shards, would be refused
        one_run(robot, data, tmp_path / "one", replace(BOTH, limit=1))
    one_run(robot, data, tmp_path / "one", replace(BOTH, limit=1), overwrite=True)
    assert len(list(tmp_path.glob("one/shards/*/*.parquet"))) == 1


@pytest.mark.slow
def test_without_a_usable_episode_neither_is_written(tmp_path: Path) -> None:
    data, robot = hdf5(tmp_path)
    values = robot.to_dict() | {"quality": {"blank": "refuse"}}
    with h5py.File(data, "a") as file:
        for demo in file["data"].values():
            demo["obs/side"][...] = 7
    with pytest.raises(SourceError, match="nothing was written"):
        one_run(Embodiment.from_values(values, "test"), data, tmp_path / "one")
    assert not list((tmp_path / "one").rglob("*"))


def test_what_a_dataset_beside_shards_cannot_have_is_refused_with_what_to_do(tmp_path: Path) -> None:
    data, robot = hdf5(tmp_path)
    beside = Conversion(robot, str(data), "fsq-8", tmp_path / "shards", lerobot=tmp_path / "set")
    with pytest.raises(UsageError, match="leave out --to lerobot"):
        replace(beside, to="lerobot")
    with pytest.raises(UsageError, match="--extend.*lerobot-edit-dataset merges"):
        replace(beside, extend=True)
    with pytest.raises(UsageError, match="--shard-index.*lerobot-edit-dataset merges"):
        beside.run_share(Share(0, 2))


@pytest.mark.parametrize("out, dataset", [("a", "a/b"), ("a/b", "a"), ("a", "b/../a")])
def test_one_folder_inside_the_other_is_refused_before_anything_is_written(out, dataset, tmp_path) -> None:
    data, robot = hdf5(tmp_path)
    with pytest.raises(UsageError, match="--lerobot: is .*inside the other — give two separate folders"):
        Conversion(robot, str(data), "fsq-8", tmp_path / out, lerobot=tmp_path / dataset)


def test_a_file_in_place_of_the_dataset_is_refused_before_the_work(tmp_path: Path) -> None:
    data, robot = hdf5(tmp_path)
    before = contents(tmp_path)
    with pytest.raises(OutputError, match="three.hdf5: holds something else — choose an empty or new folder"):
        convert(robot, str(data), "fsq-8", tmp_path / "shards", settings=BOTH, lerobot=data)
    assert contents(tmp_path) == before


def test_a_link_to_an_empty_folder_takes_the_dataset(tmp_path: Path) -> None:
    data, robot = hdf5(tmp_path)
    (tmp_path / "disk").mkdir()
    (tmp_path / "set").symlink_to(tmp_path / "disk")
    convert(robot, data, to="lerobot", tokenizer="", out=tmp_path / "set", settings=replace(BOTH, limit=1))
    assert (tmp_path / "set" / "meta" / "info.json").is_file() and (tmp_path / "set").is_symlink()
    assert not list(tmp_path.glob(".*"))
