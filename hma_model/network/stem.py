"""Embed the trunk's inputs: frames as tokens of its width, and action chunks by the stem of an embodiment.

B batch, T frames, h,w token grid, S = h*w, D width, L layers, F digits of a token id, V values of a digit,
c channels, H,W latent grid, p patch side, A values of an action, K = stride*A values of a chunk.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from itertools import accumulate
from operator import mul

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hma_data.errors import CheckpointError
from hma_model.config import ActionSpace, HMAConfig
from hma_model.network.linear import Linear

# -- frames


@lru_cache
def _places(factored: tuple[int, ...], device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Return (F,) int64: the worth of a digit in an id, its number of values, and that of all before it."""
    with torch.inference_mode(False):
        worth = [1, *accumulate(factored[:-1], mul)]
        starts = [0, *accumulate(factored[:-1])]
        made = torch.tensor([worth, factored, starts], device=device)
        return made[0], made[1], made[2]


def to_digits(tokens: Tensor, factored: Sequence[int]) -> Tensor:
    """Convert token ids (...) to digits (..., F), low digit first."""
    worth, values, _ = _places(tuple(factored), tokens.device)
    return tokens.unsqueeze(-1) // worth % values


def from_digits(digits: Tensor, factored: Sequence[int]) -> Tensor:
    """Convert digits (..., F) to token ids (...)."""
    worth, _, _ = _places(tuple(factored), digits.device)
    return (digits * worth).sum(-1)


def merge_tokens(tokens: Tensor, side: int, vocab_size: int) -> Tensor:
    """Convert ids (B, T, h, w) to ids (B, T, S) of squares of side² tokens, row by row, the first one lowest.

    A square with a token that is masked (`vocab_size`) is masked: vocab_size ** side².
    """
    if side == 1:
        return tokens.flatten(2)
    parts = patchify(tokens.unsqueeze(2), side)
    masked = (parts == vocab_size).any(-1)
    whole = from_digits(parts.masked_fill(masked.unsqueeze(-1), 0), (vocab_size,) * side**2)
    return whole.masked_fill(masked, vocab_size ** (side * side))


def split_tokens(tokens: Tensor, side: int, vocab_size: int, grid: tuple[int, int]) -> Tensor:
    """Convert ids (..., S) of squares to ids (..., h, w) of their tokens; `grid` is (h/side, w/side)."""
    if side == 1:
        return tokens.unflatten(-1, grid)
    return unpatchify(to_digits(tokens, (vocab_size,) * side**2), side, grid).squeeze(-3)


def patchify(latents: Tensor, patch: int) -> Tensor:
    """Convert latents (..., c, H, W) to patches (..., S, c*p*p)."""
    split = latents.unflatten(-1, (-1, patch)).unflatten(-3, (-1, patch)).transpose(-3, -2)
    return split.movedim(-5, -3).flatten(-3).flatten(-3, -2)


def unpatchify(patches: Tensor, patch: int, grid: tuple[int, int]) -> Tensor:
    """Convert patches (..., S, c*p*p) to latents (..., c, H, W), with `grid` = (H/p, W/p)."""
    split = patches.unflatten(-1, (-1, patch, patch)).unflatten(-4, grid).movedim(-3, -5)
    return split.transpose(-3, -2).flatten(-2).flatten(-3, -2)


class TokenEmbedding(nn.Module):
    """Token embeddings: the sum of the embeddings of a token's digits, or a learned vector if masked.

    With `masked_input == "previous"`, the embedding of the frame before at its place is added to that vector.
    """

    def __init__(self, config: HMAConfig) -> None:
        super().__init__()
        self.factored = config.digits
        self.mask_id = config.mask_id
        std = len(config.digits) ** -0.5
        self.digits = nn.ParameterList(torch.randn(v, config.width) * std for v in config.digits)
        self.carries = config.masked_input == "previous"
        self.mask = nn.Parameter(torch.randn(config.width) * (0.5 if self.carries else 0.02))

    def forward(self, tokens: Tensor, masked: Tensor | None, previous: Sequence[int]) -> Tensor:
        """Embed ids (B, T, S) as (B, T, S, D).

        Args:
            tokens: the configuration's `mask_id` means masked.
            masked: not used: an id says by itself that it is masked.
            previous: (T,) for each frame the index of the frame before it, or -1 if it is not there.
        """
        hidden = tokens == self.mask_id
        return self.of_digits(to_digits(tokens.masked_fill(hidden, 0), self.factored), hidden, previous)

    def of_digits(self, digits: Tensor, hidden: Tensor, previous: Sequence[int]) -> Tensor:
        """Embed digits (B, T, S, F) as (B, T, S, D); `hidden` (B, T, S) bool says which tokens are masked."""
        hidden = hidden.unsqueeze(-1)
        if len(self.factored) > 2:  # one sum over all digits
            starts = _places(tuple(self.factored), digits.device)[2]
            rows = (digits + starts).flatten(0, -2)
            table = torch.cat(list(self.digits))
            if torch.compiler.is_exporting():  # ONNX has no such operator, and would loop over the tokens
                embedding = F.embedding(rows, table).sum(1)
            else:
                embedding = F.embedding_bag(rows, table, mode="sum")
            embedding = embedding.view(*digits.shape[:-1], -1)
        else:
            embedding = F.embedding(digits[..., 0], self.digits[0])
            for index in range(1, len(self.factored)):
                embedding = embedding + F.embedding(digits[..., index], self.digits[index])
        mask: Tensor = self.mask
        if self.carries:
            mask = mask + values_before(embedding.masked_fill(hidden, 0), previous)
        return torch.where(hidden, mask, embedding)


def values_before(values: Tensor, previous: Sequence[int]) -> Tensor:
    """Return for each frame of (B, T, S, D) the values of the frame before it; zeros where there is none."""
    index = torch.tensor(previous, device=values.device)
    before = values.index_select(1, index.clamp(min=0))
    return before * (index >= 0).to(values.dtype).view(-1, 1, 1)


def patches_before(patches: Tensor, masked: Tensor, previous: Sequence[int], patch: int) -> Tensor:
    """Return what is seen of the frames numbered `previous`: (B, len(previous), S, c*p*p), zeros elsewhere.

    `patches` (B, T, S, c*p*p) and `masked` (B, T, S, p*p or 1) are those of `LatentEmbedding`.
    """
    pixels = patches.unflatten(-1, (-1, patch**2)).masked_fill(masked.unsqueeze(-2), 0)
    return values_before(pixels.flatten(-2), previous)


class LatentEmbedding(nn.Module):
    """A linear embedding of patches of latents; a learned pixel first replaces the masked latent pixels.

    With `masked_input == "previous"`, the patch of the frame before is added to the masked pixels.
    """

    def __init__(self, config: HMAConfig) -> None:
        super().__init__()
        self.patch = config.patch
        self.carries = config.masked_input == "previous"
        self.mask = nn.Parameter(torch.randn(config.channels) * (2.0 if self.carries else 0.02))
        self.linear = Linear(config.patch_dim, config.width, bias=False)
        nn.init.normal_(self.linear.weight, std=config.patch_dim**-0.5)

    def forward(self, patches: Tensor, masked: Tensor, previous: Sequence[int]) -> Tensor:
        """Embed patches (B, T, S, c*p*p) as (B, T, S, D).

        Args:
            patches: of the frames.
            masked: (B, T, S, p*p or 1) bool, the masked pixels of the patches.
            previous: (T,) for each frame the index of the frame before it, or -1 if it is not there.
        """
        pixels, hidden = patches.unflatten(-1, (-1, self.patch**2)), masked.unsqueeze(-2)
        mask = self.mask.to(patches.dtype).unsqueeze(-1)
        if self.carries:
            mask = mask + patches_before(patches, masked, previous, self.patch).view_as(pixels)
        filled = torch.where(hidden, mask, pixels).flatten(-2)
        return self.linear(filled.to(self.linear.weight.dtype))


class NoiseEmbedding(nn.Module):
    """The embedding of a frame's corruption, which is added to its tokens; that of a clean frame is zero.

    The projection begins at zero, so it can be added to a trained trunk.
    """

    WAVES = 16

    def __init__(self, config: HMAConfig) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(self.WAVES, config.width))

    def forward(self, corruption: Tensor) -> Tensor:
        """Embed shares (B, T) from 0 to 1 as (B, T, 1, D)."""
        rates = torch.arange(1, self.WAVES + 1, device=corruption.device) * (math.pi / 2)
        waves = (corruption.unsqueeze(-1) * rates).sin()  # all of them zero at 0
        return (waves.to(self.weight.dtype) @ self.weight).unsqueeze(2)


# -- actions


def varying(mean: Tensor, std: Tensor) -> Tensor:
    """Return which values (A,) vary; the float32 rounding of a constant is no variance."""
    return std > 1e-6 * mean.abs() + 1e-9


class Normalizer(nn.Module):
    """The normalisation of raw chunks to zero mean and unit variance, and its inverse.

    Dims that never vary become 0 and are restored as their mean, unless the action space states "divide".
    Dims that are marked not to be normalised pass through. The statistics stay float32 if the model is cast.
    """

    mean: Tensor
    std: Tensor
    normalize: Tensor
    divide: Tensor | None

    def __init__(self, space: ActionSpace) -> None:
        super().__init__()
        self.register_buffer("mean", torch.tensor(space.mean, dtype=torch.float32))
        self.register_buffer("std", torch.tensor(space.std, dtype=torch.float32))
        self.register_buffer("normalize", torch.tensor(space.normalize, dtype=torch.bool))
        released = space.zero_variance == "divide"  # it is in the state only if true
        self.register_buffer("divide", torch.tensor(True) if released else None)

    def forward(self, chunks: Tensor) -> Tensor:
        """Normalise raw chunks (..., K) to (..., K) float32."""
        mean, _, inverse = self._affine()
        return ((chunks.float().unflatten(-1, (-1, len(mean))) - mean) * inverse).flatten(-2)

    def undo(self, chunks: Tensor) -> Tensor:
        """Convert normalised chunks (..., K) to raw ones (..., K) float32."""
        mean, scale, _ = self._affine()
        return (chunks.float().unflatten(-1, (-1, len(mean))) * scale + mean).flatten(-2)

    def _affine(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return (A,) the mean, the scale and its inverse."""
        if self.divide is not None:
            scale = self.std + 1e-10
            inverse = 1 / scale
        else:
            varies = varying(self.mean, self.std)
            scale = torch.where(varies, self.std, 0.0)
            inverse = torch.where(varies, 1 / self.std.clamp(min=1e-9), 0.0)
        kept = torch.where(self.normalize, self.mean, 0.0)
        return kept, torch.where(self.normalize, scale, 1.0), torch.where(self.normalize, inverse, 1.0)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "Normalizer":
        kept = self.mean, self.std
        super()._apply(fn, recurse)
        if self.mean.dtype != torch.float32:  # a cast of the model must not round the statistics
            self.mean, self.std = (value.to(self.mean.device) for value in kept)
        return self


class Modulation(nn.Module):
    """The map from action embeddings to every layer's (shift, gain), all layers in two batched products.

    Weights are stacked over layers, (L, in, out). In the released layout it also holds each
    layer's projection after the modulated norm.
    """

    def __init__(self, config: HMAConfig) -> None:
        super().__init__()
        layers, width = config.layers, config.width
        self.weight_in = nn.Parameter(torch.randn(layers, width, width) / math.sqrt(width))
        self.bias_in = nn.Parameter(torch.zeros(layers, 1, width))
        self.weight = nn.Parameter(torch.randn(layers, width, 2 * width) / math.sqrt(width))
        self.bias = nn.Parameter(torch.zeros(layers, 1, 2 * width))
        self.out_weight: nn.Parameter | None = None
        self.out_bias: nn.Parameter | None = None
        if config.released:
            self.out_weight = nn.Parameter(torch.randn(layers, width, width) / math.sqrt(2 * layers * width))
            self.out_bias = nn.Parameter(torch.zeros(layers, width))

    @property
    def out(self) -> tuple[Tensor, Tensor] | None:
        """Return the projections after the modulated norm, (L, D, D) and (L, D), or None."""
        if self.out_weight is None or self.out_bias is None:
            return None
        return self.out_weight, self.out_bias

    def forward(self, embedding: Tensor) -> Tensor:
        """Map embeddings (B, T, D) to (L, B, T, 2D): shift, then 1 + scale."""
        rows = embedding.flatten(0, 1).expand(self.weight.shape[0], -1, -1)
        hidden = F.silu(torch.baddbmm(self.bias_in, rows, self.weight_in))
        values = torch.baddbmm(self.bias, hidden, self.weight)
        shift, scale = values.chunk(2, dim=-1)
        return torch.cat([shift, 1 + scale], dim=-1).unflatten(1, embedding.shape[:2])


class Stem(nn.Module):
    """The input modules of one embodiment.

    Args:
        waves: octaves of waves of the commands; by default the configuration's.
    """

    def __init__(self, config: HMAConfig, space: ActionSpace, waves: int | None = None) -> None:
        super().__init__()
        self.normalizer = Normalizer(space)
        self.input = Linear(space.chunk_dim, config.width)
        self.norm = nn.LayerNorm(config.width)
        self.output = Linear(config.width, config.width)
        self.modulation: Modulation | None = None
        if "modulation" in config.conditioning and not config.shared_modulation:
            self.modulation = Modulation(config)
        for linear in (self.input, self.output):
            nn.init.normal_(linear.weight, std=linear.in_features**-0.5)
            nn.init.zeros_(linear.bias)
        self.waves: Linear | None = None
        if octaves := config.action_waves if waves is None else waves:
            self.waves = Linear(2 * octaves * space.chunk_dim, config.width, bias=False)
            nn.init.zeros_(self.waves.weight)  # so it can be added to a trained stem

    def forward(self, chunks: Tensor) -> Tensor:
        """Map raw chunks (B, T, K) to action embeddings (B, T, D)."""
        values = self.normalizer(chunks).to(self.input.weight.dtype)
        hidden = self.input(values)
        if self.waves is not None:
            octaves = torch.arange(self.waves.in_features // (2 * values.shape[-1]), device=values.device)
            turns = values.unsqueeze(-1) * (2.0**octaves * (math.pi / 4))
            hidden = hidden + self.waves(torch.cat([turns.sin(), turns.cos()], dim=-1).flatten(-2))
        return self.output(F.relu(self.norm(hidden)))


def space_of_stem(embodiment: str, stem: Mapping[str, Tensor]) -> ActionSpace:
    """Return the action space for which a stem's state was made.

    Raises:
        CheckpointError: the state is not that of a stem.
    """
    try:
        mean, std, mask = (stem[f"normalizer.{name}"] for name in ("mean", "std", "normalize"))
        chunk_dim = stem["input.weight"].shape[1]
    except KeyError as error:
        fault = f"the state of a stem lacks {error.args[0]}"
        raise CheckpointError(f"{embodiment}: stem", fault, "load a stem's state") from error
    values = tuple(mean.tolist()), tuple(std.tolist()), tuple(mask.bool().tolist())
    rule = "divide" if "normalizer.divide" in stem else "zero"
    return ActionSpace(embodiment, mean.numel(), chunk_dim // mean.numel(), *values, zero_variance=rule)


def waves_of_stem(stem: Mapping[str, Tensor]) -> int:
    """Return the octaves of waves of the commands in a stem's state."""
    if "waves.weight" not in stem or "input.weight" not in stem:
        return 0
    return stem["waves.weight"].shape[-1] // max(2 * stem["input.weight"].shape[-1], 1)
