"""Read ArrayRecord files as TFDS writes them, with the `array_record` package.

The package reads local files only. It does not tell the offset of a record, so a record is found by its
number.
"""

from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np

from hma_data.errors import EpisodeError, MissingDependencyError, SourceError
from hma_data.sources.rlds.record_index import EMPTY, Framing

RANDOM_ACCESS = "readahead_buffer_size:0,max_parallelism:0"


def scan(files: Any, path: str, size: int, known: Framing = EMPTY, limit: int = -1) -> Framing:
    """Return the numbers, lengths and CRC-32C of a file's records.

    Every record is read once. A damaged record gets length 0, and fails when it is read. The arguments
    `files`, `size`, `known` and `limit` are ignored.

    Raises:
        SourceError: the file cannot be opened.
        MissingDependencyError: the array_record package is not installed.
    """
    reader = _open(path)
    if not reader.ok():
        return Framing(EMPTY.offsets, EMPTY.lengths, EMPTY.checks, _fault(reader))
    count = reader.num_records()
    lengths, checks = np.zeros(count, np.int64), np.zeros(count, np.uint32)
    for index in range(count):
        try:
            [data] = reader.read([index])
        except RuntimeError:
            continue
        lengths[index], checks[index] = len(data), google_crc32c.value(data)
    return Framing(np.arange(count, dtype=np.int64), lengths, checks)


def read_record(files: Any, path: str, frames: Framing, index: int, where: str) -> bytes:
    """Return the data of one record; check it against its chunk's hash and against the framing.

    Args:
        where: the episode, for the error.

    Raises:
        EpisodeError: it is damaged, or does not match the framing.
    """
    try:
        [data] = _open(path).read([index])
    except (RuntimeError, SourceError) as fault:
        raise EpisodeError(where, f"cannot be read from {path}: {fault}") from fault
    if len(data) != frames.lengths[index] or google_crc32c.value(data) != frames.checks[index]:
        raise EpisodeError(where, f"record {index} of {path} is not what it was when the file was indexed")
    return bytes(data)


def _open(path: str) -> Any:
    try:
        from array_record.python.array_record_module import ArrayRecordReader
    except ImportError as fault:
        raise MissingDependencyError(
            path, "ArrayRecord files need the package array-record", "uv sync --extra arrayrecord"
        ) from fault
    try:
        Path(path).open("rb").close()
    except OSError as fault:
        raise SourceError(path, f"cannot be read: {fault.strerror}", "check the path") from fault
    return ArrayRecordReader(path, RANDOM_ACCESS)


def _fault(reader: Any) -> str:
    """Return why a reader is not ok, from the error of its first read."""
    try:
        reader.read([0])
    except RuntimeError as fault:
        return str(fault)
    return "is no ArrayRecord file"
