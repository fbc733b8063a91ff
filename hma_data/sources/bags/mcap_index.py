"""What an MCAP file tells of its messages before they are read.

Counts are in its summary. Where messages lie in time is gathered from the heads of its chunks and
the message indexes behind them, which is sure also where the summary leaves it out.
"""

from collections import Counter
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from hma_data.sources.bags.container import FOREVER, Channel, Fields, Wanted, read_exact
from hma_data.sources.bags.mcap_records import (
    CHANNEL,
    CHUNK,
    DATA_END,
    FOOTER,
    FRAME,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    METADATA,
    SCHEMA,
    STATISTICS,
    Ask,
    Declared,
    between,
    chunk_head,
    frame,
    frames,
    load_chunk,
    message_head,
)
from hma_data.sources.bags.pieces import Piece

FOOTER_SIZE = FRAME.size + 20
NOTE_BYTES = 1 << 20  # a metadata record of more is not a note about the episode
RUN_BYTES = 1 << 20  # of messages outside of chunks that make one piece


def notes(file: BinaryIO, end: int) -> dict[str, str]:
    """All entries of the metadata records before `end`; later ones win."""
    found: dict[str, str] = {}
    for opcode, _, length in frames(file, len(MAGIC), end):
        if opcode == METADATA:
            found |= _note(file, length)
    return found


def _note(file: BinaryIO, length: int) -> dict[str, str]:
    """The entries of the metadata record whose content begins where the file stands."""
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
    """Messages of each channel as the summary tells; None where it does not tell all of it."""
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
    """Offset of the summary; 0 where there is none."""
    opcode, length = frame(file, end)
    if opcode != FOOTER or length != FOOTER_SIZE - FRAME.size:
        raise ValueError("there is no footer at the end")
    start = int.from_bytes(file.read(8), "little")
    if start and not len(MAGIC) <= start <= end:
        raise ValueError("the summary is said to lie outside the file")
    return start


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


# -- places in time


@dataclass
class _Part:
    """A piece while it is surveyed; `channels` by number."""

    at: int
    end: int
    first_ns: int
    last_ns: int
    channels: set[int]
    chunk: bool


@dataclass(frozen=True)
class Survey:
    """Every piece of the file, the channels of their messages, and what `notes` gives."""

    pieces: list[Piece]
    declared: Declared
    notes: dict[str, str]


def survey(file: BinaryIO, end: int) -> Survey:
    """One walk over the file's records; chunks are unpacked only where no index tells what is in them."""
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


def entries(file: BinaryIO, ask: Ask, end: int) -> dict[str, NDArray[np.uint64]] | None:
    """Topic -> (n, 2) times and offsets of its messages in a chunk, by the message indexes behind it.

    None where there are none, or of a channel that is not declared.
    """
    found: dict[str, list[NDArray[np.uint64]]] = {}
    for opcode, _, length in frames(file, ask.after, end):
        if opcode != MESSAGE_INDEX:
            break
        fields = Fields(read_exact(file, length))
        number = fields.number(2)
        if number not in ask.declared.channels:
            return None
        times = np.frombuffer(fields.block(), "<u8").reshape(-1, 2).astype(np.uint64)
        found.setdefault(ask.declared.channels[number].topic, []).append(times)
    return {topic: np.concatenate(parts) for topic, parts in found.items()} or None


def _add_loose(parts: list[_Part], at: int, end: int, number: int, log_ns: int) -> None:
    last = parts[-1] if parts else None
    if last is None or last.chunk or end - last.at > RUN_BYTES:
        parts.append(_Part(at, end, log_ns, log_ns, {number}, False))
        return
    last.end = end
    last.first_ns, last.last_ns = min(last.first_ns, log_ns), max(last.last_ns, log_ns)
    last.channels.add(number)


def learn_summary(file: BinaryIO, end: int, declared: Declared) -> None:
    """Takes the schemas and channels that the summary repeats."""
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
    """A chunk that has to be looked into; its channels may be declared nowhere else."""
    first_ns, last_ns, topics = FOREVER, -1, set()
    for record in between(file, part.at, part.end, declared, Wanted(), _whole):
        first_ns, last_ns = min(first_ns, record.log_ns), max(last_ns, record.log_ns)
        topics.add(record.channel.topic)
    held = frozenset(topics)
    return Piece(part.at, part.end, first_ns, last_ns, kinds.setdefault(held, held))


def _whole(file: BinaryIO, at: int, ask: Ask | None) -> memoryview:
    return load_chunk(file, at)
