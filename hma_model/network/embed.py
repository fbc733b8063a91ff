"""Embed frames as tokens of the trunk's width, and convert token ids to digits.

B batch, T frames, h,w token grid, S = h*w, D width, F digits of a token id, V values of a digit,
c channels, H,W latent grid, p patch side.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hma_model.config import HMAConfig


def to_digits(tokens: Tensor, factored: Sequence[int]) -> Tensor:
    """Convert token ids (...) to digits (..., F), low digit first."""
    digits = []
    for values in factored:
        digits.append(tokens % values)
        tokens = tokens // values
    return torch.stack(digits, dim=-1)


def from_digits(digits: Tensor, factored: Sequence[int]) -> Tensor:
    """Convert digits (..., F) to token ids (...)."""
    tokens = torch.zeros_like(digits[..., 0])
    for index in reversed(range(len(factored))):
        tokens = tokens * factored[index] + digits[..., index]
    return tokens


def patchify(latents: Tensor, patch: int) -> Tensor:
    """Convert latents (B, T, c, H, W) to patches (B, T, S, c*p*p)."""
    b, t, c, height, width = latents.shape
    split = latents.reshape(b, t, c, height // patch, patch, width // patch, patch)
    return split.permute(0, 1, 3, 5, 2, 4, 6).reshape(b, t, -1, c * patch * patch)


def unpatchify(patches: Tensor, patch: int, grid: tuple[int, int]) -> Tensor:
    """Convert patches (B, T, S, c*p*p) to latents (B, T, c, H, W), with `grid` = (H/p, W/p)."""
    b, t, _, values = patches.shape
    split = patches.reshape(b, t, *grid, values // patch**2, patch, patch)
    return split.permute(0, 1, 4, 2, 5, 3, 6).reshape(b, t, -1, grid[0] * patch, grid[1] * patch)


class TokenEmbedding(nn.Module):
    """Token embeddings: the sum of the embeddings of a token's digits, or a learned vector if masked."""

    def __init__(self, config: HMAConfig) -> None:
        super().__init__()
        self.factored = config.factored
        self.vocab_size = config.vocab_size
        std = len(config.factored) ** -0.5
        self.digits = nn.ParameterList(torch.randn(v, config.width) * std for v in config.factored)
        self.mask = nn.Parameter(torch.randn(config.width) * 0.02)

    def forward(self, tokens: Tensor) -> Tensor:
        """Embed ids (B, T, S), where the vocabulary's size means masked, as (B, T, S, D)."""
        masked = tokens == self.vocab_size
        digits = to_digits(tokens.masked_fill(masked, 0), self.factored)
        embedding = F.embedding(digits[..., 0], self.digits[0])
        for index in range(1, len(self.factored)):
            embedding = embedding + F.embedding(digits[..., index], self.digits[index])
        return torch.where(masked.unsqueeze(-1), self.mask, embedding)


class LatentEmbedding(nn.Module):
    """A linear embedding of patches of latents; a learned pixel first replaces the masked latent pixels."""

    def __init__(self, config: HMAConfig) -> None:
        super().__init__()
        self.patch = config.patch
        self.mask = nn.Parameter(torch.randn(config.channels) * 0.02)
        self.linear = nn.Linear(config.patch_dim, config.width, bias=False)
        nn.init.normal_(self.linear.weight, std=config.patch_dim**-0.5)

    def forward(self, patches: Tensor, masked: Tensor) -> Tensor:
        """Embed patches (B, T, S, c*p*p) with masks of their pixels (B, T, S, p*p or 1) as (B, T, S, D)."""
        pixels = patches.unflatten(-1, (-1, self.patch**2))
        mask = self.mask.to(patches.dtype).unsqueeze(-1)
        filled = torch.where(masked.unsqueeze(-2), mask, pixels).flatten(-2)
        return self.linear(filled.to(self.linear.weight.dtype))
