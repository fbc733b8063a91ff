"""When a step is not to be trusted: a loss that is no number, or a gradient far beyond what it was.

What the run does then is the recipe's: stop and name the windows, or leave the step out and count it.
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
MEMORY = 0.98  # of the running mean of norms
SETTLED = 20  # steps before a norm can be a spike


@dataclass
class Pulse:
    """The running mean of gradient norms.

    Attributes:
        limit: a norm above this many times the mean is a spike; 0 never.
        mean: of the norms of steps that were taken.
        count: of these steps.
    """

    limit: float = 0.0
    mean: float = 0.0
    count: int = 0

    def fault(self, loss: float, norm: float) -> str:
        """What is wrong with a step; nothing for one that may be taken."""
        if not math.isfinite(loss) or not math.isfinite(norm):
            return f"the loss is {loss}, the gradient's norm {norm}"
        if self.limit and self.count >= SETTLED and norm > self.limit * self.mean:
            times = norm / max(self.mean, 1e-12)
            return f"the gradient's norm {norm:.4g} is {times:.1f} times its running mean {self.mean:.4g}"
        return ""

    def take(self, norm: float) -> None:
        """Count in the norm of a step that was taken."""
        weight = max(1 - MEMORY, 1 / (self.count + 1))
        self.mean += weight * (norm - self.mean)
        self.count += 1


def suspects(
    batches: Sequence[tuple[Batch, Tensor]], sets: "Mapping[str, ShardSet]"
) -> list[tuple[float, str]]:
    """The windows of this rank's part of a step that may be at fault, each with its loss.

    Args:
        batches: with the loss (B,) of each window.
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
    """Of the suspects of all ranks those whose losses are not numbers; else all, the largest losses first."""
    return [text for _, text in _worst(suspected)]


def _worst[Item: tuple[Any, ...]](found: Sequence[Item]) -> list[Item]:
    bad = [item for item in found if not math.isfinite(item[0])]
    return bad or sorted(found, key=lambda item: -item[0])


def listed(windows: Sequence[str]) -> str:
    """The first few, and how many more."""
    more = len(windows) - NAMED
    return "; ".join(windows[:NAMED]) + (f" and {more} more" if more > 0 else "")


def _span(shards: "ShardSet | None", first: object, length: int) -> str:
    """The rows of `frame_index` that a window of so many frames goes over."""
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
