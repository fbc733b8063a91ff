"""Find the frame of a video that belongs to each row of an episode.

The metadata say at which time an episode begins in its video, and the rows have times of their own. Videos
that were cut, merged or encoded again may have other stamps, one frame too many or too few. Then every later
frame would stand beside the wrong row, and nothing in a single episode shows it. So a whole video is
compared with all of its episodes first: `fit` counts the frames in each episode's part.

N frames of a video, T rows of an episode, E episodes of a video.
"""

import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hma_data.arrays import Floats, Ints
from hma_data.episodes.align import nearest
from hma_data.errors import EpisodeError
from hma_data.sources.common.video_file import VideoFile, frame_table
from hma_data.sources.lerobot.metadata import Metadata, Span, episode_name

TIME_TOLERANCE = 0.25  # of a frame's period, between the time of a row and the time of its frame
HOLE = 1.5  # frame periods between two frames, above which a frame is missing between them
BY_INDEX = "source: {layout: {pairing: index}}"
BY_TIME = "source: {layout: {pairing: time}}"
_REMEDY = f"check the video: if its stamps are right, set {BY_TIME}; if row i has frame i, {BY_INDEX}"
_held = threading.local()  # key of a camera -> its open video: version 3 has hundreds of episodes in a file


@dataclass(frozen=True)
class Fit:
    """How a video fits the metadata of its episodes.

    Attributes:
        shift: seconds from a time in the metadata to the same time in the video.
        fault: why no row's frame can be known; empty where it can.
        remedy: what to do about it.
        unused: episode index -> frames after its last row that no row asks for.
    """

    shift: float = 0.0
    fault: str = ""
    remedy: str = ""
    unused: dict[int, int] = field(default_factory=dict)


def fit(clock: Floats, spans: Sequence[Span], fps: float) -> Fit:
    """Compare the frames of a video with the rows of all its episodes.

    Args:
        clock: (N,) rising seconds of the frames.
        spans: (E,) the episodes' parts by their start; at least one.
        fps: rows a second.
    """
    starts = np.array([span.start for span in spans])
    rows = np.array([span.rows for span in spans])
    ends = starts + rows / fps
    overlap = np.flatnonzero(ends[:-1] - starts[1:] > 0.5 / fps)
    if len(overlap):
        before, after = spans[overlap[0]], spans[overlap[0] + 1]
        fault = f"would show {episode_name(before.index)} ({before.rows} rows from {before.start:.3f} s) and "
        fault += f"{episode_name(after.index)} (from {after.start:.3f} s) at the same time"
        return Fit(fault=fault, remedy="their spans in meta/episodes overlap: merge the datasets again")
    # Stamps are believed wherever they fit. A video that begins later or earlier than its metadata says is
    # moved as a whole, but only if every episode then has exactly its number of frames.
    for shift in dict.fromkeys((0.0, float(clock[0] - starts[0]), float(clock[0]))):
        unused = _unused(clock - shift, spans, starts, ends, fps, is_moved=shift != 0.0)
        if unused is not None:
            return Fit(shift, unused=unused)
    return Fit(fault=_misfit(clock, spans), remedy=_REMEDY)


def _unused(
    clock: Floats, spans: Sequence[Span], starts: Floats, ends: Floats, fps: float, is_moved: bool
) -> dict[int, int] | None:
    """Count the frames between an episode's last row and the next episode; None where rows and frames differ.

    Args:
        clock: (N,) seconds of the frames, on the clock of the metadata.
        spans: (E,) the episodes' parts by their start.
        starts, ends: (E,) seconds; a part ends one period after its last row.
        is_moved: whether `clock` differs from the file's stamps; then only equal counts are believed.

    Returns:
        Episode index -> frames, where there are any.
    """
    rows = np.array([span.rows for span in spans])
    first, last = (np.searchsorted(clock, times - 0.5 / fps) for times in (starts, ends))
    after = np.append(first[1:], len(clock)) - last
    begins = clock[np.minimum(first, len(clock) - 1)]
    fits = bool(np.abs(begins - starts).min() <= TIME_TOLERANCE / fps)
    if spans[-1].stop is None:  # a video of one episode: its rows are compared one by one later
        fits = fits and len(clock) == rows.sum()
    else:
        if is_moved:
            fits = fits and bool((last - first == rows).all())
        else:
            # A frame that was dropped leaves a hole in the stamps. Without one, it is unknown where it was.
            missing = np.maximum(rows - (last - first), 0).sum()
            intervals = np.diff(clock) * fps
            fits = fits and missing <= np.rint(intervals[intervals > HOLE] - 1).sum()
        # A removed episode leaves as many frames after the last one as an episode has, and a recorder may add
        # some to each. Otherwise they slipped in anywhere, and moved all that follows. An episode without
        # rows would explain any number of frames.
        shortest = rows.min(where=rows > 0, initial=len(clock) + 1)
        is_usual = len(after) > 1 and (after == after[-1]).all()
        fits = fits and bool(after[-1] <= 0 or after[-1] >= shortest or is_usual)
    counts = zip(spans, after.tolist(), strict=True)
    return {span.index: count for span, count in counts if count > 0} if fits else None


def _misfit(clock: Floats, spans: Sequence[Span]) -> str:
    rows = sum(span.rows for span in spans)
    episodes = f" of {len(spans)} episodes" if len(spans) > 1 else ""
    said = f"has {len(clock):,} frames for {rows:,} rows{episodes}"
    late = clock[0] - spans[0].start
    if abs(late) > 1e-3:
        said += f", and begins at {clock[0]:.3f} s, its metadata says {spans[0].start:.3f} s"
    elif len(clock) == rows:
        said += ", but not at the times that meta/episodes says"
    return said


def fit_of(meta: Metadata, key: str, file: VideoFile, span: Span) -> Fit:
    """Return how the video of an episode's part fits all of its episodes; it is measured once."""
    known = meta.fits.get((key, span.path))
    if known is None or known[0] != file.table.state:  # the table itself has 32 bytes a frame
        found = fit(file.timestamps, meta.spans(key, span.path), meta.fps)
        known = meta.fits[key, span.path] = file.table.state, found
    return known[1]


def open_video(path: Path, key: str) -> VideoFile:
    """Return a camera's video; the one that this thread has open, where the episode before was in it too."""
    held = vars(_held).setdefault(str(os.getpid()), {})
    if key not in held or held[key].path != path or held[key].table is not frame_table(path):
        held[key] = VideoFile(path)
    file: VideoFile = held[key]
    return file


def frames_of_rows(
    meta: Metadata, key: str, file: VideoFile, span: Span, times: Floats, pairing: str | None
) -> Ints:
    """Return the index of the frame that each row has.

    Args:
        file: the video; `span` is the episode's part of it.
        times: (T,) rising seconds of the rows.
        pairing: as the YAML states it. index: row i has frame i of the episode. time: a row has the frame of
            its time, whatever the video has besides. None: the same, if the whole video fits its episodes.

    Raises:
        EpisodeError: it cannot be known which frames the rows have, or there is none at the time of a row.
    """
    clock, fps = file.timestamps, meta.fps
    spans = meta.spans(key, span.path)
    place = [other.index for other in spans].index(span.index)
    found = fit_of(meta, key, file, span)
    if pairing is None and found.fault:
        raise EpisodeError(file.path, found.fault, found.remedy)
    if pairing == "index" and len(clock) == sum(other.rows for other in spans):
        before = sum(other.rows for other in spans[:place])
        return np.arange(before, before + span.rows)
    shift = found.shift if pairing is None else 0.0
    first, last = 0, len(clock)
    if span.stop is not None:  # up to the next episode
        after = spans[place + 1].start if place + 1 < len(spans) else np.inf
        first, last = np.searchsorted(clock, np.array([span.start, after]) + shift - 0.5 / fps)
    if last - first < len(times) or (pairing == "index" and last - first > len(times)):
        part = "" if span.stop is None else f" from {span.start:.3f} to {span.stop:.3f} s"
        fault = f"has {last - first} frames{part}, the episode has {len(times)} rows"
        raise EpisodeError(file.path, fault)
    if pairing == "index":
        return np.arange(first, last)
    indices, off_ms = nearest(clock[first:last], span.start + shift + times)
    worst = int(np.argmax(off_ms))
    if off_ms[worst] > TIME_TOLERANCE * 1e3 / fps:
        fault = f"its frame nearest to row {worst} is {off_ms[worst]:.1f} ms away"
        remedy = f"rows and video disagree on time; a frame is {1e3 / fps:.1f} ms"
        if last - first == len(times):
            remedy += f", and both count {len(times)}: if row i belongs to frame i, set {BY_INDEX}"
        raise EpisodeError(file.path, fault, remedy)
    if (np.diff(indices) == 0).any():
        row = int(np.argmin(np.diff(indices)))
        raise EpisodeError(file.path, f"has one frame for the rows {row} and {row + 1}")
    return indices + first
