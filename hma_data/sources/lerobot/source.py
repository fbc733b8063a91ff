"""Read LeRobotDataset versions 2.0, 2.1 and 3.0 with pyarrow and PyAV alone.

A uri is a folder, `hf://datasets/NAME/DATASET[@REVISION]`, or `NAME/DATASET` on the Hub. From the Hub, only
the files of the episodes that are read are fetched. Keys are feature names (`action`,
`observation.images.cam_high`). The rate is `fps` of info.json, and the embodiment's rate must agree with it.

A row has the frame of its time, where the whole video fits the rows of its episodes (see `films`). Where the
film's stamps drift away from the rows' times, the embodiment may say `source: {layout: {pairing: index}}`:
row i then has frame i, and the times and the rate are the rows'. `pairing: time` believes the stamps whatever
the number of frames.

T frames of an episode.
"""

import hashlib
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.episode import Episode, Signal, Stream
from hma_data.errors import EpisodeError, SourceError
from hma_data.registry.components import Vector
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import SAMPLE, EpisodeRef, Inspection, compose
from hma_data.sources.common.places import file_fingerprint
from hma_data.sources.common.video_file import FilmRows
from hma_data.sources.lerobot.films import fit_of, frames_of_rows, open_video
from hma_data.sources.lerobot.inspect import inspect
from hma_data.sources.lerobot.language import language_of
from hma_data.sources.lerobot.metadata import Folder, Metadata, episode_name
from hma_data.sources.lerobot.rows import Rows, StillImages, rows_of, tasks_of, times_of
from hma_data.storage.paths import StrPath, as_text

NO_TASK = "episodes_without_task"
UNUSED = "frames_without_row"
RATE_TOLERANCE = 0.01  # of the rate
_SAMPLE = 4096  # bytes at each end of a video that its fingerprint covers


class LeRobotSource:
    """A reader of LeRobotDatasets; see the module."""

    def __init__(self) -> None:
        self._opened: dict[str, Metadata] = {}

    def inspect(self, uri: StrPath, episodes: int = SAMPLE) -> Inspection:
        """Return what the dataset holds: its metadata, checked against the files that are there."""
        return inspect(as_text(uri), self._open(as_text(uri), again=True), episodes)

    def episode_ids(self, uri: StrPath) -> list[str]:
        """Return the episode ids, from `episode_000000` on."""
        return [episode_name(index) for index in self._open(as_text(uri), again=True).episodes]

    def index(self, uri: StrPath, embodiment: Embodiment | None = None) -> list[EpisodeRef]:
        """Return the episodes from the metadata; a missing video is found only when its episode is read.

        Raises:
            SourceError: damaged metadata, another rate than the embodiment's, or no such split.
        """
        uri = as_text(uri)
        meta = self._open(uri, again=True)
        if embodiment:
            _check_rate(meta, embodiment)
        chosen = embodiment.source.split if embodiment else None
        if chosen and chosen not in meta.splits:
            known = ", ".join(meta.splits) or "none"
            raise SourceError(uri, f"has no split {chosen!r}", f"its splits: {known}")
        samples: dict[str, str] = {}
        return [
            EpisodeRef(
                episode_name(index),
                row["length"],
                None if chosen else meta.split_of(index),
                _fingerprint(meta, index, samples),
            )
            for index, row in meta.episodes.items()
            if not chosen or index in meta.splits[chosen]
        ]

    def read(self, uri: StrPath, episode_id: str, embodiment: Embodiment) -> Episode:
        """Return one episode; its frames are decoded on demand.

        Raises:
            EpisodeError: a video is missing or has another number of frames, rows are damaged.
            SourceError: no such episode, a key that is no feature, another rate than the embodiment's.
        """
        uri = as_text(uri)
        meta = self._open(uri)
        _check_rate(meta, embodiment)
        _check_keys(meta, embodiment)
        digits = episode_id.removeprefix("episode_")
        index = int(digits) if digits.isdecimal() else -1
        if index not in meta.episodes or episode_name(index) != episode_id:
            raise SourceError(uri, f"has no episode {episode_id!r}", "hma inspect lists what it has")
        rows = rows_of(meta, index)
        length = meta.episodes[index]["length"]
        if len(rows) != length:
            raise EpisodeError(rows.path, f"has {len(rows)} rows of {episode_id}, its metadata says {length}")
        times = times_of(rows, meta.fps)
        tasks = tasks_of(meta, index, rows)
        pairing = (embodiment.source.layout or {}).get("pairing")
        streams: dict[str, Stream] = {}
        flags = {} if tasks or embodiment.source.instruction else {NO_TASK: 1}
        for camera in embodiment.cameras:
            if meta.features[camera.key].dtype == "image":
                streams[camera.name] = StillImages(rows, camera.key, times, meta.folder)
                continue
            span = meta.video(index, camera.key)
            file = open_video(meta.folder.path(span.path), camera.key)
            found = frames_of_rows(meta, camera.key, file, span, times, pairing)
            streams[camera.name] = FilmRows(file, times, found)
            if unused := fit_of(meta, camera.key, file, span).unused.get(index):
                flags[f"{UNUSED}:{camera.name}"] = unused
        metadata: dict[str, Any] = {"flags": flags, "language": language_of(meta, rows, times)}
        if len(tasks) > 1:
            metadata["tasks"] = tasks
        return Episode(
            id=episode_id,
            streams=streams,
            actions=(Signal(times, _vector(rows, embodiment.action)),),
            states=(Signal(times, _vector(rows, embodiment.state)),) if embodiment.state else (),
            instruction=_instruction(rows, embodiment.source.instruction, tasks),
            success=_success(rows),
            source=str(rows.path),
            metadata=metadata,
        )

    def _open(self, uri: str, again: bool = False) -> Metadata:
        if again or uri not in self._opened:
            self._opened[uri] = Metadata(Folder(uri))
        return self._opened[uri]


open = LeRobotSource


def _pairs_by_index(embodiment: Embodiment) -> bool:
    """Check whether the embodiment says that row i has frame i."""
    return (embodiment.source.layout or {}).get("pairing") == "index"


def _check_rate(meta: Metadata, embodiment: Embodiment) -> None:
    if _pairs_by_index(embodiment):
        return  # then fps is the film's rate, and the rows have another
    stated = embodiment.frequency_hz
    if isinstance(stated, float) and abs(stated - meta.fps) > RATE_TOLERANCE * meta.fps:
        raise SourceError(
            meta.folder.uri,
            f"runs at {meta.fps:g} fps, embodiment {embodiment.id} says frequency_hz {stated:g}",
            "correct frequency_hz in the YAML",
        )


def _check_keys(meta: Metadata, embodiment: Embodiment) -> None:
    where = f"{meta.folder.uri}: embodiment {embodiment.id}"
    vectors = [*embodiment.action.components, *(embodiment.state.components if embodiment.state else ())]
    for key in [part.key for part in vectors] + [camera.key for camera in embodiment.cameras]:
        if key not in meta.features:
            near = get_close_matches(key, meta.features, n=3, cutoff=0.4) or list(meta.features)
            raise SourceError(where, f"{key!r} is not a feature", f"did you mean {', '.join(near)}?")
    for camera in embodiment.cameras:
        feature = meta.features[camera.key]
        if not feature.is_camera:
            kind = "a depth map" if feature.is_depth else feature.dtype
            cameras = ", ".join(name for name, item in meta.features.items() if item.is_camera)
            raise SourceError(where, f"{camera.key!r} is {kind}, not colour images", f"cameras: {cameras}")


def _fingerprint(meta: Metadata, index: int, samples: dict[str, str]) -> str:
    """Hash samples of the episode's files; each file is sampled once, however many episodes it has."""
    parts = [str(meta.folder.revision or ""), episode_name(index), str(meta.episodes[index]["length"])]
    try:
        spans = [meta.video(index, key) for key, item in meta.features.items() if item.dtype == "video"]
        parts += [f"{span.start} {span.stop}" for span in spans]
        files = [(meta.data_path(index), file_fingerprint), *((span.path, _video_sample) for span in spans)]
        for relative, sample in [] if meta.folder.repo else files:
            path = meta.folder.path(relative)
            if relative not in samples:
                samples[relative] = sample(path) if path.is_file() else "missing"
            parts.append(samples[relative])
    except EpisodeError as fault:  # `read` raises it again
        parts.append(str(fault))
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def _video_sample(path: Path) -> str:
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(_SAMPLE)
        file.seek(max(0, size - _SAMPLE))
        return hashlib.sha256(b"%d" % size + head + file.read(_SAMPLE)).hexdigest()


def _vector(rows: Rows, vector: Vector) -> NDArray[np.float32]:
    pieces = {part.key: rows.numbers(part.key) for part in vector.components}
    return compose(vector, [pieces[part.key] for part in vector.components], str(rows.path))


def _instruction(rows: Rows, key: str | None, tasks: list[str]) -> str:
    if key and key != "task":
        return str(rows.column(key)[0].as_py() or "")
    return tasks[0] if tasks else ""


def _success(rows: Rows) -> bool | None:
    return bool(rows.numbers("next.success").reshape(-1)[-1]) if "next.success" in rows.columns else None
