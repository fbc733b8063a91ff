"""Read RH20T's scenes: one episode a folder, every camera and its numbers with their own times.

A camera's key is the name of its folder, `cam_750612070851`. A number's key is a table of the scene and a
field of it: `tcp_base/tcp`, `gripper/gripper_info`, `joint`. With `/next`, it is the value of the next
sample, which stands for an action where only what the robot did was recorded. The numbers are those that were
taken with the primary camera's frames.

`source.instruction` names the field of task_description.json: task_description_english by default. The file
is looked for in the folders above the scene. A scene succeeded if its rating is 2 or more (0: emergency stop,
1: failed).

Source: see the module `scenes`.
"""

import hashlib
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from hma_data.episodes.episode import Episode, Signal
from hma_data.errors import SourceError
from hma_data.registry.components import Vector
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import SAMPLE, EpisodeRef, component_values
from hma_data.sources.common.inspection import Inspection, KeyInfo
from hma_data.sources.common.places import file_fingerprint, local_path, unfollowed
from hma_data.sources.common.survey import Series, Survey
from hma_data.sources.rh20t.scenes import FILM, INSTRUCTION_FIELD, STAMPS, TABLES, Film, Scene, scenes
from hma_data.storage.paths import StrPath, as_text

SUCCESS_RATING = 2  # the lowest rating of a task that was done
STAMP_BYTES = 16  # of timestamps.npy for a frame, of colour and of depth, about
_METADATA_KEYS = ("rating", "calib_quality", "finish_time", "calib")


class Rh20tSource:
    """A reader of RH20T's scenes; see the module."""

    def __init__(self) -> None:
        self._found: dict[str, dict[str, Path]] = {}

    def inspect(self, uri: StrPath, episodes: int = SAMPLE) -> Inspection:
        """See Source."""
        return inspect(as_text(uri), episodes)

    def episode_ids(self, uri: StrPath) -> list[str]:
        """Return the scenes' paths below the uri."""
        return list(self._scenes(as_text(uri)))

    def index(self, uri: StrPath, embodiment: Embodiment | None = None) -> list[EpisodeRef]:
        """Return the scenes, with an estimate of their frames. `read` refuses those that are not whole.

        Raises:
            SourceError: there are none.
        """
        return [
            EpisodeRef(name, _estimate(folder, embodiment), None, _fingerprint(folder, embodiment))
            for name, folder in self._scenes(as_text(uri)).items()
        ]

    def read(self, uri: StrPath, episode_id: str, embodiment: Embodiment) -> Episode:
        """Return one scene; its frames are decoded on demand.

        Raises:
            EpisodeError: a film, table or field is missing or damaged, or a film has more frames than times.
            SourceError: no such scene.
        """
        found = self._scenes(as_text(uri))
        if episode_id not in found:
            known = ", ".join(list(found)[:3])
            raise SourceError(
                as_text(uri), f"has no scene {episode_id!r}", f"it has {len(found)}: {known}, …"
            )
        scene = Scene(found[episode_id])
        flags: dict[str, int] = {}
        streams = {camera.name: Film(scene, camera.key) for camera in embodiment.cameras}
        if lacking := sum(film.lacking for film in streams.values()):
            flags["frames_missing"] = lacking
        primary = embodiment.primary_camera.key
        said = scene.metadata()
        rating = said.get("rating")
        return Episode(
            id=episode_id,
            streams={**streams},
            actions=_signals(scene, embodiment.action, primary),
            states=_signals(scene, embodiment.state, primary) if embodiment.state else (),
            rate_stamped=False,
            instruction=scene.task(embodiment.source.instruction or INSTRUCTION_FIELD),
            success=rating >= SUCCESS_RATING if isinstance(rating, int) else None,
            source=str(scene.folder),
            metadata={
                "flags": flags,
                **{key: said[key] for key in _METADATA_KEYS if _is_plain(said.get(key))},
            },
        )

    def _scenes(self, uri: str) -> dict[str, Path]:
        if uri not in self._found:
            self._found[uri] = scenes(uri)
        return self._found[uri]


open = Rh20tSource


def _signals(scene: Scene, vector: Vector, camera: str) -> tuple[Signal, ...]:
    found = []
    for part in vector.components:
        times, values = scene.series(part.key, camera)
        found.append(Signal(times, component_values(part, values, str(scene.folder))))
    return tuple(found)


def _is_plain(value: Any) -> bool:
    return isinstance(value, int | float | str) and len(str(value)) <= 200


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
        vectors = [embodiment.action, *([embodiment.state] if embodiment.state else [])]
        tables = dict.fromkeys(part.key.split("/")[0] for one in vectors for part in one.components)
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
    for link in unfollowed(local_path(uri)):
        survey.note(link)
    lengths: list[int] = []
    told = ""
    for name in survey.sample(list(found), episodes):
        scene = Scene(found[name])
        keys = {camera: partial(_film, scene, camera) for camera in scene.cameras}
        for table in scene.tables:
            with survey.reading(name, table):
                camera = next((one for one in scene.cameras if scene.fields(table, one)), "")
                keys |= {key: partial(_numbers, scene, key, camera) for key in scene.fields(table, camera)}
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


def _numbers(scene: Scene, key: str, camera: str) -> Series:
    _, values = scene.series(key, camera)
    info = KeyInfo(key, "vector", values.shape[1:], str(values.dtype), count=len(values))
    return Series(lambda: values, info=info)
