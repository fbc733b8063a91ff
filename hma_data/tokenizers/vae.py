"""`vae-8`: encode pictures to continuous latents, with weights that are inside the package.

A picture of 256×256 pixels gives latents of 4×32×32. The encoder is deterministic: the stored value is
the mean of the latent. The training recipe is recipes/tokenizer/vae.yaml.
"""

from pathlib import Path

import torch
from torch import Tensor

from hma_data.tokenizers.base import TokenizerSpec
from hma_data.tokenizers.catalog import EMBEDDED
from hma_data.tokenizers.checkpoints import fill
from hma_data.tokenizers.embedded import read_weights
from hma_data.tokenizers.fsq_network import PATCH
from hma_data.tokenizers.network import NetworkTokenizer, grid_of, open_device
from hma_data.tokenizers.vae_network import FORMAT, VaeAutoencoder, VaeConfig

WEIGHTS = EMBEDDED / "vae.safetensors"
VERSION = 1


def load(name: str, *, weights: str | None, device: str, image_size: int) -> NetworkTokenizer:
    """Return the tokenizer of that name; `hma_data.tokenizers.base.get_tokenizer` calls this.

    Raises:
        TokenizerError: the weights cannot be used, or there is no such device.
    """
    place = open_device(name, device)
    path = Path(weights).expanduser() if weights else WEIGHTS
    config, tensors, sha256 = read_weights(path, FORMAT, VaeConfig)
    with torch.device("meta"):
        network = VaeAutoencoder(config)
    fill(network, tensors, path)
    spec = TokenizerSpec(
        name=name,
        version=VERSION,
        kind="continuous",
        image_size=image_size,
        grid=grid_of(image_size, PATCH, path),
        channels=config.channels,
        latent_scale=config.latent_scale,
        dtype="float16",
        weights_sha256=sha256,
    )

    def decode(latents: Tensor) -> Tensor:
        return network.decoder(latents.contiguous(memory_format=torch.channels_last))

    return NetworkTokenizer(spec, network, place, network.encoder, decode, light=True)
