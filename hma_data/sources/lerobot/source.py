"""Read LeRobotDataset versions 2.0, 2.1 and 3.0 with pyarrow and PyAV alone.

A uri is a folder, `hf://datasets/NAME/DATASET[@REVISION]`, or `NAME/DATASET` on the Hub. From the Hub, only
the files of the episodes that are read are fetched. Keys are feature names (`action`,
`observation.images.cam_high`). The rate is `fps` of info.json, and the embodiment's rate must agree with it.

A row has the frame of its time, where the whole video fits the rows of its episodes (see `films`). Where the
film's stamps drift away from the rows' times, the embodiment may say `source: {layout: {pairing: index}}`:
row i then has frame i, and the times and the rate are the rows'. `pairing: time` believes the stamps whatever
the number of frames.

An inspection checks all of the metadata against the files that are there. Numbers, times and a few frames are
checked for a sample of the episodes. Nothing is fetched from the Hub for this.

T frames of an episode.
"""

import hashlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from hma_data.episodes.episode import Episode, Signal, Stream
from hma_data.errors import EpisodeError, HMAError, SourceError, meant
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import SAMPLE, EpisodeRef, Inspection, read_vector
from hma_data.sources.common import checks
from hma_data.sources.common.checks import Finding
from hma_data.sources.common.inspection import KeyInfo
from hma_data.sources.common.places import file_fingerprint
from hma_data.sources.common.survey import MAX_VALUES, Series, Survey, sampled
from hma_data.sources.common.video_file import FilmRows, VideoFile, frame_table
from hma_data.sources.lerobot.films import BY_INDEX, Fit, fit_of, frames_of_rows, open_video
from hma_data.sources.lerobot.language import language_of
from hma_data.sources.lerobot.metadata import Feature, Folder, Metadata, episode_name
from hma_data.sources.lerobot.rows import Rows, StillImages, rows_of, stated_times, tasks_of, times_of
from hma_data.storage.files import short_sha256
from hma_data.storage.paths import StrPath, as_text

NO_TASK = "episodes_without_task"
UNUSED = "frames_without_row"
RATE_TOLERANCE = 0.01  # of the rate
_SAMPLE = 4096  # bytes at each end of a video that its fingerprint covers
MAX_EPISODES = 20_000  # most episodes whose files are looked for, spread over all
TIMES = "timestamp"  # the column
MAX_VIDEOS = 64  # videos opened at most, over all cameras


class LeRobotSource:
    """A reader of LeRobotDatasets; see the module."""

    def __init__(self) -> None:
        self._opened: dict[str, Metadata] = {}

    def inspect(self, uri: StrPath, episodes: int = SAMPLE) -> Inspection:
        """Return what the dataset holds: its metadata, checked against the files that are there."""
        return inspect(as_text(uri), self._open(as_text(uri), again=True), episodes)

    def episode_ids(self, uri: StrPath) -> list[str]:
        """Return the episode ids, from `episode_000000` on."""
        return [episode_name(index) for index in self._open(as_text(uri), again=True).episodes]

    def index(self, uri: StrPath, embodiment: Embodiment | None = None) -> list[EpisodeRef]:
        """Return the episodes from the metadata; a missing video is found only when its episode is read.

        Raises:
            SourceError: damaged metadata, another rate than the embodiment's, or no such split.
        """
        uri = as_text(uri)
        meta = self._open(uri, again=True)
        if embodiment:
            _check_rate(meta, embodiment)
        chosen = embodiment.source.split if embodiment else None
        if chosen and chosen not in meta.splits:
            known = ", ".join(meta.splits) or "none"
            raise SourceError(uri, f"has no split {chosen!r}", f"its splits: {known}")
        samples: dict[str, str] = {}
        return [
            EpisodeRef(
                episode_name(index),
                row["length"],
                None if chosen else meta.split_of(index),
                _fingerprint(meta, index, samples),
            )
            for index, row in meta.episodes.items()
            if not chosen or index in meta.splits[chosen]
        ]

    def read(self, uri: StrPath, episode_id: str, embodiment: Embodiment) -> Episode:
        """Return one episode; its frames are decoded on demand.

        Raises:
            EpisodeError: a video is missing or has another number of frames, rows are damaged.
            SourceError: no such episode, a key that is no feature, another rate than the embodiment's.
        """
        uri = as_text(uri)
        meta = self._open(uri)
        _check_rate(meta, embodiment)
        _check_keys(meta, embodiment)
        digits = episode_id.removeprefix("episode_")
        index = int(digits) if digits.isdecimal() else -1
        if index not in meta.episodes or episode_name(index) != episode_id:
            raise SourceError(uri, f"has no episode {episode_id!r}", "hma inspect lists what it has")
        rows = rows_of(meta, index)
        length = meta.episodes[index]["length"]
        if len(rows) != length:
            raise EpisodeError(rows.path, f"has {len(rows)} rows of {episode_id}, its metadata says {length}")
        times = times_of(rows, meta.fps)
        tasks = tasks_of(meta, index, rows)
        pairing = (embodiment.source.layout or {}).get("pairing")
        streams: dict[str, Stream] = {}
        flags = {} if tasks or embodiment.source.instruction else {NO_TASK: 1}
        for camera in embodiment.cameras:
            if meta.features[camera.key].dtype == "image":
                streams[camera.name] = StillImages(rows, camera.key, times, meta.folder)
                continue
            span = meta.video(index, camera.key)
            file = open_video(meta.folder.path(span.path), camera.key)
            found = frames_of_rows(meta, camera.key, file, span, times, pairing)
            streams[camera.name] = FilmRows(file, times, found)
            if unused := fit_of(meta, camera.key, file, span).unused.get(index):
                flags[f"{UNUSED}:{camera.name}"] = unused
        read = partial(read_vector, read=rows.numbers, where=str(rows.path))
        return Episode(
            id=episode_id,
            streams=streams,
            actions=(Signal(times, read(embodiment.action)),),
            states=(Signal(times, read(embodiment.state)),) if embodiment.state else (),
            instruction=_instruction(meta, rows, embodiment.source.instruction, tasks),
            success=_success(rows),
            source=str(rows.path),
            metadata={"flags": flags, "language": language_of(meta, rows, times)},
        )

    def _open(self, uri: str, again: bool = False) -> Metadata:
        if again or uri not in self._opened:
            self._opened[uri] = Metadata(Folder(uri))
        return self._opened[uri]


open = LeRobotSource


def _check_rate(meta: Metadata, embodiment: Embodiment) -> None:
    if (embodiment.source.layout or {}).get("pairing") == "index":
        return  # row i has frame i: fps is the film's rate, and the rows have another
    stated = embodiment.frequency_hz
    if isinstance(stated, float) and abs(stated - meta.fps) > RATE_TOLERANCE * meta.fps:
        raise SourceError(
            meta.folder.uri,
            f"runs at {meta.fps:g} fps, embodiment {embodiment.id} says frequency_hz {stated:g}",
            "correct frequency_hz in the YAML",
        )


def _check_keys(meta: Metadata, embodiment: Embodiment) -> None:
    where = f"{meta.folder.uri}: embodiment {embodiment.id}"
    for key in [part.key for part in embodiment.components] + [camera.key for camera in embodiment.cameras]:
        if key not in meta.features:
            raise SourceError(where, f"{key!r} is not a feature", meant(key, meta.features, cutoff=0))
    for camera in embodiment.cameras:
        feature = meta.features[camera.key]
        if not feature.is_camera:
            kind = "a depth map" if feature.is_depth else feature.dtype
            cameras = ", ".join(name for name, item in meta.features.items() if item.is_camera)
            raise SourceError(where, f"{camera.key!r} is {kind}, not colour images", f"cameras: {cameras}")


def _fingerprint(meta: Metadata, index: int, samples: dict[str, str]) -> str:
    """Hash samples of the episode's files; each file is sampled once, however many episodes it has."""
    parts = [str(meta.folder.revision or ""), episode_name(index), str(meta.episodes[index]["length"])]
    try:
        spans = [meta.video(index, key) for key, item in meta.features.items() if item.dtype == "video"]
        parts += [f"{span.start} {span.stop}" for span in spans]
        files = [(meta.data_path(index), file_fingerprint), *((span.path, _video_sample) for span in spans)]
        for relative, sample in [] if meta.folder.repo else files:
            if relative not in samples:
                path = meta.folder.path(relative)
                samples[relative] = sample(path) if path.is_file() else "missing"
            parts.append(samples[relative])
    except EpisodeError as fault:  # `read` raises it again
        parts.append(str(fault))
    return short_sha256("\n".join(parts))


def _video_sample(path: Path) -> str:
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(_SAMPLE)
        file.seek(max(0, size - _SAMPLE))
        return hashlib.sha256(b"%d" % size + head + file.read(_SAMPLE)).hexdigest()


def _instruction(meta: Metadata, rows: Rows, key: str | None, tasks: list[str]) -> str:
    if not key or key == "task":
        return tasks[0] if tasks else ""
    said = rows.column(key)[0].as_py()
    if isinstance(said, int):  # GR00T: the annotations are numbers of tasks
        if said not in meta.tasks:
            raise EpisodeError(rows.path, f"{key!r} is {said}, which is not the index of a task")
        said = meta.tasks[said]
    return str(said or "")


def _success(rows: Rows) -> bool | None:
    return bool(rows.numbers("next.success").reshape(-1)[-1]) if "next.success" in rows.columns else None


# -- inspection


def inspect(uri: str, meta: Metadata, episodes: int) -> Inspection:
    """See Source.inspect."""
    lengths = [row["length"] for row in meta.episodes.values()]
    survey = Survey(len(lengths))
    survey.made.add("files")
    for name, stated, actual in (
        ("total_episodes", meta.info.total_episodes, len(lengths)),
        ("total_frames", meta.info.total_frames, sum(lengths)),
    ):
        if stated is not None and stated != actual:
            said = f"info.json says {name} {stated:,}, the episodes listed make {actual:,}"
            survey.note(Finding("files", "warn", said, numbers={"stated": stated, "listed": actual}))
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
            with self._survey.reading(episode_name(index)):
                paths[index] = self._meta.video(index, key).path if key else self._meta.data_path(index)
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
            return Series(partial(rows.numbers, key), times=stated_times(rows, self._meta.fps))
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
            said = f"{span.path} has {count:,} frames after the last row of {name} that belong to no row"
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
            said = f"{path} begins {found.shift:+.3f} s from where its metadata says, with one frame per row"
            self._survey.note(Finding("frames", "info", said, key=key, numbers=numbers))


def _is_vector(feature: Feature) -> bool:
    return feature.dtype.startswith(("float", "int", "uint", "bool"))


def _keys(meta: Metadata) -> tuple[KeyInfo, ...]:
    found = []
    for name, feature in meta.features.items():
        kind = "vector" if _is_vector(feature) else "other"
        shape, codec = feature.shape, feature.video.get("video.codec")
        if feature.is_camera:
            kind, codec = "camera", codec or _codec(meta, name)
            if len(shape) == 3 and shape[0] in (1, 3) and shape[2] not in (1, 3):  # stated as C, H, W
                shape = (shape[1], shape[2], shape[0])
            shape = (*shape[:2], 1 if shape[2:] == (1,) else 3)  # RGBA, or no channels stated: read as RGB
        elif feature.dtype in ("string", "large_string"):
            kind = "text"
        found.append(KeyInfo(name, kind, shape, feature.dtype, meta.fps, feature.value_names, codec))
    return tuple(found)


def _codec(meta: Metadata, key: str) -> str | None:
    """Return the codec of the first episode; None where it cannot be read, or would have to be fetched."""
    if meta.folder.repo:
        return None
    index = next(iter(meta.episodes))
    try:
        if meta.features[key].dtype == "video":
            return frame_table(meta.folder.path(meta.video(index, key).path)).codec
        rows = rows_of(meta, index)
        return StillImages(rows, key, np.zeros(len(rows)), meta.folder).codec()
    except HMAError:
        return None
