"""Define the stem of an embodiment: normalisation, embedding and modulation weights of its action chunks.

B batch, T frames, A values of an action, K = stride*A values of a chunk, D width, L layers.
"""

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hma_model.config import ActionSpace, HMAConfig


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
        return ((self._actions(chunks) - mean) * inverse).flatten(-2)

    def undo(self, chunks: Tensor) -> Tensor:
        """Convert normalised chunks (..., K) to raw ones (..., K) float32."""
        mean, scale, _ = self._affine()
        return (self._actions(chunks) * scale + mean).flatten(-2)

    def _actions(self, chunks: Tensor) -> Tensor:
        return chunks.float().unflatten(-1, (-1, self.mean.numel()))

    def _affine(self) -> tuple[Tensor, Tensor, Tensor]:
        if self.divide is not None:
            scale = self.std + 1e-10
            inverse = 1 / scale
        else:
            varies = self.std > 1e-6 * self.mean.abs() + 1e-9  # a constant's float32 rounding is no variance
            scale = torch.where(varies, self.std, 0.0)
            inverse = torch.where(varies, 1 / self.std.clamp(min=1e-9), 0.0)
        one, zero = torch.ones_like(scale), torch.zeros_like(scale)
        return (
            torch.where(self.normalize, self.mean, zero),
            torch.where(self.normalize, scale, one),
            torch.where(self.normalize, inverse, one),
        )

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "Normalizer":
        kept = self.mean, self.std
        super()._apply(fn, recurse)
        if self.mean.dtype != torch.float32:  # a cast of the model must not round the statistics
            self.mean, self.std = (value.to(self.mean.device) for value in kept)
        return self


class Modulation(nn.Module):
    """The map from action embeddings to every layer's (shift, gain), all layers in two batched products.

    Weights are stacked over layers, (L, in, out). With `modulation_out == "embodiment"` it also holds each
    layer's projection after the modulated norm, as the released code does.
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
        if config.modulation_out == "embodiment":
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
    """The input modules of one embodiment."""

    def __init__(self, config: HMAConfig, space: ActionSpace) -> None:
        super().__init__()
        self.normalizer = Normalizer(space)
        self.input = nn.Linear(space.chunk_dim, config.width)
        self.norm = nn.LayerNorm(config.width)
        self.output = nn.Linear(config.width, config.width)
        self.modulation: Modulation | None = None
        if "modulation" in config.conditioning and not config.shared_modulation:
            self.modulation = Modulation(config)
        for linear in (self.input, self.output):
            nn.init.normal_(linear.weight, std=linear.in_features**-0.5)
            nn.init.zeros_(linear.bias)

    def forward(self, chunks: Tensor) -> Tensor:
        """Map raw chunks (B, T, K) to action embeddings (B, T, D)."""
        values = self.normalizer(chunks).to(self.input.weight.dtype)
        return self.output(F.relu(self.norm(self.input(values))))
