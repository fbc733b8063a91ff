"""Index where the messages of a bag file lie, so that a time range is read without the rest.

A piece is a run of a file's records: one chunk, or messages outside of chunks. Its topics and its times of
receipt are known. A file has some thousands of pieces.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from hma_data.sources.bags.container import Record, Wanted


class Piece(NamedTuple):
    """The records from offset `at` to `end`.

    Attributes:
        first_ns, last_ns: earliest and latest receipt of its messages.
        topics: of its messages.
    """

    at: int
    end: int
    first_ns: int
    last_ns: int
    topics: frozenset[str]

    def holds(self, topics: frozenset[str] | None) -> bool:
        """Check whether it can hold a message of those topics."""
        return topics is None or not self.topics.isdisjoint(topics)


Load = Callable[[Piece, Wanted], Iterator[Record]]


def overlapping(pieces: Sequence[Piece], wanted: Wanted) -> Iterator[Piece]:
    """Yield the pieces that can hold wanted messages, in the file's order."""
    for piece in pieces:
        within = piece.first_ns <= wanted.last_ns and piece.last_ns >= wanted.first_ns
        if within and piece.holds(wanted.topics):
            yield piece


def last_before(
    pieces: Sequence[Piece], topics: frozenset[str], log_ns: int, load: Load
) -> dict[str, Record]:
    """Return each topic's last message received before a time; look back no further than needed."""
    found: dict[str, Record] = {}
    earlier = (piece for piece in pieces if piece.first_ns < log_ns and piece.holds(topics))
    for piece in sorted(earlier, key=lambda piece: piece.last_ns, reverse=True):
        newest = min(piece.last_ns, log_ns - 1)
        missing = frozenset(t for t in topics if t not in found or found[t].log_ns < newest)
        if not missing:
            break
        if piece.holds(missing):
            take_last(found, load(piece, Wanted(missing, last_ns=log_ns - 1)))
    return found


def take_last(found: dict[str, Record], records: Iterator[Record]) -> None:
    """Put the last message of each topic into `found`, with a copy of its bytes."""
    newest: dict[str, Record] = {}
    for record in records:
        topic = record.channel.topic
        if topic not in newest or newest[topic].log_ns <= record.log_ns:
            newest[topic] = record
    for topic, record in newest.items():
        if topic not in found or found[topic].log_ns <= record.log_ns:
            found[topic] = record._replace(data=bytes(record.data))
