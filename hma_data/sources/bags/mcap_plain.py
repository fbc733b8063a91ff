"""Messages of MCAP chunks that are not packed, and of those outside of chunks, read again by place."""

from typing import BinaryIO

from hma_data.sources.bags.chunks import Buffer
from hma_data.sources.bags.mcap_records import (
    FRAME,
    LOOSE,
    MESSAGE_HEAD,
    ChunkHead,
    check,
    chunk_at,
    frame,
    message,
)


class PlainChunks:
    """Reads messages of one open file, each into the memory of the one before.

    Args:
        checked: offsets of the chunks whose checksum was looked at; more are added.
    """

    def __init__(self, file: BinaryIO, checked: set[int]) -> None:
        self._file, self._checked = file, checked
        self._buffer = Buffer()
        self._heads: dict[int, ChunkHead] = {}
        self._held: tuple[int, memoryview] | None = None  # the chunk that is in the buffer

    def has(self, offset: int) -> bool:
        """Whether the chunk at that offset is not packed."""
        if offset not in self._heads:
            self._heads = {offset: chunk_at(self._file, offset)}
        return self._heads[offset].plain

    def message(self, offset: int, at: int) -> memoryview:
        """The data of the message at that place, until the next is asked for.

        A chunk is read whole the first time, for its checksum; later only what is asked for.
        """
        if offset == LOOSE:
            _, length = frame(self._file, at)
            return self._buffer.read(self._file, length)[MESSAGE_HEAD.size :]
        head = self._heads[offset]
        if head.checksum and offset not in self._checked:
            self._file.seek(head.at)
            chunk = self._buffer.read(self._file, head.size)
            check(chunk, head)
            self._checked.add(offset)
            self._held = (offset, chunk)
        if self._held and self._held[0] == offset:
            return message(self._held[1], at)
        self._held = None
        _, length = frame(self._file, head.at + at)
        if at + FRAME.size + length > head.size:
            raise ValueError("a record reaches beyond its chunk")
        return self._buffer.read(self._file, length)[MESSAGE_HEAD.size :]
