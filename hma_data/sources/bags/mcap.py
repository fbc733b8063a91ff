"""Read MCAP files as the format's specification lays them out: https://mcap.dev/spec

Chunked or not, with or without summary. Read here rather than with the mcap package because that
package takes a short read for a whole record, and its reader fails on files whose summary does
not repeat the channels; places for random access come with it.

Counts are in the file's summary. Where messages lie in time is gathered from the heads of its chunks
and the message indexes behind them, which is sure also where the summary leaves it out.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import BinaryIO

from hma_data.sources.bags.container import (
    FOREVER,
    Channel,
    ChunkCache,
    Data,
    Fields,
    Place,
    Record,
    Wanted,
    damaged,
    read_exact,
    reading,
)
from hma_data.sources.bags.mcap_records import (
    CHANNEL,
    CHUNK,
    DATA_END,
    FOOTER,
    FRAME,
    LOOSE,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    METADATA,
    SCHEMA,
    STATISTICS,
    ChunkHead,
    Declared,
    between,
    chunk_at,
    chunk_head,
    frame,
    frames,
    load_chunk,
    loose,
    message,
    message_head,
)
from hma_data.sources.bags.time_index import Piece, last_before, overlapping

FOOTER_SIZE = FRAME.size + 20
NOTE_BYTES = 1 << 20  # a metadata record of more is not a note about the episode
RUN_BYTES = 1 << 20  # of messages outside of chunks that make one piece


class McapFile:
    """Read one MCAP file; see Container.

    Args:
        chunks: where unpacked chunks are kept; shared by the files of a bag.
    """

    def __init__(self, path: Path, chunks: ChunkCache | None = None) -> None:
        self.path = path
        self._chunks = chunks or ChunkCache()
        self._surveyed: Survey | None = None
        self._notes: dict[str, str] | None = None
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
            end = self._data_end(file)
            if not wanted.bounded:
                yield from between(file, len(MAGIC), end, Declared(), wanted, self._chunk)
                return
            survey = self._survey(file, end)
            for piece in overlapping(survey.pieces, wanted):
                yield from between(file, piece.at, piece.end, survey.declared, wanted, self._chunk)

    def before(self, topics: frozenset[str], log_ns: int) -> dict[str, Record]:
        """See Container."""
        with reading(self.path), self.path.open("rb") as file:
            survey = self._survey(file, self._data_end(file))
            return last_before(
                survey.pieces,
                topics,
                log_ns,
                lambda piece, wanted: between(
                    file, piece.at, piece.end, survey.declared, wanted, self._chunk
                ),
            )

    def notes(self) -> dict[str, str]:
        """Return all entries of the file's metadata records (opcode 0x0C); later ones win."""
        if self._notes is None:
            with reading(self.path), self.path.open("rb") as file:
                self._notes = notes(file, self._data_end(file))
        return self._notes

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
        """Return a chunk, unpacked; check its checksum the first time. Only packed ones are kept."""
        if chunk_at(file, at).plain:
            return memoryview(self._load(file, at))
        return self._chunks.get(self.path, at, partial(self._load, file, at))

    def _load(self, file: BinaryIO, at: int) -> bytes:
        chunk = load_chunk(file, at, at not in self._checked)
        self._checked.add(at)
        return chunk

    def _survey(self, file: BinaryIO, end: int) -> "Survey":
        if self._surveyed is None:
            self._surveyed = survey(file, end)
            self._notes = self._surveyed.notes
        return self._surveyed

    def _data_end(self, file: BinaryIO) -> int:
        """Return where the footer begins, once both ends are what they must be."""
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


# -- notes


def notes(file: BinaryIO, end: int) -> dict[str, str]:
    """Return all entries of the metadata records before `end`; later ones win."""
    found: dict[str, str] = {}
    for opcode, _, length in frames(file, len(MAGIC), end):
        if opcode == METADATA:
            found |= _note(file, length)
    return found


def _note(file: BinaryIO, length: int) -> dict[str, str]:
    """Return the entries of the metadata record whose content begins where the file stands."""
    if length > NOTE_BYTES:
        return {}
    fields = Fields(read_exact(file, length))
    fields.text()  # the record's name
    entries, found = Fields(fields.block()), {}
    while entries:
        key = entries.text()
        found[key] = entries.text()
    return found


# -- counts


def stated_counts(file: BinaryIO, end: int) -> Counter[Channel] | None:
    """Count the messages of each channel as the summary tells; None where it does not tell all of it."""
    start = _summary_start(file, end)
    if not start:
        return None
    declared, counted = Declared(), None
    for opcode, _, length in frames(file, start, end):
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
    """Return the messages by channel number in a Statistics record; None where they are left out."""
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
    """Hold a piece while it is surveyed; `channels` by number."""

    at: int
    end: int
    first_ns: int
    last_ns: int
    channels: set[int]
    chunk: bool


@dataclass(frozen=True)
class Survey:
    """Hold every piece of the file, the channels of their messages, and what `notes` gives."""

    pieces: list[Piece]
    declared: Declared
    notes: dict[str, str]


def survey(file: BinaryIO, end: int) -> Survey:
    """Walk once over the file's records; chunks are unpacked only where no index tells what is in them."""
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
    learn_summary(file, end, declared)
    kinds: dict[frozenset[str], frozenset[str]] = {}
    return Survey([_piece(file, part, declared, kinds) for part in parts], declared, noted)


def _add_loose(parts: list[_Part], at: int, end: int, number: int, log_ns: int) -> None:
    last = parts[-1] if parts else None
    if last is None or last.chunk or end - last.at > RUN_BYTES:
        parts.append(_Part(at, end, log_ns, log_ns, {number}, False))
        return
    last.end = end
    last.first_ns, last.last_ns = min(last.first_ns, log_ns), max(last.last_ns, log_ns)
    last.channels.add(number)


def learn_summary(file: BinaryIO, end: int, declared: Declared) -> None:
    """Take the schemas and channels that the summary repeats."""
    start = _summary_start(file, end)
    if not start:
        return
    for opcode, _, length in frames(file, start, end):
        if opcode in (SCHEMA, CHANNEL):
            try:
                declared.learn(opcode, read_exact(file, length))
            except ValueError:
                return  # the chunks themselves are asked for what is missing


def _piece(
    file: BinaryIO, part: _Part, declared: Declared, kinds: dict[frozenset[str], frozenset[str]]
) -> Piece:
    told = part.channels and part.last_ns and part.channels <= declared.channels.keys()
    if part.chunk and not told:
        return _unindexed(file, part, declared, kinds)
    topics = frozenset(declared.channel(number).topic for number in part.channels)
    return Piece(part.at, part.end, part.first_ns, part.last_ns, kinds.setdefault(topics, topics))


def _unindexed(
    file: BinaryIO, part: _Part, declared: Declared, kinds: dict[frozenset[str], frozenset[str]]
) -> Piece:
    """Look into a chunk without an index; its channels may be declared nowhere else."""
    first_ns, last_ns, topics = FOREVER, -1, set()
    for record in between(file, part.at, part.end, declared, Wanted(), load_chunk):
        first_ns, last_ns = min(first_ns, record.log_ns), max(last_ns, record.log_ns)
        topics.add(record.channel.topic)
    held = frozenset(topics)
    return Piece(part.at, part.end, first_ns, last_ns, kinds.setdefault(held, held))
