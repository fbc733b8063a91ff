"""ROS 1 bags, format 2.0, as https://wiki.ros.org/Bags/Format/2.0 lays them out.

Indexed or not (a recorder that was killed leaves no index), chunks plain, bz2 or lz4.
"""

import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from hma_data.sources.bags.container import (
    Channel,
    ChunkCache,
    Data,
    Fields,
    Place,
    Record,
    damaged,
    decompress,
    read_exact,
    reading,
)

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG, CHUNK, CHUNK_INFO, CONNECTION = 0x02, 0x03, 0x05, 0x06, 0x07
TIME = struct.Struct("<II")
Header = dict[str, memoryview]


class Ros1File:
    """One ROS 1 bag; see Container."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._chunks = ChunkCache(_load_chunk)

    def counts(self) -> Counter[Channel]:
        """See Container."""
        with reading(self.path), self.path.open("rb") as file:
            index = self._index(file)
            if index:
                return index.counts()
        return Counter(record.channel for record in self.records())

    def records(self, topics: frozenset[str] | None = None) -> Iterator[Record]:
        """See Container; chunks without a wanted topic are not unpacked where an index says so."""
        with reading(self.path), self.path.open("rb") as file:
            index = self._index(file)
            channels = dict(index.channels) if index else {}
            for at in index.chunks_with(topics) if index else _scan(file, channels):
                yield from _in_chunk(_load_chunk(file, at), at, channels, topics)

    def payloads(self, places: Sequence[Place]) -> Iterator[Data]:
        """See Container."""
        with reading(self.path), self.path.open("rb") as file:
            for chunk_at, at in places:
                view = memoryview(self._chunks.get(file, chunk_at))
                yield _split(view, at)[1]

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


@dataclass
class _Index:
    """Connections by number, and for each chunk's offset how many messages of each it holds."""

    channels: dict[int, Channel]
    chunks: dict[int, dict[int, int]]

    def counts(self) -> Counter[Channel]:
        total: Counter[Channel] = Counter(dict.fromkeys(self.channels.values(), 0))
        for counts in self.chunks.values():
            for number, count in counts.items():
                total[_declared(self.channels, number)] += count
        return total

    def chunks_with(self, topics: frozenset[str] | None) -> list[int]:
        return sorted(
            at
            for at, counts in self.chunks.items()
            if topics is None or any(_declared(self.channels, number).topic in topics for number in counts)
        )


def _record(file: BinaryIO, at: int) -> tuple[Header, int, int]:
    """Header of the record at `at`, size and place of its content; the file stands there."""
    file.seek(at)
    header = _header(read_exact(file, int.from_bytes(read_exact(file, 4), "little")))
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
    index = _Index({}, {})
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
            index.chunks[_number(header, "chunk_pos")] = counts
        else:
            raise ValueError(f"the index holds a record of kind {kind}")
    return index


def _scan(file: BinaryIO, channels: dict[int, Channel]) -> Iterator[int]:
    """Offsets of the chunks of a bag without index, to the file's end; connections between are learnt."""
    at, end = len(MAGIC), file.seek(0, 2)
    while at < end:
        header, size, content_at = _record(file, at)
        if content_at + size > end:
            raise EOFError(f"the file ends {content_at + size - end:,} bytes before a record does")
        kind = _number(header, "op")
        if kind == CONNECTION:
            _learn(channels, header, read_exact(file, size))
        elif kind == CHUNK:
            yield at
        elif kind == MESSAGE:
            raise ValueError("a message outside a chunk")
        at = content_at + size


def _split(view: memoryview, at: int) -> tuple[memoryview, memoryview, int]:
    """Header and content of the record at `at` of a chunk, and where the next one begins."""
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
    chunk: bytes, chunk_at: int, channels: dict[int, Channel], topics: frozenset[str] | None
) -> Iterator[Record]:
    view, at = memoryview(chunk), 0
    while at < len(view):
        place = (chunk_at, at)
        head, content, at = _split(view, at)
        header = _header(head)
        kind = _number(header, "op")
        if kind == CONNECTION:
            _learn(channels, header, content)
        elif kind == MESSAGE:
            channel = _declared(channels, _number(header, "conn"))
            if topics is None or channel.topic in topics:
                seconds, nanoseconds = TIME.unpack(header["time"])
                yield Record(channel, seconds * 10**9 + nanoseconds, content, place)


def _load_chunk(file: BinaryIO, at: int) -> bytes:
    header, size, _ = _record(file, at)
    if _number(header, "op") != CHUNK:
        raise ValueError(f"there is no chunk at {at:,}, where the index says one is")
    return decompress(str(header["compression"], "ascii"), read_exact(file, size), _number(header, "size"))
