"""Infer the actions of film that has none, by inverse dynamics, and write them as shards marked inferred.

    found = label_actions("film", "labelled", "mover_04", checkpoint="runs/inverse")
    print(found.error.explained)      # on held-out film whose actions are known

An episode of the film that cannot be read goes to quarantine. Labelled episodes lie in a folder of the output
until all are written, so the same call continues.

T frames, A action dims, K = stride · A.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from hma_data.arrays import Float32s, Floats
from hma_data.errors import EpisodeError, HMAError, UsageError
from hma_data.shards.manifest import Manifest
from hma_data.shards.reader import ShardSet
from hma_data.shards.schema import Refused
from hma_data.storage.files import short_sha256
from hma_data.storage.kept import KeptParts, remove_kept
from hma_data.storage.locks import locked
from hma_data.storage.paths import StrPath, as_path
from hma_model.checkpoint.folder import require_tokenizer
from hma_model.config import INVERSE
from hma_model.evaluation.intervals import ends_of, interval
from hma_model.generation.commands import Commands, yaml_of
from hma_model.generation.decode import trained_cameras, trained_shards
from hma_model.network.model import HMA
from hma_model.policies.fingerprints import device_facts, world_digests
from hma_model.synthetic.film import FilmEpisode, ShardFilm, find_film, read_film
from hma_model.synthetic.recorder import SyntheticEpisode, finished, write_shards
from hma_model.worlds.images import recorded_cameras, seen_cameras
from hma_model.worlds.world import World, load_world

WORK = ".label"
ORIGIN = "inferred: the actions are a model's, by inverse dynamics from the frames"
BATCH_WINDOWS = 16  # windows of a pass
Labelling = Callable[[float, str, float], None]  # episodes done, what is done, episodes in all
MAX_CHECKED = 64  # labelled episodes that the error is measured on, at most


@dataclass(frozen=True)
class LabelError:
    """The error of inferred actions on labelled film.

    Attributes:
        source: the film's shard set.
        split: of its episodes.
        names: A names with units.
        rmse: (A,) in these units.
        spread: (A,) standard deviation of the true actions: the error of always giving their mean.
        explained_95: (A,) intervals of `explained` over recordings; None of one recording.
        commands: how many were compared.
    """

    source: str
    split: str
    names: tuple[str, ...]
    rmse: tuple[float, ...]
    spread: tuple[float, ...]
    explained_95: tuple[list[float] | None, ...]
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


def label_actions(
    film: StrPath,
    out: StrPath,
    embodiment: str,
    *,
    checkpoint: StrPath,
    check: StrPath | None = None,
    world: World | None = None,
    device: str = "cpu",
    on_progress: Labelling = lambda done, words, total: None,
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
    world = world or load_world(checkpoint, [embodiment], device=device)
    model = world.model
    model.require_readout(INVERSE, checkpoint)
    spec = world.action_spec(embodiment)
    robot = yaml_of(model, embodiment)
    with locked(folder):
        episodes = read_film(world, film, embodiment, robot.effective_hz)
        error = measure(world, spec, _check_set(model, embodiment, check), on_progress)
        made_by = {
            "by": "hma label-actions",
            "inferred_actions": True,
            "embodiment": embodiment,
            "film": as_path(film).name,
            "error": error.to_json(),
            **world_digests(world, embodiment),
        }
        keys = "\n".join(episode.key for episode in episodes)
        of_film = made_by | {"film_sha256": short_sha256(keys, 64)}
        manifest = finished(folder, of_film)
        if manifest is None:
            # The parts are kept under settings without the film: they are named by its content.
            kept = KeptParts(folder / WORK, made_by | device_facts(model))
            labelled, refused = _label(model, spec, episodes, kept, on_progress)
            if not labelled:
                fault = f"has no usable episode; the first: {refused[0].message}"
                raise UsageError(as_path(film).name, fault, "give longer videos")
            cameras = seen_cameras(trained_cameras(model, embodiment), recorded_cameras(robot))
            tokens = world.tokenizer.spec
            manifest = write_shards(folder, labelled, tokens, robot, of_film, ORIGIN, refused, cameras)
        remove_kept(folder / WORK)  # a job may have been killed here
    return Labelled(manifest, error)


# -- inference


def infer(model: HMA, spec: Commands, stored: NDArray[Any]) -> Float32s:
    """Return the chunks (T - 1, K) that led from each stored frame (T, …) to the next.

    A chunk is read off a window in whose later half it lies, except those of the first window.
    """
    count = len(stored)
    width = min(model.config.frames, len(stored))
    starts = sorted({*range(0, count - width, max(1, width // 2)), count - width})
    frames = torch.from_numpy(stored.astype(np.int64 if model.config.kind == "discrete" else np.float32))
    made = np.empty((count - 1, spec.stride * len(spec.names)), np.float32)
    for begin in range(0, len(starts), BATCH_WINDOWS):
        some = starts[begin : begin + BATCH_WINDOWS]
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
    on_progress: Labelling = lambda done, words, total: None,
) -> LabelError:
    """Return the error of inferred actions on labelled shards.

    Raises:
        HMAError: of no value of the action it is better than the mean.
    """
    film = ShardFilm(world, shards, shards.row_stride, spec.embodiment)
    split = "val" if film.numbers("val") else "train"
    numbers = film.numbers(split)[:MAX_CHECKED]
    width = len(spec.names)
    pairs = list[Float32s]()  # (2, n, A): errors, and true values
    recordings = list[int]()
    for done, (number, recording) in enumerate(zip(numbers, film.recordings(numbers))):
        on_progress(done, "checking on labelled video", len(numbers))
        stored, actions, known = film.labelled(number)
        if len(stored) < 2:
            continue
        # The last frame has a chunk after it, but no frame to which it led.
        chunks = actions[:-1]
        both = np.stack([infer(world.model, spec, stored) - chunks, chunks])
        pairs.append(both[:, known[:-1]].reshape(2, -1, width))
        recordings += [recording] * pairs[-1].shape[1]
    if not any(both.size for both in pairs):
        raise HMAError(shards.folder, "has no known actions to compare with", "name labelled shards")
    misses, values = np.concatenate(pairs, axis=1).astype(np.float64)
    rmse = np.sqrt(np.square(misses).mean(axis=0))
    robot = yaml_of(world.model, spec.embodiment)
    units = [part.unit or "" for part in robot.action.components for _ in range(part.dims)]
    names = tuple(f"{name} {unit}".strip() for name, unit in zip(spec.names, units, strict=True))
    spread = tuple(values.std(axis=0).tolist())
    ends = explained_95(misses, values, recordings)
    found = LabelError(shards.folder.name, split, names, tuple(rmse.tolist()), spread, ends, len(values))
    if not any(share is not None and share > 0 for share in found.explained):
        fault = "inferred actions are no better than their mean on labelled video"
        raise HMAError(spec.embodiment, fault, "train the inverse model longer, or on more data")
    return found


def explained_95(misses: Floats, values: Floats, own: Sequence[int]) -> tuple[list[float] | None, ...]:
    """Return the intervals (A,) of the share of variance explained, from errors and true values (n, A).

    `own` (n,) are the recordings. The share is a ratio; to first order it varies as the mean of what each
    recording adds to it.
    """
    spread = values.var(axis=0)
    spread[spread == 0] = np.nan
    share = 1 - np.square(misses).mean(axis=0) / spread
    added = (np.square(misses) - (1 - share) * np.square(values - values.mean(axis=0))) / spread
    names, place = np.unique(own, return_inverse=True)
    sums = np.zeros((len(names), len(share)))
    np.add.at(sums, place, added)
    ends = interval(share - sums * (len(names) / len(values)), within=(-math.inf, 1.0))
    return tuple(map(ends_of, ends.T))


def _check_set(model: HMA, embodiment: str, check: StrPath | None) -> ShardSet:
    """Return the labelled shards to check on: those given, else those that the model was trained on."""
    found = trained_shards(model, embodiment) if check is None else ShardSet(check)
    if found is None or found.embodiment.id != embodiment:
        other = "it has no labelled recordings here"
        fault = other if found is None else f"{check} is of {found.embodiment.id}"
        raise UsageError(embodiment, fault, "name labelled shards of it that were held out: --check SHARDS")
    require_tokenizer(model.config, found.spec, found.folder)
    return found


def _label(
    model: HMA,
    spec: Commands,
    film: Sequence[FilmEpisode],
    kept: KeptParts,
    on_progress: Labelling,
) -> "tuple[_Labelled, list[Refused]]":
    """Infer the actions of all episodes that are not kept yet."""
    usable = list[FilmEpisode]()
    refused = list[Refused]()
    for number, episode in enumerate(film):
        on_progress(number, "labelling", len(film))
        # Kept by its content, so film may be added between runs.
        found = kept.part(episode.key[:32], partial(_labels_of, model, spec, episode))
        if "fault" in found:
            refused.append(Refused(episode.id, EpisodeError.__name__, str(found["fault"])))
        else:
            usable.append(episode)
    on_progress(len(film), "labelling", len(film))
    return _Labelled(kept, usable), refused


def _labels_of(model: HMA, spec: Commands, episode: FilmEpisode) -> dict[str, NDArray[Any]]:
    """Return the frames and the inferred chunks of an episode, or why it cannot be used."""
    try:
        stored = episode.frames()
        if len(stored) < 2:
            raise EpisodeError(episode.id, "has fewer than two frames at the model's rate")
    except EpisodeError as fault:
        return {"fault": np.array(str(fault))}
    return {"stored": stored, "chunks": infer(model, spec, stored)}


class _Labelled(Sequence[SyntheticEpisode]):
    """Labelled episodes, each read from its file when it is asked for: together they may not fit memory."""

    def __init__(self, kept: KeptParts, film: Sequence[FilmEpisode]) -> None:
        self._kept = kept
        self._film = film

    def __len__(self) -> int:
        return len(self._film)

    def __getitem__(self, number: Any) -> Any:
        episode = self._film[number]
        with np.load(self._kept.path(episode.key[:32])) as arrays:
            stored = arrays["stored"]
            chunks = arrays["chunks"]
        counts = {"inferred_actions": len(chunks)}
        return SyntheticEpisode(
            episode.id, stored, chunks, counts, episode.group, instruction=episode.instruction
        )
