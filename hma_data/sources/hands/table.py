"""Read hand positions from the toolkit's own table: parquet, CSV or JSON, one row a hand.

| column | meaning |
|---|---|
| video | the video's path below the folder, with or without its suffix, or its bare name |
| frame | index of the frame in the video, from 0 (or from source.layout.first_frame) |
| side | left or right, the person's own hand; also L and R, in upper or lower case |
| score | optional: rows below source.layout.min_score are ignored |

and one of these, as fractions of the picture's width and height (x to the right, y down):

| columns | gives |
|---|---|
| landmarks | 42 numbers, x and y of MediaPipe's 21 points (0 is the wrist): landmarks, center, wrist |
| x0, y0, … x20, y20 | the same, one column a number, for CSV |
| left, top, right, bottom | a box: center |
| x, y | center; with wrist_x, wrist_y beside them or alone: wrist |

JSON is a list of such rows as objects. `video_id` and `frame_number` are accepted for `video` and `frame`. A
value that is not finite says that there is no hand.
"""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.errors import EpisodeError, SourceError
from hma_data.sources.hands.layout import HandsLayout, Video
from hma_data.sources.hands.runs import HandLabels, labels_from_rows

SUFFIXES = (".parquet", ".csv", ".json")
LARGEST = 8 << 30  # bytes
_ALIASES = {"video_id": "video", "frame_number": "frame"}
_SIDES = {"left": 0, "l": 0, "right": 1, "r": 1}
_FORMS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("landmarks", ("landmarks",)),
    ("landmarks", tuple(f"{axis}{i}" for i in range(21) for axis in "xy")),
    ("box", ("left", "top", "right", "bottom")),
    ("center", ("x", "y")),
    ("wrist", ("wrist_x", "wrist_y")),
)


class HandTable:
    """A table of hands, by video.

    Args:
        path: of the file.
        layout: of the source.

    Raises:
        SourceError: it cannot be read, lacks a column, or has another kind of value.
    """

    def __init__(self, path: Path, layout: HandsLayout) -> None:
        columns = read_columns(path)
        self._path = path
        for name in ("video", "frame", "side"):
            if name not in columns:
                raise SourceError(path, f"has no column {name!r}", f"its columns: {', '.join(columns)}")
        videos = np.array([str(value) for value in columns["video"]])
        numbers = _numbers(columns, "frame", path)
        self._sides = _side_numbers(columns["side"], path)
        scores = _numbers(columns, "score", path) if "score" in columns else np.ones(len(videos))
        self._scores, self._parts = scores, _parts(columns, path)
        good = np.isfinite(numbers) & ~(scores < layout.min_score)
        self._frames = np.where(good, numbers, 0).astype(np.int64) - layout.frame_offset
        names, number = np.unique(videos, return_inverse=True)
        order = np.argsort(number, kind="stable")
        ends = np.cumsum(np.bincount(number, minlength=len(names)))
        self._rows = {
            str(name): rows[good[rows]] for name, rows in zip(names, np.split(order, ends[:-1])) if len(rows)
        }

    def known(self) -> list[str]:
        """Return the videos that have rows."""
        return list(self._rows)

    def of(self, video: Video) -> HandLabels | None:
        """Return the hands of a video; None where the table does not have it."""
        name = next((alias for alias in video.aliases if alias in self._rows), None)
        if name is None:
            return None
        rows = self._rows[name]
        if not len(rows):
            raise EpisodeError(f"{self._path}: {name}", "has no hand above source.layout.min_score")
        parts = {part: values[rows] for part, values in self._parts.items()}
        return labels_from_rows(self._frames[rows], self._sides[rows], self._scores[rows], parts)


def read_columns(path: Path) -> dict[str, Any]:
    """Return the columns of a parquet, CSV or JSON file by name: lists, or arrays.

    Raises:
        SourceError: it is none of these, too large, damaged, or without rows.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    if path.stat().st_size > LARGEST:
        raise SourceError(path, f"has {path.stat().st_size:,} bytes, more than {LARGEST:,}")
    suffix = path.suffix.lower()
    try:
        if suffix == ".parquet":
            table = pq.read_table(path)
            found = {name: table.column(name) for name in table.column_names}
            columns = {name: _plain(column) for name, column in found.items()}
        elif suffix == ".json":
            columns = _of_rows(json.loads(path.read_bytes()), path)
        elif suffix == ".csv":
            with path.open(newline="", encoding="utf-8-sig") as file:
                header, *rows = csv.reader(file)
            if any(len(row) != len(header) for row in rows):
                raise SourceError(path, "has rows of different widths")
            columns = dict(zip(header, map(list, zip(*rows)))) if rows else {}
        else:
            raise SourceError(path, "is no table of hands", f"wanted: {', '.join(SUFFIXES)}")
    except (pa.ArrowException, OSError, ValueError, csv.Error, RecursionError) as fault:
        raise SourceError(
            path, f"cannot be read: {fault}".replace("\n", " "), "make the table anew"
        ) from fault
    if not columns or not len(next(iter(columns.values()))):
        raise SourceError(path, "has no rows")
    return {_ALIASES.get(name, name): values for name, values in columns.items()}


def _plain(column: Any) -> Any:
    """Return a parquet column as a list, or as an array where its values are numbers."""
    import pyarrow as pa

    if pa.types.is_floating(column.type) or pa.types.is_integer(column.type):
        return column.to_numpy()
    return column.to_pylist()


def _of_rows(rows: Any, path: Path) -> dict[str, list[Any]]:
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise SourceError(path, "is not a list of rows", "wanted: [{video, frame, side, x, y}, …]")
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: [row.get(name) for row in rows] for name in names}


def _numbers(columns: dict[str, Any], name: str, path: Path) -> NDArray[np.float64]:
    values = columns[name]
    try:
        found = np.array([np.nan if value in (None, "") else value for value in values], np.float64)
    except (TypeError, ValueError) as fault:
        raise SourceError(path, f"{name} holds what is no number: {fault}") from fault
    if found.ndim != 1 or (np.abs(found[np.isfinite(found)]) > 1e9).any():
        raise SourceError(path, f"{name} holds numbers beyond all measure")
    return found


def _side_numbers(values: Any, path: Path) -> NDArray[np.int64]:
    words = [str(value).strip().lower() for value in values]
    unknown = next((word for word in words if word not in _SIDES), None)
    if unknown is not None:
        raise SourceError(path, f"side holds {unknown!r}", "allowed: left, right")
    return np.array([_SIDES[word] for word in words], np.int64)


def _parts(columns: dict[str, Any], path: Path) -> dict[str, NDArray[np.float64]]:
    """Return center, wrist or landmarks -> (rows, 2 or 42), by the columns there are."""
    for part, names in _FORMS[:2]:
        if all(name in columns for name in names):
            if len(names) > 1:
                return {part: np.stack([_numbers(columns, name, path) for name in names], axis=1)}
            return {part: _lists(columns["landmarks"], path)}
    found = {
        part: np.stack([_numbers(columns, name, path) for name in names], axis=1)
        for part, names in _FORMS[2:]
        if all(name in columns for name in names)
    }
    if "box" in found:
        box = found.pop("box")
        found["center"] = (box[:, :2] + box[:, 2:]) / 2
    if not found:
        forms = "; ".join(", ".join(names[:4]) for _, names in _FORMS)
        raise SourceError(path, "has no columns that place a hand", f"wanted one of: {forms}")
    return found


def _lists(values: Any, path: Path) -> NDArray[np.float64]:
    try:
        rows = [json.loads(row) if isinstance(row, str) else row for row in values]
        found = np.array([[np.nan] * 42 if row is None else row for row in rows], np.float64)
        return found.reshape(len(rows), 42)
    except (TypeError, ValueError) as fault:
        raise SourceError(path, "landmarks are not 42 numbers a row", "x and y of 21 points") from fault
