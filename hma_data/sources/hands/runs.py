"""Cut the labelled hands of a video into episodes: runs of frames that have the needed hands.

A point is a side and a part of the hand: `left/center`, `right/wrist`, `left/landmarks`. A component's key is
a point, with `/next` for its value at the next labelled frame of the run, or `/delta` for next minus current.

`hma_data.registry.components.HandsLayout` lists the keys of `source.layout`.

N labelled frames of a video, n of a run, w values of a point (2, or 42 for landmarks).
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from hma_data.arrays import Array, Bools, Floats, Ints
from hma_data.errors import EpisodeError, SourceError, meant
from hma_data.registry.components import HandsLayout
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.common.places import named_files
from hma_data.sources.common.video_file import decoded_size, opened
from hma_data.sources.hands import VIDEO_SUFFIXES

SIDES = ("left", "right")
PARTS = {"center": 2, "wrist": 2, "landmarks": 42}
POINTS = {f"{side}/{part}": width for side in SIDES for part, width in PARTS.items()}
KEYS = tuple(point + suffix for point in POINTS for suffix in ("", "/next", "/delta"))
OUTSIDE_TOLERANCE = (
    0.05  # share of the image's side by which a label may lie outside; it is moved to the edge
)
LATE_TOLERANCE = 0.01  # share of a video's frames by which labels may continue after its end


def layout_of(embodiment: Embodiment | None) -> HandsLayout:
    """Return an embodiment's layout; all defaults without one."""
    return HandsLayout.model_validate((embodiment.source.layout or {}) if embodiment else {})


@dataclass(frozen=True)
class Video:
    """A video file of the source."""

    path: Path
    name: str  # its path within the folder; the id of its episode
    aliases: tuple[str, ...]  # names that labels may use for it, the most exact first


def videos_of(uri: str) -> dict[str, Video]:
    """Return the videos of a file or folder by name, in natural order.

    Raises:
        SourceError: there are none.
    """
    paths = named_files(uri, VIDEO_SUFFIXES, "videos")
    short = {name: sorted({PurePosixPath(name).name, PurePosixPath(name).stem}) for name in paths}
    uses = Counter(alias for aliases in short.values() for alias in aliases)
    videos = {}
    for name, path in paths.items():
        unique = (alias for alias in short[name] if uses[alias] == 1)
        videos[name] = Video(path, name, (name, str(PurePosixPath(name).with_suffix("")), *unique))
    return videos


@dataclass(frozen=True)
class Header:
    """The facts of a video file's header and first frame, known without reading its packets."""

    frames: int  # how many; 0 where the header does not state it
    hz: float  # stated rate; 0 where none is stated
    width: int  # pixels of the decoded frames
    height: int
    codec: str  # h264, av1, …


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
        return Header(frames, hz, *decoded_size(container, stream), stream.codec.canonical_name)


# -- labels and runs


def point_of(key: str, where: str) -> str:
    """Return the point of a component's key.

    Raises:
        SourceError: it is not a key of hand videos.
    """
    if key not in KEYS:
        raise SourceError(where, f"{key!r} is not a key of hand videos", meant(key, KEYS, cutoff=0))
    return key.removesuffix("/next").removesuffix("/delta")


@dataclass(frozen=True)
class HandLabels:
    """The positions of the hands in one video."""

    frames: Ints  # (N,) rising indices of the labelled frames of the video
    points: dict[str, Floats]  # point -> (N, w); NaN where there is no such hand. Every point is a key.
    pixels: bool = False  # whether values are pixels, not fractions
    irregular: bool = False  # labels are few, at any spacing; else a frame without a label has no hand
    texts: tuple[tuple[int, str], ...] = ()  # (frame, what the person does from this frame on)

    def __len__(self) -> int:
        return len(self.frames)


def labels_from_rows(
    frames: Array,
    sides: Array,
    scores: Array,
    parts: dict[str, Array],
    looked_at: Iterable[int] = (),
    **facts: Any,
) -> HandLabels:
    """Make labels from one row a hand; of two hands of one side in a frame, the higher score counts.

    Landmarks alone, as fractions, give center and wrist too. The center is that of the points' box; points
    outside the image are moved to its edge.

    Args:
        frames: (R,) index of the frame.
        sides: (R,) 0 left, 1 right.
        scores: (R,).
        parts: center, wrist or landmarks -> (R, w).
        looked_at: frames that were labelled, with or without a hand.
        facts: further attributes of HandLabels.
    """
    if set(parts) == {"landmarks"}:
        inside = np.clip(parts["landmarks"].astype(np.float64).reshape(-1, 21, 2), 0, 1)
        center = (inside.min(axis=1) + inside.max(axis=1)) / 2
        parts = {"center": center, "wrist": inside[:, 0], "landmarks": inside.reshape(-1, 42)}
    order = np.argsort(scores, kind="stable")
    every = np.unique(np.concatenate([frames, np.fromiter(looked_at, np.int64)]).astype(np.int64))
    row = np.searchsorted(every, frames[order])
    points: dict[str, Floats] = {}
    for number, side in enumerate(SIDES):
        mine = sides[order] == number
        for part, width in PARTS.items():
            values = np.full((len(every), width), np.nan)
            if part in parts:
                values[row[mine]] = parts[part][order][mine]
            values[~np.isfinite(values).all(axis=1)] = np.nan
            points[f"{side}/{part}"] = values
    return HandLabels(every, points, **facts)


@dataclass(frozen=True)
class Runs:
    """A video's labels, cut into runs."""

    labels: HandLabels  # as fractions, with gaps of regular labels filled in and hands held
    spans: tuple[tuple[int, int], ...]  # [from, to) into the labels; the last frame of a run only ends it
    missing: Bools  # (N,) whether a label lacks a needed hand; held ones do not count
    held: Bools  # (N,) whether a needed hand keeps its last position

    @property
    def dropped(self) -> int:
        """Count the labels that are in no run."""
        return len(self.labels) - sum(stop - start - 1 for start, stop in self.spans)


def cut_into_runs(
    labels: HandLabels, needed: Sequence[str], layout: HandsLayout, video: Header, where: str
) -> Runs:
    """Cut the labels of a video into runs.

    Args:
        needed: points that a frame of a run must have.
        video: number, rate and size of its frames.
        where: the video, for errors.

    Raises:
        EpisodeError: the labels do not fit the video, or never have a needed point.
    """
    labels = _within(labels, video.frames, where)
    size = layout.label_size or (video.width, video.height)
    labels = _as_fractions(labels, needed, size, where)
    for point in needed:
        if not np.isfinite(labels.points[point]).any():
            have = [name for name, values in labels.points.items() if np.isfinite(values).any()]
            raise EpisodeError(where, f"no label has {point}", f"labels have {', '.join(have) or 'no hands'}")
    labels, step = _gaps_filled(labels)
    there = np.all([np.isfinite(labels.points[point]).all(axis=1) for point in needed], axis=0)
    without = ~there
    if layout.missing != "split":
        limit = 0 if layout.missing == "mask" and layout.max_hold is None else layout.max_hold
        kept = {point: _held(labels.points[point], limit) for point in needed}
        labels = replace(labels, points=labels.points | kept)
        there = np.all([np.isfinite(values).all(axis=1) for values in kept.values()], axis=0)
    widest = max(1, round(layout.max_gap_s * video.hz)) if labels.irregular else step
    usable = np.ones_like(there) if layout.missing == "mask" else there
    least = max(1, layout.min_frames)
    long = [
        (start, stop)
        for start, stop in find_spans(labels.frames, usable, widest)
        if episode_frames(labels, (start, stop), layout) - int((~there[start:stop]).sum()) >= least
    ]
    return Runs(labels, tuple(long), ~there, without & there)


def episode_frames(labels: HandLabels, span: tuple[int, int], layout: HandsLayout) -> int:
    """Count the frames of the episode that a run gives."""
    start, stop = span
    every = layout.pictures == "every"
    return int(labels.frames[stop - 1] - labels.frames[start]) if every else stop - start - 1


def find_spans(frames: Ints, there: Bools, widest: int) -> list[tuple[int, int]]:
    """Return the longest stretches [from, to) of usable labels at most `widest` frames apart."""
    joined = there[1:] & there[:-1] & (np.diff(frames) <= widest)
    starts = np.flatnonzero(there & ~np.concatenate([[False], joined]))
    stops = np.flatnonzero(there & ~np.concatenate([joined, [False]])) + 1
    return list(zip(starts.tolist(), stops.tolist()))


def values_of(key: str, points: dict[str, Floats], span: tuple[int, int]) -> Floats:
    """Return the (n - 1, w) values of a key over a run of n labels; NaN where a needed hand is missing.

    The last label serves only as a next value.
    """
    values = points[point_of(key, key)][slice(*span)]
    if key.endswith("/next"):
        return values[1:]
    return np.diff(values, axis=0) if key.endswith("/delta") else values[:-1]


def _within(labels: HandLabels, frames: int, where: str) -> HandLabels:
    """Return the labels of frames that the video has; a few labels may lie beyond its end."""
    inside = (labels.frames >= 0) & (labels.frames < frames)
    beyond = labels.frames[~inside]
    # Published labels run a few frames past the end, because annotators counted by the stated rate.
    last_allowed = frames * (1 + LATE_TOLERANCE) + 2
    if len(beyond) and (beyond.min() < 0 or beyond.max() > last_allowed or not inside.any()):
        worst = int(beyond.min() if beyond.min() < 0 else beyond.max())
        fault = f"is labelled at frame {worst:,}, and has {frames:,} frames"
        raise EpisodeError(where, fault, "check that these are its labels, and source.layout.first_frame")
    points = {point: values[inside] for point, values in labels.points.items()}
    return replace(labels, frames=labels.frames[inside], points=points)


def _as_fractions(labels: HandLabels, needed: Sequence[str], size: tuple[int, int], where: str) -> HandLabels:
    """Convert labels to fractions of the image; treat hands outside it as missing."""
    points = {}
    for point, raw in labels.points.items():
        values = raw / np.tile(size, raw.shape[1] // 2) if labels.pixels else raw
        with np.errstate(invalid="ignore"):
            beyond = np.any((values < -OUTSIDE_TOLERANCE) | (values > 1 + OUTSIDE_TOLERANCE), axis=1)
        seen = int(np.isfinite(values).all(axis=1).sum())
        if point in needed and beyond.sum() > seen / 2:
            x, y = raw[beyond][0, :2]
            fault = f"{int(beyond.sum()):,} of {seen:,} labels of {point} lie outside the image of "
            fault += f"{size[0]}×{size[1]} pixels, the first at {x:.4g}, {y:.4g}"
            remedy = "check that these are its labels, and source.layout.label_size"
            raise EpisodeError(where, fault, remedy)
        points[point] = np.where(beyond[:, None], np.nan, np.clip(values, 0, 1))
    return replace(labels, points=points, pixels=False)


def _gaps_filled(labels: HandLabels) -> tuple[HandLabels, int]:
    """Fill the gaps of regular labels with NaN; return the labels, and their spacing in frames.

    Labels whose spacings are not multiples of the commonest one are irregular.
    """
    spacing = np.diff(labels.frames)
    if labels.irregular or not len(spacing):
        return labels, 1
    step = int(np.bincount(spacing).argmax())
    if (spacing % step).any():
        return replace(labels, irregular=True), 1
    every = np.arange(labels.frames[0], labels.frames[-1] + 1, step)
    row = (labels.frames - labels.frames[0]) // step
    points: dict[str, Floats] = {}
    for point, values in labels.points.items():
        points[point] = np.full((len(every), values.shape[1]), np.nan)
        points[point][row] = values
    return replace(labels, frames=every, points=points), step


def _held(values: Floats, limit: int | None) -> Floats:
    """Replace missing values by the last known ones, for at most `limit` labels in a row."""
    there = np.isfinite(values).all(axis=1)
    last = np.maximum.accumulate(np.where(there, np.arange(len(values)), -1))
    age = np.arange(len(values)) - last
    kept = (last >= 0) & (age <= (len(values) if limit is None else limit))
    return np.where(kept[:, None], values[np.maximum(last, 0)], np.nan)
