"""Inspect a LeRobotDataset without an embodiment: check its metadata against the files that are there.

All of the metadata is checked. Numbers, times and a few frames are checked for a sample of the episodes
whose files are there. Nothing is fetched from the Hub for this.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from hma_data.errors import EpisodeError, HMAError
from hma_data.sources.common import checks
from hma_data.sources.common.checks import Finding
from hma_data.sources.common.inspection import Inspection, KeyInfo
from hma_data.sources.common.survey import MAX_VALUES, Series, Survey, sampled
from hma_data.sources.common.video_file import VideoFile, frame_table
from hma_data.sources.lerobot.films import BY_INDEX, Fit, fit_of, frames_of_rows
from hma_data.sources.lerobot.metadata import Feature, Metadata, episode_name
from hma_data.sources.lerobot.rows import Rows, StillImages, rows_of, tasks_of, times_of

MAX_EPISODES = 20_000  # most episodes whose files are looked for, spread over all
TIMES = "timestamp"  # the column
MAX_VIDEOS = 64  # videos opened at most, over all cameras


def inspect(uri: str, meta: Metadata, episodes: int) -> Inspection:
    """See Source.inspect."""
    lengths = [row["length"] for row in meta.episodes.values()]
    survey = Survey(len(lengths))
    _totals(meta, survey)
    looking = _Looking(meta, survey, episodes)
    if not meta.folder.repo:
        looking.look()
    facts = {"version": str(meta.info.codebase_version), "tasks": str(len(meta.tasks))}
    facts |= {"pairing": "index"} if looking.drifts else {}
    hz, measured = meta.fps, survey.rate(TIMES)
    if measured and (looking.drifts or abs(measured / meta.fps - 1) > checks.DRIFT):
        hz = measured
        facts["rate"] = f"measured: the timestamps of the rows; meta/info.json states {meta.fps:g} Hz"
    robot = meta.info.robot_type or None
    return survey.inspection("lerobot", uri, _keys(meta), lengths, facts, hz=hz, robot=robot)


def _totals(meta: Metadata, survey: Survey) -> None:
    survey.made.add("files")
    lengths = [row["length"] for row in meta.episodes.values()]
    info = meta.info
    for name, stated, actual in (
        ("total_episodes", info.total_episodes, len(lengths)),
        ("total_frames", info.total_frames, sum(lengths)),
    ):
        if stated is not None and stated != actual:
            said = f"info.json says {name} {stated:,}, the episodes listed make {actual:,}"
            survey.note(Finding("files", "warn", said, numbers={"stated": stated, "listed": actual}))


class _Looking:
    """Check the files of a local dataset.

    Attributes:
        drifts: whether a video has a frame for each row, but not at the times of the rows.
    """

    def __init__(self, meta: Metadata, survey: Survey, episodes: int) -> None:
        self._meta, self._survey, self._episodes = meta, survey, episodes
        self._videos = [name for name, item in meta.features.items() if item.dtype == "video"]
        indices = list(meta.episodes)
        self._indices = [indices[i] for i in sampled(len(indices), MAX_EPISODES)]
        self.drifts = False
        self._videos_seen: set[tuple[str, str]] = set()

    def look(self) -> None:
        """Find which files are there; then sample the episodes that have all of their files."""
        whole = self._present("parquet files")
        for key in self._videos:
            whole &= self._present(f"videos of {key}", key)
        names = {episode_name(index): index for index in self._indices if index in whole}
        chosen = self._survey.sample(list(names), self._episodes)
        self._survey.made |= {"frames", "skew"} if chosen and self._videos else set()
        limit = max(1, MAX_VIDEOS // max(len(self._videos), 1))
        shown = chosen[:: max(1, -(-len(chosen) // limit))]
        for name in chosen:
            with self._survey.reading(name):
                keys = self._of_rows(name, names[name])
                if name in shown:
                    keys |= {key: partial(self._video, key, names[name]) for key in self._videos}
                self._survey.look(name, keys, self._meta.fps)

    def _present(self, what: str, key: str = "") -> set[int]:
        """Return the episodes whose file is there; report the missing files as one finding."""
        paths = {}
        for index in self._indices:
            try:
                paths[index] = self._meta.video(index, key).path if key else self._meta.data_path(index)
            except EpisodeError as fault:
                self._survey.fault(episode_name(index), fault)
        distinct = list(dict.fromkeys(paths.values()))
        missing = [path for path in distinct if not (self._meta.folder.root / path).is_file()]
        if missing:
            part = " looked for" if len(self._indices) < len(self._meta.episodes) else ""
            said = f"{len(missing):,} of {len(distinct):,} {what}{part} are missing, {missing[0]} first"
            numbers = {"missing": len(missing), "files": len(distinct)}
            self._survey.note(Finding("files", "warn", said, key=key, numbers=numbers))
        there = set(distinct) - set(missing)
        return {index for index, path in paths.items() if path in there}

    def _of_rows(self, name: str, index: int) -> dict[str, Callable[[], Series]]:
        """Return how the columns of one episode are read; check that all are there."""
        meta, rows = self._meta, rows_of(self._meta, index)
        self._survey.made.add("text")
        if not tasks_of(meta, index, rows):
            self._survey.note(Finding("text", "warn", f"{name}: has no task in words", key="task_index"))
        wanted = [key for key, item in meta.features.items() if item.dtype != "video"]
        there = [key for key in wanted if key in rows.columns]
        length = meta.episodes[index]["length"]
        self._survey.lengths(name, length, dict.fromkeys(there, len(rows)), wanted)
        if TIMES not in wanted and TIMES in rows.columns:
            there.append(TIMES)  # some writers leave it out of the features
        return {key: partial(self._column, rows, key) for key in there}

    def _column(self, rows: Rows, key: str) -> Series:
        feature = self._meta.features.get(key)
        if key == TIMES:
            values = rows.numbers(key)
            return Series(lambda: values, times=values.reshape(len(values), -1)[:, 0].astype(np.float64))
        if feature and feature.is_camera:
            stream = StillImages(rows, key, np.zeros(len(rows)), self._meta.folder)
            return Series(None, stream.frames, len(rows), codec=stream.codec())
        if feature and _is_vector(feature) and np.prod(feature.shape, dtype=float) * len(rows) <= MAX_VALUES:
            return Series(partial(rows.numbers, key))
        return Series()

    def _video(self, key: str, index: int) -> Series:
        """Compare a video with its episodes, and an episode's frames with its rows."""
        meta, name = self._meta, episode_name(index)
        span = meta.video(index, key)
        file = VideoFile(meta.folder.path(span.path))
        found = fit_of(meta, key, file, span)
        self._whole_video(key, span.path, file, found)
        if span.index in found.unused:
            count = found.unused[span.index]
            said = f"{span.path} has {count:,} frames after the last row of {name} that no row asks for"
            self._survey.note(Finding("frames", "warn", said, key=key, numbers={"frames": count}))
        times = times_of(rows_of(meta, index), meta.fps)
        codec, keys = file.table.codec, file.table.keys
        try:
            indices = frames_of_rows(meta, key, file, span, times, None)
        except EpisodeError as fault:
            if not found.fault:
                self.drifts |= BY_INDEX in fault.remedy
                said = f"{name} {key}: {fault.fault}"
                remedy = fault.remedy if BY_INDEX in fault.remedy else ""
                self._survey.note(Finding("skew", "warn", said, remedy, key))
            return Series(None, file.frames, len(file), keys, codec)
        starts = np.searchsorted(indices, keys[indices])
        return Series(None, lambda run: file.frames(indices[run]), len(indices), starts, codec)

    def _whole_video(self, key: str, path: str, file: VideoFile, found: Fit) -> None:
        """Note once what is wrong with a video as a whole."""
        if (key, path) in self._videos_seen:
            return
        self._videos_seen.add((key, path))
        rows = sum(span.rows for span in self._meta.spans(key, path))
        numbers = {"frames": len(file), "rows": rows}
        if found.fault:
            said = f"{path} {found.fault}"
            self._survey.note(Finding("frames", "warn", said, found.remedy, key, numbers))
        elif found.shift:
            said = f"{path} begins {found.shift:+.3f} s from where its metadata say, with one frame a row"
            self._survey.note(Finding("frames", "info", said, key=key, numbers=numbers))


def _is_vector(feature: Feature) -> bool:
    return feature.dtype.startswith(("float", "int", "uint", "bool"))


# -- keys


def _keys(meta: Metadata) -> tuple[KeyInfo, ...]:
    found = []
    for name, feature in meta.features.items():
        kind = "vector" if _is_vector(feature) else "other"
        shape, codec = feature.shape, feature.video.get("video.codec")
        if feature.is_camera:
            kind, codec = "camera", codec or _codec(meta, name)
            if len(shape) == 3 and shape[0] in (1, 3) and shape[2] not in (1, 3):  # stated as C, H, W
                shape = (shape[1], shape[2], shape[0])
        elif feature.dtype in ("string", "large_string"):
            kind = "text"
        found.append(KeyInfo(name, kind, shape, feature.dtype, meta.fps, feature.value_names, codec))
    return tuple(found)


def _codec(meta: Metadata, key: str) -> str | None:
    """Return the codec of the first episode; None where it cannot be read."""
    index = next(iter(meta.episodes))
    try:
        if meta.features[key].dtype == "video":
            return frame_table(meta.folder.path(meta.video(index, key).path)).codec
        rows = rows_of(meta, index)
        return StillImages(rows, key, np.zeros(len(rows)), meta.folder).codec()
    except HMAError:
        return None
