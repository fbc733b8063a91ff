"""Hand videos that are damaged or do not fit their labels: one clear error, or quarantine."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hma_data.episodes.align import to_clip
from hma_data.errors import EpisodeError, HMAError, RegistryError, SourceError
from hma_data.sources.base import open_source
from hma_data.sources.hands.runs import videos_of
from tests.data import hands_files as made
from tests.data.videos import HEIGHT, WIDTH
from tests.hostile import damage

LENGTH = 30


@pytest.mark.parametrize(
    ("layout", "fault"),
    [
        ({"missing": "skip"}, r"\(is 'skip'\); allowed: 'split', 'hold' or 'mask'"),
        ({"min_frames": "few"}, "a whole number"),
        ({"min_frames": "-1"}, "greater than or equal to 0"),
        ({"min_score": "nan"}, "finite number"),
        ({"label_size": "1920"}, "WIDTHxHEIGHT"),
        ({"colour": "red"}, "unknown key of format hands.*allowed: labels, annotations"),
    ],
)
def test_a_wrong_layout_says_where_and_what_is_allowed(layout: dict[str, str], fault: str) -> None:
    key = next(iter(layout))
    with pytest.raises(RegistryError, match=rf"source\.layout\.{key}: .*{fault}"):
        made.hand_video("landmarks", **layout)


class Touch:
    """An object whose unpickling would run something."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_code_in_a_pickle_does_not_run(folder: Path, tmp_path: Path) -> None:
    content = [*made.epic_messages(3), Touch(tmp_path / "run")]
    (folder / "a.pkl").write_bytes(pickle.dumps(content))
    with pytest.raises(EpisodeError, match="which is neither a plain value nor an array"):
        open_source("hands").read(str(folder), "a.mp4", made.hand_video("epic_kitchens_hand_objects"))
    assert not (tmp_path / "run").exists()


BAD_LABELS = {
    "no labels": ("landmarks", {}, "holds no labels"),
    "no such place": ("landmarks", {"annotations": "nowhere"}, "does not exist"),
    "no rows": ("landmarks", {"hands.csv": "video,frame,side,x,y\n"}, "has no rows"),
    "no parquet": ("landmarks", {"hands.parquet": "PAR1 or so"}, "cannot be read"),
    "no side": ("landmarks", {"hands.csv": "video,frame,x,y\na,1,0.5,0.5\n"}, "has no column 'side'"),
    "odd side": ("landmarks", {"hands.csv": "video,frame,side,x,y\na,1,up,0.5,0.5\n"}, "'side' holds 'up'"),
    "no place": ("landmarks", {"hands.csv": "video,frame,side\na,1,left\n"}, "no columns with hand"),
    "word": ("landmarks", {"hands.csv": "video,frame,side,x,y\na,one,left,1,1\n"}, "cannot be read: .*one"),
    "torn": ("landmarks", {"hands.csv": "video,frame,side,x,y\na,1,left\n"}, "Expected 5 columns, got 3"),
    "other videos": ("landmarks", {"hands.csv": "video,frame,side,x,y\nz,1,left,1,1\n"}, "labels are of z"),
    "ego4d none": ("ego4d_fho", {}, "holds no labels"),
    "ego4d other": ("ego4d_fho", {"fho_main.json": '{"clips": []}'}, "is not Ego4D's fho_main.json"),
    "ego4d cut": (
        "ego4d_fho",
        {"fho_main.json": '{"videos": [{"video_'},
        "is not Ego4D's fho_main.json: JSONDecodeError",
    ),
    "ego4d empty": (
        "ego4d_fho",
        {"fho_main.json": '{"videos": [{"video_uid": "a", "annotated_intervals": []}]}'},
        "no boxes of hands",
    ),
    "egoexo none": ("egoexo4d_hand_pose", {}, "holds no labels"),
}


@pytest.mark.parametrize("case", BAD_LABELS)
def test_labels_of_another_form_are_one_clear_error(folder: Path, case: str) -> None:
    labels, files, fault = BAD_LABELS[case]
    layout = {"annotations": files["annotations"]} if "annotations" in files else {}
    for name, text in files.items():
        if name != "annotations":
            (folder / name).write_text(text)
    with pytest.raises(SourceError, match=fault) as caught:
        open_source("hands").index(str(folder), made.hand_video(labels, **layout))
    assert "\n" not in str(caught.value)


def test_a_take_with_labels_of_another_form_is_quarantined(folder: Path) -> None:
    robot = made.hand_video("egoexo4d_hand_pose", part="wrist", camera="a")
    for text, fault in (
        ('{"1": [{"annotation2D": {"a": {"left_wrist": {"x": 1}}}}]}', "is not Ego-Exo4D's hand pose"),
        ('{"frames": []}', "is not Ego-Exo4D's hand pose"),
        (made.egoexo(3, camera="cam05"), "no hands in camera a.*cam05"),
        ("[]", "is not Ego-Exo4D's hand pose"),
        (made.egoexo(3, camera="a")[:500], "is not Ego-Exo4D's hand pose"),
        ('{"1": {"annotation2D": 3}}', "is not Ego-Exo4D's hand pose"),
    ):
        (folder / "a.json").write_text(text)
        with pytest.raises(EpisodeError, match=fault):
            open_source("hands").read(str(folder), "a.mp4", robot)
        assert [ref.id for ref in open_source("hands").index(str(folder), robot)] == ["a.mp4"]


def test_boxes_outside_the_picture_and_labels_after_the_end_are_refused(folder: Path) -> None:
    source, robot = open_source("hands"), made.hand_video("ego4d_fho")
    wide = made.ego4d({"a": [made.ego4d_action(range(20), "#C C")]}).replace('"x": ', '"x": 9')
    (folder / "fho_main.json").write_text(wide)
    with pytest.raises(EpisodeError, match=f"outside the image.*{WIDTH}×{HEIGHT}.*label_size"):
        source.read(str(folder), "a.mp4", robot)
    late = made.ego4d({"a": [made.ego4d_action(range(20, 80), "#C C")]})
    (folder / "fho_main.json").write_text(late)
    with pytest.raises(EpisodeError, match="labelled at frame 79, and has 30 frames"):
        open_source("hands").read(str(folder), "a.mp4", robot)


def test_keys_cameras_and_ids_that_are_not_there_are_named(folder: Path) -> None:
    made.write_table(folder / "hands.csv", made.rows("a", LENGTH))
    source, robot = open_source("hands"), made.hand_video("landmarks")
    with pytest.raises(EpisodeError, match="no label has left/wrist — labels have left/center, right/center"):
        source.read(str(folder), "a.mp4", made.hand_video("landmarks", part="wrist"))
    with pytest.raises(SourceError, match="'left/centre/next' is not a key.*left/center/next"):
        source.read(str(folder), "a.mp4", made.hand_video("landmarks", part="centre"))
    values = robot.to_dict() | {"cameras": [{"name": "primary", "key": "image"}]}
    with pytest.raises(SourceError, match="camera key 'image'"):
        source.index(str(folder), type(robot).from_values(values, "x"))
    for wrong in ("b.mp4", "a.mp4#x", "b.mp4#0"):
        with pytest.raises(SourceError, match="has no episode"):
            source.read(str(folder), wrong, robot)
    with pytest.raises(EpisodeError, match="has 1 runs, no run 4"):
        source.read(str(folder), "a.mp4#4", robot)


def test_a_folder_without_videos_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="holds no videos"):
        videos_of(str(tmp_path))


@given(data=st.data())
def test_any_cut_or_changed_byte_ends_in_an_error_of_ours_or_a_reading(folder, clip, data) -> None:
    name, labels = data.draw(
        st.sampled_from(
            [
                ("a.pkl", "epic_kitchens_hand_objects"),
                ("fho_main.json", "ego4d_fho"),
                ("hands.parquet", "landmarks"),
                ("hands.csv", "landmarks"),
                ("a.mp4", "landmarks"),
            ]
        )
    )
    for old in folder.iterdir():
        old.unlink()
    (folder / "a.mp4").write_bytes(clip.read_bytes())
    if name == "a.pkl":
        (folder / name).write_bytes(pickle.dumps(made.epic_messages(LENGTH)))
    elif name == "fho_main.json":
        (folder / name).write_text(made.ego4d({"a": [made.ego4d_action(range(LENGTH), "#C C")]}))
    else:
        table = folder / ("hands.csv" if name == "a.mp4" else name)
        made.write_table(table, made.rows("a", LENGTH))
    damage(data, folder / name)
    source, robot = open_source("hands"), made.hand_video(labels)
    try:
        for ref in source.index(str(folder), robot):
            aligned = to_clip(source.read(str(folder), ref.id, robot), robot)
            aligned.frames_at("primary", np.array([0, len(aligned) - 1]))
    except HMAError as fault:
        assert "\n" not in str(fault)
