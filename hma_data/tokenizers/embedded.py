"""`fsq-16`, `fsq-8` and `vae-8`: encode images with weights that are inside the package.

`fsq-16` and `fsq-8` give discrete ids: a token covers 16×16 pixels and has 18 bits. One network and one file
of weights serve both: `fsq-16` takes 256×256 images (16×16 tokens), `fsq-8` 128×128 images (8×8 tokens).
The bottleneck has a few channels, each rounded to a fixed number of levels (finite scalar quantisation,
Mentzer et al. 2023), so there is no learned codebook that could collapse.

`vae-8` gives continuous latents, 4×32×32 for an image of 256×256 pixels, about standard normal in each
channel. The encoder is deterministic: the stored value is the mean of the latent. Training adds a little
noise to the latents, so that similar latents decode to similar images.

Both networks are convolutional autoencoders. The image is first cut into 8×8 patches, and all later layers
work at 1/8 and 1/16 of its size, which makes them fast on a CPU. A linear code of the patches is added to the
output of the convolutions. The training recipes are recipes/tokenizer/fsq.yaml and vae.yaml.

B images, S side, h·w grid, C latent channels. Pixels inside the networks are in [-1, 1].
"""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from hma_data.tokenizers.catalog import CATALOG, EMBEDDED
from hma_data.tokenizers.checkpoints import fill, find_weights, read_weights
from hma_data.tokenizers.network import NetworkTokenizer, open_device
from hma_data.tokenizers.shapes import PATCH, FsqConfig, VaeConfig

# -- the layers of both networks


class Block(nn.Module):
    """A residual block: x + conv1(silu(conv3(x))), 3×3 to `hidden` channels and 1×1 back.

    Its initial weights make it the identity.
    """

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, hidden, 3, padding=1)
        self.second = nn.Conv2d(hidden, width, 1)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        return x + self.second(functional.silu(self.first(x)))


def stack(width: int, hidden: int, count: int) -> nn.Sequential:
    """Return `count` residual blocks in sequence."""
    return nn.Sequential(*(Block(width, hidden) for _ in range(count)))


class Encoder(nn.Module):
    """The encoder: (B, 3, S, S) pixels -> (B, C, h, w) latents, about standard normal.

    `widths` and `blocks` are channels and residual blocks at 1/8 of the side and, if there are two, at 1/16.
    """

    def __init__(self, channels: int, widths: Sequence[int], hidden: int, blocks: Sequence[int]) -> None:
        super().__init__()
        stride = PATCH * len(widths)
        self.halves = len(widths) == 2
        self.stem = nn.Conv2d(3 * PATCH**2, widths[0], 3, padding=1)
        self.at8 = stack(widths[0], hidden, blocks[0])
        if self.halves:
            self.down = nn.Conv2d(widths[0] * 4, widths[1], 1)
            self.at16 = stack(widths[1], hidden, blocks[1])
        self.head = nn.Conv2d(widths[-1], channels, 1)
        self.linear = nn.Conv2d(3, channels, stride, stride=stride)

    def forward(self, pixels: Tensor) -> Tensor:
        x = self.at8(self.stem(functional.pixel_unshuffle(pixels, PATCH)))
        if self.halves:
            x = self.at16(self.down(functional.pixel_unshuffle(x, 2)))
        return self.head(x) + self.linear(pixels)


class Decoder(nn.Module):
    """The decoder: (B, C, h, w) codes -> (B, 3, S, S) pixels, about [-1, 1].

    `widths` are those of the encoder; `blocks` are residual blocks at 1/16 (if there are two widths), 1/8 and
    1/4; `fine` is the number of channels at 1/4.
    """

    def __init__(
        self, channels: int, widths: Sequence[int], hidden: int, blocks: Sequence[int], fine: int
    ) -> None:
        super().__init__()
        self.stride = PATCH * len(widths)
        self.doubles = len(widths) == 2
        self.stem = nn.Conv2d(channels, widths[-1], 3, padding=1)
        if self.doubles:
            self.at16 = stack(widths[1], hidden, blocks[0])
            self.up8 = nn.Conv2d(widths[1], widths[0] * 4, 1)
        self.at8 = stack(widths[0], hidden, blocks[-2])
        self.up4 = nn.Conv2d(widths[0], fine * 4, 1)
        self.at4 = stack(fine, fine, blocks[-1])
        self.head = nn.Conv2d(fine, 48, 3, padding=1)
        self.linear = nn.Conv2d(channels, 3 * self.stride**2, 1)

    def forward(self, codes: Tensor) -> Tensor:
        x = self.stem(codes)
        if self.doubles:
            x = functional.pixel_shuffle(self.up8(self.at16(x)), 2)
        x = self.at4(functional.pixel_shuffle(self.up4(self.at8(x)), 2))
        detail = functional.pixel_shuffle(self.head(functional.silu(x)), 4)
        return detail + functional.pixel_shuffle(self.linear(codes), self.stride)


# -- discrete: finite scalar quantisation


class Quantizer(nn.Module):
    """A quantizer without parameters: latents (B, C, h, w) to levels, levels to ids, and back.

    A latent z is squashed to u = erf(z/√2) in (-1, 1). For a standard normal z, u is uniform, so that all
    levels are used. Level k of L stands for u = (2k + 1)/L - 1.
    """

    count: Tensor

    def __init__(self, config: FsqConfig) -> None:
        super().__init__()
        self.sizes = [size for digit in config.levels for size in digit]
        count = torch.tensor(self.sizes, dtype=torch.float32, device="cpu").view(1, -1, 1, 1)
        self.register_buffer("count", count, persistent=False)

    def to_levels(self, latents: Tensor) -> Tensor:
        """Return the levels of latents (B, C, h, w): whole numbers 0..L-1 of the same dtype."""
        unit = torch.erf(latents * math.sqrt(0.5)) * 0.5 + 0.5
        return torch.minimum(torch.floor(unit * self.count), self.count - 1)

    def from_levels(self, levels: Tensor) -> Tensor:
        """Return the decoder's input for whole levels, in (-1, 1)."""
        return (2 * levels + 1) / self.count - 1

    def forward(self, latents: Tensor) -> Tensor:
        """Return the decoder's input.

        Its gradient is that of the squashing (straight through the rounding).
        """
        soft = torch.erf(latents * math.sqrt(0.5))
        return soft + (self.from_levels(self.to_levels(latents)) - soft).detach()

    def to_ids(self, levels: Tensor) -> Tensor:
        """Return the ids of levels: (B, C, h, w) -> (B, h, w) int64.

        The first channel of the first digit is the lowest.
        """
        ids, scale = torch.zeros_like(levels[:, 0], dtype=torch.int64), 1
        for channel, size in enumerate(self.sizes):
            ids = ids + levels[:, channel].to(torch.int64) * scale
            scale *= size
        return ids

    def to_digits(self, ids: Tensor) -> Tensor:
        """Return the levels of ids: (B, h, w) int64 -> (B, C, h, w) float32."""
        channels = []
        for size in self.sizes:
            channels.append(ids % size)
            ids = ids // size
        return torch.stack(channels, dim=1).float()


class FsqAutoencoder(nn.Module):
    """An autoencoder of `encoder`, `quantizer` and `decoder`; `forward` is the training pass."""

    shape = FsqConfig
    linear_gain = 1.7  # least-squares estimate of z as 1.7 u, from u = erf(z/√2), z standard normal

    def __init__(self, config: FsqConfig) -> None:
        super().__init__()
        self.config = config
        self.stride = config.stride
        widths, hidden, channels = config.width, config.hidden, sum(len(digit) for digit in config.levels)
        self.encoder = Encoder(channels, widths, hidden, config.encoder_blocks)
        self.quantizer = Quantizer(config)
        self.decoder = Decoder(channels, widths, hidden, config.decoder_blocks, config.fine_width)

    def forward(self, pixels: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return the reconstruction of (B, 3, S, S) pixels in [-1, 1], and their latents (B, C, h, w).

        This network draws no random numbers; `generator` is for networks that add noise.
        """
        latents = self.encoder(pixels)
        return self.decoder(self.quantizer(latents)), latents

    def encode(self, pixels: Tensor) -> Tensor:
        """Return the ids of pixels, (B, h, w) int64."""
        return self.quantizer.to_ids(self.quantizer.to_levels(self.encoder(pixels)))

    def decode(self, ids: Tensor) -> Tensor:
        """Return the pixels of ids."""
        codes = self.quantizer.from_levels(self.quantizer.to_digits(ids))
        return self.decoder(codes.contiguous(memory_format=torch.channels_last))


# -- continuous


class VaeAutoencoder(nn.Module):
    """An autoencoder of `encoder` and `decoder`; `forward` is the training pass."""

    shape = VaeConfig
    stride = PATCH
    linear_gain = 1.0  # the decoder takes the latents unchanged

    def __init__(self, config: VaeConfig) -> None:
        super().__init__()
        self.config = config
        channels, widths, hidden = config.channels, [config.width], config.hidden
        self.encoder = Encoder(channels, widths, hidden, [config.encoder_blocks])
        self.decoder = Decoder(channels, widths, hidden, config.decoder_blocks, config.fine_width)

    def forward(self, pixels: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return the reconstruction of (B, 3, S, S) pixels in [-1, 1], and their latents (B, C, h, w)."""
        latents = self.encoder(pixels)
        noise = torch.randn(latents.shape, generator=generator).to(latents.device)
        return self.decoder(latents + self.config.noise * noise), latents

    def encode(self, pixels: Tensor) -> Tensor:
        """Return the latents of pixels, (B, C, h, w)."""
        return self.encoder(pixels)

    def decode(self, latents: Tensor) -> Tensor:
        """Return the pixels of latents."""
        return self.decoder(latents.contiguous(memory_format=torch.channels_last))


Autoencoder = FsqAutoencoder | VaeAutoencoder


def load(name: str, *, weights: str | None, device: str, image_size: int) -> NetworkTokenizer:
    """Return the tokenizer; `hma_data.tokenizers.base.get_tokenizer` states the arguments and the errors."""
    place = open_device(name, device)
    path = find_weights(name, weights) if weights else EMBEDDED / CATALOG[name].file
    kind: Any = FsqAutoencoder if name.startswith("fsq") else VaeAutoencoder
    config, tensors, sha256 = read_weights(path, kind.shape.format, kind.shape)
    with torch.device("meta"):
        network: Autoencoder = kind(config)
    fill(network, tensors, path)
    spec = config.spec(name, image_size, sha256)
    return NetworkTokenizer(spec, network, place, network.encode, network.decode, light=True)
