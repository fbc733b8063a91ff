"""Sum up training steps, and name the windows of those whose loss or gradient is not finite."""

import math
import resource
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import pyarrow.compute as pc
import torch
from torch import Tensor

from hma_data.loading.dataset import Batch
from hma_data.shards.reader import ShardSet
from hma_model.config import OBJECTIVES
from hma_model.network.objectives import Output
from hma_model.training.parallel import Ranks

NAMED = 4  # windows named in an error


class StepMetrics:
    """Sums of losses, kept on their device, so that a step needs only one transfer.

    Objectives have losses of different kinds, nats or squared errors; those by embodiment are of one alone.

    Args:
        names: ids of the embodiments.
        device: of the model.
        main: the objective whose losses are told by embodiment.
    """

    def __init__(self, names: list[str], device: torch.device, main: str) -> None:
        self._names, self._main = sorted(names), main
        self._loss = torch.zeros(1, device=device)
        self._sums = torch.zeros(2, len(names), device=device)
        self._objectives = torch.zeros(2, len(OBJECTIVES), device=device)

    def add(self, embodiment: list[str], output: Output) -> None:
        """Add the loss of a pass, the loss of each sample, and the objective."""
        index = torch.tensor([self._names.index(name) for name in embodiment], device=self._sums.device)
        losses = output.per_sample.to(self._sums)
        self._loss += output.loss.detach().to(self._loss)
        if output.objective == self._main:
            self._sums.index_add_(1, index, torch.stack([losses, torch.ones_like(losses)]))
        own = list(OBJECTIVES).index(output.objective)
        self._objectives[:, own] += torch.stack([output.loss.detach().to(losses), torch.ones_like(losses[0])])

    def whole(self, ranks: Ranks, passes: int) -> tuple[float, dict[str, float], dict[str, float]]:
        """Return the mean loss over all ranks, the main objective's by embodiment, and each objective's."""
        flat = ranks.sum(torch.cat([self._loss, self._sums.flatten(), self._objectives.flatten()]))
        parts = flat[1:].split([*[len(self._names)] * 2, *[len(OBJECTIVES)] * 2])
        by_name, by_objective = (
            {name: s / n for name, s, n in zip(names, sums.tolist(), counts.tolist()) if n}
            for names, sums, counts in ((self._names, *parts[:2]), (OBJECTIVES, *parts[2:]))
        )
        return float(flat[0]) / passes, by_name, dict(sorted(by_objective.items()))


def peak_memory_mib(device: torch.device) -> float:
    """Return the peak memory in MiB of the GPU's tensors, or of the process on another device."""
    if device.type == "cuda":
        return round(torch.cuda.max_memory_allocated(device) / 2**20, 1)
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit, 1)


def suspects(
    batches: Sequence[tuple[Batch, Tensor]], sets: Mapping[str, ShardSet]
) -> list[tuple[float, str]]:
    """Return the windows of this rank that may be the cause of a bad step, each with its loss.

    Each batch of the step comes with the loss (B,) of its windows; the shard sets have the episodes' names.
    """
    found: list[tuple[Any, ...]] = []
    for batch, losses in batches:
        assert batch.episode is not None and batch.frame is not None
        inside = torch.ones_like(batch.action_mask) if batch.frame_mask is None else batch.frame_mask
        places = (batch.episode, batch.frame, inside.sum(1))
        found += zip(losses.tolist(), batch.embodiment, *(column.tolist() for column in places), strict=True)
    return [(loss, _place(sets[name], *where)) for loss, name, *where in worst(found)]


def worst[Item: tuple[Any, ...]](found: Sequence[Item]) -> list[Item]:
    """Return the windows whose losses, their first items, are not finite; else all, the largest first."""
    bad = [item for item in found if not math.isfinite(item[0])]
    return bad or sorted(found, key=lambda item: -item[0])


def listed(windows: Sequence[str]) -> str:
    """Return a text that names the first few windows and counts the others."""
    more = len(windows) - NAMED
    return "; ".join(windows[:NAMED]) + (f" and {more} more" if more > 0 else "")


def _place(shards: ShardSet, episode: int, first: int, length: int) -> str:
    rows = shards.episodes.filter(pc.equal(shards.episodes["episode_index"], episode))
    last = first + (length - 1) * shards.row_stride
    return f"{shards.embodiment.id} episode {episode} ({rows['id'][0]}) frames {first} to {last}"
