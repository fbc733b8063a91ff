"""Read the metadata of a LeRobotDataset; bring versions 2.0, 2.1 and 3.0 to one form.

Version 2 stores one parquet file an episode, and one video an episode and camera; `meta/episodes.jsonl` and
`meta/tasks.jsonl` list them. Version 3 packs many episodes into each file; `meta/episodes/*.parquet` names
the file of an episode and, within a video, its start and end.
"""

import json
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from string import Formatter
from typing import Any

from hma_data.errors import EpisodeError, HMAError, SourceError
from hma_data.sources.base import leaves

VERSIONS = ("v2.0", "v2.1", "v3.0")
_DATA_PATHS = {
    "2": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
    "3": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
}
_HUB = re.compile(r"(hf://datasets/)?(?P<repo>[\w.-]+/[\w.-]+)(@(?P<revision>[\w./-]+))?")
_SPLIT_NAMES = {"train": "train"} | dict.fromkeys(("val", "valid", "validation", "test", "eval"), "val")


@dataclass(frozen=True)
class Feature:
    """One entry of info.json's features."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...] | None
    codec: str | None
    depth: bool

    @property
    def is_camera(self) -> bool:
        """Check whether the feature holds colour pictures."""
        return self.dtype in ("video", "image") and not self.depth


@dataclass(frozen=True)
class Span:
    """The part of a video that holds an episode, in seconds of its clock; the whole file without `stop`."""

    path: str
    start: float = 0.0
    stop: float | None = None


class Folder:
    """The files of a dataset, local or fetched from the Hub one by one on demand."""

    def __init__(self, uri: str) -> None:
        self.uri = uri
        self.repo, self.revision = _hub_name(uri)
        local = Path(uri.removeprefix("file://")).expanduser()
        self.root = self._fetch_meta(self.repo) if self.repo else local
        if not (self.root / "meta" / "info.json").is_file():
            there = "has no meta/info.json" if self.root.is_dir() else "does not exist"
            raise SourceError(uri, there, "give the folder of a LeRobotDataset, or its name on the Hub")

    def path(self, relative: str) -> Path:
        """Return the local path of a file, which need not exist.

        Raises:
            SourceError: the path leads out of the folder.
        """
        path = self.root / relative
        if self.repo and not path.is_file():
            path = self._fetch(self.repo, relative)
        if leaves(path, self.root):
            raise SourceError(path, "leads out of the dataset's folder", "copy the file in")
        return path

    def _fetch_meta(self, repo: str) -> Path:
        from huggingface_hub import snapshot_download

        with self._reached():
            found = snapshot_download(
                repo,
                repo_type="dataset",
                revision=self.revision,
                allow_patterns="meta/*",
                ignore_patterns=["meta/stats.*", "meta/episodes_stats.*"],
            )
        self.revision = Path(found).name  # later files come from the same commit
        return Path(found)

    def _fetch(self, repo: str, relative: str) -> Path:
        from huggingface_hub import hf_hub_download
        from huggingface_hub.errors import EntryNotFoundError

        with self._reached():
            try:
                found = hf_hub_download(repo, relative, repo_type="dataset", revision=self.revision)
            except EntryNotFoundError:
                return self.root / relative  # missing: callers treat it as a missing local file
        return Path(found)

    @contextmanager
    def _reached(self) -> Iterator[None]:
        from huggingface_hub.errors import HfHubHTTPError, HTTPError

        try:
            yield
        except (HfHubHTTPError, HTTPError, OSError, ValueError) as fault:
            lines = [line for line in str(fault).splitlines() if line.strip()] or [type(fault).__name__]
            remedy = "check its name, the network, and access with hf auth login"
            raise SourceError(self.uri, f"cannot be fetched from the Hub: {lines[0]}", remedy) from fault


class Metadata:
    """The content of meta/.

    Attributes:
        fps: frames a second, of both rows and videos.
        features: by name.
        episodes: by index, rows of plain values with at least `length`.
        tasks: text by task index.
        splits: name -> range of episode indices.
    """

    def __init__(self, folder: Folder) -> None:
        self.folder = folder
        where = folder.root / "meta" / "info.json"
        info = _object(where)
        self.info = info
        self.version = str(info.get("codebase_version"))
        if self.version not in VERSIONS:
            raise SourceError(
                where,
                f"is of version {self.version!r}; {', '.join(VERSIONS)} are read",
                "convert it with lerobot's own scripts",
            )
        self.fps = _positive(info.get("fps"), where, "fps")
        self.chunk_size = int(_positive(info.get("chunks_size", 1000), where, "chunks_size"))
        self.features = _features(info.get("features"), where)
        self.robot = str(info["robot_type"]) if info.get("robot_type") else None
        self.splits = _splits(info.get("splits"))
        self.tasks = _tasks(folder, self.version)
        self.episodes = _episodes_v3(folder) if self.version == "v3.0" else _episodes_v2(folder)
        if not self.episodes:
            raise SourceError(folder.uri, "has no episodes", "record some, or check meta/")

    def data_path(self, index: int) -> str:
        """Return the path of the parquet file with an episode's rows, relative to the folder."""
        template = self.info.get("data_path") or _DATA_PATHS[self.version[1]]
        return self._filled(template, index, "data", {})

    def video(self, index: int, key: str) -> Span:
        """Return the part of a video that holds an episode's frames of one camera."""
        template = self.info.get("video_path")
        if not template:
            raise SourceError(
                self.folder.root / "meta" / "info.json", "names no video_path", "add it, as lerobot does"
            )
        path = self._filled(template, index, f"videos/{key}", {"video_key": key})
        if self.version != "v3.0":
            return Span(path)
        row = self.episodes[index]
        start, stop = row.get(f"videos/{key}/from_timestamp"), row.get(f"videos/{key}/to_timestamp")
        if not (isinstance(start, float) and isinstance(stop, float) and 0 <= start <= stop < math.inf):
            raise EpisodeError(episode_name(index), f"meta/episodes does not say where {key} begins and ends")
        return Span(path, start, stop)

    def _filled(self, template: Any, index: int, prefix: str, values: dict[str, Any]) -> str:
        """Fill a path template of info.json with the episode's numbers."""
        if self.version == "v3.0":
            row = self.episodes[index]
            for name in ("chunk_index", "file_index"):
                values[name] = row.get(f"{prefix}/{name}")
                if not isinstance(values[name], int) or values[name] < 0:
                    fault = f"meta/episodes has no {prefix}/{name} for it"
                    raise EpisodeError(episode_name(index), fault)
        else:
            values |= {"episode_chunk": index // self.chunk_size, "episode_index": index}
        return fill(template, values, self.folder.root / "meta" / "info.json")

    def split_of(self, index: int) -> str | None:
        """Return train or val; None where the dataset does not have both."""
        ours = {name: _SPLIT_NAMES[name] for name in self.splits if name in _SPLIT_NAMES}
        if set(ours.values()) != {"train", "val"}:
            return None
        return next((ours[name] for name in ours if index in self.splits[name]), None)


def episode_name(index: int) -> str:
    """Return an episode's id."""
    return f"episode_{index:06d}"


def fill(template: Any, values: dict[str, Any], where: object) -> str:
    """Fill a path template with its values.

    Raises:
        SourceError: the template cannot be filled, or its path leads out of the folder.
    """
    try:
        for _, name, spec, conversion in Formatter().parse(template):
            known = name in values and not conversion and re.fullmatch(r"(0?\d{1,2}d)?", spec or "")
            if name is not None and not known:
                raise ValueError(f"{{{name}}} is not filled in here")
        path = str(template).format(**values)
    except (ValueError, TypeError, KeyError, IndexError) as fault:
        raise SourceError(where, f"has a path template that cannot be used, {template!r}: {fault}") from fault
    pure = PurePosixPath(path)
    if pure.is_absolute() or ".." in pure.parts or re.search(r"[\\\0]", path):
        raise SourceError(where, f"names a file outside the dataset: {path!r}", "correct its path templates")
    return path


@contextmanager
def parquet_explained(where: object, error: type[HMAError]) -> Iterator[None]:
    """Raise pyarrow's errors as `error`, in one line."""
    import pyarrow as pa

    try:
        yield
    except FileNotFoundError as fault:
        raise error(where, "no such file") from fault
    except (
        pa.ArrowException,
        OSError,
        ValueError,
        LookupError,
        TypeError,
        OverflowError,
        MemoryError,
    ) as fault:
        lines = str(fault).splitlines() or [type(fault).__name__]
        remedy = "the file may be cut off or damaged"
        raise error(where, f"cannot be read as parquet: {lines[0]}", remedy) from fault


def _hub_name(uri: str) -> tuple[str | None, str | None]:
    """Return repository and revision, or None and None for a folder."""
    match = _HUB.fullmatch(uri.rstrip("/"))
    if uri.startswith("hf://"):
        if not match:
            raise SourceError(
                uri, "is not a dataset on the Hub", "write hf://datasets/NAME/DATASET[@REVISION]"
            )
        return match["repo"], match["revision"]
    here = Path(uri).expanduser()
    if match and not here.exists() and not here.parent.exists():
        return match["repo"], match["revision"]
    return None, None


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as fault:
        raise SourceError(path, "no such file", "the dataset is not complete") from fault
    except (OSError, UnicodeDecodeError) as fault:
        raise SourceError(path, f"cannot be read: {fault}") from fault


def _json(text: str, where: str) -> dict[str, Any]:
    try:
        value = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as fault:
        raise SourceError(where, f"is not JSON: {fault}", "the dataset is damaged") from fault
    if not isinstance(value, dict):
        raise SourceError(where, f"must be a mapping, is {type(value).__name__}")
    return value


def _object(path: Path) -> dict[str, Any]:
    return _json(_text(path), str(path))


def _lines(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    for i, line in enumerate(_text(path).splitlines(), 1):
        if line.strip():
            yield f"{path} line {i}", _json(line, f"{path} line {i}")


def _positive(value: Any, where: object, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
        raise SourceError(where, f"{name} must be a positive number, is {value!r}")
    return float(value)


def _count(value: Any, where: object, name: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise SourceError(where, f"{name} must be a whole number from 0, is {value!r}")
    return value


def _features(found: Any, where: object) -> dict[str, Feature]:
    if not isinstance(found, dict) or not found:
        raise SourceError(where, "lists no features", "the dataset is not complete")
    features = {}
    for name, entry in found.items():
        shape = entry.get("shape") if isinstance(entry, dict) else None
        if not isinstance(shape, list) or not all(isinstance(side, int) and side >= 0 for side in shape):
            raise SourceError(where, f"features[{name!r}] has no shape")
        facts = [found for name in ("video_info", "info") if isinstance(found := entry.get(name), dict)]
        video = {name: value for found in facts for name, value in found.items()}
        features[name] = Feature(
            name=name,
            dtype=str(entry.get("dtype")),
            shape=tuple(shape),
            names=_names(entry.get("names"), math.prod(shape)),
            codec=str(video["video.codec"]) if "video.codec" in video else None,
            depth=bool(video.get("is_depth_map") or video.get("video.is_depth_map")),
        )
    return features


def _names(found: Any, count: int) -> tuple[str, ...] | None:
    """Return the names of a vector's values; None where they do not fit their count.

    Recorders nest them in lists, or in mappings by `motors`, `left`, …, or map each name to its number.
    """
    if isinstance(found, dict):
        if sorted(map(str, found.values())) == sorted(map(str, range(count))):  # {"x": 0, "gripper": 1}
            return tuple(str(name) for name in sorted(found, key=lambda name: int(found[name])))
        groups = {name: _flat(inner) for name, inner in found.items()}
        names = [name for inner in groups.values() for name in inner]
        if len(set(names)) < len(names):  # both arms use the same names
            names = [f"{group}_{name}" for group, inner in groups.items() for name in inner]
    else:
        names = _flat(found)
    return tuple(names) if len(names) == count else None


def _flat(found: Any, depth: int = 0) -> list[str]:
    """Return the texts of a list of lists; empty where it holds anything else."""
    if isinstance(found, str):
        return [found]
    inner = [_flat(item, depth + 1) for item in found] if isinstance(found, list) and depth < 8 else []
    return [name for names in inner for name in names] if all(inner) else []


def _splits(found: Any) -> dict[str, range]:
    """Return ranges of episodes by the split's name; lerobot uses no other form than `from:to`."""
    splits = {}
    for name, text in (found if isinstance(found, dict) else {}).items():
        if match := re.fullmatch(r"(\d{1,12}):(\d{1,12})", str(text)):
            splits[str(name)] = range(int(match[1]), int(match[2]))
    return splits


def _tasks(folder: Folder, version: str) -> dict[int, str]:
    if version != "v3.0":
        rows = list(_lines(folder.root / "meta" / "tasks.jsonl"))
        return {_count(row.get("task_index"), at, "task_index"): str(row.get("task", "")) for at, row in rows}
    import pyarrow.parquet as pq

    path = folder.root / "meta" / "tasks.parquet"
    with parquet_explained(path, SourceError):
        with pq.ParquetFile(path) as file:
            table = file.read(use_threads=False)
        # The text is pandas' index, whose column is named `task` or not at all.
        texts = next(
            name for name in ("task", "__index_level_0__", None) if name in (*table.column_names, None)
        )
        if texts is None or "task_index" not in table.column_names:
            raise SourceError(path, f"has no task texts; its columns: {', '.join(table.column_names)}")
        return dict(zip(table["task_index"].to_pylist(), map(str, table[texts].to_pylist()), strict=True))


def _episodes_v2(folder: Folder) -> dict[int, dict[str, Any]]:
    return _by_index(_lines(folder.root / "meta" / "episodes.jsonl"))


def _episodes_v3(folder: Folder) -> dict[int, dict[str, Any]]:
    import pyarrow.parquet as pq

    place = folder.root / "meta" / "episodes"
    files = sorted(place.rglob("*.parquet"))
    if not files:
        raise SourceError(place, "holds no parquet files", "the dataset is not complete")
    found: list[tuple[str, dict[str, Any]]] = []
    for path in files:
        with parquet_explained(path, SourceError):
            with pq.ParquetFile(path) as file:
                wanted = [name for name in file.schema_arrow.names if not name.startswith("stats/")]
                table = file.read(columns=wanted, use_threads=False)
            found += [(str(path), row) for row in table.to_pylist()]
    return _by_index(iter(found))


def _by_index(rows: Iterator[tuple[str, dict[str, Any]]]) -> dict[int, dict[str, Any]]:
    found: dict[int, dict[str, Any]] = {}
    for where, row in rows:
        index = _count(row.get("episode_index"), where, "episode_index")
        if index in found:
            raise SourceError(where, f"lists episode {index} a second time")
        row["length"] = _count(row.get("length"), where, "length")
        found[index] = row
    return dict(sorted(found.items()))
