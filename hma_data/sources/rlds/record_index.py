"""Keep on disk where the records of a file lie, for the next process that opens the file.

An index is derived data and is always verified. It is bound to the file's path, size and mark (date, ETag,
and for local files a sample of the content). It carries its own checksum, and each record read through it
is checked against the file. A damaged, stale or foreign index is made again. Indexes lie in
`$HMA_CACHE/rlds`, by default `~/.cache/hma/rlds`; deleting one costs a new scan.

N records.
"""

import hashlib
import json
import logging
import os
import struct
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import google_crc32c
import numpy as np
from numpy.typing import NDArray

from hma_data.storage.files import PART, cache_folder

MAGIC = b"HMAindx1"
HEADER = struct.Struct("<8sIIQ")  # magic, checksum of what follows, bytes of JSON, records
ROW = 8 + 8 + 4
LONGEST = 1 << 30  # bytes of an index file; 50 million records

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Framing:
    """The positions of the records of a file.

    Attributes:
        offsets: (N,) int64, first byte of each record's data; in an ArrayRecord file the record's number.
        lengths: (N,) int64, bytes of data.
        checks: (N,) uint32, checksum of the data as stored.
        fault: why reading stopped after the last record; empty where the file ends there.
        whole: whether the file was read to its end (or to `fault`).
    """

    offsets: NDArray[np.int64]
    lengths: NDArray[np.int64]
    checks: NDArray[np.uint32]
    fault: str = ""
    whole: bool = True

    def __len__(self) -> int:
        return len(self.offsets)

    def fingerprint(self, index: int) -> str:
        """Return 24 hex digits that change with the record's content."""
        return f"{int(self.lengths[index]):016x}{int(self.checks[index]):08x}"


EMPTY = Framing(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.uint32), whole=False)


def index_path(path: str, mark: str) -> Path:
    """Return the path at which the index of a file is kept.

    Args:
        path: of the file, with its protocol.
        mark: changes when the file does.
    """
    digest = hashlib.sha256(f"{path}\n{mark}".encode()).hexdigest()[:32]
    return cache_folder() / "rlds" / f"{digest}.index"


def load_index(path: str, mark: str, size: int) -> Framing | None:
    """Return the index kept for a file; None where there is none that is whole and fits the file.

    Args:
        size: bytes of the file.
    """
    place = index_path(path, mark)
    try:
        if place.stat().st_size > LONGEST:
            return None
        data = place.read_bytes()
    except OSError:
        return None
    frames = _parse(data, path, mark)
    if frames is None or not _fits(frames, size):
        log.warning("%s: the index of %s is damaged and made again", place, path)
        return None
    return frames


def save_index(path: str, mark: str, frames: Framing) -> None:
    """Write an index to disk; log a failure and continue without it."""
    place = index_path(path, mark)
    about = json.dumps(
        {"path": path, "mark": mark, "fault": frames.fault, "whole": frames.whole}, sort_keys=True
    ).encode()
    columns = (frames.offsets.astype("<i8"), frames.lengths.astype("<i8"), frames.checks.astype("<u4"))
    body = about + b"".join(column.tobytes() for column in columns)
    head = HEADER.pack(MAGIC, google_crc32c.value(body), len(about), len(frames))
    part = place.with_name(f".{place.name}.{os.getpid()}{PART}")
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(head + body)
        part.replace(place)
    except OSError as fault:
        log.info("%s: the index of %s is not kept: %s", place, path, fault)
        with suppress(OSError):
            part.unlink(missing_ok=True)


def drop_index(path: str, mark: str) -> None:
    """Delete the index kept for a file."""
    try:
        index_path(path, mark).unlink(missing_ok=True)
    except OSError as fault:
        log.info("%s: cannot be removed: %s", index_path(path, mark), fault)


def _parse(data: bytes, path: str, mark: str) -> Framing | None:
    if len(data) < HEADER.size:
        return None
    magic, check, about_size, count = HEADER.unpack_from(data)
    start = HEADER.size + about_size
    if (
        magic != MAGIC
        or len(data) != start + count * ROW
        or google_crc32c.value(data[HEADER.size :]) != check
    ):
        return None
    about = json.loads(data[HEADER.size : start])
    if (about["path"], about["mark"]) != (path, mark):
        return None
    return Framing(
        np.frombuffer(data, "<i8", count, start).astype(np.int64),
        np.frombuffer(data, "<i8", count, start + 8 * count).astype(np.int64),
        np.frombuffer(data, "<u4", count, start + 16 * count).astype(np.uint32),
        about["fault"],
        about["whole"],
    )


def _fits(frames: Framing, size: int) -> bool:
    """Check whether the records ascend and all lie inside a file of that size."""
    if not len(frames):
        return True
    inside = frames.offsets.min() >= 0 and frames.lengths.min() >= 0 and frames.offsets.max() < size
    return bool(inside and (np.diff(frames.offsets) >= 0).all())
