"""Detect bad training steps: a loss that is not finite, or a gradient far above its running mean.

The recipe decides what the run does then: stop and name the windows, or skip the step and count it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from hma_data.loading.dataset import Batch

if TYPE_CHECKING:
    from collections.abc import Mapping

    from hma_data.shards.reader import ShardSet

NAMED = 4  # windows named in an error
MEMORY = 0.98  # decay of the running mean of norms
SETTLED = 20  # steps before a norm can be a spike


@dataclass
class GradientSpikeDetector:
    """The running mean of gradient norms.

    Attributes:
        limit: a norm above this many times the mean is a spike; with 0 no norm is.
        mean: running mean of the norms of steps that were taken.
        count: number of these steps.
    """

    limit: float = 0.0
    mean: float = 0.0
    count: int = 0

    def fault(self, loss: float, norm: float) -> str:
        """Return the fault of a step; an empty string if the step may be taken."""
        if not math.isfinite(loss) or not math.isfinite(norm):
            return f"the loss is {loss}, the gradient's norm {norm}"
        if self.limit and self.count >= SETTLED and norm > self.limit * self.mean:
            times = norm / max(self.mean, 1e-12)
            return f"the gradient's norm {norm:.4g} is {times:.1f} times its running mean {self.mean:.4g}"
        return ""

    def take(self, norm: float) -> None:
        """Update the mean with the norm of a step that was taken."""
        weight = max(1 - MEMORY, 1 / (self.count + 1))
        self.mean += weight * (norm - self.mean)
        self.count += 1


def suspects(
    batches: Sequence[tuple[Batch, Tensor]], sets: "Mapping[str, ShardSet]"
) -> list[tuple[float, str]]:
    """Return the windows of this rank that may be the cause of a bad step, each with its loss.

    Args:
        batches: the batches of the step, each with the loss (B,) of its windows.
        sets: shard sets by embodiment, for the episodes' names.
    """
    found = []
    for batch, losses in batches:
        episodes, frames = (
            ["?"] * len(batch) if v is None else v.tolist() for v in (batch.episode, batch.frame)
        )
        inside = torch.ones_like(batch.action_mask) if batch.frame_mask is None else batch.frame_mask
        rows = zip(batch.embodiment, episodes, frames, losses.tolist(), inside.sum(1).tolist(), strict=True)
        found += [(loss, name, episode, frame, length) for name, episode, frame, loss, length in rows]
    told = []
    for loss, name, episode, frame, length in _worst(found):
        shards = sets.get(name)
        place = f"{name} episode {episode}{_named(shards, episode)} {_span(shards, frame, length)}"
        told.append((loss, place))
    return told


def culprits(suspected: Sequence[tuple[float, str]]) -> list[str]:
    """Return the suspects of all ranks whose losses are not finite; else all, the largest losses first."""
    return [text for _, text in _worst(suspected)]


def _worst[Item: tuple[Any, ...]](found: Sequence[Item]) -> list[Item]:
    bad = [item for item in found if not math.isfinite(item[0])]
    return bad or sorted(found, key=lambda item: -item[0])


def listed(windows: Sequence[str]) -> str:
    """Return a text that names the first few windows and counts the others."""
    more = len(windows) - NAMED
    return "; ".join(windows[:NAMED]) + (f" and {more} more" if more > 0 else "")


def _span(shards: "ShardSet | None", first: object, length: int) -> str:
    """Return a text that names the frames of the episode that a window of `length` frames spans."""
    if shards is None or not isinstance(first, int):
        return f"frame {first} and on"
    return f"frames {first} to {first + (length - 1) * shards.row_stride}"


def _named(shards: "ShardSet | None", episode: object) -> str:
    if shards is None:
        return ""
    import pyarrow.compute as pc

    table = shards.episodes
    rows = table.filter(pc.equal(table["episode_index"], episode))["id"].to_pylist()
    return f" ({rows[0]})" if rows else ""
