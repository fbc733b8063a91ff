"""TFRecord files: where each record lies, and its bytes, checked.

A record is its length (uint64), the masked CRC-32C of those eight bytes, the data, and the
masked CRC-32C of the data; all little endian (format: TensorFlow's TFRecord). Scanning reads
28 bytes a record, so any record of a large file is found without reading those before it.
"""

import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import google_crc32c
import numpy as np
from numpy.typing import NDArray

from hma_data.errors import EpisodeError, HMAError, SourceError

HEADER = struct.Struct("<QI")
FOOTER = struct.Struct("<I")


@dataclass(frozen=True)
class Framing:
    """Where the records of a file lie.

    Attributes:
        offsets: (N,) int64, first byte of each record's data.
        lengths: (N,) int64, bytes of data.
        checks: (N,) uint32, masked CRC-32C of the data as stored.
        fault: why nothing could be read after the last record; empty when the file ends there.
    """

    offsets: NDArray[np.int64]
    lengths: NDArray[np.int64]
    checks: NDArray[np.uint32]
    fault: str = ""

    def __len__(self) -> int:
        return len(self.offsets)

    def fingerprint(self, index: int) -> str:
        """Twenty-four hex digits that change with the record's content."""
        return f"{int(self.lengths[index]):016x}{int(self.checks[index]):08x}"


def masked_crc(data: bytes) -> int:
    """CRC-32C of the data, rotated by 15 bits and shifted by a constant as TFRecord stores it."""
    crc = google_crc32c.value(data)
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def framing(files: Any, path: str, limit: int = -1) -> Framing:
    """The framing of a file; kept for the process while size and date of the file stay the same.

    Args:
        files: the fsspec file system.
        path: on it.
        limit: stop after so many records; -1 for none.

    Raises:
        SourceError: the file cannot be read, or is not a TFRecord file at all.
    """
    try:
        info = files.info(path)
        stamp = next((str(info[key]) for key in ("mtime", "etag", "ETag", "updated") if info.get(key)), "")
        return _framing(files, path, info["size"], stamp, limit)
    except HMAError:
        raise
    except Exception as fault:  # file systems raise what they like
        raise SourceError(path, f"cannot be read: {fault}", "check the path and your access to it") from fault


@lru_cache(maxsize=4096)
def _framing(files: Any, path: str, size: int, stamp: str, limit: int) -> Framing:
    offsets: list[int] = []
    lengths: list[int] = []
    checks: list[int] = []
    position, fault = 0, ""
    with files.open(path, "rb", cache_type="none") as file:
        header = file.read(HEADER.size)
        if header[:2] == b"\x1f\x8b":
            raise SourceError(path, "is gzip-compressed", "decompress it: gunzip")
        while position < size and len(offsets) != limit:
            length, fault = _record_length(header, position, size)
            if fault:
                break
            data_end = position + HEADER.size + length
            file.seek(data_end)
            tail = file.read(FOOTER.size + HEADER.size)
            offsets.append(position + HEADER.size)
            lengths.append(length)
            checks.append(FOOTER.unpack_from(tail)[0])
            header, position = tail[FOOTER.size :], data_end + FOOTER.size
    return Framing(
        np.array(offsets, np.int64), np.array(lengths, np.int64), np.array(checks, np.uint32), fault
    )


def _record_length(header: bytes, position: int, size: int) -> tuple[int, str]:
    """Length of the record that begins at `position`, or why it cannot be known."""
    if len(header) < HEADER.size:
        return 0, f"cut off at byte {size}, within the header of the record at byte {position}"
    length, check = HEADER.unpack(header)
    if masked_crc(header[:8]) != check:
        return 0, f"the length of the record at byte {position} fails its checksum"
    if position + HEADER.size + length + FOOTER.size > size:
        return 0, f"cut off at byte {size}, within the {length} bytes of the record at byte {position}"
    return length, ""


def read_record(files: Any, path: str, frames: Framing, index: int, where: str) -> bytes:
    """The data of one record.

    Args:
        where: the episode, for the error.

    Raises:
        EpisodeError: it cannot be read, or fails its checksum.
    """
    start, length = int(frames.offsets[index]), int(frames.lengths[index])
    try:
        data: bytes = files.cat_file(path, start=start, end=start + length)
    except Exception as fault:  # file systems raise what they like
        raise EpisodeError(where, f"cannot be read from {path}: {fault}") from fault
    if len(data) != length:
        raise EpisodeError(where, f"{path} gives {len(data)} of {length} bytes at byte {start}")
    if masked_crc(data) != frames.checks[index]:
        raise EpisodeError(where, f"the {length} bytes at byte {start} of {path} fail their checksum")
    return data
