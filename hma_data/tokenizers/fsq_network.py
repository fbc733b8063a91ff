"""Define the network of `fsq-16` and `fsq-8`: a convolutional autoencoder with finite scalar quantisation.

The picture is first cut into 8×8 patches, and all later layers work at 1/8 and 1/16 of its size; this
makes the network fast on a CPU. The bottleneck has a few channels, each rounded to a fixed number of
levels (finite scalar quantisation, Mentzer et al. 2023), so there is no learned codebook that could
collapse. All layers are convolutions, so the network takes any size divisible by 16.

B pictures, S side, h = S/16, C latent channels, K digits. Pixels inside the network are in [-1, 1].
"""

import math
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

PATCH = 8
STRIDE = 16
FORMAT = "hma-fsq-1"


@dataclass(frozen=True)
class FsqConfig:
    """The network's shape, stored in the weights' file.

    Attributes:
        levels: number of levels of each digit's channels; `[[8, 8, 8], [8, 8, 8]]` is two digits of 512.
        width: channels at 1/8 and at 1/16 of the picture's side.
        hidden: channels inside the residual blocks at 1/8 and 1/16.
        encoder_blocks: residual blocks at 1/8 and at 1/16.
        decoder_blocks: residual blocks at 1/16, 1/8 and 1/4.
        fine_width: channels of the decoder at 1/4.
    """

    levels: tuple[tuple[int, ...], ...] = ((8, 8, 8), (8, 8, 8))
    width: tuple[int, int] = (128, 256)
    hidden: int = 128
    encoder_blocks: tuple[int, int] = (3, 4)
    decoder_blocks: tuple[int, int, int] = (5, 4, 1)
    fine_width: int = 48

    def __post_init__(self) -> None:
        sizes = [n for digit in self.levels for n in digit]
        if not sizes or min(sizes) < 2 or max(sizes) > 4096 or len(sizes) > 64:
            raise ValueError(f"levels must be 1 to 64 numbers of 2 or more, got {self.levels}")
        if math.prod(sizes) > 2**31:
            raise ValueError(f"levels make {math.prod(sizes)} ids, more than 2^31: {self.levels}")
        widths = (*self.width, self.fine_width, self.hidden)
        blocks = (*self.encoder_blocks, *self.decoder_blocks)
        if len(widths) != 4 or len(blocks) != 5 or min(widths) < 1 or max(widths) > 4096:
            raise ValueError(f"width must be two numbers in 1..4096, got {self.width}")
        if min(blocks) < 0 or max(blocks) > 256:
            raise ValueError(f"numbers of blocks must lie in 0..256, got {blocks}")

    @property
    def factored(self) -> tuple[int, ...]:
        """Return the number of values of each digit, low digit first."""
        return tuple(math.prod(digit) for digit in self.levels)

    @property
    def channels(self) -> int:
        """Return C, the number of latent channels."""
        return sum(len(digit) for digit in self.levels)

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "FsqConfig":
        """Return the config that `to_json` wrote.

        Raises:
            TypeError, ValueError, KeyError: the values are not such a config.
        """
        levels = tuple(tuple(int(n) for n in digit) for digit in values["levels"])
        encoder = tuple(int(n) for n in values["encoder_blocks"])
        decoder = tuple(int(n) for n in values["decoder_blocks"])
        low, high = (int(n) for n in values["width"])
        if len(encoder) != 2 or len(decoder) != 3:
            raise ValueError(f"encoder_blocks takes two numbers and decoder_blocks three, got {values}")
        return cls(
            levels=levels,
            width=(low, high),
            hidden=int(values["hidden"]),
            encoder_blocks=(encoder[0], encoder[1]),
            decoder_blocks=(decoder[0], decoder[1], decoder[2]),
            fine_width=int(values["fine_width"]),
        )


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
