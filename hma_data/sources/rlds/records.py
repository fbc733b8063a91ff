"""Find and read the records of TFRecord files, and the features of a record, a tf.train.Example.

A TFRecord is its length (uint64), the masked CRC-32C of those eight bytes, the data, and the masked CRC-32C
of the data; all little endian (format: TensorFlow's TFRecord). A scan reads only the length and the
checksums, 16 bytes a record. A remote file is read no further than the record that is asked for; the parts
of it that are expected are fetched ahead, by blocks.

An Example maps names to lists of bytes, float32 or int64. Parsing only finds where each list lies; byte
strings stay views into the record. So a feature that is not read costs nothing.
(Format: protobuf encoding; messages Example, Features, Feature of TensorFlow.)
"""

import os
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from threading import Lock
from typing import Any

import google_crc32c
import numpy as np
from numpy.typing import NDArray

from hma_data.errors import EpisodeError, SourceError
from hma_data.storage.blocks import Blocks
from hma_data.storage.fetch import attempt, fetch, info, is_local, mark
from hma_data.storage.kinds import LFS, unreadable

HEADER = struct.Struct("<QI")
FOOTER = struct.Struct("<I")
READ_AHEAD = 32 << 10  # bytes of one request, while records are shorter than that
VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
KINDS = {1: "bytes", 2: "float", 3: "int"}  # field numbers of Feature's lists
Span = tuple[int, int]
Read = Callable[[int, int], bytes]  # (start, end) -> the bytes between them


@dataclass(frozen=True)
class Framing:
    """The positions of the N records of a file."""

    offsets: NDArray[np.int64]  # first byte of each record's data
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
    """One TFRecord file of `size` bytes, on an fsspec file system."""

    def __init__(self, files: Any, path: str, size: int) -> None:
        self._files, self._path, self._size = files, path, size
        self._frames = EMPTY
        self._lock = Lock()
        self.blocks = None if is_local(files) else Blocks(partial(fetch, files, path), size)

    def framing(self, limit: int = -1) -> Framing:
        """Return where the records lie; for a remote file at least the first `limit`, -1 for all.

        Raises:
            SourceError: the file cannot be read, or is compressed.
        """
        with self._lock:
            if not (self._frames.whole or 0 <= limit <= len(self._frames)):
                self._frames = self._scanned(limit)
            return self._frames

    def _scanned(self, limit: int) -> Framing:
        stop = -1 if is_local(self._files) else limit
        with self._parts() as read:
            return scan_tfrecord(read, self._path, self._size, self._frames, stop)

    @contextmanager
    def _parts(self) -> Iterator[Read]:
        """Yield a function that reads parts: of a local file directly, of a remote one with read-ahead."""
        if not is_local(self._files):
            yield _Window(self._bytes, self._size)
            return
        handle = attempt(self._files, self._path, lambda: os.open(self._path, os.O_RDONLY))
        try:
            yield lambda start, end: os.pread(handle, end - start, start)
        finally:
            os.close(handle)

    def _bytes(self, start: int, end: int) -> bytes:
        if self.blocks and self.blocks.expects(start):
            return self.blocks.read(start, end)
        return fetch(self._files, self._path, start, end)

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

    def _picked(self, frames: Framing, index: int, where: str) -> bytes:
        offset, length = int(frames.offsets[index]), int(frames.lengths[index])
        data = self._bytes(offset, offset + length)
        if masked_crc(data) != frames.checks[index]:
            fault = f"the {length} bytes at byte {offset} of {self._path} fail their checksum"
            raise EpisodeError(where, fault)
        return data


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
    if ".array_record" in path.rsplit("/", 1)[-1]:
        from hma_data.sources.rlds.array_record import ArrayRecordFile

        return ArrayRecordFile(files, path, size)
    return RecordFile(files, path, size)


# -- TFRecord


def masked_crc(data: Any) -> int:
    """Return TFRecord's masked CRC-32C: rotated right by 15 bits, with a constant added."""
    crc = google_crc32c.value(data)
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def scan_tfrecord(read: Read, path: str, size: int, known: Framing = EMPTY, limit: int = -1) -> Framing:
    """Return the framing of a TFRecord file: begin where `known` ends, stop after `limit` records (-1: none).

    Raises:
        SourceError: the file cannot be read, or is compressed.
    """
    offsets, lengths, checks = known.offsets.tolist(), known.lengths.tolist(), known.checks.tolist()
    position, fault = offsets[-1] + lengths[-1] + FOOTER.size if offsets else 0, ""
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


# -- tf.train.Example


class Example:
    """The features of one record of the episode `where`.

    Raises:
        EpisodeError: (here and in every method) the bytes are not an Example, a feature is missing
            or of another kind.
    """

    def __init__(self, data: bytes, where: str) -> None:
        self._data, self._where = data, where
        try:
            self._lists = dict(_features(data))
        except ValueError as fault:
            raise EpisodeError(where, f"is not a tf.train.Example: {fault}") from fault

    def __contains__(self, name: str) -> bool:
        return name in self._lists

    @property
    def size(self) -> int:
        """Return the number of bytes of the record."""
        return len(self._data)

    def blobs(self, name: str) -> list[memoryview]:
        """Return the byte strings of a feature, as views into the record."""
        return self._items(name, "bytes")

    def numbers(self, name: str) -> NDArray[np.float32] | NDArray[np.int64]:
        """Return the (n,) numbers of a feature, float32 or int64 as stored."""
        if self._list(name)[0] == "float":
            return self._joined(name, "float", lambda data: data.view("<f4"))
        return self.ints(name)

    def ints(self, name: str) -> NDArray[np.int64]:
        """Return the (n,) integers of a feature."""
        return self._joined(name, "int", varints)

    def _joined(self, name: str, kind: str, parse: Callable[[NDArray[np.uint8]], NDArray]) -> NDArray:
        try:
            parts = [parse(np.frombuffer(item, np.uint8)) for item in self._items(name, kind)]
        except ValueError as fault:
            raise EpisodeError(self._where, f"{name}: {fault}") from fault
        return parts[0] if len(parts) == 1 else np.concatenate([parse(np.zeros(0, np.uint8)), *parts])

    def _list(self, name: str) -> tuple[str, Span]:
        if name not in self._lists:
            raise EpisodeError(self._where, f"has no feature {name!r}")
        return self._lists[name]

    def _items(self, name: str, kind: str) -> list[memoryview]:
        found, (start, stop) = self._list(name)
        if found not in (kind, "empty"):
            raise EpisodeError(self._where, f"{name} is a list of {found}, not of {kind}")
        view = memoryview(self._data)
        try:
            return [view[slice(*span)] for number, _, span in fields(self._data, start, stop) if number == 1]
        except ValueError as fault:
            raise EpisodeError(self._where, f"{name}: {fault}") from fault


def varints(data: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Decode packed varints to int64, without a loop over them.

    Raises:
        ValueError: the last is cut off, or one is longer than ten bytes.
    """
    last = np.flatnonzero(data < 0x80)
    if len(last) == len(data):
        return data.astype(np.int64)
    if not len(last) or last[-1] != len(data) - 1:
        raise ValueError("its last varint is cut off")
    first = np.concatenate([[0], last[:-1] + 1])
    lengths = last - first + 1
    if lengths.max() > 10:
        raise ValueError("a varint is longer than ten bytes")
    values = np.zeros(len(last), np.uint64)
    for place in range(int(lengths.max())):
        longer = np.flatnonzero(lengths > place)
        bits = (data[first[longer] + place] & 0x7F).astype(np.uint64)
        values[longer] |= bits << np.uint64(7 * place)
    return values.view(np.int64)


def _features(data: bytes) -> Iterator[tuple[str, tuple[str, Span]]]:
    """Yield (name, (kind, span of its list)) of each feature: the entries of Example.features.feature."""
    for number, wire, (start, stop) in fields(data, 0, len(data)):
        if number != 1 or wire != BYTES:
            continue
        for entry, entry_wire, span in fields(data, start, stop):
            if entry == 1 and entry_wire == BYTES:
                yield _entry(data, *span)


def _entry(data: bytes, start: int, stop: int) -> tuple[str, tuple[str, Span]]:
    """Parse a map entry: key 1, value 2."""
    name, value = "", ("empty", (start, start))
    for number, wire, span in fields(data, start, stop):
        if wire == BYTES and number == 1:
            name = data[slice(*span)].decode()
        elif wire == BYTES and number == 2:
            for kind, kind_wire, inner in fields(data, *span):
                if kind in KINDS and kind_wire == BYTES:
                    value = (KINDS[kind], inner)
    return name, value


def fields(data: bytes, position: int, end: int) -> Iterator[tuple[int, int, Span]]:
    """Yield (field number, wire type, span of its payload) of each field of a message.

    Raises:
        ValueError: it is no message.
    """
    while position < end:
        tag, position = varint(data, position, end)
        wire, start = tag & 7, position
        if wire == BYTES:
            length, start = varint(data, position, end)
            position = start + length
        elif wire == VARINT:
            position = varint(data, position, end)[1]
        elif wire in (FIXED32, FIXED64):
            position += 4 if wire == FIXED32 else 8
        else:
            raise ValueError(f"wire type {wire} at byte {start}")
        if position > end:
            raise ValueError(f"the field at byte {start} reaches beyond its message")
        yield tag >> 3, wire, (start, position)


def varint(data: bytes, position: int, end: int) -> tuple[int, int]:
    """Return (value, position after it).

    Raises:
        ValueError: it is cut off, or longer than ten bytes.
    """
    value = shift = 0
    while position < end and shift < 70:
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
        shift += 7
    raise ValueError(f"no varint at byte {position}")
