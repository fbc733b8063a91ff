"""Cut windows to a square of each frame in which something moves, so that training computes little else.

The convolutional trunk looks at the surroundings of a place, so a part of a frame teaches it most of what the
whole frame would, in a fraction of the time. Places near a cut edge lack their surroundings and have no loss.

Not all of it: the coarsest resolution sees an edge from every place of a square, and little of one in a whole
frame. Parts of a robot that cross the frame then dissolve at the first step of a rollout, while the loss on
squares is low. So a run ends with whole frames (`Recipe.whole_from`).

B batch, T frames, V views, h,w grid of tokens of a view, C side of the square in tokens, S = C².
"""

from dataclasses import replace

import torch
from torch import Tensor

from hma_data.loading.dataset import Batch
from hma_model.config import HMAConfig
from hma_model.network.draws import uniform

ANYWHERE = 0.15  # share of the windows whose square lies anywhere, so that what stands still is seen too


def cropped(config: HMAConfig, batch: Batch, generator: torch.Generator | None) -> Batch:
    """Return the batch with squares of `config.crop` tokens of its frames, and their `places`.

    The square of a window has the same place in all its frames and views. It lies around a place that changes
    in the window, drawn evenly, or in some windows around any place.
    """
    frames = batch.stored
    side, width = config.crop, config.token_grid[1]
    cell = config.merge if config.discrete else config.patch
    corners = _corners(config, _moving(frames, cell, config.views).cpu(), generator).to(frames.device)
    rows, columns = corners.unsqueeze(-1) + torch.arange(side, device=frames.device)  # (B, C) each
    places = (rows.unsqueeze(2) * width + columns.unsqueeze(1)).flatten(1)
    cut = _cut(frames, corners * cell, side * cell, config.views)
    if batch.tokens is not None:
        return replace(batch, places=places, tokens=cut)
    return replace(batch, places=places, latents=cut)


def _moving(frames: Tensor, cell: int, views: int) -> Tensor:
    """Return which places (B, h, w) change in a window of frames (B, T, …, V·H, W), in any view."""
    changes = (frames[:, 1:] != frames[:, :-1]).flatten(1, -3).any(1)
    height, width = changes.shape[1] // views // cell, changes.shape[2] // cell
    return changes.reshape(len(frames), views, height, cell, width, cell).any(5).any(3).any(1)


def _corners(config: HMAConfig, moving: Tensor, generator: torch.Generator | None) -> Tensor:
    """Draw the rows and columns (2, B) of the squares' first tokens."""
    side, (batch, height, width) = config.crop, moving.shape
    free, at, *inset = uniform((4, batch), generator)
    likely = moving.flatten(1).double()
    likely[(free < ANYWHERE) | ~moving.flatten(1).any(1)] = 1.0
    reached = likely.cumsum(1)
    place = (reached <= at.unsqueeze(1) * reached[:, -1:]).sum(1)
    margin = side // 4  # the place lies in the middle half of its square where the frame allows it
    before = [margin + (one * (side - 2 * margin)).long() for one in inset]
    top = (place // width - before[0]).clamp(0, height - side)
    return torch.stack([top, (place % width - before[1]).clamp(0, width - side)])


def _cut(frames: Tensor, corners: Tensor, side: int, views: int) -> Tensor:
    """Return the squares (B, T, …, V·side, side) of frames (B, T, …, V·H, W) from `corners` (2, B) on."""
    each = frames.unflatten(-2, (views, -1)).movedim((-2, -1), (1, 2))  # (B, H, W, T, …, V)
    rows, columns = corners.unsqueeze(-1) + torch.arange(side, device=frames.device)
    sample = torch.arange(len(frames), device=frames.device).view(-1, 1, 1)
    squares = each[sample, rows.unsqueeze(2), columns.unsqueeze(1)]
    return squares.movedim((1, 2), (-2, -1)).flatten(-3, -2).contiguous()
