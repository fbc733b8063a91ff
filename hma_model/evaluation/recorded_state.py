"""Read the state of a robot off pictures, and measure the state error of rollouts: `hma evaluate --state`.

A small network, the reader, learns to read the recorded state off the training split's pictures, as the
tokenizer shows them. It then reads rollouts, and what it reads is compared with the state that was recorded
at each step. Its own error is that on true pictures of training episodes that it did not learn from. A value
that hardly changes, or that it cannot read off these or the windows' true pictures, is left out. Errors are
in standard deviations of the value over the training split (`sd`), so that metres and radians can be
averaged. What it reads is also the state of the LeRobotDatasets that `hma augment` writes.

The states of robots of the laboratory are simulated instead (`hma_model.evaluation.simulated`).

N pictures or windows, T frames, P predicted frames, S values of a state.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
from torch import Tensor, nn

from hma_data.arrays import Floats, Images, Ints
from hma_data.loading.dataset import Batch, WindowDataset
from hma_data.loading.views import Cameras
from hma_data.shards.manifest import MANIFEST
from hma_data.shards.reader import ShardSet
from hma_data.shards.schema import mask_columns
from hma_data.storage.files import file_sha256
from hma_data.tokenizers.base import Tokenizer
from hma_model.arrays import evenly
from hma_model.evaluation.intervals import NATURAL, horizon_summary, rounded
from hma_model.evaluation.kept import kept_reader
from hma_model.evaluation.losses import episodes_of
from hma_model.evaluation.probe import shown_episodes
from hma_model.evaluation.rollouts import finite_frames
from hma_model.evaluation.state_reader import UNREADABLE_SHARE, StateNetwork, Tell, outputs, resized, trained
from hma_model.generation.decode import decode

TRAINING_STEPS, LEARNING_RATE = 600, 4e-3
IMAGE_LIMIT, EPISODES_NEEDED = 1500, 5  # most pictures to learn from, fewest episodes
HELD_OUT_SHARE = 0.2  # least share of the pictures, of the last recordings, that only measure the error
READER_VALUES = ("mean", "std", "low", "high", "error", "spread")  # of a reader, beside its network
LEAST_STD = 1e-6  # a value whose standard deviation is smaller never changes


@dataclass(frozen=True)
class Reader:
    """A trained network and what it can read.

    Attributes:
        mean, std, low, high: (S,) of the states that it learned from.
        error: (S,) its mean error on pictures of other episodes, in standard deviations.
        spread: (S,) the mean distance of their states from the median, in standard deviations.
    """

    network: nn.Module
    mean: Floats
    std: Floats
    low: Floats
    high: Floats
    error: Floats
    spread: Floats

    @property
    def readable(self) -> Ints:
        """Return the numbers of the values that change and that it reads."""
        return np.flatnonzero((self.std > LEAST_STD) & (self.error <= UNREADABLE_SHARE * self.spread))

    def errors(self, pictures: Images, states: Floats) -> Floats:
        """Return (…, S), how far from states (…, S) it reads pictures (…, H, W, 3), in std."""
        found = outputs(self.network, resized(pictures))
        true = (states - self.mean) / np.maximum(self.std, LEAST_STD)
        return np.abs(found.reshape(states.shape) - true)

    def read(self, pictures: Images) -> Floats:
        """Return the states (N, S) of pictures (N, H, W, 3), within the range of those that it learned from.

        A value that it cannot read is the mean.
        """
        states = np.tile(self.mean, (len(pictures), 1))
        own = self.readable
        states[:, own] += outputs(self.network, resized(pictures))[:, own] * self.std[own]
        return np.clip(states, self.low, self.high)


def learn(
    pictures: Images,
    states: Floats,
    recordings: Ints,
    seed: int = 0,
    tell: Tell = lambda words: None,
) -> Reader:
    """Train a reader on pictures whose state is known.

    Args:
        pictures: (N, H, W, 3).
        states: (N, S).
        recordings: (N,) those of the pictures; two or more. The last ones only measure the error.
        seed: of the training.
        tell: called with how far it is.
    """
    names, counts = np.unique(recordings, return_counts=True)
    since = counts[::-1].cumsum()[::-1]  # pictures of each recording and of those after it
    first = max(int((since >= HELD_OUT_SHARE * len(pictures)).sum()) - 1, 1)
    other = recordings >= names[first]
    small, known = resized(pictures), states[~other]
    mean, std = known.mean(axis=0), known.std(axis=0)
    scaled = (states - mean) / np.maximum(std, LEAST_STD)
    make = partial(StateNetwork, states.shape[1])
    network = trained(make, small[~other], scaled[~other], seed, TRAINING_STEPS, LEARNING_RATE, 0.1, tell)
    tested = scaled[other]
    error = np.abs(outputs(network, small[other]) - tested).mean(axis=0)
    spread = np.abs(tested - np.median(tested, axis=0)).mean(axis=0)
    return Reader(network, mean, std, known.min(axis=0), known.max(axis=0), error, spread)


def measure_recorded_state(
    tokenizer: Tokenizer,
    shards: ShardSet,
    batches: Sequence[Batch],
    predicted: Mapping[str, Sequence[Tensor]],
    *,
    prompt: int,
    cameras: Cameras,
    seed: int = 0,
) -> tuple[dict[str, Any], Floats]:
    """Compute the figures of rollouts from the recorded states.

    Args:
        tokenizer: of the shards.
        shards: a set with states.
        batches: the windows.
        predicted: the predicted tokens or latents of each batch, by the kind of rollout.
        prompt: true frames that a rollout starts from.
        cameras: those that the windows show.
        seed: of the reader.

    Returns:
        The figures: `error_sd` of the rollouts, of `copy` and of the true pictures as the tokenizer shows
        them (`reconstruction`): the mean over the horizon, at its last step, and by frame. `reader_sd` is the
        reader's own error, `spread_sd` what knows nothing would have. `values` has them by value, in its own
        unit. Also the error (N,) of each window at the last step, NaN where a state is unknown.
    """

    def missing(reason: str) -> tuple[dict[str, Any], Floats]:
        return {"windows": 0, "missing": reason}, np.full(sum(map(len, batches)), np.nan)

    if (episodes := shards.manifest.splits["train"]["episodes"]) < EPISODES_NEEDED:
        few = f"{episodes} training episodes are too few to read their states, {EPISODES_NEEDED} are needed"
        return missing(few)
    hashable: Any = tokenizer
    reader = _kept_reader(hashable, shards, cameras if isinstance(cameras, str) else tuple(cameras), seed)
    if reader is None:
        return missing("fewer than two recordings of the training split have known states")
    errors: dict[str, list[Floats]] = {}
    for number, batch in enumerate(batches):
        truth = decode(tokenizer, batch.stored)
        true = _states(shards, batch, truth.shape[1])[:, prompt:]
        films = {"copy": truth[:, prompt - 1 : prompt].repeat(true.shape[1], axis=1)}
        films["reconstruction"] = truth[:, prompt:]
        for kind, made in predicted.items():
            films[kind] = decode(tokenizer, made[number])
        for kind, film in films.items():
            found_errors = reader.errors(film, true)
            if kind in predicted:
                found_errors[~finite_frames(predicted[kind][number])] = np.nan
            errors.setdefault(kind, []).append(found_errors)
    joined = {kind: np.concatenate(parts) for kind, parts in errors.items()}
    kept = np.isfinite(joined["copy"]).all(axis=(1, 2))
    recordings = shards.recordings(episodes_of(batches))
    if not kept.any():
        return missing("the states of all windows are unknown in part")
    here = joined["reconstruction"][kept].mean(axis=(0, 1))  # the windows may be unlike what it learned from
    own = np.array([n for n in reader.readable if here[n] <= UNREADABLE_SHARE * reader.spread[n]], np.int64)
    if not len(own):
        return missing(
            "no recorded state can be estimated from the recorded images; more training episodes may help"
        )
    joined = {kind: part[..., own] for kind, part in joined.items()}
    found: dict[str, Any] = {
        "windows": int(kept.sum()),
        "reader_sd": rounded(reader.error[own].mean()),
        "spread_sd": rounded(reader.spread[own].mean()),
        "read": len(own),
        "of": len(reader.std),
        "values": _values(shards, reader, own, {kind: part[kept] for kind, part in joined.items()}),
    }
    for kind, part in joined.items():
        of_values = part[kept].mean(axis=-1)
        found[kind] = horizon_summary("error_sd", of_values, seed, episodes=recordings[kept], within=NATURAL)
    return found, joined["true"][:, -1].mean(axis=-1)


def recorded_reader(
    tokenizer: Tokenizer, shards: ShardSet, cameras: Cameras, seed: int, tell: Tell = lambda words: None
) -> Reader | None:
    """Train the reader of a set on its training split; None if fewer than two recordings have known states.

    Args:
        tokenizer: of the shards.
        shards: a set with states.
        cameras: those whose pictures it is to read, side by side.
        seed: of the training.
        tell: called with how far it is.
    """
    dataset = WindowDataset(shards, "train", 1, cameras=cameras)
    seen = dataset.batch(evenly(len(dataset), IMAGE_LIMIT))
    wanted = _states(shards, seen, 1)[:, 0]
    known = np.isfinite(wanted).all(axis=1)
    recordings = shards.recordings(episodes_of([seen]))[known]
    if len(np.unique(recordings)) < 2:
        return None

    def make() -> Reader:
        return learn(decode(tokenizer, seen.stored)[known, 0], wanted[known], recordings, seed, tell)

    told = file_sha256(shards.folder / MANIFEST)
    return _kept("recorded_reader", tokenizer, {"manifest": told, "cameras": cameras, "seed": seed}, make)


_kept_reader = lru_cache(maxsize=16)(recorded_reader)  # several checkpoints share it


def simulated_reader(
    robot: str, tokenizer: Tokenizer, stride: int, seed: int, tell: Tell = lambda words: None
) -> Reader:
    """Train the reader of a laboratory robot on simulated episodes; arguments as of `train_probe`."""

    def make() -> Reader:
        pictures, made = shown_episodes(robot, tokenizer, stride, seed, tell)
        states = np.concatenate([one.states for one in made]).astype(np.float64)
        return learn(pictures, states, np.repeat(np.arange(len(made)), len(made[0].states)), seed, tell)

    return _kept("simulated_reader", tokenizer, {"robot": robot, "stride": stride, "seed": seed}, make)


def _kept(kind: str, tokenizer: Tokenizer, facts: Mapping[str, Any], make: Callable[[], Reader]) -> Reader:
    """Return a reader, trained only if none is kept on disk (`hma_model.evaluation.kept`)."""
    return Reader(**kept_reader(kind, tokenizer, facts, make, READER_VALUES, StateNetwork))


def _values(shards: ShardSet, reader: Reader, own: Ints, errors: dict[str, Floats]) -> list[dict[str, Any]]:
    """Return for each value that is read its errors at the last step, in its own unit."""
    state = shards.embodiment.state
    assert state is not None
    units = [component.unit for component in state.components for _ in range(component.dims)]
    rows = []
    for place, number in enumerate(own):
        std = reader.std[number]
        row = {"name": state.names()[number], "unit": units[number]}
        row["reader"] = _digits(reader.error[number] * std)
        rows.append(row | {kind: _digits(one[:, -1, place].mean() * std) for kind, one in errors.items()})
    return rows


def _digits(value: float) -> float | None:
    return float(f"{value:.4g}") if np.isfinite(value) else None


def _states(shards: ShardSet, batch: Batch, frames: int) -> Floats:
    """Return the recorded states (N, T, S) of the windows' frames, NaN where unknown."""
    assert batch.episode is not None and batch.frame is not None
    known = [name for name in mask_columns(shards.embodiment) if name == "state_known"]
    # windows come episode by episode
    read = lru_cache(1)(lambda episode: shards.episode_rows(episode, ["frame_index", "state", *known]))
    found = []
    for episode, frame in zip(batch.episode.tolist(), batch.frame.tolist(), strict=True):
        rows = read(episode)
        first = int(np.flatnonzero(rows["frame_index"] == frame)[0])
        chosen = first + np.arange(frames) * shards.row_stride
        states = rows["state"][chosen].astype(np.float64)
        if "state_known" in rows:
            states[~rows["state_known"][chosen]] = np.nan
        found.append(states)
    return np.stack(found)
