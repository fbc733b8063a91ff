"""Replace the actions of windows: by another window's, by random ones, or by none.

How much worse a model predicts with them shows how much it uses its actions.

B batch, T frames, A action dims, K = stride·A.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hma_data.loading.dataset import Batch


def shuffled_actions(batch: Batch, begin: int = 0, seed: int = 0, draw: int = 0) -> Tensor:
    """Replace each window's chunks from `begin` on by those of another window of the same embodiment.

    Every `draw` pairs the windows anew. A window that is the only one of its embodiment gets its own chunks
    in reverse. Return (B, T, K).
    """
    actions = batch.actions.clone()
    source = batch.actions[:, begin:]
    rng = np.random.default_rng([seed, 1 + draw])
    for name in dict.fromkeys(batch.embodiment):
        own = rng.permutation([i for i, other in enumerate(batch.embodiment) if other == name])
        if len(own) == 1:  # there is no other window to take actions from
            actions[own, begin:] = source[own].flip(1)
        else:
            actions[own, begin:] = source[np.roll(own, 1)]
    return actions


def shuffled(batch: Batch, begin: int = 0, seed: int = 0, draw: int = 0) -> Batch:
    """Return the windows with the chunks of `shuffled_actions`, which are known where they were."""
    masks = replace(batch, actions=batch.action_mask)
    known = shuffled_actions(masks, begin, seed, draw)
    return replace(batch, actions=shuffled_actions(batch, begin, seed, draw), action_mask=known)


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
