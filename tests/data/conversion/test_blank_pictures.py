"""Black, frozen and repeating cameras: refused or flagged at conversion, and reported by doctor."""

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from skimage import data as skimage_data

from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.conversion.report import Summary
from hma_data.episodes.images import PictureCheck, resize
from hma_data.errors import SourceError
from hma_data.inspection.inspect import examine
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import ShardSet
from tests.command import hma
from tests.conftest import ARM_YAML, problems
from tests.data import bag_files, videos
from tests.data.sources.lerobot.test_lerobot import embodiment as lerobot_arm

KINDS = ("good", "black", "frozen", "repeated")
LENGTH = 24
NO_LIMIT = {"max_quarantine": 1.0, "settings": Settings(val_fraction=0.0)}


def pictures(kind: str, height: int = videos.HEIGHT, width: int = videos.WIDTH) -> np.ndarray:
    """(T, H, W, 3): a square that moves, stands still or moves every third picture; or a covered sensor."""
    if kind == "black":
        noise = np.random.default_rng(0).normal(0, 3, (LENGTH, height, width, 3))
        return np.clip(noise, 0, 255).astype(np.uint8)
    frames = np.broadcast_to(np.linspace(40, 120, width, dtype=np.uint8)[:, None], (LENGTH, height, width, 3))
    frames = frames.copy()
    for i, frame in enumerate(frames):
        left = 2 * {"good": i, "frozen": 0, "repeated": i // 3 * 3}[kind]
        frame[height // 4 : height // 2, left : left + 20] = (250, 200, 30)
    return frames


def write_hdf5(path: Path, episodes: dict[str, np.ndarray], side: str = "good") -> Path:
    with h5py.File(path, "w") as file:
        for name, frames in episodes.items():
            group = file.create_group(f"data/{name}")
            draw = np.random.default_rng(len(name))
            group["actions"] = draw.normal(size=(len(frames), 3)).astype(np.float32)
            group["obs/image"] = frames
            group["obs/side"] = pictures(side)[: len(frames)]
    return path


def as_hdf5(folder: Path) -> tuple[Embodiment, Path, dict[str, str]]:
    path = write_hdf5(folder / "toy.hdf5", {kind: pictures(kind) for kind in KINDS})
    return Embodiment.from_yaml(ARM_YAML), path, {kind: kind for kind in KINDS}


def as_lerobot(folder: Path) -> tuple[Embodiment, Path, dict[str, str]]:
    videos.make_v2(folder / "set", [LENGTH] * len(KINDS))
    for number, kind in enumerate(KINDS):
        path = folder / f"set/videos/chunk-000/{videos.CAMERA}/episode_{number:06d}.mp4"
        videos.encode(path, range(LENGTH), gop=LENGTH, b_frames=0, draw=pictures(kind).__getitem__)
    cameras = [{"name": "top", "key": videos.CAMERA}]
    robot = Embodiment.from_values(lerobot_arm().to_dict() | {"cameras": cameras}, "")
    return robot, folder / "set", {kind: str(i) for i, kind in enumerate(KINDS)}


def as_bags(folder: Path) -> tuple[Embodiment, Path, dict[str, str]]:
    recording = bag_files.make_recording(LENGTH)
    for kind in KINDS:
        (folder / "bags" / kind).mkdir(parents=True)
        changed = replace(recording, pictures=pictures(kind, 48, 72))
        bag_files.write_mcap(folder / "bags" / kind / "run.mcap", changed, bag_files.as_cdr())
    return bag_files.arm(front="top"), folder / "bags", {kind: kind for kind in KINDS}


@pytest.mark.parametrize("made", [as_hdf5, as_lerobot, as_bags])
def test_a_black_camera_is_refused_and_a_frozen_or_repeating_one_is_flagged(made, tmp_path, block_tokenizer):
    robot, source, ids = made(tmp_path)
    summary = convert(robot, source, block_tokenizer, tmp_path / "out", **NO_LIMIT)
    (refused,) = ShardSet(tmp_path / "out").refused()
    assert ids["black"] in refused["id"]
    assert "camera top shows one colour throughout" in refused["message"]
    flags = {row["id"]: row["flags"] for row in ShardSet(tmp_path / "out").episodes.to_pylist()}
    words = {
        kind: next(text for name, text in flags.items() if ids[kind] in name)
        for kind in ids.keys() - {"black"}
    }
    assert words["good"] == ""
    assert words["frozen"].startswith("still_pictures:top=2")
    assert words["repeated"].startswith("repeated_pictures:top=1")
    assert set(summary.flags) == {"still_pictures:top", "repeated_pictures:top"}


def converted(folder: Path, episodes: dict[str, np.ndarray], quality: str, tokenizer) -> Summary:
    path = write_hdf5(folder / "toy.hdf5", episodes)
    robot = Embodiment.from_yaml(f"{ARM_YAML}\nquality: {quality}")
    return convert(robot, path, tokenizer, folder / "out", **NO_LIMIT)


def test_the_yaml_chooses_between_refusing_and_flagging(tmp_path, block_tokenizer) -> None:
    episodes = {kind: pictures(kind) for kind in KINDS}
    rule = "{blank: flag, still: refuse, repeated: refuse, repeated_share: 0.6}"
    summary = converted(tmp_path, episodes, rule, block_tokenizer)
    assert summary.flags == {"blank_pictures:top": LENGTH}
    assert {item["id"] for item in ShardSet(tmp_path / "out").refused()} == {"frozen", "repeated"}
    assert "keeps such episodes" in next(iter(summary.reasons))


def test_a_share_of_repeated_pictures_below_the_limit_passes_and_doctor_says_nothing(
    tmp_path, block_tokenizer
) -> None:
    summary = converted(tmp_path, {"a": pictures("repeated")}, "{repeated_share: 0.7}", block_tokenizer)
    assert summary.flags == {}
    assert not [one for one in examine(tmp_path / "out") if one.check in ("blank", "still")]


def test_a_second_camera_counts_where_it_is_converted(tmp_path, block_tokenizer) -> None:
    path = write_hdf5(tmp_path / "toy.hdf5", {"a": pictures("good"), "b": pictures("black")})
    robot = Embodiment.from_yaml(ARM_YAML)
    for cameras, refused in ((("side",), []), (("side", "top"), ["b"])):
        out = tmp_path / "-".join(cameras)
        settings = Settings(cameras=cameras, val_fraction=0)
        convert(robot, path, block_tokenizer, out, settings=settings, max_quarantine=1.0)
        assert [item["id"] for item in ShardSet(out).refused()] == refused


def test_a_recording_that_is_black_throughout_is_one_error(tmp_path, block_tokenizer) -> None:
    with pytest.raises(SourceError, match="2 × <episode>: camera top shows one colour throughout"):
        converted(tmp_path, {"a_1": pictures("black"), "b_2": pictures("black")}, "{}", block_tokenizer)


def test_the_rule_belongs_to_the_snapshot_only_where_it_is_set() -> None:
    plain = Embodiment.from_yaml(ARM_YAML)
    same = Embodiment.from_yaml(f"{ARM_YAML}\nquality: {{blank: refuse}}")
    other = Embodiment.from_yaml(f"{ARM_YAML}\nquality: {{still: refuse}}")
    assert (plain.digest, plain.to_yaml()) == (same.digest, same.to_yaml())
    assert plain.digest != other.digest
    assert "quality" not in plain.to_yaml()


def test_a_wrong_word_in_the_rule_names_what_is_allowed() -> None:
    (problem,) = problems(Embodiment.from_yaml(ARM_YAML).to_dict() | {"quality": {"blank": "keep"}})
    assert problem.startswith("quality.blank")
    assert "'refuse' or 'flag'" in problem


def check(frames: np.ndarray) -> PictureCheck:
    seen = PictureCheck()
    seen.add(resize(frames, 256))
    return seen


@pytest.mark.parametrize("size", [64, 480])
@pytest.mark.parametrize(("level", "sigma"), [(0, 0), (0, 5), (16, 2), (128, 5)])
def test_the_noise_of_a_sensor_does_not_hide_a_blank_camera(size: int, level: int, sigma: float) -> None:
    noise = np.random.default_rng(0).normal(level, sigma, (8, size, size, 3))
    assert check(np.clip(noise, 0, 255).astype(np.uint8)).blank


def test_a_colour_of_its_own_is_blank_too() -> None:
    assert check(np.full((3, 64, 64, 3), (0, 0, 255), np.uint8)).blank


def test_a_dark_scene_a_small_light_and_a_brightness_that_changes_are_not_blank() -> None:
    scene = skimage_data.chelsea()[:256, :256][None].repeat(3, axis=0)
    assert not check(scene // 8).blank
    light = np.zeros((3, 256, 256, 3), np.uint8)
    light[:, 100:108, 100:108] = 255
    assert not check(light).blank
    frames = np.zeros((8, 64, 64, 3), np.uint8) + np.arange(0, 80, 10, dtype=np.uint8)[:, None, None, None]
    assert not check(frames).blank


def test_noise_does_not_hide_a_frozen_camera_and_a_small_motion_does_not_look_frozen() -> None:
    scene = np.repeat(skimage_data.chelsea()[:256, :256][None], 8, axis=0)
    noise = np.random.default_rng(0).normal(0, 3, scene.shape)
    assert check(np.clip(scene + noise, 0, 255).astype(np.uint8)).still
    for i, frame in enumerate(scene):
        frame[100:108, 60 + 2 * i : 68 + 2 * i] = 255
    assert not check(scene).still


def test_doctor_names_the_blank_and_still_episodes_that_were_kept(tmp_path, block_tokenizer) -> None:
    converted(tmp_path, {kind: pictures(kind) for kind in KINDS}, "{blank: flag}", block_tokenizer)
    done = hma("doctor", tmp_path / "out", "--json")
    found = {one["check"]: one for one in json.loads(done.stdout)["findings"]}
    for check, episode in (("blank", "black"), ("still", "frozen")):
        assert (found[check]["severity"], found[check]["key"]) == ("warn", "top")
        assert found[check]["numbers"]["episodes"] == [episode]
        assert found[check]["message"].endswith(f"throughout in 1 of 4 episodes: {episode}")
