"""`vae-8`: encode pictures to continuous latents, with weights that are inside the package.

A picture of 256×256 pixels gives latents of 4×32×32. The encoder is deterministic: the stored value is
the mean of the latent. The training recipe is recipes/tokenizer/vae.yaml.

The network is a small convolutional autoencoder, built like that of `hma_data.tokenizers.fsq`: the
picture is first cut into 8×8 patches, and a linear code of those patches is added to the output of the
convolutions. The latents are about standard normal in each channel. Training adds a little noise to them,
so that similar latents decode to similar pictures.

B pictures, S side, C latent channels, S/8 the side of the grid. Pixels are in [-1, 1].
"""

from pathlib import Path

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn
from torch.nn import functional

from hma_data.tokenizers.base import TokenizerSpec
from hma_data.tokenizers.catalog import EMBEDDED
from hma_data.tokenizers.checkpoints import fill, read_weights
from hma_data.tokenizers.fsq import PATCH, Blocks, Width, stack
from hma_data.tokenizers.network import NetworkTokenizer, open_device

WEIGHTS = EMBEDDED / "vae.safetensors"
FORMAT = "hma-vae-1"
VERSION = 1


class VaeConfig(BaseModel):
    """The network's shape, stored in the weights' file and stated by a recipe.

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

    model_config = ConfigDict(extra="forbid", frozen=True)

    channels: Width = 4
    width: Width = 96
    hidden: Width = 96
    encoder_blocks: Blocks = 3
    decoder_blocks: tuple[Blocks, Blocks] = (5, 2)
    fine_width: Width = 48
    noise: float = Field(ge=0, lt=10, default=0.05)
    latent_scale: float = Field(gt=0, lt=1e4, default=1.0)


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

    format = FORMAT
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


def load(name: str, *, weights: str | None, device: str, image_size: int) -> NetworkTokenizer:
    """Return the tokenizer; `hma_data.tokenizers.base.get_tokenizer` states the arguments and the errors."""
    place = open_device(name, device)
    path = Path(weights).expanduser() if weights else WEIGHTS
    config, tensors, sha256 = read_weights(path, FORMAT, VaeConfig)
    with torch.device("meta"):
        network = VaeAutoencoder(config)
    fill(network, tensors, path)
    facts = {"latent_scale": config.latent_scale, "weights_sha256": sha256}
    spec = TokenizerSpec.continuous(name, VERSION, image_size, PATCH, config.channels, **facts)

    def decode(latents: Tensor) -> Tensor:
        return network.decoder(latents.contiguous(memory_format=torch.channels_last))

    return NetworkTokenizer(spec, network, place, network.encoder, decode, light=True)
