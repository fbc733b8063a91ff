"""Define the network of `vae-8`: a small convolutional autoencoder with 8 pixels a cell.

It is built like `hma_data.tokenizers.fsq_network`: the picture is first cut into 8×8 patches, and a
linear code of those patches is added to the output of the convolutions. The latents are about standard
normal in each channel. Training adds a little noise to them, so that similar latents decode to similar
pictures.

B pictures, S side, C latent channels, S/8 the side of the grid. Pixels are in [-1, 1].
"""

from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from hma_data.tokenizers.fsq_network import PATCH, stack

FORMAT = "hma-vae-1"


@dataclass(frozen=True)
class VaeConfig:
    """The network's shape, stored in the weights' file.

    Attributes:
        channels: number C of latent channels.
        width: channels at 1/8 of the picture's side.
        hidden: channels inside the residual blocks at 1/8.
        encoder_blocks: residual blocks of the encoder.
        decoder_blocks: residual blocks of the decoder at 1/8 and at 1/4.
        fine_width: channels of the decoder at 1/4.
        noise: standard deviation of the noise that training adds to the latents.
        latent_scale: factor that brings the latents to unit variance; measured when training ends.
    """

    channels: int = 4
    width: int = 96
    hidden: int = 96
    encoder_blocks: int = 3
    decoder_blocks: tuple[int, int] = (5, 2)
    fine_width: int = 48
    noise: float = 0.05
    latent_scale: float = 1.0

    def __post_init__(self) -> None:
        widths = (self.channels, self.width, self.hidden, self.fine_width)
        blocks = (self.encoder_blocks, *self.decoder_blocks)
        if min(widths) < 1 or max(widths) > 4096:
            raise ValueError(f"channels and widths must lie in 1..4096, got {widths}")
        if len(blocks) != 3 or min(blocks) < 0 or max(blocks) > 256:
            raise ValueError(f"numbers of blocks must be three in 0..256, got {blocks}")
        if not 0 <= self.noise < 10 or not 0 < self.latent_scale < 1e4:
            raise ValueError(
                f"noise and latent_scale must be small numbers, got {self.noise}, {self.latent_scale}"
            )

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "VaeConfig":
        """Return the config that `to_json` wrote.

        Raises:
            TypeError, ValueError, KeyError: the values are not such a config.
        """
        at8, at4 = (int(n) for n in values["decoder_blocks"])
        return cls(
            channels=int(values["channels"]),
            width=int(values["width"]),
            hidden=int(values["hidden"]),
            encoder_blocks=int(values["encoder_blocks"]),
            decoder_blocks=(at8, at4),
            fine_width=int(values["fine_width"]),
            noise=float(values["noise"]),
            latent_scale=float(values.get("latent_scale", 1.0)),
        )


class Encoder(nn.Module):
    """The encoder: (B, 3, S, S) pixels in [-1, 1] -> (B, C, S/8, S/8) latents, about standard normal."""

    def __init__(self, config: VaeConfig) -> None:
        super().__init__()
        self.stem = nn.Conv2d(3 * PATCH**2, config.width, 3, padding=1)
        self.at8 = stack(config.width, config.hidden, config.encoder_blocks)
        self.head = nn.Conv2d(config.width, config.channels, 1)
        self.linear = nn.Conv2d(3, config.channels, PATCH, stride=PATCH)

    def forward(self, pixels: Tensor) -> Tensor:
        x = self.at8(self.stem(functional.pixel_unshuffle(pixels, PATCH)))
        return self.head(x) + self.linear(pixels)


class Decoder(nn.Module):
    """The decoder: (B, C, h, w) latents -> (B, 3, 8h, 8w) pixels, about [-1, 1]."""

    def __init__(self, config: VaeConfig) -> None:
        super().__init__()
        at8, at4 = config.decoder_blocks
        fine = config.fine_width
        self.stem = nn.Conv2d(config.channels, config.width, 3, padding=1)
        self.at8 = stack(config.width, config.hidden, at8)
        self.up4 = nn.Conv2d(config.width, fine * 4, 1)
        self.at4 = stack(fine, fine, at4)
        self.head = nn.Conv2d(fine, 48, 3, padding=1)
        self.linear = nn.Conv2d(config.channels, 3 * PATCH**2, 1)

    def forward(self, latents: Tensor) -> Tensor:
        x = self.at8(self.stem(latents))
        x = self.at4(functional.pixel_shuffle(self.up4(x), 2))
        detail = functional.pixel_shuffle(self.head(functional.silu(x)), 4)
        return detail + functional.pixel_shuffle(self.linear(latents), PATCH)


class VaeAutoencoder(nn.Module):
    """An autoencoder of `encoder` and `decoder`; `forward` is the training pass."""

    stride = PATCH
    linear_gain = 1.0  # the decoder takes the latents unchanged

    def __init__(self, config: VaeConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = Encoder(config)
        self.decoder = Decoder(config)

    def forward(self, pixels: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return the reconstruction of (B, 3, S, S) pixels in [-1, 1], and their latents (B, C, h, w)."""
        latents = self.encoder(pixels)
        noise = torch.randn(latents.shape, generator=generator).to(latents.device)
        return self.decoder(latents + self.config.noise * noise), latents
