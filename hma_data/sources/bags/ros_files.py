"""Read ROS's own bag files: format 2.0 of ROS 1, and the sqlite3 files of ROS 2.

ROS 1 bags follow https://wiki.ros.org/Bags/Format/2.0. They may have an index or not (a killed recorder
leaves none), and chunks that are plain, bz2 or lz4.

sqlite3 files are opened read-only; nothing is written beside them. Since ROS 2 Iron they hold the definitions
of the messages; before it, only the names of the definitions.
"""

import sqlite3
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

from hma_data.sources.bags.container import (
    FOREVER,
    Channel,
    Data,
    FileIndex,
    FilePlace,
    FileView,
    IndexedFile,
    Piece,
    Record,
    RecordFilter,
    StoredMessage,
    View,
    damaged,
    decompress,
    reading,
    take_last,
    without_index,
)
from hma_data.storage.blocks import expect

ROS1_MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, CHUNK, CHUNK_INFO, CONNECTION = 0x02, 0x05, 0x06, 0x07
TIME = struct.Struct("<II")
COUNTS = struct.Struct("<II")  # of a chunk: connection, messages
Header = dict[str, bytes]
SQLITE_MAGIC = b"SQLite format 3\x00"
LATEST = 2**63 - 1  # largest sqlite3 integer


class Ros1File(IndexedFile):
    """A ROS 1 bag."""

    def _view(self, file: BinaryIO, at: int, end: int | None = None) -> View:
        """See IndexedFile."""
        header, start, end = _record(_whole(file), at)

        def unpacked() -> bytes:
            data = FileView(file, start, end)[0 : end - start]
            return decompress(header["compression"].decode(), data, _number(header, "size"))

        return memoryview(self._chunks.get((self.path, at), unpacked))

    def _messages(self, index: FileIndex, view: View, at: int = 0) -> Iterator[StoredMessage]:
        """See IndexedFile."""
        for place, header, start, end in _records(view, at):
            kind = _number(header, "op")
            if kind == CONNECTION:
                _learn(index, header, view[start:end])
            elif kind == MESSAGE:
                yield StoredMessage(_number(header, "conn"), _time(header, "time"), place, start, end)

    def _make_index(self, file: BinaryIO) -> FileIndex:
        header, _, _ = _record(_whole(file), len(ROS1_MAGIC))
        at = _number(header, "index_pos")
        if not at:
            return self._index_of_chunks(file)
        return _stated_index(file, at, _number(header, "conn_count") + _number(header, "chunk_count"))

    def _index_of_chunks(self, file: BinaryIO) -> FileIndex:
        """Index a bag whose recorder was killed; every chunk is unpacked for it."""
        index, view = FileIndex(counts=Counter()), _whole(file)
        without_index(self.path, file, len(view))
        for place, header, start, end in _records(view, len(ROS1_MAGIC)):
            kind = _number(header, "op")
            if kind == CONNECTION:
                _learn(index, header, view[start:end])
            elif kind == CHUNK and index.counts is not None:
                index.counts.update(self._look_into(file, index, place, end))
        return index


def _whole(file: BinaryIO) -> FileView:
    return FileView(file, 0, file.seek(0, 2))


def _records(view: View, at: int) -> Iterator[tuple[int, Header, int, int]]:
    """Yield the place of each record from `at` on, its header, and where its content begins and ends."""
    while at < len(view):
        place = at
        header, start, at = _record(view, place)
        yield place, header, start, at


def _record(view: View, at: int) -> tuple[Header, int, int]:
    """Return the header of the record at `at`, and where its content begins and ends."""
    begin = at + 4
    start = begin + int.from_bytes(view[at:begin], "little") + 4
    header = _header(view[begin : start - 4])
    end = start + int.from_bytes(view[start - 4 : start], "little")
    if end > len(view):
        raise EOFError(f"it ends {end - len(view):,} bytes before a record does")
    return header, start, end


def _header(data: Data) -> Header:
    header, at = {}, 0
    while at < len(data):
        start = at + 4
        at = start + int.from_bytes(data[at:start], "little")
        name, _, value = bytes(data[start:at]).partition(b"=")
        header[name.decode("ascii")] = value
    return header


def _number(header: Header, name: str) -> int:
    return int.from_bytes(header[name], "little")


def _time(header: Header, name: str) -> int:
    seconds, nanoseconds = TIME.unpack(header[name])
    return int(seconds * 10**9 + nanoseconds)


def _learn(index: FileIndex, header: Header, content: Data) -> None:
    from rosbags.typesys.msg import normalize_msgtype

    inner = _header(content)
    index.channels[_number(header, "conn")] = Channel(
        topic=header["topic"].decode(),
        type=normalize_msgtype(inner["type"].decode()),
        encoding="ros1",
        schema_encoding="ros1msg",
        schema=inner["message_definition"],
    )


def _stated_index(file: BinaryIO, at: int, count: int) -> FileIndex:
    """Return the index that lies at the file's end as `count` records."""
    index, total, view = FileIndex(), Counter[int](), _whole(file)
    index_at = at
    expect(file, [(at, len(view))])
    for _ in range(count):
        header, start, at = _record(view, at)
        kind = _number(header, "op")
        if kind == CONNECTION:
            _learn(index, header, view[start:at])
        elif kind == CHUNK_INFO:
            counts = dict(COUNTS.iter_unpack(view[start:at]))
            total.update(counts)
            first_ns, last_ns = _time(header, "start_time"), _time(header, "end_time")
            index.pieces.append(
                Piece(_number(header, "chunk_pos"), index_at, first_ns, last_ns, frozenset(counts))
            )
        else:
            raise ValueError(f"the index holds a record of kind {kind}")
    index.pieces.sort()
    # A chunk ends where the next one begins.
    for i, following in enumerate(index.pieces[1:]):
        index.pieces[i] = index.pieces[i]._replace(end=following.at)
    index.counts = total
    return index


# -- sqlite3


class SqliteFile:
    """A .db3 file of rosbag2, with any version of its tables; its methods are those of IndexedFile."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def counts(self) -> Counter[Channel]:
        """See IndexedFile."""
        with self._opened() as (base, index):
            total: Counter[Channel] = Counter(dict.fromkeys(index.channels.values(), 0))
            for topic_id, count in base.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"):
                total[index.channel(topic_id)] += count
        return total

    def records(self, wanted: RecordFilter) -> Iterator[Record]:
        """See IndexedFile."""
        with self._opened() as (base, index):
            conditions, values = ["1"], list[int]()
            if wanted.topics is not None:
                ids = [number for number, channel in index.channels.items() if wanted.topic(channel.topic)]
                conditions.append(f"topic_id IN ({', '.join('?' * len(ids))})")
                values += ids
            if wanted.first_ns > 0 or wanted.last_ns < FOREVER:
                conditions.append("timestamp BETWEEN ? AND ?")
                values += [wanted.first_ns, min(wanted.last_ns, LATEST)]
            # The data is read message by message, because sorting would hold all of it in memory.
            query = "SELECT id, topic_id, timestamp FROM messages WHERE {} ORDER BY id"
            for row_id, topic_id, log_ns in base.execute(query.format(" AND ".join(conditions)), values):
                if not isinstance(log_ns, int):
                    raise ValueError(f"message {row_id} has no time")
                yield Record(index.channel(topic_id), log_ns, _payload(base, row_id), (0, row_id))

    def span(self) -> tuple[int, int]:
        """See IndexedFile."""
        with self._opened() as (base, _):
            first_ns, last_ns = base.execute("SELECT min(timestamp), max(timestamp) FROM messages").fetchone()
        return (FOREVER, -1) if first_ns is None else (first_ns, last_ns)

    def before(self, topics: frozenset[str], log_ns: int) -> dict[str, Record]:
        """See IndexedFile."""
        found: dict[str, Record] = {}
        query = (
            "SELECT id, timestamp FROM messages WHERE timestamp < ? AND topic_id = ? "
            "ORDER BY timestamp DESC, id DESC LIMIT 1"
        )
        with self._opened() as (base, index):
            for topic_id, channel in index.channels.items():
                rows = base.execute(query, (min(log_ns, LATEST), topic_id)) if channel.topic in topics else ()
                take_last(found, (Record(channel, at, _payload(base, row), (0, row)) for row, at in rows))
        return found

    def payloads(self, places: Sequence[FilePlace]) -> Iterator[Data]:
        """See IndexedFile."""
        with self._opened() as (base, _):
            for _, row_id in places:
                yield _payload(base, row_id)

    @contextmanager
    def _opened(self) -> Iterator[tuple[sqlite3.Connection, FileIndex]]:
        """Connect without writing anything, not even a lock, unless a write-ahead log must still be read."""
        log = self.path.with_name(self.path.name + "-wal")
        pending = log.is_file() and log.stat().st_size > 0
        place = f"file:{quote(str(self.path))}?mode=ro" + ("" if pending else "&immutable=1")
        with reading(self.path):
            _check_size(self.path)
            with closing(sqlite3.connect(place, uri=True)) as base:
                yield base, FileIndex(_channels(base))


def _check_size(path: Path) -> None:
    """Refuse a file that is cut off, because sqlite3 notices a missing end only where it reads it."""
    with path.open("rb") as file:
        head = file.read(100)
        size = file.seek(0, 2)
    page = int.from_bytes(head[16:18], "big")
    page = 65536 if page == 1 else page
    pages = int.from_bytes(head[28:32], "big")
    if len(head) < 100 or (head[24:28] == head[92:96] and size < page * pages):
        raise damaged(path, f"is cut off: it has {size:,} of {page * pages:,} bytes")


def _channels(base: sqlite3.Connection) -> dict[int, Channel]:
    tables = {name for (name,) in base.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    definitions: dict[str, tuple[Any, Any]] = {}
    if "message_definitions" in tables:
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        definitions = {name: (kind, text) for name, kind, text in base.execute(query)}
    channels = {}
    for topic_id, topic, kind, encoding in base.execute(
        "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
    ):
        schema_encoding, schema = definitions.get(kind) or ("", "")
        channels[topic_id] = Channel(
            str(topic), str(kind), str(encoding), str(schema_encoding), str(schema).encode()
        )
    return channels


def _payload(base: sqlite3.Connection, row_id: int) -> bytes:
    (data,) = base.execute("SELECT data FROM messages WHERE id = ?", (row_id,)).fetchone() or (None,)
    if not isinstance(data, bytes):
        raise ValueError(f"message {row_id} has no data")
    return data
