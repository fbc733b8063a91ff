"""Read LeRobotDataset versions 2.0, 2.1 and 3.0 with pyarrow and PyAV alone.

A uri is a folder, `hf://datasets/NAME/DATASET[@REVISION]`, or `NAME/DATASET` on the Hub. From the Hub, only
the files of the episodes that are read are fetched. Keys are feature names (`action`,
`observation.images.cam_high`). The rate is `fps` of info.json, and the embodiment's rate must agree with it.

A row has the picture of its time. Where the film's stamps drift away from the rows' times, the embodiment may
say `source: {layout: {pairing: index}}`: row i then has picture i, and the times and the rate are the rows'.

T frames of an episode.
"""

import hashlib
import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from hma_data.episodes.align import nearest
from hma_data.episodes.episode import Episode, Floats, Signal, Stream, rate_times
from hma_data.episodes.images import Images, decode_image
from hma_data.errors import EpisodeError, SourceError
from hma_data.registry.components import Camera, Vector
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import SAMPLE, EpisodeRef, Inspection, compose
from hma_data.sources.common.places import file_fingerprint
from hma_data.sources.common.video_file import VideoFile, frame_table
from hma_data.sources.lerobot.metadata import Folder, Metadata, Span, episode_name, parquet_explained
from hma_data.storage.paths import StrPath, as_text

RATE_TOLERANCE = 0.01  # of the rate
TIME_TOLERANCE = 0.25  # of a frame's period, between the time of a row and the time of its picture
PAIRING = "source: {layout: {pairing: index}}"
MAX_BYTES = 1 << 30  # of one column of a row group, as stored
MAX_VALUES = 1 << 26  # of such a column: a run of equal values may be stored as one value
_held = threading.local()  # key of a camera -> its open video: version 3 has hundreds of episodes in a file
_SAMPLE = 4096  # bytes at each end of a video that its fingerprint covers


def open() -> "LeRobotSource":
    """Return the source."""
    return LeRobotSource()


class LeRobotSource:
    """A reader of LeRobotDatasets; see the module."""

    def __init__(self) -> None:
        self._opened: dict[str, Metadata] = {}

    def inspect(self, uri: StrPath, episodes: int = SAMPLE) -> Inspection:
        """Return what the dataset holds: its metadata, checked against the files that are there."""
        from hma_data.sources.lerobot.inspect import inspect

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
        """Return one episode; its pictures are decoded on demand.

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
        tasks = _tasks(meta, index, rows)
        return Episode(
            id=episode_id,
            streams={
                camera.name: _stream(meta, index, camera, rows, times, pairs_by_index(embodiment))
                for camera in embodiment.cameras
            },
            actions=(Signal(times, _vector(rows, embodiment.action)),),
            states=(Signal(times, _vector(rows, embodiment.state)),) if embodiment.state else (),
            instruction=_instruction(rows, embodiment.source.instruction, tasks),
            success=_success(rows),
            source=str(rows.path),
            metadata={"tasks": tasks} if len(tasks) > 1 else {},
        )

    def _open(self, uri: str, again: bool = False) -> Metadata:
        if again or uri not in self._opened:
            self._opened[uri] = Metadata(Folder(uri))
        return self._opened[uri]


def pairs_by_index(embodiment: Embodiment) -> bool:
    """Check whether the embodiment says that row i has picture i."""
    return (embodiment.source.layout or {}).get("pairing") == "index"


def _check_rate(meta: Metadata, embodiment: Embodiment) -> None:
    if pairs_by_index(embodiment):
        return  # then fps is the film's rate, and the rows have another
    stated = embodiment.frequency_hz
    if isinstance(stated, float) and abs(stated - meta.fps) > RATE_TOLERANCE * meta.fps:
        raise SourceError(
            meta.folder.uri,
            f"runs at {meta.fps:g} fps, embodiment {embodiment.id} says frequency_hz {stated:g}",
            "correct frequency_hz in the YAML",
        )


def _check_keys(meta: Metadata, embodiment: Embodiment) -> None:
    where = f"{meta.folder.uri}: embodiment {embodiment.id}"
    vectors = [*embodiment.action.components, *(embodiment.state.components if embodiment.state else ())]
    for key in [part.key for part in vectors] + [camera.key for camera in embodiment.cameras]:
        if key not in meta.features:
            near = get_close_matches(key, meta.features, n=3, cutoff=0.4) or list(meta.features)
            raise SourceError(where, f"{key!r} is not a feature", f"did you mean {', '.join(near)}?")
    for camera in embodiment.cameras:
        feature = meta.features[camera.key]
        if not feature.is_camera:
            kind = "a depth map" if feature.is_depth else feature.dtype
            cameras = ", ".join(name for name, item in meta.features.items() if item.is_camera)
            raise SourceError(where, f"{camera.key!r} is {kind}, not colour pictures", f"cameras: {cameras}")


def _fingerprint(meta: Metadata, index: int, samples: dict[str, str]) -> str:
    """Hash samples of the episode's files; each file is sampled once, however many episodes it has."""
    parts = [str(meta.folder.revision or ""), episode_name(index), str(meta.episodes[index]["length"])]
    try:
        spans = [meta.video(index, key) for key, item in meta.features.items() if item.dtype == "video"]
        parts += [f"{span.start} {span.stop}" for span in spans]
        files = [(meta.data_path(index), file_fingerprint), *((span.path, _video_sample) for span in spans)]
        for relative, sample in [] if meta.folder.repo else files:
            path = meta.folder.path(relative)
            if relative not in samples:
                samples[relative] = sample(path) if path.is_file() else "missing"
            parts.append(samples[relative])
    except EpisodeError as fault:  # `read` raises it again
        parts.append(str(fault))
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def _video_sample(path: Path) -> str:
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(_SAMPLE)
        file.seek(max(0, size - _SAMPLE))
        return hashlib.sha256(b"%d" % size + head + file.read(_SAMPLE)).hexdigest()


# -- rows


@dataclass(frozen=True)
class Rows:
    """The rows of one episode in a parquet file.

    Attributes:
        path: of the file.
        columns: names of all columns of the file.
        places: (T, 2) row group and row within it.
    """

    path: Path
    columns: tuple[str, ...]
    places: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.places)

    def column(self, key: str) -> pa.Array:
        """Return one column over the episode.

        Raises:
            EpisodeError: the file has no such column, or cannot be read.
        """
        self.check(key)
        with parquet_explained(self.path, EpisodeError):
            parts = [
                _column_of_group(self.path, _changed(self.path), int(group), key).take(
                    self.places[self.places[:, 0] == group, 1]
                )
                for group in np.unique(self.places[:, 0])
            ]
            return pa.concat_arrays(parts)

    def check(self, key: str) -> None:
        """Raise an EpisodeError where the file has no such column."""
        if key not in self.columns:
            raise EpisodeError(self.path, f"has no column {key!r}", f"it has {', '.join(self.columns)}")

    def numbers(self, key: str) -> NDArray[Any]:
        """Return a column of numbers, (T,) or (T, …).

        Raises:
            EpisodeError: values are missing, of several widths, or no numbers.
        """
        values, shape = self.column(key), [len(self)]
        with parquet_explained(self.path, EpisodeError):
            while _is_list(values.type):
                self._complete(values, key)
                widths = pc.unique(pc.list_value_length(values)).to_pylist()
                if len(widths) != 1 or not widths[0]:
                    raise EpisodeError(self.path, f"{key!r} holds lists of {sorted(widths)} values")
                shape.append(widths[0])
                values = values.flatten()
            self._complete(values, key)
            kind = values.type
            if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)):
                raise EpisodeError(self.path, f"{key!r} holds {kind}, not numbers")
            numbers: NDArray[Any] = values.to_numpy(zero_copy_only=False).reshape(shape)
            return numbers

    def _complete(self, values: pa.Array, key: str) -> None:
        if values.null_count:
            raise EpisodeError(self.path, f"{key!r} has {values.null_count} missing values")


def rows_of(meta: Metadata, index: int) -> Rows:
    """Return the rows of an episode, found by `episode_index`.

    Raises:
        EpisodeError: the file is missing or damaged, or has no such rows.
    """
    path = meta.folder.path(meta.data_path(index))
    with parquet_explained(path, EpisodeError):
        with pq.ParquetFile(path) as file:
            columns = tuple(file.schema_arrow.names)
            metadata = file.metadata
        places = [np.zeros((0, 2), np.int64)]
        for group in range(metadata.num_row_groups):
            if not _may_hold(metadata.row_group(group), index):
                continue
            stored = _column_of_group(path, _changed(path), group, "episode_index")
            within = np.flatnonzero(stored.to_numpy(zero_copy_only=False) == index)
            places.append(np.stack([np.full(len(within), group), within], axis=1))
        placed = np.concatenate(places)
        if not len(placed):
            raise EpisodeError(path, f"has no rows of episode {index}", "the dataset is not complete")
        return Rows(path, columns, placed)


def _may_hold(held: Any, index: int) -> bool:
    """Check by its statistics whether a row group can hold rows of the episode."""
    for i in range(held.num_columns):
        column = held.column(i)
        if column.path_in_schema == "episode_index" and column.statistics and column.statistics.has_min_max:
            return bool(column.statistics.min <= index <= column.statistics.max)
    return True


@lru_cache(maxsize=8)  # version 3: the episodes of a file come one after the other
def _column_of_group(path: Path, changed: int, group: int, key: str) -> pa.Array:
    return _read(path, group, key)


def _changed(path: Path) -> int:
    return path.stat().st_mtime_ns


def _read(path: Path, group: int, key: str) -> pa.Array:
    """Return a whole column of a row group, if its size is plausible for a recording."""
    with pq.ParquetFile(path) as file:
        held = file.metadata.row_group(group)
        columns = [held.column(i) for i in range(held.num_columns)]
        parts = [item for item in columns if item.path_in_schema.startswith(key)]
        size = max((item.total_uncompressed_size for item in parts), default=0)
        values = max((item.num_values for item in parts), default=0)
        if size > MAX_BYTES or max(values, held.num_rows) > MAX_VALUES:
            fault = f"{key!r} claims {values:,} values of {held.num_rows:,} rows in {size:,} bytes"
            raise EpisodeError(path, fault, "the file may be damaged")
        column = file.read_row_group(group, [key], use_threads=False).column(key).combine_chunks()
    column = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    # Another library may have registered a type for matrices: its storage is plain lists.
    return column.storage if isinstance(column, pa.ExtensionArray) else column


def _is_list(kind: Any) -> bool:
    return bool(pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind))


def _vector(rows: Rows, vector: Vector) -> NDArray[np.float32]:
    pieces = {part.key: rows.numbers(part.key) for part in vector.components}
    return compose(vector, [pieces[part.key] for part in vector.components], str(rows.path))


def times_of(rows: Rows, fps: float) -> Floats:
    """Return the times (T,) of an episode's rows in seconds; at the rate where they state none."""
    if "timestamp" not in rows.columns:
        return rate_times(len(rows), fps)
    times = rows.numbers("timestamp").reshape(len(rows), -1)[:, 0].astype(np.float64)
    if not np.isfinite(times).all():
        raise EpisodeError(rows.path, "has timestamps that are not finite")
    return times


def _tasks(meta: Metadata, index: int, rows: Rows) -> list[str]:
    """Return the tasks in the order of the rows; the episode's own list where rows state none."""
    if "task_index" in rows.columns and meta.tasks:
        numbers = rows.numbers("task_index").reshape(-1).tolist()
        return [meta.tasks[number] for number in dict.fromkeys(numbers) if number in meta.tasks]
    said = meta.episodes[index].get("tasks")
    return [str(task) for task in said] if isinstance(said, list) else []


def _instruction(rows: Rows, key: str | None, tasks: list[str]) -> str:
    if key and key != "task":
        return str(rows.column(key)[0].as_py() or "")
    return tasks[0] if tasks else ""


def _success(rows: Rows) -> bool | None:
    return bool(rows.numbers("next.success").reshape(-1)[-1]) if "next.success" in rows.columns else None


# -- pictures


def _stream(meta: Metadata, index: int, camera: Camera, rows: Rows, times: Floats, by_index: bool) -> Stream:
    if meta.features[camera.key].dtype == "image":
        return StillPictures(rows, camera.key, times, meta.folder)
    span = meta.video(index, camera.key)
    file = _open_video(meta.folder.path(span.path), camera.key)
    return _Video(file, times, frames_of_rows(file, span, times, meta.fps, by_index))


def _open_video(path: Path, key: str) -> VideoFile:
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
        fault = f"its picture nearest to row {worst} is {off_ms[worst]:.1f} ms away"
        remedy = f"rows and video disagree on time; a frame is {1e3 / fps:.1f} ms"
        if count == rows:
            remedy += f", and both count {rows}: if row i belongs to picture i, set {PAIRING}"
        raise EpisodeError(file.path, fault, remedy)
    return indices + first


class _Video:
    """A camera's Stream: the frames of a video file with the indices (T,), at the times (T,) of the rows."""

    def __init__(self, file: VideoFile, times: Floats, indices: NDArray[np.int64]) -> None:
        self.timestamps = times
        self._file, self._indices = file, indices

    def frames(self, indices: Sequence[int] | NDArray[np.int64]) -> Images:
        """See Stream."""
        return self._file.frames(self._indices[np.asarray(indices, np.int64)])


class StillPictures:
    """A Stream of pictures stored in a parquet column, as bytes or as the path of a file."""

    def __init__(self, rows: Rows, key: str, timestamps: Floats, folder: Folder) -> None:
        rows.check(key)
        self.timestamps = timestamps
        self._rows, self._key, self._folder = rows, key, folder
        self._held: tuple[int, pa.Array] | None = None

    def frames(self, indices: Sequence[int] | NDArray[np.int64]) -> Images:
        """See Stream."""
        pictures = [decode_image(self._bytes(int(index)), self._where(int(index))) for index in indices]
        if len({picture.shape for picture in pictures}) > 1:
            raise EpisodeError(self._rows.path, f"{self._key!r} has pictures of several sizes")
        return np.stack(pictures) if pictures else np.zeros((0, 1, 1, 3), np.uint8)

    def codec(self) -> str | None:
        """Return png or jpeg, from the first picture; None for anything else."""
        start = self._bytes(0)[:4]
        return "png" if start == b"\x89PNG" else "jpeg" if start[:2] == b"\xff\xd8" else None

    def _where(self, index: int) -> str:
        return f"{self._rows.path} {self._key}[{index}]"

    def _bytes(self, index: int) -> bytes:
        group, within = (int(place) for place in self._rows.places[index])
        with parquet_explained(self._rows.path, EpisodeError):
            if self._held is None or self._held[0] != group:
                self._held = group, _read(self._rows.path, group, self._key)
            value = self._held[1][within].as_py()
        if isinstance(value, dict):
            value = value.get("bytes") or value.get("path")
        if isinstance(value, str):
            return self._file(value, self._where(index))
        if not isinstance(value, bytes):
            raise EpisodeError(self._where(index), "holds no picture")
        return value

    def _file(self, relative: str, where: str) -> bytes:
        try:
            return self._folder.path(relative).read_bytes()
        except OSError as fault:
            raise EpisodeError(where, f"its picture {relative!r} cannot be read: {fault.strerror}") from fault
