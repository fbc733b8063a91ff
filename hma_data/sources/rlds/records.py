"""Find and read the records of TFRecord and ArrayRecord files.

A TFRecord is its length (uint64), the masked CRC-32C of those eight bytes, the data, and the masked CRC-32C
of the data; all little endian (format: TensorFlow's TFRecord). A scan reads only the length and the
checksums, 16 bytes a record. A remote file is read no further than the record that is asked for; the parts
of it that are expected are fetched ahead, by blocks.

ArrayRecord files of this machine are read with the `array_record` package. It does not tell the offset of a
record, so a record is found by its number.
"""

import os
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from threading import Lock
from typing import Any

import google_crc32c
import numpy as np
from numpy.typing import NDArray

from hma_data.arrays import Ints
from hma_data.errors import EpisodeError, MissingDependencyError, SourceError, install_command
from hma_data.storage.blocks import Blocks
from hma_data.storage.fetch import mark, said
from hma_data.storage.kinds import LFS, unreadable
from hma_data.storage.remote import RemotePath, attempt, fetch_range

HEADER = struct.Struct("<QI")
FOOTER = struct.Struct("<I")
READ_AHEAD = 32 << 10  # bytes of one request, while records are shorter than that
RANDOM_ACCESS = "readahead_buffer_size:0,max_parallelism:0"  # options of array_record's reader
Read = Callable[[int, int], bytes]  # (start, end) -> the bytes between them


@dataclass(frozen=True)
class RecordFraming:
    """The positions of the N records of a file."""

    offsets: Ints  # first byte of each record's data
    lengths: Ints  # bytes of data
    checks: NDArray[np.uint32]  # checksums of the data as stored
    fault: str = ""  # why reading stopped after the last record; empty where the file ends there
    whole: bool = True  # whether the file was read to its end (or to `fault`)

    def __len__(self) -> int:
        return len(self.offsets)

    def fingerprint(self, index: int) -> str:
        """Return 24 hex digits that change with the record's content."""
        return f"{int(self.lengths[index]):016x}{int(self.checks[index]):08x}"


EMPTY = RecordFraming(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.uint32), whole=False)


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Raise SourceError where a file of a dataset cannot be read."""
    try:
        yield
    except OSError as fault:
        text = f"cannot be read: {said(fault)}"
        raise SourceError(path, text, "check the path and your access to it") from fault


class RecordFile:
    """One TFRecord file of `size` bytes, on this machine or in a store."""

    def __init__(self, path: Path, size: int) -> None:
        self._path, self._size = path, size
        self._frames = EMPTY
        self._lock = Lock()
        self.blocks = Blocks(partial(fetch_range, path), size) if isinstance(path, RemotePath) else None

    def framing(self, limit: int = -1) -> RecordFraming:
        """Return where the records lie; for a remote file at least the first `limit`, -1 for all.

        Raises:
            SourceError: the file cannot be read, or is compressed.
        """
        with self._lock:
            if not (self._frames.whole or 0 <= limit <= len(self._frames)):
                self._frames = self._scanned(limit)
            return self._frames

    def _scanned(self, limit: int) -> RecordFraming:
        with self._parts() as read:
            return scan_tfrecord(read, self._path, self._size, self._frames, limit if self.blocks else -1)

    @contextmanager
    def _parts(self) -> Iterator[Read]:
        """Yield a function that reads parts: of a local file directly, of a remote one with read-ahead."""
        if self.blocks:
            yield _Window(self._bytes, self._size)
            return
        with explained(self._path), self._path.open("rb", buffering=0) as file:
            yield lambda start, end: os.pread(file.fileno(), end - start, start)

    def _bytes(self, start: int, end: int) -> bytes:
        if not isinstance(self._path, RemotePath) or not self.blocks or start >= end:
            return b""
        with explained(self._path):
            if self.blocks.expects(start):
                return self.blocks.read(start, end)
            return fetch_range(self._path, start, end)

    def read(self, index: int, where: str) -> bytes:
        """Return the data of a record, with its checksum verified; `where` is the episode, for the error.

        Raises:
            EpisodeError: there is no such record, or it is damaged.
            SourceError: the file cannot be read.
        """
        frames = self.framing(index + 1)
        if index >= len(frames):
            raise EpisodeError(where, f"{self._path}: {frames.fault or f'ends after {len(frames)} records'}")
        return self._picked(frames, index, where)

    def _picked(self, frames: RecordFraming, index: int, where: str) -> bytes:
        offset, length = int(frames.offsets[index]), int(frames.lengths[index])
        with self._parts() as read:
            data = read(offset, offset + length)
        if masked_crc(data) != frames.checks[index]:
            fault = f"the {length} bytes at byte {offset} of {self._path} fail their checksum"
            raise EpisodeError(where, fault)
        return data


class ArrayRecordFile(RecordFile):
    """One ArrayRecord file; its framing has each record's number in place of the offset."""

    def _scanned(self, limit: int) -> RecordFraming:
        """Read every record once; a damaged one gets length 0, and fails when it is read."""
        reader = self._reader()
        if not reader.ok():
            why = "is no ArrayRecord file"
            try:
                reader.read([0])  # its error says why
            except RuntimeError as error:
                why = str(error)
            fault, _ = unreadable(self._path, why, "")
            return replace(EMPTY, fault=fault, whole=True)
        count = reader.num_records()
        lengths, checks = np.zeros(count, np.int64), np.zeros(count, np.uint32)
        for index in range(count):
            try:
                [data] = reader.read([index])
            except RuntimeError:
                continue
            lengths[index], checks[index] = len(data), google_crc32c.value(data)
        return RecordFraming(np.arange(count, dtype=np.int64), lengths, checks)

    def _picked(self, frames: RecordFraming, index: int, where: str) -> bytes:
        try:
            [data] = self._reader().read([index])
        except RuntimeError as fault:
            raise EpisodeError(where, f"cannot be read from {self._path}: {fault}") from fault
        return bytes(data)

    def _reader(self) -> Any:
        if self.blocks:
            raise SourceError(self._path, "ArrayRecord is read from local disks only", "copy it here")
        try:
            from array_record.python.array_record_module import ArrayRecordReader
        except ImportError as fault:
            said = "ArrayRecord files need the package array-record"
            raise MissingDependencyError(self._path, said, install_command("arrayrecord")) from fault
        return ArrayRecordReader(str(self._path), RANDOM_ACCESS)


def open_records(path: Path) -> RecordFile:
    """Return the record file at a path.

    It is cached for the process: a local file while its size and date stay the same, a remote one for good.

    Raises:
        SourceError: it is not there, or the file system does not answer.
    """
    if isinstance(path, RemotePath):
        return _opened(path, *remote_state(path), os.getpid())
    with explained(path):
        found = path.stat()
    return _opened(path, found.st_size, str(found.st_mtime_ns), os.getpid())


@lru_cache(maxsize=4096)
def remote_state(path: RemotePath) -> tuple[int, str]:
    """Return the size of a file in a store, and a text that changes when the file does."""
    with explained(path):
        found = attempt(path, "read", lambda: dict(path.files.info(path.key)))
    if found.get("size") is None:
        remedy = "copy the files here, or name a server that states it"
        raise SourceError(path, "its server does not state its length", remedy)
    return int(found["size"]), mark(found)


@lru_cache(maxsize=4096)
def _opened(path: Path, size: int, state: str, pid: int) -> RecordFile:
    return ArrayRecordFile(path, size) if ".array_record" in path.name else RecordFile(path, size)


# -- TFRecord


def masked_crc(data: Any) -> int:
    """Return TFRecord's masked CRC-32C: rotated right by 15 bits, with a constant added."""
    crc = google_crc32c.value(data)
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def scan_tfrecord(
    read: Read, path: Path, size: int, known: RecordFraming = EMPTY, limit: int = -1
) -> RecordFraming:
    """Return the framing of a TFRecord file: begin where `known` ends, stop after `limit` records (-1: none).

    Raises:
        SourceError: the file cannot be read, or is compressed.
    """
    rows: list[tuple[int, int, int]] = []  # of the records that are not known: offset, length and checksum
    position, fault = int(known.offsets[-1] + known.lengths[-1]) + FOOTER.size if len(known) else 0, ""
    header = read(position, min(size, position + HEADER.size))
    if not position and header[:2] == b"\x1f\x8b":
        raise SourceError(path, "is gzip-compressed", "decompress it: gunzip")
    if not position and header == LFS[: HEADER.size]:
        raise SourceError(path, *unreadable(path, "is a Git LFS pointer", "run git lfs pull"))
    while position < size and len(known) + len(rows) != limit:
        end, fault = _data_end(header, position, size)
        if fault:
            break
        tail = read(end, min(size, end + FOOTER.size + HEADER.size))
        start = position + HEADER.size
        rows.append((start, end - start, FOOTER.unpack_from(tail)[0]))
        header, position = tail[FOOTER.size :], end + FOOTER.size
    offsets, lengths, checks = np.array(rows, np.int64).reshape(-1, 3).T
    return RecordFraming(
        np.append(known.offsets, offsets),
        np.append(known.lengths, lengths),
        np.append(known.checks, checks.astype(np.uint32)),
        fault,
        bool(fault) or position >= size,
    )


def _data_end(header: bytes, position: int, size: int) -> tuple[int, str]:
    """Return where the data of the record at `position` end, and why that cannot be known (else empty)."""
    if len(header) < HEADER.size:
        return 0, f"cut off at byte {size}, within the header of the record at byte {position}"
    length, check = HEADER.unpack(header)
    if masked_crc(header[:8]) != check:
        return 0, f"the length of the record at byte {position} fails its checksum"
    end = position + HEADER.size + length
    if end + FOOTER.size > size:
        return 0, f"cut off at byte {size}, within the record of {length} bytes at byte {position}"
    return end, ""


class _Window:
    """A reader of a remote file that serves what it can from the last range it fetched."""

    def __init__(self, read: Read, size: int) -> None:
        self._read, self._size = read, size
        self._start, self._data, self._before = 0, b"", 0

    def __call__(self, start: int, end: int) -> bytes:
        if not self._start <= start <= end <= self._start + len(self._data):
            near = start - self._before < READ_AHEAD
            stop = min(self._size, max(end, start + READ_AHEAD) if near else end)
            self._data, self._start = self._read(start, stop), start
        self._before = start
        return self._data[start - self._start : end - self._start]
