"""`fsq-16` and `fsq-8`: encode pictures to discrete ids, with weights that are inside the package.

One network and one file of weights serve both. A token covers 16×16 pixels and has 18 bits.
`fsq-16` takes 256×256 pictures (16×16 tokens), `fsq-8` takes 128×128 pictures (8×8 tokens).
The training recipe is recipes/tokenizer/fsq.yaml.

The network is a convolutional autoencoder. The picture is first cut into 8×8 patches, and all later
layers work at 1/8 and 1/16 of its size; this makes the network fast on a CPU. The bottleneck has a few
channels, each rounded to a fixed number of levels (finite scalar quantisation, Mentzer et al. 2023), so
there is no learned codebook that could collapse.

B pictures, S side, h = S/16, C latent channels, K digits. Pixels inside the network are in [-1, 1].
"""

import math
from pathlib import Path
from typing import Annotated

import torch
from pydantic import BaseModel, ConfigDict, Field, field_validator
from torch import Tensor, nn
from torch.nn import functional

from hma_data.tokenizers.base import TokenizerSpec
from hma_data.tokenizers.catalog import EMBEDDED
from hma_data.tokenizers.checkpoints import fill, read_weights
from hma_data.tokenizers.network import NetworkTokenizer, open_device

WEIGHTS = EMBEDDED / "fsq.safetensors"
FORMAT = "hma-fsq-1"
VERSION = 1
PATCH = 8
STRIDE = 16
Width = Annotated[int, Field(ge=1, le=4096)]
Blocks = Annotated[int, Field(ge=0, le=256)]


class FsqConfig(BaseModel):
    """The network's shape, stored in the weights' file and stated by a recipe.

    Attributes:
        levels: number of levels of each digit's channels; `[[8, 8, 8], [8, 8, 8]]` is two digits of 512.
        width: channels at 1/8 and at 1/16 of the picture's side.
        hidden: channels inside the residual blocks at 1/8 and 1/16.
        encoder_blocks: residual blocks at 1/8 and at 1/16.
        decoder_blocks: residual blocks at 1/16, 1/8 and 1/4.
        fine_width: channels of the decoder at 1/4.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    levels: tuple[tuple[Annotated[int, Field(ge=2)], ...], ...] = ((8, 8, 8), (8, 8, 8))
    width: tuple[Width, Width] = (128, 256)
    hidden: Width = 128
    encoder_blocks: tuple[Blocks, Blocks] = (3, 4)
    decoder_blocks: tuple[Blocks, Blocks, Blocks] = (5, 4, 1)
    fine_width: Width = 48

    @field_validator("levels")
    @classmethod
    def _make_ids(cls, levels: tuple[tuple[int, ...], ...]) -> tuple[tuple[int, ...], ...]:
        count = math.prod(math.prod(digit) for digit in levels)
        if not 2 <= count <= 2**31:
            raise ValueError(f"levels make {count} ids; 2 to 2^31 are possible")
        return levels

    @property
    def factored(self) -> tuple[int, ...]:
        """Return the number of values of each digit, low digit first."""
        return tuple(math.prod(digit) for digit in self.levels)

    @property
    def channels(self) -> int:
        """Return C, the number of latent channels."""
        return sum(len(digit) for digit in self.levels)


class Quantizer(nn.Module):
    """A quantizer without parameters: latents (B, C, h, w) to levels, levels to ids, and back.

    A latent z is squashed to u = erf(z/√2) in (-1, 1). For a standard normal z, u is uniform, so that all
    levels are used. Level k of L stands for u = (2k + 1)/L - 1.
    """

    count: Tensor

    def __init__(self, config: FsqConfig) -> None:
        super().__init__()
        self.levels = config.levels
        self.factored = config.factored
        flat = torch.tensor([float(n) for digit in config.levels for n in digit])
        self.register_buffer("count", flat.view(1, -1, 1, 1), persistent=False)

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
        whole = levels.to(torch.int64)
        ids = torch.zeros_like(whole[:, 0])
        scale = 1
        for channel, size in enumerate(n for digit in self.levels for n in digit):
            ids = ids + whole[:, channel] * scale
            scale *= size
        return ids

    def to_digits(self, ids: Tensor) -> Tensor:
        """Return the levels of ids: (B, h, w) int64 -> (B, C, h, w) float32."""
        channels = []
        for size in (n for digit in self.levels for n in digit):
            channels.append(ids % size)
            ids = ids // size
        return torch.stack(channels, dim=1).float()


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
    """The encoder: (B, 3, S, S) pixels in [-1, 1] -> (B, C, S/16, S/16) latents, about standard normal."""

    def __init__(self, config: FsqConfig) -> None:
        super().__init__()
        low, high = config.width
        at8, at16 = config.encoder_blocks
        self.stem = nn.Conv2d(3 * PATCH**2, low, 3, padding=1)
        self.at8 = stack(low, config.hidden, at8)
        self.down = nn.Conv2d(low * 4, high, 1)
        self.at16 = stack(high, config.hidden, at16)
        self.head = nn.Conv2d(high, config.channels, 1)
        self.linear = nn.Conv2d(3, config.channels, STRIDE, stride=STRIDE)

    def forward(self, pixels: Tensor) -> Tensor:
        x = self.at8(self.stem(functional.pixel_unshuffle(pixels, PATCH)))
        x = self.at16(self.down(functional.pixel_unshuffle(x, 2)))
        return self.head(x) + self.linear(pixels)


class Decoder(nn.Module):
    """The decoder: (B, C, h, w) in (-1, 1) -> (B, 3, 16h, 16w) pixels, about [-1, 1]."""

    def __init__(self, config: FsqConfig) -> None:
        super().__init__()
        low, high = config.width
        at16, at8, at4 = config.decoder_blocks
        fine = config.fine_width
        self.stem = nn.Conv2d(config.channels, high, 3, padding=1)
        self.at16 = stack(high, config.hidden, at16)
        self.up8 = nn.Conv2d(high, low * 4, 1)
        self.at8 = stack(low, config.hidden, at8)
        self.up4 = nn.Conv2d(low, fine * 4, 1)
        self.at4 = stack(fine, fine, at4)
        self.head = nn.Conv2d(fine, 48, 3, padding=1)
        self.linear = nn.Conv2d(config.channels, 3 * STRIDE**2, 1)

    def forward(self, codes: Tensor) -> Tensor:
        x = self.at16(self.stem(codes))
        x = self.at8(functional.pixel_shuffle(self.up8(x), 2))
        x = self.at4(functional.pixel_shuffle(self.up4(x), 2))
        detail = functional.pixel_shuffle(self.head(functional.silu(x)), 4)
        return detail + functional.pixel_shuffle(self.linear(codes), STRIDE)


class FsqAutoencoder(nn.Module):
    """An autoencoder of `encoder`, `quantizer` and `decoder`; `forward` is the training pass."""

    format = FORMAT
    stride = STRIDE
    linear_gain = 1.7  # least-squares estimate of z as 1.7 u, from u = erf(z/√2), z standard normal

    def __init__(self, config: FsqConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = Encoder(config)
        self.quantizer = Quantizer(config)
        self.decoder = Decoder(config)

    def forward(self, pixels: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return the reconstruction of (B, 3, S, S) pixels in [-1, 1], and their latents (B, C, h, w).

        This network draws no random numbers; `generator` is for networks that add noise.
        """
        latents = self.encoder(pixels)
        return self.decoder(self.quantizer(latents)), latents


def load(name: str, *, weights: str | None, device: str, image_size: int) -> NetworkTokenizer:
    """Return the tokenizer; `hma_data.tokenizers.base.get_tokenizer` states the arguments and the errors.

    Its `.network` has `encoder`, `quantizer` and `decoder`.
    """
    place = open_device(name, device)
    path = Path(weights).expanduser() if weights else WEIGHTS
    config, tensors, sha256 = read_weights(path, FORMAT, FsqConfig)
    with torch.device("meta"):
        network = FsqAutoencoder(config)
    quantizer = network.quantizer = Quantizer(config)  # its buffers are not in the weights' file
    fill(network, tensors, path)
    spec = TokenizerSpec.discrete(name, VERSION, image_size, STRIDE, config.factored, weights_sha256=sha256)

    def encode(pixels: Tensor) -> Tensor:
        return quantizer.to_ids(quantizer.to_levels(network.encoder(pixels)))

    def decode(ids: Tensor) -> Tensor:
        codes = quantizer.from_levels(quantizer.to_digits(ids))
        return network.decoder(codes.contiguous(memory_format=torch.channels_last))

    return NetworkTokenizer(spec, network, place, encode, decode, light=True)
