"""`hma convert --to lerobot`: lerobot reads the frames and numbers that the shards of a recording hold."""

import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image

from hma_data.conversion import reading
from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings, read_clip
from hma_data.conversion.report import Summary
from hma_data.episodes.idle import idle_frames
from hma_data.episodes.images import prepare
from hma_data.errors import OutputError, ShardError, SourceError, UsageError
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import ShardSet
from hma_data.sources.base import open_source
from hma_data.sources.hdf5.source import Hdf5Source
from hma_data.tokenizers.base import get_tokenizer
from hma_model.cli import main
from tests.data import bag_files, rlds_files
from tests.data.cameras import arm as three_cameras
from tests.data.cameras import write_hdf5

SIZE = 128  # of raw-128, whose shards hold the pixels
SMALL = Settings(shard_frames=12)  # several parts


def smooth(length: int, height: int, width: int, seed: int = 0) -> np.ndarray:
    """Frames (T, H, W, 3) of soft colours that a codec keeps, each unlike the others."""
    down, across = np.mgrid[0:height, 0:width] * 90.0 / max(height, width)
    shade = np.stack([down + 40, across + 60, (down + across) / 2 + 30], axis=-1)
    steps = np.arange(length)[:, None, None, None]
    return (shade + 7 * steps + 11 * seed).clip(0, 255).astype(np.uint8)


def rlds(folder: Path) -> tuple[Path, Embodiment]:
    """Three episodes with words, one for validation; odd sides and a crop."""
    steps = {
        "observation": rlds_files.features_dict(
            {"image": rlds_files.image((33, 47, 3)), "state": rlds_files.tensor((3,))}
        ),
        "action": rlds_files.tensor((2,)),
        "language_instruction": rlds_files.TEXT,
    }

    def record(episode: int, length: int) -> dict:
        return {
            "steps/observation/image": [rlds_files.png(one) for one in smooth(length, 33, 47, episode)],
            "steps/observation/state": np.arange(length * 3, dtype=np.float32) / 9 + episode,
            "steps/action": np.sin(np.arange(length * 2, dtype=np.float32)) - episode,
            "steps/language_instruction": [f"lift é {episode}".encode()] * length,
            "episode_metadata/file_path": [b"here"],
        }

    shards = {
        "toy-train.tfrecord-00000-of-00001": [record(0, 9), record(1, 7)],
        "toy-val.tfrecord-00000-of-00001": [record(2, 8)],
    }
    robot = Embodiment.from_yaml(
        "id: words\nkind: real\nfrequency_hz: 5\ntarget_hz: 2.5\n"
        "action: {space: eef_delta, components: [{key: action, dims: 2, sign: -1}]}\n"
        "state: {components: [{key: observation/state, dims: 3}]}\n"
        "cameras: [{name: top, key: observation/image, crop: [3, 1, 40, 30], flip: horizontal}]\n"
        "source: {format: rlds, instruction: language_instruction}\n"
    )
    return rlds_files.write(folder / "toy" / "1.0.0", shards, steps), robot


def hdf5(folder: Path) -> tuple[Path, Embodiment]:
    return write_hdf5(folder / "three.hdf5"), three_cameras()


def bag(folder: Path) -> tuple[Path, Embodiment]:
    (folder / "bags").mkdir()
    for number in range(2):
        made = bag_files.make_recording(10 + number, seed=number)
        jitter = np.random.default_rng(number).integers(0, 9_000_000, 10 + number)
        made = replace(made, pictures=smooth(10 + number, 24, 32, number), stamp_shift_ns=jitter)
        bag_files.write_mcap(folder / "bags" / f"run_{number}.mcap", made, bag_files.as_cdr())
    return folder / "bags", bag_files.arm()


RECORDINGS = {"rlds": rlds, "hdf5": hdf5, "bag": bag}


def to_lerobot(robot: Embodiment, data: Path, out: Path, settings: Settings = SMALL, **options) -> Summary:
    return convert(robot, str(data), "fsq-16", out, settings=settings, to="lerobot", **options)


def opened(folder: Path) -> Any:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset("lab/robot", root=folder, video_backend="pyav")


def frame(item: dict, key: str) -> np.ndarray:
    return (item[key].numpy().transpose(1, 2, 0)[None] * 255).round().astype(np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize("kind, frames", [("hdf5", "all"), ("bag", "all"), ("rlds", "strided")])
def test_lerobot_reads_what_the_shards_hold(kind: str, frames: str, tmp_path: Path) -> None:
    data, robot = RECORDINGS[kind](tmp_path)
    summary = to_lerobot(robot, data, tmp_path / "out", replace(SMALL, frames=frames))
    shards = ShardSet(
        convert(
            robot, str(data), "raw-128", tmp_path / "shards", settings=Settings(frames, cameras=("all",))
        ).out
    )
    dataset, raw = opened(tmp_path / "out"), get_tokenizer("raw-128")
    own = Embodiment.load(tmp_path / "out" / "embodiment.yaml")
    cameras = {camera.name: camera for camera in own.cameras}
    listed = ShardSet(shards.folder).episodes.to_pylist()
    rows = dataset.meta.episodes
    assert len(listed) == dataset.meta.total_episodes == summary.manifest.to_json()["totals"]["episodes"]
    by_id = {row["id"]: row for row in listed}
    for place, row in enumerate(pq.read_table(tmp_path / "out/episodes.parquet").to_pylist()):
        assert row["episode_index"] == place
        held = by_id[row["id"]]
        start, stop = rows[place]["dataset_from_index"], rows[place]["dataset_to_index"]
        assert (row["row_start"], stop - start) == (start, held["rows"])
        values = shards.episode_rows(held["episode_index"], shards.columns())
        stated = dataset.hf_dataset["action"][start:stop]
        np.testing.assert_array_equal(np.stack(stated), values["action"])
        for at in (start, (start + stop) // 2, stop - 1):  # lerobot opens every video again for each row
            item = dataset[at]
            if "state" in values:
                np.testing.assert_array_equal(item["observation.state"].numpy(), values["state"][at - start])
            if "recorded_time" in item:
                assert item["recorded_time"].item() == pytest.approx(values["timestamp"][at - start])
            else:
                assert item["timestamp"].item() == pytest.approx(values["timestamp"][at - start], abs=1e-5)
            assert item["task"] == held["instruction"] == rows[place]["tasks"][0]
            for name, column in shards.manifest.layout.token_columns.items():
                seen = prepare(frame(item, cameras[name].key), cameras[name], SIZE)
                stored = raw.decode(shards.tokens(values[column])[at - start][None])
                assert np.abs(seen.astype(int) - stored).mean() < 3, (name, at)
    assert len({file.stat().st_mode for file in (tmp_path / "out").rglob("*.*") if file.is_file()}) == 1
    assert ("recorded_time" in dataset.features) == (kind == "bag" or frames == "strided")


@pytest.mark.slow
def test_the_dataset_converts_to_the_shards_of_its_recording(tmp_path: Path) -> None:
    data, robot = rlds(tmp_path)
    to_lerobot(robot, data, tmp_path / "out")
    own = Embodiment.load(tmp_path / "out" / "embodiment.yaml")
    folders = [tmp_path / "first", tmp_path / "second"]
    first, second = (
        ShardSet(convert(one, str(source), "raw-64", folder).out)
        for one, source, folder in zip((robot, own), (data, tmp_path / "out"), folders)
    )
    assert own.stride == robot.stride
    for one, other in zip(first.episodes.to_pylist(), second.episodes.to_pylist(), strict=True):
        assert (one["split"], one["instruction"], one["length"]) == (
            other["split"], other["instruction"], other["length"],
        )  # fmt: skip
        rows, again = (
            made.episode_rows(row["episode_index"], made.columns())
            for made, row in ((first, one), (second, other))
        )
        np.testing.assert_array_equal(rows["action"], again["action"])
        np.testing.assert_array_equal(rows["state"], again["state"])
        assert np.abs(rows["latents"].astype(int) - again["latents"]).mean() < 3


def test_no_sign_of_life_comes_from_an_episode_that_hangs(tmp_path: Path, monkeypatch) -> None:
    data, robot = hdf5(tmp_path)
    monkeypatch.setattr(reading, "SIGN_EVERY_S", 0.01)
    read, signs, heard = Hdf5Source.read, 0, []

    def slow(self, *words):
        before = signs
        time.sleep(0.3)
        heard.append(signs - before)
        return read(self, *words)

    def count(progress) -> None:
        nonlocal signs
        signs += 1

    monkeypatch.setattr(Hdf5Source, "read", slow)
    to_lerobot(robot, data, tmp_path / "out", replace(SMALL, limit=1), on_progress=count)
    assert signs and not any(heard)


@pytest.mark.slow
def test_a_full_disk_is_one_error_and_nothing_is_half_written(tmp_path: Path, monkeypatch) -> None:
    data, robot = hdf5(tmp_path)
    save, calls = Image.Image.save, 0

    def full(self, *words, **options):
        nonlocal calls
        calls += 1
        if calls > 80:
            raise OSError(28, "No space left on device")
        save(self, *words, **options)

    with monkeypatch.context() as context:
        context.setattr(Image.Image, "save", full)
        with pytest.raises(OutputError, match=r"No space left on device .* free space"):
            to_lerobot(robot, data, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert not list(tmp_path.glob(".out.parts/.*"))
    to_lerobot(robot, data, tmp_path / "out")
    assert len(opened(tmp_path / "out")) == 27


@pytest.mark.slow
def test_what_is_no_dataset_of_ours_is_left_alone(tmp_path: Path) -> None:
    data, robot = hdf5(tmp_path)
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("kept")
    for overwrite in (False, True):
        with pytest.raises(OutputError, match="holds something else"):
            to_lerobot(robot, data, out, overwrite=overwrite)
    assert (out / "mine.txt").read_text() == "kept"
    shutil.rmtree(out)
    to_lerobot(robot, data, out, replace(SMALL, limit=1))
    with pytest.raises(OutputError, match=r"--limit 1 there, None now.*--overwrite"):
        to_lerobot(robot, data, out)
    (out / "conversion.json").write_text("{")
    with pytest.raises(ShardError, match=r"conversion\.json: is damaged.*--overwrite"):
        to_lerobot(robot, data, out)
    to_lerobot(robot, data, out, overwrite=True)
    assert opened(out).meta.total_episodes == 3


@pytest.mark.slow
def test_a_first_episode_without_one_of_its_cameras_is_refused_alone(tmp_path: Path) -> None:
    data, robot = hdf5(tmp_path)
    with h5py.File(data, "a") as file:
        del file["data/demo_0/obs/wrist"]
        file["data/demo_0/obs/wrist"] = np.array([b"\xff\xd8 no image"] * 9)
    summary = to_lerobot(robot, data, tmp_path / "out")
    assert summary.manifest.quarantined == 1 and opened(tmp_path / "out").meta.total_episodes == 2


def test_without_a_usable_episode_nothing_is_written(tmp_path: Path) -> None:
    data, robot = hdf5(tmp_path)
    values = robot.to_dict() | {"sync": {"action_shift": 50}}
    with pytest.raises(SourceError):
        to_lerobot(Embodiment.from_values(values, "test"), data, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["three.hdf5"]


def test_a_store_and_an_extension_are_refused(tmp_path: Path) -> None:
    data, robot = hdf5(tmp_path)
    with pytest.raises(UsageError, match="is not a local folder"):
        to_lerobot(robot, data, "memory://somewhere/set")
    with pytest.raises(UsageError, match="--extend"):
        to_lerobot(robot, data, tmp_path / "out", extend=True)
    with pytest.raises(UsageError, match="--drop-idle"):
        convert(robot, str(data), "raw-64", tmp_path / "out", settings=Settings(drop_idle=True))


def test_a_tokenizer_for_frames_that_stay_as_they_are_is_refused(tmp_path, capsys) -> None:
    words = ["convert", "x.hdf5", "-e", "rails_03", "--to", "lerobot", "--out", str(tmp_path / "out")]
    assert main([*words, "--tokenizer", "fsq-lab"]) == 2
    assert "leave out --tokenizer and --weights" in capsys.readouterr().err


@pytest.mark.slow
def test_episodes_say_how_they_ended(tmp_path: Path) -> None:
    data, robot = hdf5(tmp_path)
    with h5py.File(data, "a") as file:
        for number, success in enumerate((True, False, True)):
            file[f"data/demo_{number}"].attrs["success"] = success
    to_lerobot(robot, data, tmp_path / "out")
    dataset = opened(tmp_path / "out")
    ends = dataset.meta.episodes["dataset_to_index"]
    said = [bool(dataset[row]["next.success"]) for row in range(len(dataset))]
    assert [row + 1 for row, success in enumerate(said) if success] == [ends[0], ends[2]]
    own = Embodiment.load(tmp_path / "out" / "embodiment.yaml")
    again = ShardSet(convert(own, str(tmp_path / "out"), "raw-64", tmp_path / "again").out)
    assert again.episodes["success"].to_pylist() == [True, False, True]


@pytest.mark.slow
def test_frames_in_which_nothing_moves_are_left_out_and_counted(tmp_path: Path) -> None:
    data, robot = hdf5(tmp_path)
    still = {0: [0, 1, 2], 1: [4], 2: [7, 8, 9]}  # of each episode: no command in these frames
    with h5py.File(data, "a") as file:
        for number, rows in still.items():
            actions = np.sin(np.arange(1, 40)).reshape(-1, 1)[: len(file[f"data/demo_{number}/actions"])]
            actions = np.repeat(actions, 2, axis=1).astype(np.float32)
            actions[rows] = 1e-4
            file[f"data/demo_{number}/actions"][...] = actions
    summary = to_lerobot(robot, data, tmp_path / "out", replace(SMALL, drop_idle=True))
    assert summary.flags["idle_frames"] == 2 + 1 + 3  # the first frame of an episode stays
    dataset = opened(tmp_path / "out")
    times = np.array([dataset[row]["recorded_time"].item() for row in range(7)])
    np.testing.assert_allclose(times, np.array([0, 3, 4, 5, 6, 7, 8]) / 10)
    assert len(dataset) == 27 - 6


@pytest.mark.parametrize("unit", ["m/s", "m"])  # a step of so many metres, repeated, is a motion too
def test_what_may_be_a_motion_in_a_mixed_space_moves_while_it_stays_the_same(tmp_path, unit) -> None:
    data, robot = hdf5(tmp_path)
    values = robot.to_dict()
    values["action"]["space"] = "mixed"
    for part in values["action"]["components"]:
        part["unit"] = unit
    with h5py.File(data, "a") as file:
        for demo in file["data"].values():
            demo["actions"][...] = 0.5
    mixed = Embodiment.from_values(values, "mixed")
    clip = read_clip(open_source("hdf5"), str(data), "demo_0", mixed, ["top"])
    assert not idle_frames(clip, mixed).any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tool", "words"),
    [
        (
            "train",
            "--dataset.repo_id=lab/robot --dataset.root={out} --dataset.video_backend=pyav --policy.type=act "
            "--policy.device=cpu --policy.push_to_hub=false --policy.pretrained_backbone_weights=null "
            "--policy.chunk_size=4 --policy.n_action_steps=4 --policy.dim_model=32 --policy.n_heads=2 "
            "--policy.dim_feedforward=32 --steps=2 --batch_size=2 --num_workers=0 --output_dir={made}",
        ),
        (
            "edit_dataset",
            "--repo_id=lab/robot --root={out} --new_repo_id=lab/less --new_root={made} "
            "--operation.type=delete_episodes --operation.episode_indices=[0]",
        ),
    ],
)
def test_tools_of_lerobot_take_the_dataset(tool: str, words: str, tmp_path: Path) -> None:
    data, robot = rlds(tmp_path)
    to_lerobot(robot, data, tmp_path / "out")
    made = tmp_path / "made"
    given = words.format(out=tmp_path / "out", made=made).split()
    done = subprocess.run(
        [sys.executable, "-m", f"lerobot.scripts.lerobot_{tool}", *given],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "HF_HUB_OFFLINE": "1"},
    )
    assert done.returncode == 0, done.stderr[-3000:]
    if tool == "train":
        assert list(made.rglob("model.safetensors"))
    else:
        assert opened(made).meta.total_episodes == 2
