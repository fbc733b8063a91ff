"""`cosmos-di16` and `cosmos-ci16`: run NVIDIA's image tokenizers from TorchScript files.

A `.jit` file is a program, not a table of numbers. It can do everything that TorchScript's operators
can do, which includes reading and writing files. For that reason there is no default download: the
user names files that the user trusts (`encoder.jit` and `decoder.jit`, or the folder that holds
both). Their SHA-256 is recorded in the spec and in every shard.

Both take 256×256 pictures to a 16×16 grid. `di16`: 64,000 ids, finite scalar quantisation with levels
(8, 8, 8, 5, 5, 5), the first lowest, so two digits of 512 and 125. `ci16`: latents of 16 channels.
"""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hma_data.errors import TokenizerError
from hma_data.tokenizers.base import TokenizerSpec
from hma_data.tokenizers.checkpoints import digest_of, find_weights, pair_of
from hma_data.tokenizers.network import NetworkTokenizer, open_device

VERSION = 1
IMAGE_SIZE = 256
SIDE = 16
CHANNELS = 16
DIGITS = (8 * 8 * 8, 5 * 5 * 5)
REMEDY = "name the folder with the encoder.jit and decoder.jit of NVIDIA's release"


class CosmosNetwork(nn.Module):
    """A network of `encoder` and `decoder`, each a TorchScript program."""

    def __init__(self, encoder: nn.Module, decoder: nn.Module) -> None:
        super().__init__()
        self.encoder, self.decoder = encoder, decoder


def find_files(path: Path) -> list[Path]:
    """Return the encoder's and the decoder's file, given the folder or one of the two files.

    Raises:
        TokenizerError: one of them is not there.
    """
    files = pair_of(path / "encoder.jit" if path.is_dir() else path)
    if not files:
        raise TokenizerError(path, "is named after neither encoder nor decoder", REMEDY)
    return files


def read_program(path: Path) -> torch.jit.ScriptModule:
    """Load a TorchScript file. Loading trusts the file: see the module's docstring.

    Raises:
        TokenizerError: the file is not a TorchScript archive, or is truncated.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            scripted = any("/code/" in name for name in archive.namelist())
    except (zipfile.BadZipFile, OSError) as fault:
        raise TokenizerError(path, f"is no whole TorchScript file: {fault}", "fetch it again") from fault
    if not scripted:
        raise TokenizerError(path, "is a torch checkpoint, not a TorchScript program", REMEDY)
    try:
        program: torch.jit.ScriptModule = torch.jit.load(str(path), map_location="cpu")
    except (RuntimeError, ValueError, EOFError) as fault:
        text = " ".join(str(fault).split())[:160]
        raise TokenizerError(path, f"cannot be loaded as TorchScript: {text}", "fetch it again") from fault
    return program


def _first(made: object) -> Tensor:
    """Return the first output of a program: the ids, latents or pixels; the rest are codes and losses."""
    value = made[0] if isinstance(made, tuple | list) and made else made
    if not isinstance(value, Tensor):
        raise TypeError(f"it gives a {type(value).__name__}")
    return value


def _try(tokenizer: NetworkTokenizer, files: list[Path]) -> None:
    """Encode and decode one grey picture, so that programs of other tokenizers are refused at once."""
    grey: NDArray[Any] = np.full((1, IMAGE_SIZE, IMAGE_SIZE, 3), 127, np.uint8)
    for file, half in zip(files, (tokenizer.encode, tokenizer.decode), strict=True):
        try:
            grey = half(grey)
        except (RuntimeError, ValueError, TypeError, IndexError) as fault:
            text = " ".join(str(fault).split())[-160:]
            raise TokenizerError(
                file, f"does not do what {tokenizer.spec.name} does: {text}", REMEDY
            ) from fault


def load(name: str, *, weights: str | None, device: str) -> NetworkTokenizer:
    """Return the tokenizer; `hma_data.tokenizers.base.get_tokenizer` calls this.

    Args:
        weights: the folder of `encoder.jit` and `decoder.jit`, or one of them. They are trusted: see the
            module's docstring.

    Raises:
        TokenizerError: the files cannot be used, or there is no such device.
    """
    place = open_device(name, device)
    files = find_files(find_weights(name, weights))
    encoder, decoder = (read_program(file) for file in files)
    discrete = name == "cosmos-di16"
    spec = TokenizerSpec(
        name=name,
        version=VERSION,
        kind="discrete" if discrete else "continuous",
        image_size=IMAGE_SIZE,
        grid=(SIDE, SIDE),
        vocab_size=DIGITS[0] * DIGITS[1] if discrete else None,
        factored=DIGITS if discrete else (),
        channels=None if discrete else CHANNELS,
        dtype="uint16" if discrete else "float16",
        weights_sha256=digest_of(files),
    )
    cells = (SIDE, SIDE) if discrete else (CHANNELS, SIDE, SIDE)

    def encode(pixels: Tensor) -> Tensor:
        # The optimiser rewrites a program after its first runs, which may change the last bits.
        with torch.jit.optimized_execution(place.type != "cpu"):
            made = _first(encoder(pixels))
        if tuple(made.shape[1:]) != cells or made.is_floating_point() == discrete:
            raise ValueError(f"it gives {made.dtype} {tuple(made.shape[1:])}, not {cells}")
        return made

    def decode(tokens: Tensor) -> Tensor:
        made = _first(decoder(tokens))
        if tuple(made.shape[1:]) != (3, IMAGE_SIZE, IMAGE_SIZE):
            raise ValueError(f"it gives {tuple(made.shape[1:])}")
        return made

    tokenizer = NetworkTokenizer(spec, CosmosNetwork(encoder, decoder), place, encode, decode)
    _try(tokenizer, files)
    return tokenizer
