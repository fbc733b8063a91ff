"""`fsq-16` and `fsq-8`: the embedded tokenizer, its weights inside the package.

One network and one file of weights serve both: 16 pixels a token, 18 bits a token, at 256×256
(16×16 tokens) and at 128×128 (8×8 tokens). How it was trained: recipes/tokenizer/fsq.yaml.
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
from hma_data.tokenizers.fsq_network import FORMAT, STRIDE, FsqAutoencoder, FsqConfig

WEIGHTS = EMBEDDED / "fsq.safetensors"
VERSION = 1


class FsqTokenizer:
    """Discrete tokens of square pictures; see `hma_data.tokenizers.base.Tokenizer`.

    Attributes:
        spec: what decides the tokens.
        network: `encoder`, `quantizer`, `decoder` (torch modules, evaluation mode).
        micro_batch: frames a pass through the network.
    """

    def __init__(self, spec: TokenizerSpec, network: FsqAutoencoder, device: torch.device) -> None:
        self.spec, self.network, self.device = spec, network, device
        self.micro_batch = micro_batch(spec.image_size, device)

    @torch.inference_mode()
    def encode(self, frames: NDArray[np.uint8]) -> NDArray[np.uint32]:
        """(N, S, S, 3) uint8 RGB -> (N, S/16, S/16) uint32 ids.

        Raises:
            TokenizerError: frames of another shape or dtype.
        """
        check_frames(frames, self.spec)
        ids = np.empty((len(frames), *self.spec.grid), np.uint32)
        run_in_passes(self._ids, frames, ids, self.micro_batch, self.device)
        return ids

    @torch.inference_mode()
    def decode(self, tokens: NDArray[Any]) -> NDArray[np.uint8]:
        """(N, S/16, S/16) ids of any integer dtype -> (N, S, S, 3) uint8 RGB.

        Raises:
            TokenizerError: another grid, no integers, or ids outside the vocabulary.
        """
        check_tokens(tokens, self.spec)
        size = self.spec.image_size
        frames = np.empty((len(tokens), size, size, 3), np.uint8)
        run_in_passes(self._frames, tokens.astype(np.int64), frames, self.micro_batch, self.device)
        return frames

    def _ids(self, frames: Tensor) -> Tensor:
        quantizer = self.network.quantizer
        return quantizer.to_ids(quantizer.to_levels(self.network.encoder(to_pixels(frames))))

    def _frames(self, ids: Tensor) -> Tensor:
        quantizer = self.network.quantizer
        codes = quantizer.from_levels(quantizer.to_digits(ids))
        return to_frames(self.network.decoder(codes.contiguous(memory_format=torch.channels_last)))


def load(name: str, *, weights: str | None, device: str, image_size: int) -> FsqTokenizer:
    """The tokenizer of that name; `hma_data.tokenizers.base.get_tokenizer` calls this.

    Raises:
        TokenizerError: the weights cannot be used, or there is no such device.
    """
    path = Path(weights).expanduser() if weights else WEIGHTS
    config, tensors, sha256 = read_weights(path, FORMAT, FsqConfig)
    network, place = FsqAutoencoder(config), open_device(name, device)
    load_network(network, tensors, path, place)
    spec = TokenizerSpec(
        name=name,
        version=VERSION,
        kind="discrete",
        image_size=image_size,
        grid=(image_size // STRIDE, image_size // STRIDE),
        vocab_size=int(np.prod(config.factored)),
        factored=config.factored,
        dtype="uint32",
        weights_sha256=sha256,
    )
    return FsqTokenizer(spec, network, place)
