"""Read videos of human hands; the positions of both hands in the image stand for the action.

A uri is a video file or a folder of videos. An episode has the camera `video`. Its values are the positions
of the hands, as fractions of the image's width and height (0..1, x to the right, y down). They refer to the
image as it is decoded, before any flip, rotation or crop of the YAML:

    left/center, right/center        centre of the hand's box
    left/wrist, right/wrist
    left/landmarks, right/landmarks  42: x, y of 21 points, the wrist first

A key ends in `/next` for the value at the next labelled frame, in `/delta` for next minus current, and has no
ending for the current value. Left and right are the person's own.

Labels come from a detector or from annotations. `source.layout` says from which, and what a frame without a
needed hand does: see the module `runs`.

With annotations, each run of at least `min_frames` is an episode, `clip.mp4#0`, `clip.mp4#1`, …; the plain
name `clip.mp4` is the longest run. Runs of one video share a group, so that they come into one split. The
detector runs only while an episode is read; so with it, a video is one episode, `clip.mp4`: its longest run.
The episode's flags count the frames that are held, masked and left out.

T frames of an episode.
"""

import os
from pathlib import Path

import numpy as np

from hma_data.episodes.align import measured_hz
from hma_data.episodes.episode import Episode, Signal
from hma_data.errors import EpisodeError, SourceError
from hma_data.registry.components import HandsLayout, Vector
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import SAMPLE, EpisodeRef, Inspection, compose
from hma_data.sources.common.places import file_fingerprint
from hma_data.sources.common.survey import listed
from hma_data.sources.common.video_file import FilmRows, VideoFile
from hma_data.sources.hands.detect import HandModels, MediaPipeHands, load_models
from hma_data.sources.hands.labels import LabelSet, open_labels
from hma_data.sources.hands.runs import (
    POINTS,
    HandLabels,
    Header,
    Runs,
    Video,
    cut_into_runs,
    episode_frames,
    header_of,
    layout_of,
    point_of,
    values_of,
    videos_of,
)
from hma_data.sources.hands.scan import inspect_videos, scan_cached
from hma_data.storage.files import short_sha256
from hma_data.storage.paths import StrPath, as_text

CAMERA = "video"
RATE_TOLERANCE = 0.01  # of the rate
INTERVAL_TOLERANCE = 0.1  # share of the median interval by which the others of a regular video may differ
_MORE_RUNS = "lower source.layout.min_frames, or set source.layout.missing: hold"


class HandsSource:
    """Read videos of hands; see the module."""

    def __init__(self) -> None:
        self._videos: dict[str, dict[str, Video]] = {}
        self._labels: dict[tuple[str, HandsLayout], LabelSet] = {}
        self._detector: tuple[int, HandsLayout, MediaPipeHands, HandModels] | None = None

    def inspect(self, uri: StrPath, episodes: int = SAMPLE) -> Inspection:
        """Return the videos, and where there are models, the hands in a small sample of frames."""
        return inspect_videos(as_text(uri), episodes)

    def episode_ids(self, uri: StrPath) -> list[str]:
        """Return the videos' names; each stands for the longest run of its video."""
        return list(self._find(as_text(uri)))

    def index(self, uri: StrPath, embodiment: Embodiment | None = None) -> list[EpisodeRef]:
        """Return the videos, or their runs where there are annotations; no frame is decoded.

        Raises:
            SourceError: no videos, no models or labels, no labels that fit, or no run that is long enough.
            RegistryError: the YAML's layout is wrong.
        """
        uri, layout = as_text(uri), layout_of(embodiment)
        videos = self._find(uri)
        needed = _needed(embodiment) if embodiment else ("left/center", "right/center")
        if layout.labels == "detector":
            digest = self._models(layout)[1].digest if embodiment else ""
            return [_whole(video, digest) for video in videos.values()]
        labels = self._labels[uri, layout] = open_labels(layout, uri)
        found = {name: _runs_of(video, labels, needed, layout) for name, video in videos.items()}
        refs = [ref for runs in found.values() for ref in runs or ()]
        if refs:
            return refs
        if all(runs is None for runs in found.values()):
            fault = f"has no labels for any of its videos: {listed(list(videos), 3)}"
            raise SourceError(uri, fault, f"labels are of {listed(labels.known, 3)}")
        fault = f"has no run of {layout.min_frames} frames with the needed hands in its labelled videos"
        raise SourceError(uri, fault, _MORE_RUNS)

    def read(self, uri: StrPath, episode_id: str, embodiment: Embodiment) -> Episode:
        """Return one run of a video; its frames are decoded on demand.

        Raises:
            EpisodeError: the video or its labels are damaged, or no run is long enough.
            SourceError: no such episode, or a key that hand videos do not have.
            RegistryError: the YAML's layout is wrong.
        """
        uri, layout, needed = as_text(uri), layout_of(embodiment), _needed(embodiment)
        video, number = self._place(uri, episode_id)
        labels = self._labels_of(uri, video, layout)
        file = VideoFile(video.path)
        table = file.table
        hz = table.hz or measured_hz(np.diff(table.times)) or 0.0
        header = Header(len(table), hz, table.width, table.height, table.codec)
        runs = cut_into_runs(labels, needed, layout, header, str(video.path))
        if not runs.spans:
            fault = f"has no run of {layout.min_frames} frames with {', '.join(needed)}: "
            lacking = int((runs.missing | runs.held).sum())
            fault += f"{lacking:,} of {len(runs.labels):,} frames lack one"
            raise EpisodeError(video.path, fault, _MORE_RUNS)
        if number is not None and number >= len(runs.spans):
            raise EpisodeError(video.path, f"has {len(runs.spans)} runs, no run {number}")
        return _episode(episode_id, file, runs, number, embodiment)

    def _find(self, uri: str) -> dict[str, Video]:
        self._videos[uri] = videos_of(uri)
        return self._videos[uri]

    def _place(self, uri: str, episode_id: str) -> tuple[Video, int | None]:
        videos = self._videos.get(uri) or self._find(uri)
        if episode_id in videos:
            return videos[episode_id], None
        name, _, number = episode_id.rpartition("#")
        if name not in videos or not number.isdecimal():
            raise SourceError(uri, f"has no episode {episode_id!r}", "hma inspect lists what it has")
        return videos[name], int(number)

    def _labels_of(self, uri: str, video: Video, layout: HandsLayout) -> HandLabels:
        if layout.labels == "detector":
            detector, models = self._models(layout)
            return scan_cached(video.path, detector, models, layout)
        labels = self._labels.get((uri, layout))
        if labels is None:
            labels = self._labels[uri, layout] = open_labels(layout, uri)
        found = labels.of(video)
        if found is None:
            raise EpisodeError(video.path, "has no labels", f"there are labels of {listed(labels.known, 3)}")
        return found

    def _models(self, layout: HandsLayout) -> tuple[MediaPipeHands, HandModels]:
        """Return the detector, made once in each process, and its models."""
        if self._detector is None or self._detector[:2] != (os.getpid(), layout):
            models = load_models(layout.models)
            made = MediaPipeHands(models, mirrored=layout.mirrored)
            self._detector = (os.getpid(), layout, made, models)
        return self._detector[2:]


open = HandsSource


def _needed(embodiment: Embodiment) -> tuple[str, ...]:
    """Return the points that the embodiment's vectors need; check its camera keys."""
    where = f"embodiment {embodiment.id}"
    for camera in embodiment.cameras:
        if camera.key != CAMERA:
            raise SourceError(where, f"camera key {camera.key!r} is not in hand videos", f"use {CAMERA!r}")
    return tuple(dict.fromkeys(point_of(part.key, where) for part in embodiment.components))


def _whole(video: Video, digest: str) -> EpisodeRef:
    try:
        frames = header_of(video.path).frames
        mark = f"{file_fingerprint(video.path)} {digest}"
    except EpisodeError as fault:  # `read` raises it again
        frames, mark = 1, str(fault)
    return EpisodeRef(video.name, max(1, frames), None, short_sha256(mark))


def _runs_of(
    video: Video, labels: LabelSet, needed: tuple[str, ...], layout: HandsLayout
) -> list[EpisodeRef] | None:
    """Return one ref a run; None for a video without labels; for damaged ones a ref that `read` refuses."""
    try:
        found = labels.of(video)
        if found is None:
            return None
        runs = cut_into_runs(found, needed, layout, header_of(video.path), str(video.path))
        mark = file_fingerprint(video.path)
    except EpisodeError as fault:
        return [EpisodeRef(video.name, 1, None, short_sha256(str(fault)))]
    refs = []
    for number, span in enumerate(runs.spans):
        values = [runs.labels.points[point][slice(*span)].tobytes() for point in needed]
        content = [mark.encode(), runs.labels.frames[slice(*span)].tobytes(), *values]
        frames = episode_frames(runs.labels, span, layout)
        refs.append(
            EpisodeRef(
                f"{video.name}#{number}", frames, None, short_sha256(b"".join(content)), group=video.name
            )
        )
    return refs


def _episode(
    episode_id: str, file: VideoFile, runs: Runs, number: int | None, embodiment: Embodiment
) -> Episode:
    """Make the episode of run `number`; None makes that of the longest run, as the only one of its video."""
    labels, layout = runs.labels, layout_of(embodiment)
    longest = int(np.argmax([stop - start for start, stop in runs.spans]))
    chosen = longest if number is None else number
    span = start, stop = runs.spans[chosen]
    marks = labels.frames[start:stop]
    every = layout.pictures == "every"
    shown = np.arange(marks[0], marks[-1]) if every else marks[:-1]
    stream = FilmRows(file, file.timestamps[shown], shown)
    steps = np.diff(file.timestamps[marks[:-1]])
    usual = np.median(steps) if len(steps) else 0.0
    regular = bool((np.abs(steps - usual) <= INTERVAL_TOLERANCE * usual).all())
    steady = regular and not every and embodiment.sync.rate_hz is None
    if steady and not labels.irregular:
        _check_rate(file.path, measured_hz(steps), embodiment)
    text = "; ".join(dict.fromkeys(words for frame, words in labels.texts if marks[0] <= frame < marks[-1]))
    state = [_signal(embodiment.state, file, labels, span, not steady)] if embodiment.state else []
    # Frames in no run count in the first run, or in the only one that is read.
    left = 0
    if number is None:
        left = len(labels) - (stop - start - 1)
    elif number == 0:
        left = runs.dropped
    held, masked = (int(marked[start : stop - 1].sum()) for marked in (runs.held, runs.missing))
    flags = {"held_frames": held, "masked_frames": masked, "dropped_frames": left}
    return Episode(
        id=episode_id,
        streams={camera.name: stream for camera in embodiment.cameras},
        actions=(_signal(embodiment.action, file, labels, span),),
        states=tuple(state),
        rate_stamped=steady,
        instruction=text,
        source=str(file.path),
        metadata={"flags": flags},
    )


def _signal(
    vector: Vector, file: VideoFile, labels: HandLabels, span: tuple[int, int], to_last: bool = False
) -> Signal:
    """Make a vector over a run of n labels: n - 1 values, or n with `to_last` where all are current."""
    keys = [part.key for part in vector.components]
    if to_last and all(key in POINTS for key in keys):
        pieces = [labels.points[key][slice(*span)] for key in keys]
    else:
        pieces = [values_of(key, labels.points, span) for key in keys]
    values = compose(vector, pieces, str(file.path))
    times = file.timestamps[labels.frames[span[0] :][: len(values)]]
    known = np.all([np.isfinite(piece).all(axis=1) for piece in pieces], axis=0)
    if known.all():
        return Signal(times, values)
    return Signal(times, np.where(known[:, None], values, np.float32(0)), known)


def _check_rate(path: Path, measured: float | None, embodiment: Embodiment) -> None:
    stated = embodiment.frequency_hz
    if isinstance(stated, float) and measured and abs(stated - measured) > RATE_TOLERANCE * measured:
        fault = f"is labelled at {measured:.4g} Hz, embodiment {embodiment.id} says frequency_hz {stated:g}"
        remedy = "correct frequency_hz, or set frequency_hz: null and sync.rate_hz for one rate of all videos"
        raise EpisodeError(path, fault, remedy)
