"""Read a file of records, TFRecord or ArrayRecord: count the records, and return any of them.

The index is made once and kept on disk (see `record_index`); it grows only as far as it is needed.
"""

import os
import re
from functools import lru_cache
from pathlib import Path
from threading import RLock
from typing import Any

from hma_data.errors import EpisodeError
from hma_data.sources.base import file_fingerprint
from hma_data.sources.rlds import tfrecord
from hma_data.sources.rlds.array_record import read_record as read_array_record
from hma_data.sources.rlds.array_record import scan as scan_array_record
from hma_data.sources.rlds.record_index import EMPTY, Framing, drop_index, load_index, save_index
from hma_data.storage.fetch import attempt, info, is_local, mark, protocol

KEPT_FROM = 64  # least records of a local file for an index on disk; fewer are scanned just as fast
KEPT_EVERY = 32  # new records after which the index of a remote file is written again


class RecordFile:
    """One record file in one state: the object is valid while the file's size and date stay the same.

    Args:
        files: the fsspec file system.
        path: on it.
        size: bytes of the file.
        stamp: changes when the file does.
    """

    def __init__(self, files: Any, path: str, size: int, stamp: str) -> None:
        self._files, self._path, self._size, self._stamp = files, path, size, stamp
        self._scan, self._pick = tfrecord.scan, tfrecord.read_record
        if is_array_record(path):
            self._scan, self._pick = scan_array_record, read_array_record
        self._frames, self._kept, self._loaded, self._asked = EMPTY, 0, False, False
        self._lock = RLock()

    def framing(self, limit: int = -1) -> Framing:
        """Return where the records lie; for a remote file at least the first `limit`, -1 for all.

        Raises:
            SourceError: the file cannot be read, or is not of its format.
        """
        with self._lock:
            if not self._enough(limit) and not self._asked:
                self._load()
            if not self._enough(limit):
                stop = -1 if is_local(self._files) else limit
                self._frames = self._scan(self._files, self._path, self._size, self._frames, stop)
                self._keep()
            return self._frames

    def read(self, index: int, where: str) -> bytes:
        """Return the data of a record, with its checksum verified.

        Args:
            where: the episode, for the error.

        Raises:
            EpisodeError: there is no such record, or it is damaged.
            SourceError: the network fails.
        """
        try:
            return self._read(index, where)
        except EpisodeError:
            if not self._loaded:
                raise
        with self._lock:  # the index kept on disk may be wrong
            drop_index(self._name, self._mark)
            self._frames, self._loaded = EMPTY, False
        return self._read(index, where)

    def _read(self, index: int, where: str) -> bytes:
        frames = self.framing(index + 1)
        if index >= len(frames):
            raise EpisodeError(where, f"{self._path}: {frames.fault or f'ends after {len(frames)} records'}")
        return self._pick(self._files, self._path, frames, index, where)

    def _enough(self, limit: int) -> bool:
        return self._frames.whole or 0 <= limit <= len(self._frames)

    def _load(self) -> None:
        self._asked = True
        found = load_index(self._name, self._mark, self._size)
        if found:
            self._frames, self._kept, self._loaded = found, len(found), True

    def _keep(self) -> None:
        count = len(self._frames)
        if is_local(self._files):
            due = count >= KEPT_FROM and self._frames.whole
        else:
            due = self._frames.whole or count - self._kept >= KEPT_EVERY
        if due:
            save_index(self._name, self._mark, self._frames)
            self._kept = count

    @property
    def _name(self) -> str:
        path = os.path.realpath(self._path) if is_local(self._files) else self._path
        return f"{protocol(self._files)}://{path}"

    @property
    def _mark(self) -> str:
        """Return the file's stamp; for a local file also a sample of its content, which costs little."""
        if not is_local(self._files):
            return self._stamp
        return f"{self._stamp} {attempt(self._files, self._path, self._sample)}"

    def _sample(self) -> str:
        return file_fingerprint(Path(self._path))


def is_array_record(path: str) -> bool:
    """Check for an ArrayRecord file by its name, such as toy-train.array_record-00000-of-00001."""
    return re.search(r"\.array_?record\b", path.rsplit("/", 1)[-1]) is not None


def open_records(files: Any, path: str) -> RecordFile:
    """Return the record file at a path.

    It is cached for the process: a local file while its size and date stay the same, a remote one for good.

    Raises:
        SourceError: it is not there, or the file system does not answer.
    """
    if not is_local(files):
        return _open_remote(files, path, os.getpid())
    found = info(files, path)
    return _open(files, path, found["size"], mark(found), os.getpid())


@lru_cache(maxsize=4096)
def _open_remote(files: Any, path: str, pid: int) -> RecordFile:
    found = info(files, path)
    return RecordFile(files, path, found["size"], mark(found))


@lru_cache(maxsize=4096)
def _open(files: Any, path: str, size: int, stamp: str, pid: int) -> RecordFile:
    return RecordFile(files, path, size, stamp)
