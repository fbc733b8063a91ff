"""Write one shard from the rows of whole episodes; the file is complete or absent."""

from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hma_data.arrays import Array
from hma_data.shards.schema import GROUP_VALUES, ROW_GROUP, Footer, encodings, to_arrow, token_column
from hma_data.storage.files import atomic_path, file_sha256
from hma_data.tokenizers.base import TokenizerSpec


class ShardWriter:
    """A context manager that writes a shard: `add` episodes, then `close` with the footer.

    Without `close`, no file is left.

    Attributes:
        rows: number of rows added so far.
        bytes, sha256: size and SHA-256 of the file, set by `close`.
    """

    def __init__(self, path: Path, schema: pa.Schema, spec: TokenizerSpec) -> None:
        self._path = path
        self._schema, (tokens, values) = schema, token_column(spec)
        values *= sum(name.startswith(tokens) for name in schema.names)  # of all cameras
        self._group = min(ROW_GROUP, max(GROUP_VALUES // values, 1))  # rows
        self._pending: list[pa.Table] = []
        self._closed = False
        self.rows = self.bytes = 0
        self.sha256 = ""

    def __enter__(self) -> "ShardWriter":
        with ExitStack() as opening:
            self._part = opening.enter_context(atomic_path(self._path))
            self._writer = pq.ParquetWriter(
                self._part,
                self._schema,
                compression="zstd",
                compression_level=6,  # 1 % smaller than 3, half its speed: far faster than any tokenizer
                data_page_size=4 << 20,
                use_dictionary=False,
                column_encoding=encodings(self._schema),
                write_statistics=["episode_index", "frame_index"],
                write_page_checksum=True,  # a damaged page is detected even if the manifest is lost
                store_schema=True,
            )
            self._atomic = opening.pop_all()
        return self

    def add(self, episode_index: int, columns: Mapping[str, Array | None]) -> None:
        """Append an episode; a row group holds whole episodes if they fit.

        Args:
            episode_index: number of the episode in the plan.
            columns: (T, …) values of the schema's columns; the two indexes are filled in, and so is a mask
                that is missing or None, because all is known. What the schema lacks is left out.
        """
        numbered = {name: values for name, values in columns.items() if values is not None}
        length = len(numbered["timestamp"])
        numbered["episode_index"] = np.full(length, episode_index, np.int32)
        numbered["frame_index"] = np.arange(length, dtype=np.int32)
        for mask in ("action_known", "state_known"):
            numbered.setdefault(mask, np.ones(length, np.bool_))
        arrays = [to_arrow(field, numbered[field.name]) for field in self._schema]
        table = pa.table(arrays, schema=self._schema)
        if self._pending and sum(map(len, self._pending)) + length > self._group:
            self._flush()
        self._pending.append(table)
        self.rows += length

    def _flush(self) -> None:
        table = pa.concat_tables(self._pending).combine_chunks()
        for start in range(0, len(table), self._group):
            self._writer.write_table(table.slice(start, self._group), row_group_size=self._group)
        self._pending = []

    def close(self, footer: Footer) -> None:
        """Write the pending rows and the footer; the shard gets its name when the `with` block ends."""
        if self._pending:
            self._flush()
        self._writer.add_key_value_metadata(footer.to_metadata())
        self._writer.close()
        self._closed = True
        self.bytes, self.sha256 = self._part.stat().st_size, file_sha256(self._part)  # it is still in memory

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._closed:
            with suppress(OSError):  # a full disk refuses the footer too: the first error counts
                self._writer.close()
            if kind is None:
                kind, fault = RuntimeError, RuntimeError("a shard was left without its footer")
        self._atomic.__exit__(kind, fault, trace)
