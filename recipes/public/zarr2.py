"""Read arrays of Zarr's format 2 from a folder, without the zarr package.

    https://zarr-specs.readthedocs.io/en/latest/v2/v2.0.html
    https://github.com/Blosc/c-blosc/blob/main/README_CHUNK_FORMAT.rst

A folder holds `.zarray` (shape, chunks, type, compression) and a file for each chunk. Chunks are raw, zlib,
Zstandard, or Blosc frames of LZ4, zlib or Zstandard with or without byte shuffle: what zarr-python writes by
default, and what its users choose. Filters and other codecs are refused by name. Nothing here unpickles.

T rows of an array.
"""

import json
import math
import zlib
from collections.abc import Callable
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import lz4.block
import numpy as np
import zstandard
from numpy.typing import NDArray

from hma_data.errors import SourceError

MAX_BYTES = 1 << 30  # of a chunk, and of rows that are read together
MAX_OVERHEAD = 1 << 16  # bytes of a chunk's file above twice those of its values
HEADER = 16  # bytes of a Blosc frame
SHUFFLED, COPIED, BIT_SHUFFLED, WHOLE = 0x1, 0x2, 0x4, 0x10  # its flags
MAX_STREAMS, MIN_STREAM = 16, 128  # a block is split into a stream a byte of its type, within these limits
KINDS = "biuf"  # of numbers

Decompress = Callable[[bytes, int], bytes]


def _lz4(data: bytes, size: int) -> bytes:
    return bytes(lz4.block.decompress(data, uncompressed_size=size))


def _zlib(data: bytes, size: int) -> bytes:
    return zlib.decompressobj().decompress(data, size)


def _zstd(data: bytes, size: int) -> bytes:
    if (claimed := zstandard.frame_content_size(data)) > size:  # which would be allocated
        raise ValueError(f"a frame of {claimed} bytes, {size} are expected")
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)


BLOSC: dict[int, Decompress] = {1: _lz4, 3: _zlib, 4: _zstd}
BLOSC_NAMES = {0: "blosclz", 2: "snappy"}
DAMAGE = (
    OSError,
    ValueError,
    RuntimeError,
    IndexError,
    ZeroDivisionError,
    zlib.error,
    zstandard.ZstdError,
    lz4.block.LZ4BlockError,
)


class ZarrArray:
    """An array on disk.

    Attributes:
        shape, dtype: of the array.

    Raises:
        SourceError: it is not there, or has a form that is not read.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            facts = json.loads((folder / ".zarray").read_text())
            self.shape, self._chunks = _sides(facts["shape"]), _sides(facts["chunks"])
            self.dtype, self._codec = np.dtype(facts["dtype"]), (facts["compressor"] or {"id": None})["id"]
            self._empty = self.dtype.type(facts.get("fill_value") or 0)
            self._separator = {".": ".", "/": "/"}[facts.get("dimension_separator", ".")]
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as fault:
            said = f"is no array of Zarr's format 2 ({type(fault).__name__}: {fault})"
            raise SourceError(folder, said, "download the set again") from fault
        self._bytes = math.prod(self._chunks) * self.dtype.itemsize
        if facts.get("filters") or facts.get("order", "C") != "C" or self.dtype.kind not in KINDS:
            said = f"has filters {facts.get('filters')}, order {facts.get('order')}, type {self.dtype}"
            raise SourceError(folder, said, "convert it with the zarr package")
        if not 0 < self._bytes <= MAX_BYTES or len(self._chunks) != len(self.shape):
            raise SourceError(folder, f"has chunks {self._chunks} of shape {self.shape}", "download it again")
        self._read = lru_cache(4)(self._chunk)

    def __len__(self) -> int:
        return int(self.shape[0])

    def rows(self, start: int, stop: int) -> NDArray[Any]:
        """Return the rows (T, …) from `start` to before `stop`.

        Raises:
            SourceError: a chunk is damaged, or they have more than MAX_BYTES.
        """
        if (stop - start) * math.prod(self.shape[1:]) * self.dtype.itemsize > MAX_BYTES:
            said = f"has rows {start} to {stop} of shape {self.shape[1:]}, more than {MAX_BYTES:,} bytes"
            raise SourceError(self.folder, said, "download the set again")
        found = np.empty((stop - start, *self.shape[1:]), self.dtype)
        first = range(start // self._chunks[0], -(-stop // self._chunks[0]))
        others = [range(-(-side // chunk)) for side, chunk in zip(self.shape[1:], self._chunks[1:])]
        for at in product(first, *others):
            low = at[0] * self._chunks[0]
            begin, end = max(low, start), min(low + self._chunks[0], stop)
            into, taken = [slice(begin - start, end - start)], [slice(begin - low, end - low)]
            for index, chunk, side in zip(at[1:], self._chunks[1:], self.shape[1:]):
                into.append(slice(index * chunk, min((index + 1) * chunk, side)))
                taken.append(slice(0, min(chunk, side - index * chunk)))
            found[tuple(into)] = self._read(at)[tuple(taken)]
        return found

    def _chunk(self, at: tuple[int, ...]) -> NDArray[Any]:
        """Return a whole chunk; one that has no file is empty."""
        path = self.folder / self._separator.join(map(str, at))
        if not path.is_file():
            return np.full(self._chunks, self._empty, self.dtype)
        try:
            if path.stat().st_size > 2 * self._bytes + MAX_OVERHEAD:
                raise ValueError(f"{path.stat().st_size} bytes are stored, {self._bytes} are expected")
            data = self._decoded(path.read_bytes(), path)
            return np.frombuffer(data, self.dtype).reshape(self._chunks)
        except DAMAGE as fault:
            raise SourceError(path, f"is damaged: {fault}", "download the set again") from fault

    def _decoded(self, data: bytes, path: Path) -> bytes:
        codec = self._codec
        if codec is None:
            return data
        if codec == "blosc":
            return unblosc(data, self._bytes, path)
        if codec not in ("zlib", "zstd"):
            raise SourceError(path, f"is compressed by {codec}", "convert it with the zarr package")
        return (_zlib if codec == "zlib" else _zstd)(data, self._bytes)


def _sides(values: Any) -> tuple[int, ...]:
    """Return the sides of an array or of its chunks."""
    if not values or not all(isinstance(side, int) and side >= 0 for side in values):
        raise ValueError(f"sides {values}")
    return tuple(values)


def unblosc(data: bytes, size: int, path: Path) -> bytes:
    """Return the `size` bytes of a Blosc frame (c-blosc 1).

    Raises:
        SourceError: its codec or shuffle is not read here.
        ValueError: it is damaged.
    """
    flags, width = data[2], data[3]
    total, block, packed = np.frombuffer(data, "<u4", 3, 4).tolist()
    if total != size or packed > len(data):
        raise ValueError(f"a frame of {total} bytes, {len(data)} of {packed} stored; {size} are expected")
    if flags & COPIED:
        return data[HEADER : HEADER + size]
    decompress = BLOSC.get(flags >> 5)
    if decompress is None or flags & BIT_SHUFFLED:
        said = "bit shuffle" if decompress else BLOSC_NAMES.get(flags >> 5, str(flags >> 5))
        raise SourceError(path, f"is compressed by Blosc with {said}", "convert it with the zarr package")
    starts = np.frombuffer(data, "<i4", -(-size // block), HEADER).tolist()
    found = []
    for number, start in enumerate(starts):
        length = min(block, size - number * block)
        split = not flags & WHOLE and 1 < width <= MAX_STREAMS and block // width >= MIN_STREAM
        streams = width if split and length == block else 1
        made = _streams(data, start, length // streams, streams, decompress)
        found.append(_unshuffled(made, width) if flags & SHUFFLED and width > 1 else made)
    return b"".join(found)


def _streams(data: bytes, at: int, size: int, count: int, decompress: Decompress) -> bytes:
    """Return the streams of a block one after the other, each of `size` bytes behind its stored length."""
    found = []
    for _ in range(count):
        stored = int(np.frombuffer(data, "<i4", 1, at)[0])
        held = data[at + 4 : at + 4 + stored]
        found.append(held if stored == size else decompress(held, size))
        if stored < 0 or len(found[-1]) != size:
            raise ValueError(f"a stream of {len(found[-1])} bytes, {size} are expected")
        at += 4 + stored
    return b"".join(found)


def _unshuffled(data: bytes, width: int) -> bytes:
    """Return a block whose values were stored as all first bytes, all second bytes, …"""
    whole = len(data) // width * width
    values = np.frombuffer(data, np.uint8, whole).reshape(width, -1)
    return values.T.tobytes() + data[whole:]
