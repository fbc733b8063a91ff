"""Draw what is hidden and corrupted in training, and compute how many tokens stay masked in decoding.

Every draw uses the given generator, on the generator's device, so that a run can be repeated exactly.

B batch, T frames, S tokens of a frame, F digits.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from hma_model.config import HMAConfig
from hma_model.network.embed import from_digits, to_digits


def uniform(
    shape: Sequence[int], generator: torch.Generator | None, device: torch.device | str = "cpu"
) -> Tensor:
    """Return float32 numbers in [0, 1), drawn on the generator's device and moved to `device`."""
    return torch.rand(tuple(shape), generator=generator, device=device_of(generator)).to(device)


def randn(
    shape: Sequence[int], generator: torch.Generator | None, device: torch.device | str = "cpu"
) -> Tensor:
    """Return standard normal float32 numbers, drawn on the generator's device and moved to `device`."""
    return torch.randn(tuple(shape), generator=generator, device=device_of(generator)).to(device)


def device_of(generator: torch.Generator | None) -> torch.device | str:
    """Return the device on which a generator draws; without one, torch draws on the CPU."""
    return "cpu" if generator is None else generator.device


@dataclass
class VideoMask:
    """The masked and corrupted tokens of windows.

    Attributes:
        masked: (B, T, S) bool, the tokens of the video loss; never those of frame 0.
        corruption: (B, T) float32, the probability that a digit of a visible token is replaced.
    """

    masked: Tensor
    corruption: Tensor


def draw_video_mask(
    config: HMAConfig, batch: int, frames: int, generator: torch.Generator | None
) -> VideoMask:
    """Mask the tokens of each frame with probability cos(u pi/2), and corrupt a share of all tokens.

    With `history_probability` a sample keeps a history of at least `history_frames` frames unmasked, and each
    frame after it is corrupted more than the one before, as in a rollout of the model's own predictions.
    Each sample has its own draws.
    """
    tokens = config.tokens_per_frame
    where = device_of(generator)
    index = torch.arange(frames, device=where)
    first, long = _first_masked(config, batch, frames, generator)
    ratio = torch.cos(uniform((batch, frames), generator, where) * (math.pi / 2))
    ratio = ratio.clamp(min=config.mask_ratio_min)
    masked = uniform((batch, frames, tokens), generator, where) < ratio.unsqueeze(-1)
    masked &= (index >= first.unsqueeze(1)).unsqueeze(-1)

    kept = 0.2 + 0.8 * uniform((batch, 1), generator, where)
    shrink = 0.9 + 0.1 * uniform((batch, frames), generator, where)
    after = (index >= first.unsqueeze(1)) & long.unsqueeze(1)
    drift = 1 - kept * torch.where(after, shrink, 1.0).cumprod(1)
    base = config.corrupt_max * uniform((batch, 1), generator, where)
    corruption = torch.where(after, torch.maximum(drift, base), base)
    return VideoMask(masked, corruption if config.corrupt_max else torch.zeros_like(corruption))


def _first_masked(
    config: HMAConfig, batch: int, frames: int, generator: torch.Generator | None
) -> tuple[Tensor, Tensor]:
    """Return (B,) the first frame that may be masked, and (B,) whether a sample keeps a long history."""
    draw = uniform((2, batch), generator, device_of(generator))
    start = min(config.history_frames, frames - 1)
    long = (draw[0] < config.history_probability) & (frames > 2)
    first = start + (draw[1] * (frames - start)).long()
    return torch.where(long, first, 1), long


def corrupt_tokens(
    config: HMAConfig, tokens: Tensor, mask: VideoMask, generator: torch.Generator | None
) -> Tensor:
    """Replace digits of token ids (B, T, S) at random, and set masked ids to the vocabulary's size."""
    digits = to_digits(tokens, config.factored)
    if config.corrupt_max:
        values = torch.tensor(config.factored, device=tokens.device)
        random = (uniform(digits.shape, generator, tokens.device) * values).long()
        draw = uniform(digits.shape, generator, tokens.device)
        hit = draw < mask.corruption.to(tokens.device)[..., None, None]
        digits = torch.where(hit, torch.minimum(random, values - 1), digits)
    corrupted = from_digits(digits, config.factored)
    return corrupted.masked_fill(mask.masked.to(tokens.device), config.vocab_size)


def drop_chunks(present: Tensor, generator: torch.Generator | None) -> Tensor:
    """Draw chunks to hide, (B, T) bool: each sample draws a rate U(0, 1) and hides at least one present."""
    draw = uniform(present.shape, generator, present.device)
    rate = uniform((present.shape[0], 1), generator, present.device)
    lowest = torch.where(present, draw, 2.0).argmin(1, keepdim=True)
    return (draw < rate).scatter(1, lowest, True)


def masked_after(step: int, steps: int, tokens: int) -> int:
    """Return how many tokens of a frame stay masked after step `step` of `steps` (cosine schedule)."""
    if step + 1 >= steps:
        return 0
    return min(math.ceil(math.cos((step + 1) / steps * math.pi / 2) * tokens), tokens - 1)
