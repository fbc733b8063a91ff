"""Read large remote files by blocks: the blocks ahead are fetched by threads, the last ones are kept.

A reader that knows which parts it will need says so (`Blocks.expect`). While it reads such a part, the next
blocks of expected parts are on their way. Blocks that nobody expects are fetched when they are read.

What a reader will need once more, such as the frames of an episode of which it looks for the times first,
it can keep until then. One cache serves all files of a process, so memory does not grow with their number or
size.
"""

import io
import itertools
import os
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from threading import Lock
from typing import Any, BinaryIO

import numpy as np

from hma_data.arrays import Ints

BLOCK = 1 << 20  # bytes of a request
BLOCKS_AHEAD = 32  # expected blocks on their way while one is read
BLOCKS_KEPT = 64  # blocks in memory
PART_BYTES = 256 << 20  # most bytes of parts in memory, such as frames, that will be read once more
REQUESTS = 16  # at once

Fetch = Callable[[int, int], bytes]  # (start, end) -> the bytes between them
_numbers = itertools.count()


class _Cache:
    """The blocks of one process, fetched or on their way, and the parts that its readers keep."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(REQUESTS, "hma-blocks")
        self._blocks: OrderedDict[tuple[int, int], Future[bytes]] = OrderedDict()
        self._parts: OrderedDict[tuple[int, Hashable], bytes] = OrderedDict()
        self._bytes = 0
        self._lock = Lock()

    def keep(self, key: tuple[int, Hashable], data: bytes) -> None:
        """Keep a part; those kept for longest are dropped."""
        with self._lock:
            self._bytes += len(data) - len(self._parts.pop(key, b""))
            self._parts[key] = data
            while self._bytes > PART_BYTES:
                self._bytes -= len(self._parts.popitem(last=False)[1])

    def take(self, key: tuple[int, Hashable]) -> bytes | None:
        """Return a part that was kept, and drop it; None where it is not there any more."""
        with self._lock:
            found = self._parts.pop(key, None)
            self._bytes -= len(found or b"")
        return found

    def want(self, key: tuple[int, int], load: Callable[[], bytes]) -> Future[bytes]:
        """Return a block, or begin to fetch it; blocks not wanted for longest are dropped."""
        with self._lock:
            if key in self._blocks:
                self._blocks.move_to_end(key)
            else:
                self._blocks[key] = self._pool.submit(load)
            found = self._blocks[key]
            while len(self._blocks) > BLOCKS_KEPT:
                self._blocks.popitem(last=False)
        return found

    def forget(self, key: tuple[int, int]) -> None:
        """Drop a block that could not be fetched, so that it is asked for again."""
        with self._lock:
            self._blocks.pop(key, None)


@lru_cache(maxsize=1)
def _cache(pid: int) -> _Cache:
    """Return the cache of this process; threads do not survive a fork."""
    return _Cache()


class Blocks:
    """A file of `size` bytes that is read by blocks.

    Args:
        fetch: reads a range of the file, in any thread.
    """

    def __init__(self, fetch: Fetch, size: int) -> None:
        self.size = size
        self._fetch = fetch
        self._number = next(_numbers)
        self._expected: Ints = np.zeros(0, np.int64)
        self._next: Blocks | None = None

    def expect(self, parts: Iterable[tuple[int, int]]) -> None:
        """Add parts, from offset to offset, to those that will be read, in the file's order."""
        blocks = [np.arange(start // BLOCK, -(-min(end, self.size) // BLOCK)) for start, end in parts]
        if blocks:
            self._expected = np.union1d(self._expected, np.concatenate(blocks))

    def expects(self, start: int) -> bool:
        """Check whether the byte at an offset lies in a part that was expected."""
        at = int(np.searchsorted(self._expected, start // BLOCK))
        return at < len(self._expected) and int(self._expected[at]) == start // BLOCK

    def follow(self, following: "Blocks | None") -> None:
        """State which file will be read after this one: near its end, the next one's blocks are fetched."""
        self._next = following

    def read(self, start: int, end: int) -> bytes:
        """Return the bytes from `start` up to `end`; fewer where the file ends before.

        Raises:
            HMAError: what `fetch` raises.
        """
        end = min(end, self.size)
        if start >= end:
            return b""
        numbers = range(start // BLOCK, (end - 1) // BLOCK + 1)
        pieces = []
        for number in numbers:
            self._prefetch(range(number + 1, min(number + 1 + BLOCKS_AHEAD, numbers.stop)))
            pieces.append(memoryview(self.block(number)))
        pieces[-1] = pieces[-1][: end - numbers[-1] * BLOCK]
        pieces[0] = pieces[0][start - numbers[0] * BLOCK :]
        return b"".join(pieces)

    def block(self, number: int) -> bytes:
        """Return a block, and let the expected blocks after it be fetched."""
        found = self._want(number)
        if self.expects(number * BLOCK):
            self._ahead(int(np.searchsorted(self._expected, number)) + 1, BLOCKS_AHEAD)
        if found.exception():  # waits for it
            _cache(os.getpid()).forget((self._number, number))
        return found.result()

    def keep(self, name: Hashable, data: bytes) -> None:
        """Keep a part of the file under a name, while there is room."""
        _cache(os.getpid()).keep((self._number, name), data)

    def take(self, name: Hashable) -> bytes | None:
        """Return the part of that name, which is then kept no longer; None where it is not kept."""
        return _cache(os.getpid()).take((self._number, name))

    def _ahead(self, at: int, count: int) -> None:
        """Begin to fetch the expected blocks from the `at`th on, here and in the files that follow."""
        here = self._expected[at : at + count]
        self._prefetch(here)
        if self._next and len(here) < count:
            self._next._ahead(0, count - len(here))

    def _prefetch(self, numbers: Iterable[int]) -> None:
        for number in numbers:
            self._want(int(number))

    def _want(self, number: int) -> Future[bytes]:
        start = number * BLOCK
        end = min(start + BLOCK, self.size)
        return _cache(os.getpid()).want((self._number, number), lambda: self._fetch(start, end))


class BlockFile(io.RawIOBase):
    """A position in a file that is read by blocks; as many as one likes share their blocks."""

    def __init__(self, blocks: Blocks) -> None:
        self.blocks = blocks
        self._at = 0
        self._begin, self._held = 0, b""  # the block that was read last

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self.blocks.size}[whence]
        return self._at

    def read(self, size: int | None = -1) -> bytes:
        """Return exactly `size` bytes, or fewer at the end of the file."""
        count = self.blocks.size if size is None or size < 0 else size
        number = self._at // BLOCK
        if self._at % BLOCK + count > BLOCK or self._at >= self.blocks.size:
            data = self.blocks.read(self._at, self._at + count)
        else:
            if self._begin != number * BLOCK or not self._held:
                self._begin, self._held = number * BLOCK, self.blocks.block(number)
            data = self._held[self._at - self._begin : self._at - self._begin + count]
        self._at += len(data)
        return data

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        data = self.read(len(view))
        view[: len(data)] = data
        return len(data)


def expect(file: BinaryIO, parts: Iterable[tuple[int, int]]) -> None:
    """State which parts of an open file will be read; it matters to remote files only."""
    if isinstance(file, BlockFile):
        file.blocks.expect(parts)
