"""Read the layout of hand videos from a YAML, and find the videos of a folder.

`source.layout` of an embodiment with format `hands`; all values are text, as in every layout:

| key | values | default |
|---|---|---|
| labels | detector, landmarks, epic_kitchens_hand_objects, ego4d_fho, egoexo4d_hand_pose | detector |
| annotations | file or folder of the labels, absolute or below the videos' folder | that folder |
| models | of the detector: folder of .tflite files or a .task bundle | $HMA_HAND_MODELS |
| missing | what a frame without a needed hand does, see below: split, hold, mask | split |
| max_hold | most labelled frames in a row for which the last position is held | no limit; with mask 0 |
| min_frames | runs with fewer frames (with hands) are left out | 12 |
| min_score | labels with a lower score are ignored | 0.5 |
| max_gap_s | most seconds between labels of one run, where labels are irregular | 3 |
| pictures | labelled: frames with a label; every: all from the first to the last of a run | labelled |
| first_frame | number of a video's first frame in the labels | 1 for EPIC-KITCHENS, else 0 |
| label_size | WIDTHxHEIGHT of the pictures on which pixel labels were made | the video's |
| camera | Ego-Exo4D: which camera's labels and videos | cam01 |
| mirrored | true for mirrored pictures (front cameras): swaps the detector's left and right | false |

missing: `split` ends the run. `hold` keeps the hand's last position for at most `max_hold` frames, and then
ends the run. `mask` continues the run: the values that need the hand are unknown; with `max_hold` they are
held first, and unknown after that.
"""

import os
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from hma_data.errors import EpisodeError, RegistryError, SourceError
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import leaves, local_path, nothing_there
from hma_data.sources.hands import VIDEO_SUFFIXES

LABELS = ("detector", "landmarks", "epic_kitchens_hand_objects", "ego4d_fho", "egoexo4d_hand_pose")
_CHOICES = {
    "labels": LABELS,
    "missing": ("split", "hold", "mask"),
    "pictures": ("labelled", "every"),
    "mirrored": ("true", "false"),
}
_NUMBERS = {"max_hold": int, "min_frames": int, "first_frame": int, "min_score": float, "max_gap_s": float}
_TEXTS = ("annotations", "models", "label_size", "camera")


@dataclass(frozen=True)
class HandsLayout:
    """The values of `source.layout`; see the module."""

    labels: str = "detector"
    annotations: str | None = None
    models: str | None = None
    missing: str = "split"
    max_hold: int | None = None
    min_frames: int = 12
    min_score: float = 0.5
    max_gap_s: float = 3.0
    pictures: str = "labelled"
    first_frame: int | None = None
    label_size: tuple[int, int] | None = None
    camera: str = "cam01"
    mirrored: bool = False

    @property
    def frame_offset(self) -> int:
        """Return the number to subtract from a label's frame number to get the frame's index."""
        if self.first_frame is not None:
            return self.first_frame
        return int(self.labels == "epic_kitchens_hand_objects")


def layout_of(embodiment: Embodiment | None) -> HandsLayout:
    """Return an embodiment's layout; all defaults without one.

    Raises:
        RegistryError: an unknown key, or a value that is not allowed.
    """
    if embodiment is None:
        return HandsLayout()
    where = f"embodiment {embodiment.id}: source.layout"
    values: dict[str, object] = {}
    for key, text in (embodiment.source.layout or {}).items():
        if key in _CHOICES:
            if text not in _CHOICES[key]:
                raise RegistryError(f"{where}.{key}", f"is {text!r}", f"allowed: {', '.join(_CHOICES[key])}")
            values[key] = text == "true" if key == "mirrored" else text
        elif key in _NUMBERS:
            values[key] = _number(text, _NUMBERS[key], f"{where}.{key}")
        elif key == "label_size":
            values[key] = _size(text, f"{where}.{key}")
        elif key in _TEXTS:
            values[key] = text
        else:
            known = ", ".join([*_CHOICES, *_NUMBERS, *_TEXTS])
            raise RegistryError(f"{where}.{key}", "is not a key of hand videos", f"allowed: {known}")
    return HandsLayout(**values)  # type: ignore[arg-type]


def _number(text: str, kind: type, where: str) -> float:
    try:
        value = kind(text)
    except ValueError as fault:
        raise RegistryError(where, f"is {text!r}", "a number is wanted") from fault
    if not 0 <= value < 1e9:
        raise RegistryError(where, f"is {text}", "a number from 0 up is wanted")
    return float(value) if kind is float else int(value)


def _size(text: str, where: str) -> tuple[int, int]:
    sides = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if not sides or not int(sides[1]) * int(sides[2]):
        raise RegistryError(where, f"is {text!r}", "WIDTHxHEIGHT is wanted, such as 1920x1080")
    return int(sides[1]), int(sides[2])


@dataclass(frozen=True)
class Video:
    """A video file of the source.

    Attributes:
        path: of the file.
        name: its path within the folder; the id of its episode.
        aliases: names that labels may use for it, the most exact first.
    """

    path: Path
    name: str
    aliases: tuple[str, ...]


def videos_of(uri: str) -> dict[str, Video]:
    """Return the videos of a file or folder by name, in natural order.

    Raises:
        SourceError: there are none, or a link leaves the folder.
    """
    root = local_path(uri)
    if root.is_file():
        if root.suffix.lower() not in VIDEO_SUFFIXES:
            raise SourceError(root, "is not a video file", f"looked for {', '.join(VIDEO_SUFFIXES)}")
        return {root.name: Video(root, root.name, (root.name, root.stem))}
    paths: dict[str, Path] = {}
    for folder, _, files in os.walk(root):
        for file in files:
            path = Path(folder, file)
            if path.suffix.lower() not in VIDEO_SUFFIXES or file.startswith(".") or not path.is_file():
                continue
            if leaves(path, root):
                raise SourceError(
                    path, "is a link that leaves the folder", "copy the file in, or convert its folder"
                )
            paths[path.relative_to(root).as_posix()] = path
    if not paths:
        raise nothing_there(uri, root, "holds no videos", f"looked for {', '.join(VIDEO_SUFFIXES)}")
    short = Counter(alias for name in paths for alias in _short_names(name))
    return {
        name: Video(paths[name], name, _aliases(name, short)) for name in sorted(paths, key=natural_order)
    }


def natural_order(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key that puts clip_2 before clip_10."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"([0-9]+)", name)]


def _short_names(name: str) -> set[str]:
    return {PurePosixPath(name).name, PurePosixPath(name).stem}


def _aliases(name: str, short: Counter[str]) -> tuple[str, ...]:
    whole = (name, str(PurePosixPath(name).with_suffix("")))
    return (*whole, *(alias for alias in sorted(_short_names(name)) if short[alias] == 1))


@dataclass(frozen=True)
class Header:
    """The facts of a video file's header, known without reading its packets.

    Attributes:
        frames: how many; 0 where the header does not state it.
        hz: stated rate; 0 where none is stated.
        width, height: pixels, as stored.
        codec: h264, av1, …
    """

    frames: int
    hz: float
    width: int
    height: int
    codec: str


def header_of(path: Path) -> Header:
    """Return the header of a video file.

    Raises:
        EpisodeError: it is not a video, or it is damaged.
    """
    from hma_data.sources.common.video_file import opened

    if not path.is_file():
        raise EpisodeError(path, "no such video file")
    with opened(path) as (container, stream):
        hz = float(stream.average_rate or 0)
        seconds = float(stream.duration * stream.time_base) if stream.duration else 0.0
        if not seconds and container.duration:
            seconds = container.duration / 1e6
        frames = stream.frames or round(seconds * hz)
        return Header(frames, hz, stream.width, stream.height, stream.codec.canonical_name)
