"""ArrayRecord files as TFDS writes them: Riegeli chunks with an index of chunks at the end.

The last 64 KiB hold a postscript that says where the footer lies; the footer is a chunk whose
records say where each chunk of data begins and how many records it has. Chunks are zstd or plain
("simple" chunks), cut by a block header of 24 bytes at every 64 KiB, and checked by HighwayHash.
(Source: Riegeli's file format specification, array_record's layout.proto.)
"""

import struct
from typing import Any, NamedTuple

import numpy as np

from hma_data.errors import EpisodeError, SourceError
from hma_data.sources.fetching import attempt, fetch, is_local
from hma_data.sources.highway_hash import highway_hash
from hma_data.sources.record_index import EMPTY, Framing
from hma_data.sources.tf_example import VARINT, fields, varint, varints
from hma_data.sources.tfrecord import Read, reader

BLOCK, BLOCK_HEADER, CHUNK_HEADER = 1 << 16, 24, 40
USABLE = BLOCK - BLOCK_HEADER
HEADER = struct.Struct("<QQQB7sQ")  # hash, data size, data hash, type, records, decoded size
MAGIC = 0x71930E704FDAE05E
SIMPLE, PLAIN, ZSTD = ord("r"), 0, ord("z")
OTHERS = {ord("b"): "brotli", ord("s"): "snappy"}
LONGEST = 1 << 30  # bytes of a chunk; more is a bomb or an error


class ChunkError(ValueError):
    """The bytes are no chunk, or not the chunk they should be."""


class Header(NamedTuple):
    """Of a chunk: bytes and hash of its data, its type, how many records, their bytes."""

    size: int
    hash: int
    type: int
    records: int
    decoded: int


def scan(files: Any, path: str, size: int, known: Framing = EMPTY, limit: int = -1) -> Framing:
    """The framing of a file from its footer; `known` and `limit` change nothing.

    Records of a chunk share its offset. Checks are of the chunk's hash; zero for a remote file, whose
    chunks are not looked at.

    Raises:
        SourceError: the file cannot be read.
    """
    try:
        with reader(files, path, size) as read:
            return attempt(files, path, lambda: _framing(read, size, is_local(files)))
    except SourceError as fault:
        if isinstance(fault.__cause__, ValueError):  # ChunkError, WireError
            return Framing(EMPTY.offsets, EMPTY.lengths, EMPTY.checks, str(fault.__cause__))
        raise


def read_record(files: Any, path: str, frames: Framing, index: int, where: str) -> bytes:
    """The data of one record, the hash of its chunk verified.

    Args:
        where: the episode, for the error.

    Raises:
        EpisodeError: it is damaged, or stored in a way that is not read here.
        SourceError: the network fails.
    """
    offset = int(frames.offsets[index])
    first = int(np.searchsorted(frames.offsets, offset, side="left"))
    try:
        records = _records(lambda start, end: fetch(files, path, start, end), offset)
        return records[index - first]
    except (ValueError, IndexError) as fault:
        raise EpisodeError(where, f"{path}: the chunk at byte {offset} is damaged: {fault}") from fault
    except SourceError as fault:
        if is_local(files):
            raise EpisodeError(where, f"cannot be read from {path}: {fault.fault}") from fault
        raise


def _framing(read: Read, size: int, look: bool) -> Framing:
    if size < BLOCK:
        raise ChunkError(f"has {size} bytes and no ArrayRecord footer: it is cut off, or none")
    postscript = _numbers(_records(read, size - BLOCK)[0])
    footer = postscript.get(1, size)
    if postscript.get(2) != MAGIC or footer >= size:
        raise ChunkError("its postscript is not an ArrayRecord's")
    rows = [_numbers(record) for record in _records(read, footer)[1:]]
    counts = np.array([row.get(3, 0) for row in rows], np.int64)
    offsets = np.array([row.get(1, 0) for row in rows], np.int64)
    if (counts < 1).any() or (counts > LONGEST).any() or counts.sum() > size or (offsets >= footer).any():
        raise ChunkError("its footer does not fit the file")
    lengths = np.array([row.get(2, 0) for row in rows], np.int64) // np.maximum(counts, 1)
    checks = [_header(read, int(offset)).hash & 0xFFFFFFFF if look else 0 for offset in offsets]
    return Framing(
        np.repeat(offsets, counts), np.repeat(lengths, counts), np.repeat(np.array(checks, np.uint32), counts)
    )


def _numbers(message: bytes) -> dict[int, int]:
    """Field number -> value of the integers in a message."""
    return {
        number: varint(message, *span)[0]
        for number, wire, span in fields(message, 0, len(message))
        if wire == VARINT
    }


def _records(read: Read, position: int) -> list[bytes]:
    """The records of the chunk that begins there, its hash verified."""
    header = _header(read, position)
    if header.size > LONGEST or header.decoded > LONGEST:
        raise ChunkError(f"it claims {max(header.size, header.decoded):,} bytes")
    data = _bytes(read, position, CHUNK_HEADER + header.size)[CHUNK_HEADER:]
    if highway_hash(data) != header.hash:
        raise ChunkError("its data fail their hash")
    if header.type != SIMPLE:
        raise ChunkError(
            f"it is of type {chr(header.type)!r}; only simple chunks are read, write it without transpose"
        )
    return _simple(data, header)


def _simple(data: bytes, header: Header) -> list[bytes]:
    """Record sizes, then the records themselves, each compressed or not."""
    compression, (sizes_bytes, start) = data[0], varint(data, 1, len(data))
    sizes = _plain(data[start : start + sizes_bytes], compression, 10 * header.records)
    values = _plain(data[start + sizes_bytes :], compression, header.decoded)
    lengths = varints(np.frombuffer(sizes, np.uint8))
    if len(lengths) != header.records or (lengths < 0).any() or lengths.sum() != len(values):
        raise ChunkError("its records do not fill it")
    ends = np.cumsum(lengths)
    return [values[end - length : end] for end, length in zip(ends.tolist(), lengths.tolist())]


def _plain(data: bytes, compression: int, limit: int) -> bytes:
    if compression == PLAIN:
        return data
    if compression != ZSTD:
        name = OTHERS.get(compression, f"type {compression}")
        raise ChunkError(f"it is compressed by {name}; zstd and none are read, write it with zstd")
    import zstandard

    size, start = varint(data, 0, len(data))
    if size > limit:
        raise ChunkError(f"it claims {size:,} bytes, its header says {limit:,}")
    try:
        if size and zstandard.frame_content_size(data[start:]) not in (-1, size):
            raise ChunkError("its sizes contradict each other")
        plain = zstandard.ZstdDecompressor().decompress(data[start:], max_output_size=size) if size else b""
    except zstandard.ZstdError as fault:
        raise ChunkError(str(fault)) from fault
    if len(plain) != size:
        raise ChunkError(f"it has {len(plain)} of {size} bytes")
    return plain


def _header(read: Read, position: int) -> Header:
    data = _bytes(read, position, CHUNK_HEADER)
    check, size, data_hash, kind, records, decoded = HEADER.unpack(data)
    if highway_hash(data[8:]) != check:
        raise ChunkError(f"there is no chunk at byte {position}")
    return Header(size, data_hash, kind, int.from_bytes(records, "little"), decoded)


def _bytes(read: Read, position: int, count: int) -> bytes:
    """`count` bytes of a chunk that begins at `position`, without the block headers between them."""
    blocks = (count + (position + USABLE - 1) % BLOCK) // USABLE
    data = read(position, position + count + blocks * BLOCK_HEADER)
    parts, at = [], 0
    while at < len(data):
        inside = (position + at) % BLOCK
        start = at + max(0, BLOCK_HEADER - inside)
        at = min(len(data), at + BLOCK - inside)
        parts.append(data[start:at])
    plain = b"".join(parts)
    if len(plain) != count:
        raise ChunkError(f"the file ends within the chunk at byte {position}")
    return plain
