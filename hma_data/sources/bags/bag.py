"""Open a bag: one recording, in one file or in a ROS 2 folder of several files; detect its format."""

import logging
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import groupby
from operator import itemgetter
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

import zstandard

from hma_data.errors import EpisodeError, OutputError
from hma_data.sources.bags.container import (
    ALL,
    MAX_CHUNK,
    Channel,
    Chunks,
    Data,
    Record,
    RecordFilter,
    damaged,
    kept_chunks,
    reading,
    unzstd,
)
from hma_data.sources.bags.mcap import MAGIC as MCAP_MAGIC
from hma_data.sources.bags.mcap import McapFile
from hma_data.sources.bags.ros_files import ROS1_MAGIC, SQLITE_MAGIC, Ros1File, SqliteFile
from hma_data.sources.common.places import file_fingerprint, first_bytes, natural, require_inside
from hma_data.storage.fetch import mark
from hma_data.storage.remote import RemotePath, is_remote
from hma_data.storage.yaml_io import read_yaml

SUFFIXES = (".bag", ".mcap", ".db3")
MAX_EXPANSION = 200  # most times its packed size that a file may have unpacked, against decompression bombs
Container = McapFile | Ros1File | SqliteFile
BagPlace = tuple[int, int, int]  # of a message: the file of the bag, and two numbers for the place in it
log = logging.getLogger(__name__)


class Bag:
    """One recording. It is cheap to make, holds no open files, and keeps unpacked chunks up to a fixed size.

    Args:
        path: a bag file, or a folder with rosbag2's metadata.yaml.
        root: a link that leads out of this folder is refused; default the bag itself.
        parts: the files that continue it, as `find_bags` finds them.

    Raises:
        EpisodeError: it cannot be a bag, by its first bytes or its metadata.
    """

    def __init__(self, path: Path, root: Path | None = None, parts: Sequence[Path] = ()) -> None:
        self.path = path
        described = path / "metadata.yaml"
        self._metadata = _information(described, _state(described)) if path.is_dir() else {}
        self.remarks: tuple[str, ...] = ()  # what its folder has beside what is read, one sentence each
        self._paths = [path, *parts]
        self._stated = False  # whether the metadata describes all of its files
        if path.is_dir():
            self._paths, self.remarks = _listed(path, self._metadata)
            self._stated = not self.remarks
        elif parts:
            said = f"{path.name} to {parts[-1].name} follow each other without a pause"
            self.remarks = (f"{said}: the {len(self._paths)} files are read as one recording",)
        self._message_packed = str(self._metadata.get("compression_mode", "")).lower() == "message"
        self._unpacked: tempfile.TemporaryDirectory[str] | None = None
        self._files: list[Container] | None = None
        self._counts: Counter[Channel] | None = None
        root = root or path
        for item in () if is_remote(path) else self._paths:
            if item != root:
                remedy = "copy the file in, or give its own path"
                require_inside(item, root if root.is_dir() else root.parent, remedy)

    def files(self) -> list[Container]:
        """Return its files in recording order.

        Packed files (.zstd) are unpacked to a temporary folder, and remote sqlite3 files are copied there.
        """
        if self._files is None:
            chunks = kept_chunks()
            self._files = [_container(self._plain(path), chunks) for path in self._paths]
        return self._files

    def notes(self) -> dict[str, str]:
        """Return the entries of MCAP metadata records; empty for the other formats."""
        found: dict[str, str] = {}
        for file in self.files():
            if isinstance(file, McapFile):
                found |= file.notes()
        return found

    def counts(self) -> Counter[Channel]:
        """Count the messages of each channel, from indexes where there are any."""
        if self._counts is None:
            packed = any(path.suffix == ".zstd" for path in self._paths)
            counts = self._stated_counts() if packed and self._stated else Counter[Channel]()
            for file in () if counts else self.files():
                counts.update(file.counts())
            self._counts = counts
        return self._counts

    def topics(self) -> Counter[str]:
        """Count the messages of each topic."""
        topics: Counter[str] = Counter()
        for channel, count in self.counts().items():
            topics[channel.topic] += count
        return topics

    def span(self) -> tuple[int, int]:
        """Return the earliest and latest time of receipt."""
        spans = [file.span() for file in self.files()]
        return min(first_ns for first_ns, _ in spans), max(last_ns for _, last_ns in spans)

    def records(self, wanted: RecordFilter = ALL) -> Iterator[tuple[BagPlace, Record]]:
        """Yield the wanted messages, file by file; a time range costs about its own bytes."""
        for number, file in enumerate(self.files()):
            for record in file.records(wanted):
                yield (number, *record.place), self._plain_record(record)

    def before(self, topics: frozenset[str], log_ns: int) -> list[tuple[BagPlace, Record]]:
        """Return each topic's last message received before that time, from the last file that has one."""
        found: dict[str, tuple[BagPlace, Record]] = {}
        for number, file in reversed(list(enumerate(self.files()))):
            missing = topics - found.keys()
            for topic, record in file.before(missing, log_ns).items() if missing else ():
                found[topic] = ((number, *record.place), self._plain_record(record))
        return sorted(found.values(), key=itemgetter(0))

    def payloads(self, places: Sequence[BagPlace]) -> Iterator[Data]:
        """Yield the data of the messages at those places, in that order."""
        files = self.files()
        for number, group in groupby(places, key=itemgetter(0)):
            for data in files[number].payloads([(first, second) for _, first, second in group]):
                yield self._unpack(data) if self._message_packed else data

    def fingerprint(self) -> str:
        """Return a text that changes when a byte of the bag does; see EpisodeRef."""
        return "-".join(file_fingerprint(path) for path in self._paths)

    def state(self) -> tuple[tuple[str, int, int], ...]:
        """Return size and time of change of its files, and of sqlite3's logs; the key for caching it."""
        logs = [] if is_remote(self.path) else [path.with_name(path.name + "-wal") for path in self._paths]
        return tuple(_state(path) for path in [*self._paths, *(log for log in logs if log.is_file())])

    def _plain_record(self, record: Record) -> Record:
        return record._replace(data=self._unpack(record.data)) if self._message_packed else record

    def _unpack(self, data: Data) -> bytes:
        with reading(self.path):
            unpacked = unzstd(data, MAX_CHUNK)
            if len(unpacked) > MAX_CHUNK:
                raise ValueError(f"a message unpacks to more than {MAX_CHUNK:,} bytes")
        return unpacked

    def _plain(self, path: Path) -> Path:
        """Return the path, or that of the temporary file where it cannot be read in its place."""
        packed = path.suffix == ".zstd"
        if not packed and not (is_remote(path) and path.suffix == ".db3"):
            return path
        if self._unpacked is None:
            self._unpacked = tempfile.TemporaryDirectory(prefix="hma-bag-")
        target = Path(self._unpacked.name) / (path.stem if packed else path.name)
        with reading(path), path.open("rb") as file, target.open("wb") as plain:
            if packed:
                _unpack_file(file, plain, path.stat().st_size * MAX_EXPANSION)
            else:
                _require_space(path, target.parent)
                shutil.copyfileobj(file, plain, 8 << 20)
        return target

    def _stated_counts(self) -> Counter[Channel]:
        total: Counter[Channel] = Counter()
        with reading(self.path):
            for item in self._metadata.get("topics_with_message_count") or ():
                topic = item["topic_metadata"]
                channel = Channel(str(topic["name"]), str(topic["type"]), str(topic["serialization_format"]))
                total[channel] += int(item["message_count"])
        return total


def _unpack_file(packed: BinaryIO, plain: BinaryIO, limit: int) -> None:
    for piece in zstandard.ZstdDecompressor().read_to_iter(packed):
        plain.write(piece)
        if plain.tell() > limit:
            raise ValueError(f"it unpacks to more than {MAX_EXPANSION} times its size")


def _require_space(path: Path, folder: Path) -> None:
    """Raise OutputError where a folder has no space for the copy of a file."""
    size, free = path.stat().st_size, shutil.disk_usage(folder).free
    log.info("%s: sqlite3 needs a local file; %s bytes are copied to %s", path, f"{size:,}", folder)
    if size > free:
        fault = f"must be copied here to be read: it has {size:,} bytes, and {folder} has {free:,} free"
        raise OutputError(path, fault, "set TMPDIR to a larger disk, or write it as MCAP (ros2 bag convert)")


def find_bags(root: Path) -> dict[str, list[Path]]:
    """Return episode id -> bag at or under a path and the files that continue it, in order of the ids.

    An id is the path relative to `root` without suffix; the suffix stays where two ids would be equal. A
    folder with rosbag2's metadata.yaml is one bag. Elsewhere every bag file is one, but files that a recorder
    split (run_0.mcap, run_1.mcap) are one bag together, and its id is `run`.
    """
    if root.is_file() or is_bag_folder(root):
        return {root.stem if root.is_file() else root.name: [root]}
    files = [path for path in root.rglob("*") if _is_bag_name(path.name) or path.name == "metadata.yaml"]
    folders = {path.parent for path in files if path.name == "metadata.yaml" and is_bag_folder(path.parent)}
    found = [(path.relative_to(root).as_posix(), [path]) for path in folders]  # ids and files
    loose = [path for path in files if _is_bag_name(path.name) and folders.isdisjoint(path.parents)]
    # a link to nothing is told when it is read
    for paths in _recordings(path for path in loose if is_remote(path) or not path.is_dir()):
        place = paths[0].relative_to(root)
        match = SPLIT_PART.fullmatch(place.name) if len(paths) > 1 else None
        found.append(((place.with_name(match["stem"]) if match else place.with_suffix("")).as_posix(), paths))
    counts = Counter(name for name, _ in found)
    named = {
        name if counts[name] == 1 else paths[0].relative_to(root).as_posix(): paths for name, paths in found
    }
    return dict(sorted(named.items()))


def is_bag_folder(path: Path) -> bool:
    """Check whether a folder is a ROS 2 bag."""
    return b"rosbag2_bagfile_information" in first_bytes(path / "metadata.yaml", 4096)


def _container(path: Path, chunks: Chunks) -> Container:
    magic = first_bytes(path, 16)
    if magic.startswith(ROS1_MAGIC):
        return Ros1File(path, chunks)
    if magic.startswith(MCAP_MAGIC):
        return McapFile(path, chunks)
    if magic.startswith(SQLITE_MAGIC):
        return SqliteFile(path)
    known = "a ROS 1 bag (format 2.0), MCAP or sqlite3 file"
    raise damaged(path, f"begins with {magic[:13]!r}, which is not how {known} begins")


def _state(path: Path) -> tuple[str, int, int]:
    """Return what changes when a file does."""
    if isinstance(path, RemotePath):
        found = path.info()
        return f"{path} {mark(found)}", int(found["size"] or 0), 0
    with reading(path):
        stat = path.stat()
    return str(path), stat.st_size, stat.st_mtime_ns


@lru_cache(maxsize=16)  # each segment of a bag asks, and thousands of files or topics take half a second
def _information(where: Path, state: object) -> dict[str, Any]:
    values = read_yaml(where, EpisodeError)
    information = values.get("rosbag2_bagfile_information") if isinstance(values, dict) else None
    if not isinstance(information, dict) or not isinstance(information.get("relative_file_paths"), list):
        raise EpisodeError(where, "names no files of a bag", "run ros2 bag reindex")
    return information


def _listed(folder: Path, metadata: dict[str, Any]) -> tuple[list[Path], tuple[str, ...]]:
    """Return the files of a bag's folder in order, and remarks on files that metadata.yaml does not name.

    A recorder that was killed leaves a metadata.yaml that names only some of the parts.
    """
    where, names = folder / "metadata.yaml", metadata["relative_file_paths"]
    paths = [_named_file(folder, PurePosixPath(str(name)).name, where) for name in names]
    named = set(paths)
    others = [path for path in folder.iterdir() if path not in named and _is_bag_name(path.name)]
    stems = {_split_stem(path) for path in paths} - {None}
    parts = [path for path in others if _split_stem(path) in stems]
    left_out = sorted(path.name for path in others if _split_stem(path) not in stems)
    remarks = []
    if parts:
        remarks.append(f"{where} names {len(paths)} of its {len(paths) + len(parts)} files: all are read")
        paths = sorted([*paths, *parts], key=lambda path: natural(path.name))
    if left_out:
        remarks.append(f"{where} does not name {', '.join(left_out[:3])}: left out ({len(left_out)} in all)")
    return paths, tuple(remarks)


def _named_file(folder: Path, name: str, where: Path) -> Path:
    """Return a file that metadata.yaml names: by its last name, because older versions put the folder before.

    Foxy names packed files without the suffix of their packing.
    """
    path = folder / name
    packed = folder / f"{name}.zstd"
    if not path.is_file() and packed.is_file():
        return packed
    if not path.is_file():
        remedy = "copy it in, or remove it from relative_file_paths"
        raise EpisodeError(where, f"names {name}, which is not in the folder", remedy)
    return path


# -- recordings that a recorder split

SPLIT_PART = re.compile(
    r"(?P<stem>.+?)(_\d{4}(-\d\d){5})?_(?P<number>\d+)(?P<suffix>\.(bag|mcap|db3)(\.zstd)?)"
)
MAX_PAUSE_NS = 10**9  # between two parts of one recording; episodes that are recorded apart pause longer
MAX_OVERLAP_NS = 10**8


def _split_stem(path: Path) -> tuple[str, str] | None:
    """Return what the names of all parts of a recording share."""
    match = SPLIT_PART.fullmatch(path.name)
    return (match["stem"], match["suffix"].removesuffix(".zstd")) if match else None


def _is_bag_name(name: str) -> bool:
    # A recorder that was killed leaves run.bag.active.
    return name.removesuffix(".zstd").removesuffix(".active").endswith(SUFFIXES)


def _recordings(files: Iterable[Path]) -> Iterator[list[Path]]:
    """Yield the files of each recording, in order.

    Files that continue one another are numbered on, and each begins when the one before ends. Names alone do
    not tell: episodes recorded one after the other are often numbered too.
    """
    numbered: dict[object, list[tuple[int, Path]]] = {}
    for path in files:
        match = SPLIT_PART.fullmatch(path.name)
        if match is None:
            yield [path]
        else:
            numbered.setdefault((path.parent, _split_stem(path)), []).append((int(match["number"]), path))
    for group in numbered.values():
        parts: list[Path] = []
        last = -1
        for number, path in sorted(group):
            if number == last:  # a part that is there packed too
                yield [path]
                continue
            if parts and not (number == last + 1 and _continues(parts[-1], path)):
                yield parts
                parts = []
            parts.append(path)
            last = number
        yield parts


def _continues(path: Path, following: Path) -> bool:
    try:
        last_ns = _span(path, Bag(path).state())[1]
        first_ns = _span(following, Bag(following).state())[0]
    except EpisodeError:  # reading it raises its error
        return False
    # Messages may change places where a recorder splits, but what overlaps by more is another recording.
    return -MAX_OVERLAP_NS <= first_ns - last_ns <= MAX_PAUSE_NS


@lru_cache(maxsize=4096)
def _span(path: Path, state: tuple[Any, ...]) -> tuple[int, int]:
    return Bag(path).span()
