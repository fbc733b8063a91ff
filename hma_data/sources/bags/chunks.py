"""Chunks of bags in memory: those unpacked are kept for a while, others are read into one buffer.

A scan for numbers unpacks a chunk, and so does the first picture out of it; between the two it is
kept while there is room. What there is no room for is unpacked by the scan as far as it must be.
Memory is used again wherever nobody looks at it any more: fresh pages cost as much as unpacking.
"""

import os
import threading
import weakref
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Mapping
from itertools import count
from mmap import MAP_ANONYMOUS, MAP_PRIVATE, mmap
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from hma_data.sources.bags.container import HEAD, Wanted, checked_size

CACHED_BYTES = 128 << 20  # of unpacked chunks, of all the bags a process reads
WORTH = 0.8  # of a chunk: where more has to be unpacked, all of it is
LARGE = 1 << 18  # bytes; memory of fewer is left to the allocator
GRAIN = 1 << 16  # large memory is a multiple of this, so that chunks of nearly one size fit each other's
Key = tuple[int, Path, int]
Take = Callable[[int], memoryview]
Memory = bytearray | mmap
_NOTHING = bytearray()


class _Kept:
    """The chunks unpacked last in this process, at most CACHED_BYTES of them (and always one)."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._chunks: OrderedDict[Key, Memory] = OrderedDict()
        self._sizes: dict[Key, int] = {}
        self._spare: list[Memory] = []
        self._dropped: deque[Iterable[Key]] = deque()
        self.bytes = 0  # of both

    def has(self, key: Key) -> bool:
        return key in self._chunks

    def take(self, key: Key) -> memoryview | None:
        with self._lock:
            if key not in self._chunks:
                return None
            self._chunks.move_to_end(key)
            return memoryview(self._chunks[key])[: self._sizes[key]]

    def put(self, key: Key, memory: Memory, size: int) -> None:
        with self._lock:
            self._forget(key)
            self._chunks[key], self._sizes[key] = memory, size
            self.bytes += len(memory)

    def memory(self, size: int) -> Memory:
        """At least so many bytes that nobody looks at; others go where there is no room for them."""
        needed = _rounded(size)
        with self._lock:
            self._sweep()
            for i, spare in enumerate(self._spare):
                if needed <= len(spare) <= 2 * needed:
                    self.bytes -= len(spare)
                    return self._spare.pop(i)
            while self.bytes + needed > CACHED_BYTES and self._spare:
                self.bytes -= len(self._spare.pop())
            while self.bytes + needed > CACHED_BYTES and self._chunks:
                memory = self._forget(next(iter(self._chunks)))
                if LARGE <= needed <= len(memory) <= 2 * needed and _unseen(memory):
                    return memory
        return _fresh(needed)

    def drop(self, keys: Iterable[Key]) -> None:
        """Those chunks are not needed again; their memory is.

        The garbage collector calls this at any moment, in a thread that holds the lock too: it never
        waits. What cannot be dropped now is dropped with the next keys, or when memory is asked for.
        """
        self._dropped.append(keys)
        if self._lock.acquire(blocking=False):
            try:
                self._sweep()
            finally:
                self._lock.release()

    def _sweep(self) -> None:
        while self._dropped:
            for key in self._dropped.popleft():
                memory = self._forget(key)
                if len(memory) >= LARGE and _unseen(memory):
                    self._spare.append(memory)
                    self.bytes += len(memory)

    def _forget(self, key: Key) -> Memory:
        memory = self._chunks.pop(key, _NOTHING)
        self._sizes.pop(key, None)
        self.bytes -= len(memory)
        return memory


def _fresh(size: int) -> Memory:
    """New memory, which takes room only as far as it is written to."""
    size = _rounded(checked_size(size))
    return bytearray(size) if size < LARGE else mmap(-1, size, flags=MAP_PRIVATE | MAP_ANONYMOUS)


def _rounded(size: int) -> int:
    return size if size < LARGE else -(-size // GRAIN) * GRAIN


def _unseen(memory: Memory) -> bool:
    """Whether there is no view of it: it could be resized."""
    try:
        if isinstance(memory, mmap):
            memory.resize(len(memory))
        else:
            memory.append(memory.pop())
    except (BufferError, IndexError, SystemError):  # seen, empty, or of a system that cannot resize
        return False
    return True


_kept = _Kept()
_numbers = count()


def _anew() -> None:
    """A child that was forked begins without: its parent's lock may have been held."""
    global _kept
    _kept = _Kept()


os.register_at_fork(after_in_child=_anew)


class ChunkCache:
    """The unpacked chunks of one bag; they are dropped with it."""

    def __init__(self) -> None:
        self._number = next(_numbers)
        self._sizes: dict[tuple[Path, int], int] = {}
        self._bytes = 0  # of all chunks that were put in
        self._scratch: Memory = _NOTHING
        weakref.finalize(self, _drop, self._number, self._sizes).atexit = False

    def get(self, path: Path, offset: int, load: Callable[[Take], memoryview]) -> memoryview:
        """The chunk at that offset of that file; where it is not kept from `load`, told where to put it."""
        key = (self._number, path, offset)
        chunk = _kept.take(key)
        if chunk is not None:
            return chunk
        taken: list[Memory] = []

        def take(size: int) -> memoryview:
            taken.append(_kept.memory(size))
            return memoryview(taken[-1])[:size]

        chunk = load(take)
        _kept.put(key, taken.pop(), len(chunk))
        self._bytes += len(chunk) - self._sizes.get((path, offset), 0)
        self._sizes[path, offset] = len(chunk)
        return chunk

    def has(self, path: Path, offset: int) -> bool:
        """Whether the chunk is kept."""
        return _kept.has((self._number, path, offset))

    def scratch(self, size: int) -> memoryview:
        """Memory for the beginning of a chunk that is not kept; another's where that is still looked at."""
        if len(self._scratch) < size or not _unseen(self._scratch):
            self._scratch = _fresh(size)
        return memoryview(self._scratch)[:size]

    def room(self, size: int) -> bool:
        """Whether a chunk of that size can be kept with all of this bag that was."""
        return self._bytes + size <= CACHED_BYTES


def _drop(number: int, sizes: dict[tuple[Path, int], int]) -> None:
    _kept.drop((number, path, offset) for path, offset in sizes)


class Buffer:
    """Memory that is read into again and again; what was read is there until the next time."""

    def __init__(self) -> None:
        self._memory = memoryview(_NOTHING)

    def read(self, file: BinaryIO, size: int) -> memoryview:
        """The next `size` bytes of the file.

        Raises:
            ValueError: more than MAX_CHUNK.
            EOFError: the file ends before.
        """
        checked_size(size)
        if size > len(self._memory):
            left = os.fstat(file.fileno()).st_size - file.tell()
            if size > left:
                raise EOFError(f"the file ends {size - left:,} bytes before a record does")
            self._memory = memoryview(_fresh(size))
        view = self._memory[:size]
        got: int = file.readinto(view)  # type: ignore[attr-defined]
        if got != size:
            raise EOFError(f"the file ends {size - got:,} bytes before a record does")
        return view


def placed(entries: Mapping[str, NDArray[np.uint64]], chunk: memoryview, mark: bytes, head: int) -> None:
    """Looks whether messages begin in the chunk where an index says, as far as it was unpacked.

    Args:
        entries: as `reach` takes them.
        mark: what a message has in its first `head` bytes.

    Raises:
        ValueError: one does not.
    """
    for found in entries.values():
        for at in found[found[:, 1] + np.uint64(head) <= len(chunk), 1].tolist():
            if mark not in bytes(chunk[at : at + head]):
                raise ValueError("an index tells another place of a message than its own")


def reach(entries: Mapping[str, NDArray[np.uint64]], wanted: Wanted, size: int, head: int) -> int:
    """How many bytes of a chunk have to be unpacked for the wanted messages in it.

    Args:
        entries: topic -> (n, 2) times and offsets of its messages, as a message index tells.
        size: of the chunk.
        head: bytes before a message's data.
    """
    offsets = np.sort(np.concatenate([found[:, 1] for found in entries.values()]))
    ends = 0
    for topic, found in entries.items():
        if not wanted.topic(topic):
            continue
        within = (found[:, 0] >= wanted.first_ns) & (found[:, 0] <= min(wanted.last_ns, 2**64 - 1))
        if not within.any():
            continue
        last = int(found[within, 1].max())
        following = int(np.searchsorted(offsets, last, side="right"))
        end = int(offsets[following]) if following < len(offsets) else size
        ends = max(ends, min(end, last + head + HEAD) if topic in wanted.heads else end)
    return min(ends, size)
