"""The hand detector: its geometry, and MediaPipe's models on real pictures and videos."""

import sys
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hma_data.episodes.align import to_clip
from hma_data.episodes.sheets import write_mp4
from hma_data.errors import EpisodeError, MissingDependencyError, SourceError
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import open_source
from hma_data.sources.common.video_file import VideoFile
from hma_data.sources.hands import scan as hands_scan
from hma_data.sources.hands.detect import (
    Hand,
    HandNetwork,
    MediaPipeHands,
    Square,
    choose_sides,
    cut,
    decode_palms,
    load_models,
    merge_overlapping,
    palm_anchors,
    square_of_palm,
    square_of_points,
)
from tests.data import hands_files as made
from tests.data.videos import encode

# The hand that is raised, as a person sees it: shirts' writing shows that the pictures are not mirrored.
RAISED = {
    "call_17d804b5": "right",
    "four_105f8f8e": "right",
    "four_249c5023": "left",
    "none_00b85ea4": "right",
    "none_0a0ef3d2": "right",
    "none_0a4bc2da": "left",
    "rock_026fd791": "right",
    "rock_0c6628ea": "left",
    "rock_15cb4e8b": "right",
    "rock_20e2164d": "right",
}


@pytest.fixture(scope="module")
def models(real_data: Path) -> Path:
    return real_data / "hands" / "models"


@pytest.fixture(scope="module")
def finder(models: Path) -> MediaPipeHands:
    return MediaPipeHands(load_models(models))


@pytest.fixture(scope="module")
def short(real_data: Path, models: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = VideoFile(real_data / "hands" / "demo3.mp4")
    pictures = [cv2.resize(picture, (426, 240)) for picture in file.frames(range(100, 124))]
    folder = tmp_path_factory.mktemp("short")
    write_mp4(folder / "clip.mp4", np.stack(pictures), 30)
    return folder


@pytest.fixture(autouse=True)
def apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HMA_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("HMA_HAND_MODELS", raising=False)


def picture_of(path: Path) -> np.ndarray:
    return np.ascontiguousarray(cv2.imread(str(path))[..., ::-1])


# -- geometry, without models


def test_the_anchors_are_the_2016_of_the_palm_model() -> None:
    anchors = palm_anchors()
    assert anchors.shape == (2016, 2)
    expected = [
        ((x + 0.5) / cells, (y + 0.5) / cells)
        for cells, copies in ((24, 2), (12, 6))
        for y in range(cells)
        for x in range(cells)
        for _ in range(copies)
    ]
    np.testing.assert_allclose(anchors, expected)


def test_a_decoded_palm_lies_where_anchor_and_values_say() -> None:
    anchors, values, scores = palm_anchors(), np.zeros((2016, 18)), np.full(2016, -9.0)
    values[700, :4], values[700, 4:6], scores[700] = (19.2, -9.6, 38.4, 57.6), (1.92, 3.84), 2.0
    (palm,) = decode_palms(values, scores, anchors)
    centre, half = anchors[700] + [0.1, -0.05], np.array([0.1, 0.15])
    np.testing.assert_allclose(palm[:2], [centre - half, centre + half])
    np.testing.assert_allclose(palm[2], anchors[700] + (0.01, 0.02))


def test_overlapping_finds_become_one_weighted_by_their_chances() -> None:
    shapes = np.zeros((3, 9, 2))
    for shape, left in zip(shapes, (0.10, 0.14, 0.70)):
        shape[:2] = [[left, 0.1], [left + 0.2, 0.3]]
    merged = merge_overlapping(shapes, np.array([0.9, 0.6, 0.5]))
    assert len(merged) == 2
    np.testing.assert_allclose(merged[0][0], [(0.1 * 0.9 + 0.14 * 0.6) / 1.5, 0.1])
    np.testing.assert_allclose(merged[1], shapes[2])


@given(st.floats(-3.1, 3.1), st.floats(20, 60), st.floats(-10, 70), st.floats(-10, 50))
def test_the_map_of_a_square_turns_it_about_its_centre(angle: float, side: float, x: float, y: float) -> None:
    matrix = Square(x, y, side, angle).to_image(100)
    corners = np.array([[0, 0], [100, 0], [100, 100], [0, 100]]) @ matrix[:, :2].T + matrix[:, 2]
    np.testing.assert_allclose(corners.mean(axis=0), [x, y], atol=1e-9)
    edge = corners[1] - corners[0]
    np.testing.assert_allclose(np.linalg.norm(edge), side)
    np.testing.assert_allclose(edge / side, [np.cos(angle), np.sin(angle)], atol=1e-9)


def test_a_cut_of_the_same_size_is_the_picture_and_beyond_its_edge_black() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (32, 32, 3), dtype=np.uint8)
    np.testing.assert_array_equal(np.rint(cut(picture, Square(16, 16, 32, 0), 32) * 255), picture)
    moved = np.rint(cut(picture, Square(32, 16, 32, 0), 32) * 255)
    np.testing.assert_array_equal(moved[:, :15], picture[:, 16:31])
    assert not moved[:, 17:].any()
    turned = np.rint(cut(picture, Square(16, 16, 32, np.pi / 2), 32) * 255)
    np.testing.assert_array_equal(turned, np.rot90(picture))


@given(st.floats(-3.1, 3.1), st.floats(-50, 50), st.floats(0.5, 3))
def test_where_a_hand_is_looked_for_turns_moves_and_grows_with_it(angle, moved, grown) -> None:
    points = np.random.default_rng(1).random((21, 2)) * 100
    points[[0, 5, 9, 13]] = [[50, 100], [40, 40], [50, 35], [60, 40]]  # a hand that points up
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, -sin], [sin, cos]]) * grown
    plain = square_of_points(points)
    other = square_of_points(points @ turn.T + moved)
    assert plain.angle == pytest.approx(0, abs=1e-9)
    assert np.exp(1j * other.angle) == pytest.approx(np.exp(1j * angle), abs=1e-6)
    assert other.side == pytest.approx(plain.side * grown, rel=1e-6)
    np.testing.assert_allclose([other.x, other.y], turn @ (plain.x, plain.y) + moved, atol=1e-6)


def test_a_palm_that_points_up_has_its_hand_above_it() -> None:
    palm = np.zeros((9, 2))
    palm[:2], palm[2], palm[4] = [[40, 60], [60, 90]], (50, 90), (50, 60)
    square = square_of_palm(palm)
    assert (square.x, square.y, square.side, square.angle) == pytest.approx((50, 60, 78, 0))


@pytest.mark.parametrize(
    ("p_right", "sides"),
    [
        ([], []),
        ([0.9], ["right"]),
        ([0.1, 0.8], ["left", "right"]),
        ([0.95, 0.7], ["right", "left"]),
        ([0.3, 0.05], ["right", "left"]),
        ([0.95, 0.99], [None, "right"]),
    ],
)
def test_there_is_at_most_one_hand_a_side(p_right: list[float], sides: list[str | None]) -> None:
    assert choose_sides(p_right) == sides


@pytest.mark.real
def test_raised_hands_are_found_on_their_side_with_the_wrist_below(real_data, finder) -> None:
    for name, side in RAISED.items():
        finder.reset()
        hands = {one.side: one for one in finder.detect(picture_of(real_data / f"hands/images/{name}.jpg"))}
        assert side in hands, name
        points = hands[side].points
        assert hands[side].score > 0.9 and (points > 0).all() and (points < 1).all()
        tips = points[[4, 8, 12, 16, 20]]
        assert (tips[:, 1] < points[0, 1]).all() or name.startswith("call"), name


@pytest.mark.real
def test_a_mirrored_picture_gives_the_same_points_of_the_other_hand(real_data, finder, models) -> None:
    picture = picture_of(real_data / "hands/images/four_249c5023.jpg")
    mirrored = np.ascontiguousarray(picture[:, ::-1])
    finder.reset()
    (plain,) = finder.detect(picture)
    finder.reset()
    (other,) = finder.detect(mirrored)
    assert (plain.side, other.side) == ("left", "right")
    np.testing.assert_allclose(other.points * (-1, 1) + (1, 0), plain.points, atol=0.02)
    (told,) = MediaPipeHands(load_models(models), mirrored=True).detect(mirrored)
    assert told.side == "left"


@pytest.mark.real
def test_no_frame_of_the_clip_loses_both_hands(real_data: Path, finder: MediaPipeHands) -> None:
    file = VideoFile(real_data / "hands" / "demo3.mp4")
    found = hands_scan.scan("demo3.mp4", file, finder, range(120, 150))
    each = [np.sum(found["frame"].to_numpy() == i) for i in range(120, 150)]
    assert min(each) >= 1 and np.mean(each) > 1.8
    wrists = np.array(found["landmarks"].to_pylist()).reshape(-1, 21, 2)[:, 0]
    for side in ("left", "right"):  # a hand goes on from frame to frame
        mine = wrists[np.array(found["side"].to_pylist()) == side]
        assert np.linalg.norm(np.diff(mine, axis=0), axis=1).max() < 0.1


def robot(models: Path, **layout: str) -> Embodiment:
    values = made.hand_video("detector", hz=30, models=str(models), **layout).to_dict()
    return Embodiment.from_values(values, "test")


@pytest.mark.real
def test_a_folder_of_videos_becomes_episodes_whose_hands_are_the_tables(short, models, tmp_path) -> None:
    source, own = open_source("hands"), robot(models)
    (ref,) = source.index(str(short), own)
    assert (ref.id, ref.frames) == ("clip.mp4", 24)
    episode = source.read(str(short), "clip.mp4", own)
    clip = to_clip(episode, own)
    assert len(clip) == 23 and episode.rate_stamped and episode.metadata["flags"]["dropped_frames"] == 1
    assert (clip.actions[:, 0] > clip.actions[:, 2]).all()  # facing us, the left hand is at our right
    np.testing.assert_array_equal(clip.actions[:-1], clip.states[1:])

    finder = MediaPipeHands(load_models(models))
    table = hands_scan.scan("clip.mp4", VideoFile(short / "clip.mp4"), finder)
    pq.write_table(table, tmp_path / "hands.parquet")
    assert len(table) == 48
    labels = made.hand_video("landmarks", hz=30, annotations=str(tmp_path / "hands.parquet"))
    again = open_source("hands").read(str(short), "clip.mp4#0", labels)
    np.testing.assert_array_equal(again.actions[0].values, episode.actions[0].values)


@pytest.mark.real
def test_what_was_found_is_kept(short: Path, models: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    looked = []
    real = hands_scan.scan
    monkeypatch.setattr(hands_scan, "scan", lambda *given: looked.append(1) or real(*given))
    first = open_source("hands").read(str(short), "clip.mp4", robot(models))
    second = open_source("hands").read(str(short), "clip.mp4", robot(models))
    assert len(looked) == 1
    np.testing.assert_array_equal(first.actions[0].values, second.actions[0].values)
    open_source("hands").read(str(short), "clip.mp4", robot(models, mirrored="true"))
    assert len(looked) == 2  # another answer, so another entry


class Blinking:
    """A detector that sees both hands in frames 2 to 9 and 11 to 16, the left one less surely in 13."""

    def reset(self) -> None:
        self.frame = -1

    def detect(self, picture: np.ndarray) -> list[Hand]:
        self.frame += 1
        if not (2 <= self.frame <= 9 or 11 <= self.frame <= 16):
            return []
        score = 0.55 if self.frame == 13 else 0.9
        points = np.full((21, 2), 0.02 * self.frame)
        return [Hand("left", score, points), Hand("right", 0.9, 1 - points)]


@pytest.fixture
def blinking(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    models = type("Models", (), {"digest": "made"})()
    target = "hma_data.sources.hands.source.HandsSource._models"
    monkeypatch.setattr(target, lambda self, layout: (Blinking(), models))
    encode(tmp_path / "set" / "a.mp4", range(20), fps=30)
    return tmp_path / "set"


def test_of_a_video_the_longest_run_is_taken_and_the_rest_counted(blinking: Path, tmp_path: Path) -> None:
    own = robot(tmp_path, min_frames="3")
    episode = open_source("hands").read(str(blinking), "a.mp4", own)
    np.testing.assert_allclose(episode.actions[0].values[:, 0], 0.02 * np.arange(3, 10), atol=1e-6)
    assert episode.metadata["flags"]["dropped_frames"] == 20 - 7
    held = open_source("hands").read(str(blinking), "a.mp4", robot(tmp_path, missing="hold", max_hold="1"))
    assert held.metadata["flags"]["held_frames"] == 1 and len(held.actions[0].values) == 15
    strict = open_source("hands").read(
        str(blinking), "a.mp4", robot(tmp_path, min_score="0.6", min_frames="2")
    )
    assert strict.metadata["flags"]["dropped_frames"] == 20 - len(strict.actions[0].values)
    with pytest.raises(EpisodeError, match="no run of 12 frames with left/center, right/center: 6 of 20"):
        open_source("hands").read(str(blinking), "a.mp4", robot(tmp_path))


@pytest.mark.real
def test_videos_without_hands_and_cut_off_ones_are_refused(short: Path, models: Path, tmp_path: Path) -> None:
    encode(tmp_path / "set" / "grey.mp4", range(20), fps=30)
    (tmp_path / "set" / "cut.mp4").write_bytes((short / "clip.mp4").read_bytes()[:-3000])
    source, own = open_source("hands"), robot(models)
    assert {ref.id for ref in source.index(str(tmp_path / "set"), own)} == {"grey.mp4", "cut.mp4"}
    for name in ("grey.mp4", "cut.mp4"):
        with pytest.raises(EpisodeError, match=name):
            episode = source.read(str(tmp_path / "set"), name, own)
            episode.streams["primary"].frames(range(23))


@pytest.mark.real
def test_inspection_tells_the_share_of_frames_with_hands(short, models, monkeypatch) -> None:
    monkeypatch.setenv("HMA_HAND_MODELS", str(models))
    facts = open_source("hands").inspect(str(short)).facts
    assert facts["frames with left hand"] == facts["frames with both"] == "100% of 12 sampled"


def test_missing_models_say_where_they_are_looked_for(tmp_path: Path) -> None:
    source, own = open_source("hands"), made.hand_video("detector")
    encode(tmp_path / "a.mp4", range(12))
    with pytest.raises(SourceError, match=r"hand models: are not given.*HMA_HAND_MODELS"):
        source.index(str(tmp_path), own)
    with pytest.raises(SourceError, match="has none of palm_detection_full.tflite"):
        load_models(tmp_path)
    with pytest.raises(SourceError, match="holds no hand models: .*No such file"):
        load_models(tmp_path / "hand_landmarker.task")
    (tmp_path / "hand_landmarker.task").write_bytes(b"PK no zip")
    with pytest.raises(SourceError, match="holds no hand models: File is not a zip file"):
        load_models(tmp_path)


@pytest.mark.real
def test_a_bundle_gives_the_same_hands_as_the_files_in_it(real_data, models, finder, tmp_path) -> None:
    with zipfile.ZipFile(tmp_path / "hand_landmarker.task", "w") as bundle:
        bundle.write(models / "palm_detection_full.tflite", "hand_detector.tflite")
        bundle.write(models / "hand_landmark_full.tflite", "hand_landmarks_detector.tflite")
    picture = picture_of(real_data / "hands/images/four_249c5023.jpg")
    finder.reset()
    (expected,) = finder.detect(picture)
    for place in (tmp_path, tmp_path / "hand_landmarker.task"):
        (hand,) = MediaPipeHands(load_models(place)).detect(picture)
        np.testing.assert_array_equal(hand.points, expected.points)


@pytest.mark.real
def test_models_in_each_others_place_or_damaged_are_refused(models: Path, tmp_path: Path) -> None:
    palm, hand = (
        (models / f"{name}.tflite").read_bytes() for name in ("palm_detection_full", "hand_landmark_full")
    )
    for content, fault in ((hand, "is another model: takes"), (palm[:5000], "cannot be run")):
        (tmp_path / "palm_detection_full.tflite").write_bytes(content)
        (tmp_path / "hand_landmark_full.tflite").write_bytes(hand)
        with pytest.raises(SourceError, match=fault):
            MediaPipeHands(load_models(tmp_path))


def test_without_litert_the_error_names_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", None)
    with pytest.raises(MissingDependencyError, match="uv sync --inexact --extra hands"):
        HandNetwork(b"", 192, (1,), "x")
