"""Read annotations of hands in videos, by video.

- `landmarks`: the toolkit's own table, see hands_table.
- `epic_kitchens_hand_objects`: EPIC-KITCHENS-100, one file a video, see hands_epic.
- `ego4d_fho`: Ego4D's fho_main.json. Boxes (x, y, width, height in pixels) of left_hand and
  right_hand in a few frames of each narrated action; rejected and invalid actions are left out.
- `egoexo4d_hand_pose`: Ego-Exo4D's ego_pose/<split>/hand/{automatic,annotation}/<take>.json: frame number ->
  joints of one camera in pixels. A take's videos lie in a folder with the take's name.

A file of another form raises one clear error. JSON is parsed once, and only arrays stay in memory.
"""

import json
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, Protocol

import numpy as np

from hma_data.errors import EpisodeError, SourceError
from hma_data.sources.base import first_bytes, local_path
from hma_data.sources.hands.epic import PICKLES, STREAMS, epic_labels
from hma_data.sources.hands.layout import HandsLayout, Video
from hma_data.sources.hands.runs import SIDES, HandLabels, labels_from_rows
from hma_data.sources.hands.table import SUFFIXES, HandTable

LARGEST = 8 << 30  # bytes of a JSON file; fho_main.json has several hundred MB
_FHO = "give fho_main.json of the annotations that Ego4D's command fetches (benchmark FHO)"
_FINGERS = ("thumb", "index", "middle", "ring", "pinky")
JOINTS = ("wrist", *(f"{finger}_{i}" for finger in _FINGERS for i in (1, 2, 3, 4)))


class LabelSet(Protocol):
    """The labels of a set of videos."""

    def known(self) -> list[str]:
        """Return the names that the labels use for their videos."""
        ...

    def of(self, video: Video) -> HandLabels | None:
        """Return the labels of a video; None where it has none.

        Raises:
            EpisodeError: they are damaged.
        """
        ...


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
        return HandTable(_one_file(root, ("hands", "landmarks"), SUFFIXES), layout)
    if layout.labels == "ego4d_fho":
        return Ego4dFho(_one_file(root, ("fho_main",), (".json",)), layout)
    if layout.labels == "egoexo4d_hand_pose":
        return EgoExoHands(_label_files(root, (".json",)), layout, root)
    if root.is_file() and root.suffix.lower() in SUFFIXES:
        return HandTable(root, layout)
    return EpicHands(_label_files(root, (*PICKLES, *STREAMS, *SUFFIXES)), layout, root)


def _one_file(root: Path, stems: tuple[str, ...], suffixes: tuple[str, ...]) -> Path:
    if root.is_file():
        return root
    names = [f"{stem}{suffix}" for stem in stems for suffix in suffixes]
    found = sorted(path for path in root.rglob("*") if path.name in names and path.is_file())
    if len(found) != 1:
        fault = f"holds {len(found)} files called {' or '.join(names)}" if found else "holds no labels"
        raise SourceError(
            root, fault, f"give source.layout.annotations; looked for {', '.join(names)} in all folders"
        )
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
        raise SourceError(
            root, "holds no labels", f"looked for {', '.join(suffixes)}; give source.layout.annotations"
        )
    return found


class EpicHands:
    """Labels of EPIC-KITCHENS-100: `P01_01.MP4` has its labels in `P01_01.pkl`."""

    def __init__(self, files: dict[str, Path], layout: HandsLayout, root: Path) -> None:
        self._files, self._layout = files, layout

    def known(self) -> list[str]:
        """See LabelSet."""
        return list(self._files)

    def of(self, video: Video) -> HandLabels | None:
        """See LabelSet."""
        path = self._files.get(PurePosixPath(video.name).stem)
        if path is None:
            return None
        if path.suffix.lower() in SUFFIXES:
            return HandTable(path, self._layout).of(video)
        return epic_labels(path, self._layout)


class Ego4dFho:
    """Labels of Ego4D; a video's name is its uid."""

    def __init__(self, path: Path, layout: HandsLayout) -> None:
        content = read_json(path, _compact)
        videos = content.get("videos") if isinstance(content, dict) else None
        if not isinstance(videos, list) or not any(isinstance(item, dict) for item in videos):
            raise SourceError(path, "is not Ego4D's fho_main.json: it has no list of videos", _FHO)
        self._videos = {}
        for item in videos:
            labels = _labels_of_actions(item.get("actions", []), layout) if isinstance(item, dict) else None
            if labels is not None:
                self._videos[str(item["uid"])] = labels
        if not self._videos:
            raise SourceError(path, "has no boxes of hands", _FHO)

    def known(self) -> list[str]:
        """See LabelSet."""
        return list(self._videos)

    def of(self, video: Video) -> HandLabels | None:
        """See LabelSet."""
        return self._videos.get(PurePosixPath(video.name).stem)


def _compact(item: dict[str, Any]) -> Any:
    """Return what is kept of an object while fho_main.json is parsed, innermost objects first.

    The whole file would not fit in memory.
    """
    if "object_type" in item:
        box, kind = item.get("bbox"), item["object_type"]
        if not isinstance(box, dict) or kind not in ("left_hand", "right_hand"):
            return None
        return kind, *(box.get(key) for key in ("x", "y", "width", "height"))
    if "boxes" in item and "frame_number" in item:
        return item["frame_number"], [box for box in item["boxes"] or [] if isinstance(box, tuple)]
    if "narration_text" in item and "frames" in item:
        refused = item.get("is_rejected") or item.get("is_invalid_annotation")
        frames = [frame for frame in item["frames"] or [] if isinstance(frame, tuple)]
        return None if refused or not frames else (str(item["narration_text"] or ""), frames)
    if "narrated_actions" in item:
        return [action for action in item["narrated_actions"] or [] if isinstance(action, tuple)]
    if "annotated_intervals" in item and "video_uid" in item:
        intervals = item["annotated_intervals"] or []
        actions = [action for part in intervals if isinstance(part, list) for action in part]
        return {"uid": item["video_uid"], "actions": actions}
    return item


def _labels_of_actions(actions: list[Any], layout: HandsLayout) -> HandLabels | None:
    rows, looked_at, texts = [], [], []
    try:
        for text, frames in actions:
            numbers = [int(frame) - layout.frame_offset for frame, _ in frames]
            looked_at += numbers
            texts.append((min(numbers), text))
            for number, (_, boxes) in zip(numbers, frames):
                for kind, x, y, width, height in boxes:
                    rows.append((number, kind == "right_hand", x + width / 2, y + height / 2))
    except (TypeError, ValueError) as fault:
        raise SourceError("fho_main.json", f"has a box or frame that is no number: {fault}") from fault
    if not rows:
        return None
    table = np.array(rows, np.float64)
    return labels_from_rows(
        table[:, 0].astype(np.int64),
        table[:, 1].astype(np.int64),
        np.ones(len(table)),
        {"center": table[:, 2:]},
        looked_at,
        pixels=True,
        irregular=True,
        texts=tuple(sorted(texts)),
    )


class EgoExoHands:
    """Labels of Ego-Exo4D, by take; the videos of a take lie in its folder, one a camera.

    The names of the takes come from the label files, or from takes.json beside or above them. A video may
    also have the name of its take or the take's uid.
    """

    def __init__(self, files: dict[str, Path], layout: HandsLayout, root: Path) -> None:
        self._layout = layout
        self._files = {stem: path for stem, path in files.items() if stem != "takes"}
        takes = next(
            (path for path in (root / "takes.json", root.parent / "takes.json") if path.is_file()), None
        )
        listed = read_json(takes) if takes else []
        names = {
            item["take_uid"]: item["take_name"]
            for item in (listed if isinstance(listed, list) else [])
            if isinstance(item, dict) and {"take_uid", "take_name"} <= set(item)
        }
        self._uids: dict[str, str] = {}
        for uid, path in self._files.items():
            self._uids[uid] = uid
            self._uids[str(names.get(uid) or _take_name(path))] = uid

    def known(self) -> list[str]:
        """See LabelSet."""
        return list(self._uids)

    def of(self, video: Video) -> HandLabels | None:
        """See LabelSet."""
        place = PurePosixPath(video.name)
        called = next((part for part in (place.stem, *place.parts[:-1]) if part in self._uids), None)
        if called is None or (called != place.stem and place.stem != self._layout.camera):
            return None
        return egoexo_labels(self._files[self._uids[called]], self._layout)


def _take_name(path: Path) -> str:
    """Return the take's name, as its first labelled frame states it; else the file's own name."""
    stated = re.search(rb'"take_name"\s*:\s*"([^"]{1,200})"', first_bytes(path, 1 << 16))
    return stated[1].decode(errors="replace") if stated else path.stem


def egoexo_labels(path: Path, layout: HandsLayout) -> HandLabels:
    """Return the hands of one take in one camera.

    Raises:
        EpisodeError: the file is damaged, of another form, or has no such camera.
    """
    content = read_json(path)
    if not isinstance(content, dict) or not all(number.isdecimal() for number in content):
        raise EpisodeError(path, "is not Ego-Exo4D's hand pose: its keys are no frame numbers")
    frames, sides, joints, cameras = [], [], [], set()
    try:
        for number, people in content.items():
            views = (people[0].get("annotation2D") or {}) if people else {}
            cameras |= set(views)
            named = views.get(layout.camera) or {}
            for side, name in enumerate(SIDES):
                mine = [named.get(f"{name}_{joint}") for joint in JOINTS]
                if any(mine):
                    frames.append(int(number) - layout.frame_offset)
                    sides.append(side)
                    joints.append([(at["x"], at["y"]) if at else (np.nan, np.nan) for at in mine])
        points = np.array(joints, np.float64).reshape(-1, 21, 2)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as fault:
        raise EpisodeError(path, f"is not Ego-Exo4D's hand pose: {fault!r}") from fault
    if not frames:
        raise EpisodeError(
            path,
            f"has no hands in camera {layout.camera}",
            f"its cameras: {', '.join(sorted(cameras)) or 'none'}",
        )
    parts = {
        "wrist": points[:, 0],
        "center": (points.min(axis=1) + points.max(axis=1)) / 2,
        "landmarks": points.reshape(-1, 42),
    }
    looked_at = [int(number) - layout.frame_offset for number in content]
    scores = np.ones(len(frames))
    return labels_from_rows(np.array(frames), np.array(sides), scores, parts, looked_at, pixels=True)


def read_json(path: Path, keep: Callable[[dict[str, Any]], Any] | None = None) -> Any:
    """Return the content of a JSON file.

    Args:
        keep: called with each parsed object; its result replaces the object.

    Raises:
        SourceError: it is too large, damaged, or not JSON.
    """
    size = path.stat().st_size
    if size > LARGEST:
        raise SourceError(path, f"has {size:,} bytes, more than {LARGEST:,}")
    parse = partial(json.loads, object_hook=keep) if keep else json.loads
    try:
        return parse(path.read_bytes())
    except (ValueError, RecursionError, MemoryError) as fault:
        raise SourceError(path, f"is no JSON, or cut off: {fault}", "fetch the file again") from fault
