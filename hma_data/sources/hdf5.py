"""HDF5 recordings: robomimic, LIBERO, raw robosuite, ALOHA/ACT, and layouts a YAML describes.

An episode is a group (`data/demo_0`) or a whole file. Which of the two is seen from the file, or
said by `source.layout`:

    source:
      format: hdf5
      layout: {episodes: "data/*", timestamps: obs/time}   # "/" means one file an episode

A uri is a file or a folder of files. Keys are paths inside the episode's group. HDF5 keeps no
rate: it is the embodiment's `frequency_hz`, unless `layout.timestamps` names seconds.

T frames of an episode, n of them asked for.
"""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from hma_data.embodiment import Embodiment
from hma_data.episode import Episode, Floats, Signal, rate_times
from hma_data.errors import EpisodeError, HMAError, SourceError
from hma_data.sources.base import SAMPLE, EpisodeRef, Inspection, compose, file_fingerprint
from hma_data.sources.hdf5_file import OpenFiles, child, dataset, explained, member, numbers, rows, text, walk
from hma_data.sources.hdf5_layout import WHOLE_FILE, Place, Places, episodes_pattern
from hma_data.spec import Vector
from hma_data.video import MAX_PIXELS, Images, decode_image

TEXT_KEYS = ("language_instruction", "instruction", "lang", "task_description", "task")
_SPLITS = {"train": "train", "valid": "val"}


class Hdf5Source:
    """See the module."""

    def __init__(self) -> None:
        self._files = OpenFiles()
        self._places = Places(self._files)

    def inspect(self, uri: str, episodes: int = SAMPLE) -> Inspection:
        """See Source."""
        from hma_data.sources.hdf5_inspect import inspect

        return inspect(uri, self._places, self._files, episodes)

    def episode_ids(self, uri: str) -> list[str]:
        """Their ids, files by name and `demo_2` before `demo_10`."""
        return list(self._places.all(uri))

    def index(self, uri: str, embodiment: Embodiment | None = None) -> list[EpisodeRef]:
        """The episodes. A damaged file among others is one that `read` will refuse.

        Raises:
            SourceError: nothing there, a single file that is damaged, or no mask of the name `source.split`.
        """
        pattern = episodes_pattern(embodiment)
        places = self._places.all(uri, pattern)
        fingerprints = {file: file_fingerprint(file) for file in {place.file for place in places.values()}}
        whole = {place.file for place in places.values() if place.group == WHOLE_FILE}
        masks = {file: {} if file in whole else self._masks(file) for file in fingerprints}
        chosen = embodiment.source.split if embodiment else None
        if chosen and not any(chosen in found for found in masks.values()):
            known = sorted({name for found in masks.values() for name in found})
            raise SourceError(uri, f"has no mask {chosen!r}", f"its masks: {', '.join(known) or 'none'}")
        refs = []
        for episode_id, place in places.items():
            found, name = masks[place.file], place.group.rsplit("/", 1)[-1]
            if chosen and name not in found.get(chosen, ()):
                continue
            split = None
            if not chosen and set(_SPLITS) <= set(found):
                split = next((ours for mask, ours in _SPLITS.items() if name in found[mask]), None)
            digest = hashlib.sha256(f"{fingerprints[place.file]} {place.group}".encode()).hexdigest()[:16]
            refs.append(EpisodeRef(episode_id, self._length(place, embodiment), split, digest))
        return refs

    def read(self, uri: str, episode_id: str, embodiment: Embodiment) -> Episode:
        """One episode; its pictures are read when asked for.

        Raises:
            EpisodeError: a damaged file, a missing key, a wrong width, an empty episode.
            SourceError: no such episode, or no rate and no times.
        """
        place = self._places.find(uri, episode_id, episodes_pattern(embodiment))
        where = str(place)
        with explained(where):
            group = self._places.group(place)
            actions = _vector(group, embodiment.action, where)
            states = _vector(group, embodiment.state, where) if embodiment.state else None
            clock = _Clock(group, embodiment, where)
            streams = {
                camera.name: _Pictures(self._places, place, camera.key, clock)
                for camera in embodiment.cameras
            }
            return Episode(
                id=episode_id,
                streams=dict(streams),
                actions=(Signal(clock.times(len(actions)), actions),),
                states=() if states is None else (Signal(clock.times(len(states)), states),),
                instruction=_instruction(group, embodiment.source.instruction, where),
                success=_success(group),
                source=where,
                metadata=_metadata(group),
            )

    def _length(self, place: Place, embodiment: Embodiment | None) -> int:
        """T as the action's rows, or the most rows of any dataset; 0 when it cannot be read."""
        keys = [part.key for part in embodiment.action.components] if embodiment else ["actions", "action"]
        try:
            with explained(place):
                group = self._places.group(place)
                for key in keys:
                    if key.strip("/") in group:
                        return len(dataset(group, key, str(place)))
                return max((item.shape[0] for _, item in walk(group) if item.shape), default=0)
        except HMAError:
            return 0

    def _masks(self, file: Path) -> dict[str, set[str]]:
        """robomimic's filter keys: name -> names of demos."""
        with explained(file, SourceError):
            mask = child(self._files.get(file), "mask")
            if not isinstance(mask, h5py.Group):
                return {}
            lists = {name: child(mask, name) for name in mask}
            return {
                name: {text(row) for row in found[()]}
                for name, found in lists.items()
                if isinstance(found, h5py.Dataset) and found.ndim == 1
            }


class _Clock:
    """Times of an episode: its own where the YAML names them, else ticks of the embodiment's rate."""

    def __init__(self, group: h5py.Group, embodiment: Embodiment, where: str) -> None:
        key = (embodiment.source.layout or {}).get("timestamps")
        self._where, self._recorded = where, None if key is None else _times(group, key, where)
        if key is None and embodiment.frequency_hz is None:
            raise SourceError(
                f"embodiment {embodiment.id}",
                "frequency_hz is null, and HDF5 keeps no times of itself",
                "set frequency_hz, or source.layout.timestamps to the key of the seconds",
            )
        # With an unknown rate a recording can still be looked at; converting it is refused before.
        self._hz = embodiment.frequency_hz if isinstance(embodiment.frequency_hz, float) else 1.0

    def times(self, length: int) -> Floats:
        """(length,) seconds."""
        if self._recorded is None:
            return rate_times(length, self._hz)
        if length != len(self._recorded):
            raise EpisodeError(self._where, f"has {len(self._recorded)} times for {length} frames")
        return self._recorded


def _times(group: h5py.Group, key: str, where: str) -> Floats:
    values = numbers(group, key, where)
    if values.dtype.kind not in "fiu" or values.size != len(values):
        raise EpisodeError(where, f"{key!r} holds {values.shape} {values.dtype}, not a time a frame")
    return values.reshape(-1).astype(np.float64)


class _Pictures:
    """A camera's Stream: (T, H, W, 3) raw, or a JPEG or PNG a row."""

    def __init__(self, places: Places, place: Place, key: str, clock: _Clock) -> None:
        self._places, self._place, self._key = places, place, key
        found = self._dataset()
        self._raw = picture_kind(found) == "raw"
        self.timestamps = clock.times(len(found))

    def _dataset(self) -> h5py.Dataset:
        where = str(self._place)
        found = dataset(self._places.group(self._place), self._key, where)
        kind = picture_kind(found)
        if kind is None or (kind == "raw" and np.prod(found.shape[1:], dtype=float) > 4 * MAX_PIXELS):
            raise EpisodeError(
                where,
                f"{self._key!r} holds {found.shape} {found.dtype}, not colour pictures",
                "expected (T, H, W, 3) uint8, or encoded pictures",
            )
        return found

    def frames(self, indices: Sequence[int] | NDArray[np.int64]) -> Images:
        """See Stream."""
        with explained(self._place):
            found = rows(self._dataset(), indices)
        if self._raw:
            return as_rgb(found)
        if not len(found):
            return np.zeros((0, 1, 1, 3), np.uint8)
        pictures = [
            decode_image(encoded(row), f"{self._place} {self._key}[{index}]")
            for row, index in zip(found, indices, strict=True)
        ]
        if len({picture.shape for picture in pictures}) > 1:
            raise EpisodeError(self._place, f"{self._key!r} has pictures of several sizes")
        return np.stack(pictures)


def open() -> Hdf5Source:
    """The source."""
    return Hdf5Source()


def picture_kind(found: h5py.Dataset) -> str | None:
    """`raw`, `encoded`, or None for what cannot be pictures, by dtype and shape."""
    shape: tuple[int, ...] = found.shape or ()
    if found.dtype == np.uint8 and len(shape) == 4 and (shape[3] in (1, 3, 4) or shape[1] in (1, 3)):
        return "raw"
    if found.dtype == np.uint8 and len(shape) == 3:
        return "raw"
    padded = found.dtype == np.uint8 and len(shape) == 2
    return "encoded" if padded or (len(shape) == 1 and found.dtype.kind in "OSV") else None


def as_rgb(pictures: NDArray[np.uint8]) -> Images:
    """(n, H, W), (n, H, W, 1|3|4) or (n, 1|3, H, W) -> (n, H, W, 3)."""
    if pictures.ndim == 3:
        pictures = pictures[..., None]
    elif pictures.shape[3] not in (1, 3, 4):
        pictures = pictures.transpose(0, 2, 3, 1)
    if pictures.shape[3] == 1:
        pictures = np.repeat(pictures, 3, axis=3)
    return np.ascontiguousarray(pictures[..., :3])


def encoded(row: Any) -> NDArray[np.uint8]:
    """One encoded picture's bytes; zeros after its end are harmless."""
    if isinstance(row, np.ndarray) and row.dtype == np.uint8:
        return row
    return np.frombuffer(row.tobytes() if isinstance(row, np.void) else bytes(row), np.uint8)


def _vector(group: h5py.Group, vector: Vector, where: str) -> NDArray[np.float32]:
    read: dict[str, NDArray[Any]] = {}
    for part in vector.components:
        if part.key not in read:
            read[part.key] = numbers(group, part.key, where)
    lengths = {key: len(values) for key, values in read.items()}
    if len(set(lengths.values())) > 1:
        raise EpisodeError(
            where, "differ in length: " + ", ".join(f"{key} {length}" for key, length in lengths.items())
        )
    return compose(vector, [read[part.key] for part in vector.components], where)


def _instruction(group: h5py.Group, key: str | None, where: str) -> str:
    """What was asked: at the key the YAML names, else in the places robomimic and LIBERO use."""
    if key and key in group.attrs:
        return text(group.attrs[key])
    if key:
        return text(member(group, key, where)[()])
    for holder in (group, group.parent, group.file):
        for name in TEXT_KEYS:
            if name in holder.attrs and (found := text(holder.attrs[name])):
                return found
        said = _json(holder, "problem_info").get("language_instruction", "")
        if said := text("".join(map(str, said)) if isinstance(said, list) else said):
            return said
    return ""


def _success(group: h5py.Group) -> bool | None:
    """By the last reward; by the last `done` only where rewards are not kept, for time-outs are done too."""
    if "success" in group.attrs:
        return bool(np.all(group.attrs["success"]))
    for key in ("rewards", "dones"):
        found = child(group, key)
        if isinstance(found, h5py.Dataset) and found.ndim == 1 and len(found) and found.dtype.kind in "fiub":
            return bool(found[-1] > 0)
    return None


def _metadata(group: h5py.Group) -> dict[str, Any]:
    """Short plain attributes of the episode; models and other long texts stay behind."""
    found: dict[str, Any] = {}
    for name in group.attrs:
        value = group.attrs[name]
        plain = value.item() if isinstance(value, np.generic) else value
        if isinstance(plain, bool | int | float) or (isinstance(plain, str) and 0 < len(plain) <= 200):
            found[name] = plain
    return found


def environment(handle: h5py.File) -> dict[str, Any]:
    """What robomimic (`env_args`) or robosuite (`env_info`) say of the simulator."""
    data = child(handle, "data")
    if not isinstance(data, h5py.Group):
        return {}
    found = _json(data, "env_args") or _json(data, "env_info")
    inner = found.get("env_kwargs")
    return {**found, **inner} if isinstance(inner, dict) else found


def _json(holder: Any, name: str) -> dict[str, Any]:
    try:
        value = json.loads(text(holder.attrs[name])) if name in holder.attrs else {}
    except (json.JSONDecodeError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}
