"""Read the layout of hand videos from a YAML, and find the videos of a folder.

`hma_data.registry.layouts.HandsLayout` lists the keys of `source.layout`.
"""

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from hma_data.registry.embodiment import Embodiment
from hma_data.registry.layouts import HandsLayout
from hma_data.sources.base import local_path, nothing_there
from hma_data.sources.common.video_file import opened
from hma_data.sources.hands import VIDEO_SUFFIXES


def layout_of(embodiment: Embodiment | None) -> HandsLayout:
    """Return an embodiment's layout; all defaults without one."""
    return HandsLayout.model_validate((embodiment.source.layout or {}) if embodiment else {})


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
