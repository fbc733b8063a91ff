"""List the recordings and shard sets in a folder that holds several, each with the command that looks at it.

A folder with the marks of a dataset (LeRobot, RLDS, a ROS 2 bag, a shard set) is one entry. Other files are
recognised one by one; where a folder holds files of one format alone, the folder is the entry, because a
source reads it as one recording. Unknown files and hidden folders are passed over; links are not followed.
"""

import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from hma_data.errors import HMAError
from hma_data.registry import FORMATS
from hma_data.sources.base import Recognition, open_source
from hma_data.sources.detect import by_files, recognitions
from hma_data.storage.paths import StrPath, as_path

SHARDS = "shard set"
NEVER_JOINED = ("rlds", "lerobot", SHARDS)  # formats whose folders are never read together as one recording


@dataclass(frozen=True)
class Found:
    """A recording or shard set in a folder.

    Attributes:
        path: of its file or folder.
        format: name of the format, or "shard set".
        beside: a video in a folder of recordings; it is probably a film of them and no recording itself.
        episodes: number of episodes; None where they cannot be counted.
        problem: why not.
    """

    path: Path
    format: str
    beside: bool = False
    episodes: int | None = None
    problem: str = ""

    @property
    def command(self) -> str:
        """Return the command that looks at it."""
        verb = "shards info" if self.format == SHARDS else "inspect"
        return f"hma {verb} {shlex.quote(str(self.path))}"

    def counted(self) -> "Found":
        """Return this with the number of its episodes, or with the reason why they cannot be counted."""
        try:
            if self.format != SHARDS:
                return replace(self, episodes=len(open_source(self.format).episode_ids(self.path)))
            from hma_data.shards.manifest import Manifest

            return replace(self, episodes=Manifest.load(self.path).episodes)
        except HMAError as fault:
            return replace(self, problem=str(fault))

    def to_json(self) -> dict[str, Any]:
        """Return plain values for `--json`."""
        values = {key: value for key, value in asdict(self).items() if key != "beside"}
        return values | {"path": str(self.path), "command": self.command}


def several(folder: StrPath) -> list[Found]:
    """Return the recordings of a folder that cannot be read as one recording; empty if it can, or has none.

    Args:
        folder: str or path of a folder on this machine.
    """
    folder = as_path(folder).expanduser()
    found = list(_found(folder, recognitions(), False))
    apart = [one for one in found if not one.beside]
    alone = len(apart) == 1 and (apart[0].path == folder or apart[0].format not in ("lerobot", SHARDS))
    return [] if not apart or alone else sorted(found, key=lambda one: one.path)


def _found(folder: Path, known: Mapping[str, Recognition], below: bool) -> Iterator[Found]:
    """Yield what a folder holds; `below` says whether a folder above it holds recordings."""
    names = sorted(os.scandir(folder), key=lambda item: item.name)
    shown = [Path(item) for item in names if not item.name.startswith(".")]
    files = [path for path in shown if path.is_file()]
    if whole := _whole(folder, files, known):
        yield Found(folder, whole)
        return
    kinds = {path: kind for path in files if (kind := by_files(path, [path], known))}
    weak = {kind for kind in kinds.values() if known[kind].weak_endings}
    below = below or any(kind not in weak for kind in kinds.values())
    inside = [Found(path, kind, beside=below and kind in weak) for path, kind in kinds.items()]
    for path in shown:
        if path.is_dir() and not path.is_symlink():
            inside += _found(path, known, below)
    films = [one for one in inside if one.beside]
    apart = [one for one in inside if not one.beside]
    formats = {one.format for one in apart}
    if len(apart) > 1 and len(formats) == 1 and not formats & {*NEVER_JOINED}:
        apart = [Found(folder, apart[0].format)]
    yield from apart
    yield from films


def _whole(folder: Path, files: Sequence[Path], known: Mapping[str, Recognition]) -> str | None:
    """Return the format of a folder that is one dataset by its marks, or None."""
    if (folder / "manifest.json").is_file() and (folder / "episodes.parquet").is_file():
        return SHARDS
    for name, recognition in known.items():
        if any((folder / place).is_file() for place in recognition.layout):
            return name
    marks = [path for path in files if path.name in ("metadata.yaml", "features.json", "dataset_info.json")]
    kind = by_files(folder, marks or files, {name: known[name] for name in FORMATS})
    return kind if kind == "rlds" or (marks and kind == "rosbag") else None
