"""Define what the three kinds of bag file share: the contract, records, chunks, binary fields.

A container is one file. It yields the messages of wanted topics in the file's order. Where it has an index,
it counts the messages without reading them. It finds a message again by its place, so for pictures only
places are kept in memory. No container holds an open file between calls.
"""

import bz2
import sqlite3
import struct
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple, Protocol

from hma_data.errors import EpisodeError

CACHED_BYTES = 64 << 20  # of unpacked chunks that a bag keeps
MAX_CHUNK = 512 << 20  # most bytes of an unpacked chunk, against decompression bombs and errors
FOREVER = 2**64
HEAD = 64  # bytes: the stamp of a message is within them
FAULTS = (
    struct.error, ValueError, LookupError, OverflowError, RecursionError, EOFError, OSError, RuntimeError,
    MemoryError, sqlite3.Error,
)  # fmt: skip

Data = bytes | memoryview
Place = tuple[int, int]


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
    place: Place


@dataclass(frozen=True)
class Wanted:
    """The messages that a container is asked for.

    Attributes:
        topics: None for all.
        first_ns, last_ns: range of the time of receipt, both ends included.
        heads: topics for which the first HEAD bytes of a message are enough; more may be returned.
    """

    topics: frozenset[str] | None = None
    first_ns: int = 0
    last_ns: int = FOREVER
    heads: frozenset[str] = frozenset()

    @property
    def bounded(self) -> bool:
        """Check whether only a part of the recording's time is asked for."""
        return self.first_ns > 0 or self.last_ns < FOREVER

    def topic(self, name: str) -> bool:
        """Check whether messages of that topic are asked for."""
        return self.topics is None or name in self.topics

    def time(self, log_ns: int) -> bool:
        """Check whether a message received at that time is asked for."""
        return self.first_ns <= log_ns <= self.last_ns


class Container(Protocol):
    """One file of a bag. Every method raises EpisodeError when the file is damaged."""

    path: Path

    def counts(self) -> Counter[Channel]:
        """Count the messages of each channel, from the index if there is one; also of empty channels."""
        ...

    def records(self, wanted: Wanted) -> Iterator[Record]:
        """Yield the wanted messages, in the file's order."""
        ...

    def before(self, topics: frozenset[str], log_ns: int) -> dict[str, Record]:
        """Return each topic's last message before a time; topics without one are left out."""
        ...

    def payloads(self, places: Sequence[Place]) -> Iterator[Data]:
        """Yield the data of the messages at those places."""
        ...


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Raise any error inside as damage of that file."""
    try:
        yield
    except FAULTS as fault:
        detail = " ".join(str(fault).split())[:200] or type(fault).__name__
        raise damaged(path, f"is damaged or cut off: {detail}") from fault


def damaged(path: Path, fault: str) -> EpisodeError:
    """Return the error of a file that cannot be read to its end."""
    return EpisodeError(
        path, fault, "copy it again, or repair it (rosbag reindex, ros2 bag reindex, mcap recover)"
    )


class ChunkCache:
    """Keep the last unpacked chunks of one bag: at most CACHED_BYTES of them, and always at least one."""

    def __init__(self) -> None:
        self._chunks: OrderedDict[tuple[Path, int], bytes] = OrderedDict()
        self._bytes = 0

    def get(self, path: Path, offset: int, load: Callable[[], bytes]) -> memoryview:
        """Return the chunk at an offset of a file; `load` unpacks it where it is not cached."""
        key = (path, offset)
        if key in self._chunks:
            self._chunks.move_to_end(key)
            return memoryview(self._chunks[key])
        chunk = self._chunks[key] = load()
        self._bytes += len(chunk)
        while self._bytes > CACHED_BYTES and len(self._chunks) > 1:
            self._bytes -= len(self._chunks.popitem(last=False)[1])
        return memoryview(chunk)


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
        ValueError: the data is not zstd.
    """
    import zstandard

    try:
        if zstandard.get_frame_parameters(data).content_size == limit:
            return zstandard.ZstdDecompressor().decompress(data, max_output_size=limit)
        with zstandard.ZstdDecompressor().stream_reader(bytes(data)) as stream:
            unpacked: bytes = stream.read(limit + 1)
    except zstandard.ZstdError as fault:
        raise ValueError(str(fault)) from fault
    return unpacked


class Fields:
    """Read little-endian fields from bytes; raise ValueError where the bytes end too soon."""

    def __init__(self, data: Data) -> None:
        self._data = memoryview(data)
        self._at = 0

    def take(self, size: int) -> memoryview:
        """Take the next `size` bytes."""
        if self._at + size > len(self._data):
            raise ValueError("a record ends too soon")
        self._at += size
        return self._data[self._at - size : self._at]

    def number(self, size: int) -> int:
        """Read an unsigned number of `size` bytes."""
        return int.from_bytes(self.take(size), "little")

    def block(self) -> memoryview:
        """Take the bytes that follow their 32-bit length."""
        return self.take(self.number(4))

    def text(self) -> str:
        """Read UTF-8 text that follows its 32-bit length."""
        return str(self.block(), "utf-8")

    def __bool__(self) -> bool:
        return self._at < len(self._data)


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
