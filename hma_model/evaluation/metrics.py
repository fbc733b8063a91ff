"""Compute metrics of predicted images and tokens.

Image metrics are numpy on uint8 or float pictures; token metrics are torch on logits.

N images of (H, W, C); B batch, T frames, h,w token grid; F factored digits, V values a digit.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from torch import Tensor
from torch.nn.functional import cross_entropy

from hma_data.arrays import Floats
from hma_data.errors import UsageError
from hma_data.loading.dataset import Batch
from hma_model.evaluation.intervals import NATURAL, Episodes, ends_of, interval
from hma_model.network.conditioning import Groups, align
from hma_model.network.copying import known_digits
from hma_model.network.model import HMA
from hma_model.network.objectives import Layout
from hma_model.network.stem import to_digits

Values = NDArray[Any]
SSIM_WINDOW = 7
WHITE = 255.0  # the span of the values of images
PSNR_LIMIT = 60.0  # dB; where the PSNR of equal images, and with it a mean over frames, would be infinite
# what values can be, so that no interval of few episodes leaves it
PSNR_RANGE, PSNR_GAIN_RANGE = (0.0, PSNR_LIMIT), (-PSNR_LIMIT, PSNR_LIMIT)
SSIM_RANGE = (-1.0, 1.0)


def psnr(truth: Values, pictures: Values, limit: float = math.inf) -> Floats:
    """Return the peak signal-to-noise ratio of each image in dB.

    Args:
        truth: (…, H, W, C).
        pictures: as truth.
        limit: the ratio of equal images, which would be infinite.

    Returns:
        (…,).
    """
    _require_pair(truth, pictures)
    error = np.square(np.subtract(truth, pictures, dtype=np.float64)).mean(axis=(-3, -2, -1))
    with np.errstate(divide="ignore"):
        return np.minimum(10 * np.log10(WHITE**2 / error), limit)


def ssim(truth: Values, pictures: Values) -> Floats:
    """Return the structural similarity of each image (Wang et al. 2004), averaged over its channels.

    The settings are those of the paper's evaluation: a uniform 7x7 window, sample covariance, K1 0.01 and
    K2 0.03, and only windows inside the image.

    Args:
        truth: (…, H, W, C), each side at least 7.
        pictures: as truth.

    Returns:
        (…,), 1 if the two are equal.
    """
    _require_pair(truth, pictures)
    *lead, height, width, channels = truth.shape
    if min(height, width) < SSIM_WINDOW:
        raise UsageError("ssim", f"images of {height}x{width} are smaller than its 7x7 window")
    # one image after the other, so that the arrays of a pair fit a processor's cache
    flat = (values.reshape(-1, height, width, channels).astype(np.float64) for values in (truth, pictures))
    return np.array([_similarity(x, y) for x, y in zip(*flat)]).reshape(lead)


def _similarity(truth: Floats, picture: Floats) -> float:
    mean_x = _window_means(truth)
    mean_y = _window_means(picture)
    count = SSIM_WINDOW**2
    unbias = count / (count - 1)  # the paper's evaluation divides by the sample's degrees of freedom
    var_x = unbias * (_window_means(truth * truth) - mean_x * mean_x)
    var_y = unbias * (_window_means(picture * picture) - mean_y * mean_y)
    covariance = unbias * (_window_means(truth * picture) - mean_x * mean_y)
    c1 = (0.01 * WHITE) ** 2
    c2 = (0.03 * WHITE) ** 2
    above = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    below = (mean_x**2 + mean_y**2 + c1) * (var_x + var_y + c2)
    return float((above / below).mean())


def _window_means(values: Floats) -> Floats:
    """Return the mean over every 7x7 window inside (H, W, C)."""
    edge = SSIM_WINDOW // 2
    return uniform_filter(values, SSIM_WINDOW, axes=(0, 1))[edge:-edge, edge:-edge]


def _require_pair(truth: Values, pictures: Values) -> None:
    if truth.shape != pictures.shape or truth.ndim < 3:  # shapes that broadcast would give a wrong figure
        fault = f"the images must both be (…, H, W, C); they are {truth.shape} and {pictures.shape}"
        raise UsageError("metrics", fault)


def perplexity(nats: float) -> float:
    """Return exp of a cross-entropy in nats a token; infinity in place of an overflow."""
    return math.exp(nats) if nats < 700 else math.inf


def perplexity_summary(name: str, nats: Floats, seed: int, episodes: Episodes = None) -> dict[str, Any]:
    """Return exp of the mean of finite losses (N,) as `name`, with its interval."""
    known = np.isfinite(nats)
    if not known.any():
        return {name: None, f"{name}_95": None}
    own = None if episodes is None else np.asarray(episodes)[known]
    ends = [perplexity(float(end)) for end in interval(nats[known], seed, own, NATURAL)]
    return {name: perplexity(float(nats[known].mean())), f"{name}_95": ends_of(np.array(ends))}


def token_nats(logits: Tensor, tokens: Tensor, factored: Sequence[int]) -> Tensor:
    """Return the cross-entropy of each token in nats: the sum over its digits, without label smoothing.

    Args:
        logits: (..., F, V).
        tokens: (...) int64 ids.
        factored: values of each digit, low digit first.

    Returns:
        (...) float32.
    """
    digits = to_digits(tokens, factored)
    flat = cross_entropy(logits.flatten(0, -2).float(), digits.flatten().to(logits.device), reduction="none")
    return flat.view(digits.shape).sum(dim=-1)


def token_hits(logits: Tensor, tokens: Tensor, factored: Sequence[int]) -> Tensor:
    """Return (...) bool, True where every likeliest digit is the true one; arguments as in `token_nats`."""
    return (logits.argmax(dim=-1) == to_digits(tokens, factored).to(logits.device)).all(dim=-1)


@torch.no_grad()
def teacher_forced(model: HMA, batch: Batch) -> tuple[Tensor, Tensor]:
    """Score each frame from the second on, fully masked, given as much true past as a window holds.

    One pass scores a whole window: its input is the true frames, then each frame from the second on again,
    masked, at the same time. Each frame sees itself and the true frames before it.

    Args:
        model: a discrete model in eval mode.
        batch: a batch on the model's device.

    Returns:
        nats (B, T-1) float32 a token, averaged over the frame, and accuracy (B, T-1) of whole tokens.
    """
    config, held = model.config, model.config.frames
    first = _part(batch, slice(held))
    parts = [_scored(model, first, _at_once(model, first))]
    for t in range(held, batch.stored.shape[1]):  # the past of such a frame begins after the first frame
        own = _part(batch, slice(t + 1 - held, t + 1))
        seen = own.stored.clone()
        seen[:, -1] = config.vocab_size  # the mask's id
        logits = model.video_logits(seen, own.actions, own.embodiment, own.action_mask, own.stored)
        parts.append(_scored(model, own, logits[:, -1:]))
    nats, hits = (torch.cat(part, dim=1) for part in zip(*parts, strict=True))
    return nats, hits


@torch.no_grad()
def masked_scores(
    model: HMA, batch: Batch, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Score the tokens that training would mask, among its masks and replaced digits (paper section 3).

    Args:
        model: a discrete model in eval mode, which predicts video from actions.
        batch: a batch on the model's device; of longer windows the first frames that the model holds.
        generator: of the masks and the replaced digits.

    Returns:
        nats (B,) float32 a masked token, without label smoothing, and accuracy (B,) of whole tokens; NaN for
        a window without a masked token.
    """
    batch, config = _part(batch, slice(model.config.frames)), model.config
    output = model(batch, "forward", generator)
    true = model.frame_values(batch.stored).unflatten(2, config.token_grid)
    masked = output.masked.flatten(1)
    counts = masked.sum(dim=1)
    scores = (rule(output.video_logits, true, config.digits) for rule in (token_nats, token_hits))
    nats, hits = ((score.flatten(1) * masked).sum(dim=1) / counts for score in scores)
    return nats, hits


def _at_once(model: HMA, batch: Batch) -> Tensor:
    """Return scores (B, T-1, h, w, F, V) of the masked frames, computed in one pass."""
    config, frames = model.config, model.frame_values(batch.stored)
    count, groups = frames.shape[1], Groups.of(batch.embodiment, len(frames))
    layout = Layout.pairs(model, count, past=count)
    given = align(config, batch.actions, batch.action_mask, count).frames(layout.frames)
    masked = torch.full_like(frames[:, 1:], config.mask_id)
    x = model.embed(groups.sort(torch.cat([frames, masked], dim=1)), previous=layout.previous)
    features = model.trunk(x, model.condition(given, groups, layout.times.positions), layout.times)
    true = to_digits(groups.sort(frames[:, 1:]), config.digits)
    before = known_digits(groups.sort(frames[:, :-1]), config)
    scores = model.token_readout(model.video_features(features)[:, count:], true, before)
    return groups.unsort(model.token_readout.split(scores)).unflatten(2, config.token_grid)


def _part(batch: Batch, frames: slice) -> Batch:
    known = batch.action_mask[:, frames]
    return replace(batch, tokens=batch.stored[:, frames], actions=batch.actions[:, frames], action_mask=known)


def _scored(model: HMA, batch: Batch, logits: Tensor) -> tuple[Tensor, Tensor]:
    """Score the last frames of a batch, as many as `logits` has."""
    config, last = model.config, batch.stored[:, -logits.shape[1] :]
    true = model.frame_values(last).unflatten(2, config.token_grid)
    nats = token_nats(logits, true, config.digits).mean(dim=(2, 3))
    return nats, token_hits(logits, true, config.digits).float().mean(dim=(2, 3))
