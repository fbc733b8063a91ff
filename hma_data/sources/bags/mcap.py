"""Read MCAP files by the format's specification: https://mcap.dev/spec

Files may have chunks or not, and a summary or not. The mcap package is not used: it takes a short read for a
whole record, its reader fails on files whose summary does not repeat the channels, and it gives no places for
random access.

Chunks that are not packed need not be read whole: their records are walked in the file itself. Counts come
from the file's summary. The time index comes from the heads of the chunks and the message indexes behind
them, which also works where the summary leaves the index out.
"""

import struct
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import BinaryIO, NamedTuple

from isal.isal_zlib import crc32

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
from hma_data.sources.bags.time_index import Piece, last_before, overlapping

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07
STATISTICS, METADATA, DATA_END = 0x0B, 0x0C, 0x0F
FRAME = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
LOOSE = -1  # the chunk's offset in the place of a message that is in no chunk
FOOTER_SIZE = FRAME.size + 20
NOTE_BYTES = 1 << 20  # most bytes of a metadata record that is read as a note about the episode
RUN_BYTES = 1 << 20  # most bytes of messages outside of chunks that make one piece
CODEC_BYTES = 32  # most bytes of a codec's name


class McapFile:
    """Read one MCAP file; its packed chunks are kept unpacked in `chunks`. See Container."""

    def __init__(self, path: Path, chunks: ChunkCache | None = None) -> None:
        self.path = path
        self._chunks = chunks or ChunkCache()
        self._surveyed: Survey | None = None
        self._checked: set[int] = set()

    def counts(self) -> Counter[Channel]:
        """See Container."""
        with reading(self.path), self.path.open("rb") as file:
            found = stated_counts(file, self._data_end(file))
        if found is None:
            found = Counter(record.channel for record in self.records(Wanted()))
        return found

    def records(self, wanted: Wanted) -> Iterator[Record]:
        """See Container."""
        with reading(self.path), self.path.open("rb") as file:
            if not wanted.bounded:
                end = self._data_end(file)
                yield from between(file, len(MAGIC), end, Declared(), wanted, self._chunk)
                return
            index = self._survey(file)
            for piece in overlapping(index.pieces, wanted):
                yield from between(file, piece.at, piece.end, index.declared, wanted, self._chunk)

    def before(self, topics: frozenset[str], log_ns: int) -> dict[str, Record]:
        """See Container."""
        with reading(self.path), self.path.open("rb") as file:
            index = self._survey(file)
            return last_before(
                index.pieces,
                topics,
                log_ns,
                lambda piece, wanted: between(file, piece.at, piece.end, index.declared, wanted, self._chunk),
            )

    def notes(self) -> dict[str, str]:
        """Return all entries of the file's metadata records (opcode 0x0C); later ones win."""
        with reading(self.path), self.path.open("rb") as file:
            return self._survey(file).notes

    def payloads(self, places: Sequence[Place]) -> Iterator[Data]:
        """See Container."""
        with reading(self.path), self.path.open("rb") as file:
            heads: dict[int, ChunkHead] = {}
            for offset, at in places:
                if offset == LOOSE:
                    yield loose(file, at)
                    continue
                if offset not in heads:
                    heads = {offset: chunk_at(file, offset)}
                if heads[offset].plain and offset in self._checked:
                    yield loose(file, heads[offset].at + at)
                else:
                    yield message(self._chunk(file, offset), at)

    def _chunk(self, file: BinaryIO, at: int) -> memoryview:
        """Return an unpacked chunk; check its checksum the first time. Only packed chunks are cached."""
        if chunk_at(file, at).plain:
            return memoryview(self._load(file, at))
        return self._chunks.get(self.path, at, partial(self._load, file, at))

    def _load(self, file: BinaryIO, at: int) -> bytes:
        chunk = load_chunk(file, at, at not in self._checked)
        self._checked.add(at)
        return chunk

    def _survey(self, file: BinaryIO) -> "Survey":
        if self._surveyed is None:
            self._surveyed = survey(file, self._data_end(file))
        return self._surveyed

    def _data_end(self, file: BinaryIO) -> int:
        """Return the offset of the footer, after checking both ends of the file."""
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


# -- records


class Declared:
    """Keep the schemas and channels read so far."""

    def __init__(self) -> None:
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        self.channels: dict[int, Channel] = {}

    def learn(self, opcode: int, data: Data) -> None:
        """Add a schema or channel record."""
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
        """Return the channel of that number."""
        if number not in self.channels:
            raise ValueError(f"a message is on channel {number}, which is not declared")
        return self.channels[number]


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


Load = Callable[[BinaryIO, int], Data]


def frame(file: BinaryIO, at: int) -> tuple[int, int]:
    """Return opcode and length of the record at `at`; leave the file at the record's content."""
    file.seek(at)
    opcode, length = FRAME.unpack(read_exact(file, FRAME.size))
    return opcode, length


def frames(file: BinaryIO, at: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, offset, length) of the records from `at` to `end`, with the file at the content."""
    while at < end:
        opcode, length = frame(file, at)
        following = at + FRAME.size + length
        if following > end:
            raise EOFError(f"the file ends {following - end:,} bytes before a record does")
        yield opcode, at, length
        at = following


def between(
    file: BinaryIO,
    at: int,
    end: int,
    declared: Declared,
    wanted: Wanted,
    load: Load,
    chunk: Place = (LOOSE, 0),
) -> Iterator[Record]:
    """Yield the wanted messages from offset `at` to `end`; of other messages, read only the head.

    Args:
        load: unpacks a chunk.
        chunk: offsets of the chunk and of its records, where a chunk stored uncompressed is walked.
    """
    for opcode, offset, length in frames(file, at, end):
        if opcode in (DATA_END, FOOTER):
            return
        if opcode == CHUNK:
            yield from _in_chunk(file, offset, length, declared, wanted, load)
        elif opcode in (SCHEMA, CHANNEL):
            declared.learn(opcode, read_exact(file, length))
        elif opcode == MESSAGE:
            record = _loose(file, length, (chunk[0], offset - chunk[1]), declared, wanted)
            if record:
                yield record


def message_head(body: Data) -> tuple[int, int]:
    """Return the number of the channel, and the log time."""
    if len(body) < MESSAGE_HEAD.size:
        raise ValueError("a message ends too soon")
    channel, _, log_ns, _ = MESSAGE_HEAD.unpack_from(body)
    return channel, log_ns


def chunk_head(file: BinaryIO, length: int) -> ChunkHead:
    """Return the head of the chunk whose content begins at the file's position."""
    start = file.tell()
    fields = Fields(read_exact(file, min(length, 40 + CODEC_BYTES)))
    first_ns, last_ns = fields.number(8), fields.number(8)
    size, checksum = fields.number(8), fields.number(4)
    codec = fields.text()
    packed = fields.number(8)
    at = start + 8 + 8 + 8 + 4 + 4 + len(codec.encode()) + 8
    if at + packed > start + length:
        raise ValueError("a record ends too soon")
    return ChunkHead(first_ns, last_ns, size, checksum, codec, at, packed)


def load_chunk(file: BinaryIO, at: int, checked: bool = True) -> bytes:
    """Return the unpacked records of the chunk at an offset; `checked` compares them with its checksum."""
    head = chunk_at(file, at)
    file.seek(head.at)
    chunk = decompress(head.codec, read_exact(file, head.packed), head.size)
    if checked and head.checksum and crc32(chunk) != head.checksum:
        raise ValueError("a chunk's checksum does not fit its content")
    return chunk


def message(chunk: memoryview, at: int) -> memoryview:
    """Return the data of the message at a place in a chunk."""
    _, length = FRAME.unpack_from(chunk, at)
    end = at + FRAME.size + length
    if end > len(chunk):
        raise ValueError("a record reaches beyond its chunk")
    return chunk[at + FRAME.size + MESSAGE_HEAD.size : end]


def loose(file: BinaryIO, at: int) -> Data:
    """Return the data of the message at an offset of the file."""
    _, length = frame(file, at)
    return memoryview(read_exact(file, length))[MESSAGE_HEAD.size :]


def chunk_at(file: BinaryIO, at: int) -> ChunkHead:
    """Return the head of the chunk at an offset."""
    opcode, length = frame(file, at)
    if opcode != CHUNK:
        raise ValueError(f"there is no chunk at {at:,}")
    return chunk_head(file, length)


def _in_chunk(
    file: BinaryIO, at: int, length: int, declared: Declared, wanted: Wanted, load: Load
) -> Iterator[Record]:
    head = chunk_head(file, length)
    if not (head.plain and wanted.heads):
        yield from _in_records(memoryview(load(file, at)), at, declared, wanted)
        return
    heads: set[bool] = set()
    for record in between(file, head.at, head.at + head.size, declared, wanted, load, (at, head.at)):
        heads.add(record.channel.topic in wanted.heads)
        yield record
    if head.checksum and heads == {False}:  # a chunk with a picture is checked when the picture is read
        load(file, at)


def _in_records(chunk: memoryview, chunk_at: int, declared: Declared, wanted: Wanted) -> Iterator[Record]:
    at = 0
    while at < len(chunk):
        opcode, length = FRAME.unpack_from(chunk, at)
        start, following = at + FRAME.size, at + FRAME.size + length
        if following > len(chunk):
            raise ValueError("a record reaches beyond its chunk")
        if opcode == MESSAGE:
            number, log_ns = message_head(chunk[start:following])
            channel = declared.channel(number)
            if wanted.topic(channel.topic) and wanted.time(log_ns):
                yield Record(channel, log_ns, chunk[start + MESSAGE_HEAD.size : following], (chunk_at, at))
        elif opcode in (SCHEMA, CHANNEL):
            declared.learn(opcode, chunk[start:following])
        at = following


def _loose(file: BinaryIO, length: int, place: Place, declared: Declared, wanted: Wanted) -> Record | None:
    """Return the message whose content begins at the file's position, if it is wanted."""
    head = read_exact(file, min(length, MESSAGE_HEAD.size + HEAD))
    number, log_ns = message_head(head)
    channel = declared.channel(number)
    if not (wanted.topic(channel.topic) and wanted.time(log_ns)):
        return None
    if channel.topic not in wanted.heads and length > len(head):
        head += read_exact(file, length - len(head))
    return Record(channel, log_ns, memoryview(head)[MESSAGE_HEAD.size :], place)


# -- summary


def stated_counts(file: BinaryIO, end: int) -> Counter[Channel] | None:
    """Count the messages of each channel from the summary; None where it does not state all of them."""
    declared = Declared()
    counted = summary(file, end, declared)
    if counted is None or not counted.keys() <= declared.channels.keys():
        return None
    total: Counter[Channel] = Counter()
    for number, channel in declared.channels.items():
        total[channel] += counted.get(number, 0)
    return total


def summary(file: BinaryIO, end: int, declared: Declared) -> dict[int, int] | None:
    """Learn the schemas and channels in the summary; return the messages by channel number.

    None where the summary does not state them.
    """
    start, counted = _summary_start(file, end), None
    for opcode, _, length in frames(file, start, end) if start else ():
        if opcode in (SCHEMA, CHANNEL):
            try:
                declared.learn(opcode, read_exact(file, length))
            except ValueError:  # the summary need not repeat schemas; the chunks hold the missing ones
                return None
        elif opcode == STATISTICS:
            counted = _counted(read_exact(file, length))
    return counted


def _summary_start(file: BinaryIO, end: int) -> int:
    """Return the offset of the summary; 0 where there is none."""
    opcode, length = frame(file, end)
    if opcode != FOOTER or length != FOOTER_SIZE - FRAME.size:
        raise ValueError("there is no footer at the end")
    start = int.from_bytes(file.read(8), "little")
    if start and not len(MAGIC) <= start <= end:
        raise ValueError("the summary is said to lie outside the file")
    return start


def _counted(data: bytes) -> dict[int, int] | None:
    """Return the messages by channel number in a Statistics record; None where it leaves them out."""
    fields = Fields(data)
    messages = fields.number(8)
    fields.take(2 + 4 + 4 + 4 + 4 + 8 + 8)
    entries = Fields(fields.block())
    counts = {}
    while entries:
        number = entries.number(2)
        counts[number] = entries.number(8)
    return counts if sum(counts.values()) == messages else None


# -- places in time


@dataclass
class _Part:
    """A piece while it is surveyed, with its channels by number."""

    at: int
    end: int
    first_ns: int
    last_ns: int
    channels: set[int]
    chunk: bool


@dataclass(frozen=True)
class Survey:
    """All pieces of the file, the channels of their messages, and the result of `notes`."""

    pieces: list[Piece]
    declared: Declared
    notes: dict[str, str]


def survey(file: BinaryIO, end: int) -> Survey:
    """Walk once over the file's records, and gather its pieces, channels and notes.

    Chunks are unpacked only where no index states what they hold.
    """
    declared = Declared()
    parts: list[_Part] = []
    noted: dict[str, str] = {}
    for opcode, at, length in frames(file, len(MAGIC), end):
        if opcode in (DATA_END, FOOTER):
            break
        if opcode in (SCHEMA, CHANNEL):
            declared.learn(opcode, read_exact(file, length))
        elif opcode == METADATA:
            noted |= _note(file, length)
        elif opcode == CHUNK:
            head = chunk_head(file, length)
            parts.append(_Part(at, at + FRAME.size + length, head.first_ns, head.last_ns, set(), True))
        elif opcode == MESSAGE_INDEX and parts and parts[-1].chunk:
            fields = Fields(read_exact(file, min(length, 6)))
            number = fields.number(2)
            if fields.number(4):
                parts[-1].channels.add(number)
        elif opcode == MESSAGE:
            number, log_ns = message_head(read_exact(file, min(length, MESSAGE_HEAD.size)))
            _add_loose(parts, at, at + FRAME.size + length, number, log_ns)
    summary(file, end, declared)
    return Survey([_piece(file, part, declared) for part in parts], declared, noted)


def _note(file: BinaryIO, length: int) -> dict[str, str]:
    """Return the entries of the metadata record whose content begins at the file's position."""
    if length > NOTE_BYTES:
        return {}
    fields = Fields(read_exact(file, length))
    fields.text()  # the record's name
    entries, found = Fields(fields.block()), {}
    while entries:
        key = entries.text()
        found[key] = entries.text()
    return found


def _add_loose(parts: list[_Part], at: int, end: int, number: int, log_ns: int) -> None:
    last = parts[-1] if parts else None
    if last is None or last.chunk or end - last.at > RUN_BYTES:
        parts.append(_Part(at, end, log_ns, log_ns, {number}, False))
        return
    last.end = end
    last.first_ns, last.last_ns = min(last.first_ns, log_ns), max(last.last_ns, log_ns)
    last.channels.add(number)


def _piece(file: BinaryIO, part: _Part, declared: Declared) -> Piece:
    told = part.channels and part.last_ns and part.channels <= declared.channels.keys()
    if told or not part.chunk:
        topics = {declared.channel(number).topic for number in part.channels}
        return Piece(part.at, part.end, part.first_ns, part.last_ns, frozenset(topics))
    first_ns, last_ns, topics = FOREVER, -1, set()  # no index: only the chunk may declare its channels
    for record in between(file, part.at, part.end, declared, Wanted(), load_chunk):
        first_ns, last_ns = min(first_ns, record.log_ns), max(last_ns, record.log_ns)
        topics.add(record.channel.topic)
    return Piece(part.at, part.end, first_ns, last_ns, frozenset(topics))
