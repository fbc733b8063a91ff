"""Previews show what the tokens say, and where in time."""

from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from hma_data.conversion.plan import Settings
from hma_data.errors import UsageError
from hma_data.shards.preview import CURSOR_COLOUR, UNKNOWN_COLOUR, Curves, preview
from hma_data.shards.reader import ShardSet
from tests.conftest import BlockTokenizer, toy_shards


@pytest.fixture
def made(tmp_path: Path) -> Path:
    settings = Settings(val_fraction=0.3, cameras=("top", "side"))
    return toy_shards(tmp_path / "set", [14, 1, 16, 17, 18], settings)


def test_the_video_shows_each_frame_at_the_recorded_rate(made: Path, tmp_path: Path) -> None:
    shown = preview(made, tmp_path / "seen", episodes=9, tokenizer=BlockTokenizer())
    with av.open(str(shown.video)) as container:
        stream = container.streams.video[0]
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        assert float(stream.average_rate) == pytest.approx(10)
    assert len(frames) == 14 + 1 + 16 + 17 + 18
    assert len(shown.episodes) == 5
    for side in (0, 256):  # recorded, decoded
        blue, brighter = (frame[36 + 128, side + 128].astype(int) for frame in (frames[0], frames[13]))
        assert brighter[1] > blue[1] + 100  # the toy's green counts frames


def test_the_sheet_shows_recorded_frames_above_decoded_ones_in_order(made: Path, tmp_path: Path) -> None:
    shown = preview(made, tmp_path / "seen", episodes=1, columns=3, tokenizer=BlockTokenizer())
    sheet = cv2.imread(str(shown.sheet))[..., ::-1].astype(int)
    for row in range(4):  # of each camera, recorded and decoded
        greens = [sheet[row * 166 + 18 + 72, 4 + place * 148 + 72, 1] for place in range(3)]
        assert greens == [0, 17 * 6, 17 * 13]
    assert shown.sheet.parent.is_dir()
    assert {path.name for path in shown.sheet.parent.iterdir()} == {"sheet.png", "preview.mp4"}


def test_one_of_several_episodes_is_held_out_and_a_recording_that_is_gone_leaves_the_decoded_frames(
    made: Path, tmp_path: Path
) -> None:
    rows = {row["id"]: row["split"] for row in ShardSet(made).episodes.to_pylist()}
    shown = preview(made, tmp_path / "seen", episodes=2, tokenizer=BlockTokenizer())
    assert "val" in {rows[name] for name in shown.episodes}
    made.with_suffix(".hdf5").unlink()
    alone = preview(made, tmp_path / "alone", episodes=2, tokenizer=BlockTokenizer())
    tall, short = (cv2.imread(str(one.sheet)).shape[0] for one in (shown, alone))
    assert tall - short == 2 * 2 * 166  # two cameras of two episodes


def test_another_camera_can_be_shown(made: Path, tmp_path: Path) -> None:
    shown = preview(made, tmp_path / "s", episodes=1, camera="side", tokenizer=BlockTokenizer())
    sheet = cv2.imread(str(shown.sheet))[..., ::-1]
    assert shown.sheet.is_file()
    last = sheet[18 + 72, 4 + 7 * 148 + 72].astype(int)
    assert last[1] == 17 * 13
    with pytest.raises(UsageError, match="top, side"):
        preview(made, tmp_path / "t", camera="nose", tokenizer=BlockTokenizer())


def curves(values: np.ndarray, known: np.ndarray | None = None) -> Curves:
    low, high = values.min(0).astype(np.float64), values.max(0).astype(np.float64)
    names = [f"v{i}" for i in range(values.shape[1])]
    return Curves(values.astype(np.float32), known, low, high, names, 3.0, 400, 200)


def count(picture: np.ndarray, colour: tuple[int, int, int]) -> int:
    """Pixels of just that colour; lines are smoothed, so few of theirs are."""
    return int((picture == colour).all(axis=-1).sum())


def lines(picture: np.ndarray) -> int:
    """Bluish pixels."""
    return int((picture[..., 2].astype(int) - picture[..., 0] > 40).sum())


@pytest.mark.parametrize("shape", [(1, 1), (2, 7), (300, 7), (50, 40)])
def test_curves_of_any_size_are_drawn(shape: tuple[int, int]) -> None:
    values = np.random.default_rng(0).normal(size=shape)
    picture = curves(values).at(0)
    assert picture.shape == (200, 400, 3)
    assert count(picture, CURSOR_COLOUR) >= 100
    assert lines(curves(values).panel) > 20 or shape[0] == 1


def test_constant_and_huge_values_are_drawn() -> None:
    for values in (np.zeros((10, 2)), np.full((10, 2), 3e38), np.array([[-3e38], [3e38]])):
        assert curves(values).panel.shape == (200, 400, 3)


def test_what_is_not_known_is_grey() -> None:
    values = np.sin(np.arange(40.0))[:, None]
    assert count(curves(values, np.arange(40) % 20 > 5).panel, UNKNOWN_COLOUR) > 1000
    assert count(curves(values, np.ones(40, bool)).panel, UNKNOWN_COLOUR) < 100
