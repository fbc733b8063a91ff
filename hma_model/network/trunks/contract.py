"""State what a trunk takes and gives, so that models, training and rollouts work with any trunk.

A trunk embeds the frames of a pass. From these, their times, and an embedding of the action chunk in force at
each frame it computes features, which the readouts of `hma_model.network.head` turn into tokens, latents or
actions. In a rollout it also carries what it needs of past frames. To add a trunk, write a module here with a
class that satisfies `Trunk`, and name it in `TRUNKS` of `hma_model.network.network` and in
`HMAConfig.trunk`.

B batch, T frames of a pass, S tokens of a frame, N = S + action tokens, D width, L layers, R slots of a row.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from hma_model.config import HMAConfig
from hma_model.network.rotary import rotary_angles
from hma_model.network.stem import LatentEmbedding, NoiseEmbedding, TokenEmbedding


@dataclass
class Conditioning:
    """The conditioning of the trunk by actions.

    Attributes:
        embedding: (B, T, D), the embedding of the chunk at each frame; None without conditioning.
        tokens: (B, T, D), the action tokens after the tokens of each frame; None for no tokens.
        modulation: (L, B, T, 2D) shift and gain.
        out: for each group of samples, in batch order: its size and the embodiment's projections after the
            modulated norm, (L, D, D) and (L, D). None if the trunk has them.
        order: indices (B,) that sort the samples into the groups of `out`, and that undo it; None if they are
            sorted.
    """

    embedding: Tensor | None = None
    modulation: Tensor | None = None
    out: list[tuple[int, Tensor, Tensor]] | None = None
    tokens: Tensor | None = None
    order: tuple[Tensor, Tensor] | None = None

    def last(self) -> "Conditioning":
        """Return the conditioning of the last frame alone."""

        def newest(values: Tensor | None, axis: int) -> Tensor | None:
            # In memory of its own: compiled code checks strides, and a view would have those of T frames.
            return None if values is None else values.narrow(axis, -1, 1).contiguous()

        embedding, modulation = newest(self.embedding, 1), newest(self.modulation, 2)
        return Conditioning(embedding, modulation, self.out, newest(self.tokens, 1), self.order)


@dataclass
class TimePositions:
    """The times of the frames of a pass, and which frames each may see.

    Samples whose times differ have a first axis B in every attribute; where they agree, it is 1 or absent.

    Attributes:
        positions: (T,) int64, the times of the frames.
        allowed: (T, keys) bool, which key frames each frame may see.
        rotary: cos and sin (T, head_dim / 2) of the rotary angles.
        causal: `allowed` is the plain lower triangle.
        slots: (B, T) int64, slot · rows + row, the places where the frames of the pass are carried; None
            where nothing is carried.
        rows: the samples' rows of what is carried; None for all.
        wanted: the first frame whose features are read; a trunk may leave out those before it.
        places: (B, S of a view) int64, which places of the grid the frames show; None for all.
        shared: what `once` keeps.
    """

    positions: Tensor
    allowed: Tensor
    rotary: tuple[Tensor, Tensor]
    causal: bool = False
    slots: Tensor | None = None
    rows: slice | Tensor | None = None
    wanted: int = 0
    places: Tensor | None = None
    shared: dict[str, Tensor] = field(default_factory=dict, repr=False)

    def once(self, name: str, make: Callable[[], Tensor]) -> Tensor:
        """Return what `make` returns; the layers of a pass share it."""
        if name not in self.shared:
            self.shared[name] = make()
        return self.shared[name]

    def last(self) -> "TimePositions":
        """Return the times of the last frame alone."""
        cos, sin = (angle[..., -1:, :].contiguous() for angle in self.rotary)
        slots = None if self.slots is None else self.slots[:, -1:].contiguous()
        allowed, positions = self.allowed[..., -1:, :].contiguous(), self.positions[..., -1:].contiguous()
        return TimePositions(positions, allowed, (cos, sin), slots=slots, rows=self.rows)


@dataclass(frozen=True)
class Carried:
    """What a rollout carries of the past frames of its rows, beside the frames themselves.

    Attributes:
        memory: what a pass writes in place, of one type on one device.
        axis: that of the slots in each; the next one is that of the rows.
        tokens: N of the frames.
    """

    memory: list[Tensor]
    axis: int
    tokens: int

    def fits(self, slots: int, tokens: int, dtype: torch.dtype, device: torch.device) -> bool:
        """Check whether this is for so many slots a row and tokens a frame."""
        kept = self.memory[0]
        return (kept.shape[self.axis], self.tokens, kept.dtype, kept.device) == (slots, tokens, dtype, device)

    def take(self, rows: Tensor) -> "Carried":
        """Return a copy of some rows."""
        return replace(self, memory=[kept.index_select(self.axis + 1, rows) for kept in self.memory])

    def put(self, rows: Tensor, other: "Carried") -> None:
        """Replace rows by all rows of another one."""
        for own, theirs in zip(self.memory, other.memory, strict=True):
            own.index_copy_(self.axis + 1, rows, theirs)


class Trunk(Protocol):
    """What embodiments share.

    Attributes:
        config: of the model.
        blocks: the repeated layers: ranks shard them, compilers compile them, Muon steps their matrices.
        absent: (1 or T, D), the embedding of a chunk that is not there.
        modulation: the map from embeddings to shifts and gains; None if each stem has its own.
        checkpointing: recompute each block in the backward pass instead of keeping its activations.
    """

    config: HMAConfig
    blocks: nn.ModuleList
    absent: nn.Parameter
    modulation: Any
    checkpointing: bool

    def embed_frames(
        self, frames: Tensor, masked: Tensor | None, previous: Sequence[int], corruption: Tensor | None
    ) -> Tensor:
        """Embed frames as (B, T, S, D).

        Args:
            frames: (B, T, S) ids, of which `mask_id` means masked, or (B, T, S, C) patches.
            masked: (B, T, S, pixels of a patch or 1) bool, what is masked of patches; None for ids.
            previous: (T,) for each frame the index of the frame before it, or -1 if it is not there.
            corruption: (B, T) shares that the model is told to distrust; None tells nothing.
        """

    def __call__(
        self, x: Tensor, conditioning: Conditioning, times: TimePositions, carried: Carried | None = None
    ) -> Tensor:
        """Map embedded frames (B, T, S, D) to features (B, T, N, D); action tokens come last in a frame.

        With `carried`, past frames are read from there, and those of the pass are written to their slots.
        """

    def carry(self, rows: int, slots: int, tokens: int, dtype: torch.dtype, device: torch.device) -> Carried:
        """Return what a rollout of so many rows carries, without any frame yet."""


class BlockTrunk(nn.Module):
    """What trunks of blocks have in common: the embedding of frames, and blocks that may be recomputed."""

    def __init__(self, config: HMAConfig) -> None:
        super().__init__()
        self.config = config
        self.checkpointing = False
        self.embed = TokenEmbedding(config) if config.discrete else LatentEmbedding(config)
        self.noise = NoiseEmbedding(config) if config.told_noise else None

    def embed_frames(
        self, frames: Tensor, masked: Tensor | None, previous: Sequence[int], corruption: Tensor | None
    ) -> Tensor:
        """Embed frames, as `Trunk.embed_frames` says."""
        x: Tensor = self.embed(frames, masked, previous)
        return x if corruption is None or self.noise is None else x + self.noise(corruption)

    def run_block(self, block: nn.Module, *given: Any) -> Tensor:
        """Call a block; with `checkpointing`, training recomputes it in the backward pass."""
        if self.checkpointing and self.training and torch.is_grad_enabled():
            made: Tensor = checkpoint(block, *given, use_reentrant=False)
            return made
        return block(*given)


def rows_at(table: Tensor, positions: Tensor) -> Tensor:
    """Return the rows of a table at absolute times, or its only row if it does not depend on time."""
    return table if table.shape[0] == 1 else table[positions]


def window_times(config: HMAConfig, frames: int, device: torch.device | str) -> TimePositions:
    """Return the times of consecutive frames; each sees itself and the `config.frames` - 1 before it."""
    positions = torch.arange(frames, device=device)
    age = positions.unsqueeze(1) - positions
    allowed = (age >= 0) & (age < config.frames)
    return TimePositions(positions, allowed, rotary_angles(config, positions), causal=frames <= config.frames)


def ring_times(config: HMAConfig, positions: Tensor, slots: int) -> TimePositions:
    """Return the times of frames at (B, T) of rows whose frame at time t is carried in slot t mod R.

    The slots of the frames (`TimePositions.slots`) are those of a single row.
    """
    newest = positions[:, -1:]
    # Slot r holds the newest time t with t mod R = r. A negative one is a slot that nothing has filled.
    held = newest - (newest - torch.arange(slots, device=newest.device)) % slots  # (B, R) times
    age = positions.unsqueeze(2) - held.unsqueeze(1)
    allowed = (held >= 0).unsqueeze(1) & (age >= 0) & (age < config.frames)
    return TimePositions(positions, allowed, rotary_angles(config, positions), slots=positions % slots)


def paired_times(config: HMAConfig, past: int, frames: int, device: torch.device | str) -> TimePositions:
    """Return the times of the first `past` frames, then of a copy of each frame from the second on.

    A frame sees itself and the frames before it; a copy sees itself and the frames before it, no other copy.
    """
    positions = torch.cat([torch.arange(past), torch.arange(1, frames)]).to(device)
    age = positions.unsqueeze(1) - positions
    is_true = torch.arange(len(positions), device=device) < past
    # A true frame and its copy have the same time. Age 0 is left out, so that a copy cannot see its answer.
    allowed = (age > 0) & (age < config.frames) & is_true
    allowed.fill_diagonal_(True)
    return TimePositions(positions, allowed, rotary_angles(config, positions))
