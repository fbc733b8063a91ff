"""What the three kinds of bag file have in common.

A container is one file. It yields the messages of wanted topics in the file's order, tells how
many there are without reading them where it has an index, and finds a message again by its
place, so that nothing but places needs to be kept of pictures. No container holds an open file
between calls.
"""

import bz2
import sqlite3
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple, Protocol

from hma_data.errors import EpisodeError

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
    """A topic as one writer declared it.

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
    """A message as stored: `log_ns` is when it was received, `place` where `payloads` finds it again."""

    channel: Channel
    log_ns: int
    data: Data
    place: Place


@dataclass(frozen=True)
class Wanted:
    """Which messages are asked of a container.

    Attributes:
        topics: None for all.
        first_ns, last_ns: received from the one to the other, both included.
        heads: topics of whose messages the first HEAD bytes will do; more may come.
        checked: whether a checksum must be looked at also where no head is met, whose message is read later.
    """

    topics: frozenset[str] | None = None
    first_ns: int = 0
    last_ns: int = FOREVER
    heads: frozenset[str] = frozenset()
    checked: bool = True

    @property
    def bounded(self) -> bool:
        """Whether a part of the recording's time is asked for."""
        return self.first_ns > 0 or self.last_ns < FOREVER

    def topic(self, name: str) -> bool:
        """Whether messages of that topic are asked for."""
        return self.topics is None or name in self.topics

    def time(self, log_ns: int) -> bool:
        """Whether a message received then is asked for."""
        return self.first_ns <= log_ns <= self.last_ns


class Container(Protocol):
    """One file of a bag. Every method raises EpisodeError when the file is damaged."""

    path: Path

    def counts(self) -> Counter[Channel]:
        """Messages of each channel, from the index where there is one; channels without any included."""
        ...

    def records(self, wanted: Wanted) -> Iterator[Record]:
        """Those messages, in the file's order."""
        ...

    def before(self, topics: frozenset[str], log_ns: int) -> dict[str, Record]:
        """Of each topic the last message received before that time; topics without one are left out."""
        ...

    def payloads(self, places: Sequence[Place]) -> Iterator[Data]:
        """The data of the messages at those places; each is there until the next is asked for."""
        ...


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Whatever goes wrong inside is told as damage of that file."""
    try:
        yield
    except FAULTS as fault:
        detail = " ".join(str(fault).split())[:200] or type(fault).__name__
        raise damaged(path, f"is damaged or cut off: {detail}") from fault


def damaged(path: Path, fault: str) -> EpisodeError:
    """The error of a file that cannot be read to its end."""
    return EpisodeError(
        path, fault, "copy it again, or repair it (rosbag reindex, ros2 bag reindex, mcap recover)"
    )


def decompress(codec: str, data: Data, into: memoryview) -> None:
    """Fills `into` with what was packed.

    Raises:
        ValueError: another codec, or another size.
    """
    if codec in ("", "none"):
        unpacked: Data = data
    elif codec == "zstd":
        _unzstd_into(data, into)
        return
    else:
        unpacked = _unpacked(codec, data, len(into) + 1)
    if len(unpacked) != len(into):
        raise ValueError(f"a chunk unpacks to {len(unpacked):,} bytes where {len(into):,} are announced")
    into[:] = unpacked


def decompress_begin(codec: str, data: Data, into: memoryview) -> None:
    """Fills `into` with the first bytes of what was packed; the rest is not looked at.

    Raises:
        ValueError: another codec, or fewer bytes.
    """
    if codec == "zstd":
        _unzstd_into(data, into, whole=False)
        return
    unpacked = data[: len(into)] if codec in ("", "none") else _unpacked(codec, data, len(into))
    if len(unpacked) != len(into):
        raise ValueError(f"a chunk unpacks to {len(unpacked):,} bytes, fewer than its index says")
    into[:] = unpacked


def _unpacked(codec: str, data: Data, limit: int) -> bytes:
    """Up to `limit` bytes of what was packed by bz2 or lz4."""
    if codec == "bz2":
        return bz2.BZ2Decompressor().decompress(data, limit)
    if codec == "lz4":
        from lz4.frame import LZ4FrameDecompressor

        unpacked: bytes = LZ4FrameDecompressor().decompress(data, limit)
        return unpacked
    raise ValueError(f"chunks packed with {codec!r} cannot be read; none, bz2, lz4 and zstd can")


def _unzstd_into(data: Data, into: memoryview, whole: bool = True) -> None:
    """Fills `into`; `whole`: there must be no more than that, and its checksum is looked at."""
    import zstandard

    filled = more = 0
    try:
        with zstandard.ZstdDecompressor().stream_reader(data) as stream:
            while filled < len(into) and (got := stream.readinto(into[filled:])):
                filled += got
            more = len(stream.read(1)) if whole else 0
    except zstandard.ZstdError as fault:
        raise ValueError(str(fault)) from fault
    if filled != len(into) or more:
        raise ValueError(f"a chunk unpacks to {filled + more:,} bytes where {len(into):,} are announced")


def checked_size(size: int) -> int:
    """That size of a chunk.

    Raises:
        ValueError: it is more than MAX_CHUNK.
    """
    if size > MAX_CHUNK:
        raise ValueError(f"a chunk claims {size:,} bytes, more than {MAX_CHUNK:,}")
    return size


def unzstd(data: Data, limit: int) -> bytes:
    """Up to `limit` + 1 unpacked bytes.

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
    """Reads little-endian fields off bytes; ValueError where they end too soon."""

    def __init__(self, data: Data) -> None:
        self._data = memoryview(data)
        self._at = 0

    def take(self, size: int) -> memoryview:
        """The next `size` bytes."""
        if self._at + size > len(self._data):
            raise ValueError("a record ends too soon")
        self._at += size
        return self._data[self._at - size : self._at]

    def number(self, size: int) -> int:
        """An unsigned number of `size` bytes."""
        return int.from_bytes(self.take(size), "little")

    def block(self) -> memoryview:
        """Bytes after their 32-bit length."""
        return self.take(self.number(4))

    def text(self) -> str:
        """UTF-8 after its 32-bit length."""
        return str(self.block(), "utf-8")

    def __bool__(self) -> bool:
        return self._at < len(self._data)


def read_exact(file: BinaryIO, size: int) -> bytes:
    """That many bytes.

    Raises:
        EOFError: the file ends before.
    """
    if size > MAX_CHUNK:
        raise ValueError(f"a record claims {size:,} bytes, more than {MAX_CHUNK:,}")
    data = file.read(size)
    if len(data) != size:
        raise EOFError(f"the file ends {size - len(data):,} bytes before a record does")
    return data
