"""Frames without a hand: masked, held or dropped, and counted on the whole road from video to batch."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.episodes.align import to_clip
from hma_data.episodes.episode import Clip
from hma_data.episodes.sheets import write_mp4
from hma_data.errors import SourceError
from hma_data.inspection.infer import infer
from hma_data.loading.dataset import WindowDataset
from hma_data.registry.components import HandsLayout
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.sources.base import open_source
from hma_data.sources.common.video_file import VideoFile
from hma_data.sources.hands.runs import Header, cut_into_runs, labels_from_rows
from tests.data import hands_files as made
from tests.data.hands_files import GONE, LENGTH
from tests.data.videos import number_of


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made.write_gap(tmp_path_factory.mktemp("videos"), "hands.parquet")


def read(folder: Path, robot: Embodiment, name: str = "a.mp4#0") -> Clip:
    return to_clip(open_source("hands").read(str(folder), name, robot), robot)


def unknown(known: np.ndarray | None) -> list[int]:
    assert known is not None
    return np.flatnonzero(~known).tolist()


@pytest.mark.parametrize(
    ("action", "gone"), [("", [10, 11, 12]), ("/next", [9, 10, 11]), ("/delta", [9, 10, 11, 12])]
)
def test_a_masked_video_is_one_episode_whose_actions_are_known_where_their_hands_are(folder, action, gone):
    robot = made.hand_video("landmarks", missing="mask", action=action)
    assert [(ref.id, ref.frames) for ref in open_source("hands").index(str(folder), robot)] == [
        ("a.mp4#0", LENGTH - 1)
    ]
    clip = read(folder, robot)
    assert unknown(clip.action_known) == gone and unknown(clip.state_known) == list(GONE)
    places = made.expected(range(LENGTH))
    wanted = {"": places[:-1], "/next": places[1:], "/delta": np.diff(places, axis=0)}[action].copy()
    wanted[gone] = 0
    np.testing.assert_allclose(clip.actions, wanted, atol=1e-6)
    assert [number_of(p) for p in clip.frames_at("primary", np.arange(len(clip)))] == list(range(LENGTH - 1))
    assert clip.flags == {
        "masked_actions": len(gone), "masked_states": 3, "masked_frames": 3, "dropped_frames": 1
    }  # fmt: skip


def test_on_a_grid_of_its_own_what_lies_beside_a_missing_hand_is_not_known(folder: Path) -> None:
    robot = made.hand_video("landmarks", missing="mask", hz=None)
    clip = read(folder, robot)
    frame = np.arange(len(clip)) / 2  # the grid has 20 Hz, the video 10
    held = np.floor(frame + 1e-9)
    np.testing.assert_array_equal(clip.action_known, ~np.isin(held, [9, 10, 11]))
    np.testing.assert_array_equal(clip.state_known, (frame <= 9) | (frame >= 13))
    np.testing.assert_allclose(clip.known_states[:, 0], 0.1 + 0.01 * frame[clip.state_known], atol=1e-5)


def test_a_video_with_too_few_hands_gives_no_masked_episode(folder: Path) -> None:
    source = open_source("hands")
    enough = made.hand_video("landmarks", missing="mask", min_frames="26")
    assert len(source.index(str(folder), enough)) == 1
    with pytest.raises(SourceError, match="has no run of 27 frames"):
        source.index(str(folder), made.hand_video("landmarks", missing="mask", min_frames="27"))


@given(st.lists(st.booleans(), min_size=3, max_size=30), st.none() | st.integers(0, 4), st.integers(1, 8))
def test_masked_runs_against_a_plain_loop(seen: list[bool], limit: int | None, least: int) -> None:
    if not any(seen):
        return
    frames = np.flatnonzero(seen)
    centres = np.random.default_rng(0).random((len(frames), 2))
    labels = labels_from_rows(
        frames, np.zeros(len(frames)), np.ones(len(frames)), {"center": centres}, range(len(seen))
    )
    layout = HandsLayout(missing="mask", max_hold=limit, min_frames=least)
    runs = cut_into_runs(labels, ("left/center",), layout, Header(1_000, 10.0, 100, 50, "h264"), "v")
    ages = [min((i - j for j in range(i + 1) if seen[j]), default=99) for i in range(len(seen))]
    missing = [age > (limit or 0) for age in ages]
    assert runs.missing.tolist() == missing
    assert runs.held.tolist() == [0 < age <= (limit or 0) for age in ages]
    whole = len(seen) - 1 - sum(missing) >= least
    assert runs.spans == (((0, len(seen)),) if whole else ())
    there = np.isfinite(runs.labels.points["left/center"]).all(axis=1)
    assert (~there).tolist() == missing


def test_a_masked_conversion_stores_marks_and_zeros_and_counts_known_values_only(
    folder: Path, tmp_path: Path, block_tokenizer
) -> None:
    robot = made.hand_video("landmarks", missing="mask")
    done = convert(robot, str(folder), block_tokenizer, tmp_path / "out")
    shards = ShardSet(tmp_path / "out")
    rows = shards.episode_rows(0, ["action", "state", "action_known", "state_known"])
    assert unknown(rows["action_known"]) == [9, 10, 11] and unknown(rows["state_known"]) == list(GONE)
    assert not rows["action"][9:12].any() and not rows["state"][10:13].any()
    known = np.delete(made.expected(range(1, LENGTH)), [9, 10, 11], axis=0).astype(np.float64)
    said = shards.manifest.stats["action"]
    assert said["count"] == 26
    np.testing.assert_allclose(said["mean"], known.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(said["min"], known.min(axis=0), atol=1e-6)
    flags = "dropped_frames=1,masked_actions=3,masked_frames=3,masked_states=3"
    assert shards.episodes["flags"].to_pylist() == [flags]
    assert done.flags == {
        "dropped_frames": 1, "masked_actions": 3, "masked_frames": 3, "masked_states": 3
    }  # fmt: skip
    assert verify(tmp_path / "out") == []


def test_a_chunk_of_a_batch_is_known_when_all_its_steps_are(folder, tmp_path, block_tokenizer) -> None:
    robot = made.hand_video("landmarks", missing="mask")
    assert robot.stride == 5
    for frames in ("all", "strided"):
        convert(robot, str(folder), block_tokenizer, tmp_path / frames, settings=Settings(frames))
        windows = WindowDataset(tmp_path / frames, "train", 2)
        batch = windows.batch(range(len(windows)))
        first = batch.frame * (5 if frames == "strided" else 1)
        for start, mask, chunks in zip(first.tolist(), batch.action_mask.tolist(), batch.actions):
            steps = [range(start + 5 * k, start + 5 * k + 5) for k in range(2)]
            assert mask == [not set(steps[k]) & {9, 10, 11} for k in range(2)]
            for k in range(2):
                values = made.expected([i + 1 for i in steps[k]])
                values[[i in (9, 10, 11) for i in steps[k]]] = 0
                if mask[k] or frames == "all":
                    np.testing.assert_allclose(chunks[k].numpy(), values.reshape(-1), atol=1e-6)
                else:
                    assert not chunks[k].any()
        assert not batch.action_mask.all() and batch.action_mask.any()
        assert verify(tmp_path / frames) == []


def test_sets_that_cannot_mask_have_no_marks_and_all_is_known(folder, tmp_path, block_tokenizer) -> None:
    robot = made.hand_video("landmarks", missing="hold")
    done = convert(robot, str(folder), block_tokenizer, tmp_path / "out")
    assert done.flags == {"held_frames": 3, "dropped_frames": 1}
    assert "action_known" not in pq.read_schema(next((tmp_path / "out").glob("*/*.parquet"))).names
    assert WindowDataset(tmp_path / "out", "train", 2).batch([0]).action_mask.all()


def test_runs_of_one_video_come_into_one_split_and_their_counts_add_up_once(
    folder: Path, tmp_path: Path, block_tokenizer
) -> None:
    videos = tmp_path / "videos"
    videos.mkdir()
    rows = []
    for i in range(6):
        (videos / f"{i}.mp4").write_bytes((folder / "a.mp4").read_bytes())
        rows += made.rows(f"{i}.mp4", LENGTH, lambda side, frame: frame not in GONE)
    made.write_table(videos / "hands.parquet", rows)
    robot = made.hand_video("landmarks", min_frames="3")
    refs = open_source("hands").index(str(videos), robot)
    assert [ref.group for ref in refs] == [f"{i}.mp4" for i in range(6) for _ in range(2)]
    settings = Settings(val_fraction=0.4, seed=3)
    done = convert(robot, str(videos), block_tokenizer, tmp_path / "out", settings=settings)
    table = ShardSet(tmp_path / "out").episodes.to_pylist()
    splits = {row["id"]: row["split"] for row in table}
    assert all(splits[f"{i}.mp4#0"] == splits[f"{i}.mp4#1"] for i in range(6))
    assert set(splits.values()) == {"train", "val"}
    assert done.flags == {"dropped_frames": 6 * 5}  # three without the hand, and the last of each run


def test_a_film_is_written_frame_by_frame_as_all_at_once(tmp_path: Path) -> None:
    frames = np.random.default_rng(0).integers(0, 255, (5, 15, 17, 3), np.uint8)
    write_mp4(tmp_path / "whole.mp4", frames, 10)
    write_mp4(tmp_path / "parts.mp4", (frame for frame in frames), 10)
    assert (tmp_path / "whole.mp4").read_bytes() == (tmp_path / "parts.mp4").read_bytes()
    assert VideoFile(tmp_path / "parts.mp4").frames([4]).shape == (1, 16, 18, 3)


def test_infer_gives_videos_a_copy_of_hand_video(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("HMA_HAND_MODELS", raising=False)
    text = infer(str(folder / "a.mp4"), "my_hands")
    robot = Embodiment.from_yaml(text)
    assert "hand_video" in text.splitlines()[0] and "TODO" not in text
    assert robot.id == "my_hands" and robot.source.format == "hands"
