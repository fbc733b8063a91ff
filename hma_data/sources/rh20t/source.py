"""Read RH20T's scenes: one episode a folder, every camera and its numbers with their own times.

A scene is a folder `task_0001_user_0001_scene_0001_cfg_0001`. It has `metadata.json`, tables
`transformed/TABLE.npy`, and for each camera `cam_SERIAL/color.mp4` and `cam_SERIAL/timestamps.npy`. A table
has for each serial number of a camera the samples that were taken with its frames: a list of dictionaries
with a `timestamp`, or a dictionary from timestamps to values. Timestamps are milliseconds since 1970.

A camera's key is the name of its folder, `cam_750612070851`. A number's key is a table of the scene and a
field of it: `tcp_base/tcp`, `gripper/gripper_info`, `joint`. With `/next`, it is the value of the next
sample, which stands for an action where only what the robot did was recorded. The numbers are those that were
taken with the primary camera's frames.

`source.instruction` names the field of task_description.json: task_description_english by default. The file
is looked for in the folders above the scene. A scene succeeded if its rating is 2 or more (0: emergency stop,
1: failed).

Source: rh20t/rh20t_api, scene.py and extract.py; kpertsch/rh20t_dataset_converter.

T samples, A values of a sample.
"""

import hashlib
import os
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.arrays import Array, Floats, Ints
from hma_data.episodes.episode import Episode, Signal
from hma_data.errors import EpisodeError, SourceError
from hma_data.registry.components import Vector
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import SAMPLE, EpisodeRef, component_values
from hma_data.sources.common.inspection import Inspection, KeyInfo
from hma_data.sources.common.pickles import read_dict
from hma_data.sources.common.places import file_fingerprint, local_path, nothing_there, require_inside
from hma_data.sources.common.survey import Series, Survey
from hma_data.sources.common.video_file import FilmRows, VideoFile
from hma_data.sources.rh20t import SCENE
from hma_data.storage.files import read_json
from hma_data.storage.paths import StrPath, as_text

NEXT_SAMPLE = "next"  # the ending of a key: the value of the next sample
CAMERA, TABLES, FILM, STAMPS = "cam_", "transformed", "color.mp4", "timestamps.npy"
TASKS = "task_description.json"
INSTRUCTION_FIELD = "task_description_english"  # the field of TASKS that gives the instruction by default
DEPTH = 4  # folders below a uri in which scenes are looked for
MAX_WIDTH = 4096  # values of a sample
SUCCESS_RATING = 2  # the lowest rating of a task that was done
MAX_STAMP = 1 << 53  # milliseconds: below it, float64 holds every whole number
STAMP_BYTES = 16  # of timestamps.npy for a frame, of colour and of depth, about


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
            remedy = f"its {people} folders _human are videos of people: read them with source.format hands"
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
        require_inside(path, self.folder)
        return path

    def stamps(self, camera: str) -> Ints:
        """Return the times (T,) of a camera's frames in milliseconds, in the film's order.

        Raises:
            EpisodeError: they cannot be read.
        """
        path = self.folder / camera / STAMPS
        found = read_dict(path).get("color")
        values = _numbers(found, path, "color")
        if values.ndim != 1 or values.dtype.kind not in "iu" or not len(values):
            raise EpisodeError(path, "its color holds no times in whole milliseconds")
        return values.astype(np.int64)

    def series(self, key: str, camera: str) -> tuple[Floats, Array]:
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
        if values[0].size > MAX_WIDTH:
            raise EpisodeError(
                path, f"{key} has {values[0].size:,} values per sample, more than {MAX_WIDTH:,}"
            )
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

    def success(self) -> bool | None:
        """Return whether the task was done; None where metadata.json does not rate it.

        Raises:
            EpisodeError: metadata.json is damaged.
        """
        path = self.folder / "metadata.json"
        rating = _json(path).get("rating") if path.exists() else None
        return rating >= SUCCESS_RATING if isinstance(rating, int) else None

    def task(self, field: str) -> str:
        """Return the task in words, from task_description.json in a folder above; empty without it."""
        for folder in list(self.folder.parents)[:DEPTH]:
            if (folder / TASKS).is_file():
                told = _json(folder / TASKS).get("_".join(self.folder.name.split("_")[:2]))
                said = told.get(field) if isinstance(told, dict) else None
                return said if isinstance(said, str) else ""
        return ""

    def _table(self, name: str, path: Path) -> dict[Any, Any]:
        require_inside(path, self.folder)
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
            fault = f"has {len(self.file)} frames, but {STAMPS} has only {len(stamps)} times"
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
    if not rows or not all(isinstance(stamp, int) and abs(stamp) < MAX_STAMP for stamp, _ in rows):
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


def _numbers(value: Any, path: Path, key: str) -> Array:
    """Return numbers as an array; a list inside a list is refused."""
    if not _is_numeric(value):
        raise EpisodeError(path, f"{key} holds {type(value).__name__} values, not numbers")
    return np.asarray(value)


def _json(path: Path) -> dict[str, Any]:
    try:
        return read_json(path, EpisodeError)
    except EpisodeError as fault:
        raise EpisodeError(path, fault.fault, "copy it again") from fault


# -- the source


class Rh20tSource:
    """A reader of RH20T's scenes; see the module."""

    def __init__(self) -> None:
        self._found: dict[str, dict[str, Path]] = {}

    def inspect(self, uri: StrPath, episodes: int = SAMPLE) -> Inspection:
        """See Source."""
        return inspect(as_text(uri), episodes)

    def episode_ids(self, uri: StrPath) -> list[str]:
        """Return the scenes' paths below the uri."""
        return list(self._list(as_text(uri)))

    def index(self, uri: StrPath, embodiment: Embodiment | None = None) -> list[EpisodeRef]:
        """Return the scenes, with an estimate of their frames. `read` refuses those that are not whole.

        Raises:
            SourceError: there are none.
        """
        return [
            EpisodeRef(name, _estimate(folder, embodiment), None, _fingerprint(folder, embodiment))
            for name, folder in self._list(as_text(uri)).items()
        ]

    def read(self, uri: StrPath, episode_id: str, embodiment: Embodiment) -> Episode:
        """Return one scene; its frames are decoded on demand.

        Raises:
            EpisodeError: a film, table or field is missing or damaged, or a film has more frames than times.
            SourceError: no such scene.
        """
        found = self._found.get(as_text(uri), {})  # listed once, for all scenes of a conversion
        if episode_id not in found:
            found = self._list(as_text(uri))
        if episode_id not in found:
            known = ", ".join(list(found)[:3])
            raise SourceError(
                as_text(uri), f"has no scene {episode_id!r}", f"it has {len(found)}: {known}, …"
            )
        scene = Scene(found[episode_id])
        streams = {camera.name: Film(scene, camera.key) for camera in embodiment.cameras}
        primary = embodiment.primary_camera.key
        return Episode(
            id=episode_id,
            streams={**streams},
            actions=_signals(scene, embodiment.action, primary),
            states=_signals(scene, embodiment.state, primary) if embodiment.state else (),
            rate_stamped=False,
            instruction=scene.task(embodiment.source.instruction or INSTRUCTION_FIELD),
            success=scene.success(),
            source=str(scene.folder),
            metadata={"flags": {"frames_missing": sum(film.lacking for film in streams.values())}},
        )

    def _list(self, uri: str) -> dict[str, Path]:
        self._found[uri] = scenes(uri)
        return self._found[uri]


open = Rh20tSource


def _signals(scene: Scene, vector: Vector, camera: str) -> tuple[Signal, ...]:
    found = []
    for part in vector.components:
        times, values = scene.series(part.key, camera)
        found.append(Signal(times, component_values(part, values, str(scene.folder))))
    return tuple(found)


def _estimate(folder: Path, embodiment: Embodiment | None) -> int:
    """Return about how many frames a scene has, from the size of a file of times; 0 where there is none."""
    camera = embodiment.primary_camera.key if embodiment else "cam_*"
    with suppress(OSError, ValueError):
        for path in folder.glob(f"{camera}/{STAMPS}"):
            return max(1, path.stat().st_size // STAMP_BYTES)
    return 0


def _fingerprint(folder: Path, embodiment: Embodiment | None) -> str:
    """Return 16 hex digits that change when a file does that the embodiment takes."""
    used = [folder / "metadata.json"]
    if embodiment:
        tables = dict.fromkeys(part.key.split("/")[0] for part in embodiment.components)
        used += [folder / TABLES / f"{table}.npy" for table in tables]
        used += [folder / camera.key / name for camera in embodiment.cameras for name in (FILM, STAMPS)]
    digest = hashlib.sha256()
    for path in used:
        with suppress(OSError):
            digest.update(file_fingerprint(path).encode())
        digest.update(b"\n")
    return digest.hexdigest()[:16]


# -- inspection


def inspect(uri: str, episodes: int) -> Inspection:
    """See Source.inspect.

    Raises:
        SourceError: there is no scene.
    """
    found = scenes(uri)
    survey = Survey(len(found))
    survey.links(local_path(uri))
    lengths: list[int] = []
    told = ""
    for name in survey.sample(list(found), episodes):
        scene = Scene(found[name])
        keys = {camera: partial(_film, scene, camera) for camera in scene.cameras}
        for table in scene.tables:
            with survey.reading(name, table):
                camera = next((one for one in scene.cameras if scene.fields(table, one)), "")
                keys |= {key: partial(_table, scene, key, camera) for key in scene.fields(table, camera)}
        lengths.append(survey.look(name, keys))
        with survey.reading(name):
            told = told or scene.task(INSTRUCTION_FIELD)
    hz = next((survey.rate(key) for key, info in survey.infos.items() if info.kind == "camera"), None)
    facts = {
        "dataset": "RH20T",
        "rate": "measured from the cameras' timestamps" if hz else "",
        "task": told or "no task_description.json in a folder above: episodes get no instruction",
    }
    return survey.inspection("rh20t", uri, survey.infos.values(), lengths, facts, hz=hz)


def _film(scene: Scene, camera: str) -> Series:
    film = Film(scene, camera)
    table, count = film.file.table, len(film.timestamps)
    size = (table.height, table.width, 3)
    info = KeyInfo(camera, "camera", size, "uint8", codec=table.codec, count=len(table))
    starts = table.keys[:count]
    return Series(None, film.frames, count, starts, table.codec, film.timestamps, info)


def _table(scene: Scene, key: str, camera: str) -> Series:
    _, values = scene.series(key, camera)
    info = KeyInfo(key, "vector", values.shape[1:], str(values.dtype), count=len(values))
    return Series(lambda: values, info=info)
