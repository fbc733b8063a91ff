"""Read ROS's own bag files: format 2.0 of ROS 1, and the sqlite3 files of ROS 2.

ROS 1 bags follow https://wiki.ros.org/Bags/Format/2.0. They may have an index or not (a killed recorder
leaves none), and chunks that are plain, bz2 or lz4.

sqlite3 files are opened read-only; nothing is written beside them. Since ROS 2 Iron they hold the definitions
of the messages; before it, only the names of the definitions.
"""

import sqlite3
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from urllib.parse import quote

from hma_data.sources.bags.container import (
    FOREVER,
    HEAD,
    Channel,
    ChunkCache,
    Data,
    Fields,
    Place,
    Record,
    Wanted,
    damaged,
    decompress,
    read_exact,
    reading,
)
from hma_data.sources.bags.time_index import Piece, last_before, overlapping, take_last

ROS1_MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG, CHUNK, CHUNK_INFO, CONNECTION = 0x02, 0x03, 0x05, 0x06, 0x07
HEADER_BYTES = 1 << 16  # most bytes of a record's header
TIME = struct.Struct("<II")
Header = dict[str, memoryview]
SQLITE_MAGIC = b"SQLite format 3\x00"
LATEST = 2**63 - 1  # largest sqlite3 integer


class Ros1File:
    """Read one ROS 1 bag; its unpacked chunks are kept in `chunks`. See Container."""

    def __init__(self, path: Path, chunks: ChunkCache | None = None) -> None:
        self.path = path
        self._chunks = chunks or ChunkCache()
        self._surveyed: _Index | None = None

    def counts(self) -> Counter[Channel]:
        """See Container."""
        with reading(self.path), self.path.open("rb") as file:
            return self._survey(file).counts.copy()

    def records(self, wanted: Wanted) -> Iterator[Record]:
        """See Container; chunks without a wanted message are not unpacked."""
        with reading(self.path), self.path.open("rb") as file:
            index = self._survey(file)
            for piece in overlapping(index.pieces, wanted):
                yield from _in_chunk(file, piece.at, index.channels, wanted, self._chunk)

    def before(self, topics: frozenset[str], log_ns: int) -> dict[str, Record]:
        """See Container."""
        with reading(self.path), self.path.open("rb") as file:
            index = self._survey(file)
            return last_before(
                index.pieces,
                topics,
                log_ns,
                lambda piece, wanted: _in_chunk(file, piece.at, index.channels, wanted, self._chunk),
            )

    def payloads(self, places: Sequence[Place]) -> Iterator[Data]:
        """See Container."""
        with reading(self.path), self.path.open("rb") as file:
            heads: dict[int, _ChunkHead] = {}
            for offset, at in places:
                if offset not in heads:
                    heads = {offset: _chunk_head(file, offset)}
                head = heads[offset]
                yield _content(file, head, at) if head.plain else _split(self._chunk(file, head), at)[1]

    def _chunk(self, file: BinaryIO, head: "_ChunkHead") -> memoryview:
        return self._chunks.get(self.path, head.offset, partial(_load_chunk, file, head))

    def _survey(self, file: BinaryIO) -> "_Index":
        """Return the index; make it from the chunks where the recorder left none."""
        if self._surveyed is None:
            self._surveyed = self._index(file) or _made_index(file)
        return self._surveyed

    def _index(self, file: BinaryIO) -> "_Index | None":
        """Return the index at the file's end; None where the recorder left none."""
        magic = file.read(len(ROS1_MAGIC))
        if magic != ROS1_MAGIC:
            shown = magic.split(b"\n")[0].decode("ascii", "replace")
            raise damaged(self.path, f"begins with {shown!r}, not as a ROS 1 bag" if magic else "is empty")
        header, _, _ = _record(file, len(ROS1_MAGIC))
        if _number(header, "op") != BAG:
            raise ValueError("the bag's header is missing")
        if bytes(header.get("encryptor", b"")):
            raise ValueError("it is encrypted")
        at = _number(header, "index_pos")
        count = _number(header, "conn_count") + _number(header, "chunk_count")
        return _read_index(file, at, count) if at else None


class _ChunkHead(NamedTuple):
    """The head of the chunk at `offset`; its content lies at `at`, `packed` bytes that unpack to `size`."""

    offset: int
    codec: str
    at: int
    packed: int
    size: int

    @property
    def plain(self) -> bool:
        """Check whether its records are stored uncompressed."""
        return self.codec == "none"


Load = Callable[[BinaryIO, _ChunkHead], Data]


@dataclass
class _Index:
    """Connections by number, the messages of each, and a piece for each chunk, without the piece's end."""

    channels: dict[int, Channel] = field(default_factory=dict)
    counts: Counter[Channel] = field(default_factory=Counter)
    pieces: list[Piece] = field(default_factory=list)

    def add(self, at: int, first_ns: int, last_ns: int, counts: Counter[Channel]) -> None:
        """Add the chunk at an offset."""
        self.counts.update(counts)
        topics = frozenset(channel.topic for channel in counts)
        self.pieces.append(Piece(at, at, first_ns, last_ns, topics))


def _record(file: BinaryIO, at: int) -> tuple[Header, int, int]:
    """Return the header of the record at `at`, and the size and offset of its content.

    The file is left at the content.
    """
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


def _read_index(file: BinaryIO, at: int, count: int) -> _Index:
    index, chunks = _Index(), list[tuple[Header, bytes]]()
    for _ in range(count):
        header, size, content_at = _record(file, at)
        content = read_exact(file, size)
        at = content_at + size
        kind = _number(header, "op")
        if kind == CONNECTION:
            _learn(index.channels, header, content)
        elif kind == CHUNK_INFO:
            chunks.append((header, content))
        else:
            raise ValueError(f"the index holds a record of kind {kind}")
    index.counts.update(dict.fromkeys(index.channels.values(), 0))
    for header, content in sorted(chunks, key=lambda chunk: _number(chunk[0], "chunk_pos")):
        fields, counts = Fields(content), Counter[Channel]()
        for _ in range(_number(header, "count")):
            counts[_declared(index.channels, fields.number(4))] += fields.number(4)
        first_ns, last_ns = _time(header, "start_time"), _time(header, "end_time")
        index.add(_number(header, "chunk_pos"), first_ns, last_ns, counts)
    return index


def _made_index(file: BinaryIO) -> _Index:
    """Make the index of a bag that has none; every chunk is unpacked for it."""
    index, at, end = _Index(), len(ROS1_MAGIC), file.seek(0, 2)
    while at < end:
        header, size, content_at = _record(file, at)
        if content_at + size > end:
            raise EOFError(f"the file ends {content_at + size - end:,} bytes before a record does")
        kind = _number(header, "op")
        if kind == CONNECTION:
            _learn(index.channels, header, read_exact(file, size))
        elif kind == CHUNK:
            times, counts = [FOREVER, -1], Counter[Channel]()
            for record in _in_chunk(file, at, index.channels, Wanted(), _load_chunk):
                times = [min(times[0], record.log_ns), max(times[1], record.log_ns)]
                counts[record.channel] += 1
            index.add(at, times[0], times[1], counts)
        elif kind == MESSAGE:
            raise ValueError("a message outside a chunk")
        at = content_at + size
    return index


def _split(view: memoryview, at: int) -> tuple[memoryview, memoryview, int]:
    """Return header and content of the record at `at` of a chunk, and the offset of the next record."""
    parts = []
    for _ in range(2):
        size = int.from_bytes(view[at : at + 4], "little")
        at += 4
        if at + size > len(view):
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
    view, at = memoryview(load(file, head)), 0
    while at < len(view):
        place = (offset, at)
        header, content, at = _split(view, at)
        channel, log_ns = _take(_header(header), content, channels, wanted)
        if channel:
            yield Record(channel, log_ns, content, place)


def _walk(
    file: BinaryIO, chunk_at: int, at: int, end: int, channels: dict[int, Channel], wanted: Wanted
) -> Iterator[Record]:
    """Yield the messages of a chunk that is not packed; of other messages, read only the header."""
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
    """Return channel and time of a wanted message, else None; learn a connection record."""
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
    """Return the head of the chunk at an offset; leave the file at its content."""
    header, packed, at = _record(file, offset)
    if _number(header, "op") != CHUNK:
        raise ValueError(f"there is no chunk at {offset:,}, where the index says one is")
    codec = str(header["compression"], "ascii")
    return _ChunkHead(offset, codec, at, packed, packed if codec == "none" else _number(header, "size"))


def _content(file: BinaryIO, head: _ChunkHead, at: int) -> bytes:
    """Return the data of the message at a place in a chunk that is not packed."""
    _, size, begin = _record(file, head.at + at)
    if begin + size > head.at + head.packed:
        raise ValueError("a record reaches beyond its chunk")
    return read_exact(file, size)


def _load_chunk(file: BinaryIO, head: _ChunkHead) -> bytes:
    file.seek(head.at)
    return decompress(head.codec, read_exact(file, head.packed), head.size)


# -- sqlite3


class SqliteFile:
    """Read one .db3 file of rosbag2, with any version of its tables; see Container."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def counts(self) -> Counter[Channel]:
        """See Container."""
        with reading(self.path), closing(self._open()) as base:
            channels = self._channels(base)
            total: Counter[Channel] = Counter(dict.fromkeys(channels.values(), 0))
            for topic_id, count in base.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"):
                total[self._channel(channels, topic_id)] += count
        return total

    def records(self, wanted: Wanted) -> Iterator[Record]:
        """See Container."""
        with reading(self.path), closing(self._open()) as base:
            channels = self._channels(base)
            for row_id, topic_id, log_ns in self._rows(base, channels, wanted):
                channel = self._channel(channels, topic_id)
                data = self._data(base, row_id, HEAD if channel.topic in wanted.heads else None)
                if not isinstance(log_ns, int):
                    raise ValueError(f"message {row_id} has no time")
                yield Record(channel, log_ns, data, (0, row_id))

    def before(self, topics: frozenset[str], log_ns: int) -> dict[str, Record]:
        """See Container."""
        found: dict[str, Record] = {}
        query = (
            "SELECT id, topic_id, timestamp FROM messages WHERE timestamp < ? AND topic_id = ? "
            "ORDER BY timestamp DESC, id DESC LIMIT 1"
        )
        with reading(self.path), closing(self._open()) as base:
            for topic_id, channel in self._channels(base).items():
                rows = base.execute(query, (min(log_ns, LATEST), topic_id)) if channel.topic in topics else ()
                take_last(
                    found, (Record(channel, at, self._data(base, row, None), (0, row)) for row, _, at in rows)
                )
        return found

    def _rows(
        self, base: sqlite3.Connection, channels: dict[int, Channel], wanted: Wanted
    ) -> Iterator[tuple[int, int, Any]]:
        """Yield id, topic and time of the wanted messages.

        The query leaves out the data, because sorting would hold it all in memory.
        """
        ids = [number for number, channel in channels.items() if wanted.topic(channel.topic)]
        conditions, values = [], []
        if wanted.topics is not None:
            conditions.append(f"topic_id IN ({', '.join('?' * len(ids))})")
            values += ids
        if wanted.bounded:
            conditions.append("timestamp BETWEEN ? AND ?")
            values += [wanted.first_ns, min(wanted.last_ns, LATEST)]
        where = f" WHERE {' AND '.join(conditions)}" if conditions else ""
        return base.execute(f"SELECT id, topic_id, timestamp FROM messages{where} ORDER BY id", values)

    def _data(self, base: sqlite3.Connection, row_id: int, limit: int | None) -> bytes:
        """Return a message's bytes, or only its first `limit` bytes."""
        if limit is None:
            return self._payload(base, row_id)
        with base.blobopen("messages", "data", row_id, readonly=True) as blob:
            return blob.read(limit)

    def _payload(self, base: sqlite3.Connection, row_id: int) -> bytes:
        (data,) = base.execute("SELECT data FROM messages WHERE id = ?", (row_id,)).fetchone() or (None,)
        if not isinstance(data, bytes):
            raise ValueError(f"message {row_id} has no data")
        return data

    def payloads(self, places: Sequence[Place]) -> Iterator[Data]:
        """See Container."""
        with reading(self.path), closing(self._open()) as base:
            for _, row_id in places:
                yield self._payload(base, row_id)

    def _open(self) -> sqlite3.Connection:
        """Connect without writing anything, not even a lock, unless a write-ahead log must still be read."""
        self._check_size()
        log = self.path.with_name(self.path.name + "-wal")
        pending = log.is_file() and log.stat().st_size > 0
        place = f"file:{quote(str(self.path))}?mode=ro" + ("" if pending else "&immutable=1")
        return sqlite3.connect(place, uri=True)

    def _check_size(self) -> None:
        """Refuse a file that is cut off, because sqlite3 notices a missing end only where it reads it."""
        with self.path.open("rb") as file:
            head = file.read(100)
            size = file.seek(0, 2)
        if not head.startswith(SQLITE_MAGIC):
            raise damaged(self.path, "does not begin as an sqlite3 file does" if head else "is empty")
        page = int.from_bytes(head[16:18], "big")
        page = 65536 if page == 1 else page
        pages = int.from_bytes(head[28:32], "big")
        if head[24:28] == head[92:96] and size < page * pages:
            raise damaged(self.path, f"is cut off: it has {size:,} of {page * pages:,} bytes")

    def _channels(self, base: sqlite3.Connection) -> dict[int, Channel]:
        tables = {name for (name,) in base.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"topics", "messages"} <= tables:
            raise damaged(self.path, "is an sqlite3 file without rosbag2's tables topics and messages")
        definitions: dict[str, tuple[Any, Any]] = {}
        if "message_definitions" in tables:
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            definitions = {name: (kind, text) for name, kind, text in base.execute(query)}
        channels = {}
        for topic_id, topic, kind, encoding in base.execute(
            "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
        ):
            service = str(kind).removesuffix(
                "_Event"
            )  # rosbag2 keeps the definition of a service's events there
            schema_encoding, schema = definitions.get(kind) or definitions.get(service) or ("", "")
            channels[topic_id] = Channel(
                str(topic), str(kind), str(encoding), str(schema_encoding), str(schema).encode()
            )
        return channels

    def _channel(self, channels: dict[int, Channel], topic_id: Any) -> Channel:
        if topic_id not in channels:
            raise ValueError(f"a message is of topic {topic_id}, which is not declared")
        return channels[topic_id]
