"""Read MCAP files as the format's specification lays them out: https://mcap.dev/spec

Chunked or not, with or without summary. Read here rather than with the mcap package because that
package takes a short read for a whole record, and its reader fails on files whose summary does
not repeat the channels; places for random access come with it.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
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
    reading,
)
from hma_data.sources.bags.mcap_records import (
    FOOTER_SIZE,
    LOOSE,
    MAGIC,
    ChunkHead,
    Declared,
    Survey,
    between,
    chunk_at,
    load_chunk,
    loose,
    message,
    stated_counts,
    survey,
)
from hma_data.sources.bags.time_index import last_before, overlapping


class McapFile:
    """Read one MCAP file; see Container.

    Args:
        chunks: where unpacked chunks are kept; shared by the files of a bag.
    """

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
        """Return a chunk, unpacked; check its checksum the first time. Only packed ones are kept."""
        if chunk_at(file, at).plain:
            return memoryview(self._load(file, at))
        return self._chunks.get(self.path, at, partial(self._load, file, at))

    def _load(self, file: BinaryIO, at: int) -> bytes:
        chunk = load_chunk(file, at, at not in self._checked)
        self._checked.add(at)
        return chunk

    def _survey(self, file: BinaryIO) -> Survey:
        if self._surveyed is None:
            self._surveyed = survey(file, self._data_end(file))
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
