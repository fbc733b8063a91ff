"""Let a readout copy the frame before (a copy mechanism as in arXiv 1603.06393).

Most of a picture stays from one frame to the next. To keep a token, a readout must spell out all its digits
from the features; here the features only say how likely it stays. The score of each digit that the frame
before has at the same place gains a number that depends on the features, and on whether an earlier digit of
the place already differs from the frame before. Of latents, the features say the share of each value that
stays.

B batch, k places, S places of a frame, F digits of a place, V values of one, C values of a patch, D width.
"""

from collections.abc import Callable
from itertools import accumulate

import torch
from torch import Tensor, nn

from hma_model.config import HMAConfig
from hma_model.network.linear import Linear
from hma_model.network.stem import to_digits

# Nothing before a digit differs; only other tokens of its square do; its own token does.
STATES = 3
START_LOGIT = 2.0  # a patch's shares begin at the sigmoid of this, 0.88; begun at 0 they learn less
SCALE = 4.0  # of the features: gains grow as fast as scores at a learning rate of small steps


def known_digits(frames: Tensor, config: HMAConfig) -> Tensor:
    """Return the digits (..., F) int64 of ids (...), -1 where an id is masked."""
    masked = frames == config.mask_id
    digits = to_digits(frames.masked_fill(masked, 0), config.digits)
    return digits.masked_fill(masked.unsqueeze(-1), -1)


def frames_before(frames: Tensor, previous: list[int], config: HMAConfig) -> Tensor | None:
    """Return digits (B, T, S, F) of frames (B, N, S) at `previous` (T,), or -1; None if none is copied."""
    if not config.copy_previous:
        return None
    masked = torch.full_like(frames[:, :1], config.mask_id)
    return known_digits(torch.cat([frames, masked], dim=1)[:, previous], config)  # the last one is masked


class CopyGain(nn.Module):
    """The gain of the score of the digit that the frame before has at the same place.

    The gains begin at zero, so that the module can be added to a trained readout.
    """

    starts: Tensor

    def __init__(self, config: HMAConfig) -> None:
        super().__init__()
        self.digits = len(config.digits)
        self.multiplier = SCALE * config.readout_scale
        self.token_digits = self.digits // config.merge**2
        self.linear = Linear(config.width, self.digits * STATES)
        nn.init.zeros_(self.linear.weight)
        nn.init.zeros_(self.linear.bias)
        starts = torch.tensor([0, *accumulate(config.digits[:-1])])
        self.register_buffer("starts", starts, persistent=False)

    def gains(self, features: Tensor, before: Tensor) -> Tensor:
        """Return the gains (..., F, STATES) of features (..., D); 0 where `before` (..., F) is -1."""
        gains = self.linear(features * self.multiplier).float().unflatten(-1, (self.digits, STATES))
        return gains * (before >= 0).unsqueeze(-1)

    def forward(self, scores: Tensor, features: Tensor, digits: Tensor | None, before: Tensor) -> Tensor:
        """Return the scores (..., sum of V) with the gains of features (..., D).

        Args:
            digits: (..., F) the true digits; None if the digits do not depend on one another.
            before: (..., F) those of the frame before, or -1.
        """
        gains = self.gains(features, before)
        if digits is None:
            gained = gains[..., 0]
        else:
            gained = gains.gather(-1, self._states(digits != before).unsqueeze(-1)).squeeze(-1)
        return scores.scatter_add(-1, self.starts + before.clamp(min=0), gained)

    def _states(self, differs: Tensor) -> Tensor:
        """Return the state (..., F) of each digit, 0 to 2, from which digits differ, (..., F) bool."""
        parts = differs.long().unflatten(-1, (-1, self.token_digits))
        in_token = (parts.cumsum(-1) - parts > 0).flatten(-2)
        in_square = differs.long().cumsum(-1) - differs.long() > 0
        return in_square.long() + in_token.long()


class Copying:
    """The copying of digits that are chosen one after the other, or all at once.

    Args:
        gain: the module.
        features: (B, k, D).
        before: (B, k, F) digits of the frame before, or -1.
    """

    def __init__(self, gain: CopyGain, features: Tensor, before: Tensor) -> None:
        self.token_digits = gain.token_digits
        self.gains, self.before = gain.gains(features, before), before
        self.in_square = self.in_token = torch.zeros_like(before[..., 0])

    def chosen(self, choose: Callable[[Tensor, int], Tensor], scores: Tensor, first: int) -> Tensor:
        """Choose digits (B, f, k) from the scores (B, f, k, V) of the digits from `first` on, and gains."""
        count = scores.shape[1]
        if first % self.token_digits == 0:
            self.in_token = torch.zeros_like(self.in_token)
        state = (self.in_square + self.in_token)[..., None, None].expand(-1, -1, count, 1)
        gains = self.gains[:, :, first : first + count].gather(-1, state).transpose(1, 2)
        before = self.before[:, :, first : first + count].transpose(1, 2)
        digits = choose(scores.scatter_add(-1, before.clamp(min=0).unsqueeze(-1), gains), first)
        differs = (digits != before).any(1).long()
        self.in_square, self.in_token = self.in_square | differs, self.in_token | differs
        return digits


class PatchCopy(nn.Module):
    """What a patch of latents keeps of the frame before: of each value a share that the features say."""

    def __init__(self, config: HMAConfig) -> None:
        super().__init__()
        self.multiplier = SCALE * config.readout_scale
        self.linear = Linear(config.width, config.patch_dim)
        nn.init.zeros_(self.linear.weight)
        nn.init.constant_(self.linear.bias, START_LOGIT)

    def forward(self, features: Tensor, before: Tensor) -> Tensor:
        """Return what is kept (..., C) float32 of patches (..., C), from features (..., D)."""
        return self.linear(features * self.multiplier).float().sigmoid() * before
