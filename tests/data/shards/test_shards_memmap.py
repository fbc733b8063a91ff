"""Flat files in the layout of the paper's code: they hold everything that a shard set holds."""

import json
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from hma_data.conversion.plan import Settings
from hma_data.errors import HMAError, OutputError, UsageError
from hma_data.shards.memmap import export, video_dtype
from hma_data.shards.reader import ShardSet
from hma_data.shards.schema import token_column
from hma_data.tokenizers.base import get_tokenizer
from tests.conftest import ARM_YAML, toy_shards

SMALL = Settings(val_fraction=0.3, shard_frames=40, cameras=("top", "side"))


def make(folder: Path, tokenizer=None, settings: Settings = SMALL, yaml: str = ARM_YAML) -> Path:
    return toy_shards(folder, (14, 15, 16, 17), settings, yaml, tokenizer=tokenizer)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("made") / "set")


def test_the_files_are_those_of_the_papers_code(made: Path, tmp_path: Path) -> None:
    """dtypes and shapes as liruiw/HMA writes them: encode_openx_dataset.py, end of `encode_dataset`."""
    export(made, tmp_path / "out")
    shards = ShardSet(made)
    for split in ("train", "val"):
        place = tmp_path / "out" / split
        metadata = json.loads((place / "metadata.json").read_text())
        n = metadata["num_images"]
        assert n == shards.manifest.splits[split]["frames"]
        assert metadata["token_dtype"] == "uint32"
        assert {"s", "hz", "vocab_size", "encoder_name_or_path", "encoder_type", "name"} < metadata.keys()
        assert {"latent_channels", "quantized", "action_dim", "h", "w"} < metadata.keys()
        video = np.memmap(place / "video.bin", np.uint32, "r", shape=(n, metadata["h"], metadata["w"]))
        actions = np.memmap(place / "actions" / "actions.bin", np.float32, "r").reshape(n, -1)
        segments = np.memmap(place / "segment_ids.bin", np.int32, "r", shape=(n,))
        assert actions.shape[1] == metadata["action_dim"] == 3
        assert [path.name for path in (place / "actions").iterdir()] == ["actions.bin"]
        assert (np.diff(segments) >= 0).all()
        table = shards.episodes.filter(pc.equal(shards.episodes["split"], split)).to_pylist()
        for number, row in enumerate(table):
            values = shards.episode_rows(row["episode_index"], ["tokens", "action"])
            own = segments == number
            np.testing.assert_array_equal(video[own].reshape(-1, 64), values["tokens"][: row["length"]])
            np.testing.assert_array_equal(actions[own], values["action"][: row["length"]])


@pytest.mark.parametrize("name", ["fsq-8", "vae-8", "raw-64"])
@pytest.mark.parametrize("frames", ["all", "strided"])
def test_the_files_hold_every_column_of_every_episode(tmp_path: Path, name: str, frames: str) -> None:
    made = make(
        tmp_path / "set",
        get_tokenizer(name),
        Settings(val_fraction=0.3, frames=frames),
        yaml=ARM_YAML + "sync: {beyond: mask, max_skew_ms: 50}\n",
    )
    export(made, tmp_path / "out")
    shards = ShardSet(made)
    tokens = token_column(shards.spec)[0]
    for row in shards.episodes.to_pylist():
        place = tmp_path / "out" / row["split"]
        table = pq.read_table(place / "hma" / "episodes.parquet")
        own = np.fromfile(place / "segment_ids.bin", "<i4") == table["id"].to_pylist().index(row["id"])
        values = shards.episode_rows(row["episode_index"], shards.columns())
        for column, path, dtype in (
            (tokens, "video.bin", video_dtype(shards.spec)),
            ("action", "actions/actions.bin", "<f4"),
            ("timestamp", "hma/timestamp.bin", "<f8"),
            ("action_known", "hma/action_known.bin", "|b1"),
        ):
            flat = np.fromfile(place / path, dtype).reshape(len(own), -1)[own]
            stored = values[column].reshape(len(flat), -1)
            if name == "raw-64" and column == tokens:  # colour last
                flat = flat.reshape(-1, 64, 64, 3).transpose(0, 3, 1, 2).reshape(stored.shape)
            np.testing.assert_array_equal(flat, stored)


def test_the_second_camera_can_be_exported(made: Path, tmp_path: Path) -> None:
    export(made, tmp_path / "out", camera="side", split="val")
    shards = ShardSet(made)
    row = shards.episodes.filter(pc.equal(shards.episodes["split"], "val")).to_pylist()[0]
    values = shards.episode_rows(row["episode_index"], ["tokens_side"])["tokens_side"]
    video = np.fromfile(tmp_path / "out" / "video.bin", np.uint32).reshape(-1, 64)
    np.testing.assert_array_equal(video[: row["length"]], values)


def test_export_refuses_what_is_there_and_leaves_nothing_half_done(made: Path, tmp_path: Path) -> None:
    (tmp_path / "out" / "train").mkdir(parents=True)
    (tmp_path / "out" / "train" / "mine.txt").write_text("mine")
    with pytest.raises(OutputError, match="already"):
        export(made, tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").rglob("*")] == ["train", "mine.txt"]
    with pytest.raises(UsageError, match="camera"):
        export(made, tmp_path / "other", camera="nose")
    damaged = ShardSet(made).folder / "val" / "shard-00000.parquet"
    whole = damaged.read_bytes()
    try:
        damaged.write_bytes(whole[: len(whole) // 2])
        with pytest.raises(HMAError):
            export(made, tmp_path / "third", split="val")
    finally:
        damaged.write_bytes(whole)
    assert not (tmp_path / "third").exists()
    assert not list(tmp_path.glob(".*part"))
