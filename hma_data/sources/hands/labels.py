"""Read annotations of hands in videos, by video.

- `landmarks`: the toolkit's own table, see table_labels.
- `epic_kitchens_hand_objects`: EPIC-KITCHENS-100's published hand-object detections, one pickle a video.
- `ego4d_fho`: Ego4D's fho_main.json. Boxes (x, y, width, height in pixels) of left_hand and
  right_hand in a few frames of each narrated action; rejected and invalid actions are left out.
- `egoexo4d_hand_pose`: Ego-Exo4D's ego_pose/<split>/hand/{automatic,annotation}/<take>.json: frame number ->
  joints of one camera in pixels. A take's videos lie in a folder with the take's name.

EPIC-KITCHENS's pickles are read as plain values only; nothing in them runs.

R rows of a table, one a hand.
"""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from hma_data.arrays import Floats
from hma_data.errors import EpisodeError, SourceError
from hma_data.registry.components import HandsLayout
from hma_data.sources.common.pickles import load_plain
from hma_data.sources.common.places import first_bytes, local_path
from hma_data.sources.hands.runs import SIDES, HandLabels, Video, labels_from_rows

PICKLES, TABLES = (".pkl", ".pickle"), (".parquet", ".csv")
_FINGERS = ("thumb", "index", "middle", "ring", "pinky")
JOINTS = ("wrist", *(f"{finger}_{i}" for finger in _FINGERS for i in (1, 2, 3, 4)))
_FHO = "give fho_main.json of the annotations that Ego4D's command fetches (benchmark FHO)"


@dataclass(frozen=True)
class LabelSet:
    """The labels of some videos."""

    known: list[str]  # the names that the labels use for their videos
    of: Callable[[Video], HandLabels | None]  # None without labels; raises EpisodeError for damaged ones


def open_labels(layout: HandsLayout, uri: str) -> LabelSet:
    """Return the labels that belong to the videos of `uri`.

    Raises:
        SourceError: there are none, or they have another form.
    """
    folder = local_path(uri)
    folder = folder.parent if folder.is_file() else folder
    root = folder / Path(layout.annotations).expanduser() if layout.annotations else folder
    if not root.exists():
        raise SourceError(root, "does not exist", "correct source.layout.annotations")
    if layout.labels == "landmarks":
        names = [stem + suffix for stem in ("hands", "landmarks") for suffix in TABLES]
        return table_labels(_one_file(root, names), layout)
    if layout.labels == "ego4d_fho":
        return _fho_labels(_one_file(root, ["fho_main.json"]), layout)
    if layout.labels == "egoexo4d_hand_pose":
        return _egoexo_labels(_label_files(root, (".json",)), layout, root)
    return _epic_labels(_label_files(root, PICKLES), layout)


def _one_file(root: Path, names: list[str]) -> Path:
    if root.is_file():
        return root
    found = sorted(path for path in root.rglob("*") if path.name in names and path.is_file())
    if len(found) != 1:
        fault = f"holds {len(found)} files of labels" if found else "holds no labels"
        remedy = f"give source.layout.annotations; looked for {', '.join(names)} in all folders"
        raise SourceError(root, fault, remedy)
    return found[0]


def _label_files(root: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    """Return label files by stem; of two, the one in a folder `automatic` (Ego-Exo4D's dense labels)."""
    files = sorted(path for path in (root.rglob("*") if root.is_dir() else [root]) if path.is_file())
    files = [path for path in files if path.suffix.lower() in suffixes]
    hands = [path for path in files if "hand" in path.parts]  # other folders hold labels of bodies
    found: dict[str, Path] = {}
    for path in sorted(hands or files, key=lambda item: "automatic" not in item.parts):
        found.setdefault(path.stem, path)
    if not found:
        remedy = f"give source.layout.annotations; looked for {', '.join(suffixes)}"
        raise SourceError(root, "holds no labels", remedy)
    return found


# -- the toolkit's own table

_FORMS: dict[str, tuple[str, ...]] = {
    "box": ("left", "top", "right", "bottom"),
    "center": ("x", "y"),
    "wrist": ("wrist_x", "wrist_y"),
}


def table_labels(path: Path, layout: HandsLayout) -> LabelSet:
    """Return the labels of a table of hands: parquet or CSV, one row a hand.

    | column | meaning |
    |---|---|
    | video | the video's path below the folder, with or without its suffix, or its bare name |
    | frame | index of the frame in the video, from 0 (or from source.layout.first_frame) |
    | side | left or right, the person's own hand |
    | score | optional: rows below source.layout.min_score are ignored |

    and one of these, as fractions of the image's width and height (x to the right, y down):

    | columns | gives |
    |---|---|
    | landmarks | 42 numbers, x and y of MediaPipe's 21 points (0 is the wrist): landmarks, center, wrist |
    | left, top, right, bottom | a box: center |
    | x, y | center; with wrist_x, wrist_y beside them or alone: wrist |

    A value that is not finite says that there is no hand.

    Raises:
        SourceError: it cannot be read, lacks a column, or has another kind of value.
    """

    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet as pq

    try:
        if path.suffix.lower() == ".csv":
            text = dict.fromkeys(("video", "side"), pa.string())
            options = pyarrow.csv.ConvertOptions(column_types=text)
            table = pyarrow.csv.read_csv(path, convert_options=options)
        else:
            table = pq.read_table(path)
        columns = dict(zip(table.column_names, table.columns, strict=True))
        absent = [name for name in ("video", "frame", "side") if name not in columns]
        if absent or not table.num_rows:
            fault = f"has no column {absent[0]!r}" if absent else "has no rows"
            raise SourceError(path, fault, f"its columns: {', '.join(columns)}")
        numbers = _numbers(columns["frame"])
        scores = _numbers(columns["score"]) if "score" in columns else np.ones(len(numbers))
        parts = _parts(columns, path)
    except (pa.ArrowException, OSError, ValueError) as fault:
        said = " ".join(f"cannot be read: {fault}".split())
        raise SourceError(path, said, "write the table again as parquet or CSV") from fault
    stated = columns["side"].to_pylist()
    if unknown := set(stated) - set(SIDES):
        raise SourceError(path, f"column 'side' holds {unknown.pop()!r}", "allowed: left, right")
    sides = np.array([SIDES.index(side) for side in stated], np.int64)
    good = np.isfinite(numbers) & ~(scores < layout.min_score)
    frames = np.where(good, numbers, 0).astype(np.int64) - layout.frame_offset
    names, number = np.unique(np.array(columns["video"].to_pylist(), str), return_inverse=True)
    order = np.argsort(number, kind="stable")
    ends = np.cumsum(np.bincount(number))
    rows = {str(name): mine[good[mine]] for name, mine in zip(names, np.split(order, ends[:-1]), strict=True)}

    def of(video: Video) -> HandLabels | None:
        name = next((alias for alias in video.aliases if alias in rows), None)
        if name is None:
            return None
        mine = rows[name]
        own = {part: values[mine] for part, values in parts.items()}
        return labels_from_rows(frames[mine], sides[mine], scores[mine], own)

    return LabelSet(list(rows), of)


def _numbers(column: Any) -> Floats:
    values: Floats = column.cast("float64").to_numpy()
    return np.where(np.abs(values) < 1e9, values, np.nan)


def _parts(columns: dict[str, Any], path: Path) -> dict[str, Floats]:
    """Return center, wrist or landmarks -> (R, 2 or 42), by the columns there are."""
    if "landmarks" in columns:
        rows = [[np.nan] * 42 if row is None else row for row in columns["landmarks"].to_pylist()]
        return {"landmarks": np.array(rows, np.float64).reshape(len(rows), 42)}
    found = {
        part: np.stack([_numbers(columns[name]) for name in names], axis=1)
        for part, names in _FORMS.items()
        if all(name in columns for name in names)
    }
    if "box" in found:
        box = found.pop("box")
        found["center"] = (box[:, :2] + box[:, 2:]) / 2
    if not found:
        forms = "; ".join(", ".join(names) for names in _FORMS.values())
        raise SourceError(path, "has no columns with hand positions", f"give landmarks, or one of: {forms}")
    return found


# -- EPIC-KITCHENS-100


def _epic_labels(files: dict[str, Path], layout: HandsLayout) -> LabelSet:
    """Return labels of EPIC-KITCHENS-100: `P01_01.MP4` has its labels in `P01_01.pkl`.

    A file is a pickled list of byte strings, each a protobuf message of one frame (types.proto of
    epic-kitchens/epic-kitchens-100-hand-object-bboxes). Boxes are fractions of the image.
    """

    def of(video: Video) -> HandLabels | None:
        path = files.get(PurePosixPath(video.name).stem)
        return _boxes_of(path, layout) if path else None

    return LabelSet(list(files), of)


def _boxes_of(path: Path, layout: HandsLayout) -> HandLabels:
    from hma_data.sources.common.protobuf import message_class

    looked_at, rows = [], []
    kind = message_class(_DETECTIONS, "hands.Frame")
    try:
        for message in load_plain(path.read_bytes()):
            frame = kind.FromString(message)
            index = frame.frame_number - layout.frame_offset
            looked_at.append(index)
            for hand in frame.hands:
                if hand.score >= layout.min_score:
                    box = hand.bbox
                    centre = ((box.left + box.right) / 2, (box.top + box.bottom) / 2)
                    rows.append((index, hand.side, hand.score, *centre))
    except Exception as fault:  # damaged bytes make pickle and protobuf raise a dozen different types
        remedy = "fetch the file again, or write its hands as a table and set labels: landmarks"
        raise EpisodeError(path, f"cannot be read as a list of messages: {fault}", remedy) from fault
    return _of_centers(rows, looked_at)


def _of_centers(rows: Sequence[tuple[float, ...]], looked_at: list[int], **facts: Any) -> HandLabels:
    """Make labels of rows (frame, side, score, x, y); see `labels_from_rows`."""
    table = np.array(rows, np.float64).reshape(-1, 5)
    frames, sides = table[:, :2].astype(np.int64).T
    return labels_from_rows(frames, sides, table[:, 2], {"center": table[:, 3:]}, looked_at, **facts)


# the fields of EPIC-KITCHENS' types.proto that are read
_DETECTIONS = """
    name: "hands.proto" package: "hands" syntax: "proto3"
    message_type {
        name: "Box"
        field { name: "left" number: 1 type: TYPE_FLOAT } field { name: "top" number: 2 type: TYPE_FLOAT }
        field { name: "right" number: 3 type: TYPE_FLOAT } field { name: "bottom" number: 4 type: TYPE_FLOAT }
    }
    message_type {
        name: "Hand"
        field { name: "bbox" number: 1 type: TYPE_MESSAGE type_name: "Box" }
        field { name: "score" number: 2 type: TYPE_FLOAT } field { name: "side" number: 5 type: TYPE_INT32 }
    }
    message_type {
        name: "Frame" field { name: "frame_number" number: 2 type: TYPE_INT32 }
        field { name: "hands" number: 3 label: LABEL_REPEATED type: TYPE_MESSAGE type_name: "Hand" }
    }
"""


# -- Ego4D


def _fho_labels(path: Path, layout: HandsLayout) -> LabelSet:
    """Return labels of Ego4D; a video's name is its uid."""
    try:
        videos = json.loads(path.read_bytes(), object_hook=_compact)["videos"]
        labels = {str(item["uid"]): _labels_of_actions(item["actions"], layout) for item in videos}
    except (AttributeError, KeyError, RecursionError, TypeError, ValueError) as fault:
        raise SourceError(path, f"is not Ego4D's fho_main.json: {fault!r}", _FHO) from fault
    known = [uid for uid, found in labels.items() if found]
    if not known:
        raise SourceError(path, "has no boxes of hands", _FHO)
    return LabelSet(known, lambda video: labels.get(PurePosixPath(video.name).stem))


def _compact(item: dict[str, Any]) -> Any:
    """Return what is kept of an object while fho_main.json, too large for memory, is parsed from inside."""
    if "object_type" in item:
        box, kind = item.get("bbox"), item["object_type"]
        sides = ("x", "y", "width", "height")
        return (kind, *(box[side] for side in sides)) if box and kind in ("left_hand", "right_hand") else None
    if "boxes" in item and "frame_number" in item:
        return item["frame_number"], [box for box in item["boxes"] or [] if box]
    if "narration_text" in item and "frames" in item:
        refused = item.get("is_rejected") or item.get("is_invalid_annotation")
        frames = [frame for frame in item["frames"] or [] if isinstance(frame, tuple)]
        return None if refused or not frames else (str(item["narration_text"] or ""), frames)
    if "narrated_actions" in item:
        return [action for action in item["narrated_actions"] or [] if action]
    if "annotated_intervals" in item and "video_uid" in item:
        intervals = item["annotated_intervals"] or []
        return {"uid": item["video_uid"], "actions": [action for part in intervals for action in part]}
    return item


def _labels_of_actions(actions: list[Any], layout: HandsLayout) -> HandLabels | None:
    rows, looked_at, texts = [], [], []
    for text, frames in actions:
        numbers = [int(frame) - layout.frame_offset for frame, _ in frames]
        looked_at += numbers
        texts.append((min(numbers), text))
        for number, (_, boxes) in zip(numbers, frames, strict=True):
            for kind, x, y, width, height in boxes:
                rows.append((number, kind == "right_hand", 1.0, x + width / 2, y + height / 2))
    if not rows:
        return None
    return _of_centers(rows, looked_at, pixels=True, irregular=True, texts=tuple(sorted(texts)))


# -- Ego-Exo4D


def _egoexo_labels(files: dict[str, Path], layout: HandsLayout, root: Path) -> LabelSet:
    """Return labels of Ego-Exo4D, by take; the videos of a take lie in its folder, one a camera.

    The names of the takes come from the label files, or from takes.json beside or above them. A video may
    also have the name of its take or the take's uid.
    """
    names: dict[str, str] = {}
    for path in (root.parent / "takes.json", root / "takes.json"):
        try:
            takes = json.loads(path.read_bytes()) if path.is_file() else []
            names |= {str(take["take_uid"]): str(take["take_name"]) for take in takes}
        except (KeyError, RecursionError, TypeError, ValueError) as fault:
            raise SourceError(path, f"is not Ego-Exo4D's takes.json: {fault!r}") from fault
    by_take = {uid: path for uid, path in files.items() if uid != "takes"}
    by_name = dict(by_take)
    for uid, path in by_take.items():
        if uid not in names:
            stated = re.search(rb'"take_name"\s*:\s*"([^"]+)"', first_bytes(path, 1 << 16))
            names[uid] = stated[1].decode(errors="replace") if stated else uid
        by_name[names[uid]] = path

    def of(video: Video) -> HandLabels | None:
        place = PurePosixPath(video.name)
        called = next((part for part in (place.stem, *place.parts[:-1]) if part in by_name), None)
        if called is None or (called != place.stem and place.stem != layout.camera):
            return None
        return _joints_of(by_name[called], layout)

    return LabelSet(list(by_name), of)


def _joints_of(path: Path, layout: HandsLayout) -> HandLabels:
    frames, sides, joints, cameras = [], [], [], set()
    try:
        content = json.loads(path.read_bytes())
        looked_at = [int(number) - layout.frame_offset for number in content]
        for index, people in zip(looked_at, content.values(), strict=True):
            views = (people[0].get("annotation2D") or {}) if people else {}
            cameras |= set(views)
            named = views.get(layout.camera) or {}
            for side, name in enumerate(SIDES):
                mine = [named.get(f"{name}_{joint}") for joint in JOINTS]
                if any(mine):
                    frames.append(index)
                    sides.append(side)
                    joints.append([(at["x"], at["y"]) if at else (np.nan, np.nan) for at in mine])
        points = np.array(joints, np.float64).reshape(-1, 21, 2)
    except (AttributeError, IndexError, KeyError, OSError, RecursionError, TypeError, ValueError) as fault:
        raise EpisodeError(path, f"is not Ego-Exo4D's hand pose: {fault!r}") from fault
    if not frames:
        remedy = f"its cameras: {', '.join(sorted(cameras)) or 'none'}"
        raise EpisodeError(path, f"has no hands in camera {layout.camera}", remedy)
    center = (points.min(axis=1) + points.max(axis=1)) / 2
    parts = {"wrist": points[:, 0], "center": center, "landmarks": points.reshape(-1, 42)}
    scores = np.ones(len(frames))
    return labels_from_rows(np.array(frames), np.array(sides), scores, parts, looked_at, pixels=True)
