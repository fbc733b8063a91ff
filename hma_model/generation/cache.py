"""Keep the keys and values of past frames during a rollout.

Attention over time is causal, so the keys and values of a past frame never change: only new frames need to be
computed. A frame at time t lies in slot t mod R. With rotary positions the length of a rollout has no limit.
There is then one slot more than the window has frames, for the pass that computes a finished frame and the
next one together.

B batch, N tokens of a frame with its action tokens, L layers, R slots, n frames of a pass.
"""

import torch
from torch import Tensor

from hma_model.config import HMAConfig
from hma_model.network.trunk import Clock, LayerCache, rotary_angles

_NEVER = -(1 << 40)


class Cache:
    """The keys and values of every layer, and the time of the frame in each slot.

    Args:
        config: of the model.
        batch: B.
        tokens: N.
        like: a tensor whose device and dtype the keys and values get.
    """

    def __init__(self, config: HMAConfig, batch: int, tokens: int, like: Tensor) -> None:
        self.config = config
        self.slots = config.frames + (config.time_position == "rotary")
        heads = (config.heads, config.head_dim)
        crossed = "cross_attention" in config.conditioning
        self.layers = [
            LayerCache(
                like.new_zeros(2, self.slots, batch, tokens, *heads),
                like.new_zeros(2, batch, heads[0], self.slots, heads[1]) if crossed else None,
            )
            for _ in range(config.layers)
        ]
        self.times = torch.full((self.slots,), _NEVER, device=like.device)

    def clear(self) -> None:
        """Forget every frame."""
        self.times.fill_(_NEVER)

    def hold_still(self) -> None:
        """Mark the addresses of keys and values as static, so that a compiler may write them in place."""
        for layer in self.layers:
            for kept in (layer.time, layer.action):
                if kept is not None:
                    torch._dynamo.mark_static_address(kept)

    def clock(self, start: int, frames: int) -> Clock:
        """Return the clock of a pass over n consecutive frames, and record their times in their slots."""
        device = self.times.device
        positions = torch.arange(start, start + frames, device=device)
        slots = positions % self.slots
        self.times.index_copy_(0, slots, positions)
        age = positions.unsqueeze(1) - self.times
        allowed = (age >= 0) & (age < self.config.frames)
        return Clock(positions, allowed, rotary_angles(self.config, positions), slots=slots)
