"""Define what the three kinds of bag file share: the contract, records, chunks, binary fields.

A container is one file. It yields the messages of wanted topics in the file's order, tells how
many there are without reading them where it has an index, and finds a message again by its
place, so that nothing but places needs to be kept of pictures. No container holds an open file
between calls.
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
MAX_CHUNK = 512 << 20  # bytes; a chunk that unpacks to more is a bomb or an error
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
    """Describe a topic as one writer declared it.

    Attributes:
        type: of its messages, "sensor_msgs/msg/JointState" or as the schema names it.
        encoding: of its messages: ros1, cdr, json, protobuf, or what the file says.
        schema_encoding: ros1msg, ros2msg, ros2idl, jsonschema, protobuf; empty without a schema.
        schema: the definition carried by the file.
    """

    topic: str
    type: str
    encoding: str
    schema_encoding: str = ""
    schema: bytes = field(default=b"", repr=False)


class Record(NamedTuple):
    """Hold a message as stored: `log_ns` is when it was received, `place` where `payloads` finds it again."""

    channel: Channel
    log_ns: int
    data: Data
    place: Place


@dataclass(frozen=True)
class Wanted:
    """Say which messages are asked of a container.

    Attributes:
        topics: None for all.
        first_ns, last_ns: received from the one to the other, both included.
        heads: topics of whose messages the first HEAD bytes will do; more may come.
    """

    topics: frozenset[str] | None = None
    first_ns: int = 0
    last_ns: int = FOREVER
    heads: frozenset[str] = frozenset()

    @property
    def bounded(self) -> bool:
        """Check whether a part of the recording's time is asked for."""
        return self.first_ns > 0 or self.last_ns < FOREVER

    def topic(self, name: str) -> bool:
        """Check whether messages of that topic are asked for."""
        return self.topics is None or name in self.topics

    def time(self, log_ns: int) -> bool:
        """Check whether a message received then is asked for."""
        return self.first_ns <= log_ns <= self.last_ns


class Container(Protocol):
    """Read one file of a bag. Every method raises EpisodeError when the file is damaged."""

    path: Path

    def counts(self) -> Counter[Channel]:
        """Count the messages of each channel, from the index where there is one; also those without any."""
        ...

    def records(self, wanted: Wanted) -> Iterator[Record]:
        """Yield those messages, in the file's order."""
        ...

    def before(self, topics: frozenset[str], log_ns: int) -> dict[str, Record]:
        """Return each topic's last message before that time; topics without one are left out."""
        ...

    def payloads(self, places: Sequence[Place]) -> Iterator[Data]:
        """Yield the data of the messages at those places."""
        ...


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Tell whatever goes wrong inside as damage of that file."""
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
    """Keep the chunks of one bag that were unpacked last: at most CACHED_BYTES of them, and always one."""

    def __init__(self) -> None:
        self._chunks: OrderedDict[tuple[Path, int], bytes] = OrderedDict()
        self._bytes = 0

    def get(self, path: Path, offset: int, load: Callable[[], bytes]) -> memoryview:
        """Return the chunk at that offset of that file; `load` unpacks it where it is not kept."""
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
    """Return the `size` bytes that a chunk unpacks to.

    Raises:
        ValueError: another codec or size, or more than MAX_CHUNK bytes.
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
    """Return up to `limit` + 1 unpacked bytes.

    Raises:
        ValueError: not zstd.
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
    """Read little-endian fields off bytes; ValueError where they end too soon."""

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
        """Take the bytes after their 32-bit length."""
        return self.take(self.number(4))

    def text(self) -> str:
        """Read UTF-8 after its 32-bit length."""
        return str(self.block(), "utf-8")

    def __bool__(self) -> bool:
        return self._at < len(self._data)


def read_exact(file: BinaryIO, size: int) -> bytes:
    """Read that many bytes.

    Raises:
        EOFError: the file ends before.
    """
    if size > MAX_CHUNK:
        raise ValueError(f"a record claims {size:,} bytes, more than {MAX_CHUNK:,}")
    data = file.read(size)
    if len(data) != size:
        raise EOFError(f"the file ends {size - len(data):,} bytes before a record does")
    return data
