"""Several cameras: each is a column of the same rows, and says what its own conversion would say."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest

from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings, read_clip
from hma_data.episodes.images import describe_resize, prepare
from hma_data.errors import RegistryError
from hma_data.registry.components import Camera
from hma_data.shards.manifest import Manifest
from hma_data.shards.memmap import export
from hma_data.shards.preview import preview, tokenizer_of
from hma_data.shards.reader import EpisodeReader, ShardSet
from hma_data.shards.schema import read_footer
from hma_data.shards.verify import verify
from hma_data.sources.base import open_source
from tests.command import hma
from tests.conftest import BlockTokenizer, write_toy
from tests.data.cameras import LENGTHS, SIZES, arm, write_dataset, write_hdf5

ONE_CAMERA = Path(__file__).parents[1] / "shards" / "one_camera"  # written from `write_toy`
EVERY = Settings(val_fraction=0.3, cameras=("all",))


def frames(folder: Path, camera: str) -> list[np.ndarray]:
    shards = ShardSet(folder)
    reader = EpisodeReader(shards, shards.columns())
    episodes = [reader.episode(row, camera) for row in shards.episodes.to_pylist()]
    return [BlockTokenizer().decode(shards.tokens(values["tokens"])) for values in episodes]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_hdf5(tmp_path_factory.mktemp("three") / "three.hdf5")


@pytest.fixture(scope="module")
def made(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "set"
    convert(arm(), recording, BlockTokenizer(), out, settings=EVERY)
    return out


def test_each_camera_is_a_column_of_what_it_would_be_alone(made, recording, tmp_path) -> None:
    assert verify(made) == []
    shards = ShardSet(made)
    assert shards.manifest.cameras == list(SIZES)
    columns = pq.read_schema(made / "train/shard-00000.parquet").names
    assert columns[3:7] == ["tokens", "tokens_wrist", "tokens_side", "action"]
    rows = [row["rows"] for row in shards.episodes.to_pylist()]
    assert rows == list(LENGTHS)
    for camera in SIZES:
        alone = tmp_path / camera
        convert(arm(), recording, BlockTokenizer(), alone, settings=replace(EVERY, cameras=(camera,)))
        assert pq.read_schema(alone / "train/shard-00000.parquet").names[3:] == ["tokens", "action"]
        for ours, theirs in zip(frames(made, camera), frames(alone, camera), strict=True):
            np.testing.assert_array_equal(ours, theirs)
        assert ShardSet(alone).manifest.stats == shards.manifest.stats  # actions count once


def test_a_set_of_another_filter_holds_its_pictures_and_opens_with_it(recording, tmp_path) -> None:
    out, settings = tmp_path / "set", Settings(cameras=("wrist",))
    convert(arm(), recording, "raw-64:antialias", out, settings=settings, workers=0)
    assert verify(out) == []
    shards = ShardSet(out)
    assert tokenizer_of(shards).spec == shards.spec and shards.spec.resize_filter == "antialias"
    row = shards.episodes.to_pylist()[0]
    clip = read_clip(open_source("hdf5"), str(recording), row["id"], arm(), ("wrist",))
    raw = clip.frames_at("wrist", np.arange(len(clip)))
    expected = prepare(raw, arm().camera("wrist"), 64, "antialias").transpose(0, 3, 1, 2)
    stored = EpisodeReader(shards, shards.columns()).episode(row, "wrist")
    assert np.array_equal(np.asarray(stored["latents"]).reshape(expected.shape), expected)


@pytest.mark.slow
def test_the_cameras_of_a_lerobot_dataset_too(made: Path, tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "dataset")
    convert(arm("lerobot"), folder, BlockTokenizer(), tmp_path / "set", settings=EVERY)
    assert verify(tmp_path / "set") == []
    for camera in SIZES:
        for ours, theirs in zip(frames(tmp_path / "set", camera), frames(made, camera), strict=True):
            assert np.abs(ours.astype(int) - theirs).mean() < 6  # the videos are lossy


def test_what_is_not_stored_is_told(recording: Path, tmp_path: Path) -> None:
    (tmp_path / "three_hdf5.yaml").write_text(arm().to_yaml())
    start = ("convert", "-e", tmp_path / "three_hdf5.yaml", "--source", recording, "--tokenizer", "fsq-8")
    line = "cameras: top; not stored: wrist, side (use --cameras all)"
    planned = hma(*start, "--out", tmp_path / "set", "--dry-run").stdout
    assert line in planned.splitlines()
    assert "top: 64×64 → 128×128" in planned.splitlines()
    planned = hma(*start, "--out", tmp_path / "set", "--dry-run", "--cameras", "side,top").stdout
    assert "cameras: side, top; not stored: wrist (use --cameras all)" in planned.splitlines()
    cropped = "side: 96×64 → 128×128, 33 % of the width cropped; resize: letterbox keeps it"
    assert cropped in planned.splitlines()
    done = hma(*start, "--out", tmp_path / "set", "--workers", "0", "--limit", "2").stdout
    assert {line, "top: 64×64 → 128×128"} <= set(done.splitlines())
    assert line in hma("shards", "info", tmp_path / "set").stdout.splitlines()
    assert json.loads((tmp_path / "set/manifest.json").read_text())["cameras"] == line[9:]


def test_a_camera_that_an_episode_lacks_is_named(tmp_path: Path) -> None:
    recording = write_hdf5(tmp_path / "three.hdf5")
    with h5py.File(recording, "a") as file:
        del file["data/demo_1/obs/wrist"]
    summary = convert(arm(), recording, BlockTokenizer(), tmp_path / "all", settings=EVERY)
    (reason,) = summary.reasons
    assert "demo_1: camera wrist cannot be read" in reason
    assert "--cameras top,side leaves wrist out" in reason
    for cameras in (("top", "side"), ()):  # a camera that is not stored refuses no episode
        settings = replace(EVERY, cameras=cameras)
        out = tmp_path / "-".join(("out", *cameras))
        assert not convert(arm(), recording, BlockTokenizer(), out, settings=settings).reasons


def test_an_unknown_camera_is_refused(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(RegistryError, match="nose.*top, wrist, side"):
        convert(arm(), recording, BlockTokenizer(), tmp_path / "x", settings=Settings(cameras=("nose",)))


def test_a_damaged_token_of_a_further_camera_is_found(recording: Path, tmp_path: Path) -> None:
    class Wild(BlockTokenizer):
        def encode(self, frames: np.ndarray) -> np.ndarray:
            return super().encode(frames) + 4096 * (frames[:, 0, 0, 0] == 17 * 5)[:, None, None]  # wrist

    out = tmp_path / "set"
    convert(arm(), recording, Wild(), out, settings=EVERY)
    assert any("in tokens_wrist, the vocabulary ends" in problem for problem in verify(out))


def test_preview_and_export_show_the_cameras(made: Path, tmp_path: Path) -> None:
    shown = preview(made, tmp_path / "seen", episodes=1, columns=3, tokenizer=BlockTokenizer())
    assert shown.resized[2].startswith("side: 96×64 → 64×64, 33 %")
    sheet = cv2.imread(str(shown.sheet))[..., ::-1].astype(int)
    reds = [sheet[18 + row * 166 + 72, 4 + 72, 0] for row in range(1, 6, 2)]  # decoded, below the recorded
    assert reds == [17, 17 * 5, 17 * 9]
    export(made, tmp_path / "flat", camera="wrist", split="train")
    video = np.fromfile(tmp_path / "flat/video.bin", np.uint32)
    assert set((video % 16).tolist()) == {5}
    assert json.loads((tmp_path / "flat/metadata.json").read_text())["camera"] == "wrist"


def test_a_set_of_one_camera_has_the_rows_that_it_had(toy_arm, block_tokenizer, tmp_path) -> None:
    write_toy(tmp_path / "toy.hdf5", [9, 11, 10])
    out = tmp_path / "set"
    convert(toy_arm, tmp_path / "toy.hdf5", block_tokenizer, out, settings=Settings(val_fraction=0.3))
    for shard in Manifest.load(ONE_CAMERA).shards:  # their bytes differ only with another pyarrow
        ours, theirs = pq.read_table(out / shard.path), pq.read_table(ONE_CAMERA / shard.path)
        assert ours.equals(theirs)
        plans = [read_footer(folder / shard.path)[0].plan for folder in (out, ONE_CAMERA)]
        for plan in plans:
            del plan["recording"], plan["hash"]  # of the file's bytes
        assert plans[0] == plans[1]


@pytest.mark.parametrize(
    ("rule", "said"),
    [
        ("short_side_crop", "a: 640×480 → 256×256, 25 % of the width cropped; resize: letterbox keeps it"),
        ("letterbox", "a: 640×480 → 256×256, letterbox: 25 % of the height is black"),
        ("stretch", "a: 640×480 → 256×256, stretched by 1.33"),
    ],
)
def test_what_becomes_of_a_picture_is_told(rule: str, said: str) -> None:
    assert describe_resize(Camera(name="a", key="k", resize=rule), 480, 640, 256) == said
    cropped = Camera(name="a", key="k", crop=(80, 0, 480, 480))
    assert describe_resize(cropped, 480, 640, 256) == "a: 640×480, crop 480×480 → 256×256"
    wide = describe_resize(Camera(name="a", key="k", rotate=90), 1080, 1920, 256)
    assert wide == "a: 1920×1080 → 256×256, 44 % of the height cropped; resize: letterbox keeps it"
