"""Open a TFDS folder: its version, its splits, its shards, and the place of each episode in them.

`dataset_info.json` names the shards of each split by a template and gives the number of records of each, so
an episode is found without opening the other shards. Shards that it does not list are found by name and
counted. Paths are of this machine or of a store.
"""

import math
import re
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.alias_generators import to_camel

from hma_data.errors import EpisodeError, SourceError
from hma_data.sources.common.places import is_away, local_path
from hma_data.sources.rlds.example import Example
from hma_data.sources.rlds.features import RldsFeature, read_features
from hma_data.sources.rlds.records import RecordFile, RecordFraming, explained, open_records
from hma_data.storage.blocks import Blocks
from hma_data.storage.fetch import ABSENT
from hma_data.storage.remote import RemotePath, is_remote, place
from hma_data.storage.yaml_io import first_fault

LONGEST_JSON = 64 << 20  # most bytes of a description; more is an error
MAX_RECORDS = 1_000_000  # that a shard may state
TEMPLATE = "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}"
NUMBER = r"-(?P<shard>\d{5,})(?:-of-(?P<shards>\d{5,}))?"
NAMED = (  # forms of file names: the suffix after the number, or before it as TFDS writes it
    re.compile(rf"(?P<stem>.+?)[-_]{NUMBER[1:]}\.(?:tfrecord|array_record)"),
    re.compile(rf"(?P<stem>.+)\.(?:tfrecord|array_record)(?:{NUMBER})?"),
)


class _StatedSplit(BaseModel):
    model_config = ConfigDict(alias_generator=to_camel)

    name: str = ""
    filepath_template: str = TEMPLATE
    shard_lengths: tuple[Annotated[int, Field(ge=0, le=MAX_RECORDS)], ...] = ()


class _DatasetInfo(BaseModel):
    model_config = ConfigDict(alias_generator=to_camel)

    name: str = ""
    version: str = ""
    file_format: str = "tfrecord"
    splits: tuple[_StatedSplit, ...] = ()

    def shard_path(self, split: _StatedSplit, number: int) -> str:
        shards = len(split.shard_lengths)
        digits = max(5, len(str(shards)))
        place, total = f"{number:0{digits}d}", f"{shards:0{digits}d}"
        values = {
            "DATASET": self.name,
            "SPLIT": split.name,
            "FILEFORMAT": self.file_format,
            "SHARD_INDEX": place,
            "NUM_SHARDS": total,
            "SHARD_X_OF_Y": f"{place}-of-{total}",
        }
        template = split.filepath_template.split("%")[0]
        return re.sub(r"\{(\w+)\}", lambda match: values.get(match[1], match[0]), template)


@dataclass(frozen=True)
class Shard:
    """One TFRecord or ArrayRecord file of a split."""

    path: Path
    number: int  # its place in the split
    stated: int | None  # how many records dataset_info.json states; None where it states none
    first: int = 0  # index within the split of its first record

    @property
    def records(self) -> RecordFile:
        """Return the shard's file.

        Raises:
            SourceError: it is not there, or the file system does not answer.
        """
        return open_records(self.path)

    def framing(self, limit: int = -1) -> RecordFraming:
        """Return where the shard's records lie; see `RecordFile.framing`.

        Raises:
            SourceError: it cannot be read, or has more records than dataset_info.json says.
        """
        frames = self.records.framing(limit)
        if self.stated is not None and len(frames) > self.stated:
            fault = f"has {len(frames)} records, dataset_info.json says {self.stated}"
            remedy = "write dataset_info.json again, or remove it: then the records are counted"
            raise SourceError(self.path, fault, remedy)
        return frames

    def count(self) -> int:
        """Count the episodes that the shard should have; a record cut off at the end counts."""
        if self.stated is not None:
            return self.stated
        frames = self.framing()
        return len(frames) + bool(frames.fault)


@dataclass(frozen=True)
class RldsFolder:
    """One version of a TFDS dataset."""

    uri: str  # as given
    features: dict[str, RldsFeature]  # leaves of features.json by name
    splits: dict[str, tuple[Shard, ...]]  # the shards that are there, in order
    remote: bool  # whether every read of a file is a request over the network
    name: str  # of the dataset; empty when not stated, as is `version`
    version: str
    problems: tuple[str, ...]  # contradictions in the dataset, one sentence each

    @cached_property
    def step_features(self) -> dict[str, RldsFeature]:
        """Return the features over the steps by their path in a step; without `steps`, by their name."""
        found = self.features.items()
        inside = {name.removeprefix("steps/"): leaf for name, leaf in found if name.startswith("steps/")}
        return inside or {name: leaf for name, leaf in found if leaf.nesting}

    def example(self, episode_id: str) -> tuple[Example, str]:
        """Return an episode's parsed record and the path of its shard.

        Raises:
            EpisodeError: there is no such episode, or its bytes are damaged or missing.
        """
        shard, position = self._place(episode_id)
        return Example(shard.records.read(position, episode_id), episode_id), str(shard.path)

    def expect(self, episode_ids: Iterable[str]) -> None:
        """State which episodes will be read next, in that order; remote shards are then fetched ahead.

        Where an episode lies in its shard is estimated from its number. A shard of which less than half is
        wanted is not fetched ahead.

        Raises:
            HMAError: there is no such episode, or a shard cannot be found.
        """
        wanted: dict[Path, tuple[Shard, list[int]]] = {}
        for name in episode_ids if self.remote else ():
            shard, position = self._place(name)
            wanted.setdefault(shard.path, (shard, []))[1].append(position)
        before: Blocks | None = None
        for shard, positions in wanted.values():
            first, stop, records = min(positions), max(positions) + 1, shard.records
            if records.blocks is None or 2 * len(positions) < stop - first:
                continue
            size, mean = records.blocks.size, records.blocks.size / max(shard.count(), 1)
            begin, end = max(0, int((first - 1) * mean)), min(size, math.ceil((stop + 1) * mean))
            records.blocks.expect([(begin, end)])
            if before:
                before.follow(records.blocks)
            records.blocks.follow(None)
            before = records.blocks

    def _place(self, episode_id: str) -> tuple[Shard, int]:
        """Return the shard of an episode, and the number of its record there."""
        split, _, index = episode_id.partition("/")
        shards = self.splits.get(split, ())
        if not shards or not index.isdecimal():
            like = f"{next(iter(self.splits))}/000000"
            raise EpisodeError(episode_id, f"is not in {self.uri}; an id is like {like}")
        shard = shards[max(0, bisect_right(shards, int(index), key=lambda item: item.first) - 1)]
        position = int(index) - shard.first
        if not 0 <= position < shard.count():
            raise EpisodeError(episode_id, f"is in no shard of {self.uri}")
        return shard, position


def episode_id(split: str, index: int) -> str:
    """Return an episode's id, for example train/000012."""
    return f"{split}/{index:06d}"


def open_folder(uri: str) -> RldsFolder:
    """Open the TFDS dataset at `uri`: a version folder, a folder above with one version, or one shard.

    Raises:
        SourceError: there is none, or its description cannot be read.
        MissingDependencyError: the URI's file system needs a package that is not installed.
    """
    path = place(uri) if is_away(uri) else local_path(uri).absolute()
    only = path if _lists(path) and path.is_file() else None  # the one shard that the user chose
    root = _version_folder(uri, path.parent if only else path)
    described = _description(root / "features.json")
    if described is None:
        fault = "has no features.json, without which its records cannot be understood"
        raise SourceError(uri, fault, "copy it from where the records are from, or write it with TFDS")
    info = _dataset_info(root / "dataset_info.json")
    if info.file_format not in ("tfrecord", "array_record"):
        fault = f"holds {info.file_format} files; TFRecord and ArrayRecord files can be read"
        raise SourceError(uri, fault, "write it again with TFDS, as file_format tfrecord")
    listing = [only] if only else _files_in(root) if _lists(root) else None
    shards, problems = _stated_shards(root, info, listing)
    if not shards:
        shards, more = _named_shards(root, info, listing or [])
        problems += more
    if not shards:
        fault = "holds no TFRecord file"
        raise SourceError(uri, fault, "names are like name-train.tfrecord-00000-of-00001")
    return RldsFolder(
        uri=uri,
        features=read_features(described, str(root / "features.json")),
        splits={split: _counted(items) for split, items in shards.items()},
        remote=is_remote(root),
        name=info.name,
        version=info.version,
        problems=() if only else tuple(problems),  # of one shard, the others are not missing
    )


def _lists(path: Path) -> bool:
    return not isinstance(path, RemotePath) or path.lists


def _version_folder(uri: str, path: Path) -> Path:
    """Return the folder with features.json: `path`, or one at most two levels below it."""
    if not _lists(path) or (path / "features.json").is_file():
        return path
    if not path.exists():
        raise SourceError(uri, "does not exist", "check the path, or source.uri in the embodiment's YAML")
    patterns = ("*/features.json", "*/*/features.json")
    folders = [found.parent for pattern in patterns for found in path.glob(pattern)]
    if len(folders) > 1:
        names = ", ".join(sorted(folder.relative_to(path).as_posix() for folder in folders))
        raise SourceError(uri, f"holds several datasets or versions: {names}", "give the folder of one")
    return folders[0] if folders else path


def _files_in(root: Path) -> list[Path]:
    """Return the files of a folder and of those directly below it, sorted."""
    found = (path for pattern in ("*", "*/*") for path in root.glob(pattern))
    with explained(root):
        return sorted(path for path in found if is_remote(root) or path.is_file())


def _description(path: Path) -> bytes | None:
    """Return the bytes of a description; None where there is none."""
    with explained(path):
        if not is_remote(path) and path.is_file() and (size := path.stat().st_size) > LONGEST_JSON:
            fault = f"has {size:,} bytes, more than {LONGEST_JSON:,}"
            raise SourceError(path, fault, "a description by TFDS is smaller: check the file")
        try:
            return path.read_bytes()
        except ABSENT:
            return None


def _dataset_info(path: Path) -> _DatasetInfo:
    data = _description(path)
    try:
        return _DatasetInfo() if data is None else _DatasetInfo.model_validate_json(data)
    except ValidationError as fault:
        remedy = "write it again with tensorflow_datasets, or remove it"
        raise SourceError(path, first_fault(fault), remedy) from fault


def _counted(shards: list[Shard]) -> tuple[Shard, ...]:
    """Return the shards with `first` set; count the records where dataset_info.json does not state them."""
    if all(shard.stated is not None for shard in shards):
        return tuple(shards)
    firsts = accumulate((shard.count() for shard in shards), initial=0)
    return tuple(replace(shard, first=first) for shard, first in zip(shards, firsts))


def _stated_shards(
    root: Path, info: _DatasetInfo, listing: list[Path] | None
) -> tuple[dict[str, list[Shard]], list[str]]:
    """Return the existing shards that dataset_info.json names, and what is missing."""
    there = None if listing is None else set(listing)
    shards: dict[str, list[Shard]] = {}
    problems, absent = [], []
    for split in info.splits:
        counts = split.shard_lengths
        firsts = accumulate(counts, initial=0)
        items = [
            Shard(root / info.shard_path(split, number), number, records, first)
            for number, (records, first) in enumerate(zip(counts, firsts))
        ]
        present = [item for item in items if there is None or item.path in there]
        if present:
            shards[split.name] = present
            problems += _missing(split.name, len(present), len(items))
        elif sum(counts):
            absent.append(f"split {split.name} of {sum(counts):,} episodes is missing")
    return shards, problems + absent if shards else problems


def _named_shards(
    root: Path, info: _DatasetInfo, listing: Iterable[Path]
) -> tuple[dict[str, list[Shard]], list[str]]:
    """Return the same for a renamed dataset, or one without dataset_info.json, by the shards' names alone."""
    stated = {split.name: split.shard_lengths for split in info.splits}
    shards: dict[str, list[Shard]] = {}
    totals: dict[str, int] = {}
    for path in listing:
        match = next((found for form in NAMED if (found := form.fullmatch(path.name))), None)
        if not match:
            continue
        above = path.parent.relative_to(root).as_posix()
        split = _split_of(match["stem"], info.name, stated) if above == "." else above
        parts = match.groupdict()
        number = int(parts["shard"] or len(shards.get(split, ())))
        totals[split] = max(totals.get(split, 0), int(parts["shards"] or 0))
        counts = stated.get(split, ())
        records = counts[number] if number < len(counts) else None
        shards.setdefault(split, []).append(Shard(path, number, records, sum(counts[:number])))
    problems = []
    for split, items in shards.items():
        items.sort(key=lambda item: item.number)
        problems += _missing(split, len(items), totals[split])
    return shards, problems


def _missing(split: str, present: int, shards: int) -> list[str]:
    said = f"{shards - present} of {shards} shards of split {split} are missing"
    return [said] if present < shards else []


def _split_of(stem: str, dataset: str, stated: Iterable[str]) -> str:
    """Return the split in a file's name, e.g. train of toy-train; a split's name may have hyphens itself."""
    for split in sorted(stated, key=len, reverse=True):
        if stem == split or stem.endswith(f"-{split}"):
            return split
    if dataset and stem.startswith(f"{dataset}-"):
        return stem[len(dataset) + 1 :]
    return stem.rsplit("-", 1)[-1]
