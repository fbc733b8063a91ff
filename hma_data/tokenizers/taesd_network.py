"""Define the tiny autoencoders of the TAESD family: 3×3 convolutions, ReLUs, residual blocks.

Each is distilled from another autoencoder and shares its latent space. Encoder and decoder are plain
sequences, so their layers are derived from the weights: a convolution without a bias halves (encoder)
or doubles (decoder) the side. Sizes and order follow Ollin Boer Bohan's TAESD. Pixels are in [-1, 1]
at the interface; the weights expect [0, 1].
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

LIMIT = 3.0  # the decoder squeezes latents into (-LIMIT, LIMIT)
POOL_GROUPS = 4


@dataclass(frozen=True)
class Layer:
    """One layer of the encoder or the decoder.

    Attributes:
        kind: `conv` keeps the size, `scale` halves or doubles it, `block` is residual.
        before, after: numbers of input and output channels.
        pooled: channels inside the block's second branch; 0 if the block has none.
    """

    kind: str
    before: int
    after: int
    pooled: int = 0


@dataclass(frozen=True)
class TinyConfig:
    """The layers of the encoder and the decoder, in order."""

    encoder: tuple[Layer, ...] = field(default=())
    decoder: tuple[Layer, ...] = field(default=())

    def __post_init__(self) -> None:
        if _stride(self.encoder) != _stride(self.decoder):
            raise ValueError(f"it shrinks by {_stride(self.encoder)}, but grows by {_stride(self.decoder)}")
        if self.encoder[-1].after != self.decoder[0].before:
            raise ValueError("encoder and decoder have latents of another width")
        if self.encoder[0].before != 3 or self.decoder[-1].after != 3:
            raise ValueError("it takes or makes no RGB pictures")
        for half in (self.encoder, self.decoder):
            if half[0].kind != "conv" or half[-1].kind != "conv" or len(half) < 3:
                raise ValueError("a half must begin and end with a convolution that has a bias")
            if any(layer.kind == "conv" for layer in half[1:-1]):
                raise ValueError("a half has a convolution with a bias inside")
            if any(a.after != b.before for a, b in pairwise(half)):
                raise ValueError("the widths of neighbouring layers differ")

    @property
    def channels(self) -> int:
        """Return the number of latent channels."""
        return self.encoder[-1].after

    @property
    def stride(self) -> int:
        """Return the number of pixels a latent covers along each side."""
        return _stride(self.encoder)


def _stride(layers: Sequence[Layer]) -> int:
    return 2 ** sum(layer.kind == "scale" for layer in layers)


class Block(nn.Module):
    """A residual block: relu(x + three convolutions of x).

    With `pool`, a normalised 1×1 branch is first added to x.
    """

    def __init__(self, layer: Layer) -> None:
        super().__init__()
        before, after = layer.before, layer.after
        self.conv = nn.Sequential(
            nn.Conv2d(before, after, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(after, after, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(after, after, 3, padding=1),
        )
        self.skip = nn.Identity() if before == after else nn.Conv2d(before, after, 1, bias=False)
        self.pool: nn.Module | None = None
        if layer.pooled:
            self.pool = nn.Sequential(
                nn.Conv2d(before, layer.pooled, 1, bias=False),
                nn.GroupNorm(POOL_GROUPS, layer.pooled),
                nn.ReLU(),
                nn.Conv2d(layer.pooled, before, 1, bias=False),
            )

    def forward(self, x: Tensor) -> Tensor:
        if self.pool is not None:
            x = x + self.pool(x)
        return functional.relu(self.conv(x) + self.skip(x))


def _modules(layers: Sequence[Layer], stride: int) -> nn.ModuleList:
    made: list[nn.Module] = []
    for layer in layers:
        if layer.kind == "block":
            made.append(Block(layer))
        else:
            scale = layer.kind == "scale"
            step = stride if scale else 1
            made.append(nn.Conv2d(layer.before, layer.after, 3, stride=step, padding=1, bias=not scale))
    return nn.ModuleList(made)


class Encoder(nn.Module):
    """The encoder: (B, 3, S, S) pixels -> (B, c, h, h) latents."""

    def __init__(self, layers: Sequence[Layer]) -> None:
        super().__init__()
        self.layers = _modules(layers, 2)

    def forward(self, pixels: Tensor) -> Tensor:
        x = pixels.add(1).div(2)
        for layer in self.layers:
            x = layer(x)
        return x


class Decoder(nn.Module):
    """The decoder: (B, c, h, h) latents -> (B, 3, S, S) pixels, about [-1, 1]."""

    def __init__(self, layers: Sequence[Layer]) -> None:
        super().__init__()
        self.kinds = [layer.kind for layer in layers]
        self.layers = _modules(layers, 1)

    def forward(self, latents: Tensor) -> Tensor:
        x = torch.tanh(latents / LIMIT) * LIMIT
        x = functional.relu(self.layers[0](x))
        for kind, layer in zip(self.kinds[1:], list(self.layers)[1:], strict=True):
            x = layer(functional.interpolate(x, scale_factor=2) if kind == "scale" else x)
        return x.mul(2).sub(1)


class TinyAutoencoder(nn.Module):
    """An autoencoder of `encoder` and `decoder`."""

    def __init__(self, config: TinyConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = Encoder(config.encoder)
        self.decoder = Decoder(config.decoder)
