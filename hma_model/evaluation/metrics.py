"""Compute metrics of predicted pictures and tokens.

Picture metrics are numpy on uint8 or float pictures; token metrics are torch on logits.
N pictures of (H, W, C); F factored digits, V values a digit.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hma_data.errors import UsageError

if TYPE_CHECKING:
    from torch import Tensor

SSIM_WINDOW = 7


def psnr(truth: NDArray[Any], pictures: NDArray[Any], data_range: float = 255.0) -> NDArray[np.float64]:
    """Return the peak signal-to-noise ratio of each picture in dB; infinite if the two are equal.

    Args:
        truth: (N, H, W, C) or (H, W, C).
        pictures: as truth.
        data_range: the span of the values, 255 for uint8.

    Returns:
        (N,).
    """
    truth, pictures = _pair(truth, pictures)
    error = np.square(truth - pictures).mean(axis=(1, 2, 3))
    with np.errstate(divide="ignore"):
        return 10 * np.log10(data_range**2 / error)


def ssim(truth: NDArray[Any], pictures: NDArray[Any], data_range: float = 255.0) -> NDArray[np.float64]:
    """Return the structural similarity of each picture (Wang et al. 2004), averaged over its channels.

    The settings are those of the paper's evaluation: a uniform 7x7 window, sample covariance, K1 0.01 and
    K2 0.03, and only windows inside the picture.

    Args:
        truth: (N, H, W, C) or (H, W, C), each side at least 7.
        pictures: as truth.
        data_range: the span of the values.

    Returns:
        (N,), 1 if the two are equal.
    """
    truth, pictures = _pair(truth, pictures)
    if min(truth.shape[1:3]) < SSIM_WINDOW:
        raise UsageError(
            "ssim", f"pictures of {truth.shape[1]}x{truth.shape[2]} are smaller than its 7x7 window"
        )
    return np.array([_similarity(x, y, data_range) for x, y in zip(truth, pictures, strict=True)])


def _similarity(truth: NDArray[np.float64], picture: NDArray[np.float64], data_range: float) -> float:
    """Return the SSIM of two pictures (H, W, C); the arrays of one pair fit a processor's cache."""
    count = SSIM_WINDOW**2
    mean_x, mean_y = _box(truth), _box(picture)
    unbias = count / (count - 1)
    var_x = unbias * (_box(truth * truth) - mean_x * mean_x)
    var_y = unbias * (_box(picture * picture) - mean_y * mean_y)
    covariance = unbias * (_box(truth * picture) - mean_x * mean_y)
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    above = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    below = (mean_x**2 + mean_y**2 + c1) * (var_x + var_y + c2)
    return float((above / below).mean())


def _pair(truth: NDArray[Any], pictures: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    if truth.shape != pictures.shape or truth.ndim not in (3, 4):
        raise UsageError(
            "metrics", f"pictures must agree as (N, H, W, C), are {truth.shape} and {pictures.shape}"
        )
    shape = (-1, *truth.shape[-3:])
    return truth.reshape(shape).astype(np.float64), pictures.reshape(shape).astype(np.float64)


def _box(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean over every 7x7 window inside (H, W, C), by running sums along each axis."""
    for axis in (0, 1):
        sums = np.zeros([n + (k == axis) for k, n in enumerate(values.shape)])
        behind, ahead = [slice(None)] * 3, [slice(None)] * 3
        ahead[axis] = slice(1, None)
        np.cumsum(values, axis=axis, out=sums[tuple(ahead)])
        behind[axis], ahead[axis] = slice(None, -SSIM_WINDOW), slice(SSIM_WINDOW, None)
        values = (sums[tuple(ahead)] - sums[tuple(behind)]) / SSIM_WINDOW
    return values


def perplexity(nats: float) -> float:
    """Return exp of a cross-entropy in nats a token; infinity in place of an overflow."""
    return math.exp(nats) if nats < 700 else math.inf


def token_nats(logits: "Tensor", tokens: "Tensor", factored: Sequence[int]) -> "Tensor":
    """Return the cross-entropy of each token in nats: the sum over its digits, without label smoothing.

    Args:
        logits: (..., F, V).
        tokens: (...) int64 ids.
        factored: values of each digit, low digit first.

    Returns:
        (...) float32.
    """
    import torch.nn.functional as functional

    from hma_model.network.embed import to_digits

    digits = to_digits(tokens, factored)
    flat = functional.cross_entropy(
        logits.flatten(0, -2).float(), digits.flatten().to(logits.device), reduction="none"
    )
    return flat.view(digits.shape).sum(dim=-1)


def token_hits(logits: "Tensor", tokens: "Tensor", factored: Sequence[int]) -> "Tensor":
    """Return (...) bool, True where every likeliest digit is the true one; arguments as in `token_nats`."""
    from hma_model.network.embed import to_digits

    return (logits.argmax(dim=-1) == to_digits(tokens, factored).to(logits.device)).all(dim=-1)
