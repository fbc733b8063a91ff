"""Open a TFDS folder: its version, its splits, its shards, and the place of each episode in them.

`dataset_info.json` gives the number of records of each shard of a split, so an episode is found without
opening the other shards. Shards that it does not list are found by name and counted. Paths are of an fsspec
file system, which is local unless the URI names another.
"""

import json
import os
from bisect import bisect_right
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import fsspec

from hma_data.errors import EpisodeError, SourceError
from hma_data.sources.base import leaves
from hma_data.sources.rlds.features import Feature, read_features
from hma_data.sources.rlds.record_file import RecordFile, is_array_record, open_records
from hma_data.sources.rlds.record_index import EMPTY, Framing
from hma_data.sources.rlds.shard_files import FORMATS, Shard, named_shards, stated_shards
from hma_data.sources.rlds.tf_example import Example
from hma_data.storage.fetch import attempt, fetch_whole, file_system, is_listless, is_local

LISTED = 10_000  # most missing records of a shard that are listed and quarantined one by one
LONGEST_JSON = 64 << 20  # most bytes of a description; more is an error


@dataclass(frozen=True)
class Folder:
    """One version of a TFDS dataset.

    Attributes:
        uri: as given.
        files: fsspec file system of the paths.
        root: the folder, on it.
        features: leaves of features.json by name.
        splits: name -> the shards that are there, in order.
        name, version: of the dataset; empty when not stated.
        problems: contradictions in the dataset, one sentence each.
    """

    uri: str
    files: Any
    root: str
    features: dict[str, Feature]
    splits: dict[str, tuple[Shard, ...]]
    name: str = ""
    version: str = ""
    problems: tuple[str, ...] = ()

    @cached_property
    def step_features(self) -> dict[str, Feature]:
        """Return the features over the steps by their path in a step; without `steps`, by their name."""
        inside = {
            name.removeprefix("steps/"): leaf
            for name, leaf in self.features.items()
            if name.startswith("steps/")
        }
        return inside or {name: leaf for name, leaf in self.features.items() if leaf.nesting}

    @property
    def remote(self) -> bool:
        """Check whether every read of a file is a request over the network."""
        return not is_local(self.files)

    def framing(self, shard: Shard, limit: int = -1) -> Framing:
        """Return where the shard's records lie; for a remote shard at least the first `limit`, -1 for all.

        Raises:
            SourceError: it cannot be read, or has more records than dataset_info.json says.
        """
        if self.leaves(shard):
            return replace(EMPTY, fault="is a link to a file outside the dataset's folder", whole=True)
        frames = self.records(shard).framing(limit)
        if shard.records is not None and len(frames) > shard.records:
            raise SourceError(
                shard.path,
                f"has {len(frames)} records, dataset_info.json says {shard.records}",
                "write dataset_info.json again, or remove it: the records are then counted",
            )
        self.believe(shard, LISTED * (len(frames) + 1))
        return frames

    def believe(self, shard: Shard, most: int) -> None:
        """Refuse a record count in dataset_info.json that is too high for the shard.

        Raises:
            SourceError: it states more than `most` records, and more than 10,000.
        """
        if shard.records is not None and shard.records > max(most, LISTED):
            raise SourceError(
                shard.path,
                f"cannot have the {shard.records:,} records that dataset_info.json says",
                "write dataset_info.json again, or remove it: the records are then counted",
            )

    def records(self, shard: Shard) -> RecordFile:
        """Return the shard's file.

        Raises:
            SourceError: it is not there, or the file system does not answer.
        """
        return open_records(self.files, shard.path)

    def leaves(self, shard: Shard) -> bool:
        """Check whether the shard is a link to a file outside the dataset's folder."""
        return not self.remote and leaves(Path(shard.path), Path(self.root))

    def example(self, episode_id: str) -> tuple[Example, str]:
        """Return an episode's parsed record and the path of its shard.

        Raises:
            EpisodeError: there is no such episode, or its bytes are damaged or missing.
        """
        split, _, index = episode_id.partition("/")
        shards = self.splits.get(split, ())
        if not shards or not index.isdecimal():
            raise EpisodeError(
                episode_id, f"is not in {self.uri}; an id is like {next(iter(self.splits))}/000000"
            )
        shard = shards[max(0, bisect_right([item.first for item in shards], int(index)) - 1)]
        position = int(index) - shard.first
        if not 0 <= position < self.counted(shard):
            raise EpisodeError(episode_id, f"lies in no shard of {self.uri}")
        frames = self.framing(shard, position + 1)
        if position >= len(frames):
            fault = frames.fault or f"ends after {len(frames)} of {shard.records} records"
            raise EpisodeError(episode_id, f"{shard.path}: {fault}")
        return Example(self.records(shard).read(position, episode_id), episode_id), shard.path

    def counted(self, shard: Shard) -> int:
        """Count the episodes that the shard should have; a record cut off at the end counts."""
        if shard.records is not None:
            return shard.records
        frames = self.framing(shard)
        return len(frames) + bool(frames.fault)


def episode_id(split: str, index: int) -> str:
    """Return an episode's id, for example train/000012."""
    return f"{split}/{index:06d}"


def open_folder(uri: str) -> Folder:
    """Open the TFDS dataset at `uri`, which is cached for the process.

    The URI is a version folder, a folder above with one version, or one shard of the dataset. A local folder
    is cached while its descriptions stay the same, a remote one for good.

    Raises:
        SourceError: there is none, or its description cannot be read.
        MissingDependencyError: the URI's file system needs a package that is not installed.
    """
    remote = "://" in uri and not uri.startswith("file://")
    return _remote(uri, os.getpid()) if remote else _find(uri)


@lru_cache(maxsize=64)
def _remote(uri: str, pid: int) -> Folder:
    return _find(uri)


def _find(uri: str) -> Folder:
    files, path = _file_system(uri)
    is_file = not is_listless(files) and attempt(files, uri, lambda: files.isfile(path))
    only = path if is_file else ""
    above = files._parent(path) if only else path
    root = attempt(files, uri, lambda: _version_folder(uri, files, above))
    stamps = [_stamp(files, f"{root}/{name}") for name in ("", "features.json", "dataset_info.json")]
    return _open(uri, files, root, only, tuple(stamps), os.getpid())


def _file_system(uri: str) -> tuple[Any, str]:
    if "://" not in uri:  # a plain path, even where it contains fsspec's signs for chained file systems
        return fsspec.filesystem("file"), str(Path(uri).expanduser().absolute())
    try:
        files, path = file_system(uri)
    except ValueError as fault:
        raise SourceError(uri, str(fault), "give a path or an fsspec URI such as gs://bucket/path") from fault
    return files, path.rstrip("/")


def _stamp(files: Any, path: str) -> str:
    """Return a text that changes when a local file or folder does; empty for a remote one."""
    try:
        return str(Path(path).stat().st_mtime_ns) if is_local(files) else ""
    except FileNotFoundError:
        return "none"


def _version_folder(uri: str, files: Any, path: str) -> str:
    """Return the folder with features.json, at most two levels below `path` (configuration and version)."""
    if _is_described(files, path):
        return path
    if not files.exists(path) and not is_listless(files):
        raise SourceError(uri, "does not exist", "check --source, or source.uri in the embodiment's YAML")
    found = _described(files, path)
    if len(found) == 1:
        return files._parent(found[0])
    if found:
        names = ", ".join(sorted(files._parent(item)[len(path) + 1 :] for item in found))
        raise SourceError(uri, f"holds several datasets or versions: {names}", "give the folder of one")
    raise SourceError(
        uri,
        "has no features.json",
        "records cannot be understood without; copy it from where they are from, or write it with TFDS",
    )


def _is_described(files: Any, path: str) -> bool:
    if not is_listless(files):
        return bool(files.isfile(f"{path}/features.json"))
    try:  # on a web server, isfile() reports a lost connection as a missing file
        files.cat_file(f"{path}/features.json", start=0, end=1)
    except FileNotFoundError:
        return False
    return True


def _described(files: Any, path: str) -> list[str]:
    """Return the paths of all features.json one or two folders below `path`."""
    patterns = ("*/features.json", "*/*/features.json")
    if is_listless(files):
        return []
    if is_local(files):  # its name may contain the wildcards of patterns
        return [str(found) for pattern in patterns for found in sorted(Path(path).glob(pattern))]
    return [str(found) for pattern in patterns for found in files.glob(f"{path}/{pattern}")]


@lru_cache(maxsize=64)
def _open(uri: str, files: Any, root: str, only: str, stamps: tuple[str, ...], pid: int) -> Folder:
    """Make the folder of `open_folder`; the cache holds while the folder is unchanged, not across a fork."""
    described = _text(files, root, "features.json")
    if described is None:
        raise SourceError(uri, "has no features.json", "copy it from where the records are from")
    features = read_features(described, f"{root}/features.json")
    info = _info(files, root)
    listing = (
        None if is_listless(files) else attempt(files, uri, lambda: sorted(files.find(root, maxdepth=2)))
    )
    if only:
        listing = [only]
    shards, problems = stated_shards(root, info, listing)
    if not shards:
        shards, more = named_shards(root, listing or [], info)
        problems += more
    paths = [shard.path for items in shards.values() for shard in items]
    if not is_local(files) and any(map(is_array_record, paths)):
        raise SourceError(
            uri, "holds ArrayRecord files, which are read from this machine's disks only", "copy it here"
        )
    if only:  # the user chose one shard: the others are not missing
        problems = []
    folder = Folder(
        uri,
        files,
        root,
        features,
        {},
        str(info.get("name", "")),
        str(info.get("version", "")),
        tuple(problems),
    )
    splits = {split: _placed(folder, items) for split, items in shards.items()}
    if not any(splits.values()):
        raise SourceError(
            uri, "holds no TFRecord or ArrayRecord file", "names are like name-train.tfrecord-00000-of-00001"
        )
    return replace(folder, splits={split: items for split, items in splits.items() if items})


def _text(files: Any, root: str, name: str) -> str | None:
    """Return the text of a description in the folder; None where there is no such file."""
    path = f"{root}/{name}"
    if is_local(files) and leaves(Path(path), Path(root)):
        raise SourceError(path, "is a link to a file outside its folder", "copy the file in")
    data = fetch_whole(files, path, LONGEST_JSON)
    try:
        return None if data is None else data.decode()
    except UnicodeDecodeError as fault:
        raise SourceError(path, f"is not text: {fault}", "copy it again") from fault


def _info(files: Any, root: str) -> dict[str, Any]:
    """Return the content of dataset_info.json; empty where there is none."""
    path = f"{root}/dataset_info.json"
    text = _text(files, root, "dataset_info.json")
    try:
        info = {} if text is None else json.loads(text)
    except (ValueError, RecursionError) as fault:
        raise SourceError(path, f"is not JSON: {fault}", "write it again, or remove it") from fault
    if not isinstance(info, dict) or not _are_splits(info.get("splits", [])):
        raise SourceError(path, "is not what TFDS writes", "write it again, or remove it")
    form = info.get("fileFormat") or info.get("file_format") or FORMATS[0]
    if form not in FORMATS:
        raise SourceError(
            path, f"states the file format {form!r}", "convert it to tfrecord with tensorflow_datasets"
        )
    return info


def _are_splits(splits: Any) -> bool:
    """Check whether the splits have the form that TFDS writes; their values are not checked."""
    return isinstance(splits, list) and all(
        isinstance(split, dict)
        and isinstance(split.get("filepathTemplate") or split.get("filepath_template") or "", str)
        and isinstance(split.get("shardLengths") or split.get("shard_lengths") or [], list)
        for split in splits
    )


def _placed(folder: Folder, shards: list[Shard]) -> tuple[Shard, ...]:
    """Return the shards with `first` set; count the records where dataset_info.json does not state them."""
    if all(shard.records is not None for shard in shards):
        return tuple(shards)
    placed, first = [], 0
    for shard in shards:
        placed.append(replace(shard, first=first))
        first += folder.counted(shard)
    return tuple(placed)
