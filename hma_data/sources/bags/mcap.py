"""Read MCAP files by the format's specification: https://mcap.dev/spec

Files may have chunks or not, and a summary or not. Of the mcap package only the parsers of records are used:
its readers take a short read for a whole record, fail on files whose summary does not repeat the channels,
and give no places for random access.

Counts and the index come from the file's summary. The chunks that the summary leaves out are found by a walk
over the file, and read.
"""

import struct
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from isal.isal_zlib import crc32
from mcap import records
from mcap.data_stream import ReadDataStream

from hma_data.sources.bags.container import (
    Channel,
    Chunks,
    FileIndex,
    FileView,
    IndexedFile,
    Piece,
    StoredMessage,
    View,
    damaged,
    decompress,
    without_index,
)
from hma_data.storage.blocks import expect

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = 0x02, 0x03, 0x04, 0x05, 0x06
CHUNK_INDEX, STATISTICS, METADATA, DATA_END = 0x08, 0x0B, 0x0C, 0x0F
FRAME = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
EMPTY_INDEX = FRAME.size + 6  # bytes of a message index without entries
FOOTER_SIZE = FRAME.size + 20
RUN_BYTES = 1 << 20  # most bytes of messages outside of chunks that make one piece


class McapFile(IndexedFile):
    """An MCAP file."""

    def __init__(self, path: Path, chunks: Chunks) -> None:
        super().__init__(path, chunks)
        self._schemas: dict[int, Any] = {}

    def notes(self) -> dict[str, str]:
        """Return all entries of the file's metadata records (opcode 0x0C); later ones win."""
        with self._opened() as (_, index):
            return index.notes

    def _view(self, file: BinaryIO, at: int, end: int | None = None) -> View:
        whole = FileView(file, 0, file.seek(0, 2))
        opcode, start, stop = _record(whole, at)
        if opcode != CHUNK:
            return FileView(file, at, end or len(whole))
        return memoryview(self._chunks.get((self.path, at), lambda: _unpacked(whole[start:stop])))

    def _messages(self, index: FileIndex, view: View, at: int = 0) -> Iterator[StoredMessage]:
        for opcode, place, start, end in _records(view, at, len(view)):
            if opcode == MESSAGE:
                yield _entry(view, place, start, end)
            elif opcode in (SCHEMA, CHANNEL):
                self._learn(index, opcode, bytes(view[start:end]))

    def _learn(self, index: FileIndex, opcode: int, data: bytes) -> None:
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
        """Return the offset of the footer, after checking that the file ends with the magic bytes."""
        size = file.seek(0, 2)
        end = size - len(MAGIC) - FOOTER_SIZE
        file.seek(size - len(MAGIC))
        if end < len(MAGIC) or file.read(len(MAGIC)) != MAGIC:
            raise damaged(self.path, "is cut off: it does not end with MCAP's magic bytes")
        return end

    def _summary(self, file: BinaryIO, end: int, index: FileIndex) -> dict[int, tuple[Piece, int]]:
        """Return the chunks that the summary describes; add its channels and counts to the index.

        Returns:
            By offset, each chunk and the offset after it and its message indexes.
        """
        view, chunks = FileView(file, 0, end + FOOTER_SIZE), dict[int, tuple[Piece, int]]()
        opcode, at, stop = _record(view, end)
        if opcode != FOOTER:
            raise ValueError("there is no footer at the end")
        start = records.Footer.read(_stream(view[at:stop])).summary_start
        expect(file, [(start, end)] if start else ())
        for opcode, _, at, stop in _records(view, start, end) if start else ():
            data = view[at:stop]
            if opcode in (SCHEMA, CHANNEL):
                with suppress(ValueError):  # it need not repeat schemas: the chunks hold the missing ones
                    self._learn(index, opcode, data)
            elif opcode == STATISTICS:
                stated = records.Statistics.read(_stream(data))
                counts = Counter[int](stated.channel_message_counts)
                index.counts = counts if counts.total() == stated.message_count else None
            elif opcode == CHUNK_INDEX:
                piece, after = _indexed_chunk(data)
                chunks[piece.at] = piece, after
        return chunks

    def _make_index(self, file: BinaryIO) -> FileIndex:
        """Walk over the file's records, past the chunks that the summary describes."""
        index = FileIndex()
        end = self._data_end(file)
        stated = self._summary(file, end, index)
        if not stated:
            without_index(self.path, file, end)
        view, at = FileView(file, 0, end), len(MAGIC)
        loose = False  # whether the last piece holds messages outside of chunks
        while at < end:
            if at in stated:
                piece, at = stated[at]
                loose = False
                if piece.channels and piece.last_ns and piece.channels <= index.channels.keys():
                    index.pieces.append(piece)
                else:  # only the chunk itself tells what it holds
                    self._look_into(file, index, piece.at, piece.end)
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
                self._look_into(file, index, place, at)
                loose = False
            elif opcode == MESSAGE:
                if not loose or at - index.pieces[-1].at > RUN_BYTES:
                    index.pieces.append(Piece(place, at))
                loose = True
                piece = index.pieces[-1].including(_entry(view, place, start, at))
                index.pieces[-1] = piece._replace(end=at)
        return index


def _indexed_chunk(data: bytes) -> tuple[Piece, int]:
    """Return the chunk that a record of the summary describes, and the offset after its message indexes."""
    found = records.ChunkIndex.read(_stream(data))
    at, end = found.chunk_start_offset, found.chunk_start_offset + found.chunk_length
    after = end + found.message_index_length
    bounds = sorted((*found.message_index_offsets.values(), after))
    # A writer may index channels that have no message in the chunk.
    channels = frozenset(
        number
        for number, offset in found.message_index_offsets.items()
        if offset < after and bounds[bisect_right(bounds, offset)] - offset > EMPTY_INDEX
    )
    piece = Piece(at, end, found.message_start_time, found.message_end_time, channels)
    return piece, max(after, at + FRAME.size)


def _unpacked(data: bytes) -> bytes:
    chunk = records.Chunk.read(_stream(data))
    unpacked = decompress(chunk.compression, chunk.data, chunk.uncompressed_size)
    if chunk.uncompressed_crc and crc32(unpacked) != chunk.uncompressed_crc:
        raise ValueError("a chunk's checksum does not fit its content")
    return unpacked


def _entry(view: View, at: int, start: int, end: int) -> StoredMessage:
    """Return the message whose content lies between `start` and `end`."""
    number, _, log_ns, _ = MESSAGE_HEAD.unpack(view[start : start + MESSAGE_HEAD.size])
    return StoredMessage(number, log_ns, at, start + MESSAGE_HEAD.size, end)


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
