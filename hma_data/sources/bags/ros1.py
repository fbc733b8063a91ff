"""ROS 1 bags, format 2.0, as https://wiki.ros.org/Bags/Format/2.0 lays them out.

Indexed or not (a recorder that was killed leaves no index), chunks plain, bz2 or lz4.
"""

import struct
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hma_data.sources.bags.chunks import WORTH, Buffer, ChunkCache, Take, placed, reach
from hma_data.sources.bags.container import (
    FOREVER,
    HEAD,
    Channel,
    Data,
    Fields,
    Place,
    Record,
    Wanted,
    checked_size,
    damaged,
    decompress,
    decompress_begin,
    read_exact,
    reading,
)
from hma_data.sources.bags.pieces import Piece, last_before, overlapping

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07
HEADER_BYTES = 1 << 16  # a record's header is no longer
MESSAGE_BYTES = 128  # before the data of a message: its header has three short fields
SAMPLE_BYTES = 12  # an entry of an index record: time, offset
TIME = struct.Struct("<II")
Header = dict[str, memoryview]


class Ros1File:
    """One ROS 1 bag; see Container.

    Args:
        chunks: where unpacked chunks are kept; shared by the files of a bag.
    """

    def __init__(self, path: Path, chunks: ChunkCache | None = None) -> None:
        self.path = path
        self._chunks = chunks or ChunkCache()
        self._surveyed: _Index | None = None

    def counts(self) -> Counter[Channel]:
        """See Container."""
        with reading(self.path), self.path.open("rb") as file:
            index = self._index(file)
            if index:
                return index.counts()
        return Counter(record.channel for record in self.records(Wanted()))

    def records(self, wanted: Wanted) -> Iterator[Record]:
        """See Container; chunks without a wanted message are not unpacked where an index says so."""
        with reading(self.path), self.path.open("rb") as file:
            index = self._survey(file) if wanted.bounded else self._index(file)
            channels = index.channels if index else {}
            found = (piece.at for piece in overlapping(index.pieces(), wanted)) if index else None
            for at in found or _scan(file, channels):
                yield from _in_chunk(file, at, channels, wanted, self._asked)

    def before(self, topics: frozenset[str], log_ns: int) -> dict[str, Record]:
        """See Container."""
        with reading(self.path), self.path.open("rb") as file:
            index = self._survey(file)
            return last_before(
                index.pieces(),
                topics,
                log_ns,
                lambda piece, wanted: _in_chunk(file, piece.at, index.channels, wanted, self._asked),
            )

    def payloads(self, places: Sequence[Place]) -> Iterator[Data]:
        """See Container."""
        with reading(self.path), self.path.open("rb") as file:
            buffer, heads = Buffer(), dict[int, _ChunkHead]()
            for offset, at in places:
                if offset not in heads:
                    heads = {offset: _chunk_head(file, offset)}
                if heads[offset].plain:
                    yield _content(file, heads[offset], at, buffer)
                else:
                    yield _split(self._chunk(file, heads[offset]), at)[1]

    def _chunk(self, file: BinaryIO, head: "_ChunkHead") -> memoryview:
        return self._chunks.get(self.path, head.offset, partial(_load_chunk, file, head))

    def _asked(
        self, file: BinaryIO, head: "_ChunkHead", channels: dict[int, Channel], wanted: Wanted
    ) -> memoryview:
        """A chunk unpacked, or where there is no room to keep it what is wanted of it."""
        kept = self._chunks.has(self.path, head.offset) or self._chunks.room(head.size)
        if wanted.heads and not kept:
            found = _entries(file, head, channels)
            size = reach(found, wanted, head.size, MESSAGE_BYTES) if found else head.size
            if found and size < WORTH * head.size:
                begin = _load_begin(file, head, size, self._chunks.scratch)
                placed(found, begin, b"op=" + bytes([MESSAGE]), MESSAGE_BYTES)
                return begin
        return self._chunk(file, head)

    def _survey(self, file: BinaryIO) -> "_Index":
        """The index, made from the chunks where the recorder left none."""
        if self._surveyed is None:
            self._surveyed = self._index(file) or _made_index(file)
        return self._surveyed

    def _index(self, file: BinaryIO) -> "_Index | None":
        """The index at the file's end; None where the recorder left none."""
        magic = file.read(len(MAGIC))
        if magic != MAGIC:
            shown = magic.split(b"\n")[0].decode("ascii", "replace")
            raise damaged(self.path, f"begins with {shown!r}, not as a ROS 1 bag" if magic else "is empty")
        header, _, _ = _record(file, len(MAGIC))
        if _number(header, "op") != BAG:
            raise ValueError("the bag's header is missing")
        if bytes(header.get("encryptor", b"")):
            raise ValueError("it is encrypted")
        at = _number(header, "index_pos")
        return (
            _read_index(file, at, _number(header, "conn_count"), _number(header, "chunk_count"))
            if at
            else None
        )


class _ChunkHead(NamedTuple):
    """A chunk at `offset`: its content lies at `at`, `packed` bytes that unpack to `size`."""

    offset: int
    codec: str
    at: int
    packed: int
    size: int

    @property
    def plain(self) -> bool:
        """Whether its records lie in the file as they are."""
        return self.codec == "none"


Load = Callable[[BinaryIO, _ChunkHead, dict[int, Channel], Wanted], memoryview]


@dataclass
class _ChunkInfo:
    """When the messages of a chunk were received, and how many there are of each connection."""

    first_ns: int
    last_ns: int
    counts: dict[int, int]


@dataclass
class _Index:
    """Connections by number, and what is in the chunk at each offset."""

    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: dict[int, _ChunkInfo] = field(default_factory=dict)
    _pieces: list[Piece] = field(default_factory=list)

    def counts(self) -> Counter[Channel]:
        total: Counter[Channel] = Counter(dict.fromkeys(self.channels.values(), 0))
        for info in self.chunks.values():
            for number, count in info.counts.items():
                total[_declared(self.channels, number)] += count
        return total

    def pieces(self) -> list[Piece]:
        """Of chunks the offset is told, not the end."""
        if not self._pieces:
            kinds: dict[frozenset[str], frozenset[str]] = {}
            for at, info in sorted(self.chunks.items()):
                topics = frozenset(_declared(self.channels, number).topic for number in info.counts)
                held = kinds.setdefault(topics, topics)
                self._pieces.append(Piece(at, at, info.first_ns, info.last_ns, held))
        return self._pieces


def _record(file: BinaryIO, at: int) -> tuple[Header, int, int]:
    """Header of the record at `at`, size and place of its content; the file stands there."""
    file.seek(at)
    length = int.from_bytes(read_exact(file, 4), "little")
    if length > HEADER_BYTES:
        raise ValueError(f"a record's header claims {length:,} bytes")
    header = _header(read_exact(file, length))
    size = int.from_bytes(read_exact(file, 4), "little")
    return header, size, file.tell()


def _header(data: Data) -> Header:
    fields, header = Fields(data), {}
    while fields:
        item = fields.block()
        name, equals, _ = bytes(item[:64]).partition(b"=")
        if not equals:
            raise ValueError("a header's field has no name")
        header[name.decode("ascii")] = item[len(name) + 1 :]
    return header


def _number(header: Header, name: str) -> int:
    if name not in header:
        raise ValueError(f"a record lacks {name}")
    return int.from_bytes(header[name], "little")


def _time(header: Header, name: str) -> int:
    if name not in header:
        raise ValueError(f"a record lacks {name}")
    seconds, nanoseconds = TIME.unpack(header[name])
    return int(seconds * 10**9 + nanoseconds)


def _learn(channels: dict[int, Channel], header: Header, content: Data) -> None:
    from rosbags.typesys.msg import normalize_msgtype

    inner = _header(content)
    channels[_number(header, "conn")] = Channel(
        topic=str(header["topic"], "utf-8"),
        type=normalize_msgtype(str(inner["type"], "utf-8")),
        encoding="ros1",
        schema_encoding="ros1msg",
        schema=bytes(inner["message_definition"]),
    )


def _declared(channels: dict[int, Channel], number: int) -> Channel:
    if number not in channels:
        raise ValueError(f"messages are of connection {number}, which is not declared")
    return channels[number]


def _read_index(file: BinaryIO, at: int, connections: int, chunks: int) -> _Index:
    index = _Index()
    for _ in range(connections + chunks):
        header, size, content_at = _record(file, at)
        content = read_exact(file, size)
        at = content_at + size
        kind = _number(header, "op")
        if kind == CONNECTION:
            _learn(index.channels, header, content)
        elif kind == CHUNK_INFO:
            fields = Fields(content)
            counts = {fields.number(4): fields.number(4) for _ in range(_number(header, "count"))}
            first_ns, last_ns = _time(header, "start_time"), _time(header, "end_time")
            index.chunks[_number(header, "chunk_pos")] = _ChunkInfo(first_ns, last_ns, counts)
        else:
            raise ValueError(f"the index holds a record of kind {kind}")
    return index


def _made_index(file: BinaryIO) -> _Index:
    """The index of a bag without one, from the index records behind its chunks, else from the messages."""
    index, followed = _Index(), set()
    chunk_at = 0
    for at, header, size in _records(file):
        kind = _number(header, "op")
        if kind == CONNECTION:
            _learn(index.channels, header, read_exact(file, size))
        elif kind == CHUNK:
            chunk_at = at
            index.chunks[at] = _ChunkInfo(FOREVER, -1, {})
        elif kind == INDEX and chunk_at:
            _count(index.chunks[chunk_at], header, read_exact(file, size))
            followed.add(chunk_at)
    for at, info in index.chunks.items():
        if at not in followed or not info.counts.keys() <= index.channels.keys():
            index.chunks[at] = _counted(file, at, index.channels)
    return index


def _count(info: _ChunkInfo, header: Header, entries: Data) -> None:
    """Takes an index record: times and offsets of a connection's messages in the chunk before it."""
    if len(entries) % SAMPLE_BYTES or not entries:
        raise ValueError("an index record has half an entry")
    times = [s * 10**9 + ns for s, ns, _ in struct.iter_unpack("<III", entries)]
    info.first_ns, info.last_ns = min(info.first_ns, *times), max(info.last_ns, *times)
    number = _number(header, "conn")
    info.counts[number] = info.counts.get(number, 0) + len(times)


def _counted(file: BinaryIO, at: int, channels: dict[int, Channel]) -> _ChunkInfo:
    info = _ChunkInfo(FOREVER, -1, {})
    for record in _in_chunk(file, at, channels, Wanted(), _whole):
        info.first_ns, info.last_ns = min(info.first_ns, record.log_ns), max(info.last_ns, record.log_ns)
        number = next(number for number, channel in channels.items() if channel == record.channel)
        info.counts[number] = info.counts.get(number, 0) + 1
    return info


def _records(file: BinaryIO) -> Iterator[tuple[int, Header, int]]:
    """Offset, header and size of content of the records to the file's end; the file stands at the content."""
    at, end = len(MAGIC), file.seek(0, 2)
    while at < end:
        header, size, content_at = _record(file, at)
        if content_at + size > end:
            raise EOFError(f"the file ends {content_at + size - end:,} bytes before a record does")
        yield at, header, size
        at = content_at + size


def _scan(file: BinaryIO, channels: dict[int, Channel]) -> Iterator[int]:
    """Offsets of the chunks of a bag without index, to the file's end; connections between are learnt."""
    for at, header, size in _records(file):
        kind = _number(header, "op")
        if kind == CONNECTION:
            _learn(channels, header, read_exact(file, size))
        elif kind == CHUNK:
            yield at
        elif kind == MESSAGE:
            raise ValueError("a message outside a chunk")


def _split(view: memoryview, at: int, end: int | None = None) -> tuple[memoryview, memoryview, int]:
    """Header and content of the record at `at` of a chunk, and where the next one begins.

    The chunk ends at `end`; where less of it is there, a content may be cut.
    """
    end = len(view) if end is None else end
    parts = []
    for _ in range(2):
        size = int.from_bytes(view[at : at + 4], "little")
        at += 4
        if at + size > end:
            raise ValueError("a record reaches beyond its chunk")
        parts.append(view[at : at + size])
        at += size
    return parts[0], parts[1], at


def _in_chunk(
    file: BinaryIO, offset: int, channels: dict[int, Channel], wanted: Wanted, load: Load
) -> Iterator[Record]:
    head = _chunk_head(file, offset)
    if wanted.heads and head.plain:
        yield from _walk(file, offset, head.at, head.at + head.packed, channels, wanted)
        return
    view, at = load(file, head, channels, wanted), 0
    while at < len(view):
        place = (offset, at)
        if len(view) < head.size and len(view) < at + 8 + int.from_bytes(view[at : at + 4], "little"):
            break  # the rest was not asked for
        header, content, at = _split(view, at, head.size)
        if at > len(view) and _number(_header(header), "op") == CONNECTION:
            break
        channel, log_ns = _take(_header(header), content, channels, wanted)
        if channel:
            if at > len(view) and channel.topic not in wanted.heads:
                raise ValueError("an index tells another place of a message")
            yield Record(channel, log_ns, content, place)


def _walk(
    file: BinaryIO, chunk_at: int, at: int, end: int, channels: dict[int, Channel], wanted: Wanted
) -> Iterator[Record]:
    """The messages of a chunk that is not packed, without reading more of them than is wanted."""
    begin = at
    while at < end:
        header, size, content_at = _record(file, at)
        if content_at + size > end:
            raise ValueError("a record reaches beyond its chunk")
        content = read_exact(file, size) if _number(header, "op") == CONNECTION else b""
        channel, log_ns = _take(header, content, channels, wanted)
        if channel:
            data = read_exact(file, min(size, HEAD) if channel.topic in wanted.heads else size)
            yield Record(channel, log_ns, data, (chunk_at, at - begin))
        at = content_at + size


def _take(
    header: Header, content: Data, channels: dict[int, Channel], wanted: Wanted
) -> tuple[Channel | None, int]:
    """Channel and time of a wanted message; learns a connection; None for anything else."""
    kind = _number(header, "op")
    if kind == CONNECTION:
        _learn(channels, header, content)
    elif kind == MESSAGE:
        channel = _declared(channels, _number(header, "conn"))
        log_ns = _time(header, "time")
        if wanted.topic(channel.topic) and wanted.time(log_ns):
            return channel, log_ns
    return None, 0


def _chunk_head(file: BinaryIO, offset: int) -> _ChunkHead:
    """Of the chunk at that offset; the file stands at its content."""
    header, packed, at = _record(file, offset)
    if _number(header, "op") != CHUNK:
        raise ValueError(f"there is no chunk at {offset:,}, where the index says one is")
    codec = str(header["compression"], "ascii")
    return _ChunkHead(offset, codec, at, packed, packed if codec == "none" else _number(header, "size"))


def _content(file: BinaryIO, head: _ChunkHead, at: int, buffer: Buffer) -> memoryview:
    """The data of the message at that place of a chunk that is not packed, until the buffer's next."""
    _, size, begin = _record(file, head.at + at)
    if begin + size > head.at + head.packed:
        raise ValueError("a record reaches beyond its chunk")
    return buffer.read(file, size)


def _load_chunk(file: BinaryIO, head: _ChunkHead, take: Take) -> memoryview:
    file.seek(head.at)
    chunk = take(checked_size(head.size))
    decompress(head.codec, read_exact(file, head.packed), chunk)
    return chunk


def _load_begin(file: BinaryIO, head: _ChunkHead, size: int, take: Take) -> memoryview:
    file.seek(head.at)
    chunk = take(size)
    decompress_begin(head.codec, read_exact(file, head.packed), chunk)
    return chunk


def _whole(file: BinaryIO, head: _ChunkHead, channels: dict[int, Channel], wanted: Wanted) -> memoryview:
    return _load_chunk(file, head, lambda size: memoryview(bytearray(size)))


def _entries(
    file: BinaryIO, head: _ChunkHead, channels: dict[int, Channel]
) -> dict[str, NDArray[np.uint64]] | None:
    """Topic -> (n, 2) times and offsets of its messages in a chunk, by the index records behind it.

    None where there are none, or of a connection that is not declared.
    """
    at, end = head.at + head.packed, file.seek(0, 2)
    found: dict[str, list[NDArray[np.uint64]]] = {}
    while at < end:
        header, size, content_at = _record(file, at)
        if _number(header, "op") != INDEX:
            break
        if _number(header, "conn") not in channels or size % SAMPLE_BYTES:
            return None
        stored = np.frombuffer(read_exact(file, size), "<u4").reshape(-1, 3).astype(np.uint64)
        times = np.stack([stored[:, 0] * np.uint64(10**9) + stored[:, 1], stored[:, 2]], -1)
        found.setdefault(channels[_number(header, "conn")].topic, []).append(times)
        at = content_at + size
    return {topic: np.concatenate(parts) for topic, parts in found.items()} or None
