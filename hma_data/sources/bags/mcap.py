"""MCAP files, read as the format's specification lays them out: https://mcap.dev/spec

Chunked or not, with or without summary. Read here rather than with the mcap package because that
package takes a short read for a whole record, and its reader fails on files whose summary does
not repeat the channels; places for random access come with it.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

from hma_data.sources.bags.container import (
    Channel,
    ChunkCache,
    Data,
    Place,
    Record,
    Wanted,
    damaged,
    read_exact,
    reading,
)
from hma_data.sources.bags.mcap_index import FOOTER_SIZE, Survey, notes, stated_counts, survey
from hma_data.sources.bags.mcap_records import (
    FRAME,
    LOOSE,
    MAGIC,
    MESSAGE_HEAD,
    Declared,
    between,
    frame,
    load_chunk,
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
        """All entries of the file's metadata records (MCAP specification, opcode 0x0C); later ones win."""
        if self._notes is None:
            with reading(self.path), self.path.open("rb") as file:
                self._notes = notes(file, self._data_end(file))
        return self._notes

    def payloads(self, places: Sequence[Place]) -> Iterator[Data]:
        """See Container."""
        with reading(self.path), self.path.open("rb") as file:
            for chunk_at, at in places:
                if chunk_at == LOOSE:
                    _, length = frame(file, at)
                    yield read_exact(file, length)[MESSAGE_HEAD.size :]
                    continue
                chunk = self._chunk(file, chunk_at)
                _, length = FRAME.unpack_from(chunk, at)
                start = at + FRAME.size
                yield memoryview(chunk)[start + MESSAGE_HEAD.size : start + length]

    def _chunk(self, file: BinaryIO, at: int) -> bytes:
        """A chunk, unpacked; its checksum is looked at the first time."""

        def load() -> bytes:
            chunk = load_chunk(file, at, at not in self._checked)
            self._checked.add(at)
            return chunk

        return self._chunks.get(self.path, at, load)

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
