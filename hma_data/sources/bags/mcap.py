"""MCAP files, read as the format's specification lays them out: https://mcap.dev/spec

Chunked or not, with or without summary. Read here rather than with the mcap package because that
package takes a short read for a whole record, and its reader fails on files whose summary does
not repeat the channels; places for random access come with it.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

from hma_data.sources.bags.chunks import WORTH, ChunkCache, Take, placed, reach
from hma_data.sources.bags.container import (
    Channel,
    Data,
    Place,
    Record,
    Wanted,
    damaged,
    reading,
)
from hma_data.sources.bags.mcap_index import (
    FOOTER_SIZE,
    Survey,
    entries,
    learn_summary,
    notes,
    stated_counts,
    survey,
)
from hma_data.sources.bags.mcap_plain import PlainChunks
from hma_data.sources.bags.mcap_records import (
    FRAME,
    LOOSE,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    Ask,
    Declared,
    between,
    load_begin,
    load_chunk,
    message,
)
from hma_data.sources.bags.pieces import last_before, overlapping


class McapFile:
    """One MCAP file; see Container.

    Args:
        chunks: where unpacked chunks are kept; shared by the files of a bag.
    """

    def __init__(self, path: Path, chunks: ChunkCache | None = None) -> None:
        self.path = path
        self._chunks = chunks or ChunkCache()
        self._surveyed: Survey | None = None
        self._notes: dict[str, str] | None = None
        self._checked: set[int] = set()
        self._told = False  # whether the summary tells every channel

    def counts(self) -> Counter[Channel]:
        """See Container."""
        with reading(self.path), self.path.open("rb") as file:
            found = stated_counts(file, self._data_end(file))
            self._told = found is not None
        if found is None:
            found = Counter(record.channel for record in self.records(Wanted()))
        return found

    def records(self, wanted: Wanted) -> Iterator[Record]:
        """See Container."""
        with reading(self.path), self.path.open("rb") as file:
            end = self._data_end(file)
            if not wanted.bounded:
                declared = Declared()
                if self._told:
                    learn_summary(file, end, declared)
                yield from between(file, len(MAGIC), end, declared, wanted, self._chunk)
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
        """All entries of the file's metadata records (MCAP specification, opcode 0x0C); later ones win."""
        if self._notes is None:
            with reading(self.path), self.path.open("rb") as file:
                self._notes = notes(file, self._data_end(file))
        return self._notes

    def payloads(self, places: Sequence[Place]) -> Iterator[Data]:
        """See Container."""
        with reading(self.path), self.path.open("rb") as file:
            plain = PlainChunks(file, self._checked)
            for chunk_offset, at in places:
                if chunk_offset == LOOSE or plain.has(chunk_offset):
                    yield plain.message(chunk_offset, at)
                else:
                    yield message(self._chunk(file, chunk_offset), at)

    def _chunk(self, file: BinaryIO, at: int, ask: Ask | None = None) -> memoryview:
        """A chunk, unpacked; its checksum is looked at the first time.

        Where pictures' heads will do and there is no room to keep it, what is asked for may be all of it.
        """
        if ask and ask.wanted.heads and self._told and not self._may_keep(at, ask.head.size):
            found = entries(file, ask, self._data_end(file))
            size = reach(found, ask.wanted, ask.head.size, FRAME.size + MESSAGE_HEAD.size) if found else None
            if found and size is not None and size < WORTH * ask.head.size:
                begin = load_begin(file, at, size, self._chunks.scratch)
                placed(found, begin, bytes([MESSAGE]), 1)
                return begin

        def load(take: Take) -> memoryview:
            chunk = load_chunk(file, at, take, at not in self._checked)
            self._checked.add(at)
            return chunk

        return self._chunks.get(self.path, at, load)

    def _may_keep(self, at: int, size: int) -> bool:
        return self._chunks.has(self.path, at) or self._chunks.room(size)

    def _survey(self, file: BinaryIO, end: int) -> Survey:
        if self._surveyed is None:
            self._surveyed = survey(file, end)
            self._notes = self._surveyed.notes
        return self._surveyed

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
