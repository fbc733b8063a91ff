"""Read the metadata of a LeRobotDataset; bring versions 2.0, 2.1 and 3.0 to one form.

Version 2 stores one parquet file an episode, and one video an episode and camera; `meta/episodes.jsonl` and
`meta/tasks.jsonl` list them. Version 3 packs many episodes into each file; `meta/episodes/*.parquet` names
the file of an episode and, within a video, its start and end.
"""

import json
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path, PurePosixPath
from typing import Any

from pydantic import BaseModel, Field, NonNegativeInt, PositiveFloat, PositiveInt, ValidationError

from hma_data.errors import EpisodeError, HMAError, SourceError
from hma_data.sources.common.places import require_inside
from hma_data.storage.kinds import one_line, unreadable
from hma_data.storage.yaml_io import first_fault

VERSIONS = ("v2.0", "v2.1", "v3.0")
_DATA_PATHS = {
    "2": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
    "3": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
}
_HUB = re.compile(r"(hf://datasets/)?(?P<repo>[\w.-]+/[\w.-]+)(@(?P<revision>[\w./-]+))?")
_SPLIT_NAMES = {"train": "train"} | dict.fromkeys(("val", "valid", "validation", "test", "eval"), "val")


class Feature(BaseModel):
    """One entry of info.json's features; `info` and `video_info` hold facts of a video."""

    dtype: str
    shape: tuple[NonNegativeInt, ...]
    names: Any = None
    info: dict[str, Any] | None = None
    video_info: dict[str, Any] | None = None

    @property
    def video(self) -> dict[str, Any]:
        """Return the facts of a feature's video."""
        return {**(self.video_info or {}), **(self.info or {})}

    @property
    def is_depth(self) -> bool:
        """Check whether the images are depth maps."""
        return bool(self.video.get("is_depth_map") or self.video.get("video.is_depth_map"))

    @property
    def is_camera(self) -> bool:
        """Check whether the feature holds colour images."""
        return self.dtype in ("video", "image") and not self.is_depth

    @property
    def value_names(self) -> tuple[str, ...] | None:
        """Return the names of a vector's values; None where they do not fit their count.

        Recorders nest them in lists, or in mappings by `motors`, `left`, …, or map each name to its number.
        """
        found, count = self.names, math.prod(self.shape)
        if isinstance(found, dict) and sorted(map(str, found.values())) == sorted(map(str, range(count))):
            names = sorted(found, key=lambda name: int(found[name]))  # {"x": 0, "gripper": 1}
        elif isinstance(found, dict):
            groups = {name: _flat(inner) for name, inner in found.items()}
            names = [name for inner in groups.values() for name in inner]
            if len(set(names)) < len(names):  # both arms use the same names
                names = [f"{group}_{name}" for group, inner in groups.items() for name in inner]
        else:
            names = _flat(found)
        return tuple(names) if len(names) == count else None


def _flat(found: Any) -> list[str]:
    """Return the texts of a list of lists; empty where it holds anything else."""
    if isinstance(found, str):
        return [found]
    inner = [_flat(item) for item in found] if isinstance(found, list) else []
    return [name for names in inner for name in names] if all(inner) else []


class Info(BaseModel):
    """The content of info.json that is used."""

    codebase_version: str | None = None
    fps: PositiveFloat = Field(allow_inf_nan=False)
    chunks_size: PositiveInt = 1000
    features: dict[str, Feature] = Field(min_length=1)
    robot_type: str | None = None
    splits: dict[str, Any] = {}
    data_path: str | None = None
    video_path: str | None = None
    total_episodes: int | None = None
    total_frames: int | None = None


@dataclass(frozen=True)
class Span:
    """The part of a video that holds an episode, in seconds of the clock that the metadata use.

    Attributes:
        index: of the episode.
        path: of the file.
        rows: how many the episode has.
        start: time of the episode's first frame.
        stop: as the metadata state it; None for a whole file. Some writers state the end of the last frame,
            others its time, so no frames are counted by it. lerobot does not read it either.
    """

    index: int
    path: str
    rows: int
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
            there = "has no meta/info.json" if self.root.exists() else "does not exist"
            raise SourceError(uri, there, "give the folder of a whole LeRobotDataset, or its name on the Hub")
        meta = self.root / "meta"
        for path in chain([meta], meta.rglob("*")):  # of its links to folders, none is entered
            require_inside(path, self.root)

    def path(self, relative: str) -> Path:
        """Return the local path of a file, which need not exist.

        Raises:
            EpisodeError: the path leads out of the folder, by itself or by a link.
            SourceError: the Hub cannot be reached.
        """
        pure = PurePosixPath(relative)
        if pure.is_absolute() or ".." in pure.parts:
            fault = f"names a file outside the dataset: {relative!r}"
            raise EpisodeError(self.uri, fault, "correct the paths in meta/info.json or in its rows")
        path = self.root / relative
        if self.repo and not path.is_file():
            return self._fetch(self.repo, relative)
        require_inside(path, self.root)
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
                return Path(hf_hub_download(repo, relative, repo_type="dataset", revision=self.revision))
            except EntryNotFoundError:
                return self.root / relative  # missing: callers treat it as a missing local file

    @contextmanager
    def _reached(self) -> Iterator[None]:
        from huggingface_hub.errors import HfHubHTTPError, HTTPError

        from hma_data.hub.errors import explain

        try:
            yield
        except (HfHubHTTPError, HTTPError, OSError, ValueError) as fault:
            known = explain(self.uri, fault)
            said = f"cannot be fetched from the Hub ({known.fault})"
            raise SourceError(self.uri, said, known.remedy) from fault


def _hub_name(uri: str) -> tuple[str | None, str | None]:
    """Return repository and revision, or None and None for a folder."""
    match = _HUB.fullmatch(uri.rstrip("/"))
    here = Path(uri).expanduser()
    if uri.startswith("hf://"):
        if not match:
            raise SourceError(
                uri, "is not a dataset on the Hub", "write hf://datasets/NAME/DATASET[@REVISION]"
            )
    elif not match or here.exists() or here.parent.exists():
        return None, None
    return match["repo"], match["revision"]


class Metadata:
    """The content of meta/.

    Attributes:
        info: the content of info.json.
        fps: frames a second, of both rows and videos.
        features: by name.
        episodes: by index, rows of plain values with at least `length`.
        tasks: text by task index.
        splits: name -> range of episode indices.
    """

    def __init__(self, folder: Folder) -> None:
        self.folder = folder
        self._where = folder.root / "meta" / "info.json"
        self.info = _info(self._where)
        self.fps, self.features = self.info.fps, self.info.features
        self._is_v3 = is_v3 = self.info.codebase_version == "v3.0"
        self.splits = {  # ranges of episodes; lerobot uses no other form than `from:to`
            name: range(int(match[1]), int(match[2]))
            for name, text in self.info.splits.items()
            if (match := re.fullmatch(r"(\d{1,12}):(\d{1,12})", str(text)))
        }
        self.tasks = _by_number(numbered_texts(folder, "task") if is_v3 else _tasks_v2(folder))
        self.episodes = _by_index(_episodes_v3(folder) if is_v3 else _lines(folder, "episodes.jsonl"))
        self._spans: dict[str, dict[str, tuple[Span, ...]]] = {}  # camera -> video -> its episodes
        self.fits: dict[tuple[str, str], tuple[Any, Any]] = {}  # camera, video -> its state, and its Fit
        if not self.episodes:
            raise SourceError(folder.uri, "has no episodes", "record some, or check meta/")

    @cached_property
    def subtasks(self) -> dict[int, str]:
        """Return the text of each subtask by its number, where older versions keep them."""
        return dict(numbered_texts(self.folder, "subtask"))

    def data_path(self, index: int) -> str:
        """Return the path of the parquet file with an episode's rows, relative to the folder."""
        template = self.info.data_path or _DATA_PATHS["3" if self._is_v3 else "2"]
        return self._filled(template, index, "data", {})

    def video(self, index: int, key: str) -> Span:
        """Return the part of a video that holds an episode's frames of one camera."""
        if not self.info.video_path:
            raise SourceError(self._where, "names no video_path", "add it, as lerobot does")
        path = self._filled(self.info.video_path, index, f"videos/{key}", {"video_key": key})
        row = self.episodes[index]
        if not self._is_v3:
            return Span(index, path, row["length"])
        start, stop = row.get(f"videos/{key}/from_timestamp"), row.get(f"videos/{key}/to_timestamp")
        if not (isinstance(start, float | int) and isinstance(stop, float | int) and 0 <= start < math.inf):
            raise EpisodeError(episode_name(index), f"meta/episodes does not say where {key} begins and ends")
        return Span(index, path, row["length"], start, stop)

    def spans(self, key: str, path: str) -> tuple[Span, ...]:
        """Return the episodes that have their frames of one camera in a video, in the order of the video."""
        if key not in self._spans:
            found: dict[str, list[Span]] = {}
            for index in self.episodes:
                with suppress(EpisodeError):
                    span = self.video(index, key)
                    found.setdefault(span.path, []).append(span)
            self._spans[key] = {
                name: tuple(sorted(spans, key=lambda span: span.start)) for name, spans in found.items()
            }
        return self._spans[key][path]

    def _filled(self, template: str, index: int, prefix: str, values: dict[str, Any]) -> str:
        """Fill a path template of info.json with the episode's numbers."""
        if self._is_v3:
            for name in ("chunk_index", "file_index"):
                values[name] = self.episodes[index].get(f"{prefix}/{name}")
                if not isinstance(values[name], int):
                    raise EpisodeError(episode_name(index), f"meta/episodes has no {prefix}/{name} for it")
        else:
            chunk = index // self.info.chunks_size
            values |= {"episode_chunk": chunk, "episode_index": index}
            values |= {"chunk_index": chunk, "file_index": index}  # version 3's names, one file an episode
        return fill(template, values, self._where)

    def split_of(self, index: int) -> str | None:
        """Return train or val; None where the dataset does not have both."""
        ours = {name: _SPLIT_NAMES[name] for name in self.splits if name in _SPLIT_NAMES}
        if set(ours.values()) != {"train", "val"}:
            return None
        return next((ours[name] for name in ours if index in self.splits[name]), None)


def episode_name(index: int) -> str:
    """Return an episode's id."""
    return f"episode_{index:06d}"


def fill(template: str, values: dict[str, Any], where: object) -> str:
    """Fill a path template, such as `chunk-{chunk_index:03d}/{video_key}`, with its values.

    Raises:
        SourceError: the template names another value, or has another format.
    """
    known = "|".join(values)
    field = re.compile(rf"\{{({known})(?::0?(\d?)d)?\}}")
    path = field.sub(lambda part: str(values[part[1]]).zfill(int(part[2] or 0)), template)
    if "{" in path:
        fault = f"has a path template that cannot be filled in: {template!r}"
        raise SourceError(where, fault, f"it may name {', '.join(values)}")
    return path


@contextmanager
def parquet_explained(where: object, error: type[HMAError]) -> Iterator[None]:
    """Raise pyarrow's errors as `error`, in one line."""
    import pyarrow as pa

    try:
        yield
    except FileNotFoundError as fault:
        raise error(where, "no such file", "copy the dataset again, whole") from fault
    except (pa.ArrowException, OSError, ValueError, LookupError, TypeError) as fault:
        remedy = "it may be cut off or damaged: copy it again"
        reason = unreadable(Path(str(where)), f"cannot be read as parquet: {one_line(fault)}", remedy)
        raise error(where, *reason) from fault


def _info(path: Path) -> Info:
    try:
        info = Info.model_validate_json(_content(path))
    except ValidationError as fault:
        remedy = "the dataset is damaged or not complete"
        raise SourceError(path, *unreadable(path, first_fault(fault), remedy)) from fault
    if info.codebase_version not in VERSIONS:
        said = f"is of version {info.codebase_version!r}; {', '.join(VERSIONS)} are read"
        raise SourceError(path, said, "convert it with lerobot's own scripts")
    return info


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as fault:
        raise SourceError(path, f"cannot be read: {fault.strerror}", "the dataset is not complete") from fault


Row = tuple[str, dict[str, Any]]  # where it is written, and what it holds


def _lines(folder: Folder, name: str) -> Iterator[Row]:
    """Yield the objects of a file of JSON lines; some writers store one list, or one object over lines."""
    path = folder.root / "meta" / name
    content = _content(path).decode("utf-8-sig", errors="replace")
    found: list[tuple[str, Any]] = []
    with suppress(ValueError, RecursionError):
        found = [(str(path), json.loads(content))]
    lines = [] if found else enumerate(content.splitlines(), 1)
    for i, line in lines:
        if not line.strip():
            continue
        where = f"{path} line {i}"
        try:
            found.append((where, json.loads(line)))
        except (ValueError, RecursionError) as fault:
            reason = unreadable(path, f"is not JSON: {fault}", "the dataset is damaged")
            raise SourceError(where, *reason) from fault
    for where, value in found:
        for row in value if isinstance(value, list) else [value]:
            if not isinstance(row, dict):
                raise SourceError(where, f"holds {row!r:.60}, not an object", "the dataset is damaged")
            yield where, row


def _tasks_v2(folder: Folder) -> Iterator[tuple[Any, Any]]:
    # Without the file, the episodes' own lists have the words.
    rows = _lines(folder, "tasks.jsonl") if (folder.root / "meta" / "tasks.jsonl").is_file() else ()
    yield from ((row.get("task_index"), row.get("task")) for _, row in rows)


def numbered_texts(folder: Folder, kind: str) -> Iterator[tuple[Any, Any]]:
    """Yield number and text of each task or subtask, as version 3 stores them; none without the file."""
    import pyarrow.parquet as pq

    path = folder.root / "meta" / f"{kind}s.parquet"
    if not path.is_file():
        return
    with parquet_explained(path, SourceError):
        with pq.ParquetFile(path) as file:
            table = file.read(use_threads=False)
        # The text is pandas' index, whose column is named by the kind or not at all.
        texts = kind if kind in table.column_names else "__index_level_0__"
        yield from zip(table[f"{kind}_index"].to_pylist(), table[texts].to_pylist(), strict=True)


def _by_number(tasks: Iterator[tuple[Any, Any]]) -> dict[int, str]:
    """Return the text of each task; none for a number that stands for two texts."""
    found: dict[int, set[str]] = {}
    for number, text in tasks:
        if isinstance(number, int) and isinstance(text, str) and text.strip():
            found.setdefault(number, set()).add(text)
    return {number: texts.pop() for number, texts in found.items() if len(texts) == 1}


def _episodes_v3(folder: Folder) -> Iterator[Row]:
    import pyarrow.parquet as pq

    place = folder.root / "meta" / "episodes"
    files = sorted(place.rglob("*.parquet"))
    if not files:
        raise SourceError(place, "holds no parquet files", "the dataset is not complete")
    for path in files:
        with parquet_explained(path, SourceError), pq.ParquetFile(path) as file:
            wanted = [name for name in file.schema_arrow.names if not name.startswith("stats/")]
            table = file.read(columns=wanted, use_threads=False).to_pylist()
        yield from ((str(path), row) for row in table)


def _by_index(rows: Iterator[Row]) -> dict[int, dict[str, Any]]:
    found: dict[int, dict[str, Any]] = {}
    for where, row in rows:
        for name in ("episode_index", "length"):
            if not isinstance(row.get(name), int) or row[name] < 0:
                raise SourceError(where, f"{name} must be a whole number from 0, is {row.get(name)!r}")
        if row["episode_index"] in found:
            raise SourceError(where, f"lists episode {row['episode_index']} a second time")
        found[row["episode_index"]] = row
    return dict(sorted(found.items()))
