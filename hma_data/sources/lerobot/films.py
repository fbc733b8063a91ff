"""Find the frame of a video that belongs to each row of an episode.

T rows of an episode.
"""

import os
import threading
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.align import nearest
from hma_data.episodes.episode import Floats
from hma_data.episodes.images import Images
from hma_data.errors import EpisodeError
from hma_data.sources.common.video_file import VideoFile, frame_table
from hma_data.sources.lerobot.metadata import Span

TIME_TOLERANCE = 0.25  # of a frame's period, between the time of a row and the time of its frame
PAIRING = "source: {layout: {pairing: index}}"
_held = threading.local()  # key of a camera -> its open video: version 3 has hundreds of episodes in a file


def open_video(path: Path, key: str) -> VideoFile:
    """Return a camera's video; the one that this thread has open, where the episode before was in it too."""
    held = vars(_held).setdefault(str(os.getpid()), {})
    if key not in held or held[key].path != path or held[key].table is not frame_table(path):
        held[key] = VideoFile(path)
    file: VideoFile = held[key]
    return file


def frames_of_rows(
    file: VideoFile, span: Span, times: Floats, fps: float, by_index: bool
) -> NDArray[np.int64]:
    """Return the index of the frame that each row has.

    Args:
        file: the video; `span` is the episode's part of it.
        times: (T,) seconds of the rows.
        by_index: whether row i has frame i of the episode; otherwise it has the frame of its time.

    Raises:
        EpisodeError: the video has too few frames or too many, or none at the time of a row.
    """
    first, last = span.frames(file.timestamps, fps)
    count, rows = last - first, len(times)
    # A shared video may hold frames that no row asks for, such as those of a deleted episode.
    if count < rows or (count > rows and (by_index or span.stop is None)):
        raise EpisodeError(file.path, f"has {count} frames{span}, the episode has {rows} rows")
    if by_index:
        return np.arange(first, last)
    indices, off_ms = nearest(file.timestamps[first:last], span.start + times)
    worst = int(np.argmax(off_ms))
    if off_ms[worst] > TIME_TOLERANCE * 1e3 / fps:
        fault = f"its frame nearest to row {worst} is {off_ms[worst]:.1f} ms away"
        remedy = f"rows and video disagree on time; a frame is {1e3 / fps:.1f} ms"
        if count == rows:
            remedy += f", and both count {rows}: if row i belongs to frame i, set {PAIRING}"
        raise EpisodeError(file.path, fault, remedy)
    return indices + first


class FilmRows:
    """A camera's Stream: the frames of a video file with the indices (T,), at the times (T,) of the rows."""

    def __init__(self, file: VideoFile, times: Floats, indices: NDArray[np.int64]) -> None:
        self.timestamps = times
        self._file, self._indices = file, indices

    def frames(self, indices: Sequence[int] | NDArray[np.int64]) -> Images:
        """See Stream."""
        return self._file.frames(self._indices[np.asarray(indices, np.int64)])
