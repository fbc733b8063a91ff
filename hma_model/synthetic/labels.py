"""Infer the actions of film that has none, by inverse dynamics, and write them as shards marked inferred.

    found = label_actions("film", "labelled", "mover_04", checkpoint="runs/inverse")
    print(found.error.explained)      # on held-out film whose actions are known

Film is a shard set, of any robot or of people, or a folder of video files. Its frames are taken at the rate
of the robot's model. What lies between two pauses of a set's episode is an episode of its own. An episode
that cannot be read goes to quarantine. Labelled episodes lie in a folder of the output until all are
written, by the content of their film, so the same call continues.

T frames, A action dims, K = stride · A.
"""

import hashlib
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from hma_data.errors import EpisodeError, HMAError, OutputError, UsageError
from hma_data.loading.views import Cameras, Views, view_count
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.manifest import MANIFEST, Manifest
from hma_data.shards.reader import EpisodeReader, ShardSet
from hma_data.shards.schema import Refused
from hma_data.shards.windows import episode_pieces
from hma_data.sources.common.video_file import VideoFile, frame_table
from hma_data.storage.files import atomic_path, file_sha256
from hma_data.storage.kept import kept_arrays
from hma_data.storage.locks import locked
from hma_data.storage.paths import StrPath, as_path
from hma_model.checkpoint.folder import require_tokenizer
from hma_model.config import INVERSE, OBJECTIVES
from hma_model.generation.commands import Commands, Floats, card, described
from hma_model.policies.fingerprints import begun, digests
from hma_model.synthetic.recorder import Made, finished, write_shards
from hma_model.worlds.images import fitted, recorded_cameras, seen_cameras, trained_cameras
from hma_model.worlds.prompts import seen_frames
from hma_model.worlds.world import World, load_world

if TYPE_CHECKING:
    from hma_model.network.model import HMA

WORK = ".label"
ORIGIN = "inferred: the actions are a model's, by inverse dynamics from the images"
VIDEOS = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v")
BATCH = 16  # windows of a pass
CHECKED = 64  # labelled episodes that the error is measured on, at most
RATE = 0.1  # share by which the film's rate may differ from the model's


@dataclass(frozen=True)
class LabelError:
    """The error of inferred actions on labelled film.

    Attributes:
        source: the film's shard set.
        split: of its episodes.
        names: A names with units.
        rmse: (A,) in these units.
        spread: (A,) standard deviation of the true actions: the error of always giving their mean.
        commands: how many were compared.
    """

    source: str
    split: str
    names: tuple[str, ...]
    rmse: tuple[float, ...]
    spread: tuple[float, ...]
    commands: int

    @property
    def explained(self) -> tuple[float | None, ...]:
        """Return the share of variance explained (A,); None of a value that does not vary."""
        pairs = zip(self.rmse, self.spread)
        return tuple(1 - (error / spread) ** 2 if spread else None for error, spread in pairs)

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values."""
        return vars(self) | {"explained": self.explained}


@dataclass(frozen=True)
class Labelled:
    """Labelled shards, and the error of their actions."""

    manifest: Manifest
    error: LabelError


class Film(Protocol):
    """Episodes of frames."""

    name: str

    def heads(self) -> list[tuple[str, str, str]]:
        """Return id, group and instruction of each episode."""

    def content(self, number: int) -> str:
        """Return words that are others if the frames of an episode are others."""

    def read(self, number: int) -> NDArray[Any]:
        """Return the frames (T, …) of an episode as shards store them."""


def label_actions(
    film: StrPath,
    out: StrPath,
    embodiment: str,
    *,
    checkpoint: StrPath,
    check: StrPath | None = None,
    world: World | None = None,
    device: str = "cpu",
    on_progress: Callable[[float, str, float], None] = lambda done, words, total: None,
) -> Labelled:
    """Infer the actions of film, and write a shard set of the robot.

    Args:
        film: a shard set of the model's tokens, or a folder of video files.
        out: folder of the shards.
        embodiment: the robot whose actions they are.
        checkpoint: with the objective `inverse`.
        check: labelled shards to measure the error on, their val split if they have one; by default those
            that the checkpoint's training run held out.
        world: a world instead of a checkpoint.
        device: of the world made from the checkpoint.
        on_progress: called with the episodes done, what is done, and the episodes in all.

    Raises:
        HMAError: the model does not infer actions, film or output do not fit, or on labelled film the
            inferred actions are no better than their mean.
    """
    folder = as_path(out)
    find_film(film)
    if folder.exists() and not folder.is_dir():
        raise OutputError(folder, "is a file", "name a folder")
    world = world or load_world(checkpoint, device=device)
    model = world.model
    trained = [OBJECTIVES[name].readout for name, weight in model.config.objectives.items() if weight]
    if INVERSE not in trained:
        fault = f"was not trained to infer actions, but for {', '.join(model.config.objectives)}"
        raise HMAError(checkpoint, fault, "train one with objectives={inverse: 1.0}")
    spec = world.action_spec(embodiment)
    robot = described(model, embodiment)
    if robot is None:
        raise HMAError(embodiment, "has no YAML that describes its actions", "load a checkpoint")
    with locked(folder):
        shown = film_of(world, film, embodiment, robot.effective_hz)
        error = measure(world, spec, _labelled(model, embodiment, check), on_progress)
        made_by: dict[str, Any] = {
            "by": "hma label-actions",
            "inferred_actions": True,
            "embodiment": embodiment,
            "film": shown.name,
        }
        made_by |= {"error": error.to_json()} | digests(world, embodiment)
        keys = _keys(shown)
        whole = made_by | {"film_sha256": hashlib.sha256("\n".join(keys).encode()).hexdigest()}
        manifest = finished(folder, whole)
        if manifest is None:
            work = begun(folder, WORK, made_by, model)  # what is kept of other film does no harm there
            episodes, refused = _label(world, spec, shown, keys, work, on_progress)
            cameras = seen_cameras(trained_cameras(card(model, embodiment)), recorded_cameras(robot))
            tokens = world.tokenizer.spec
            manifest = write_shards(folder, episodes, tokens, robot, whole, ORIGIN, refused, cameras)
            shutil.rmtree(work)
    return Labelled(manifest, error)


# -- inference


def infer(model: "HMA", spec: Commands, stored: NDArray[Any]) -> Floats:
    """Return the chunks (T - 1, K) that led from each stored frame (T, …) to the next.

    A chunk is read off a window in whose later half it lies, except those of the first window.
    """
    count, width = len(stored), min(model.config.frames, len(stored))
    hop = max(1, width // 2)
    starts = sorted({*range(0, count - width, hop), count - width})
    frames = torch.from_numpy(stored.astype(np.int64 if model.config.kind == "discrete" else np.float32))
    made = np.empty((count - 1, spec.stride * len(spec.names)), np.float32)
    for begin in range(0, len(starts), BATCH):
        some = starts[begin : begin + BATCH]
        windows = torch.stack([frames[at : at + width] for at in some]).to(model.device)
        read = model.predict_actions(windows, spec.embodiment, readout=INVERSE.name)
        for at, chunks in zip(some, read.numpy(force=True)):
            known = 0 if at == 0 else (width - 1) // 2  # later windows overwrite what had less of a past
            made[at + known : at + width - 1] = chunks[known : width - 1]
    return spec.clip(made.reshape(count - 1, spec.stride, -1)).reshape(made.shape)


def measure(
    world: World,
    spec: Commands,
    shards: ShardSet,
    on_progress: Callable[[float, str, float], None] = lambda done, words, total: None,
) -> LabelError:
    """Return the error of inferred actions on labelled shards.

    Raises:
        HMAError: of no value of the action it is better than the mean.
    """
    film = ShardFilm(world, shards, shards.row_stride, spec.embodiment)
    splits = film.splits()
    split = "val" if "val" in splits else "train"
    chosen = [number for number, name in enumerate(splits) if name == split][:CHECKED]
    width, misses, true = len(spec.names), [], []
    for done, number in enumerate(chosen):
        on_progress(done, "checking on labelled film", len(chosen))
        stored, actions, known = film.labelled(number)
        if len(stored) > 1:
            made = infer(world.model, spec, stored)
            misses.append((made - actions[:-1])[known[:-1]].reshape(-1, width))
            true.append(actions[:-1][known[:-1]].reshape(-1, width))
    if not sum(map(len, true)):
        raise HMAError(shards.folder, "has no known actions to compare with", "name labelled shards")
    values = np.concatenate(true).astype(np.float64)
    rmse = np.sqrt(np.square(np.concatenate(misses).astype(np.float64)).mean(axis=0))
    robot = described(world.model, spec.embodiment)
    assert robot is not None
    units = [part.unit or "" for part in robot.action.components for _ in range(part.dims)]
    names = tuple(f"{name} {unit}".strip() for name, unit in zip(spec.names, units, strict=True))
    spread = tuple(values.std(axis=0).tolist())
    found = LabelError(shards.folder.name, split, names, tuple(rmse.tolist()), spread, len(values))
    if not any(share is not None and share > 0 for share in found.explained):
        fault = "inferred actions are no better than their mean on labelled film"
        raise HMAError(spec.embodiment, fault, "train the inverse model longer, or on more film")
    return found


def _labelled(model: "HMA", embodiment: str, check: StrPath | None) -> ShardSet:
    """Return the labelled shards to check on."""
    if check is not None:
        sets = [ShardSet(check)]
    else:
        sets = model.source.shards() if model.source else []
    found = [one for one in sets if one.embodiment.id == embodiment]
    if not found:
        fault = (
            "no labelled film of it is known" if check is None else f"{check} is of {sets[0].embodiment.id}"
        )
        raise UsageError(embodiment, fault, "name labelled shards of it that were held out: --check SHARDS")
    require_tokenizer(model.config, found[0].spec, found[0].folder)
    return found[0]


def _keys(film: Film) -> list[str]:
    """Return what tells each episode of film, by its id and content, from any other."""
    heads = enumerate(film.heads())
    return [hashlib.sha256(f"{name}\n{film.content(i)}".encode()).hexdigest() for i, (name, *_) in heads]


def _label(
    world: World,
    spec: Commands,
    film: Film,
    keys: Sequence[str],
    work: Path,
    on_progress: Callable[[float, str, float], None],
) -> "tuple[_Kept, list[Refused]]":
    """Infer the actions of all episodes that are not in the folder yet."""
    heads, kept, refused = film.heads(), [], list[Refused]()
    for number, (name, group, instruction) in enumerate(heads):
        path = work / f"{keys[number][:32]}.npz"
        found = kept_arrays(path)
        if found is None:
            on_progress(number, "labelling", len(heads))
            found = _labels_of(world.model, spec, film, number)
            with atomic_path(path) as part, part.open("wb") as file:
                np.savez(file, **found)
        if fault := str(found.get("fault", "")):
            refused.append(Refused(name, EpisodeError.__name__, fault))
        else:
            kept.append((path, name, group, instruction))
    on_progress(len(heads), "labelling", len(heads))
    if not kept:
        raise UsageError(
            film.name, f"has no usable episode; the first: {refused[0].message}", "give longer film"
        )
    return _Kept(kept), refused


def _labels_of(model: "HMA", spec: Commands, film: Film, number: int) -> dict[str, Any]:
    """Return the frames and the inferred chunks of an episode, or why it cannot be used."""
    try:
        stored = film.read(number)
        if len(stored) < 2:
            raise EpisodeError(film.heads()[number][0], "has fewer than two frames at the model's rate")
    except EpisodeError as fault:
        return {"fault": np.array(str(fault))}
    return {"stored": stored, "chunks": infer(model, spec, stored)}


@dataclass(frozen=True)
class _Kept(Sequence[Made]):
    """Labelled episodes in files: path, id, group and instruction of each."""

    files: list[tuple[Path, str, str, str]]

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, number: Any) -> Any:
        path, name, group, instruction = self.files[number]
        with np.load(path) as arrays:
            chunks = arrays["chunks"]
            counts = {"inferred_actions": len(chunks)}
            return Made(name, arrays["stored"], chunks, counts, group, instruction=instruction)

    def __iter__(self) -> Iterator[Made]:
        return (self[number] for number in range(len(self)))


# -- film


def find_film(place: StrPath) -> ShardSet | list[Path]:
    """Return the shard set at a place, or the video files of a folder.

    Raises:
        UsageError: it is neither.
        ShardError: the set is damaged.
    """
    path = as_path(place)
    if (path / MANIFEST).is_file():
        return ShardSet(path)
    videos = (
        sorted(file for file in path.rglob("*") if file.suffix.lower() in VIDEOS) if path.is_dir() else []
    )
    if not videos:
        fault = "is no shard set and no folder with video files" if path.exists() else "does not exist"
        raise UsageError(path, fault, f"give a folder of {', '.join(VIDEOS)}, or a shard set")
    return videos


def film_of(world: World, place: StrPath, embodiment: str, hz: float) -> Film:
    """Return the film of a shard set or of a folder of video files, at a rate in Hz.

    Raises:
        UsageError: it is neither, or its rate is no multiple of that.
    """
    path, found = as_path(place), find_film(place)
    if isinstance(found, ShardSet):
        shards = found
        require_tokenizer(world.model.config, shards.spec, shards.folder)
        rows_hz = shards.embodiment.rate_hz / shards.manifest.frame_stride
        step = max(1, round(rows_hz / hz))
        if abs(rows_hz / step / hz - 1) > RATE:
            fault = f"has {rows_hz:g} frames a second; the model takes {hz:g}"
            remedy = "convert the film with --frames all, or at a multiple of the model's rate"
            raise UsageError(path, fault, remedy)
        return ShardFilm(world, shards, step, embodiment)
    if world.model.config.views > 1:
        fault = f"has films of one camera, and the model sees {world.model.config.views} at once"
        raise UsageError(path, fault, "convert the recordings with --cameras, and give the shards")
    return VideoFilm(world, path, found, embodiment, hz)


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
        self.name, self._shards, self._step = shards.folder.name, shards, step
        rows = shards.episodes.to_pylist()
        self._parts = [(row, part) for row in rows for part in episode_pieces(shards, row, step)]
        cameras = trained_cameras(card(world.model, embodiment or shards.embodiment.id))
        if embodiment in (None, shards.embodiment.id) or view_count(cameras) > 1:
            Views.of(shards, cameras)
        self.cameras = seen_cameras(cameras, shards.manifest.cameras)
        self._reader = EpisodeReader(shards, shards.columns(self.cameras))

    def heads(self) -> list[tuple[str, str, str]]:
        return [
            (
                row["id"] if len(part) == row["length"] else f"{row['id']}_from_{part.start}",
                row["group"] or (row["id"] if len(part) < row["length"] else ""),
                row["instruction"] or "",
            )
            for row, part in self._parts
        ]

    def splits(self) -> list[str]:
        """Return the split of each episode."""
        return [row["split"] for row, _ in self._parts]

    def content(self, number: int) -> str:
        return f"{self._manifest_sha256} {self.cameras} {self._step}"

    @cached_property
    def _manifest_sha256(self) -> str:
        return hashlib.sha256((self._shards.folder / MANIFEST).read_bytes()).hexdigest()

    def read(self, number: int) -> NDArray[Any]:
        return self.labelled(number)[0]

    def labelled(self, number: int) -> tuple[NDArray[Any], Floats, NDArray[np.bool_]]:
        """Return the frames (T, …), the chunks (T, K) that follow them, and which are known (T,)."""
        row, part = self._parts[number]
        stored, columns = seen_frames(self._shards, self._reader, row, self.cameras)
        at = np.array(part[:: self._step])
        actions = columns["action"]
        spans = at[:, None] + np.arange(self._step)
        whole = spans[:, -1] < part.stop
        spans = np.minimum(spans, part.stop - 1)
        known = columns.get("action_known", np.ones(len(stored), np.bool_))[spans].all(axis=1) & whole
        return stored[at], actions[spans].reshape(len(at), -1).astype(np.float32), known


class VideoFilm:
    """Video files, an episode each; their images are resized like those of the robot's camera."""

    def __init__(self, world: World, folder: Path, files: list[Path], embodiment: str, hz: float) -> None:
        self.name, self._world, self._folder, self._files = folder.name, world, folder, files
        self._hz, robot = hz, described(world.model, embodiment)
        self._robot = (
            None if robot is None else _seen_by(robot, trained_cameras(card(world.model, embodiment)))
        )

    def heads(self) -> list[tuple[str, str, str]]:
        return [(str(file.relative_to(self._folder).with_suffix("")), "", "") for file in self._files]

    def content(self, number: int) -> str:
        try:
            return file_sha256(self._files[number])
        except OSError as fault:  # it goes to quarantine when it is read
            return str(fault)

    def read(self, number: int) -> NDArray[Any]:
        path = self._files[number]
        times = frame_table(path).times
        wanted = np.arange(times[0], times[-1] + 1e-6, 1 / self._hz)
        nearest = np.searchsorted((times[1:] + times[:-1]) / 2, wanted)
        video, made = VideoFile(path), []
        some = iter(nearest.tolist())
        while indices := list(islice(some, 4 * BATCH)):
            images = fitted(video.frames(indices), self._world.model.config, self._robot)
            made.append(self._world.tokenizer.encode(images))
        video.close()
        return np.concatenate(made)


def _seen_by(robot: Embodiment, cameras: Cameras) -> Embodiment:
    """Return a robot whose primary camera is the one that a model of one view sees."""
    camera, *_ = seen_cameras(cameras, recorded_cameras(robot))
    sync = robot.sync.model_copy(update={"primary": None})
    return robot.model_copy(update={"cameras": (robot.camera(camera),), "sync": sync})
