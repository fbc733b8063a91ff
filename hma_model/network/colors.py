"""Choose a frame's colours from the probabilities of each pixel, so that no object is lost.

The likeliest colour of each pixel is not enough. Where an object's edge may lie here or there, its
probability is spread over its shades, and the ground is likelier than each: so a pixel takes the median of
colours. And an object that may as a whole lie here or there is nowhere likelier than the ground: so a colour
that would lose many of the pixels that are expected of it and of those near it gets them where they are
likeliest.

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
SURE = 0.98  # probability of a colour from which a pixel takes no part in balancing


def color_distances(config: HMAConfig) -> Tensor | None:
    """Return the distances (V, V) in RGB between the colours of a palette; None for other tokens."""
    if not config.tokenizer.get("colors"):
        return None
    values = torch.from_numpy(parse_colors(config.tokenizer["colors"], "tokenizer").astype(np.float32))
    return (values.unsqueeze(1) - values).norm(dim=-1)


def chosen(shares: Tensor, distances: Tensor) -> Tensor:
    """Return the colours (..., N) chosen by shares (..., N, V) and the distances (V, V) of colours."""
    values = _medians(shares, distances)
    expected, near = shares.sum(-2), (distances < NEAR).to(shares.dtype)
    counted = torch.zeros_like(expected).scatter_add(-1, values, torch.ones_like(shares[..., 0]))
    lost = counted @ near < KEPT * (expected @ near) - 0.5
    restored = _restored(shares, distances, values)
    return torch.where(lost.gather(-1, restored), restored, values)


def balanced(shares: Tensor) -> Tensor:
    """Return a frame's probabilities (..., N, V) sharpened, with as much of each value as before.

    A small object that may lie here or there is nowhere likelier than the ground. Here it keeps its expected
    number of places, the likeliest: Sinkhorn's iteration (Cuturi, 2013, arXiv:1306.0895) between the places,
    each with one value, and those numbers. A place of zeros stays one.
    """
    wanted, sharp = shares.sum(-2, keepdim=True), shares**SHARPNESS
    weight = torch.ones_like(wanted)
    for _ in range(ROUNDS):  # products of rows, (1, V) by (V, N): of columns they take four times as long
        place = (weight @ sharp.mT).clamp(min=SMALLEST).reciprocal()
        weight = wanted / (place @ sharp).clamp(min=SMALLEST)
    shares = sharp * weight
    return shares / shares.sum(-1, keepdim=True).clamp(min=SMALLEST)


def _restored(shares: Tensor, distances: Tensor, values: Tensor) -> Tensor:
    """Return the values (..., N) with those of unsure pixels from their balanced shares."""
    unsure = shares.amax(-1) < SURE
    if _fixed(shares):
        return torch.where(unsure, _medians(balanced(shares * unsure.unsqueeze(-1)), distances), values)
    restored = values.clone()
    frames = zip(restored.flatten(0, -2), shares.flatten(0, -3), unsure.flatten(0, -2), strict=True)
    for frame, share, places in frames:
        frame[places] = _medians(balanced(share[places]), distances)
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
