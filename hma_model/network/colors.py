"""Choose a frame's colours from the probabilities of each pixel, so that no object is lost.

The likeliest colour of each pixel is not enough. Where an object's edge may lie here or there, its
probability is spread over its shades, and the ground is likelier than each: so a pixel takes the median of
colours. And an object that may as a whole lie here or there is nowhere likelier than the ground: so a colour
that would lose many of the pixels that are expected of it and of those near it gets them where they are
likeliest. And things do not vanish: of the pixels that a colour has lost since the frame before, it keeps as
large a share as the ground has of the frame, even where fewer are expected. The rest may be hidden.

N pixels of a frame, V colours.
"""

import numpy as np
import torch
from torch import Tensor

from hma_data.tokenizers.shapes import parse_colors
from hma_model.config import HMAConfig

SHARPNESS, ROUNDS, SMALLEST = 3, 8, 1e-30  # of balanced shares
NEAR = 60.0  # distance of RGB up to which colours are shades of one
KEPT = 0.9  # of the pixels expected of a colour; with fewer it is lost
GONE, FEWEST, MOST_GAIN = 0.05, 6, 50.0  # share that may vanish; pixels of a thing; gain of its shares
SURE = 0.98  # probability of a colour from which a pixel takes no part in balancing


def color_distances(config: HMAConfig) -> Tensor | None:
    """Return the distances (V, V) in RGB between the colours of a palette; None for other tokens."""
    if not config.tokenizer.get("colors"):
        return None
    values = torch.from_numpy(parse_colors(config.tokenizer["colors"], "tokenizer").astype(np.float32))
    return (values.unsqueeze(1) - values).norm(dim=-1)


def chosen(shares: Tensor, distances: Tensor, before: Tensor | None = None) -> Tensor:
    """Return the colours (..., N) chosen by shares (..., N, V) and the distances (V, V) of colours.

    Args:
        before: (..., N) colours of the frame before, in any order, or -1; by default no frame is before.
    """
    values = _medians(shares, distances)
    wanted, near = shares.sum(-2), (distances < NEAR).to(shares.dtype)
    lost = _counts(values, shares) @ near < KEPT * (wanted @ near) - 0.5
    if before is not None:
        wanted, kept = _kept(wanted, values, before, shares, near)
        lost = lost | kept
    restored = _restored(shares, distances, values, wanted)
    return torch.where(lost.gather(-1, restored) | lost.gather(-1, values), restored, values)


def _kept(
    wanted: Tensor, values: Tensor, before: Tensor, shares: Tensor, near: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the wanted numbers (..., V) with the pixels that would vanish, and whose they are (..., V)."""
    counts = _counts(before, shares)
    had, now, most = counts @ near, _counts(values, shares) @ near, counts.argmax(-1)
    ground = near[most] > 0
    uncovered = (counts * ground).sum(-1, keepdim=True) / counts.sum(-1, keepdim=True).clamp(min=1)
    gone = (had - now) * uncovered
    kept = (gone > GONE * had + 0.5) & (had >= FEWEST) & ~ground
    gain = (now + gone) / (wanted @ near).clamp(min=1e-3)
    more = torch.where(kept, wanted * gain.clamp(1.0, MOST_GAIN), wanted)
    extra = (more - wanted).sum(-1, keepdim=True)  # the ground has as many fewer
    return more.scatter_add(-1, most.unsqueeze(-1), -extra).clamp(min=0), kept


def _counts(values: Tensor, shares: Tensor) -> Tensor:
    """Return how many pixels have each of the V values (..., V); -1 is none."""
    zeros = torch.zeros_like(shares[..., 0, :])
    return zeros.scatter_add(-1, values.clamp(min=0), (values >= 0).to(shares.dtype))


def balanced(shares: Tensor, wanted: Tensor | None = None) -> Tensor:
    """Return a frame's probabilities (..., N, V) sharpened, with as much of each value as wanted (..., V).

    By default as much as before.

    A small object that may lie here or there is nowhere likelier than the ground. Here it keeps its expected
    number of places, the likeliest: Sinkhorn's iteration (Cuturi, 2013, arXiv:1306.0895) between the places,
    each with one value, and those numbers. A place of zeros stays one.
    """
    wanted = (shares.sum(-2) if wanted is None else wanted).unsqueeze(-2)
    sharp = shares**SHARPNESS
    weight = torch.ones_like(wanted)
    for _ in range(ROUNDS):  # products of rows, (1, V) by (V, N): of columns they take four times as long
        place = (weight @ sharp.mT).clamp(min=SMALLEST).reciprocal()
        weight = wanted / (place @ sharp).clamp(min=SMALLEST)
    shares = sharp * weight
    return shares / shares.sum(-1, keepdim=True).clamp(min=SMALLEST)


def _restored(shares: Tensor, distances: Tensor, values: Tensor, wanted: Tensor) -> Tensor:
    """Return the values (..., N) with those of unsure pixels from their shares, balanced to `wanted`."""
    unsure = shares.amax(-1) < SURE
    left = (wanted - (shares * ~unsure.unsqueeze(-1)).sum(-2)).clamp(min=0)
    if _fixed(shares):
        return torch.where(unsure, _medians(balanced(shares * unsure.unsqueeze(-1), left), distances), values)
    restored = values.clone()
    each = (restored.flatten(0, -2), shares.flatten(0, -3), unsure.flatten(0, -2), left.flatten(0, -2))
    for frame, share, places, rest in zip(*each, strict=True):
        frame[places] = _medians(balanced(share[places], rest), distances)
    return restored


def _medians(shares: Tensor, distances: Tensor) -> Tensor:
    """Return the colours (..., N) with the least expected distances."""
    if _fixed(shares):
        return (shares @ distances).argmin(-1)
    most, values = shares.max(-1)
    unsure = most < 0.5  # a colour with half of the probability is the median
    values[unsure] = (shares[unsure] @ distances).argmin(-1)
    return values


def _fixed(values: Tensor) -> bool:
    """Return whether code is compiled for a device, or into a graph: no size may depend on values."""
    return values.device.type != "cpu" or torch.compiler.is_compiling()
