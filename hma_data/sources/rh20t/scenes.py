"""Find RH20T's scenes, and read the files of one.

A scene is a folder `task_0001_user_0001_scene_0001_cfg_0001`. It has `metadata.json`, tables
`transformed/TABLE.npy`, and for each camera `cam_SERIAL/color.mp4` and `cam_SERIAL/timestamps.npy`. A table
has for each serial number of a camera the samples that were taken with its frames: a list of dictionaries
with a `timestamp`, or a dictionary from timestamps to values. Timestamps are milliseconds since 1970.

Source: rh20t/rh20t_api, scene.py and extract.py; kpertsch/rh20t_dataset_converter.

T samples, A values of a sample.
"""

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.episode import Floats
from hma_data.errors import EpisodeError
from hma_data.sources.common.pickles import read_dict
from hma_data.sources.common.places import leaves, local_path, nothing_there
from hma_data.sources.common.video_file import FilmRows, VideoFile
from hma_data.sources.rh20t import SCENE
from hma_data.storage.files import read_json

NEXT_SAMPLE = "next"  # the ending of a key: the value of the next sample
CAMERA, TABLES, FILM, STAMPS = "cam_", "transformed", "color.mp4", "timestamps.npy"
TASKS = "task_description.json"
INSTRUCTION_FIELD = "task_description_english"  # the field of TASKS that gives the instruction by default
DEPTH = 4  # folders below a uri in which scenes are looked for
MAX_WIDTH = 4096  # values of a sample


def scenes(uri: str) -> dict[str, Path]:
    """Return the folders of the scenes, by their paths below the uri.

    Raises:
        SourceError: there are none.
    """
    root = local_path(uri)
    if SCENE.fullmatch(root.name):
        return {root.name: root}
    found, people = [], 0
    for folder, inside, _ in os.walk(root):
        here = Path(folder)
        own = sorted(name for name in inside if SCENE.fullmatch(name))
        people += sum(name.endswith("_human") for name in inside)
        found += [here / name for name in own]
        deep = len(here.relative_to(root).parts) >= DEPTH
        inside[:] = [] if deep else sorted(name for name in inside if not name.startswith(("task_", "calib")))
    if not found:
        remedy = "name RH20T_cfg1 to RH20T_cfg7, or the folder with them"
        if people:
            remedy = f"its {people} folders _human are films of people: read them with source.format hands"
        raise nothing_there(uri, root, "has no scene of RH20T (task_…_user_…_scene_…_cfg_…)", remedy)
    return {path.relative_to(root).as_posix(): path for path in sorted(found)}


class Scene:
    """The files of one scene; each is read once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._tables: dict[str, dict[Any, Any]] = {}

    @property
    def cameras(self) -> list[str]:
        """Return the names of the folders of its cameras that have a film."""
        return sorted(path.parent.name for path in self.folder.glob(f"{CAMERA}*/{FILM}"))

    @property
    def tables(self) -> list[str]:
        """Return the names of its tables."""
        return sorted(path.stem for path in (self.folder / TABLES).glob("*.npy"))

    def film(self, camera: str) -> Path:
        """Return the path of a camera's film.

        Raises:
            EpisodeError: there is none, or the name leads elsewhere.
        """
        path = self.folder / camera / FILM
        if not camera.startswith(CAMERA) or Path(camera).name != camera or not path.is_file():
            there = f"it has {', '.join(self.cameras) or 'no films'}"
            raise EpisodeError(self.folder, f"has no {camera}/{FILM}", there)
        if leaves(path, self.folder):
            raise EpisodeError(path, "is a link to a file outside its folder", "copy the file in")
        return path

    def stamps(self, camera: str) -> NDArray[np.int64]:
        """Return the times (T,) of a camera's frames in milliseconds, in the film's order.

        Raises:
            EpisodeError: they cannot be read.
        """
        path = self.folder / camera / STAMPS
        found = read_dict(path).get("color")
        values = _numbers(found, path, "color", lists=True)
        if values.ndim != 1 or values.dtype.kind not in "iu" or not len(values):
            raise EpisodeError(path, "its color holds no times in whole milliseconds")
        return values.astype(np.int64)

    def series(self, key: str, camera: str) -> tuple[Floats, NDArray[Any]]:
        """Return the times (T,) in seconds and the values (T, A) of a key, as recorded with a camera.

        Args:
            key: TABLE, TABLE/FIELD, or either with /next for the value of the next sample.
            camera: the name of its folder.

        Raises:
            EpisodeError: there is no such table, field or camera in it, or its values differ in number.
        """
        table, *rest = key.split("/")
        ahead = rest[-1:] == [NEXT_SAMPLE]
        field = "/".join(rest[:-1] if ahead else rest)
        path = self.folder / TABLES / f"{table}.npy"
        rows = _rows(self._table(table, path), camera.removeprefix(CAMERA), path)
        values = [_numbers(_field(row, field, path), path, key) for _, row in rows]
        if len({value.shape for value in values}) > 1:
            raise EpisodeError(path, f"{key} changes its number of values")
        times = np.array([stamp for stamp, _ in rows], np.float64) / 1e3
        stacked = np.stack(values).reshape(len(rows), -1)
        return (times[:-1], stacked[1:]) if ahead and len(rows) > 1 else (times, stacked)

    def fields(self, table: str, camera: str) -> list[str]:
        """Return the keys of a table whose values are numbers; empty where it has none of that camera."""
        path = self.folder / TABLES / f"{table}.npy"
        content = self._table(table, path)
        if camera.removeprefix(CAMERA) not in content:
            return []
        _, first = _rows(content, camera.removeprefix(CAMERA), path)[0]
        if not isinstance(first, dict):
            return [table]
        return [
            f"{table}/{name}" for name, value in first.items() if name != "timestamp" and _is_numeric(value)
        ]

    def metadata(self) -> dict[str, Any]:
        """Return the content of metadata.json; empty where there is none.

        Raises:
            EpisodeError: it is damaged.
        """
        path = self.folder / "metadata.json"
        return _json(path) if path.exists() else {}

    def task(self, field: str) -> str:
        """Return the task in words, from task_description.json in a folder above; empty without it."""
        for folder in list(self.folder.parents)[:DEPTH]:
            if (folder / TASKS).is_file():
                told = _json(folder / TASKS).get("_".join(self.folder.name.split("_")[:2]))
                said = told.get(field) if isinstance(told, dict) else None
                return said if isinstance(said, str) else ""
        return ""

    def _table(self, name: str, path: Path) -> dict[Any, Any]:
        if Path(name).name != name or leaves(path, self.folder):
            raise EpisodeError(path, "lies outside the scene's folder", "copy the file in")
        if not path.is_file():
            known = f"{TABLES} has {', '.join(self.tables) or 'none'}"
            raise EpisodeError(self.folder, f"has no {TABLES}/{name}.npy", known)
        if name not in self._tables:
            self._tables[name] = read_dict(path)
        return self._tables[name]


class Film(FilmRows):
    """A camera's Stream: the frames of its film, at the times of its timestamps.npy.

    Attributes:
        timestamps: (T,) seconds since 1970.
        lacking: times at the end for which the film has no frame.

    Raises:
        EpisodeError: the film or its times cannot be read, or the film is longer.
    """

    def __init__(self, scene: Scene, camera: str) -> None:
        self.file = VideoFile(scene.film(camera))
        stamps = scene.stamps(camera)
        self.lacking = len(stamps) - len(self.file)
        if self.lacking < 0:
            fault = f"has {len(self.file)} frames, {STAMPS} beside it only {len(stamps)} times"
            raise EpisodeError(self.file.path, fault)
        super().__init__(self.file, stamps[: len(self.file)].astype(np.float64) / 1e3)


def _rows(table: dict[Any, Any], serial: str, path: Path) -> list[tuple[int, Any]]:
    """Return the samples of a camera with their timestamps, by time."""
    if serial not in table:
        known = ", ".join(sorted(map(str, table))[:12])
        raise EpisodeError(path, f"has no samples of camera {serial}", f"it has {known}")
    content = table[serial]
    if isinstance(content, list) and all(isinstance(row, dict) for row in content):
        rows = [(row.get("timestamp"), row) for row in content]
    else:
        rows = list(content.items()) if isinstance(content, dict) else []
    if not rows or not all(isinstance(stamp, int) for stamp, _ in rows):
        raise EpisodeError(path, f"its samples of camera {serial} have no timestamps in whole milliseconds")
    return sorted(rows, key=lambda row: row[0])


def _field(row: Any, field: str, path: Path) -> Any:
    if not field:
        return row
    if not isinstance(row, dict) or field not in row:
        known = ", ".join(map(str, row)) if isinstance(row, dict) else "values without names"
        raise EpisodeError(path, f"a sample has no {field!r}", f"it has {known}")
    return row[field]


def _is_numeric(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return bool(value) and all(isinstance(item, int | float) for item in value)
    return isinstance(value, int | float | np.ndarray)


def _numbers(value: Any, path: Path, key: str, lists: bool = False) -> NDArray[Any]:
    """Return a sample's numbers as an array; a list inside a list, which could be huge, is refused."""
    if not isinstance(value, np.ndarray) and not _is_numeric(value):
        raise EpisodeError(path, f"{key} holds {type(value).__name__} values, not numbers")
    found = np.asarray(value)
    if found.size > MAX_WIDTH and not lists:
        raise EpisodeError(path, f"{key} has {found.size:,} values a sample, more than {MAX_WIDTH:,}")
    return found


def _json(path: Path) -> dict[str, Any]:
    try:
        return read_json(path, EpisodeError)
    except EpisodeError as fault:
        raise EpisodeError(path, fault.fault, "copy it again") from fault
