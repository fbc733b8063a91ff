"""`fsq-16` and `fsq-8`: encode pictures to discrete ids, with weights that are inside the package.

One network and one file of weights serve both. A token covers 16×16 pixels and has 18 bits.
`fsq-16` takes 256×256 pictures (16×16 tokens), `fsq-8` takes 128×128 pictures (8×8 tokens).
The training recipe is recipes/tokenizer/fsq.yaml.
"""

import math
from pathlib import Path

import torch
from torch import Tensor

from hma_data.tokenizers.base import TokenizerSpec
from hma_data.tokenizers.catalog import EMBEDDED
from hma_data.tokenizers.checkpoints import fill
from hma_data.tokenizers.embedded import read_weights
from hma_data.tokenizers.fsq_network import FORMAT, STRIDE, FsqAutoencoder, FsqConfig, Quantizer
from hma_data.tokenizers.network import NetworkTokenizer, grid_of, open_device

WEIGHTS = EMBEDDED / "fsq.safetensors"
VERSION = 1


def load(name: str, *, weights: str | None, device: str, image_size: int) -> NetworkTokenizer:
    """Return the tokenizer of that name; `hma_data.tokenizers.base.get_tokenizer` calls this.

    Its `.network` has `encoder`, `quantizer` and `decoder`.

    Raises:
        TokenizerError: the weights cannot be used, or there is no such device.
    """
    place = open_device(name, device)
    path = Path(weights).expanduser() if weights else WEIGHTS
    config, tensors, sha256 = read_weights(path, FORMAT, FsqConfig)
    with torch.device("meta"):
        network = FsqAutoencoder(config)
    quantizer = network.quantizer = Quantizer(config)  # its buffers are not in the weights' file
    fill(network, tensors, path)
    spec = TokenizerSpec(
        name=name,
        version=VERSION,
        kind="discrete",
        image_size=image_size,
        grid=grid_of(image_size, STRIDE, path),
        vocab_size=math.prod(config.factored),
        factored=config.factored,
        dtype="uint32",
        weights_sha256=sha256,
    )

    def encode(pixels: Tensor) -> Tensor:
        return quantizer.to_ids(quantizer.to_levels(network.encoder(pixels)))

    def decode(ids: Tensor) -> Tensor:
        codes = quantizer.from_levels(quantizer.to_digits(ids))
        return network.decoder(codes.contiguous(memory_format=torch.channels_last))

    return NetworkTokenizer(spec, network, place, encode, decode, light=True)
