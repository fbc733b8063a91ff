"""How good a tokenizer is: what a round trip loses, what its ids use, what it costs.

N frames, S side, h·w grid, D digits.
"""

import torch
from torch import Tensor
from torch.nn import functional


def _window(channels: int, like: Tensor) -> Tensor:
    """Gaussian of 11 taps, sigma 1.5 (Wang et al. 2004)."""
    at = torch.arange(11, dtype=like.dtype, device=like.device) - 5
    taps = torch.exp(-(at**2) / (2 * 1.5**2))
    return (taps / taps.sum()).view(1, 1, 11, 1).expand(channels, 1, 11, 1)


def _smooth(x: Tensor) -> Tensor:
    window = _window(x.shape[1], x)
    x = functional.conv2d(x, window, groups=x.shape[1])
    return functional.conv2d(x, window.transpose(2, 3), groups=x.shape[1])


def ssim_map(first: Tensor, second: Tensor) -> Tensor:
    """Structural similarity of (N, C, S, S) pictures in [0, 1] at every place (N, C, S-10, S-10)."""
    c1, c2 = 0.01**2, 0.03**2
    count = first.shape[1]
    both = torch.cat([first, second, first * first, second * second, first * second], dim=1)
    mean1, mean2, square1, square2, product = _smooth(both).split(count, dim=1)
    var1, var2 = square1 - mean1 * mean1, square2 - mean2 * mean2
    covariance = product - mean1 * mean2
    return ((2 * mean1 * mean2 + c1) * (2 * covariance + c2)) / (
        (mean1 * mean1 + mean2 * mean2 + c1) * (var1 + var2 + c2)
    )
