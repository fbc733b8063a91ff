"""Hand videos with annotations: every published form, runs, values and times."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hma_data.episodes.align import to_clip
from hma_data.errors import EpisodeError
from hma_data.registry.components import HandsLayout
from hma_data.registry.embodiment import find
from hma_data.sources.base import open_source
from hma_data.sources.common.video_file import VideoFile
from hma_data.sources.detect import detect
from hma_data.sources.hands.runs import (
    KEYS,
    POINTS,
    Header,
    cut_into_runs,
    labels_from_rows,
    layout_of,
    values_of,
)
from tests.data import hands_files as made
from tests.data.sources.common.test_video_kinds import make
from tests.data.videos import HEIGHT, WIDTH, encode, number_of, turn

LENGTH = 30
VIDEO = Header(1_000, 10.0, 100, 50, "h264")
BOTH = ("left/center", "right/center")


def check_run(folder: Path, robot, episode_id: str, frames: range) -> None:
    source = open_source("hands")
    ref = {ref.id: ref for ref in source.index(str(folder), robot)}[episode_id]
    episode = open_source("hands").read(str(folder), episode_id, robot)
    aligned = to_clip(episode, robot)
    assert ref.frames == len(aligned) == len(frames) - 1
    np.testing.assert_allclose(aligned.actions, made.expected(frames[1:]), atol=1e-6)
    np.testing.assert_allclose(aligned.states, made.expected(frames[:-1]), atol=1e-6)
    shown = aligned.frames_at("primary", np.arange(len(aligned)))
    assert [number_of(picture) for picture in shown] == list(frames[:-1])
    np.testing.assert_allclose(np.diff(aligned.timestamps), np.diff(frames[:-1]) / 10, atol=1e-9)


@pytest.mark.parametrize("name", ["hands.parquet", "hands.csv", "landmarks.parquet"])
def test_a_table_in_any_form(folder: Path, name: str) -> None:
    made.write_table(folder / name, made.rows("a.mp4", LENGTH))
    check_run(folder, made.hand_video("landmarks"), "a.mp4#0", range(LENGTH))


@pytest.mark.parametrize("name", ["set/a", "a", "a.mp4"])
def test_a_table_may_call_a_video_by_any_name_that_only_it_has(tmp_path: Path, clip: Path, name: str) -> None:
    for place in ("set/a.mp4", "set/b.mp4"):
        (tmp_path / place).parent.mkdir(exist_ok=True)
        (tmp_path / place).write_bytes(clip.read_bytes())
    made.write_table(tmp_path / "hands.csv", made.rows(name, LENGTH))
    refs = open_source("hands").index(str(tmp_path), made.hand_video("landmarks"))
    assert [ref.id for ref in refs] == ["set/a.mp4#0"]


def test_boxes_and_landmarks_of_a_table_give_centres_and_wrists(folder: Path) -> None:
    table = []
    for row in made.rows("a", LENGTH):
        x, y = row.pop("x"), row.pop("y")
        points = np.array([[x + 0.01 * ((i % 5) - 2), y + 0.02 * ((i % 3) - 1)] for i in range(21)])
        box = dict(zip(("left", "top", "right", "bottom"), (x - 0.02, y - 0.02, x + 0.02, y + 0.02)))
        table.append((row | box, row | {"landmarks": points.reshape(-1).tolist()}))
    read = []
    for form, name in enumerate(("boxes.csv", "lists.parquet")):
        made.write_table(folder / name, [forms[form] for forms in table])
        robot = made.hand_video("landmarks", annotations=name)
        check_run(folder, robot, "a.mp4#0", range(LENGTH))
        if form:
            wrists = made.hand_video("landmarks", part="wrist", annotations=name)
            read.append(open_source("hands").read(str(folder), "a.mp4", wrists).actions[0].values)
    expected = made.expected(range(1, LENGTH)) + np.float32([-0.02, -0.02, -0.02, -0.02])
    for values in read:
        np.testing.assert_allclose(values, expected, atol=1e-6)


@pytest.mark.parametrize("protocol", [3, 4, 5])
def test_epic_kitchens_as_published(folder: Path, protocol: int) -> None:
    (folder / "P01").mkdir()
    with (folder / "P01" / "a.pkl").open("wb") as file:
        pickle.dump(made.epic_messages(LENGTH), file, protocol=protocol)
    check_run(folder, made.hand_video("epic_kitchens_hand_objects"), "a.mp4#0", range(LENGTH))


def test_a_table_whose_frames_count_from_one(folder: Path) -> None:
    table = [row | {"frame": row["frame"] + 1} for row in made.rows("a", LENGTH)]
    made.write_table(folder / "hands.csv", table)
    check_run(folder, made.hand_video("landmarks", first_frame="1"), "a.mp4#0", range(LENGTH))


def test_of_two_left_hands_the_surer_counts_and_doubtful_ones_do_not(folder: Path) -> None:
    both = [("left", 0.9), ("left", 0.6), ("right", 0.8), ("right", 0.3)]
    messages = []
    for i in range(LENGTH):
        hands = [(side, score, made.place(side, i + 7 * (score in (0.6, 0.3)))) for side, score in both]
        messages.append(made.epic_message(i + 1, hands if i % 2 else hands[::-1]))
    (folder / "a.pkl").write_bytes(pickle.dumps(messages))
    check_run(folder, made.hand_video("epic_kitchens_hand_objects"), "a.mp4#0", range(LENGTH))


def test_ego_exo4d_by_take_and_camera(tmp_path: Path, clip: Path) -> None:
    videos = tmp_path / "takes/cook_1/frame_aligned_videos"
    labels = tmp_path / "annotations/ego_pose/train/hand/automatic"
    for path in (videos / "cam01.mp4", videos / "cam02.mp4", labels / "uid-1.json"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(clip.read_bytes())
    (labels / "uid-1.json").write_text(made.egoexo(LENGTH))
    robot = made.hand_video("egoexo4d_hand_pose", part="wrist")
    check_run(tmp_path, robot, "takes/cook_1/frame_aligned_videos/cam01.mp4#0", range(LENGTH))
    assert len(open_source("hands").index(str(tmp_path), robot)) == 1
    shift = made.expected(range(1, LENGTH)) + np.float32([0.1, 0, 0.1, 0])
    centres = made.hand_video("egoexo4d_hand_pose")
    episode = open_source("hands").read(str(tmp_path), "takes/cook_1/frame_aligned_videos/cam01.mp4", centres)
    np.testing.assert_allclose(episode.actions[0].values, shift, atol=1e-6)


def test_ego4d_keeps_labelled_frames_at_their_own_times(folder: Path) -> None:
    actions = [
        made.ego4d_action([2, 7, 12], "#C C takes a cup"),
        made.ego4d_action([13, 17, 25], "#C C fills it"),
        made.ego4d_action([14], "#C C does nothing", is_rejected=True),
    ]
    (folder / "fho_main.json").write_text(made.ego4d({"a": actions, "absent": actions}))
    robot = made.hand_video("ego4d_fho", min_frames="3")
    episode = open_source("hands").read(str(folder), "a.mp4#0", robot)
    aligned = to_clip(episode, robot)
    np.testing.assert_allclose(aligned.timestamps, np.array([0, 5, 10, 11, 15]) / 10, atol=1e-9)
    np.testing.assert_allclose(aligned.actions, made.expected([7, 12, 13, 17, 25]), atol=1e-6)
    assert episode.instruction == "#C C takes a cup; #C C fills it"


def test_ego4d_with_every_picture_holds_the_next_place_until_it_is_reached(folder: Path) -> None:
    (folder / "fho_main.json").write_text(made.ego4d({"a": [made.ego4d_action([2, 7, 17, 25], "#C C")]}))
    robot = made.hand_video("ego4d_fho", pictures="every")
    aligned = to_clip(open_source("hands").read(str(folder), "a.mp4", robot), robot)
    nexts = [7] * 5 + [17] * 10 + [25] * 8
    np.testing.assert_allclose(aligned.actions, made.expected(nexts), atol=1e-6)
    np.testing.assert_allclose(aligned.states, made.expected(range(2, 25)), atol=1e-5)  # it moves evenly
    shown = aligned.frames_at("primary", np.arange(len(aligned)))
    assert [number_of(picture) for picture in shown] == list(range(2, 25))


def test_labels_of_pictures_of_another_size(folder: Path) -> None:
    (folder / "fho_main.json").write_text(made.ego4d({"a": [made.ego4d_action(range(20), "#C C")]}))
    plain = made.hand_video("ego4d_fho")
    double = made.hand_video("ego4d_fho", label_size=f"{2 * WIDTH}x{2 * HEIGHT}")
    source = open_source("hands")
    values = [source.read(str(folder), "a.mp4", robot).actions[0].values for robot in (plain, double)]
    np.testing.assert_allclose(values[1] * 2, values[0], atol=1e-6)


def test_hold_keeps_the_last_place_for_so_many_frames(folder: Path) -> None:
    table = made.rows("a", LENGTH, lambda side, i: side == "left" or i not in (0, 10, 11, 20, 21, 22, 23))
    made.write_table(folder / "hands.csv", table)
    robot = made.hand_video("landmarks", action="", missing="hold", max_hold="2", min_frames="1")
    refs = open_source("hands").index(str(folder), robot)
    assert [(ref.id, ref.frames) for ref in refs] == [("a.mp4#0", 20), ("a.mp4#1", 5)]
    episode = open_source("hands").read(str(folder), "a.mp4#0", robot)
    held = [9 if i in (10, 11) else 19 if i > 19 else i for i in range(1, 22)]
    np.testing.assert_allclose(episode.actions[0].values[:, 2:], made.expected(held)[:20, 2:], atol=1e-6)
    assert episode.metadata["flags"]["held_frames"] == 3  # and one where the run ends


def test_nan_says_that_there_is_no_hand(folder: Path) -> None:
    table = made.rows("a", LENGTH)
    table[20]["x"] = float("nan")
    table[21]["y"] = float("inf")
    made.write_table(folder / "hands.csv", table)
    robot = made.hand_video("landmarks", min_frames="5")
    check_run(folder, robot, "a.mp4#0", range(10))
    check_run(folder, robot, "a.mp4#1", range(11, LENGTH))


@given(st.data())
def test_runs_values_and_counts_against_a_plain_loop(data: st.DataObject) -> None:
    length = data.draw(st.integers(2, 30))
    seen = data.draw(st.lists(st.tuples(st.booleans(), st.booleans()), min_size=length, max_size=length))
    rows = [(i, side) for i, pair in enumerate(seen) for side in (0, 1) if pair[side]]
    hold, least = data.draw(st.booleans()), data.draw(st.integers(1, 4))
    limit = data.draw(st.none() | st.integers(0, 3)) if hold else None
    layout = HandsLayout(missing="hold" if hold else "split", max_hold=limit, min_frames=least)
    frames, sides = np.array(rows, np.int64).reshape(-1, 2).T
    centres = np.random.default_rng(0).random((len(rows), 2))
    labels = labels_from_rows(frames, sides, np.ones(len(rows)), {"center": centres}, range(length))
    if not all(any(pair[side] for pair in seen) for side in (0, 1)):
        with pytest.raises(EpisodeError, match="no label has"):
            cut_into_runs(labels, BOTH, layout, VIDEO, "v")
        return
    runs = cut_into_runs(labels, BOTH, layout, VIDEO, "v")

    at = dict(zip(rows, centres))
    places: list[list[np.ndarray | None]] = []
    for i in range(length):
        pair: list[np.ndarray | None] = []
        for side in (0, 1):
            known = [j for j in range(i + 1) if (j, side) in at]
            age = i - known[-1] if known else length
            usable = bool(known) and (age == 0 or (hold and (limit is None or age <= limit)))
            pair.append(at[known[-1], side] if usable else None)
        places.append(pair)
    good = [all(value is not None for value in pair) for pair in places]
    expected: list[range] = []
    start = None
    for i, usable in enumerate([*good, False]):
        if usable and start is None:
            start = i
        if not usable and start is not None:
            expected += [range(start, i)] if i - start - 1 >= least else []
            start = None
    assert [range(*span) for span in runs.spans] == expected
    used = 0
    for span in runs.spans:
        for number, side in enumerate(("left", "right")):
            now = values_of(f"{side}/center", runs.labels.points, span)
            after = values_of(f"{side}/center/next", runs.labels.points, span)
            change = values_of(f"{side}/center/delta", runs.labels.points, span)
            used += len(now) * (number == 0)
            for row, i in enumerate(range(span[0], span[1] - 1)):
                here, there = places[i][number], places[i + 1][number]
                np.testing.assert_array_equal(now[row], here)
                np.testing.assert_array_equal(after[row], there)
                np.testing.assert_array_equal(change[row], there - here)
    assert len(runs.labels) == length == used + runs.dropped
    assert (runs.missing | runs.held).sum() == sum(not all(pair) for pair in seen)


def test_labels_of_every_third_frame_run_on_and_a_missing_one_ends_the_run() -> None:
    frames = np.array([3, 6, 9, 15, 18, 21, 24])
    labels = labels_from_rows(frames, np.zeros(7, int), np.ones(7), {"center": np.full((7, 2), 0.5)})
    runs = cut_into_runs(labels, ("left/center",), HandsLayout(min_frames=1), VIDEO, "v")
    assert [runs.labels.frames[slice(*span)].tolist() for span in runs.spans] == [[3, 6, 9], [15, 18, 21, 24]]


def test_a_grid_of_its_own_resamples_pictures_and_hands(folder: Path) -> None:
    made.write_table(folder / "hands.csv", made.rows("a", LENGTH))
    robot = made.hand_video("landmarks", hz=None)
    aligned = to_clip(open_source("hands").read(str(folder), "a.mp4", robot), robot)
    np.testing.assert_allclose(np.diff(aligned.timestamps), 0.05, atol=1e-9)
    shown = [number_of(p) for p in aligned.frames_at("primary", np.arange(len(aligned)))]
    np.testing.assert_allclose(aligned.actions, made.expected(np.arange(len(aligned)) // 2 + 1), atol=1e-6)
    assert set(shown) == set(range(LENGTH - 1)) and shown == sorted(shown)


def test_the_human_embodiments_that_come_along_have_known_keys_and_layouts() -> None:
    for name in ("ego4d", "egoexo4d", "exoego4d", "epic_kitchen", "epic_kitchens", "hand_video"):
        robot = find(name)
        keys = [part.key for part in (*robot.action.components, *robot.state.components)]
        assert set(keys) <= set(KEYS) and [key.split("/")[0] for key in keys] == ["left", "right"] * 2
        assert robot.cameras[0].key == "video"
        assert layout_of(robot).labels == robot.source.layout["labels"]


def test_the_size_of_a_video_filmed_upright_is_that_of_its_pictures(tmp_path: Path) -> None:
    path = turn(encode(tmp_path / "v.mp4", range(LENGTH)))
    camera = open_source("hands").inspect(str(path)).keys[0]
    assert camera.shape == VideoFile(path).frames([0])[0].shape == (WIDTH, HEIGHT, 3)


def test_a_folder_of_videos_is_recognised_and_inspected(folder: Path, monkeypatch) -> None:
    monkeypatch.delenv("HMA_HAND_MODELS", raising=False)
    assert detect(str(folder)) == detect(str(folder / "a.mp4")) == "hands"
    (folder / "broken.mp4").write_bytes(b"\0" * 100)
    found = open_source("hands").inspect(str(folder))
    camera = found.keys[0]
    assert (camera.key, camera.shape, camera.hz, camera.codec) == ("video", (HEIGHT, WIDTH, 3), 10, "h264")
    assert (
        found.episodes == 2 and found.frames == LENGTH and {key.key for key in found.keys[1:]} == set(POINTS)
    )
    assert "broken.mp4" in found.problems[0] and "hands were not detected" in found.problems[-1]


def test_a_rate_that_nothing_states_is_called_measured(folder: Path, monkeypatch) -> None:
    monkeypatch.delenv("HMA_HAND_MODELS", raising=False)
    make(folder / "a.mp4", "libx264", {}, times=[*range(20), *range(24, 30)])
    (told,) = (one for one in open_source("hands").inspect(str(folder)).findings if one.check == "rate")
    assert "a.mp4: video: runs at 10 Hz, measured over its whole length " in told.message
