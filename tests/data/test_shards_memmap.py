"""Flat files in the layout of the paper's code: out, and back without loss."""

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pytest

from hma_data.convert import convert
from hma_data.embodiment import Embodiment
from hma_data.errors import HMAError, OutputError, ShardError, UsageError
from hma_data.plan import Settings
from hma_data.shards.memmap import export
from hma_data.shards.memmap_import import import_memmap
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.tokenizers.base import TokenizerSpec
from tests.conftest import ARM_YAML, BlockTokenizer, write_toy
from tests.data.test_shards_remake import episodes

SMALL = Settings(val_fraction=0.3, shard_frames=40, cameras=("top", "side"))


class HalfTokenizer:
    """Continuous latents for tests: the mean colour of 8×8 blocks."""

    spec = TokenizerSpec("half", 1, "continuous", 64, (8, 8), channels=3, dtype="float16")

    def encode(self, frames):
        blocks = frames.reshape(-1, 8, 8, 8, 8, 3).astype(np.float32).mean(axis=(2, 4))
        return (blocks / 255).transpose(0, 3, 1, 2).astype(np.float16)

    def decode(self, tokens):
        return np.repeat(np.repeat((tokens.transpose(0, 2, 3, 1) * 255).astype(np.uint8), 8, 1), 8, 2)


class PixelTokenizer:
    """Pixels, small."""

    spec = TokenizerSpec("pixels", 1, "continuous", 64, (64, 64), channels=3, dtype="uint8")

    def encode(self, frames):
        return np.ascontiguousarray(frames.transpose(0, 3, 1, 2))

    def decode(self, tokens):
        return np.ascontiguousarray(tokens.transpose(0, 2, 3, 1))


def make(folder: Path, tokenizer=None, settings: Settings = SMALL, lengths=(14, 15, 16, 17)) -> Path:
    write_toy(folder.with_suffix(".hdf5"), lengths)
    arm = Embodiment.from_yaml(ARM_YAML)
    convert(arm, str(folder.with_suffix(".hdf5")), tokenizer or BlockTokenizer(), folder, settings=settings)
    return folder


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


@pytest.mark.parametrize("tokenizer", [BlockTokenizer(), HalfTokenizer(), PixelTokenizer()])
@pytest.mark.parametrize("frames", ["all", "strided"])
def test_out_and_back_is_the_same(tmp_path: Path, tokenizer, frames: str) -> None:
    made = make(tmp_path / "set", tokenizer, Settings(val_fraction=0.3, frames=frames))
    export(made, tmp_path / "out")
    import_memmap(tmp_path / "out", tmp_path / "back")
    assert verify(tmp_path / "back") == []
    before, after = ShardSet(made), ShardSet(tmp_path / "back")
    assert after.episodes.drop(["shard"]).equals(before.episodes.drop(["shard"]))
    for index in before.episodes["episode_index"].to_pylist():
        mine, theirs = (s.episode_rows(index, s.columns()) for s in (before, after))
        for name in mine:
            np.testing.assert_array_equal(mine[name], theirs[name])
    if frames == "all":  # a strided set's statistics know the steps after an episode's last row too
        assert after.manifest.stats["action"]["mean"] == pytest.approx(
            before.manifest.stats["action"]["mean"]
        )


def test_the_second_camera_can_be_exported(made: Path, tmp_path: Path) -> None:
    export(made, tmp_path / "out", camera="side", split="val")
    shards = ShardSet(made)
    row = shards.episodes.filter(pc.equal(shards.episodes["split"], "val")).to_pylist()[0]
    values = shards.episode_rows(row["episode_index"], ["tokens"])["tokens"]
    video = np.fromfile(tmp_path / "out" / "video.bin", np.uint32).reshape(-1, 64)
    np.testing.assert_array_equal(video[: row["length"]], values[row["length"] :])


def plain(folder: Path) -> Path:
    """What the paper's code would have written: nothing of ours."""
    for place in folder.iterdir():
        shutil.rmtree(place / "hma")
        values = json.loads((place / "metadata.json").read_text())
        for name in ("stride", "camera", "frames", "source", "tokenizer"):
            values.pop(name)
        (place / "metadata.json").write_text(json.dumps(values))
        place.rename(place.with_name(f"toy_arm_magvit_max1_{place.name}"))
    return folder


def test_a_folder_of_the_papers_code_is_imported(made: Path, tmp_path: Path, toy_arm) -> None:
    export(made, tmp_path / "out")
    folder = plain(tmp_path / "out")
    with pytest.raises(UsageError, match="embodiment"):
        import_memmap(folder, tmp_path / "back")
    with pytest.raises(UsageError, match="tokenizer"):
        import_memmap(folder, tmp_path / "back", embodiment=toy_arm)
    import_memmap(folder, tmp_path / "back", embodiment=toy_arm, tokenizer=BlockTokenizer.spec)
    assert verify(tmp_path / "back") == []
    stored = {values[2] for values in episodes(tmp_path / "back").values()}
    shards = ShardSet(made)
    for row in shards.episodes.to_pylist():
        tokens = shards.episode_rows(row["episode_index"], ["tokens"])["tokens"][: row["length"]]
        assert tokens.tobytes() in stored


DAMAGE = {
    "bytes": lambda p: (p / "video.bin").write_bytes((p / "video.bin").read_bytes()[:-3]),
    "segment_ids.bin": lambda p: (p / "segment_ids.bin").unlink(),
    "actions": lambda p: (p / "actions" / "actions.bin").unlink(),
    "go back": lambda p: (p / "segment_ids.bin").write_bytes((p / "segment_ids.bin").read_bytes()[::-1]),
    "metadata.json": lambda p: (p / "metadata.json").write_text("[]"),
    "num_images": lambda p: (p / "metadata.json").write_text('{"num_images": -1}'),
    "does not fit": lambda p: (p / "segment_ids.bin").write_bytes(
        bytes(len((p / "segment_ids.bin").read_bytes()))
    ),
}


@pytest.mark.parametrize("said", DAMAGE)
def test_damaged_flat_files_are_one_clear_error(made: Path, tmp_path: Path, said: str) -> None:
    export(made, tmp_path / "out", split="train")
    DAMAGE[said](tmp_path / "out")
    with pytest.raises(ShardError, match=said):
        import_memmap(tmp_path / "out", tmp_path / "back")
    assert not (tmp_path / "back").exists()


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
