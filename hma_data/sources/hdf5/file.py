"""Open HDF5 files, find the episodes in them, and read a few rows at a time.

A uri is a file or a folder of files. A pattern such as `data/*` names the groups that are episodes; `/` says
that each file is one episode. Without a pattern, the file itself shows it.

Files are opened lazily in each process. Only values in the file itself are read: those that it keeps in other
files are refused, and so are sizes that no recording has.
"""

import json
import os
import re
from collections import Counter, OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any, TypeGuard

import h5py
import numpy as np

from hma_data.arrays import Array, Indices
from hma_data.errors import EpisodeError, HMAError, SourceError, meant
from hma_data.sources.common.places import local_path, named_files, natural
from hma_data.sources.common.survey import sampled
from hma_data.storage.kinds import one_line, unreadable

SUFFIXES = (".h5", ".hdf5", ".hdf")
WHOLE_FILE = "/"
OPEN_FILES = 8
CHUNK_CACHE = 16 << 20  # bytes a dataset, where its chunks are not larger
HELD_BYTES = 512 << 20  # of decompressed chunks in memory, over all datasets of images
HELD_DATASETS = 64  # of images that stay open; without chunks they take no bytes of the above
MAX_BYTES = 1 << 30  # of a chunk
MAX_NUMBERS = 1 << 26  # values read whole; they become float64
MAX_SINGLE = 1 << 16  # bytes of a single value, such as a text
MAX_ROW = 1 << 27  # bytes of a row: more than any image has
MAX_DEPTH = 4  # of the groups above the episodes
MAX_GROUPS_SAMPLED = 8  # most groups looked into to see whether they and their like are episodes
MIN_ENCODED = 64  # bytes a row: no image has fewer
TEXT_KEYS = ("language_instruction", "language_raw", "instruction", "lang", "task_description", "task")
# Attributes that state how many rows of preallocated series were recorded
RECORDED = ("num_samples", "num_steps", "num_frames", "episode_length", "episode_len", "length")
MAX_KEYS = 5_000  # datasets and groups of an episode that are listed
_EPISODE_NAME = re.compile(r"(demo|episode|ep|traj|trajectory|rollout)[_-]?\d+")
_PART = re.compile(  # of a robot or a scene; one episode holds several
    r"(arm|robot|hand|gripper|finger|joint|agent|object|cam|camera|view|sensor|device|kinect|realsense|zed)s?"
)


class OpenFiles:
    """The files open in this process; the least recently used is closed first. None stays open after a fork.

    Datasets of images stay open too, so that a chunk that several calls need is decompressed once.
    """

    def __init__(self) -> None:
        self._process = os.getpid()
        self._files: OrderedDict[tuple[Path, int, int], h5py.File] = OrderedDict()
        self._held: OrderedDict[tuple[Path, str, str], tuple[int, h5py.Dataset]] = OrderedDict()
        self._room = 0  # bytes of the caches in `_held`

    def get(self, path: Path) -> h5py.File:
        """Return the open file; open it again where it has changed.

        Raises:
            OSError: it is not HDF5, or is cut off; `explained` raises that as our error.
        """
        if self._process != os.getpid():
            self._files, self._held, self._room = OrderedDict(), OrderedDict(), 0
            self._process = os.getpid()
        status = path.stat()
        state = (path, status.st_size, status.st_mtime_ns)
        if state not in self._files:
            for old in [held for held in self._files if held[0] == path]:
                self._files.pop(old).close()
            self._files[state] = _open(path)
        self._files.move_to_end(state)
        while len(self._files) > OPEN_FILES:
            self._files.popitem(last=False)[1].close()
        return self._files[state]

    def cached(self, path: Path, group: h5py.Group, key: str, where: str) -> h5py.Dataset:
        """Return the dataset at `key` of a group of an open file; its cache has room for the chunks of a row.

        Raises:
            EpisodeError: see `dataset`.
        """
        name = (path, str(group.name), key)
        # A handle is false once its file is closed.
        if name not in self._held or not self._held[name][1]:
            self._room -= self._held.pop(name, (0, None))[0]
            self._held[name] = _with_room(group, key, where)
            self._room += self._held[name][0]
        self._held.move_to_end(name)
        while len(self._held) > 1 and (self._room > HELD_BYTES or len(self._held) > HELD_DATASETS):
            self._room -= self._held.popitem(last=False)[1][0]
        return self._held[name][1]


def _open(path: Path) -> h5py.File:
    """Open a file with HDF5's own locking, or without on file systems that have no locks."""
    try:
        return h5py.File(path, "r", rdcc_nbytes=CHUNK_CACHE)
    except OSError as fault:
        if "lock" not in str(fault):
            raise
    return h5py.File(path, "r", rdcc_nbytes=CHUNK_CACHE, locking=False)


def _with_room(group: h5py.Group, key: str, where: str) -> tuple[int, h5py.Dataset]:
    """Return the bytes of the dataset's cache, and the dataset."""
    found = dataset(group, key, where)
    room = min(max(_band_bytes(found), CHUNK_CACHE), HELD_BYTES) if found.chunks else 0
    if room <= CHUNK_CACHE:
        return room, found
    slots = 100 * (room // (int(np.prod(found.chunks)) * found.dtype.itemsize) + 1) + 1
    del found  # HDF5 makes the cache with the first handle and ignores the settings of later ones
    access = h5py.h5p.create(h5py.h5p.DATASET_ACCESS)
    access.set_chunk_cache(min(slots, 1_000_003), room, 1.0)
    return room, h5py.Dataset(h5py.h5d.open(group.id, key.strip("/").encode(), access))


def _band_bytes(found: h5py.Dataset) -> int:
    """Return the decompressed bytes of all chunks that hold a row; 0 without chunks."""
    if not found.chunks:
        return 0
    sides = [-(-side // chunk) * chunk for side, chunk in zip(found.shape[1:], found.chunks[1:], strict=True)]
    return int(found.chunks[0] * np.prod(sides, dtype=float)) * int(found.dtype.itemsize)


@contextmanager
def explained(where: object, error: type[HMAError] = EpisodeError) -> Iterator[None]:
    """Raise h5py's errors on damaged files as `error`, in one line."""
    try:
        yield
    except (OSError, KeyError, RuntimeError, ValueError, TypeError, ArithmeticError, MemoryError) as fault:
        said = one_line(fault)
        remedy = "it may be cut off or damaged: copy it again"
        if "plugin" in said or ("filter" in said and "not registered" in said):
            remedy = (
                "it is compressed in a way that HDF5 alone does not know; rewrite it with h5repack -f GZIP=4"
            )
        file = Path(str(getattr(where, "file", where)))
        raise error(where, *unreadable(file, f"cannot be read as HDF5: {said}", remedy)) from fault


# -- episodes


@dataclass(frozen=True)
class EpisodeGroup:
    """The place of an episode: a file and the group in it."""

    file: Path
    group: str = WHOLE_FILE

    def __str__(self) -> str:
        return str(self.file) if self.group == WHOLE_FILE else f"{self.file}:{self.group}"


class EpisodeFinder:
    """The episodes of recordings, by their ids; the episodes of each file are remembered."""

    def __init__(self) -> None:
        self.files = OpenFiles()
        self._stems: dict[str, dict[str, Path]] = {}
        self._seen: dict[tuple[Path, str | None], dict[str, EpisodeGroup]] = {}

    def all(self, uri: str, pattern: str | None = None) -> dict[str, EpisodeGroup]:
        """Return every episode by its id, in natural order.

        A damaged file in a folder counts as one episode, so that it is quarantined by its name.

        Raises:
            SourceError: the only file is damaged, there are no episodes, or two have one id.
        """
        return {name: place for _, found in self.by_file(uri, pattern) for name, place in found.items()}

    def by_file(self, uri: str, pattern: str | None = None) -> Iterator[tuple[Path, dict[str, EpisodeGroup]]]:
        """Yield each file with its episodes, while the file is open.

        Opening many files a second time would take as long again.

        Raises:
            SourceError: as `all`.
        """
        self._seen.clear()
        stems = self._stems[uri] = _stems(uri)
        in_folder = local_path(uri).is_dir()
        is_empty = True
        for stem, file in stems.items():
            try:
                inside = self._inside(file, pattern)
            except SourceError:
                if len(stems) == 1:
                    raise
                inside = {"": EpisodeGroup(file)}
            is_empty = is_empty and not inside
            prefix = stem if in_folder else ""
            yield file, {"/".join(filter(None, (prefix, name))) or stem: inside[name] for name in inside}
        if is_empty:
            raise SourceError(uri, "holds no episodes", f"looked for groups {pattern or 'data/*'}")

    def find(self, uri: str, episode_id: str, pattern: str | None = None) -> EpisodeGroup:
        """Return the place of an id; open only the file that holds it.

        Raises:
            SourceError: no such episode.
            EpisodeError: its file is damaged.
        """
        stems = self._stems.get(uri) or self._stems.setdefault(uri, _stems(uri))
        parts = episode_id.split("/")
        if local_path(uri).is_dir():
            candidates = [("/".join(parts[:i]), "/".join(parts[i:])) for i in range(len(parts), 0, -1)]
        else:
            candidates = [(stem, name) for stem in stems for name in (episode_id, "")]
        for stem, name in candidates:
            if stem not in stems:
                continue
            try:
                inside = self._inside(stems[stem], pattern)
            except SourceError as fault:
                raise EpisodeError(fault.where, fault.fault, fault.remedy) from fault
            if name in inside and (name or stem == episode_id):
                return inside[name]
        raise SourceError(uri, f"has no episode {episode_id!r}", "hma inspect lists what it has")

    def group(self, place: EpisodeGroup) -> h5py.Group:
        """Return the episode's group, in the open file."""
        handle = self.files.get(place.file)
        found = handle if place.group == WHOLE_FILE else inside(handle, place.group)
        if found is None:
            remedy = "copy the group into this file"
            raise EpisodeError(place, "is damaged, or a link to what is not in this file", remedy)
        return found

    def _inside(self, file: Path, pattern: str | None) -> dict[str, EpisodeGroup]:
        """Return the episodes of one file by name within it; the name of a whole file is empty."""
        if (file, pattern) not in self._seen:
            with explained(file, SourceError):
                self._seen[file, pattern] = _episodes(self.files.get(file), file, pattern)
        return self._seen[file, pattern]


def _stems(uri: str) -> dict[str, Path]:
    """Return the HDF5 files of a uri by their names without suffix, relative to the folder."""
    path = local_path(uri)
    if path.is_file():
        return {_safe(path.stem): path}
    found: dict[str, Path] = {}
    for name, file in named_files(uri, SUFFIXES, "HDF5 files").items():
        stem = "/".join(map(_safe, PurePosixPath(name).with_suffix("").parts))
        if stem in found:
            raise SourceError(file, f"differs from {found[stem].name} in its suffix only", "rename one")
        found[stem] = file
    return found


def _episodes(handle: h5py.File, file: Path, pattern: str | None) -> dict[str, EpisodeGroup]:
    pattern = pattern or _guess_pattern(handle)
    if pattern == WHOLE_FILE:
        return {"": EpisodeGroup(file)}
    parts = pattern.split("/")
    fixed = next((i for i, part in enumerate(parts) if re.search(r"[*?\[]", part)), len(parts) - 1)
    found: dict[str, EpisodeGroup] = {}
    for group in sorted(_matching(handle, parts), key=natural):
        name = "/".join(map(_safe, group.split("/")[fixed:]))
        if name in found:
            raise SourceError(file, f"two of its groups give an episode called {name!r}", "rename one")
        found[name] = EpisodeGroup(file, group)
    return found


def _guess_pattern(handle: h5py.File) -> str:
    data = inside(handle, "data")
    is_demos = isinstance(data, h5py.Group) and not any(
        isinstance(inside(data, name), h5py.Dataset) for name in data
    )
    if is_demos:
        return "data/*"
    groups = [name for name in handle if isinstance(inside(handle, name), h5py.Group)]
    if groups and len(groups) == len(handle) and all(_EPISODE_NAME.fullmatch(name) for name in groups):
        return "*"
    return _numbered(handle) or WHOLE_FILE


def _numbered(group: h5py.Group, depth: int = 0) -> str | None:
    """Return the pattern of the groups that are episodes: numbered, with images and actions in most.

    Numbered cameras and arms are none: they do not hold both, or are named as such.
    """
    inner = {name: item for name in group if (item := inside(group, name)) is not None}
    groups = {name: item for name, item in inner.items() if isinstance(item, h5py.Group)}
    if not groups or depth > MAX_DEPTH:
        return None
    stem, count = Counter(map(_stem, groups)).most_common(1)[0]
    if "#" not in stem or count < 2:
        return _below(groups, depth)
    family = sorted((name for name in groups if _stem(name) == stem), key=natural)
    pattern = "*" if count == len(groups) else re.sub(r"\d+", "[0-9]*", family[0])
    if _is_part(stem, group) or {name for name in groups if fnmatchcase(name, pattern)} != set(family):
        return None
    if deeper := _numbered(groups[family[0]], depth + 1):  # day_1/t000
        return f"{pattern}/{deeper}"
    # Walking thousands of groups takes minutes on a slow disk, so a spread sample decides.
    spread = sampled(count, MAX_GROUPS_SAMPLED)
    episodes = sum(_is_episode(groups[family[i]]) for i in spread)
    return pattern if episodes >= 2 and 2 * episodes > len(spread) else None


def _below(groups: dict[str, h5py.Group], depth: int) -> str | None:
    """Return the pattern by way of the one group that holds episodes, or of all where they do alike."""
    sampled = list(groups)[:MAX_GROUPS_SAMPLED]
    holders = {name: found for name in sampled if (found := _numbered(groups[name], depth + 1))}
    patterns = set(holders.values())
    if len(patterns) != 1 or 1 < len(holders) < len(sampled):
        return None
    return f"{'*' if len(holders) > 1 else next(iter(holders))}/{patterns.pop()}"


def _stem(name: str) -> str:
    return re.sub(r"\d+", "#", name)


def _is_part(stem: str, group: h5py.Group) -> bool:
    """Check whether numbered groups are named as parts: `wrist_cam_0`, or `robots/0`."""
    words = re.findall(r"[a-z]+", stem.lower()) or re.findall(r"[a-z]+", str(group.name).lower())
    return bool(words and _PART.fullmatch(words[-1]))


def _is_coded(dtype: np.dtype[Any]) -> bool:
    """Check whether a value may be an encoded image, so is bytes and no text."""
    string = h5py.check_string_dtype(dtype)
    return dtype.kind in "OSV" and not (string and string.encoding == "utf-8")


def _is_episode(group: h5py.Group) -> bool:
    """Check for what may be images, with numbers of as many rows, or one more or less."""
    images, values = [], []
    for _, item in walk(group):
        shape: tuple[int, ...] = item.shape or ()
        dtype = item.dtype
        padded = len(shape) == 2 and shape[1] > MIN_ENCODED
        if (dtype == np.uint8 and (len(shape) >= 3 or padded)) or (len(shape) == 1 and _is_coded(dtype)):
            images.append(shape[0])
        elif dtype.kind == "f" and len(shape) == 2:
            values.append(shape[0])
    return any(abs(count - other) <= 1 for count in images for other in values)


def inside(group: h5py.Group, name: str) -> h5py.Group | h5py.Dataset | None:
    """Return a member of a group that lies in the same file; None for a link out of it, or to nothing."""
    if isinstance(group.get(name, getlink=True), h5py.ExternalLink):
        return None
    item = None
    with suppress(OSError, RuntimeError):  # a soft link that leads to itself
        item = group.get(name)
    # A soft link may pass through an external one.
    return item if item is not None and item.file.filename == group.file.filename else None


def _matching(group: h5py.Group, parts: list[str]) -> Iterator[str]:
    """Yield the paths of the groups that match a pattern, one part a level, and of links that lead away."""
    for name in group:
        if not fnmatchcase(name, parts[0]):
            continue
        item = inside(group, name)
        if item is None:
            yield name
        elif isinstance(item, h5py.Group) and parts[1:]:
            yield from (f"{name}/{rest}" for rest in _matching(item, parts[1:]))
        elif isinstance(item, h5py.Group):
            yield name


def _safe(name: str) -> str:
    return re.sub(r"[^\w.-]", "_", name).lstrip(".") or "_"


# -- values


def member(group: h5py.Group, key: str, where: str) -> Any:
    """Return the group or dataset at a path inside `group`.

    Raises:
        EpisodeError: it is not there; the error names the nearest keys.
    """
    try:
        return group[key.strip("/") or "/"]
    except KeyError as fault:
        keys = [name for name, _ in walk(group)]
        listed = f"it has {', '.join(keys[:8]) or 'no datasets'}"
        remedy = meant(key.strip("/"), keys, cutoff=0.5) or listed
        raise EpisodeError(where, f"has no {key!r}", remedy) from fault


def dataset(group: h5py.Group, key: str, where: str) -> h5py.Dataset:
    """Return the dataset at a path inside `group`; check that it lies in this file and has rows.

    Raises:
        EpisodeError: see `member`; or it is a group, a single value, empty, or of a size no recording has.
    """
    found = member(group, key, where)
    if not isinstance(found, h5py.Dataset):
        members = list(found)[:8] if isinstance(found, h5py.Group) else ()
        inner = ", ".join(f"{key.strip('/')}/{name}" for name in members)
        raise EpisodeError(
            where, f"{key!r} is a group or a type, not a dataset", f"it holds: {inner or 'nothing'}"
        )
    if is_elsewhere(found, group):
        raise EpisodeError(where, f"{key!r} keeps its values in other files", "write them into this one")
    if not found.shape or not found.shape[0]:
        raise EpisodeError(where, f"{key!r} holds no rows, one per frame (shape {found.shape})")
    if not is_plausible(found):
        raise EpisodeError(
            where,
            f"{key!r} has shape {found.shape} of {found.dtype} in chunks {found.chunks}, too large to read",
        )
    return found


def is_elsewhere(found: h5py.Dataset, group: h5py.Group) -> bool:
    """Check whether a dataset lies in another file than its group, or keeps its values in one."""
    return bool(found.file.filename != group.file.filename or found.external or found.is_virtual)


def is_single(found: Any, group: h5py.Group) -> TypeGuard[h5py.Dataset]:
    """Check whether something is a dataset of one short value that lies in the same file as a group."""
    if not isinstance(found, h5py.Dataset) or found.size != 1 or is_elsewhere(found, group):
        return False
    return bool(found.dtype.itemsize <= MAX_SINGLE)  # a small file may state gigabytes


def is_plausible(found: h5py.Dataset) -> bool:
    """Check whether a recording can have rows and chunks of this size."""
    chunk, row = np.prod(found.chunks or 0, dtype=float), np.prod(found.shape[1:], dtype=float)
    each = found.dtype.itemsize
    return bool(chunk * each <= MAX_BYTES and row * each <= MAX_ROW)


def numbers(group: h5py.Group, key: str, where: str) -> Array:
    """Return all values (T, …) of a dataset of numbers."""
    found = dataset(group, key, where)
    if np.prod(found.shape, dtype=float) > MAX_NUMBERS:
        raise EpisodeError(where, f"{key!r} has shape {found.shape}, too large for numbers over time")
    values: Array = found[()]
    return values


def rows(found: h5py.Dataset, indices: Indices) -> Array:
    """Return the rows (n, …) of the given indices, in the order asked for.

    Neighbours are read as one slice.

    Raises:
        IndexError: an index lies outside the dataset.
    """
    wanted = np.asarray(indices, np.int64).reshape(-1)
    if not len(wanted):
        return np.zeros((0, *found.shape[1:]), found.dtype)
    if not 0 <= wanted.min() <= wanted.max() < len(found):
        raise IndexError(f"{found.name} has {len(found)} rows, asked for {wanted.min()} to {wanted.max()}")
    ordered = np.unique(wanted)
    read = np.empty((len(ordered), *found.shape[1:]), found.dtype)
    ends = [0, *(np.flatnonzero(np.diff(ordered) > 1) + 1), len(ordered)]
    for start, stop in pairwise(ends):
        first, last = int(ordered[start]), int(ordered[stop - 1])
        if read.dtype.hasobject:
            read[start:stop] = found[first : last + 1]
        else:
            found.read_direct(read, np.s_[first : last + 1], np.s_[int(start) : int(stop)])
    return read if np.array_equal(ordered, wanted) else read[np.searchsorted(ordered, wanted)]


def walk(group: h5py.Group) -> Iterator[tuple[str, h5py.Dataset]]:
    """Yield every dataset below `group` with its path, up to 5,000 keys; no cycle and no link elsewhere."""
    pending: list[tuple[str, h5py.Group, tuple[h5py.Group, ...]]] = [("", group, (group,))]
    seen = 0
    while pending and seen <= MAX_KEYS:
        prefix, current, above = pending.pop(0)
        seen += len(current)
        for name in current:
            item = inside(current, name)
            if isinstance(item, h5py.Group) and item not in above:
                pending.append((f"{prefix}{name}/", item, (*above, item)))
            elif isinstance(item, h5py.Dataset):
                yield f"{prefix}{name}", item


class RecordedRows:
    """How many rows of an episode's series were recorded: all, or fewer where preallocated buffers say so.

    Args:
        capacity: rows of the actions.
    """

    def __init__(self, group: h5py.Group, capacity: int) -> None:
        self.rows, self._capacity, self._is_stated = capacity, capacity, False
        for name in RECORDED:
            stated = group.attrs.get(name)
            if stated is None and isinstance(found := inside(group, name), h5py.Dataset) and not found.shape:
                stated = found[()]
            if isinstance(stated, int | np.integer) and 0 < stated <= capacity:
                self.rows, self._is_stated = int(stated), True
                break

    def of(self, length: int) -> int:
        """Return how many rows of a series are recorded; one row more than actions may be an observation."""
        is_buffer = self._is_stated and (self.rows < self._capacity or length > self.rows + 1)
        return min(length, self.rows) if is_buffer else length


def masks_of(handle: h5py.File) -> dict[str, set[str]]:
    """Return robomimic's filter keys: name -> names of demos."""
    mask = inside(handle, "mask")
    lists = {name: inside(mask, name) for name in mask} if isinstance(mask, h5py.Group) else {}
    return {
        name: {text(row).rsplit("/", 1)[-1] for row in found[()]}
        for name, found in lists.items()
        if isinstance(found, h5py.Dataset) and found.ndim == 1 and not is_elsewhere(found, mask)
    }


def text(value: Any) -> str:
    """Return an attribute or a dataset's value as text; empty when it is not text."""
    if isinstance(value, np.ndarray):
        value = value.reshape(-1)[0] if value.size else b""
    if isinstance(value, bytes):
        value = value.decode("utf-8", errors="replace")
    return str(value).strip().strip('"').strip("\x00").strip() if isinstance(value, str) else ""


def json_of(holder: Any, name: str) -> dict[str, Any]:
    """Return the mapping that an attribute holds as JSON; empty where it holds none."""
    try:
        value = json.loads(text(holder.attrs.get(name)))
    except (ValueError, RecursionError):  # of numbers with too many digits too
        return {}
    return value if isinstance(value, dict) else {}
