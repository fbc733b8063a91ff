"""Read film: the episodes of a shard set, of any robot or of people, or a folder of video files.

Frames are taken at the rate of a robot's model. What lies between two pauses of a set's episode is an episode
of its own.

T frames, A action dims, K = stride · A.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import batched
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.arrays import Bools, Float32s, Ints
from hma_data.errors import EpisodeError, UsageError
from hma_data.loading.views import Cameras, Views, view_count
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.manifest import MANIFEST
from hma_data.shards.reader import ShardSet
from hma_data.shards.windows import episode_pieces
from hma_data.sources.common.video_file import VideoFile, frame_table
from hma_data.storage.files import file_sha256, short_sha256
from hma_data.storage.paths import StrPath, as_path
from hma_model.checkpoint.folder import require_tokenizer
from hma_model.generation.commands import described
from hma_model.generation.decode import trained_cameras
from hma_model.worlds.images import fitted
from hma_model.worlds.prompts import SeenShards
from hma_model.worlds.world import World

VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v")
MOST_REPEATS = 100  # of a video's frames, in the mean; a video of more has a wrong clock
DECODED = 64  # frames of a video that are decoded at a time
RATE_TOLERANCE = 0.1  # share by which the film's rate may differ from the model's


@dataclass(frozen=True)
class FilmEpisode:
    """An episode of film.

    Attributes:
        id: of the episode.
        group: id of the recording that it is a part of; empty if it is one of its own.
        instruction: the task in words, if it is known.
        key: SHA-256 of its id and content.
        frames: reads its frames (T, …) as shards store them.
    """

    id: str
    group: str
    instruction: str
    key: str
    frames: Callable[[], NDArray[Any]]


def find_film(place: StrPath) -> ShardSet | list[Path]:
    """Return the shard set at a place, or the video files of a folder.

    Raises:
        UsageError: it is neither.
        ShardError: the set is damaged.
    """
    path = as_path(place)
    if (path / MANIFEST).is_file():
        return ShardSet(path)
    files = sorted(path.rglob("*")) if path.is_dir() else []
    videos = [file for file in files if file.suffix.lower() in VIDEO_SUFFIXES]
    if not videos:
        fault = "is neither a shard set nor a folder with video files" if path.exists() else "does not exist"
        raise UsageError(path, fault, f"give a folder of {', '.join(VIDEO_SUFFIXES)}, or a shard set")
    return videos


def read_film(world: World, place: StrPath, embodiment: str, hz: float) -> list[FilmEpisode]:
    """Return the episodes of a shard set or of a folder of video files, at a rate in Hz.

    Raises:
        UsageError: it is neither, or its rate is no multiple of that.
    """
    path = as_path(place)
    found = find_film(place)
    if isinstance(found, ShardSet):
        require_tokenizer(world.model.config, found.spec, found.folder)
        rows_hz = found.embodiment.rate_hz / found.manifest.frame_stride
        step = max(1, round(rows_hz / hz))
        if abs(rows_hz / step / hz - 1) > RATE_TOLERANCE:
            fault = f"has {rows_hz:g} frames per second; the model takes {hz:g}"
            remedy = "convert the video with --frames all, or at a multiple of the model's rate"
            raise UsageError(path, fault, remedy)
        return ShardFilm(world, found, step, embodiment).episodes()
    if world.model.config.views > 1:
        fault = f"has videos of one camera, but the model sees {world.model.config.views} at once"
        raise UsageError(path, fault, "convert the recordings with --cameras, and give the shards")
    return _video_episodes(world, path, found, embodiment, hz)


def _key(name: str, content: str) -> str:
    return short_sha256(f"{name}\n{content}", 64)


# -- shards


class ShardFilm:
    """The episodes of a shard set, divided where they pause: every `step`-th row, of the model's cameras.

    Film of another robot, which lacks them, is taken from its first camera.

    Args:
        world: of the model.
        shards: the set.
        step: rows from one frame to the next.
        embodiment: the robot whose actions are inferred; by default that of the set.

    Raises:
        UsageError: the set lacks a camera that the model sees, and is of the robot or the model sees several.
    """

    def __init__(self, world: World, shards: ShardSet, step: int, embodiment: str | None = None) -> None:
        self._step = step
        rows = shards.episodes.to_pylist()
        self._parts = [(row, part) for row in rows for part in episode_pieces(shards, row, step)]
        cameras = trained_cameras(world.model, embodiment or shards.embodiment.id)
        if embodiment in (None, shards.embodiment.id) or view_count(cameras) > 1:
            Views.of(shards, cameras)  # raises if one of them is not there
        self._seen = SeenShards(shards, cameras)
        self.cameras = self._seen.cameras

    def episodes(self) -> list[FilmEpisode]:
        """Return the episodes."""
        content = f"{file_sha256(self._seen.shards.folder / MANIFEST)} {self.cameras} {self._step}"
        found = []
        for number, (row, part) in enumerate(self._parts):
            whole = len(part) == row["length"]
            name = row["id"] if whole else f"{row['id']}_from_{part.start}"
            group = row["group"] or ("" if whole else row["id"])
            read = partial(self.stored, number)
            found.append(FilmEpisode(name, group, row["instruction"] or "", _key(name, content), read))
        return found

    def numbers(self, split: str) -> list[int]:
        """Return the numbers of the episodes of a split."""
        return [number for number, (row, _) in enumerate(self._parts) if row["split"] == split]

    def recordings(self, numbers: Sequence[int]) -> Ints:
        """Return the recording of each of some episodes."""
        return self._seen.shards.recordings(self._parts[number][0]["episode_index"] for number in numbers)

    def stored(self, number: int) -> NDArray[Any]:
        """Return the frames (T, …) of an episode."""
        return self.labelled(number)[0]

    def labelled(self, number: int) -> tuple[NDArray[Any], Float32s, Bools]:
        """Return the frames (T, …), the chunks (T, K) that follow them, and which are known (T,)."""
        row, part = self._parts[number]
        stored, columns = self._seen.episode(row)
        actions = columns["action"]
        at = np.array(part[:: self._step])
        spans = at[:, None] + np.arange(self._step)
        whole = spans[:, -1] < part.stop
        # The chunk after the last frame may reach beyond the part; it is then filled up, and not known.
        spans = np.minimum(spans, part.stop - 1)
        known = columns.get("action_known", np.ones(len(stored), np.bool_))[spans].all(axis=1) & whole
        return stored[at], actions[spans].reshape(len(at), -1).astype(np.float32), known


# -- video files


def _video_episodes(
    world: World, folder: Path, files: Sequence[Path], embodiment: str, hz: float
) -> list[FilmEpisode]:
    """Return an episode for each file; its frames are resized like those of the robot's camera."""
    robot = described(world.model, embodiment)
    cameras = trained_cameras(world.model, embodiment)
    found = []
    names = set[str]()
    for file in files:
        name = str(file.relative_to(folder).with_suffix(""))
        name += file.suffix * (name in names)  # of a video that differs from another one by its suffix alone
        names.add(name)
        try:
            content = file_sha256(file)
        except OSError as fault:  # it goes to quarantine when it is read
            content = str(fault)
        read = partial(_encoded_video, world, file, robot, cameras, hz)
        found.append(FilmEpisode(name, "", "", _key(name, content), read))
    return found


def _encoded_video(
    world: World, file: Path, robot: Embodiment | None, cameras: Cameras, hz: float
) -> NDArray[Any]:
    """Return the frames of a video that are nearest to the ticks of a clock, as shards store them."""
    times = frame_table(file).times
    seconds = times[-1] - times[0]
    if seconds * hz > MOST_REPEATS * len(times):
        raise EpisodeError(file, f"has {len(times)} frames in {seconds:,.0f} s", "correct their times")
    ticks = np.arange(times[0], times[-1] + 1e-6, 1 / hz)
    nearest = np.searchsorted((times[1:] + times[:-1]) / 2, ticks)
    video = VideoFile(file)
    stored = []
    for indices in batched(nearest.tolist(), DECODED):
        images = fitted(video.frames(list(indices)), world.model.config, robot, cameras)
        stored.append(world.tokenizer.encode(images))
    video.close()
    return np.concatenate(stored)
