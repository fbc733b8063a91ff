"""Which cameras and episodes are converted: each camera is a column; episodes by id, glob or file."""

import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest

from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings, read_clip
from hma_data.conversion.rewrite import merge, split
from hma_data.episodes.images import describe_resize, prepare
from hma_data.errors import OutputError, RegistryError, UsageError
from hma_data.registry.components import Camera
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.manifest import Manifest
from hma_data.shards.memmap import export
from hma_data.shards.preview import preview, tokenizer_of
from hma_data.shards.reader import EpisodeReader, ShardSet
from hma_data.shards.schema import read_footer
from hma_data.shards.verify import verify
from hma_data.sources.base import open_source
from hma_data.sources.common.choice import chosen_ids
from tests.command import fails, hma
from tests.conftest import ARM_YAML, BlockTokenizer, write_toy
from tests.data.cameras import LENGTHS, SIZES, arm, write_hdf5

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


def test_what_is_not_stored_is_told(recording: Path, tmp_path: Path) -> None:
    (tmp_path / "three_hdf5.yaml").write_text(arm().to_yaml())
    start = ("convert", "-e", tmp_path / "three_hdf5.yaml", "--source", recording, "--tokenizer", "fsq-8")
    line = "cameras: top; not stored: wrist, side (use --cameras all)"
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
    ("camera", "said"),
    [
        ({}, "640×480 → 256×256, 25 % of the width cropped; resize: letterbox keeps it"),
        ({"resize": "letterbox"}, "640×480 → 256×256, letterbox: 25 % of the height is black"),
        ({"resize": "stretch"}, "640×480 → 256×256, stretched by 1.33"),
        ({"crop": (80, 0, 480, 480)}, "640×480, crop 480×480 → 256×256"),
        ({"rotate": 90}, "640×480 → 256×256, 25 % of the height cropped; resize: letterbox keeps it"),
    ],
)
def test_what_becomes_of_a_picture_is_told(camera: dict, said: str) -> None:
    assert describe_resize(Camera(name="a", key="k", **camera), 480, 640, 256) == f"a: {said}"


IDS = ["day_1", "day_2", "night/1", "night/2", "take[1]"]


@pytest.mark.parametrize(
    ("only", "exclude", "left"),
    [
        ([], [], IDS),
        (["day_2"], [], ["day_2"]),
        (["day_*", "night/1"], ["*1"], ["day_2"]),
        ([], ["night*", "take[1]"], ["day_1", "day_2"]),
        (["?????"], [], ["day_1", "day_2"]),
    ],
)
def test_ids_and_globs_choose(only: list[str], exclude: list[str], left: list[str]) -> None:
    assert chosen_ids(IDS, only, exclude) == left


def test_a_file_names_ids_and_globs(tmp_path: Path) -> None:
    (tmp_path / "bad.txt").write_text("# too dark\nnight/*\n\nday_1\r\n")
    assert chosen_ids(IDS, [], [f"@{tmp_path}/bad.txt"]) == ["day_2", "take[1]"]
    (tmp_path / "bad.txt").write_text("day_1\nday_9\n")
    with pytest.raises(UsageError, match=r"--exclude: 'day_9' in line 2 of .*bad.txt matches no episode"):
        chosen_ids(IDS, [], [f"@{tmp_path}/bad.txt"])
    with pytest.raises(UsageError, match="none.txt cannot be read"):
        chosen_ids(IDS, ["@none.txt"], [])


@pytest.mark.parametrize(
    ("only", "exclude", "words"),
    [
        (["dya_1"], [], "--only: 'dya_1' matches no episode — did you mean 'day_1'?"),
        ([], ["evening*"], "--exclude: 'evening*' matches no episode — there are ids such as day_1, day_2"),
        (["day_1"], ["day_*"], "--exclude: leaves none of 5 episodes"),
    ],
)
def test_a_choice_that_matches_nothing_is_one_error(only: list[str], exclude: list[str], words: str) -> None:
    with pytest.raises(UsageError) as fault:
        chosen_ids(IDS, only, exclude)
    assert words in str(fault.value)


def run(robot: Embodiment, source: Path, out: Path, **settings):
    return convert(robot, source, BlockTokenizer(), out, settings=Settings(val_fraction=0, **settings))


def ids(folder: Path) -> list[str]:
    return sorted(ShardSet(folder).episodes["id"].to_pylist())


def test_command_and_yaml_choose_together(tmp_path, toy_recording) -> None:
    robot = Embodiment.from_yaml(ARM_YAML.replace("format: hdf5", "format: hdf5, exclude: [demo_1*]"))
    chosen = run(robot, toy_recording, tmp_path / "out", exclude=("demo_2",), limit=3)
    assert ids(tmp_path / "out") == ["demo_0", "demo_3", "demo_4"]
    assert chosen.left_out == 4
    assert verify(tmp_path / "out") == []
    with pytest.raises(RegistryError, match="nose.*top, side"):
        run(robot, toy_recording, tmp_path / "none", cameras=("nose",))
    with pytest.raises(RegistryError, match=r"embodiment toy_arm: source.only: 'demo_77' matches no episode"):
        wrong = Embodiment.from_yaml(ARM_YAML.replace("format: hdf5", "format: hdf5, only: [demo_77]"))
        run(wrong, toy_recording, tmp_path / "none")


def test_another_choice_is_another_plan_and_extend_adds_the_rest(tmp_path, toy_arm, toy_recording) -> None:
    first = run(toy_arm, toy_recording, tmp_path / "out", exclude=("demo_3", "demo_4"))
    again = run(toy_arm, toy_recording, tmp_path / "out", exclude=("demo_3", "demo_4"))
    assert (first.left_out, again.made_shards) == (2, 0)
    with pytest.raises(OutputError, match="--exclude demo_3, demo_4 there, demo_3 now"):
        run(toy_arm, toy_recording, tmp_path / "out", exclude=("demo_3",))
    settings = Settings(val_fraction=0)
    convert(toy_arm, toy_recording, BlockTokenizer(), tmp_path / "out", settings=settings, extend=True)
    assert len(ids(tmp_path / "out")) == 12


def test_a_set_of_chosen_episodes_can_be_split_and_merged(tmp_path, toy_arm, toy_recording) -> None:
    run(toy_arm, toy_recording, tmp_path / "a", only=("demo_1", "demo_2"))
    run(toy_arm, toy_recording, tmp_path / "b", exclude=("demo_1", "demo_2"))
    split(tmp_path / "a", tmp_path / "c", val_fraction=0.5)
    merge([tmp_path / "a", tmp_path / "b"], tmp_path / "d")
    assert ids(tmp_path / "c") == ["demo_1", "demo_2"]
    assert len(ids(tmp_path / "d")) == 12
    assert verify(tmp_path / "c") == verify(tmp_path / "d") == []
    shown = preview(tmp_path / "d", tmp_path / "p", tokenizer=BlockTokenizer(), only=["demo_1*"], frames=1)
    assert shown.episodes == ("demo_1", "demo_10", "demo_11")


def test_a_plan_without_a_choice_states_none(tmp_path, toy_arm, toy_recording) -> None:
    (tmp_path / "bad.txt").write_text("demo_1\n")
    run(toy_arm, toy_recording, tmp_path / "a")
    run(toy_arm, toy_recording, tmp_path / "b", exclude=(f"@{tmp_path}/bad.txt", "demo_2"))
    plain, chosen = (ShardSet(tmp_path / name).manifest.plan for name in "ab")
    assert list(plain["settings"]) == ["frames", "cameras", "val_fraction", "seed", "limit", "shard_frames"]
    assert chosen["settings"]["exclude"] == ["@bad.txt", "demo_2"]
    assert plain["hash"] != chosen["hash"]


def test_the_command_counts_what_it_leaves_out(tmp_path, toy_yaml) -> None:
    write_toy(tmp_path / "toy.hdf5", [8, 8, 8, 8])
    words = ["convert", "-e", toy_yaml, "--source", tmp_path / "toy.hdf5", "--tokenizer", "fsq-8"]
    words += ["--out", tmp_path / "out", "--workers", "0"]
    planned = hma(*words, "--dry-run", "--exclude", "demo_0", "--exclude", "demo_2")
    assert "2 episodes, about 16 recorded frames" in planned.stdout
    assert "left out by only and exclude: 2 episodes" in planned.stdout
    done = hma(*words, "--json", "--only", "demo_[12]", "--exclude", "demo_1")
    assert (json.loads(done.stdout)["episodes"], json.loads(done.stdout)["left_out"]) == (1, 3)
    fails(hma(*words, "--dry-run", "--only", "demo_9"), 2, "--only: 'demo_9' matches no episode", "demo_")


def test_inspect_and_doctor_take_the_episodes_that_a_yaml_chooses(toy_yaml, toy_recording) -> None:
    toy_yaml.write_text(ARM_YAML.replace("format: hdf5", "format: hdf5, only: [demo_5]"))
    report = json.loads(hma("inspect", toy_recording, "-e", toy_yaml, "--json").stdout)
    assert report["embodiment"]["first episode"].startswith("demo_5:")


def test_a_recording_whose_name_is_not_utf8_is_refused_before_the_work(tmp_path, toy_yaml, toy_recording):
    """Neither a YAML nor a shard can state such a name."""
    odd = tmp_path / os.fsdecode(b"r\xe9c.hdf5")
    try:
        toy_recording.rename(odd)
    except OSError:
        pytest.skip("this file system takes UTF-8 names only")
    words = [r"r\udce9c.hdf5: its name is not UTF-8 text — rename it"]
    fails(hma("registry", "infer", odd, "--id", "mine", "--out", tmp_path / "mine.yaml"), 1, *words)
    assert not (tmp_path / "mine.yaml").exists()
    start = ("convert", "-e", toy_yaml, "--tokenizer", "fsq-8")
    fails(hma(*start, "--source", odd, "--out", tmp_path / "out"), 1, *words)
    assert not (tmp_path / "out").exists()
