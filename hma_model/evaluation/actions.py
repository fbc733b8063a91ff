"""Replace the actions of windows: by another window's, by random ones, or by none.

How much worse a model predicts with them shows how much it uses its actions.

B batch, T frames, A action dims, K = stride·A.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hma_data.arrays import Ints
from hma_data.loading.dataset import Batch


def shuffled(batch: Batch, begin: int = 0, seed: int = 0, draw: int = 0) -> Batch:
    """Return the windows with another window's chunks from `begin` on, known where they were known there.

    A window that is the only one of its embodiment gets its own chunks in reverse.
    """
    others = partners(batch.embodiment, seed, draw)
    alone = others == np.arange(len(others))

    def taken(values: Tensor) -> Tensor:
        later = values[others, begin:]
        later[alone] = later[alone].flip(1)
        return torch.cat([values[:, :begin], later], dim=1)

    return replace(batch, actions=taken(batch.actions), action_mask=taken(batch.action_mask))


def partners(embodiments: Sequence[str], seed: int, draw: int) -> Ints:
    """Return for each window (B,) another one of its embodiment, if there is one; each `draw` pairs anew."""
    found = np.arange(len(embodiments))
    rng = np.random.default_rng([seed, 1 + draw])
    for name in dict.fromkeys(embodiments):
        own = rng.permutation([i for i, other in enumerate(embodiments) if other == name])
        found[own] = np.roll(own, 1)
    return found


def gaussian(batch: Batch, stats: Mapping[str, Any], seed: int = 0) -> Batch:
    """Return windows of one embodiment with every command drawn anew, as the paper's evaluation does.

    Args:
        batch: chunks of K = stride·A values, time-major.
        stats: `mean` and `std` (A,) of the embodiment's raw actions; a command is N(mean, std²).
        seed: of the draws.
    """
    mean, std = (torch.tensor(stats[key], dtype=torch.float32) for key in ("mean", "std"))
    generator = torch.Generator().manual_seed(seed)
    steps = batch.actions.unflatten(2, (-1, len(mean)))
    drawn = torch.randn(steps.shape, generator=generator) * std + mean
    return replace(batch, actions=drawn.flatten(2), action_mask=torch.ones_like(batch.action_mask))


def without_actions(batch: Batch) -> Batch:
    """Return the windows with all chunks unknown."""
    return replace(batch, action_mask=torch.zeros_like(batch.action_mask))
