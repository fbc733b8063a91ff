"""Read rows of a LeRobotDataset's parquet files: one episode's columns, and the pictures stored in them.

T rows of an episode.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from hma_data.episodes.episode import Floats
from hma_data.episodes.images import Images, decode_image
from hma_data.errors import EpisodeError
from hma_data.sources.lerobot.metadata import Folder, parquet_explained

MAX_BYTES = 1 << 30  # of one column of a row group, as stored
MAX_VALUES = 1 << 26  # of such a column: a run of equal values may be stored as one value


@dataclass(frozen=True)
class Rows:
    """The rows of one episode in a parquet file.

    Attributes:
        path: of the file.
        groups: row groups that hold them.
        columns: names of all columns of the file.
        places: (T, 2) row group and row within it.
    """

    path: Path
    groups: tuple[int, ...]
    columns: tuple[str, ...]
    places: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.places)

    def column(self, key: str) -> pa.Array:
        """Return one column over the episode.

        Raises:
            EpisodeError: the file has no such column, or cannot be read.
        """
        if key not in self.columns:
            raise EpisodeError(self.path, f"has no column {key!r}", f"it has {', '.join(self.columns)}")
        with parquet_explained(self.path, EpisodeError):
            parts = [self._group(group, key).take(self._within(group)) for group in self.groups]
            joined = pa.chunked_array(parts).combine_chunks()
            return joined.combine_chunks() if isinstance(joined, pa.ChunkedArray) else joined

    def numbers(self, key: str) -> NDArray[Any]:
        """Return a column of numbers, (T,) or (T, …).

        Raises:
            EpisodeError: values are missing, of several widths, or no numbers.
        """
        values, shape = self.column(key), [len(self)]
        with parquet_explained(self.path, EpisodeError):
            while pa.types.is_list(values.type) or _is_other_list(values.type):
                self._complete(values, key)
                widths = pc.unique(pc.list_value_length(values)).to_pylist()
                if len(widths) != 1 or not widths[0]:
                    raise EpisodeError(self.path, f"{key!r} holds lists of {sorted(widths)} values")
                shape.append(widths[0])
                values = values.flatten()
            self._complete(values, key)
            if not (_is_number(values.type) or pa.types.is_boolean(values.type)):
                raise EpisodeError(self.path, f"{key!r} holds {values.type}, not numbers")
            numbers: NDArray[Any] = values.to_numpy(zero_copy_only=False).reshape(shape)
            return numbers

    def _complete(self, values: pa.Array, key: str) -> None:
        if values.null_count:
            raise EpisodeError(self.path, f"{key!r} has {values.null_count} missing values")

    def _within(self, group: int) -> NDArray[np.int64]:
        return self.places[self.places[:, 0] == group, 1]

    def _group(self, group: int, key: str) -> pa.Array:
        return _column_of_group(self.path, _changed(self.path), group, key)


def rows_of(path: Path, index: int) -> Rows:
    """Return the rows of an episode, found by `episode_index`; all rows where the file has no such column.

    Raises:
        EpisodeError: the file is missing or damaged, or has no such rows.
    """
    with parquet_explained(path, EpisodeError):
        with pq.ParquetFile(path) as file:
            columns = tuple(file.schema_arrow.names)
            metadata = file.metadata
        candidates = [group for group in range(metadata.num_row_groups) if _may_hold(metadata, group, index)]
        places = []
        for group in candidates:
            if "episode_index" in columns:
                found = _column_of_group(path, _changed(path), group, "episode_index").to_numpy(
                    zero_copy_only=False
                )
                within = np.flatnonzero(found == index)
            else:
                within = np.arange(min(metadata.row_group(group).num_rows, MAX_VALUES))
            places.append(np.stack([np.full(len(within), group), within], axis=1))
        placed = np.concatenate(places) if places else np.zeros((0, 2), np.int64)
        if not len(placed):
            raise EpisodeError(path, f"has no rows of episode {index}", "the dataset is not complete")
        return Rows(path, tuple(int(group) for group in np.unique(placed[:, 0])), columns, placed)


class StillPictures:
    """A Stream of pictures stored in a parquet column, as bytes or as the path of a file."""

    def __init__(self, rows: Rows, key: str, timestamps: Floats, folder: Folder) -> None:
        self.timestamps = timestamps
        self._rows, self._key, self._folder = rows, key, folder
        if key not in rows.columns:
            raise EpisodeError(rows.path, f"has no column {key!r}", f"it has {', '.join(rows.columns)}")
        self._held: tuple[int, pa.Array] | None = None

    def frames(self, indices: Sequence[int] | NDArray[np.int64]) -> Images:
        """See Stream."""
        pictures = [self._picture(int(index)) for index in indices]
        if len({picture.shape for picture in pictures}) > 1:
            raise EpisodeError(self._rows.path, f"{self._key!r} has pictures of several sizes")
        return np.stack(pictures) if pictures else np.zeros((0, 1, 1, 3), np.uint8)

    def codec(self) -> str | None:
        """Return png or jpeg, from the first picture; None for anything else."""
        start = self._bytes(0)[:4]
        return "png" if start == b"\x89PNG" else "jpeg" if start[:2] == b"\xff\xd8" else None

    def _picture(self, index: int) -> Images:
        return decode_image(self._bytes(index), f"{self._rows.path} {self._key}[{index}]")

    def _bytes(self, index: int) -> bytes:
        group, within = (int(place) for place in self._rows.places[index])
        with parquet_explained(self._rows.path, EpisodeError):
            value = self._column(group)[within].as_py()
        if isinstance(value, dict):
            value = value.get("bytes") or value.get("path")
        where = f"{self._rows.path} {self._key}[{index}]"
        if isinstance(value, str):
            return self._file(value, where)
        if not isinstance(value, bytes):
            raise EpisodeError(where, "holds no picture")
        return value

    def _column(self, group: int) -> pa.Array:
        if self._held is None or self._held[0] != group:
            self._held = group, _read(self._rows.path, group, self._key)
        return self._held[1]

    def _file(self, relative: str, where: str) -> bytes:
        if Path(relative).is_absolute() or ".." in Path(relative).parts or "\0" in relative:
            raise EpisodeError(where, f"names a file outside the dataset: {relative!r}")
        try:
            return self._folder.path(relative).read_bytes()
        except OSError as fault:
            raise EpisodeError(where, f"its picture {relative!r} cannot be read: {fault.strerror}") from fault


@lru_cache(maxsize=8)  # version 3: the episodes of a file come one after the other
def _column_of_group(path: Path, changed: int, group: int, key: str) -> pa.Array:
    with parquet_explained(path, EpisodeError):
        return _read(path, group, key)


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
        return _only(file.read_row_group(group, [key], use_threads=False), key)


def _only(table: pa.Table, key: str) -> pa.Array:
    """Return a table's column in one piece.

    It is returned as plain lists where another library has registered a type for matrices.
    """
    column = table.column(key).combine_chunks()
    column = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    return column.storage if isinstance(column, pa.ExtensionArray) else column


def _changed(path: Path) -> int:
    return path.stat().st_mtime_ns


def _may_hold(metadata: Any, group: int, index: int) -> bool:
    """Check by its statistics whether a row group can hold rows of the episode."""
    held = metadata.row_group(group)
    for i in range(held.num_columns):
        column = held.column(i)
        if column.path_in_schema == "episode_index" and column.statistics and column.statistics.has_min_max:
            return bool(column.statistics.min <= index <= column.statistics.max)
    return True


def _is_other_list(kind: Any) -> bool:
    return bool(pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind))


def _is_number(kind: Any) -> bool:
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))
