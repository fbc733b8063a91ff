"""Draw what training hides: masked tokens, corrupted digits, chunks that must be predicted (paper section 3).

B batch, T frames, h,w token grid, S = h*w.
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from hma_model.config import HMAConfig
from hma_model.network.draws import device_of, nearby, uniform
from hma_model.network.stem import from_digits, to_digits

HISTORY_FRAMES = 4  # of the shortest history that stays unmasked


@dataclass
class VideoMask:
    """The masked and corrupted tokens of the frames of a pass, which are T, or more with pairs.

    Attributes:
        masked: (B, T, S) bool, the tokens of the video loss; never those of frame 0.
        corruption: (B, T) float32, the probability that a digit of a visible token is replaced.
    """

    masked: Tensor
    corruption: Tensor


def draw_pairs_mask(
    config: HMAConfig,
    batch: int,
    frames: int,
    past: int,
    generator: torch.Generator | None,
    tokens: int | None = None,
) -> VideoMask:
    """Mask the copies of the frames from the second on, and corrupt the `past` frames before them.

    A copy is wholly masked with probability `whole_share`, else its tokens are masked with probability
    cos(u pi/2). The past is corrupted as by `draw_video_mask`, the copies' visible tokens never.
    """
    where = device_of(generator)
    corruption = draw_video_mask(config, batch, frames, generator).corruption[:, :past]
    whole = uniform((batch, frames - 1), generator, where) < config.whole_share
    ratio = torch.cos(uniform((batch, frames - 1), generator, where) * (math.pi / 2))
    ratio = torch.where(whole, 1.0, ratio).unsqueeze(-1)
    tokens = tokens or config.tokens_per_frame
    copies = uniform((batch, frames - 1, tokens), generator, where) < ratio
    masked = torch.cat([copies.new_zeros(batch, past, copies.shape[2]), copies], dim=1)
    return VideoMask(masked, F.pad(corruption, (0, frames - 1)))


def draw_video_mask(
    config: HMAConfig, batch: int, frames: int, generator: torch.Generator | None, drift: bool = True
) -> VideoMask:
    """Mask the tokens of each frame with probability cos(u pi/2), and corrupt a share of all tokens.

    With `history_probability` a sample keeps a history of at least HISTORY_FRAMES frames unmasked. With
    `drift`, each frame after it is corrupted more than the one before, as in a rollout of the model's own
    predictions. Each sample has its own draws.
    """
    tokens = config.tokens_per_frame
    where = device_of(generator)
    index = torch.arange(frames, device=where)
    draw = uniform((2, batch), generator, where)
    start = min(HISTORY_FRAMES, frames - 1)
    long = (draw[0] < config.history_probability) & (frames > 2)
    first = torch.where(long, start + (draw[1] * (frames - start)).long(), 1).unsqueeze(1)
    ratio = torch.cos(uniform((batch, frames), generator, where) * (math.pi / 2))
    masked = uniform((batch, frames, tokens), generator, where) < ratio.unsqueeze(-1)
    masked &= (index >= first).unsqueeze(-1)

    # As errors of a rollout add up: U(0.2, 1) of the digits are right, and a frame later U(0.9, 1) of those.
    right = 0.2 + 0.8 * uniform((batch, 1), generator, where)
    still_right = 0.9 + 0.1 * uniform((batch, frames), generator, where)
    after = (index >= first) & long.unsqueeze(1) & drift
    drifted = 1 - right * torch.where(after, still_right, 1.0).cumprod(1)
    base = config.corrupt_max * uniform((batch, 1), generator, where)
    corruption = torch.where(after, torch.maximum(drifted, base), base)
    return VideoMask(masked, corruption if config.corrupt_max else torch.zeros_like(corruption))


def corrupt_tokens(
    config: HMAConfig, tokens: Tensor, mask: VideoMask, generator: torch.Generator | None
) -> Tensor:
    """Replace digits of token ids (B, T, S) at random, and set masked ids to `mask_id`."""
    digits = to_digits(tokens, config.digits)
    if config.corrupt_max:
        values = torch.tensor(config.digits, device=tokens.device)
        generator = nearby(generator, tokens.device)
        random = (uniform(digits.shape, generator, tokens.device) * values).long()
        draw = uniform(digits.shape, generator, tokens.device)
        hit = draw < mask.corruption.to(tokens.device)[..., None, None]
        digits = torch.where(hit, torch.minimum(random, values - 1), digits)
    corrupted = from_digits(digits, config.digits)
    return corrupted.masked_fill(mask.masked.to(tokens.device), config.mask_id)


def drop_chunks(present: Tensor, generator: torch.Generator | None) -> Tensor:
    """Draw chunks to hide, (B, T) bool: each sample draws a rate U(0, 1) and hides at least one present."""
    draw = uniform(present.shape, generator, present.device)
    rate = uniform((present.shape[0], 1), generator, present.device)
    lowest = torch.where(present, draw, 2.0).argmin(1, keepdim=True)
    return (draw < rate).scatter(1, lowest, True)
