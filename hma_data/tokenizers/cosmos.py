"""`cosmos-di16` and `cosmos-ci16`: run NVIDIA's image tokenizers from TorchScript files.

A `.jit` file is a program, not a table of numbers. It can do everything that TorchScript's operators
can do, which includes reading and writing files. For that reason there is no default download: the
user names files that the user trusts (`encoder.jit` and `decoder.jit`, or the folder that holds
both). Their SHA-256 is recorded in the spec and in every shard.

Both take 256×256 images to a 16×16 grid. `di16`: 64,000 ids, finite scalar quantisation with levels
(8, 8, 8, 5, 5, 5), the first lowest, so two digits of 512 and 125. `ci16`: latents of 16 channels.
"""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from hma_data.arrays import Array
from hma_data.errors import TokenizerError
from hma_data.storage.kinds import one_line
from hma_data.tokenizers.base import TokenizerSpec
from hma_data.tokenizers.checkpoints import digest_of, find_weights, pair_of
from hma_data.tokenizers.network import NetworkTokenizer, open_device

VERSION = 1
IMAGE_SIZE = 256
STRIDE = 16
CHANNELS = 16
DIGITS = (8 * 8 * 8, 5 * 5 * 5)
REMEDY = "name the folder with the encoder.jit and decoder.jit of NVIDIA's release"


def _read_program(path: Path) -> torch.jit.ScriptModule:
    """Load a TorchScript file, which is trusted; raise TokenizerError if it is no whole program."""
    try:
        return torch.jit.load(str(path), map_location="cpu")
    except (RuntimeError, ValueError, EOFError) as fault:
        text = f"cannot be loaded as TorchScript: {one_line(fault)}"
        raise TokenizerError(path, text, REMEDY) from fault


def _output(made: object, shape: tuple[int, ...]) -> Tensor:
    """Return the first output of a program, the ids, latents or pixels; the others are codes and losses."""
    value = made[0] if isinstance(made, tuple | list) and made else made
    if not isinstance(value, Tensor) or tuple(value.shape[1:]) != shape:
        raise ValueError(f"it does not give values of shape {shape}")
    return value


def _try(tokenizer: NetworkTokenizer, files: list[Path]) -> None:
    """Encode and decode one grey image, so that programs of other tokenizers are refused at once."""
    values: Array = np.full((1, IMAGE_SIZE, IMAGE_SIZE, 3), 127, np.uint8)
    for file, half in zip(files, (tokenizer.encode, tokenizer.decode), strict=True):
        try:
            values = half(values)
        except (RuntimeError, ValueError) as fault:
            text = f"does not do what {tokenizer.spec.name} does: {' '.join(str(fault).split())[-160:]}"
            raise TokenizerError(file, text, REMEDY) from fault


def load(name: str, *, weights: str | None, device: str) -> NetworkTokenizer:
    """Return the tokenizer; `hma_data.tokenizers.base.get_tokenizer` states the arguments and the errors.

    Args:
        weights: the folder of `encoder.jit` and `decoder.jit`, or one of them. They are trusted: see the
            module's docstring.
    """
    place = open_device(name, device)
    path = find_weights(name, weights)
    files = pair_of(path / "encoder.jit" if path.is_dir() else path)
    if not files:
        raise TokenizerError(path, "is named after neither encoder nor decoder", REMEDY)
    network = nn.Module()
    network.encoder, network.decoder = encoder, decoder = [_read_program(file) for file in files]
    facts = {"weights_sha256": digest_of(files)}
    if name == "cosmos-di16":
        spec = TokenizerSpec.discrete(name, VERSION, IMAGE_SIZE, STRIDE, DIGITS, dtype="uint16", **facts)
    else:
        spec = TokenizerSpec.continuous(name, VERSION, IMAGE_SIZE, STRIDE, CHANNELS, **facts)

    def encode(pixels: Tensor) -> Tensor:
        # The optimiser rewrites a program after its first runs, which may change the last bits.
        with torch.jit.optimized_execution(place.type != "cpu"):
            return _output(encoder(pixels), spec.cells)

    def decode(tokens: Tensor) -> Tensor:
        return _output(decoder(tokens), (3, IMAGE_SIZE, IMAGE_SIZE))

    tokenizer = NetworkTokenizer(spec, network, place, encode, decode)
    _try(tokenizer, files)
    return tokenizer
