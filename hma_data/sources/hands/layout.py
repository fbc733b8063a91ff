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

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, ValidationError

from hma_data.errors import RegistryError
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import local_path, nothing_there
from hma_data.sources.common.video_file import opened
from hma_data.sources.hands import VIDEO_SUFFIXES


def _width_and_height(value: Any) -> Any:
    if isinstance(value, str):
        sides = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", value)
        if not sides:
            raise ValueError("give WIDTHxHEIGHT, such as 1920x1080")
        return int(sides[1]), int(sides[2])
    return value


class HandsLayout(BaseModel):
    """The values of `source.layout`; see the module."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    labels: Literal[
        "detector", "landmarks", "epic_kitchens_hand_objects", "ego4d_fho", "egoexo4d_hand_pose"
    ] = "detector"
    annotations: str | None = None
    models: str | None = None
    missing: Literal["split", "hold", "mask"] = "split"
    max_hold: int | None = Field(None, ge=0)
    min_frames: int = Field(12, ge=0)
    min_score: FiniteFloat = Field(0.5, ge=0)
    max_gap_s: FiniteFloat = Field(3.0, ge=0)
    pictures: Literal["labelled", "every"] = "labelled"
    first_frame: int | None = Field(None, ge=0)
    label_size: Annotated[tuple[int, int] | None, BeforeValidator(_width_and_height)] = None
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
    try:
        return HandsLayout.model_validate(embodiment.source.layout or {})
    except ValidationError as fault:
        first = fault.errors()[0]
        where = f"embodiment {embodiment.id}: source.layout.{first['loc'][0]}"
        if first["type"] == "extra_forbidden":
            known = ", ".join(HandsLayout.model_fields)
            raise RegistryError(where, "is not a key of hand videos", f"allowed: {known}") from fault
        said = first["msg"].removeprefix("Value error, ")
        raise RegistryError(where, f"is {first['input']!r}", said) from fault


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
        SourceError: there are none.
    """
    root = local_path(uri)
    files = [root] if root.is_file() else sorted(root.rglob("*"), key=lambda path: _natural_order(str(path)))
    folder = root.parent if root.is_file() else root
    paths = {
        path.relative_to(folder).as_posix(): path
        for path in files
        if path.suffix.lower() in VIDEO_SUFFIXES and not path.name.startswith(".") and path.is_file()
    }
    if not paths:
        raise nothing_there(uri, root, "holds no videos", f"looked for {', '.join(VIDEO_SUFFIXES)}")
    short = Counter(alias for name in paths for alias in _short_names(name))
    return {name: Video(path, name, _aliases(name, short)) for name, path in paths.items()}


def _natural_order(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key that puts clip_2 before clip_10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", name)]


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
    with opened(path) as (container, stream):
        hz = float(stream.average_rate or 0)
        seconds = float(stream.duration * stream.time_base) if stream.duration else 0.0
        if not seconds and container.duration:
            seconds = container.duration / 1e6
        frames = stream.frames or round(seconds * hz)
        return Header(frames, hz, stream.width, stream.height, stream.codec.canonical_name)
