"""Open HDF5 files lazily in each process, read a few rows at a time, and trust none of their claims.

Only data in the file itself is read. Links to other files, external storage and virtual datasets are refused,
and so are sizes that no recording has.
"""

import os
import zlib
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from itertools import pairwise
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from hma_data.errors import EpisodeError, HMAError

OPEN_FILES = 8
CHUNK_CACHE = 16 << 20  # bytes a dataset, where its chunks are not larger
HELD_BYTES = 512 << 20  # of decompressed chunks in memory, over all datasets of pictures
MAX_BYTES = 1 << 30  # of a chunk
MAX_NUMBERS = 1 << 26  # values read whole; they become float64
MAX_ROW = 1 << 28  # values of a row: more than any picture has
MAX_KEYS, MAX_DEPTH = 5_000, 16


class OpenFiles:
    """Keep the files open in this process; close the least recently used first. None stays open after a fork.

    Datasets of pictures stay open too, so that a chunk that several calls need is decompressed once.
    """

    def __init__(self) -> None:
        self._process = os.getpid()
        self._files: OrderedDict[Path, tuple[tuple[int, int], h5py.File]] = OrderedDict()
        self._held: OrderedDict[tuple[Path, str, str], tuple[int, h5py.Dataset]] = OrderedDict()

    def get(self, path: Path) -> h5py.File:
        """Return the open file; open it again where it has changed.

        Raises:
            OSError: it is not HDF5, or is cut off; `explained` raises that as our error.
        """
        if self._process != os.getpid():
            self._files, self._held, self._process = OrderedDict(), OrderedDict(), os.getpid()
        status = path.stat()
        state = (status.st_size, status.st_mtime_ns)
        held = self._files.get(path)
        if held and held[0] != state:
            held[1].close()
        if not held or held[0] != state:
            self._files[path] = state, _open(path)
        self._files.move_to_end(path)
        while len(self._files) > OPEN_FILES:
            self._files.popitem(last=False)[1][1].close()
        return self._files[path][1]

    def cached(self, path: Path, group: h5py.Group, key: str, where: str) -> h5py.Dataset:
        """Return the dataset at `key` of a group of an open file; its cache has room for the chunks of a row.

        Raises:
            EpisodeError: see `dataset`.
        """
        name = (path, str(group.name), key)
        if name not in self._held or not self._held[name][1]:  # false once its file is closed
            self._held.pop(name, None)
            self._held[name] = _with_room(group, key, where)
        self._held.move_to_end(name)
        while len(self._held) > 1 and sum(room for room, _ in self._held.values()) > HELD_BYTES:
            self._held.popitem(last=False)
        return self._held[name][1]


def _with_room(group: h5py.Group, key: str, where: str) -> tuple[int, h5py.Dataset]:
    """Return the bytes of the dataset's cache, and the dataset."""
    found = dataset(group, key, where)
    room = min(max(band_bytes(found), CHUNK_CACHE), HELD_BYTES) if found.chunks else 0
    if room <= CHUNK_CACHE:
        return room, found
    slots = 100 * (room // (int(np.prod(found.chunks)) * found.dtype.itemsize) + 1) + 1
    del found  # the cache is made when the first handle is opened
    access = h5py.h5p.create(h5py.h5p.DATASET_ACCESS)
    access.set_chunk_cache(min(slots, 1_000_003), room, 1.0)
    return room, h5py.Dataset(h5py.h5d.open(group.id, key.strip("/").encode(), access))


def band_bytes(found: h5py.Dataset) -> int:
    """Return the decompressed bytes of all chunks that hold a row; 0 without chunks."""
    if not found.chunks:
        return 0
    sides = [-(-side // chunk) * chunk for side, chunk in zip(found.shape[1:], found.chunks[1:], strict=True)]
    return int(found.chunks[0] * np.prod(sides, dtype=float)) * int(found.dtype.itemsize)


def _open(path: Path) -> h5py.File:
    """Open a file with HDF5's own locking; where that fails on locks, without them; at last with them.

    A file that this process already holds open can be opened again only with the same locking.
    """
    for locking in (None, False):
        try:
            return h5py.File(path, "r", rdcc_nbytes=CHUNK_CACHE, locking=locking)
        except OSError as fault:
            if "lock" not in str(fault):
                raise
    return h5py.File(path, "r", rdcc_nbytes=CHUNK_CACHE, locking=True)


@contextmanager
def explained(where: object, error: type[HMAError] = EpisodeError) -> Iterator[None]:
    """Raise h5py's errors on damaged files as `error`, in one line."""
    try:
        yield
    except (
        OSError,
        zlib.error,
        KeyError,
        RuntimeError,
        ValueError,
        TypeError,
        OverflowError,
        MemoryError,
    ) as fault:
        lines = str(fault).splitlines() or [type(fault).__name__]
        remedy = "the file may be cut off or damaged"
        if "plugin" in lines[0] or ("filter" in lines[0] and "not registered" in lines[0]):
            remedy = (
                "it is compressed in a way that HDF5 alone does not know; rewrite it with h5repack -f GZIP=4"
            )
        raise error(where, f"cannot be read as HDF5: {lines[0]}", remedy) from fault


def member(group: h5py.Group, key: str, where: str) -> Any:
    """Return the group or dataset at a path inside `group`.

    Raises:
        EpisodeError: it is not there (the error names the nearest keys), or it lies in another file.
    """
    found: Any = group
    for part in key.strip("/").split("/"):
        link = found.get(part, getlink=True) if isinstance(found, h5py.Group) else None
        if link is None:
            raise EpisodeError(where, f"has no {key!r}", _nearest(group, key))
        if isinstance(link, h5py.ExternalLink):
            raise EpisodeError(where, f"{key!r} links to another file, {link.filename!r}", "copy it in")
        found = found[part]
        if _strays(found, group):  # by way of a soft link
            raise EpisodeError(where, f"{key!r} links to another file, {found.file.filename!r}", "copy it in")
    return found


def child(group: h5py.Group, name: str) -> Any:
    """Return the direct member of a name; None where there is none in this file."""
    link = group.get(name, getlink=True)
    found = None if link is None or isinstance(link, h5py.ExternalLink) else group.get(name)
    return None if found is None or _strays(found, group) else found


def _strays(found: Any, group: h5py.Group) -> bool:
    return bool(found.file.filename != group.file.filename)


def dataset(group: h5py.Group, key: str, where: str) -> h5py.Dataset:
    """Return the dataset at a path inside `group`; check that it lies in this file and has rows.

    Raises:
        EpisodeError: see `member`; or it is a group, a single value, empty, or of a size no recording has.
    """
    found = member(group, key, where)
    if isinstance(found, h5py.Group):
        inner = ", ".join(f"{key.strip('/')}/{name}" for name in list(found)[:8])
        raise EpisodeError(where, f"{key!r} is a group, not a dataset", f"it holds: {inner or 'nothing'}")
    if not isinstance(found, h5py.Dataset):
        raise EpisodeError(where, f"{key!r} is a named type, not a dataset")
    if found.external or found.is_virtual:
        raise EpisodeError(where, f"{key!r} keeps its values in other files", "write them into this one")
    if not found.shape:
        raise EpisodeError(where, f"{key!r} is a single value, not one a frame")
    if not found.shape[0]:
        raise EpisodeError(where, f"{key!r} is empty")
    if chunk_bytes(found) > MAX_BYTES:
        raise EpisodeError(where, f"{key!r} has chunks of {found.chunks}, too large to read")
    return found


def chunk_bytes(found: h5py.Dataset) -> float:
    """Return the decompressed bytes of a chunk; 0 without chunks."""
    return float(np.prod(found.chunks, dtype=float) * found.dtype.itemsize) if found.chunks else 0.0


def numbers(group: h5py.Group, key: str, where: str) -> NDArray[Any]:
    """Return all values (T, …) of a dataset of numbers."""
    found = dataset(group, key, where)
    if np.prod(found.shape, dtype=float) > MAX_NUMBERS:
        raise EpisodeError(where, f"{key!r} has shape {found.shape}, too large for numbers over time")
    check_lengths(found)
    values: NDArray[Any] = found[()]
    return values


def check_lengths(found: h5py.Dataset) -> None:
    """Check that no row of varying length claims more bytes than its file has; HDF5 would allocate them.

    Rows that are compressed by anything but gzip are not checked.

    Raises:
        OSError: a row claims more; `explained` raises that as our error.
    """
    if not found.dtype.hasobject or not found.size or h5py.check_ref_dtype(found.dtype):
        return
    size = Path(found.file.filename).stat().st_size
    for heads in _row_heads(found):
        longest = int(heads.max(initial=0))
        if longest > size:
            raise OSError(f"a row of {found.name} claims {longest:,} values, the file has {size:,} bytes")


def _row_heads(found: h5py.Dataset) -> Iterator[NDArray[np.uint32]]:
    """Yield the lengths stored in front of rows of varying length, chunk by chunk."""
    width = found.id.get_type().get_size()
    if not found.chunks:
        offset = found.id.get_offset()
        pieces = [] if offset is None else [(offset, found.id.get_storage_size(), 0)]
    else:
        infos = (found.id.get_chunk_info(i) for i in range(found.id.get_num_chunks()))
        pieces = [(info.byte_offset, info.size, info.filter_mask) for info in infos]
    plan = found.id.get_create_plist()
    filters = [plan.get_filter(i)[0] for i in range(plan.get_nfilters())]
    with Path(found.file.filename).open("rb") as file:
        for offset, size, skipped in pieces:
            applied = [code for i, code in enumerate(filters) if not skipped >> i & 1]
            if applied not in ([], [h5py.h5z.FILTER_DEFLATE]):  # a shuffle is never applied to such rows
                return
            file.seek(offset)
            content = file.read(min(size, MAX_BYTES))
            if applied:
                content = zlib.decompressobj().decompress(content, int(np.prod(found.chunks)) * width)
            values = np.frombuffer(content[: len(content) // width * width], np.uint8).reshape(-1, width)
            yield np.ascontiguousarray(values[:, :4]).view("<u4")


def rows(found: h5py.Dataset, indices: Sequence[int] | NDArray[np.int64]) -> NDArray[Any]:
    """Return the rows (n, …) of the given indices, in the order asked for.

    Neighbours are read as one slice. Rows of one chunk that is too large for the cache are also read as one
    slice, so that it is decompressed once.

    Raises:
        EpisodeError: a row or a chunk is larger than any picture.
        IndexError: an index lies outside the dataset.
    """
    if np.prod(found.shape[1:], dtype=float) > MAX_ROW or chunk_bytes(found) > MAX_BYTES:
        fault = f"has rows of {found.shape[1:]} in chunks of {found.chunks}, too large to read"
        raise EpisodeError(f"{found.file.filename}:{found.name}", fault)
    wanted = np.asarray(indices, np.int64).reshape(-1)
    if not len(wanted):
        return np.zeros((0, *found.shape[1:]), found.dtype)
    if not 0 <= wanted.min() <= wanted.max() < len(found):
        raise IndexError(f"{found.name} has {len(found)} rows, asked for {wanted.min()} to {wanted.max()}")
    check_lengths(found)
    ordered = np.unique(wanted)
    apart = np.diff(ordered) > 1
    if band_bytes(found) > HELD_BYTES:
        apart &= np.diff(ordered // found.chunks[0]) > 0
    read = np.empty((len(ordered), *found.shape[1:]), found.dtype)
    ends = [0, *(np.flatnonzero(apart) + 1), len(ordered)]
    for start, stop in pairwise(ends):
        first, last = int(ordered[start]), int(ordered[stop - 1])
        if last - first + 1 > stop - start:
            read[start:stop] = found[first : last + 1][ordered[start:stop] - first]
        elif read.dtype.hasobject:
            read[start:stop] = found[first : last + 1]
        else:
            found.read_direct(read, np.s_[first : last + 1], np.s_[int(start) : int(stop)])
    return read if np.array_equal(ordered, wanted) else read[np.searchsorted(ordered, wanted)]


def walk(group: h5py.Group) -> Iterator[tuple[str, h5py.Dataset]]:
    """Yield every dataset below `group` with its path; do not follow links."""
    pending: list[tuple[str, h5py.Group]] = [("", group)]
    seen = 0
    while pending:
        prefix, current = pending.pop(0)
        for name in current:
            seen += 1
            if seen > MAX_KEYS or prefix.count("/") > MAX_DEPTH:
                return
            if not isinstance(current.get(name, getlink=True), h5py.HardLink):
                continue
            item = current[name]
            if isinstance(item, h5py.Group):
                pending.append((f"{prefix}{name}/", item))
            elif isinstance(item, h5py.Dataset):
                yield f"{prefix}{name}", item


def text(value: Any) -> str:
    """Return an attribute or a dataset's value as text; empty when it is not text."""
    if isinstance(value, h5py.Empty):
        return ""
    if isinstance(value, np.ndarray):
        value = value.reshape(-1)[0] if value.size else b""
    if isinstance(value, bytes):
        value = value.decode("utf-8", errors="replace")
    return str(value).strip().strip('"').strip("\x00").strip() if isinstance(value, str) else ""


def _nearest(group: h5py.Group, key: str) -> str:
    keys = [name for name, _ in walk(group)]
    near = get_close_matches(key.strip("/"), keys, n=3, cutoff=0.5)
    if near:
        return f"did you mean {', '.join(near)}?"
    return f"it has {', '.join(keys[:8])}{', …' if len(keys) > 8 else ''}" if keys else "it has no datasets"
