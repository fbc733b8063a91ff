"""Open a TFDS folder: its version, its splits, its shards, and the place of each episode in them.

`dataset_info.json` names the shards of each split by a template and gives the number of records of each, so
an episode is found without opening the other shards. Paths are of this machine or of a store.
"""

import math
import re
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass
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
    count: int  # how many records dataset_info.json states; some may be cut off
    first: int  # index within the split of its first record

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
        if len(frames) > self.count:
            fault = f"has {len(frames)} records, dataset_info.json says {self.count}"
            raise SourceError(self.path, fault, "write dataset_info.json again with TFDS")
        return frames


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
        """Return the features over the steps by their path in a step."""
        found = self.features.items()
        return {name.removeprefix("steps/"): leaf for name, leaf in found if name.startswith("steps/")}

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
            size, mean = records.blocks.size, records.blocks.size / max(shard.count, 1)
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
        if not 0 <= position < shard.count:
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
    features = read_features(_description(root / "features.json"), str(root / "features.json"))
    info = _dataset_info(root / "dataset_info.json")
    if info.file_format not in ("tfrecord", "array_record"):
        fault = f"holds {info.file_format} files; TFRecord and ArrayRecord files can be read"
        raise SourceError(uri, fault, "write it again with TFDS, as file_format tfrecord")
    listing = {only} if only else _files_in(root) if _lists(root) else None
    splits, problems = _shards(root, info, listing)
    if not splits:
        named = [info.shard_path(split, 0) for split in info.splits]
        remedy = f"their names are like {named[0]}" if named else "it names none: write it with TFDS"
        raise SourceError(uri, "holds no file that dataset_info.json names", remedy)
    return RldsFolder(
        uri=uri,
        features=features,
        splits=splits,
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


def _files_in(root: Path) -> set[Path]:
    """Return the files of a folder and of those directly below it."""
    found = (path for pattern in ("*", "*/*") for path in root.glob(pattern))
    with explained(root):
        return {path for path in found if is_remote(root) or path.is_file()}


def _description(path: Path) -> bytes:
    """Return the bytes of a description."""
    with explained(path):
        if not is_remote(path) and path.is_file() and (size := path.stat().st_size) > LONGEST_JSON:
            fault = f"has {size:,} bytes, more than {LONGEST_JSON:,}"
            raise SourceError(path, fault, "a description by TFDS is smaller: check the file")
        try:
            return path.read_bytes()
        except ABSENT as fault:
            said = f"has no {path.name}, without which its records cannot be understood"
            remedy = "copy it from where the records are from, or write it with TFDS"
            raise SourceError(path.parent, said, remedy) from fault


def _dataset_info(path: Path) -> _DatasetInfo:
    try:
        return _DatasetInfo.model_validate_json(_description(path))
    except ValidationError as fault:
        raise SourceError(path, first_fault(fault), "write it again with tensorflow_datasets") from fault


def _shards(
    root: Path, info: _DatasetInfo, listing: set[Path] | None
) -> tuple[dict[str, tuple[Shard, ...]], list[str]]:
    """Return the shards that dataset_info.json names and that are there, and what is missing.

    Args:
        listing: the files that are there; None where they cannot be listed.
    """
    splits: dict[str, tuple[Shard, ...]] = {}
    problems = []
    for split in info.splits:
        counts = split.shard_lengths
        firsts = accumulate(counts, initial=0)
        items = [
            Shard(root / info.shard_path(split, number), count, first)
            for number, (count, first) in enumerate(zip(counts, firsts))
        ]
        present = tuple(item for item in items if listing is None or item.path in listing)
        if present:
            splits[split.name] = present
        elif sum(counts):
            problems.append(f"split {split.name} of {sum(counts):,} episodes is missing")
        if 0 < len(present) < len(items):
            said = f"{len(items) - len(present)} of {len(items)} shards of split {split.name} are missing"
            problems.append(said)
    return splits, problems
