"""Compute the cross-entropy of many digits a few rows at a time, and never hold all scores.

A step of 16 windows of colours has twenty million scores, and torch passes over them a dozen times. A few
rows stay in the processor's cache; the backward pass computes their scores again. On a CPU this takes half of
the time of torch's operations, a third in bf16.

M rows, D width, F digits, V values of a digit.
"""

from collections.abc import Iterator
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hma_model.network.linear import is_whole, product

ROWS = 256  # 1 MB of scores of 255 colours


def has_kernel(linear: nn.Module, features: Tensor) -> bool:
    """Check whether `cross_entropy` takes this map and these features; elsewhere torch's operations serve."""
    return features.device.type == "cpu" and not torch.compiler.is_compiling() and is_whole(linear)


def cross_entropy(
    features: Tensor, linear: nn.Linear, gains: Tensor | None, before: Tensor | None, digits: Tensor
) -> Tensor:
    """Return the cross-entropy (M,) float32, summed over digits, of features (M, D) through a linear map.

    Args:
        linear: its outputs (M, F·V) are the scores of the digits' values, digit after digit.
        gains: (M, F) float32, what the scores of the digits `before` gain; None for no gains.
        before: (M, F) int64 those of the frame before, from 0; not used without gains.
        digits: (M, F) int64 the true ones.
    """
    values: tuple[Tensor, ...] = features, linear.weight, linear.bias
    if torch.is_autocast_enabled("cpu"):
        values = tuple(each.to(torch.get_autocast_dtype("cpu")) for each in values)
    with torch.autocast("cpu", enabled=False):
        made: Tensor = _CrossEntropy.apply(*values, gains, before, digits)
    return made


class _CrossEntropy(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        features: Tensor,
        weight: Tensor,
        bias: Tensor,
        gains: Tensor | None,
        before: Tensor | None,
        digits: Tensor,
    ) -> Tensor:
        totals = torch.empty(digits.shape)  # the logarithms of the sums of a digit's probabilities
        true = torch.empty_like(totals)
        for rows, scores in _scores(features, weight, bias, digits.shape[1], gains, before):
            totals[rows] = scores.logsumexp(-1)
            true[rows] = scores.gather(-1, digits[rows].unsqueeze(-1)).squeeze(-1)
        ctx.save_for_backward(features, weight, bias, gains, before, digits, totals)
        return (totals - true).sum(-1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:
        features, weight, bias, gains, before, digits, totals = ctx.saved_tensors
        of_features = torch.empty_like(features)
        of_weight, of_bias = (torch.zeros_like(each, dtype=torch.float32) for each in (weight, bias))
        of_gains = None if gains is None else torch.empty_like(gains)
        for rows, scores in _scores(features, weight, bias, digits.shape[1], gains, before):
            shares = scores.sub_(totals[rows].unsqueeze(-1)).exp_()
            places = digits[rows].unsqueeze(-1)
            shares.scatter_add_(-1, places, shares.new_full((), -1.0).expand(places.shape))
            shares *= grad[rows, None, None]
            if before is not None and of_gains is not None:
                of_gains[rows] = shares.gather(-1, before[rows].unsqueeze(-1)).squeeze(-1)
            of_scores = shares.flatten(1)
            of_bias += of_scores.sum(0)
            of_scores = of_scores.to(features.dtype)
            torch.mm(of_scores, weight, out=of_features[rows])
            of_weight += of_scores.t() @ features[rows]
        return of_features, of_weight.to(weight.dtype), of_bias.to(bias.dtype), of_gains, None, None


def _scores(
    features: Tensor, weight: Tensor, bias: Tensor, count: int, gains: Tensor | None, before: Tensor | None
) -> Iterator[tuple[slice, Tensor]]:
    """Yield rows, and the scores (rows, F, V) float32 of their `count` digits."""
    for first in range(0, len(features), ROWS):
        rows = slice(first, first + ROWS)
        if features.dtype == torch.float32:
            scores = product(features[rows], weight, bias)
        else:
            scores = F.linear(features[rows], weight, bias).float()
        scores = scores.unflatten(-1, (count, -1))
        if gains is not None and before is not None:
            scores.scatter_add_(-1, before[rows].unsqueeze(-1), gains[rows].unsqueeze(-1))
        yield rows, scores
