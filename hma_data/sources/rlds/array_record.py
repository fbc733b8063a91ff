"""Read the records of ArrayRecord files of this machine, with the `array_record` package.

The package does not tell the offset of a record, so a record is found by its number.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np

from hma_data.errors import EpisodeError, MissingDependencyError, SourceError, install_command
from hma_data.sources.rlds.records import EMPTY, Framing, RecordFile
from hma_data.storage.fetch import is_local
from hma_data.storage.kinds import unreadable

RANDOM_ACCESS = "readahead_buffer_size:0,max_parallelism:0"  # as the package takes it


class ArrayRecordFile(RecordFile):
    """One ArrayRecord file; its framing has each record's number in place of the offset."""

    def _scanned(self, limit: int) -> Framing:
        """Read every record once; a damaged one gets length 0, and fails when it is read."""
        reader = self._reader()
        if not reader.ok():
            why = "is no ArrayRecord file"
            try:
                reader.read([0])  # its error says why
            except RuntimeError as error:
                why = str(error)
            fault, _ = unreadable(Path(self._path), why, "")
            return replace(EMPTY, fault=fault, whole=True)
        count = reader.num_records()
        lengths, checks = np.zeros(count, np.int64), np.zeros(count, np.uint32)
        for index in range(count):
            try:
                [data] = reader.read([index])
            except RuntimeError:
                continue
            lengths[index], checks[index] = len(data), google_crc32c.value(data)
        return Framing(np.arange(count, dtype=np.int64), lengths, checks)

    def _picked(self, frames: Framing, index: int, where: str) -> bytes:
        try:
            [data] = self._reader().read([index])
        except RuntimeError as fault:
            raise EpisodeError(where, f"cannot be read from {self._path}: {fault}") from fault
        return bytes(data)

    def _reader(self) -> Any:
        if not is_local(self._files):
            raise SourceError(self._path, "ArrayRecord is read from local disks only", "copy it here")
        try:
            from array_record.python.array_record_module import ArrayRecordReader
        except ImportError as fault:
            said = "ArrayRecord files need the package array-record"
            raise MissingDependencyError(self._path, said, install_command("arrayrecord")) from fault
        return ArrayRecordReader(self._path, RANDOM_ACCESS)
