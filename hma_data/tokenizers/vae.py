"""`vae-8`: continuous latents without a download, 4×32×32 for a picture of 256², weights in the package.

The encoder is deterministic: what is stored is the latent's mean. How it was trained:
recipes/tokenizer/vae.yaml.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hma_data.tokenizers.base import TokenizerSpec, check_frames, check_tokens
from hma_data.tokenizers.catalog import EMBEDDED
from hma_data.tokenizers.embedded import (
    load_network,
    micro_batch,
    open_device,
    read_weights,
    run_in_passes,
    to_frames,
    to_pixels,
)
from hma_data.tokenizers.fsq_network import PATCH
from hma_data.tokenizers.vae_network import FORMAT, VaeAutoencoder, VaeConfig

WEIGHTS = EMBEDDED / "vae.safetensors"
VERSION = 1


class VaeTokenizer:
    """Continuous latents of square pictures; see `hma_data.tokenizers.base.Tokenizer`.

    Attributes:
        spec: what decides the latents.
        network: `encoder`, `decoder` (torch modules, evaluation mode).
        micro_batch: frames a pass through the network.
    """

    def __init__(self, spec: TokenizerSpec, network: VaeAutoencoder, device: torch.device) -> None:
        self.spec, self.network, self.device = spec, network, device
        self.micro_batch = micro_batch(spec.image_size, device)

    @torch.inference_mode()
    def encode(self, frames: NDArray[np.uint8]) -> NDArray[np.float16]:
        """(N, S, S, 3) uint8 RGB -> (N, C, S/8, S/8) float16 latents.

        Raises:
            TokenizerError: frames of another shape or dtype.
        """
        check_frames(frames, self.spec)
        latents = np.empty((len(frames), self.spec.channels or 0, *self.spec.grid), np.float16)
        run_in_passes(self._latents, frames, latents, self.micro_batch, self.device)
        return latents

    @torch.inference_mode()
    def decode(self, tokens: NDArray[Any]) -> NDArray[np.uint8]:
        """(N, C, S/8, S/8) latents of any float dtype -> (N, S, S, 3) uint8 RGB.

        Raises:
            TokenizerError: another shape.
        """
        check_tokens(tokens, self.spec)
        size = self.spec.image_size
        frames = np.empty((len(tokens), size, size, 3), np.uint8)
        run_in_passes(self._frames, tokens.astype(np.float32), frames, self.micro_batch, self.device)
        return frames

    def _latents(self, frames: Tensor) -> Tensor:
        return self.network.encoder(to_pixels(frames)).half()

    def _frames(self, latents: Tensor) -> Tensor:
        return to_frames(self.network.decoder(latents.contiguous(memory_format=torch.channels_last)))


def load(name: str, *, weights: str | None, device: str, image_size: int) -> VaeTokenizer:
    """The tokenizer of that name; `hma_data.tokenizers.base.get_tokenizer` calls this.

    Raises:
        TokenizerError: the weights cannot be used, or there is no such device.
    """
    path = Path(weights).expanduser() if weights else WEIGHTS
    config, tensors, sha256 = read_weights(path, FORMAT, VaeConfig)
    network, place = VaeAutoencoder(config), open_device(name, device)
    load_network(network, tensors, path, place)
    spec = TokenizerSpec(
        name=name,
        version=VERSION,
        kind="continuous",
        image_size=image_size,
        grid=(image_size // PATCH, image_size // PATCH),
        channels=config.channels,
        latent_scale=config.latent_scale,
        dtype="float16",
        weights_sha256=sha256,
    )
    return VaeTokenizer(spec, network, place)
