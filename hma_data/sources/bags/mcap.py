"""MCAP files, read as the format's specification lays them out: https://mcap.dev/spec

Chunked or not, with or without summary. Read here rather than with the mcap package because that
package takes a short read for a whole record, and its reader fails on files whose summary does
not repeat the channels; places for random access come with it.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
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

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, STATISTICS, DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0B, 0x0F
METADATA = 0x0C
NOTE_BYTES = 1 << 20  # a metadata record of more is not a note about the episode
FRAME = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
FOOTER_SIZE = FRAME.size + 20
LOOSE = -1  # in a place: the message is in no chunk


class McapFile:
    """One MCAP file; see Container."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._chunks = ChunkCache(_load_chunk)

    def counts(self) -> Counter[Channel]:
        """See Container."""
        with reading(self.path), self.path.open("rb") as file:
            found = _summary(file, self._data_end(file))
        if found is None:
            found = Counter(record.channel for record in self.records())
        return found

    def records(self, topics: frozenset[str] | None = None) -> Iterator[Record]:
        """See Container."""
        declared = _Declared()
        with reading(self.path), self.path.open("rb") as file:
            for opcode, at, length in _frames(file, len(MAGIC), self._data_end(file)):
                if opcode in (DATA_END, FOOTER):
                    return
                if opcode == CHUNK:
                    chunk = _unpack_chunk(read_exact(file, length))
                    yield from _in_chunk(chunk, at, declared, topics)
                elif opcode in (SCHEMA, CHANNEL):
                    declared.learn(opcode, read_exact(file, length))
                elif opcode == MESSAGE:
                    record = _message(memoryview(read_exact(file, length)), (LOOSE, at), declared)
                    if topics is None or record.channel.topic in topics:
                        yield record

    def notes(self) -> dict[str, str]:
        """All entries of the file's metadata records (MCAP specification, opcode 0x0C); later ones win."""
        found: dict[str, str] = {}
        with reading(self.path), self.path.open("rb") as file:
            for opcode, _, length in _frames(file, len(MAGIC), self._data_end(file)):
                if opcode == METADATA and length <= NOTE_BYTES:
                    fields = Fields(read_exact(file, length))
                    fields.text()  # the record's name
                    entries = Fields(fields.block())
                    while entries:
                        key = entries.text()
                        found[key] = entries.text()
        return found

    def payloads(self, places: Sequence[Place]) -> Iterator[Data]:
        """See Container."""
        with reading(self.path), self.path.open("rb") as file:
            for chunk_at, at in places:
                if chunk_at == LOOSE:
                    _, length = _frame(file, at)
                    yield read_exact(file, length)[MESSAGE_HEAD.size :]
                    continue
                chunk = self._chunks.get(file, chunk_at)
                _, length = FRAME.unpack_from(chunk, at)
                start = at + FRAME.size
                yield memoryview(chunk)[start + MESSAGE_HEAD.size : start + length]

    def _data_end(self, file: BinaryIO) -> int:
        """Where the footer begins, once both ends are what they must be."""
        size = file.seek(0, 2)
        file.seek(0)
        if file.read(len(MAGIC)) != MAGIC:
            raise damaged(self.path, "is empty" if not size else "does not begin as an MCAP file does")
        end = size - len(MAGIC) - FOOTER_SIZE
        if end >= len(MAGIC):
            file.seek(size - len(MAGIC))
        if end < len(MAGIC) or file.read(len(MAGIC)) != MAGIC:
            raise damaged(self.path, "is cut off: it does not end as an MCAP file does")
        return end


class _Declared:
    """Schemas and channels met so far."""

    def __init__(self) -> None:
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        self.channels: dict[int, Channel] = {}

    def learn(self, opcode: int, data: Data) -> None:
        fields = Fields(data)
        number = fields.number(2)
        if opcode == SCHEMA:
            self._schemas[number] = (fields.text(), fields.text(), bytes(fields.block()))
        elif opcode == CHANNEL:
            schema_id, topic, encoding = fields.number(2), fields.text(), fields.text()
            if schema_id and schema_id not in self._schemas:
                raise ValueError(f"channel {number} of {topic} names schema {schema_id}, which is not there")
            name, kind, schema = self._schemas.get(schema_id, ("", "", b""))
            self.channels[number] = Channel(topic, name, encoding, kind, schema)

    def channel(self, number: int) -> Channel:
        if number not in self.channels:
            raise ValueError(f"a message is on channel {number}, which is not declared")
        return self.channels[number]


def _frame(file: BinaryIO, at: int) -> tuple[int, int]:
    file.seek(at)
    opcode, length = FRAME.unpack(read_exact(file, FRAME.size))
    return opcode, length


def _frames(file: BinaryIO, at: int, end: int) -> Iterator[tuple[int, int, int]]:
    """(opcode, offset, length) of the records from `at` to `end`; the file stands at the content."""
    while at < end:
        opcode, length = _frame(file, at)
        following = at + FRAME.size + length
        if following > end:
            raise EOFError(f"the file ends {following - end:,} bytes before a record does")
        yield opcode, at, length
        at = following


def _message(body: memoryview, place: Place, declared: _Declared) -> Record:
    if len(body) < MESSAGE_HEAD.size:
        raise ValueError("a message ends too soon")
    channel, _, log_ns, _ = MESSAGE_HEAD.unpack_from(body)
    return Record(declared.channel(channel), log_ns, body[MESSAGE_HEAD.size :], place)


def _in_chunk(
    chunk: bytes, chunk_at: int, declared: _Declared, topics: frozenset[str] | None
) -> Iterator[Record]:
    view, at = memoryview(chunk), 0
    while at < len(view):
        opcode, length = FRAME.unpack_from(view, at)
        start, following = at + FRAME.size, at + FRAME.size + length
        if following > len(view):
            raise ValueError("a record reaches beyond its chunk")
        if opcode == MESSAGE:
            record = _message(view[start:following], (chunk_at, at), declared)
            if topics is None or record.channel.topic in topics:
                yield record
        elif opcode in (SCHEMA, CHANNEL):
            declared.learn(opcode, view[start:following])
        at = following


def _load_chunk(file: BinaryIO, at: int) -> bytes:
    _, length = _frame(file, at)
    return _unpack_chunk(read_exact(file, length))


def _unpack_chunk(data: bytes) -> bytes:
    fields = Fields(data)
    fields.take(16)  # first and last log time
    size, checksum, codec = fields.number(8), fields.number(4), fields.text()
    chunk = decompress(codec, fields.take(fields.number(8)), size)
    if checksum and zlib.crc32(chunk) != checksum:
        raise ValueError("a chunk's checksum does not fit its content")
    return chunk


def _summary(file: BinaryIO, end: int) -> Counter[Channel] | None:
    """Messages of each channel as the summary tells; None where it does not tell all of it."""
    opcode, length = _frame(file, end)
    if opcode != FOOTER or length != FOOTER_SIZE - FRAME.size:
        raise ValueError("there is no footer at the end")
    start = int.from_bytes(file.read(8), "little")
    if not start:
        return None
    if not len(MAGIC) <= start <= end:
        raise ValueError("the summary is said to lie outside the file")
    declared, counted = _Declared(), None
    for opcode, _, length in _frames(file, start, end):
        if opcode in (SCHEMA, CHANNEL):
            try:
                declared.learn(opcode, read_exact(file, length))
            except ValueError:
                return None  # the summary need not repeat schemas
        elif opcode == STATISTICS:
            counted = _counted(read_exact(file, length))
    if counted is None or not counted.keys() <= declared.channels.keys():
        return None
    total: Counter[Channel] = Counter()
    for number, channel in declared.channels.items():
        total[channel] += counted.get(number, 0)
    return total


def _counted(data: bytes) -> dict[int, int] | None:
    """Messages by channel number in a Statistics record; None where they are left out."""
    fields = Fields(data)
    messages = fields.number(8)
    fields.take(2 + 4 + 4 + 4 + 4 + 8 + 8)
    entries = Fields(fields.block())
    counts = {}
    while entries:
        number = entries.number(2)
        counts[number] = entries.number(8)
    return counts if sum(counts.values()) == messages else None
