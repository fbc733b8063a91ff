"""Previews show what the tokens say, and where in time."""

from pathlib import Path

import av
import cv2
import pytest

from hma_data.conversion.plan import Settings
from hma_data.errors import UsageError
from hma_data.shards.preview import preview
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
