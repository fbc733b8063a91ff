"""Define what the three kinds of bag file share: the contract, records, the index by time, chunks.

A container is one file. It yields the messages of wanted topics in the file's order. Where it has an index,
it counts the messages without reading them. It finds a message again by its place, so for images only
places are kept in memory. No container holds an open file between calls.

A piece is a run of a file's records: one chunk, or messages outside of chunks. Its channels and its times of
receipt are known, so a time range is read without the rest. A file has some thousands of pieces.
"""

import bz2
import logging
import sqlite3
import struct
from abc import ABC, abstractmethod
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

import zstandard
from mcap.exceptions import McapError

from hma_data.errors import EpisodeError
from hma_data.storage.blocks import BlockFile, expect
from hma_data.storage.kinds import one_line, unreadable
from hma_data.storage.remote import LargeFile, is_remote

CACHED_BYTES = 64 << 20  # of unpacked chunks that a bag keeps
MAX_CHUNK = 512 << 20  # most bytes of an unpacked chunk, against decompression bombs and errors
FOREVER = 2**64
KEPT_FROM = 2048  # bytes of a message of a remote file that is kept in memory for `payloads`
FAULTS = (
    struct.error, ValueError, LookupError, OverflowError, RecursionError, EOFError, OSError, RuntimeError,
    MemoryError, sqlite3.Error, McapError, zstandard.ZstdError,
)  # fmt: skip

log = logging.getLogger(__name__)
Data = bytes | memoryview
FilePlace = tuple[int, int]


@dataclass(frozen=True)
class Channel:
    """A topic as one writer declared it.

    Attributes:
        type: of its messages, "sensor_msgs/msg/JointState" or as the schema names it.
        encoding: of its messages: ros1, cdr, json, protobuf, or another that the file states.
        schema_encoding: ros1msg, ros2msg, ros2idl, jsonschema, protobuf; empty without a schema.
        schema: the definition in the file.
    """

    topic: str
    type: str
    encoding: str
    schema_encoding: str = ""
    schema: bytes = field(default=b"", repr=False)


class Record(NamedTuple):
    """A stored message: `log_ns` is its time of receipt, `place` is where `payloads` finds it again."""

    channel: Channel
    log_ns: int
    data: Data
    place: FilePlace


@dataclass(frozen=True)
class RecordFilter:
    """The messages that a container is asked for.

    Attributes:
        topics: None for all.
        first_ns, last_ns: range of the time of receipt, both ends included.
        again: whether `payloads` of these messages will be asked for.
    """

    topics: frozenset[str] | None = None
    first_ns: int = 0
    last_ns: int = FOREVER
    again: bool = False

    def topic(self, name: str) -> bool:
        """Check whether messages of that topic are asked for."""
        return self.topics is None or name in self.topics

    def time(self, log_ns: int) -> bool:
        """Check whether a message received at that time is asked for."""
        return self.first_ns <= log_ns <= self.last_ns


ALL = RecordFilter()


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Raise any error inside as damage of that file."""
    try:
        yield
    except FAULTS as fault:
        raise damaged(path, f"is damaged or cut off: {one_line(fault)}") from fault


def damaged(path: Path, fault: str) -> EpisodeError:
    """Return the error of a file that cannot be read to its end."""
    remedy = "copy it again, or repair it (rosbag reindex, ros2 bag reindex, mcap recover)"
    return EpisodeError(path, *unreadable(path, fault, remedy))


def without_index(path: Path, file: BinaryIO, size: int) -> None:
    """State that a file will be read to its end because it has no index."""
    expect(file, [(0, size)])
    if is_remote(path):
        log.warning(
            "%s: has no index, so all of its %s bytes are read to find its messages — "
            "write one (mcap recover, rosbag reindex), or copy the file here",
            path,
            f"{size:,}",
        )


class Piece(NamedTuple):
    """The records from offset `at` to `end`: one chunk, or messages outside of chunks.

    Attributes:
        first_ns, last_ns: earliest and latest receipt of its messages.
        channels: the numbers of the channels of its messages.
    """

    at: int
    end: int
    first_ns: int = FOREVER
    last_ns: int = -1
    channels: frozenset[int] = frozenset()

    def including(self, message: "StoredMessage") -> "Piece":
        """Return the piece with the time and channel of one message more."""
        return self._replace(
            first_ns=min(self.first_ns, message.log_ns),
            last_ns=max(self.last_ns, message.log_ns),
            channels=self.channels | {message.number},
        )


class StoredMessage(NamedTuple):
    """A message among the records of a piece: it lies at `at`, its data from `start` to `end`."""

    number: int  # of its channel
    log_ns: int
    at: int
    start: int
    end: int


@dataclass
class FileIndex:
    """The channels of a file by number, its pieces in their order, and what else a walk over it shows.

    Attributes:
        counts: messages by channel number; None where the file does not state them.
        notes: entries of MCAP's metadata records.
    """

    channels: dict[int, Channel] = field(default_factory=dict)
    pieces: list[Piece] = field(default_factory=list)
    counts: Counter[int] | None = None
    notes: dict[str, str] = field(default_factory=dict)

    def channel(self, number: int) -> Channel:
        """Return the channel of that number.

        Raises:
            ValueError: the file does not declare it.
        """
        if number not in self.channels:
            raise ValueError(f"a message is on channel {number}, which is not declared")
        return self.channels[number]

    def holds(self, piece: Piece, topics: frozenset[str] | None) -> bool:
        """Check whether a piece holds a message of those topics."""
        return topics is None or any(self.channel(number).topic in topics for number in piece.channels)


class IndexedFile(ABC):
    """A bag file that is read piece by piece; its unpacked chunks are kept in `chunks`.

    Every method of a container raises EpisodeError when the file is damaged.
    """

    def __init__(self, path: Path, chunks: "Chunks") -> None:
        self.path, self._chunks = path, chunks
        self._file = LargeFile(path)
        self._indexed: FileIndex | None = None

    def counts(self) -> Counter[Channel]:
        """Count the messages of each channel, from the index if there is one; also of empty channels."""
        with self._opened() as (_, index):
            channels, counts = index.channels, index.counts
        if counts is None or not counts.keys() <= channels.keys():
            return Counter(record.channel for record in self.records(ALL))
        total: Counter[Channel] = Counter()
        for number, channel in channels.items():
            total[channel] += counts[number]
        return total

    def records(self, wanted: RecordFilter) -> Iterator[Record]:
        """Yield the wanted messages, in the file's order; pieces without one are not read."""
        with self._opened() as (file, index):
            pieces = [
                piece
                for piece in index.pieces
                if piece.first_ns <= wanted.last_ns
                and piece.last_ns >= wanted.first_ns
                and index.holds(piece, wanted.topics)
            ]
            expect(file, ((piece.at, piece.end) for piece in pieces))
            for piece in pieces:
                for record in self._in_piece(file, index, piece, wanted):
                    # Images of a remote file are not fetched again.
                    if wanted.again and isinstance(file, BlockFile) and len(record.data) >= KEPT_FROM:
                        file.blocks.keep(record.place, bytes(record.data))
                    yield record

    def span(self) -> tuple[int, int]:
        """Return the earliest and latest time of receipt; (FOREVER, -1) without messages."""
        with self._opened() as (_, index):
            pieces = index.pieces
        first_ns = min((piece.first_ns for piece in pieces), default=FOREVER)
        return first_ns, max((piece.last_ns for piece in pieces), default=-1)

    def before(self, topics: frozenset[str], log_ns: int) -> dict[str, Record]:
        """Return each topic's last message before a time; topics without one are left out."""
        found: dict[str, Record] = {}
        with self._opened() as (file, index):
            earlier = (piece for piece in index.pieces if piece.first_ns < log_ns)
            for piece in sorted(earlier, key=lambda piece: piece.last_ns, reverse=True):
                newest = min(piece.last_ns, log_ns - 1)
                missing = frozenset(t for t in topics if t not in found or found[t].log_ns < newest)
                if not missing:
                    break
                if index.holds(piece, missing):
                    wanted = RecordFilter(missing, last_ns=log_ns - 1)
                    take_last(found, self._in_piece(file, index, piece, wanted))
        return found

    def payloads(self, places: Sequence[FilePlace]) -> Iterator[Data]:
        """Yield the data of the messages at those places."""
        with self._opened() as (file, index):
            last = -1
            for offset, at in places:
                kept = file.blocks.take((offset, at)) if isinstance(file, BlockFile) else None
                if kept is not None:
                    yield kept
                    continue
                if offset != last:
                    last, view = offset, self._view(file, offset)
                message = next(self._messages(index, view, at))
                yield view[message.start : message.end]

    @contextmanager
    def _opened(self) -> Iterator[tuple[BinaryIO, FileIndex]]:
        with reading(self.path), self._file.open() as file:
            if self._indexed is None:
                self._indexed = self._make_index(file)
            yield file, self._indexed

    def _in_piece(
        self, file: BinaryIO, index: FileIndex, piece: Piece, wanted: RecordFilter
    ) -> Iterator[Record]:
        view = self._view(file, piece.at, piece.end)
        for number, log_ns, at, start, end in self._messages(index, view):
            channel = index.channel(number)
            if wanted.topic(channel.topic) and wanted.time(log_ns):
                yield Record(channel, log_ns, view[start:end], (piece.at, at))

    def _look_into(self, file: BinaryIO, index: FileIndex, at: int, end: int) -> Counter[int]:
        """Add a piece that no index describes, by reading it; return its messages by channel."""
        counts: Counter[int] = Counter()
        piece = Piece(at, end)
        for message in self._messages(index, self._view(file, at, end)):
            counts[message.number] += 1
            piece = piece.including(message)
        index.pieces.append(piece)
        return counts

    @abstractmethod
    def _make_index(self, file: BinaryIO) -> FileIndex:
        """Return the pieces of the file, and its channels."""

    @abstractmethod
    def _view(self, file: BinaryIO, at: int, end: int | None = None) -> "View":
        """Return the records of the piece at an offset: unpacked, or read lazily outside of chunks."""

    @abstractmethod
    def _messages(self, index: FileIndex, view: "View", at: int = 0) -> Iterator[StoredMessage]:
        """Yield the messages of a piece from an offset on; add the channels met to the index."""


def take_last(found: dict[str, Record], records: Iterable[Record]) -> None:
    """Put the last message of each topic into `found`, with a copy of its bytes."""
    newest: dict[str, Record] = {}
    for record in records:
        topic = record.channel.topic
        if topic not in newest or newest[topic].log_ns <= record.log_ns:
            newest[topic] = record
    for topic, record in newest.items():
        if topic not in found or found[topic].log_ns <= record.log_ns:
            found[topic] = record._replace(data=bytes(record.data))


class Recent[K, V]:
    """The values used last, as many as `most` allows of their sizes, and always at least one."""

    def __init__(self, most: int, size: Callable[[V], int] = lambda value: 1) -> None:
        self._values: OrderedDict[K, V] = OrderedDict()
        self._room, self._size = most, size

    def get(self, key: K, make: Callable[[], V]) -> V:
        """Return the value of a key; it is made where it is not kept."""
        if key not in self._values:
            self._values[key] = made = make()
            self._room -= self._size(made)
        self._values.move_to_end(key)
        while self._room < 0 and len(self._values) > 1:
            self._room += self._size(self._values.popitem(last=False)[1])
        return self._values[key]


Chunks = Recent[tuple[Path, int], bytes]  # unpacked chunks, by their offsets in the files of a bag


def kept_chunks() -> Chunks:
    """Return what keeps the chunks of one bag that were unpacked last."""
    return Recent(CACHED_BYTES, len)


def decompress(codec: str, data: bytes, size: int) -> bytes:
    """Return the `size` bytes of an unpacked chunk.

    Raises:
        ValueError: the codec is unknown, the size is another, or it exceeds MAX_CHUNK bytes.
    """
    if size > MAX_CHUNK:
        raise ValueError(f"a chunk claims {size:,} bytes, more than {MAX_CHUNK:,}")
    if codec in ("", "none"):
        unpacked = data
    elif codec == "zstd":
        unpacked = unzstd(data, size)
    elif codec == "bz2":
        unpacked = bz2.BZ2Decompressor().decompress(data, size + 1)
    elif codec == "lz4":
        from lz4.frame import LZ4FrameDecompressor

        unpacked = LZ4FrameDecompressor().decompress(data, size + 1)
    else:
        raise ValueError(f"chunks packed with {codec!r} cannot be read; none, bz2, lz4 and zstd can")
    if len(unpacked) != size:
        raise ValueError(f"a chunk unpacks to {len(unpacked):,} bytes where {size:,} are announced")
    return unpacked


def unzstd(data: Data, limit: int) -> bytes:
    """Unpack zstd data; return at most `limit` + 1 bytes.

    Raises:
        zstandard.ZstdError: the data is not zstd.
    """
    if zstandard.get_frame_parameters(data).content_size == limit:
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=limit)
    with zstandard.ZstdDecompressor().stream_reader(bytes(data)) as stream:
        unpacked: bytes = stream.read(limit + 1)
    return unpacked


class FileView:
    """A part of a file whose slices are read when they are taken, like a memoryview of its bytes."""

    def __init__(self, file: BinaryIO, begin: int, end: int) -> None:
        self._file, self._begin, self._size = file, begin, end - begin

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, part: slice) -> bytes:
        self._file.seek(self._begin + part.start)
        return read_exact(self._file, part.stop - part.start)


View = memoryview | FileView


def read_exact(file: BinaryIO, size: int) -> bytes:
    """Read exactly `size` bytes.

    Raises:
        EOFError: the file ends before that.
        ValueError: `size` is more than MAX_CHUNK.
    """
    if size > MAX_CHUNK:
        raise ValueError(f"a record claims {size:,} bytes, more than {MAX_CHUNK:,}")
    data = file.read(size)
    if len(data) != size:
        raise EOFError(f"the file ends {size - len(data):,} bytes before a record does")
    return data
