"""Find and read the records of TFRecord and ArrayRecord files, with their checksums verified.

A TFRecord is its length (uint64), the masked CRC-32C of those eight bytes, the data, and the masked CRC-32C
of the data; all little endian (format: TensorFlow's TFRecord). A scan reads only the length and the
checksums, 16 bytes a record. A remote file is read no further than the record that is asked for.

ArrayRecord files are read from this machine only, with the `array_record` package. It does not tell the
offset of a record, so a record is found by its number.

Where the records of a file lie is kept in `$HMA_CACHE/rlds`, by default `~/.cache/hma/rlds`, while the file
keeps its state (size and date, or ETag). Deleting it costs a new scan.
"""

import hashlib
import logging
import os
import re
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any
from zipfile import BadZipFile

import google_crc32c
import numpy as np
from numpy.typing import NDArray

from hma_data.errors import EpisodeError, MissingDependencyError, OutputError, SourceError
from hma_data.storage.fetch import attempt, fetch, info, is_local, mark, protocol
from hma_data.storage.files import atomic_path, cache_folder
from hma_data.storage.kinds import LFS, unreadable

HEADER = struct.Struct("<QI")
FOOTER = struct.Struct("<I")
READ_AHEAD = 32 << 10  # bytes of one request, while records are shorter than that
KEPT_EVERY = 32  # new records after which an index is written; fewer of a local file are scanned just as fast
RANDOM_ACCESS = "readahead_buffer_size:0,max_parallelism:0"  # for the array_record package
Read = Callable[[int, int], bytes]  # (start, end) -> the bytes between them

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Framing:
    """The positions of the N records of a file."""

    offsets: NDArray[np.int64]  # first byte of each record's data; in an ArrayRecord file the record's number
    lengths: NDArray[np.int64]  # bytes of data
    checks: NDArray[np.uint32]  # checksums of the data as stored
    fault: str = ""  # why reading stopped after the last record; empty where the file ends there
    whole: bool = True  # whether the file was read to its end (or to `fault`)

    def __len__(self) -> int:
        return len(self.offsets)

    def fingerprint(self, index: int) -> str:
        """Return 24 hex digits that change with the record's content."""
        return f"{int(self.lengths[index]):016x}{int(self.checks[index]):08x}"


EMPTY = Framing(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.uint32), whole=False)


class RecordFile:
    """One record file of `size` bytes, on an fsspec file system; `state` changes when the file does."""

    def __init__(self, files: Any, path: str, size: int, state: str) -> None:
        self._files, self._path, self._size = files, path, size
        self._scan, self._pick = scan_tfrecord, read_tfrecord
        if is_array_record(path):
            self._scan, self._pick = scan_array_record, read_array_record
        digest = hashlib.sha256(f"{protocol(files)}://{path}\n{state}".encode()).hexdigest()[:32]
        self._index = cache_folder() / "rlds" / f"{digest}.npz"
        self._frames: Framing | None = None
        self._kept = 0  # records in the index on disk
        self._lock = Lock()

    def framing(self, limit: int = -1) -> Framing:
        """Return where the records lie; for a remote file at least the first `limit`, -1 for all.

        Raises:
            SourceError: the file cannot be read, or is not of its format.
        """
        with self._lock:
            if self._frames is None:
                self._frames = _load_index(self._index)
                self._kept = len(self._frames)
            if not (self._frames.whole or 0 <= limit <= len(self._frames)):
                local = is_local(self._files)
                stop = -1 if local else limit
                self._frames = frames = self._scan(self._files, self._path, self._size, self._frames, stop)
                if len(frames) - self._kept >= KEPT_EVERY or (frames.whole and not local):
                    _save_index(self._index, frames)
                    self._kept = len(frames)
            return self._frames

    def read(self, index: int, where: str) -> bytes:
        """Return the data of a record, with its checksum verified; `where` is the episode, for the error.

        Raises:
            EpisodeError: there is no such record, or it is damaged.
            SourceError: the file cannot be read.
        """
        frames = self.framing(index + 1)
        if index >= len(frames):
            raise EpisodeError(where, f"{self._path}: {frames.fault or f'ends after {len(frames)} records'}")
        return self._pick(self._files, self._path, frames, index, where)


def is_array_record(path: str) -> bool:
    """Check for an ArrayRecord file by its name, such as toy-train.array_record-00000-of-00001."""
    return re.search(r"\.array_?record\b", path.rsplit("/", 1)[-1]) is not None


def open_records(files: Any, path: str) -> RecordFile:
    """Return the record file at a path.

    It is cached for the process: a local file while its size and date stay the same, a remote one for good.

    Raises:
        SourceError: it is not there, or the file system does not answer.
    """
    size, state = (_state if is_local(files) else _remote_state)(files, path)
    return _opened(files, path, size, state, os.getpid())


def _state(files: Any, path: str) -> tuple[int, str]:
    found = info(files, path)
    return found["size"], mark(found)


_remote_state = lru_cache(maxsize=4096)(_state)


@lru_cache(maxsize=4096)
def _opened(files: Any, path: str, size: int, state: str, pid: int) -> RecordFile:
    return RecordFile(files, path, size, state)


def _load_index(path: Path) -> Framing:
    """Return the index kept for a file; EMPTY where there is none, or it is damaged."""
    try:
        with np.load(path) as held:
            columns = held["offsets"], held["lengths"], held["checks"]
            return Framing(*columns, str(held["fault"]), bool(held["whole"]))
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        return EMPTY


def _save_index(path: Path, frames: Framing) -> None:
    """Write an index to disk; log a failure and continue without it."""
    try:
        with atomic_path(path) as part, part.open("wb") as file:
            np.savez(file, **vars(frames))
    except (OSError, OutputError) as fault:
        log.info("the index of records cannot be kept: %s", fault)


# -- TFRecord


def masked_crc(data: Any) -> int:
    """Return TFRecord's masked CRC-32C: rotated right by 15 bits, with a constant added."""
    crc = google_crc32c.value(data)
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def scan_tfrecord(files: Any, path: str, size: int, known: Framing = EMPTY, limit: int = -1) -> Framing:
    """Return the framing of a TFRecord file: begin where `known` ends, stop after `limit` records (-1: none).

    Raises:
        SourceError: the file cannot be read, or is compressed.
    """
    offsets, lengths, checks = known.offsets.tolist(), known.lengths.tolist(), known.checks.tolist()
    position, fault = offsets[-1] + lengths[-1] + FOOTER.size if offsets else 0, ""
    with _reader(files, path, size) as read:
        header = read(position, min(size, position + HEADER.size))
        if not position and header[:2] == b"\x1f\x8b":
            raise SourceError(path, "is gzip-compressed", "decompress it: gunzip")
        if not position and header == LFS[: HEADER.size]:
            raise SourceError(path, *unreadable(Path(path), "is a Git LFS pointer", "run git lfs pull"))
        while position < size and len(offsets) != limit:
            end, fault = _data_end(header, position, size)
            if fault:
                break
            tail = read(end, min(size, end + FOOTER.size + HEADER.size))
            offsets.append(position + HEADER.size)
            lengths.append(end - position - HEADER.size)
            checks.append(FOOTER.unpack_from(tail)[0])
            header, position = tail[FOOTER.size :], end + FOOTER.size
    columns = np.array(offsets, np.int64), np.array(lengths, np.int64), np.array(checks, np.uint32)
    return Framing(*columns, fault, bool(fault) or position >= size)


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


@contextmanager
def _reader(files: Any, path: str, size: int) -> Iterator[Read]:
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
    """A reader of a remote file that serves what it can from the last range it fetched."""

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


def read_tfrecord(files: Any, path: str, frames: Framing, index: int, where: str) -> bytes:
    """Return the data of one record of a TFRecord file; see `RecordFile.read`."""
    offset, length = int(frames.offsets[index]), int(frames.lengths[index])
    data = fetch(files, path, offset, offset + length)
    if masked_crc(data) != frames.checks[index]:
        raise EpisodeError(where, f"the {length} bytes at byte {offset} of {path} fail their checksum")
    return data


# -- ArrayRecord


def scan_array_record(files: Any, path: str, size: int, known: Framing = EMPTY, limit: int = -1) -> Framing:
    """Return the numbers, lengths and CRC-32C of an ArrayRecord file's records.

    Every record is read once; a damaged one gets length 0, and fails when it is read. Of the arguments, those
    of `scan_tfrecord`, only `path` is used.

    Raises:
        MissingDependencyError: the array_record package is not installed.
    """
    reader = _open_array_record(path)
    if not reader.ok():
        why = "is no ArrayRecord file"
        try:
            reader.read([0])  # its error says why
        except RuntimeError as error:
            why = str(error)
        fault, remedy = unreadable(Path(path), why, "")
        return replace(EMPTY, fault=f"{fault} — {remedy}" if remedy else fault, whole=True)
    count = reader.num_records()
    lengths, checks = np.zeros(count, np.int64), np.zeros(count, np.uint32)
    for index in range(count):
        try:
            [data] = reader.read([index])
        except RuntimeError:
            continue
        lengths[index], checks[index] = len(data), google_crc32c.value(data)
    return Framing(np.arange(count, dtype=np.int64), lengths, checks)


def read_array_record(files: Any, path: str, frames: Framing, index: int, where: str) -> bytes:
    """Return the data of one record of an ArrayRecord file; see `RecordFile.read`."""
    try:
        [data] = _open_array_record(path).read([index])
    except RuntimeError as fault:
        raise EpisodeError(where, f"cannot be read from {path}: {fault}") from fault
    if google_crc32c.value(data) != frames.checks[index]:
        raise EpisodeError(where, f"record {index} of {path} has changed since the file was indexed")
    return bytes(data)


def _open_array_record(path: str) -> Any:
    try:
        from array_record.python.array_record_module import ArrayRecordReader
    except ImportError as fault:
        said = "ArrayRecord files need the package array-record"
        raise MissingDependencyError(path, said, "uv sync --extra arrayrecord") from fault
    return ArrayRecordReader(path, RANDOM_ACCESS)
