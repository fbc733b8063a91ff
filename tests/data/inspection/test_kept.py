"""Where the robot is in the images, and whether its tokens keep it: infer, doctor and convert say so."""

import subprocess
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest

from hma_data.episodes.movement import Kept, MovingPart, framing
from hma_data.inspection import shard_findings
from hma_data.inspection.infer import infer
from hma_data.inspection.inspect import examine
from hma_data.inspection.shard_findings import kept_findings
from hma_data.registry.components import Camera
from hma_data.shards.reader import ShardSet
from hma_data.storage.yaml_io import parse_yaml
from tests.command import hma
from tests.conftest import BlockTokenizer, toy_shards

HEIGHT, WIDTH, LINK = 240, 400, 18  # pixels


def record(path: Path, x: int, episodes: int = 3) -> Path:
    """Record a small arm that turns about (x, 100) before a patterned wall."""
    draw = np.random.default_rng(0)
    coarse = draw.integers(80, 176, (12, 20, 3), dtype=np.uint8)
    wall = cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    with h5py.File(path, "w") as file:
        for episode in range(episodes):
            angle = (0.8 * np.sin(np.arange(24) / 3) + episode).astype(np.float32)
            images = np.repeat(wall[None], len(angle), axis=0)
            for image, a in zip(images, angle, strict=True):
                end = round(x + LINK * np.cos(a)), round(100 + LINK * np.sin(a))
                cv2.line(image, (x, 100), end, (20, 30, 90), 4)
            group = file.create_group(f"data/demo_{episode}")
            group["actions"] = angle[:, None]
            group["obs/image"] = images
    return path


def robot(recording: Path, camera: str = "") -> Path:
    path = recording.with_suffix(".yaml")
    path.write_text(
        "id: arm\nkind: simulation\nfrequency_hz: 10\ntarget_hz: 10\n"
        "action: {space: joint_position, components: [{key: actions, dims: 1}]}\n"
        f"cameras: [{{name: front, key: obs/image{camera}}}]\nsource: {{format: hdf5, uri: {recording}}}\n"
    )
    return path


def inferred(recording: Path) -> dict[str, Any]:
    return dict(parse_yaml(infer(recording, "arm"), "inferred"))


def test_a_small_robot_is_given_a_square_crop_that_holds_it(tmp_path: Path) -> None:
    values = inferred(record(tmp_path / "arm.hdf5", 200))
    x, y, wide, tall = values["cameras"][0]["crop"]
    assert wide == tall <= 100
    assert x <= 200 - 5 and x + wide >= 200 + LINK + 5 and y <= 100 and y + tall >= 100 + LINK + 5
    assert f"crop: {[x, y, wide, tall]} contain everything relevant?" in values["provenance"]["crop"]


def test_no_crop_is_proposed_where_the_whole_image_changes_or_nothing_does() -> None:
    camera, draw = Camera(name="front", key="k"), np.random.default_rng(0)
    moving, still = MovingPart(), MovingPart()
    moving.add(draw.integers(0, 256, (4, 60, 80, 3), dtype=np.uint8).repeat(4, 1).repeat(4, 2))
    still.add(np.full((4, HEIGHT, WIDTH, 3), 90, np.uint8))
    assert moving.box and framing(camera, moving.box, *moving.size) is None
    assert still.box is None and framing(camera, None, HEIGHT, WIDTH) is None


def test_what_moves_across_more_than_a_square_gets_black_borders() -> None:
    found = framing(Camera(name="front", key="k"), (5, 60, 300, 90), 240, 400)
    assert found and found.keys == {"resize": "letterbox"} and "cuts off 25%" in found.fault


def test_a_crop_that_cuts_the_robot_off_is_told_before_converting(tmp_path: Path) -> None:
    recording = record(tmp_path / "arm.hdf5", 370)
    (found,) = (one for one in examine(recording, robot(recording)) if one.check == "crop")
    assert found.severity == "warn" and "resize: short_side_crop cuts off 100% of that" in found.message
    crop = found.remedy.removeprefix("set ").removesuffix(" in the YAML")
    assert not [one for one in examine(recording, robot(recording, f", {crop}")) if one.check == "crop"]


def test_a_camera_whose_key_holds_no_images_is_a_finding_and_no_crash(tmp_path: Path) -> None:
    recording = record(tmp_path / "arm.hdf5", 200)
    path = robot(recording)
    path.write_text(path.read_text().replace("key: obs/image", "key: actions"))
    assert any(one.severity == "error" for one in examine(recording, path))


@pytest.mark.slow
def test_tokens_that_lose_the_robot_are_a_warning_and_with_the_crop_they_keep_it(tmp_path: Path) -> None:
    recording = record(tmp_path / "arm.hdf5", 200)

    def convert(camera: str) -> subprocess.CompletedProcess[str]:
        out = ("--out", tmp_path / "set", "--overwrite", "--workers", "0")
        return hma("convert", "-e", robot(recording, camera), "--tokenizer", "fsq-lab", *out)

    lost = convert("")
    assert "the tokenizer does not reconstruct the robot" in lost.stderr and not lost.returncode
    (found,) = (one for one in examine(tmp_path / "set") if one.check == "tokens")
    assert found.severity == "warn" and found.numbers["change_shown"] < 0.5
    crop = found.remedy.removeprefix("set ").partition(" in the YAML")[0]
    kept = convert(f", {crop}")
    assert "lose" not in kept.stderr and "decoded frames show" in kept.stdout
    (better,) = kept_findings(ShardSet(tmp_path / "set"))
    assert better.severity == "info" and better.numbers["change_shown"] > 0.6
    assert better.numbers["moving_share"] > 4 * found.numbers["moving_share"]


def test_a_set_whose_recording_is_gone_says_that_nothing_was_measured(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(shard_findings, "tokenizer_of", lambda *given: BlockTokenizer())
    folder = toy_shards(tmp_path / "set", [12, 13])
    (kept,) = kept_findings(ShardSet(folder))
    assert kept.severity == "info" and "are decoded at" in kept.message
    folder.with_suffix(".hdf5").unlink()
    (found,) = kept_findings(ShardSet(folder))
    assert found.severity == "info" and "was not measured" in found.message


def test_kept_counts_the_pixels_that_move_and_how_much_of_their_change_is_shown() -> None:
    film = np.full((3, 20, 20, 3), 60, np.uint8)
    for t in range(3):
        film[t, 4:8, 4 * t : 4 * t + 4] = 160
    exact, blind = Kept(), Kept()
    exact.add(film, film)
    blind.add(film, np.full_like(film, 60))
    assert (exact.share, exact.psnr_db, exact.change_shown) == (112 / 1200, 99.0, 1.0)
    assert "(9.3 % of the image)" in str(exact)
    everywhere = Kept()
    everywhere.add(np.arange(0, 90, 30, dtype=np.uint8)[:, None, None, None] + np.zeros_like(film), film)
    assert "(100 % of the image)" in str(everywhere)
    assert blind.change_shown == 0 and blind.lost and not exact.lost
    assert blind.psnr_db == pytest.approx(10 * np.log10(255**2 / (100**2 * 48 / 112)))
