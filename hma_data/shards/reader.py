"""Read a shard set: its episodes and its rows, one row group at a time.

Whole shards of remote sets are kept on this machine, by their sha256, so that later epochs read them locally.
They are files of `$HMA_CACHE/shards` and take at most `$HMA_CACHE_GB` gigabytes (default 20; 0 keeps none).
The shards unused for longest are deleted to make room, but none that was used in the last hour.

N rows, S tokens a frame, A values of an action.
"""

import fcntl
import os
import shutil
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from hma_data.arrays import Array, Ints
from hma_data.errors import ShardError, UsageError
from hma_data.shards.manifest import EPISODES, QUARANTINE, Manifest, ShardFile, restat_remedy
from hma_data.shards.schema import flag_pauses, joined, mask_columns, to_numpy, token_column
from hma_data.storage.files import cache_folder, file_sha256, parse_json, part_of
from hma_data.storage.paths import StrPath
from hma_data.storage.remote import RemotePath, parquet_file, place, remote_file

CACHE_VARIABLE, DEFAULT_GB = "HMA_CACHE_GB", 20.0
IN_USE_S = 3600.0
DOWNLOADED_BYTES = 8 << 20  # of a shard at once
SPARE_SHARE, SPARE_BYTES = 0.1, 5 * 10**9  # free space to leave: a tenth of the disk, but at most 5 GB


@dataclass(frozen=True)
class EpisodeIndex:
    """The places of a split's episodes, in arrays of one length.

    Attributes:
        episode_index: number of the episode in the plan.
        shard: index into `ShardSet.shards(split)`.
        start: first row in the shard.
        length: number of rows.
        pauses: (P, 3) the jumps of time: entry of these arrays, its row before the jump, and how many
            recorded steps it lasts.
    """

    episode_index: Ints
    shard: Ints
    start: Ints
    length: Ints
    pauses: Ints = field(default_factory=lambda: np.zeros((0, 3), np.int64))


class ShardSet:
    """A folder that `hma convert` wrote, on this machine or in a store (`s3://bucket/set`).

    Opening it reads the manifest only; episodes and rows are read on request.

    Args:
        folder: path or URI.
        cache: for a set in a store, whether to keep whole shards on this machine if they fit; otherwise
            shards are read by ranges.

    Raises:
        ShardError: there is no shard set, or its manifest is damaged.
        StorageError: the store refuses to read it.
    """

    def __init__(self, folder: StrPath, cache: bool = True) -> None:
        self.folder = place(folder)
        self._cache = cache
        self.manifest = Manifest.load(self.folder)
        self.embodiment = self.manifest.embodiment
        self.spec = self.manifest.tokenizer

    @property
    def row_stride(self) -> int:
        """Return the number of rows from one frame of the model's grid to the next."""
        return self.embodiment.stride // self.manifest.frame_stride

    @cached_property
    def episodes(self) -> pa.Table:
        """Read episodes.parquet."""
        return self._episodes()

    def _episodes(self, columns: list[str] | None = None, **options: Any) -> pa.Table:
        path = self.folder / EPISODES
        try:
            with parquet_file(path, **options) as file:
                table = file.read(columns=columns)
        except (OSError, pa.ArrowException) as fault:
            raise ShardError(path, f"cannot be read: {fault}", "run the same hma convert again") from fault
        if other := set(table["shard"].unique().to_pylist()) - self.listed.keys():
            text = f"names {min(map(str, other))!r}, which is not a shard of the manifest"
            raise ShardError(path, text, restat_remedy(self.folder))
        return table

    def recordings(self, episodes: Iterable[int]) -> Ints:
        """Return the number of the recording of each of some episodes, which those of one group share."""
        known = dict[tuple[str, str], int]()
        own = {}
        for row in self.episodes.select(["episode_index", "group", "id"]).to_pylist():
            name = row["group"], row["group"] or row["id"]
            own[row["episode_index"]] = known.setdefault(name, len(known))
        return np.array([own[int(episode)] for episode in episodes], np.int64)

    def refused(self) -> list[dict[str, Any]]:
        """Read quarantine.jsonl; return one mapping for each refused episode."""
        path = self.folder / QUARANTINE
        try:
            return [dict(parse_json(line)) for line in path.read_text(encoding="utf-8").splitlines()]
        except (OSError, ValueError, TypeError) as fault:
            raise ShardError(path, f"cannot be read: {fault}", restat_remedy(self.folder)) from fault

    def camera_index(self, camera: str | None) -> int:
        """Return the place of a camera among those of the set; None means the first."""
        cameras = self.manifest.cameras
        if camera is not None and camera not in cameras:
            remedy = f"its cameras are {', '.join(cameras)}"
            raise UsageError("--camera", f"{camera!r} is not a camera of {self.folder}", remedy)
        return cameras.index(camera) if camera else 0

    def columns(self, cameras: Sequence[str] | None = None) -> list[str]:
        """Return the columns to `read` for some cameras, None for all.

        `camera` and `frame_index` are left out; they follow from the others.
        """
        tokens = self.manifest.layout.token_columns
        names = dict.fromkeys(tokens[name] for name in (cameras or tokens))
        names |= dict.fromkeys(("episode_index", "timestamp", "action"))
        return [*names, *(["state"] if self.embodiment.state else []), *mask_columns(self.embodiment)]

    def shards(self, split: str) -> list[str]:
        """Return the names of a split's shards, in order."""
        return [shard.path for shard in self.manifest.shards if shard.split == split]

    def row_groups(self, split: str) -> list[tuple[int, ...]]:
        """Return the rows of each row group of each shard of a split."""
        return [shard.row_groups for shard in self.manifest.shards if shard.split == split]

    def index(self, split: str) -> EpisodeIndex:
        """Return the split's episodes, in row order."""
        columns = ["episode_index", "split", "shard", "row_start", "length", "flags"]
        table = self._episodes(columns, read_dictionary=["split", "shard", "flags"])
        splits, names, flags = (_words(table[name]) for name in ("split", "shard", "flags"))
        mine = np.array([word == split for word in splits[1]], np.bool_)[splits[0]]
        order = {name: i for i, name in enumerate(self.shards(split))}
        shard = np.array([order.get(word, -1) for word in names[1]], np.int64)[names[0][mine]]
        if (shard < 0).any():
            fault = f"puts an episode of split {split} into a shard of another"
            raise ShardError(self.folder / EPISODES, fault, restat_remedy(self.folder))
        start, length, index = (
            to_numpy(table[name]).astype(np.int64)[mine] for name in ("row_start", "length", "episode_index")
        )
        pauses = _pauses(flags[0][mine], flags[1], self.manifest.frame_stride)
        return EpisodeIndex(index, shard, start, length, pauses)

    def read(self, shard: str, row_groups: Sequence[int], columns: Sequence[str]) -> dict[str, Array]:
        """Read columns of some row groups of a shard, (N,) or (N, width) each.

        Raises:
            ShardError: the shard is missing or damaged.
        """
        path = self.folder / shard
        try:
            with self._opened(shard) as file:
                table = file.read_row_groups(list(row_groups), columns=list(columns), use_threads=False)
        except (OSError, pa.ArrowException) as fault:
            remedy = "hma shards verify shows what is damaged"
            raise ShardError(path, f"cannot be read: {fault}", remedy) from fault
        return {name: to_numpy(table[name]) for name in columns}

    def _opened(self, shard: str) -> pq.ParquetFile:
        path = self.folder / shard
        if not isinstance(path, RemotePath):
            return pq.ParquetFile(path, pre_buffer=False, page_checksum_verification=True)
        listed = self.listed[shard]
        fits = self._cache and self._bytes <= limit_bytes()
        if fits and (kept := kept_shard(path, listed.sha256, listed.bytes)):
            return pq.ParquetFile(kept, pre_buffer=False, page_checksum_verification=True)
        metadata = _footer(path, listed.bytes, listed.sha256)
        given = remote_file(path, listed.bytes)
        return pq.ParquetFile(given, pre_buffer=True, metadata=metadata, page_checksum_verification=True)

    @cached_property
    def listed(self) -> dict[str, ShardFile]:
        """Return name -> what the manifest says of that shard."""
        return {shard.path: shard for shard in self.manifest.shards}

    @cached_property
    def _bytes(self) -> int:
        return sum(shard.bytes for shard in self.manifest.shards)

    def episode_rows(self, episode_index: int, columns: Sequence[str] | None = None) -> dict[str, Array]:
        """Read all rows of one episode."""
        wanted = pa.scalar(episode_index)  # for a plain number pyarrow would import pandas
        found = self.episodes.filter(pc.equal(self.episodes["episode_index"], wanted)).to_pylist()
        if not found:
            raise ShardError(self.folder, f"has no episode {episode_index}")
        row = found[0]
        reader = EpisodeReader(self, columns or [token_column(self.spec)[0], "action", "timestamp"])
        return reader.rows(row["shard"], row["row_start"], row["rows"])

    def tokens(self, rows: Array) -> Array:
        """Reshape (N, width) values of the token column to (N, h, w) or (N, c, h, w)."""
        return rows.reshape(-1, *self.spec.cells)


@lru_cache(maxsize=64)
def _footer(path: RemotePath, size: int, sha256: str) -> pq.FileMetaData:
    """Read the footer of a shard in a store; it is read once for each sha256."""
    return pq.read_metadata(remote_file(path, size))


class EpisodeReader:
    """A reader of whole episodes that keeps the last row groups decoded.

    Reading episodes in their order decodes every row group once.
    """

    def __init__(self, shards: ShardSet, columns: Sequence[str]) -> None:
        self._set, self._columns = shards, list(columns)
        self._group = lru_cache(2)(lambda shard, group: shards.read(shard, [group], self._columns))
        listed = shards.listed
        self._edges = lru_cache(64)(lambda shard: np.cumsum([0, *listed[shard].row_groups], dtype=np.int64))

    def episode(self, row: Mapping[str, Any], camera: str) -> dict[str, Array]:
        """Read the columns of an episode, (T,) or (T, width) each, as one camera recorded it.

        Args:
            row: of episodes.parquet.
            camera: name of a camera of the set.

        Returns:
            the columns; the frames of the camera are in the first token column.
        """
        layout = self._set.manifest.layout
        values = self.rows(row["shard"], row["row_start"], row["length"])
        columns = {*layout.token_columns.values()}
        kept = {name: column for name, column in values.items() if name not in columns}
        return {token_column(layout.tokenizer)[0]: values[layout.token_columns[camera]], **kept}

    def rows(self, shard: str, row_start: int, rows: int) -> dict[str, Array]:
        """Read columns of `rows` rows of a shard from `row_start` on, (rows,) or (rows, width) each."""
        edges = self._edges(shard)
        first = int(np.searchsorted(edges, row_start, side="right")) - 1
        last = int(np.searchsorted(edges, row_start + rows, side="left"))
        parts = []
        for group in range(first, last):
            begin, end = (int(np.clip(at - edges[group], 0, None)) for at in (row_start, row_start + rows))
            values = self._group(shard, group)
            parts.append({name: values[name][begin:end] for name in self._columns})
        return joined(parts)


def _pauses(flags: Ints, words: Sequence[str], frame_stride: int) -> Ints:
    """Return `EpisodeIndex.pauses` from the word (N,) of each episode."""
    of_word = {i: pauses for i, word in enumerate(words) if (pauses := flag_pauses(word))}
    found = [
        (episode, frame // frame_stride, steps)
        for episode in np.flatnonzero(np.isin(flags, list(of_word))).tolist()
        for frame, steps in of_word[int(flags[episode])].items()
    ]
    return np.array(found, np.int64).reshape(-1, 3)


def _words(column: pa.ChunkedArray) -> tuple[Ints, list[str]]:
    """Return the index of each row's word (N,) and the words of a dictionary-encoded column.

    pyarrow's own functions for this import pandas if it is installed, which takes a second.
    """
    codes = column.unify_dictionaries().combine_chunks()
    return to_numpy(codes.indices).astype(np.int64), codes.dictionary.to_pylist()


# -- shards kept on this machine


def limit_bytes() -> int:
    """Return how many bytes of shards may be kept."""
    stated = os.environ.get(CACHE_VARIABLE) or DEFAULT_GB
    try:
        return int(float(stated) * 1e9)
    except (ValueError, OverflowError) as fault:
        text = f"{stated!r} is not a number of gigabytes"
        raise UsageError(f"${CACHE_VARIABLE}", text, "give for example 20, or 0 for no cache") from fault


def kept_shard(path: RemotePath, sha256: str, size: int) -> Path | None:
    """Return a shard's copy on this machine; download it if there is none.

    The result is None where the copy does not fit or the cache cannot be written: read it by ranges.

    Args:
        sha256, size: as its manifest states.

    Raises:
        ShardError: its bytes are not those of the manifest.
        StorageError: it cannot be read; StorageAwayError: the store does not answer.
    """
    folder = cache_folder() / "shards"
    final = folder / f"{sha256}.parquet"
    try:
        if _is_there(final, size):
            return final
        folder.mkdir(parents=True, exist_ok=True)
        with (lock := folder / f".{sha256}.lock").open("w") as handle:
            fcntl.flock(handle, fcntl.LOCK_EX)  # only one of the processes that want it downloads it
            try:
                if _is_there(final, size):
                    return final
                return _download(path, sha256, size, final) if _make_room(folder, size) else None
            finally:
                lock.unlink(missing_ok=True)
    except OSError:  # the cache cannot be written
        return None


def _is_there(final: Path, size: int) -> bool:
    """Check whether a shard is kept; if so, mark it as used now."""
    with suppress(OSError):
        if final.stat().st_size == size:
            os.utime(final)
            return True
    return False


def _download(path: RemotePath, sha256: str, size: int, final: Path) -> Path:
    part = part_of(final)
    try:
        with part.open("wb") as out:
            shutil.copyfileobj(remote_file(path, size), out, DOWNLOADED_BYTES)
        if file_sha256(part) != sha256:
            fault = "its bytes are not those of the manifest (sha256 differs)"
            raise ShardError(path, fault, "run hma shards verify to see what is damaged")
        part.replace(final)
    finally:
        part.unlink(missing_ok=True)
    return final


def _make_room(folder: Path, size: int) -> bool:
    """Delete the shards unused for longest until `size` more bytes fit; return False if they cannot."""
    found = []
    for path in folder.iterdir():
        with suppress(OSError):
            facts = path.stat()
            found.append((facts.st_mtime, facts.st_size, path))
    limit, disk = limit_bytes(), shutil.disk_usage(folder)
    usable = disk.free - min(int(SPARE_SHARE * disk.total), SPARE_BYTES)
    over = max(sum(item[1] for item in found) + size - limit, size - usable)
    old = [item for item in sorted(found) if item[0] < time.time() - IN_USE_S]
    if size > limit or over > sum(item[1] for item in old):
        return False
    for _, length, path in old:
        if over <= 0:
            break
        path.unlink(missing_ok=True)
        over -= length
    return True
