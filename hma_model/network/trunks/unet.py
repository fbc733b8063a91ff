"""Define the convolutional U-Net that all embodiments share: a frame is masked and predicted as a whole.

In the paper's terms this is masked autoregression with all tokens of the next frame masked at once. A frame's
tokens lie on their full grid. Each frame of a pass sees the frames before it at the same place, the newest
first, and spreads what it sees by convolutions at several resolutions; every convolution is modulated by the
actions. Nothing is computed of past frames but their embedding, so a rollout carries only embeddings.

B batch, T frames, S = h*w tokens of a frame, D width, A ages (the frame itself and the frames before it),
R slots of a row, E width of the conditioning.
"""

import math
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hma_model.config import HMAConfig
from hma_model.network.trunks.contract import BlockTrunk, Carried, Conditioning, TimePositions

CONDITIONING = 192  # E


def convolve(conv: nn.Module, x: Tensor) -> Tensor:
    """Apply a convolution to places with their channels last, (M, h, w, C)."""
    made: Tensor = conv(x.permute(0, 3, 1, 2))
    return made.permute(0, 2, 3, 1)


class Block(nn.Module):
    """Two modulated 3×3 convolutions with a residual connection; it begins as the identity.

    The norms are over the channels of each place, so that no place depends on what lies far from it.
    Statistics over the whole frame (GroupNorm) let an error anywhere change everything; a rollout of such a
    network drifts several times as fast.
    """

    def __init__(self, before: int, after: int) -> None:
        super().__init__()
        self.norm1, self.conv1 = nn.LayerNorm(before), nn.Conv2d(before, after, 3, padding=1)
        self.norm2, self.conv2 = nn.LayerNorm(after), nn.Conv2d(after, after, 3, padding=1)
        self.modulation = nn.Linear(CONDITIONING, 2 * after)
        self.skip = nn.Conv2d(before, after, 1) if before != after else None
        nn.init.zeros_(self.conv2.weight)
        if self.conv2.bias is not None:
            nn.init.zeros_(self.conv2.bias)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """Apply the block to (M, h, w, C) under conditions (M, E)."""
        gain, shift = self.modulation(condition).to(x.dtype)[:, None, None].chunk(2, dim=-1)
        hidden = convolve(self.conv1, F.silu(self.norm1(x)))
        hidden = convolve(self.conv2, F.silu(torch.addcmul(shift, self.norm2(hidden), 1 + gain)))
        return hidden + (x if self.skip is None else convolve(self.skip, x))


class Ages(nn.Module):
    """A linear map of what each place has seen, the newest first; frames are picked out one age at a time."""

    def __init__(self, config: HMAConfig, channels: int) -> None:
        super().__init__()
        self.shape = config.frames, config.views, config.width
        start = nn.Linear(math.prod(self.shape), channels)
        self.weight, self.bias = start.weight, start.bias

    def forward(self, frames: Tensor, index: Tensor, unseen: Tensor) -> Tensor:
        """Map frames (N, views * S, D), of which each sees those numbered `index` (M, A), to (M, S, C).

        `unseen` (M, A, D) is added to the frame of each age.
        """
        ages, views, _ = self.shape
        maps = self.weight.unflatten(1, self.shape)  # (C, A, views, D)
        offset = self.bias + torch.einsum("mad,cavd->mc", unseen, maps)
        x = offset.to(frames.dtype).unsqueeze(1)
        joined = frames.unflatten(1, (views, -1)).transpose(1, 2).flatten(2)  # (N, S, views * D)
        for age in range(ages):
            weight = maps[:, age].flatten(1).to(frames.dtype)
            x = x + F.linear(joined.index_select(0, index[:, age]), weight)
        return x


class UNet(BlockTrunk):
    """The U-Net: embedding, ages, blocks down and up; it satisfies `contract.Trunk`."""

    def __init__(self, config: HMAConfig) -> None:
        super().__init__(config)
        self.modulation = None  # the blocks have their own
        width, ages, views = config.width, config.frames, config.views
        self.absent = nn.Parameter(torch.randn(1, width) * 0.02)
        self.unseen = nn.Parameter(torch.zeros(ages, width))  # added where an age repeats the oldest frame
        levels = config.levels
        self.ages = Ages(config, levels[0])
        height, across = config.token_grid
        self.grid = height // views, across
        self.position = nn.Parameter(torch.randn(levels[0], *self.grid) * 0.02)
        self.condition = nn.Sequential(
            nn.Linear(ages * width, CONDITIONING), nn.SiLU(), nn.Linear(CONDITIONING, CONDITIONING), nn.SiLU()
        )
        down, up = [], []
        for own in levels:
            down += [Block(own, own) for _ in range(config.layers)]
            up += [Block(own if i else 2 * own, own) for i in range(config.layers)]
        self.depth = len(levels) - 1
        self.blocks = nn.ModuleList([*down, *up[: self.depth * config.layers]])
        pairs = list(pairwise(levels))
        self.shrink = nn.ModuleList(nn.Conv2d(fine, coarse, 3, stride=2, padding=1) for fine, coarse in pairs)
        self.grow = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in pairs)
        self.norm = nn.LayerNorm(levels[0])
        self.output = nn.Conv2d(levels[0], views * width, 3, padding=1)

    def carry(self, rows: int, slots: int, tokens: int, dtype: torch.dtype, device: torch.device) -> Carried:
        """Return the embeddings of past frames (R, rows, S, D) and of their actions (R, rows, D)."""
        frames = torch.zeros(slots, rows, tokens, self.config.width, dtype=dtype, device=device)
        return Carried([frames, torch.zeros_like(frames[:, :, 0])], 0, tokens)

    def forward(
        self, x: Tensor, conditioning: Conditioning, times: TimePositions, carried: Carried | None = None
    ) -> Tensor:
        """Map embedded frames to features, as `Trunk.__call__` says; those before `wanted` are zeros."""
        actions = conditioning.embedding
        if actions is None:
            actions = self.absent.expand(*x.shape[:2], -1)
        if carried is None:
            frames, of_actions = x.flatten(0, 1), actions.flatten(0, 1)
            index, seen = self._of_window(times, len(x))
        else:
            frames, of_actions = (kept.flatten(0, 1) for kept in carried.memory)
            assert times.slots is not None
            slots = times.slots.flatten()
            frames.index_copy_(0, slots, x.flatten(0, 1).to(frames.dtype))
            of_actions.index_copy_(0, slots, actions.flatten(0, 1).to(of_actions.dtype))
            index, seen = self._of_slots(times, carried)
        index, seen = index[:, times.wanted :], seen[:, times.wanted :]
        if not index.shape[1]:
            return torch.zeros_like(x)
        b, t = index.shape[:2]
        condition = self.condition(self._seen_actions(of_actions, index).flatten(2).flatten(0, 1))
        if torch.is_autocast_enabled(x.device.type):  # else the products alone would be in less precision
            frames = frames.to(torch.get_autocast_dtype(x.device.type))
        unseen = (self.unseen * ~seen.unsqueeze(-1)).expand(b, -1, -1, -1).flatten(0, 1)
        position, grid = self.position.flatten(1).t(), self.grid
        if times.places is not None:
            side = math.isqrt(times.places.shape[1])
            position, grid = position[times.places].repeat_interleave(t, 0), (side, side)
        x = self.ages(frames, index.flatten(0, 1), unseen) + position.to(frames.dtype)
        features = self._spread(x.unflatten(1, grid), condition).unflatten(0, (b, t))
        if not times.wanted:
            return features
        return torch.cat([features.new_zeros(b, times.wanted, *features.shape[2:]), features], dim=1)

    def _seen_actions(self, actions: Tensor, index: Tensor) -> Tensor:
        """Return the actions (B, T, A, D) that led to the frames numbered `index` (B, T, A), from (N, D).

        What led to the oldest frame is not seen: in training it is the window's first, and nothing leads
        there. A rollout knows it, and would show the network what it was never trained on.
        """
        if self.config.action_alignment != "previous":
            return actions[index]
        recent = actions[index[..., :-1]]
        return torch.cat([recent, self.absent.to(recent.dtype).expand_as(recent[:, :, :1])], dim=2)

    def _of_window(self, times: TimePositions, batch: int) -> tuple[Tensor, Tensor]:
        """Return for each frame of a window and age the index (B, T, A) of its frame, and whether it is seen.

        The frames of all samples lie one after the other. An age that is not seen repeats the oldest frame.
        """
        ages = torch.arange(self.config.frames, device=times.positions.device)
        behind = times.positions.unsqueeze(1) - times.positions  # (T, keys)
        match = times.allowed.unsqueeze(1) & (behind.unsqueeze(1) == ages.unsqueeze(1))
        own = torch.eye(len(times.positions), dtype=torch.bool, device=ages.device)
        match[:, 0] &= own  # the copy of a frame has its time, but is another frame
        seen = match.any(-1)
        oldest = seen.long().cumprod(-1).sum(-1, keepdim=True) - 1
        index = match.long().argmax(-1).gather(1, torch.minimum(ages, oldest))
        begin = torch.arange(batch, device=ages.device).view(-1, 1, 1) * len(times.positions)
        return begin + index, seen.unsqueeze(0)

    def _of_slots(self, times: TimePositions, carried: Carried) -> tuple[Tensor, Tensor]:
        """Return as `_of_window` the indices among the slots of all rows, one slot after the other."""
        assert times.slots is not None
        ages = torch.arange(self.config.frames, device=times.positions.device)
        slots, rows = carried.memory[0].shape[:2]
        positions = times.positions.unsqueeze(-1)  # (B, T, 1)
        seen = ages <= positions
        held = positions - torch.minimum(ages, positions)
        return held % slots * rows + times.slots.unsqueeze(-1) % rows, seen

    def _spread(self, x: Tensor, condition: Tensor) -> Tensor:
        """Return features (M, S, D) of frames (M, h, w, C) under conditions (M, E)."""
        layers, kept = self.config.layers, []
        for level in range(self.depth + 1):
            for block in self.blocks[level * layers : (level + 1) * layers]:
                x = self.run_block(block, x, condition)
            if level < self.depth:
                kept.append(x)
                x = convolve(self.shrink[level], x)
        first = (self.depth + 1) * layers
        for level in reversed(range(self.depth)):
            x = convolve(self.grow[level], x).repeat_interleave(2, 1).repeat_interleave(2, 2)
            x = torch.cat([x, kept[level]], dim=-1)
            for block in self.blocks[first + level * layers : first + (level + 1) * layers]:
                x = self.run_block(block, x, condition)
        x = convolve(self.output, F.silu(self.norm(x)))
        return x.unflatten(-1, (self.config.views, -1)).permute(0, 3, 1, 2, 4).flatten(1, 3)
