"""Measure a model's loss on windows, and a baseline that ignores all input.

The loss is the cross-entropy in nats a token of each fully masked frame, given the true frames and actions
before it. It is averaged over the frames from the second on. The baseline is the same cross-entropy for the
frequencies of the training tokens: a model that ignores its input would reach it.

B batch, T frames, F digits, V values a digit.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hma_data.arrays import Floats, Ints
from hma_data.errors import UsageError
from hma_data.loading.dataset import Batch, WindowDataset
from hma_data.loading.views import FIRST_CAMERA, Cameras, Views
from hma_data.shards.reader import ShardSet
from hma_data.storage.paths import StrPath
from hma_model.arrays import evenly
from hma_model.config import OBJECTIVES, HMAConfig
from hma_model.evaluation.metrics import teacher_forced
from hma_model.network.model import HMA

BASELINE_FRAMES = 200_000


@dataclass
class Means:
    """Values of samples, in their order, and the embodiment of each."""

    names: list[str] = field(default_factory=list)
    samples: list[float] = field(default_factory=list)

    def add(self, names: Sequence[str], values: Tensor | NDArray[Any]) -> None:
        """Add one value a sample, (B,)."""
        self.names += names
        self.samples += values.tolist()

    def by_embodiment(self) -> dict[str, float]:
        """Return the mean of each embodiment, sorted by id."""
        whose, values = np.array(self.names), np.array(self.samples)
        return {name: float(values[whose == name].mean()) for name in sorted(set(self.names))}

    def mean(self) -> float:
        """Return the mean over all samples; NaN if there are none."""
        return float(np.mean(self.samples)) if self.samples else float("nan")


def windows(
    data: StrPath | ShardSet,
    split: str,
    frames: int,
    count: int,
    batch_size: int = 8,
    cameras: Cameras = FIRST_CAMERA,
) -> Iterator[Batch]:
    """Yield up to `count` windows of a split in batches; they are evenly spaced and always the same.

    A batch has a single window only if there is but one: windows take the actions of others in their batch.
    """
    dataset = WindowDataset(data, split, frames, cameras=cameras)
    chosen = evenly(len(dataset), count)
    if not len(dataset):
        return
    whole, rest = divmod(len(chosen), batch_size)
    # a last batch of one window would find no other window's actions: it is spread over the others
    alone = rest == 1 and whole and batch_size > 1
    parts = np.array_split(chosen, whole + 1 if alone else range(batch_size, len(chosen), batch_size))
    yield from map(dataset.batch, parts)


def episodes_of(batches: Sequence[Batch]) -> Ints:
    """Return the episode (N,) of each window of a shard set."""
    known: Any = [batch.episode for batch in batches]
    return np.concatenate(known)


def no_window(shards: ShardSet, split: str, frames: int) -> UsageError:
    """Return the error of a split that has no window of so many frames."""
    if shards.manifest.splits[split]["episodes"]:
        fault, remedy = (
            f"has no window of {frames} frames in {split}",
            "give another --split or fewer --frames",
        )
    else:
        other = "train" if split == "val" else "val"
        fault, remedy = f"has no episode in {split}", f"give --split {other}, or convert more episodes"
    return UsageError(shards.folder, fault, remedy)


@torch.no_grad()
def validation_losses(
    model: HMA, batches: Iterable[Batch], seed: int = 0, objective: str = "forward"
) -> tuple[Means, Means]:
    """Return the losses and accuracies of the windows, by embodiment.

    Where a discrete model predicts video from actions, the loss is that of `teacher_forced`. Any other loss
    is the training loss of the objective, under masks and noise drawn from `seed`; it has no accuracy.
    """
    losses, accuracy, training = Means(), Means(), model.training
    drawn = OBJECTIVES[objective]
    exact = model.config.kind == "discrete" and drawn.predicts_video and drawn.sees_actions
    model.eval()
    for number, batch in enumerate(batches):
        batch = batch.to(model.device)
        if exact:
            nats, hits = teacher_forced(model, batch)
            losses.add(batch.embodiment, nats.mean(dim=1))
            accuracy.add(batch.embodiment, hits.mean(dim=1))
        else:
            generator = torch.Generator().manual_seed(seed * 1_000_003 + number)
            losses.add(batch.embodiment, model(batch, objective, generator).per_sample)
    model.train(training)
    return losses, accuracy


def digit_frequencies(
    shards: ShardSet,
    factored: Sequence[int],
    cameras: Cameras = FIRST_CAMERA,
) -> list[Floats]:
    """Return the frequency of each value of each digit in train: F arrays (V,), add-one smoothed.

    `factored` states the values of each digit, low digit first.

    Of more than BASELINE_FRAMES frames, only row groups spread evenly over them are counted, so many frames
    at most.
    """
    counts = [np.ones(values) for values in factored]
    files = list(zip(shards.shards("train"), shards.row_groups("train")))
    groups = [(name, group) for name, rows in files for group in range(len(rows))]
    stride = max(1, -(-sum(sum(rows) for _, rows in files) // BASELINE_FRAMES))
    columns = Views.of(shards, cameras).columns
    for name, group in groups[::stride]:
        read = shards.read(name, [group], columns)
        tokens = np.concatenate([read[column].astype(np.int64).ravel() for column in columns])
        for digit, values in enumerate(factored):
            counts[digit] += np.bincount(tokens % values, minlength=values)
            tokens //= values
    return [count / count.sum() for count in counts]


def unconditional_baseline(
    sets: Iterable[ShardSet], batches: Iterable[Batch], config: HMAConfig, cameras: Cameras = FIRST_CAMERA
) -> Means:
    """Return the cross-entropy of each embodiment's training frequencies, which ignores all input.

    Args:
        sets: those whose train frames are counted, digit by digit.
        batches: validation windows of discrete tokens.
        config: of the model, which says what digits and squares of tokens there are.
        cameras: as `WindowDataset` takes them.

    Returns:
        Nats a token by embodiment, over the frames from the second on, as in `validation_losses`.
    """
    scores = {
        shards.embodiment.id: [np.log(p) for p in digit_frequencies(shards, config.factored, cameras)]
        for shards in sets
    }
    means = Means()
    for batch in batches:
        for name, tokens in zip(batch.embodiment, batch.stored[:, 1:].numpy()):
            nats, rest = np.zeros(tokens.shape), tokens.copy()
            for digit in scores[name]:
                nats -= digit[rest % len(digit)]
                rest //= len(digit)
            means.add([name], np.array([nats.mean() * config.merge**2]))
    return means
