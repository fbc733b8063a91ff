"""Define the convolutional U-Net that all embodiments share: a frame is masked and predicted as a whole.

In the paper's terms this is masked autoregression with all tokens of the next frame masked at once. A frame's
tokens lie on their full grid. Each frame of a pass sees the frames before it at the same place, the newest
first, and spreads what it sees by convolutions at several resolutions; every convolution is modulated by the
actions. Nothing is computed of past frames but their embedding, so a rollout carries only embeddings
(`Embeddings`).

B batch, T frames, S = h*w tokens of a frame, D width, A ages (the frame itself and the frames before it),
R slots of a row, E width of the conditioning.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from hma_model.config import HMAConfig
from hma_model.network.stem import LatentEmbedding, NoiseEmbedding
from hma_model.network.trunks.contract import Conditioning, TimePositions

CONDITIONING = 192  # E


@dataclass(frozen=True)
class Embeddings:
    """The embeddings of past frames and of their actions, which a rollout carries (`contract.Carried`).

    Attributes:
        frames: (R, rows, S, D).
        actions: (R, rows, D).
    """

    frames: Tensor
    actions: Tensor

    @property
    def tokens(self) -> int:
        """Return S."""
        return self.frames.shape[2]

    def fits(self, slots: int, tokens: int, dtype: torch.dtype, device: torch.device) -> bool:
        """Check whether this is for so many slots a row and tokens a frame."""
        kept = self.frames
        return (kept.shape[0], kept.shape[2], kept.dtype, kept.device) == (slots, tokens, dtype, device)

    def take(self, rows: Tensor) -> "Embeddings":
        """Return a copy of some rows."""
        return Embeddings(self.frames[:, rows], self.actions[:, rows])

    def put(self, rows: Tensor, other: "Embeddings") -> None:
        """Replace rows by all rows of another one."""
        slots = len(other.frames)
        self.frames[:slots, rows], self.actions[:slots, rows] = other.frames, other.actions

    def tensors(self) -> list[Tensor]:
        """Return its memory, which a pass writes in place."""
        return [self.frames, self.actions]


class ChannelNorm(nn.LayerNorm):
    """A LayerNorm over the channels of each place: no place depends on what lies far from it.

    Statistics over the whole frame (GroupNorm) let an error anywhere change everything; a rollout of such a
    network drifts several times as fast.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Normalise (M, C, h, w)."""
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class Block(nn.Module):
    """Two modulated 3×3 convolutions with a residual connection; it begins as the identity."""

    def __init__(self, before: int, after: int) -> None:
        super().__init__()
        self.norm1, self.conv1 = ChannelNorm(before), nn.Conv2d(before, after, 3, padding=1)
        self.norm2, self.conv2 = ChannelNorm(after), nn.Conv2d(after, after, 3, padding=1)
        self.modulation = nn.Linear(CONDITIONING, 2 * after)
        self.skip = nn.Conv2d(before, after, 1) if before != after else nn.Identity()
        nn.init.zeros_(self.conv2.weight)
        if self.conv2.bias is not None:
            nn.init.zeros_(self.conv2.bias)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """Apply the block to (M, C, h, w) under conditions (M, E)."""
        gain, shift = self.modulation(condition)[..., None, None].chunk(2, dim=1)
        hidden = self.conv1(F.silu(self.norm1(x)))
        hidden = self.conv2(F.silu(torch.addcmul(shift, self.norm2(hidden), 1 + gain)))
        return self.skip(x) + hidden


class UNet(nn.Module):
    """The U-Net: embedding, ages, blocks down and up; it satisfies `contract.Trunk`."""

    def __init__(self, config: HMAConfig) -> None:
        super().__init__()
        self.config = config
        self.checkpointing = False
        self.modulation = None  # the blocks have their own
        width, ages, views = config.width, config.frames, config.views
        self.embed = LatentEmbedding(config)
        self.noise = NoiseEmbedding(config) if config.told_noise else None
        self.absent = nn.Parameter(torch.randn(1, width) * 0.02)
        self.unseen = nn.Parameter(torch.zeros(ages, width))  # added where an age repeats the oldest frame
        levels = config.levels
        self.ages = nn.Linear(ages * width * views, levels[0])
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
        self.norm = ChannelNorm(levels[0])
        self.output = nn.Conv2d(levels[0], views * width, 3, padding=1)

    def embed_frames(
        self, frames: Tensor, masked: Tensor | None, previous: Sequence[int], corruption: Tensor | None
    ) -> Tensor:
        """Embed frames, as `Trunk.embed_frames` says."""
        assert masked is not None
        x: Tensor = self.embed(frames, masked, previous)
        return x if corruption is None or self.noise is None else x + self.noise(corruption)

    def carry(
        self, rows: int, slots: int, tokens: int, dtype: torch.dtype, device: torch.device
    ) -> Embeddings:
        """Return the memory for the embeddings of past frames."""
        frames = torch.zeros(slots, rows, tokens, self.config.width, dtype=dtype, device=device)
        return Embeddings(frames, torch.zeros_like(frames[:, :, 0]))

    def forward(
        self, x: Tensor, conditioning: Conditioning, times: TimePositions, carried: Embeddings | None = None
    ) -> Tensor:
        """Map embedded frames to features, as `Trunk.__call__` says; those before `wanted` are zeros."""
        actions = conditioning.embedding
        if actions is None:
            actions = self.absent.expand(*x.shape[:2], -1)
        if carried is None:
            frames, of_actions, index, seen = *self._flat(x, actions), *self._of_window(times, len(x))
        else:
            frames, of_actions = carried.frames.flatten(0, 1), carried.actions.flatten(0, 1)
            assert times.slots is not None
            slots = times.slots.flatten()
            frames.index_copy_(0, slots, x.flatten(0, 1).to(frames.dtype))
            of_actions.index_copy_(0, slots, actions.flatten(0, 1).to(of_actions.dtype))
            index, seen = self._of_slots(times, carried)
        index, seen = index[:, times.wanted :], seen[:, times.wanted :]
        if not index.shape[1]:
            return torch.zeros_like(x)
        b, t = index.shape[:2]
        if torch.is_autocast_enabled(x.device.type):  # else the products alone would be in less precision
            frames = frames.to(torch.get_autocast_dtype(x.device.type))
        unseen = (self.unseen * ~seen.unsqueeze(-1)).to(frames.dtype)  # (B or 1, t, A, D)
        stacked = frames[index].add(unseen.unsqueeze(3)).flatten(0, 1)  # (M, A, S, D)
        condition = self.condition(of_actions[index].flatten(2).flatten(0, 1))
        features = self._spread(stacked, condition).unflatten(0, (b, t))
        if not times.wanted:
            return features
        return torch.cat([features.new_zeros(b, times.wanted, *features.shape[2:]), features], dim=1)

    def _flat(self, x: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        return x.flatten(0, 1), actions.flatten(0, 1)

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

    def _of_slots(self, times: TimePositions, carried: Embeddings) -> tuple[Tensor, Tensor]:
        """Return as `_of_window` the indices among the slots of all rows, one slot after the other."""
        assert times.slots is not None
        ages = torch.arange(self.config.frames, device=times.positions.device)
        slots, rows = carried.frames.shape[:2]
        positions = times.positions.unsqueeze(-1)  # (B, T, 1)
        seen = ages <= positions
        held = positions - torch.minimum(ages, positions)
        return held % slots * rows + times.slots.unsqueeze(-1) % rows, seen

    def _spread(self, stacked: Tensor, condition: Tensor) -> Tensor:
        """Return features (M, S, D) of the frames (M, A, S, D) that each frame sees."""
        views = self.config.views
        seen = stacked.unflatten(2, (views, -1)).permute(0, 3, 1, 2, 4).flatten(2)  # (M, h*w, A * views * D)
        x = self.ages(seen).transpose(1, 2).unflatten(2, self.grid)
        x = x + self.position.to(x.dtype)
        layers, kept = self.config.layers, []
        for level in range(self.depth + 1):
            for block in self.blocks[level * layers : (level + 1) * layers]:
                x = self._run(block, x, condition)
            if level < self.depth:
                kept.append(x)
                x = self.shrink[level](x)
        first = (self.depth + 1) * layers
        for level in reversed(range(self.depth)):
            x = F.interpolate(self.grow[level](x), scale_factor=2.0, mode="nearest")
            x = torch.cat([x, kept[level]], dim=1)
            for block in self.blocks[first + level * layers : first + (level + 1) * layers]:
                x = self._run(block, x, condition)
        x = self.output(F.silu(self.norm(x)))
        return x.unflatten(1, (views, -1)).flatten(3).transpose(2, 3).flatten(1, 2)

    def _run(self, block: nn.Module, x: Tensor, condition: Tensor) -> Tensor:
        if self.checkpointing and self.training and torch.is_grad_enabled():
            return checkpoint(block, x, condition, use_reentrant=False)
        return block(x, condition)
