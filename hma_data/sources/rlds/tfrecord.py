"""Find and read the records of TFRecord files, with their checksums verified.

A record is its length (uint64), the masked CRC-32C of those eight bytes, the data, and the masked CRC-32C
of the data; all little endian (format: TensorFlow's TFRecord). A scan needs only the length and the
checksums, 16 bytes a record, so any record of a large file is found without reading the data of the
others. A remote file is read no further than the record that is asked for.
"""

import os
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import google_crc32c
import numpy as np

from hma_data.errors import EpisodeError, SourceError
from hma_data.sources.rlds.record_index import EMPTY, Framing
from hma_data.storage.fetch import attempt, fetch, is_local

HEADER = struct.Struct("<QI")
FOOTER = struct.Struct("<I")
READ_AHEAD = 32 << 10  # bytes of one request, while records are shorter than that
MAX_RECORD = 2**31  # protobuf's own limit
Read = Callable[[int, int], bytes]  # (start, end) -> the bytes between them


def masked_crc(data: Any) -> int:
    """Return TFRecord's masked CRC-32C: rotated right by 15 bits, with a constant added."""
    crc = google_crc32c.value(data)
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def scan(files: Any, path: str, size: int, known: Framing = EMPTY, limit: int = -1) -> Framing:
    """Return the framing of a file; begin where `known` ends.

    Args:
        files: the fsspec file system.
        path: on it.
        size: bytes of the file.
        limit: stop after this many records; -1 for all.

    Raises:
        SourceError: the file cannot be read, or is not a TFRecord file at all.
    """
    offsets, lengths, checks = known.offsets.tolist(), known.lengths.tolist(), known.checks.tolist()
    position, fault = offsets[-1] + lengths[-1] + FOOTER.size if offsets else 0, ""
    with reader(files, path, size) as read:
        found = (offsets, lengths, checks)
        fault = attempt(files, path, lambda: _walk(read, position, size, limit, found, path))
    end = offsets[-1] + lengths[-1] + FOOTER.size if offsets else 0
    return Framing(
        np.array(offsets, np.int64),
        np.array(lengths, np.int64),
        np.array(checks, np.uint32),
        fault,
        bool(fault) or end >= size,
    )


def _walk(
    read: Read, position: int, size: int, limit: int, found: tuple[list[int], list[int], list[int]], path: str
) -> str:
    """Append the offset, length and checksum of each record from `position` on; return why it ended early."""
    offsets, lengths, checks = found
    header = read(position, position + HEADER.size) if position < size else b""
    if not position and header[:2] == b"\x1f\x8b":
        raise SourceError(path, "is gzip-compressed", "decompress it: gunzip")
    while position < size and len(offsets) != limit:
        length, fault = _record_length(header, position, size)
        if fault:
            return fault
        data_end = position + HEADER.size + length
        tail = read(data_end, min(size, data_end + FOOTER.size + HEADER.size))
        if len(tail) < FOOTER.size:
            return f"cut off within the record at byte {position}"
        offsets.append(position + HEADER.size)
        lengths.append(length)
        checks.append(FOOTER.unpack_from(tail)[0])
        header, position = tail[FOOTER.size :], data_end + FOOTER.size
    return ""


@contextmanager
def reader(files: Any, path: str, size: int) -> Iterator[Read]:
    """Yield a function that reads parts of a file: a local one directly, a remote one with read-ahead."""
    if not is_local(files):
        yield _Window(files, path, size)
        return
    handle = attempt(files, path, lambda: os.open(path, os.O_RDONLY))
    try:
        yield lambda start, end: os.pread(handle, end - start, start)
    finally:
        os.close(handle)


class _Window:
    """Read a remote file through the last range that was fetched."""

    def __init__(self, files: Any, path: str, size: int) -> None:
        self._files, self._path, self._size = files, path, size
        self._start, self._data, self._before = 0, b"", 0

    def __call__(self, start: int, end: int) -> bytes:
        if not self._start <= start <= end <= self._start + len(self._data):
            near = start - self._before < READ_AHEAD
            stop = min(self._size, max(end, start + READ_AHEAD) if near else end)
            self._data, self._start = fetch(self._files, self._path, start, stop), start
        self._before = start
        return self._data[start - self._start : end - self._start]


def _record_length(header: bytes, position: int, size: int) -> tuple[int, str]:
    """Return the length of the record at `position`, and why it cannot be known (else empty)."""
    if len(header) < HEADER.size:
        return 0, f"cut off at byte {size}, within the header of the record at byte {position}"
    length, check = HEADER.unpack(header)
    if masked_crc(header[:8]) != check:
        return 0, f"the length of the record at byte {position} fails its checksum"
    if position + HEADER.size + length + FOOTER.size > size:
        return 0, f"cut off at byte {size}, within the {length} bytes of the record at byte {position}"
    if length > MAX_RECORD:
        return 0, f"the record at byte {position} has {length:,} bytes, more than an Example can have"
    return length, ""


def read_record(files: Any, path: str, frames: Framing, index: int, where: str) -> bytes:
    """Return the data of one record; check its length and data against the checksums in the file.

    Args:
        where: the episode, for the error.

    Raises:
        EpisodeError: no record is where the framing says, or its checksum fails.
        SourceError: the network fails.
    """
    offset, length = int(frames.offsets[index]), int(frames.lengths[index])
    start, end = offset - HEADER.size, offset + length + FOOTER.size
    try:
        record = fetch(files, path, start, end)
    except SourceError as fault:
        if is_local(files):
            raise EpisodeError(where, f"cannot be read from {path}: {fault.fault}") from fault
        raise
    if len(record) != end - start:
        raise EpisodeError(
            where, f"{path} gives {len(record)} of the {end - start} bytes of the record at byte {start}"
        )
    stated, check = HEADER.unpack_from(record)
    if stated != length or masked_crc(record[:8]) != check:
        raise EpisodeError(where, f"{path} has no record of {length} bytes at byte {start}")
    data = record[HEADER.size : -FOOTER.size]
    if (
        not masked_crc(data)
        == FOOTER.unpack_from(record, len(record) - FOOTER.size)[0]
        == frames.checks[index]
    ):
        raise EpisodeError(where, f"the {length} bytes at byte {offset} of {path} fail their checksum")
    return data
