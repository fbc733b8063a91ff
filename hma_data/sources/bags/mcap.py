"""Read MCAP files by the format's specification: https://mcap.dev/spec

Files may have chunks or not, and a summary or not. Of the mcap package only the parsers of records are used:
its readers take a short read for a whole record, fail on files whose summary does not repeat the channels,
and give no places for random access.

Chunks that are not packed need not be read whole: their records are walked in the file itself. Counts come
from the file's summary. So does the index; the chunks that the summary leaves out are found by a walk over
the file, and described by their heads and the message indexes behind them.
"""

import struct
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from isal.isal_zlib import crc32
from mcap import records
from mcap.data_stream import ReadDataStream

from hma_data.sources.bags.container import (
    ALL,
    FOREVER,
    HEAD,
    Channel,
    ChunkCache,
    FileIndex,
    FileView,
    IndexedFile,
    Piece,
    Record,
    RecordFilter,
    View,
    damaged,
    decompress,
    read_exact,
    reading,
    without_index,
)
from hma_data.storage.blocks import expect

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07
CHUNK_INDEX, STATISTICS, METADATA, DATA_END = 0x08, 0x0B, 0x0C, 0x0F
FRAME = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
CHUNK_HEAD = struct.Struct("<QQQII")  # first and last time, unpacked size, checksum, length of the codec
INDEX_HEAD = struct.Struct("<HI")  # channel, bytes of its entries
SIZE = struct.Struct("<Q")
FOOTER_SIZE = FRAME.size + 20
RUN_BYTES = 1 << 20  # most bytes of messages outside of chunks that make one piece
CODEC_BYTES = 32  # most bytes of a codec's name


class ChunkHead(NamedTuple):
    """The head of a chunk; its records lie at `at`, as `packed` bytes that unpack to `size`."""

    first_ns: int
    last_ns: int
    size: int
    checksum: int
    codec: str
    at: int
    packed: int

    @property
    def plain(self) -> bool:
        """Check whether its records are stored uncompressed."""
        return self.codec in ("", "none") and self.packed == self.size


@dataclass
class _Part:
    """A piece while its file is indexed, with its channels by number."""

    at: int
    end: int
    first_ns: int
    last_ns: int
    channels: set[int]
    chunk: bool


@dataclass
class _Summary:
    """The summary at the end of a file.

    Attributes:
        counts: messages by channel number; None where it does not state all of them.
        chunks: offset of a chunk -> what is in it, and the offset after it and its message indexes.
    """

    counts: dict[int, int] | None = None
    chunks: dict[int, tuple[_Part, int]] = field(default_factory=dict)


class McapFile(IndexedFile):
    """An MCAP file."""

    def __init__(self, path: Path, chunks: ChunkCache | None = None) -> None:
        super().__init__(path, chunks)
        self._checked: set[int] = set()  # offsets of the chunks whose checksum fits
        self._schemas: dict[int, Any] = {}

    def counts(self) -> Counter[Channel]:
        """See IndexedFile."""
        with reading(self.path), self._file.open() as file:
            index = FileIndex()
            counted = self._summary(file, self._data_end(file), index).counts
            if counted is not None and counted.keys() <= index.channels.keys():
                total: Counter[Channel] = Counter()
                for number, channel in index.channels.items():
                    total[channel] += counted.get(number, 0)
                return total
        return Counter(record.channel for record in self.records(ALL))

    def notes(self) -> dict[str, str]:
        """Return all entries of the file's metadata records (opcode 0x0C); later ones win."""
        with reading(self.path), self._file.open() as file:
            return self._index(file).notes

    def _content(self, view: View, at: int) -> tuple[int, int]:
        _, start, end = _record(view, at)
        return start + MESSAGE_HEAD.size, end

    def _view(self, file: BinaryIO, at: int, end: int | None = None, check: bool = True) -> View:
        """See IndexedFile. A packed chunk is checked the first time, a plain one only with `check`."""
        whole = FileView(file, 0, file.seek(0, 2))
        opcode, start, stop = _record(whole, at)
        if opcode != CHUNK:
            return FileView(file, at, end or len(whole))
        head = _chunk_head(file, start, stop)
        if head.plain and (at in self._checked or not check):
            return FileView(file, head.at, head.at + head.packed)
        load = partial(self._load, file, at, head)
        return memoryview(load()) if head.plain else self._chunks.get(self.path, at, load)

    def _load(self, file: BinaryIO, at: int, head: ChunkHead) -> bytes:
        file.seek(head.at)
        chunk = decompress(head.codec, read_exact(file, head.packed), head.size)
        if at not in self._checked and head.checksum and crc32(chunk) != head.checksum:
            raise ValueError("a chunk's checksum does not fit its content")
        self._checked.add(at)
        return chunk

    def _in_piece(
        self, file: BinaryIO, index: FileIndex, piece: Piece, wanted: RecordFilter
    ) -> Iterator[Record]:
        # A chunk of which only heads are read is checked when its first frame is read.
        view = self._view(file, piece.at, piece.end, piece.topics.isdisjoint(wanted.heads))
        for opcode, at, start, end in _records(view, 0, len(view)):
            if opcode == MESSAGE:
                number, _, log_ns, _ = MESSAGE_HEAD.unpack(view[start : start + MESSAGE_HEAD.size])
                channel = index.channel(number)
                if wanted.topic(channel.topic) and wanted.time(log_ns):
                    start += MESSAGE_HEAD.size
                    stop = min(end, start + HEAD) if channel.topic in wanted.heads else end
                    yield Record(channel, log_ns, view[start:stop], (piece.at, at))
            elif opcode in (SCHEMA, CHANNEL):
                self._learn(index, opcode, bytes(view[start:end]))

    def _learn(self, index: FileIndex, opcode: int, data: bytes) -> None:
        """Add a schema or channel record."""
        if opcode == SCHEMA:
            schema = records.Schema.read(_stream(data))
            self._schemas[schema.id] = schema
            return
        found = records.Channel.read(_stream(data))
        name, encoding, text = "", "", b""
        if found.schema_id:
            if found.schema_id not in self._schemas:
                raise ValueError(f"channel {found.topic} names schema {found.schema_id}, which is not there")
            schema = self._schemas[found.schema_id]
            name, encoding, text = schema.name, schema.encoding, schema.data
        index.channels[found.id] = Channel(found.topic, name, found.message_encoding, encoding, text)

    # -- the index

    def _data_end(self, file: BinaryIO) -> int:
        """Return the offset of the footer, after checking both ends of the file."""
        size = file.seek(0, 2)
        file.seek(0)
        if file.read(len(MAGIC)) != MAGIC:
            raise damaged(self.path, "does not begin with MCAP's magic bytes" if size else "is empty")
        end = size - len(MAGIC) - FOOTER_SIZE
        file.seek(size - len(MAGIC))
        if end < len(MAGIC) or file.read(len(MAGIC)) != MAGIC:
            raise damaged(self.path, "is cut off: it does not end with MCAP's magic bytes")
        return end

    def _summary(self, file: BinaryIO, end: int, index: FileIndex) -> _Summary:
        """Return the summary; learn the schemas and channels in it."""
        view, found = FileView(file, 0, end + FOOTER_SIZE), _Summary()
        opcode, at, stop = _record(view, end)
        if opcode != FOOTER:
            raise ValueError("there is no footer at the end")
        start, complete = records.Footer.read(_stream(view[at:stop])).summary_start, True
        expect(file, [(start, end)] if start else ())
        for opcode, _, at, stop in _records(view, start, end) if start else ():
            if opcode in (SCHEMA, CHANNEL):
                try:
                    self._learn(index, opcode, bytes(view[at:stop]))
                except ValueError:  # the summary need not repeat schemas; the chunks hold the missing ones
                    complete = False
            elif opcode == STATISTICS:
                stated = records.Statistics.read(_stream(view[at:stop]))
                counts: dict[int, int] = stated.channel_message_counts
                found.counts = counts if sum(counts.values()) == stated.message_count else None
            elif opcode == CHUNK_INDEX:
                part, after = _indexed_chunk(view[at:stop])
                found.chunks[part.at] = (part, after)
        found.counts = found.counts if complete else None
        return found

    def _make_index(self, file: BinaryIO) -> FileIndex:
        """Walk over the file's records, past the chunks that the summary describes."""
        index, parts = FileIndex(), list[_Part]()
        end = self._data_end(file)
        stated = self._summary(file, end, index).chunks
        if not stated:
            without_index(self.path, file, end)
        view, at = FileView(file, 0, end), len(MAGIC)
        while at < end:
            if at in stated:
                part, at = stated[at]
                parts.append(part)
                continue
            place = at
            opcode, start, at = _record(view, place)
            if opcode in (DATA_END, FOOTER):
                break
            if opcode in (SCHEMA, CHANNEL):
                self._learn(index, opcode, view[start:at])
            elif opcode == METADATA:
                index.notes |= records.Metadata.read(_stream(view[start:at])).metadata
            elif opcode == CHUNK:
                head = _chunk_head(file, start, at)
                parts.append(_Part(place, at, head.first_ns, head.last_ns, set(), True))
            elif opcode == MESSAGE_INDEX and parts and parts[-1].chunk:
                number, size = INDEX_HEAD.unpack(view[start : start + INDEX_HEAD.size])
                parts[-1].channels |= {number} if size else set()
            elif opcode == MESSAGE:
                number, _, log_ns, _ = MESSAGE_HEAD.unpack(view[start : start + MESSAGE_HEAD.size])
                _add_loose(parts, place, at, number, log_ns)
        for part in parts:
            index.pieces.append(self._piece(file, index, part))
        return index

    def _piece(self, file: BinaryIO, index: FileIndex, part: _Part) -> Piece:
        told = part.channels and part.last_ns and part.channels <= index.channels.keys()
        if told or not part.chunk:
            topics = frozenset(index.channel(number).topic for number in part.channels)
            return Piece(part.at, part.end, part.first_ns, part.last_ns, topics)
        # Without an index, only the chunk states what it holds.
        piece = Piece(part.at, part.end, 0, FOREVER, frozenset())
        held = {(r.log_ns, r.channel.topic) for r in self._in_piece(file, index, piece, ALL)}
        times = [log_ns for log_ns, _ in held]
        return piece._replace(
            first_ns=min(times, default=FOREVER),
            last_ns=max(times, default=-1),
            topics=frozenset(topic for _, topic in held),
        )


def _indexed_chunk(data: bytes) -> tuple[_Part, int]:
    """Return the chunk that a record of the summary describes, and the offset after its message indexes."""
    found = records.ChunkIndex.read(_stream(data))
    at, end = found.chunk_start_offset, found.chunk_start_offset + found.chunk_length
    after = end + found.message_index_length
    bounds = sorted((*found.message_index_offsets.values(), after))
    empty = FRAME.size + INDEX_HEAD.size  # bytes of a message index without entries
    channels = {
        number
        for number, offset in found.message_index_offsets.items()
        if offset < after and bounds[bisect_right(bounds, offset)] - offset > empty
    }
    part = _Part(at, end, found.message_start_time, found.message_end_time, channels, True)
    return part, max(after, at + FRAME.size)


def _stream(data: bytes) -> Any:
    return ReadDataStream(BytesIO(data))


def _record(view: View, at: int) -> tuple[int, int, int]:
    """Return the opcode of the record at `at`, and where its content begins and ends."""
    opcode, length = FRAME.unpack(view[at : at + FRAME.size])
    start = at + FRAME.size
    if start + length > len(view):
        raise EOFError(f"it ends {start + length - len(view):,} bytes before a record does")
    return opcode, start, start + length


def _records(view: View, at: int, end: int) -> Iterator[tuple[int, int, int, int]]:
    """Yield (opcode, offset, begin and end of the content) of the records from `at` to `end`."""
    while at < end:
        opcode, start, stop = _record(view, at)
        yield opcode, at, start, stop
        at = stop


def _add_loose(parts: list[_Part], at: int, end: int, number: int, log_ns: int) -> None:
    last = parts[-1] if parts else None
    if last is None or last.chunk or end - last.at > RUN_BYTES:
        parts.append(_Part(at, end, log_ns, log_ns, {number}, False))
        return
    last.end = end
    last.first_ns, last.last_ns = min(last.first_ns, log_ns), max(last.last_ns, log_ns)
    last.channels.add(number)


def _chunk_head(file: BinaryIO, start: int, end: int) -> ChunkHead:
    """Return the head of the chunk whose content lies between those offsets."""
    file.seek(start)
    data = read_exact(file, min(end - start, CHUNK_HEAD.size + CODEC_BYTES + SIZE.size))
    first_ns, last_ns, size, checksum, named = CHUNK_HEAD.unpack_from(data)
    codec = str(data[CHUNK_HEAD.size : CHUNK_HEAD.size + named], "utf-8")
    (packed,) = SIZE.unpack_from(data, CHUNK_HEAD.size + named)
    at = start + CHUNK_HEAD.size + named + SIZE.size
    if at + packed > end:
        raise ValueError("a chunk's records reach beyond it")
    return ChunkHead(first_ns, last_ns, size, checksum, codec, at, packed)
