"""Read the rows of an episode from the parquet files of a LeRobotDataset, columns of images among them.

T rows of an episode.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from hma_data.arrays import Array, Floats, Images, Indices, Ints
from hma_data.episodes.episode import OneByOne, of_one_size, rate_times
from hma_data.episodes.images import decode_image, image_codec
from hma_data.errors import EpisodeError
from hma_data.sources.lerobot.metadata import Folder, Metadata, parquet_explained

MAX_BYTES = 1 << 30  # of one column of a row group, as stored
MAX_VALUES = 1 << 26  # of such a column: a run of equal values may be stored as one value
State = tuple[int, int]  # a file's size and time of change


@dataclass(frozen=True)
class Rows:
    """The rows of one episode in a parquet file.

    Attributes:
        path: of the file.
        columns: names of all columns of the file.
        places: (T, 2) row group and row within it, in the order of the episode.
    """

    path: Path
    columns: tuple[str, ...]
    places: Ints

    def __len__(self) -> int:
        return len(self.places)

    def column(self, key: str) -> pa.Array:
        """Return one column over the episode.

        Raises:
            EpisodeError: the file has no such column, or cannot be read.
        """
        self.check(key)
        with parquet_explained(self.path, EpisodeError):
            parts, order = [], []
            for group in np.unique(self.places[:, 0]):
                held = _column_of_group(self.path, _state(self.path), int(group), key)
                mine = np.flatnonzero(self.places[:, 0] == group)
                parts.append(held.take(self.places[mine, 1]))
                order.append(mine)
            # A group's rows may lie apart in the episode: bring the groups back into its order.
            return pa.concat_arrays(parts).take(np.argsort(np.concatenate(order)))

    def check(self, key: str) -> None:
        """Raise an EpisodeError where the file has no such column."""
        if key not in self.columns:
            raise EpisodeError(self.path, f"has no column {key!r}", f"it has {', '.join(self.columns)}")

    def numbers(self, key: str) -> Array:
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
            numbers: Array = values.to_numpy(zero_copy_only=False).reshape(shape)
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
        state = _state(path)
        footer = _footer(path, state)
        places = [np.zeros((0, 2), np.int64)]
        Rows(path, footer.columns, places[0]).check("episode_index")
        for group in np.flatnonzero((footer.lows <= index) & (index <= footer.highs)).tolist():
            stored = _column_of_group(path, state, group, "episode_index")
            within = np.flatnonzero(stored.to_numpy(zero_copy_only=False) == index)
            places.append(np.stack([np.full(len(within), group), within], axis=1))
        placed = np.concatenate(places)
        if not len(placed):
            raise EpisodeError(path, f"has no rows of episode {index}", "the dataset is not complete")
        return _in_order(Rows(path, footer.columns, placed), index)


def _in_order(rows: Rows, index: int) -> Rows:
    """Return the rows by their number in the episode: parallel writers and merges store them in any order.

    Raises:
        EpisodeError: a row is missing, or there twice.
    """
    key = next((name for name in ("frame_index", "index") if name in rows.columns), None)
    if key is None:
        return rows
    numbers = rows.numbers(key).reshape(len(rows), -1)[:, 0]
    order = np.argsort(numbers, kind="stable")
    steps = np.diff(numbers[order])
    if (steps != 1).any():
        number = numbers[order][int(np.argmax(steps != 1))]
        fault = f"has row {number} of episode {index} twice" if (steps == 0).any() else ""
        fault = fault or f"lacks rows of episode {index} after row {number}"
        raise EpisodeError(rows.path, f"{fault}, by {key}", "write or merge the dataset again")
    return Rows(rows.path, rows.columns, rows.places[order])


@dataclass(frozen=True)
class _Footer:
    """The footer of a parquet file of G row groups.

    Attributes:
        columns: names of all columns.
        lows, highs: (G,) range of `episode_index` in each row group, unbounded where none is stated.
    """

    metadata: pq.FileMetaData
    columns: tuple[str, ...]
    lows: Floats
    highs: Floats


@lru_cache(maxsize=8)  # lerobot's merges write a row group an episode: it takes long to parse thousands
def _footer(path: Path, state: State) -> _Footer:
    with pq.ParquetFile(path) as file:
        metadata, columns = file.metadata, tuple(file.schema_arrow.names)
    ranges = np.tile([-np.inf, np.inf], (metadata.num_row_groups, 1))
    paths = [metadata.schema.column(i).path for i in range(metadata.num_columns)]
    for group in range(metadata.num_row_groups) if "episode_index" in paths else ():
        stated = metadata.row_group(group).column(paths.index("episode_index")).statistics
        if stated and stated.has_min_max:
            ranges[group] = stated.min, stated.max
    return _Footer(metadata, columns, ranges[:, 0], ranges[:, 1])


def _state(path: Path) -> State:
    found = path.stat()
    return found.st_size, found.st_mtime_ns


def _read(path: Path, state: State, group: int, key: str) -> pa.Array:
    """Return a whole column of a row group, if its size is plausible for a recording."""
    with pq.ParquetFile(path, metadata=_footer(path, state).metadata) as file:
        held = file.metadata.row_group(group)
        columns = [held.column(i) for i in range(held.num_columns)]
        parts = [item for item in columns if f"{item.path_in_schema}.".startswith(f"{key}.")]
        size = max((item.total_uncompressed_size for item in parts), default=0)
        values = max((item.num_values for item in parts), default=0)
        if size > MAX_BYTES or max(values, held.num_rows) > MAX_VALUES:
            fault = f"{key!r} claims {values:,} values of {held.num_rows:,} rows in {size:,} bytes"
            raise EpisodeError(path, fault, "the file may be damaged")
        column = file.read_row_group(group, [key], use_threads=False).column(key).combine_chunks()
    column = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    # Another library may have registered a type for matrices: its storage is plain lists.
    return column.storage if isinstance(column, pa.ExtensionArray) else column


# In version 3 the episodes of a file come one after the other.
_column_of_group = lru_cache(maxsize=8)(_read)


def _is_list(kind: Any) -> bool:
    return bool(pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind))


def stated_times(rows: Rows, fps: float) -> Floats:
    """Return the timestamps (T,) in seconds; those in ms, µs or ns show it by their steps."""
    times: Floats = rows.numbers("timestamp").reshape(len(rows), -1)[:, 0].astype(np.float64)
    periods = float(np.median(np.diff(times))) * fps if len(times) > 1 else 1.0
    return times * next((unit for unit in (1e-3, 1e-6, 1e-9) if 0.5 < periods * unit < 2), 1.0)


def times_of(rows: Rows, fps: float) -> Floats:
    """Return the times (T,) of an episode's rows in seconds; at the rate where they state none."""
    if "timestamp" not in rows.columns:
        return rate_times(len(rows), fps)
    times = stated_times(rows, fps)
    if not np.isfinite(times).all():
        raise EpisodeError(rows.path, "has timestamps that are not finite")
    if (np.diff(times) <= 0).any():
        row = int(np.argmax(np.diff(times) <= 0))
        said = f"{times[row]:g} s, then {times[row + 1]:g} s"
        raise EpisodeError(rows.path, f"its timestamps do not rise after row {row}: {said}")
    return times


def tasks_of(meta: Metadata, index: int, rows: Rows) -> list[str]:
    """Return the tasks in the order of the rows.

    Where a row's number is of no task, as merges leave it, the episode's own list counts.
    """
    listed = meta.episodes[index].get("tasks")
    listed = [listed] if isinstance(listed, str) else listed
    own = [str(task) for task in listed if task] if isinstance(listed, list) else []
    if "task_index" not in rows.columns:
        return own
    numbers = list(dict.fromkeys(rows.numbers("task_index").reshape(-1).tolist()))
    found = [meta.tasks[number] for number in numbers if meta.tasks.get(number)]
    return found if len(found) == len(numbers) or not own else own


class StillImages(OneByOne):
    """A Stream of images stored in a parquet column, as bytes or as the path of a file."""

    def __init__(self, rows: Rows, key: str, timestamps: Floats, folder: Folder) -> None:
        rows.check(key)
        self.timestamps = timestamps
        self._rows, self._key, self._folder = rows, key, folder
        self._held: tuple[int, pa.Array] | None = None

    def each(self, indices: Indices, least: int = 0) -> Iterator[Images]:
        """See episode.OneByOne."""
        images = (decode_image(self._bytes(i), self._where(i), least) for i in map(int, indices))
        return of_one_size(images, f"{self._rows.path} {self._key}")

    def codec(self) -> str | None:
        """Return png or jpeg, from the first image; None for anything else."""
        return image_codec(self._bytes(0))

    def _where(self, index: int) -> str:
        return f"{self._rows.path} {self._key}[{index}]"

    def _bytes(self, index: int) -> bytes:
        group, within = (int(place) for place in self._rows.places[index])
        with parquet_explained(self._rows.path, EpisodeError):
            if self._held is None or self._held[0] != group:
                self._held = group, _read(self._rows.path, _state(self._rows.path), group, self._key)
            value = self._held[1][within].as_py()
        if isinstance(value, dict):
            value = value.get("bytes") or value.get("path")
        if isinstance(value, str):
            try:
                return self._folder.path(value).read_bytes()
            except OSError as fault:
                said = f"its image {value!r} cannot be read: {fault.strerror}"
                raise EpisodeError(self._where(index), said) from fault
        if not isinstance(value, bytes):
            raise EpisodeError(self._where(index), "holds no image")
        return value
