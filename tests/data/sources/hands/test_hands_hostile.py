"""Hand videos that are damaged, hostile, or do not fit their labels."""

import json
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from hma_data.errors import EpisodeError, RegistryError, SourceError
from hma_data.sources.base import open_source
from tests.data import hands_files as made
from tests.data.videos import HEIGHT, WIDTH
from tests.hostile import Edit, Row, Touch, check_refused, cut, of, untouched, whole

LENGTH, NAMES = 30, ("a", "b", "c")
EPIC, EGO4D, EXO = "epic_kitchens_hand_objects", "ego4d_fho", "egoexo4d_hand_pose"


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
def test_a_wrong_layout_says_where_and_what_is_allowed(layout: dict[str, Any], fault: str) -> None:
    key = next(iter(layout))
    with pytest.raises(RegistryError, match=rf"source\.layout\.{key}: .*{fault}"):
        made.hand_video("landmarks", **layout)


def write_labels(folder: Path, labels: str, names: Sequence[str] = NAMES, table: str = "hands.csv") -> None:
    action = made.ego4d_action(range(LENGTH), "#C C")
    if labels == "landmarks":
        made.write_table(folder / table, [row for name in names for row in made.rows(name, LENGTH)])
    elif labels == EGO4D:
        (folder / "fho_main.json").write_text(made.ego4d({name: [action] for name in names}))
    for name in names:
        if labels == EPIC:
            (folder / f"{name}.pkl").write_bytes(pickle.dumps(made.epic_messages(LENGTH)))
        elif labels == EXO:
            (folder / f"{name}.json").write_text(made.egoexo(LENGTH, camera="a"))


def ego4d(text: str, frames: range) -> Edit:
    """Return an edit that labels the first video by those frames, and replaces a text in its labels."""
    old, new = text.split(">")

    def edit(path: Path) -> None:
        good = made.ego4d_action(range(LENGTH), "#C C")
        first = made.ego4d({"a": [made.ego4d_action(frames, "#C C")]}).replace(old, new)
        videos = json.loads(first)["videos"]
        videos += json.loads(made.ego4d({"b": [good], "c": [good]}))["videos"]
        path.write_text(json.dumps({"videos": videos}))

    return of("fho_main.json", edit)


def table(content: str) -> Edit:
    return of("hands.csv", whole(content))


def moved(name: str, content: str) -> Edit:
    """Return an edit that leaves labels of another name instead of the table."""
    return lambda folder: (folder / "hands.csv").rename(folder / name).write_text(content)


def of_format(labels: str, **more: Any) -> dict[str, Any]:
    return {"labels": labels, **more}


TAKE = of_format(EXO, part="wrist", camera="a")
CODE = pickle.dumps([*made.epic_messages(3), Touch("ran")])
HEAD, POSE = "video,frame,side,x,y\n", "is not Ego-Exo4D's hand pose"
NO_INTERVAL = '{"videos": [{"video_uid": "a", "annotated_intervals": []}]}'
POINT = '{"1": [{"annotation2D": {"a": {"left_wrist": {"x": 1}}}}]}'
ONE: dict[str, Row] = {  # one video is refused
    "code in a pickle": (of("a.pkl", whole(CODE)), "is neither a plain value nor an array", of_format(EPIC)),
    "a pickle cut short": (of("a.pkl", cut(500)), r"a\.pkl: .*", of_format(EPIC)),
    "a video cut short": (of("a.mp4", cut(600)), r"a\.mp4: .*cut off", of_format(EPIC)),
    "a take of one point": (of("a.json", whole(POINT)), POSE, TAKE),
    "a take of frames": (of("a.json", whole('{"frames": []}')), POSE, TAKE),
    "a take of a list": (of("a.json", whole("[]")), POSE, TAKE),
    "a take of numbers": (of("a.json", whole('{"1": {"annotation2D": 3}}')), POSE, TAKE),
    "a take cut short": (of("a.json", cut(500)), POSE, TAKE),
    "a take of lists in lists": (of("a.json", whole("[" * 200_000)), POSE, TAKE),
    "a take of another camera": (
        of("a.json", whole(made.egoexo(3, camera="cam05"))), "no hands in camera a.*cam05", TAKE,
    ),
    "boxes outside the image": (
        ego4d('"x": >"x": 9', range(20)), f"outside the image.*{WIDTH}×{HEIGHT}.*_size", of_format(EGO4D),
    ),
    "labels after the end": (
        ego4d(">", range(20, 80)), "labelled at frame 79, and has 30 frames", of_format(EGO4D),
    ),
}  # fmt: skip
ALL: dict[str, Row] = {  # no video can be used
    "no labels": (of("hands.csv", Path.unlink), "holds no labels"),
    "no such place": (untouched, "does not exist", {"annotations": "nowhere"}),
    "no rows": (table(HEAD), "has no rows"),
    "no parquet": (moved("hands.parquet", "PAR1 or so"), "cannot be read"),
    "no side": (table("video,frame,x,y\na,1,0.5,0.5\n"), "has no column 'side'"),
    "an odd side": (table(HEAD + "a,1,up,0.5,0.5\n"), "'side' holds 'up'"),
    "no place": (table("video,frame,side\na,1,left\n"), "no columns with hand"),
    "a word": (table(HEAD + "a,one,left,1,1\n"), "cannot be read: .*one"),
    "a torn line": (table(HEAD + "a,1,left\n"), "Expected 5 columns, got 3"),
    "other videos": (table(HEAD + "z,1,left,1,1\n"), "labels are of z"),
    "Ego4D: none": (of("fho_main.json", Path.unlink), "holds no labels", of_format(EGO4D)),
    "Ego4D: other": (of("fho_main.json", whole('{"clips": []}')), "is not Ego4D's fho_", of_format(EGO4D)),
    "Ego4D: cut": (of("fho_main.json", cut(30)), "fho_main.json: JSONDecodeError", of_format(EGO4D)),
    "Ego4D: empty": (of("fho_main.json", whole(NO_INTERVAL)), "no boxes of hands", of_format(EGO4D)),
    "Ego4D: lists in lists": (
        of("fho_main.json", whole("[" * 200_000)),
        "fho_main.json: RecursionError",
        of_format(EGO4D),
    ),
    "Ego-Exo4D: none": (untouched, "holds no labels", of_format(EXO)),
    "another rate": (untouched, "labelled at 10 Hz, embodiment test_hands says frequency_hz 30", {"hz": 30}),
    "no such part": (untouched, "no label has left/wrist — labels have left/center", {"part": "wrist"}),
    "no videos": (lambda folder: [path.unlink() for path in folder.glob("*.mp4")], "holds no videos"),
}


@pytest.mark.parametrize("case", [*ONE, *ALL])
def test_hostile_videos_or_labels_are_one_line(case: str, clip: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "set"
    folder.mkdir()
    row = (ONE | ALL)[case]
    options: dict[str, Any] = {"labels": "landmarks"} | dict(*row[2:])
    for name in NAMES:
        (folder / f"{name}.mp4").write_bytes(clip.read_bytes())
    write_labels(folder, "" if case == "Ego-Exo4D: none" else options["labels"])
    check_refused(row, folder, made.hand_video(**options), tmp_path / "out", one=case in ONE)
    assert not (tmp_path / "ran").exists()


def test_cameras_and_ids_that_are_not_there_are_named(folder: Path) -> None:
    made.write_table(folder / "hands.csv", made.rows("a", LENGTH))
    source, robot = open_source("hands"), made.hand_video("landmarks")
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


def test_a_take_whose_name_is_a_list_is_found_by_its_uid(folder: Path) -> None:
    write_labels(folder, EXO, ["a"])
    (folder / "takes.json").write_text('[{"take_uid": "a", "take_name": ["cook"]}]')
    robot = made.hand_video(EXO, part="wrist", camera="a")
    assert [ref.id for ref in open_source("hands").index(str(folder), robot)] == ["a.mp4#0"]
