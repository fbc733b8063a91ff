"""State the shapes of the embedded networks, and read them from the files of weights.

The command that plans a conversion needs what a tokenizer is, not its network: nothing here imports torch.
"""

import math
import re
import sys
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from hma_data.arrays import Array
from hma_data.errors import TokenizerError
from hma_data.storage.files import file_sha256, opened_weights, read_json
from hma_data.storage.kinds import one_line
from hma_data.storage.paths import StrPath, as_text
from hma_data.tokenizers.base import TokenizerSpec, filtered, get_tokenizer, usable_entry
from hma_data.tokenizers.catalog import CATALOG, EMBEDDED

VERSION = 1
PATCH = 8
CELL = 2  # pixels a side of the square that is a token of a palette
MOST_COLORS = 255  # four of them fit 32 bits
_COLORS = "name a file of `hma tokenizer fit`, or a config.json or manifest.json with colours"
Width = Annotated[int, Field(ge=1, le=4096)]
Blocks = Annotated[int, Field(ge=0, le=256)]


class FsqConfig(BaseModel):
    """The network's shape, stored in the weights' file and stated by a recipe.

    Attributes:
        levels: number of levels of each digit's channels; `[[8, 8, 8], [8, 8, 8]]` is two digits of 512.
        width: channels at 1/8 and, if there are two, at 1/16 of the image's side; tokens lie at the last.
        hidden: channels inside the residual blocks at 1/8 and 1/16.
        encoder_blocks: residual blocks at each width.
        decoder_blocks: residual blocks at each width in reverse order, then at 1/4.
        fine_width: channels of the decoder at 1/4.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    format: ClassVar = "hma-fsq-1"

    levels: tuple[tuple[Annotated[int, Field(ge=2)], ...], ...] = ((8, 8, 8), (8, 8, 8))
    width: tuple[Width] | tuple[Width, Width] = (128, 256)
    hidden: Width = 128
    encoder_blocks: tuple[Blocks, ...] = (3, 4)
    decoder_blocks: tuple[Blocks, ...] = (5, 4, 1)
    fine_width: Width = 48

    @model_validator(mode="after")
    def _fit(self) -> "FsqConfig":
        count = len(self.width)
        if (len(self.encoder_blocks), len(self.decoder_blocks)) != (count, count + 1):
            raise ValueError(f"give {count} encoder_blocks and {count + 1} decoder_blocks for {count} widths")
        return self

    @field_validator("levels")
    @classmethod
    def _make_ids(cls, levels: tuple[tuple[int, ...], ...]) -> tuple[tuple[int, ...], ...]:
        count = math.prod(math.prod(digit) for digit in levels)
        if not 2 <= count <= 2**31:
            raise ValueError(f"levels make {count} ids; 2 to 2^31 are possible")
        return levels

    @property
    def stride(self) -> int:
        """Return the side of a token in pixels."""
        return PATCH * len(self.width)

    def spec(self, name: str, image_size: int, sha256: str) -> TokenizerSpec:
        """Return the spec of the tokenizer with these weights."""
        factored = tuple(math.prod(digit) for digit in self.levels)
        return TokenizerSpec.discrete(name, VERSION, image_size, self.stride, factored, weights_sha256=sha256)


class VaeConfig(BaseModel):
    """The network's shape, stored in the weights' file and stated by a recipe.

    Attributes:
        channels: number C of latent channels.
        width: channels at 1/8 of the image's side.
        hidden: channels inside the residual blocks at 1/8.
        encoder_blocks: residual blocks of the encoder.
        decoder_blocks: residual blocks of the decoder at 1/8 and at 1/4.
        fine_width: channels of the decoder at 1/4.
        noise: standard deviation of the noise that training adds to the latents.
        latent_scale: factor that brings the latents to unit variance; measured when training ends.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    format: ClassVar = "hma-vae-1"

    channels: Width = 4
    width: Width = 96
    hidden: Width = 96
    encoder_blocks: Blocks = 3
    decoder_blocks: tuple[Blocks, Blocks] = (5, 2)
    fine_width: Width = 48
    noise: float = Field(ge=0, lt=10, default=0.05)
    latent_scale: float = Field(gt=0, lt=1e4, default=1.0)

    def spec(self, name: str, image_size: int, sha256: str) -> TokenizerSpec:
        """Return the spec of the tokenizer with these weights."""
        facts = {"latent_scale": self.latent_scale, "weights_sha256": sha256}
        return TokenizerSpec.continuous(name, VERSION, image_size, PATCH, self.channels, **facts)


def read_shape[C: BaseModel](path: Path, form: str, config: type[C]) -> tuple[C, str]:
    """Read the network's shape from a weights' file; return it and its tokens' digest.

    The digest is the file's SHA-256, or that of the file whose encoder it kept.

    Raises:
        TokenizerError: there is no such file, or it is not safetensors, truncated, or of another network.
    """
    with opened_weights(path, TokenizerError) as file:
        metadata = file.metadata() or {}
    remedy = "take the file that `hma tokenizer train` writes, or leave --weights out"
    if metadata.get("format") != form:
        raise TokenizerError(
            path, f"does not hold {form} weights (format {metadata.get('format')!r})", remedy
        )
    try:
        shape = config.model_validate_json(metadata.get("config", ""))
    except ValueError as fault:
        text = f"its metadata does not describe the network: {one_line(fault)}"
        raise TokenizerError(path, text, remedy) from fault
    return shape, metadata.get("tokens_sha256") or file_sha256(path)


def read_colors(path: Path) -> NDArray[np.uint8]:
    """Return the colours (K, 3) in a file of `hma tokenizer fit`, a config.json, or a manifest.json.

    Raises:
        TokenizerError: the file holds something else.
    """
    if path.suffix == ".json":
        spec = read_json(path, TokenizerError).get("tokenizer")
        return parse_colors(spec.get("colors") if isinstance(spec, dict) else None, path)
    with opened_weights(path, TokenizerError) as file:
        held = file.keys()
        colors: Array = file.get_tensor("colors") if "colors" in held else np.zeros(0)
    if colors.dtype != np.uint8 or colors.shape[1:] != (3,) or not 2 <= len(colors) <= MOST_COLORS:
        text = f"its colours are {colors.dtype} {colors.shape}, not uint8 (2 to {MOST_COLORS}, 3)"
        raise TokenizerError(path, text, _COLORS)
    return colors


def parse_colors(text: Any, where: object) -> NDArray[np.uint8]:
    """Return the colours (K, 3) of a value of `TokenizerSpec.colors`; raise TokenizerError for another."""
    if not isinstance(text, str) or not re.fullmatch(f"([0-9a-f]{{6}}){{2,{MOST_COLORS}}}", text):
        fault = f"holds no colours: 2 to {MOST_COLORS} in hex, six digits each"
        raise TokenizerError(where, fault, _COLORS)
    return np.frombuffer(bytes.fromhex(text), np.uint8).reshape(-1, 3)


def palette_spec(name: str, image_size: int, colors: NDArray[np.uint8]) -> TokenizerSpec:
    """Return the spec of the tokenizer of these colours (K, 3)."""
    digits = (len(colors),) * CELL**2
    return TokenizerSpec.discrete(name, VERSION, image_size, CELL, digits, colors=colors.tobytes().hex())


def get_spec(name_or_path: StrPath, *, weights: StrPath | None = None) -> TokenizerSpec:
    """Return the spec of the tokenizer that `get_tokenizer` makes of the same arguments.

    Where torch is not loaded yet, it stays so: weights from inside the package are only looked at, others
    are opened in a process that ends.
    """
    entry = usable_entry(as_text(name_or_path))
    if entry.weights == "embedded" and weights is None and entry.name in CATALOG:
        if entry.name.startswith("palette"):
            colors = read_colors(EMBEDDED / entry.file)
            return filtered(palette_spec(entry.name, entry.image_size, colors), as_text(name_or_path))
        kind: type[FsqConfig | VaeConfig] = FsqConfig if entry.name.startswith("fsq") else VaeConfig
        shape, sha256 = read_shape(EMBEDDED / entry.file, kind.format, kind)
        return filtered(shape.spec(entry.name, entry.image_size, sha256), as_text(name_or_path))
    if "torch" in entry.imports and "torch" not in sys.modules:
        with suppress(BrokenProcessPool), ProcessPoolExecutor(1, get_context("spawn")) as apart:
            return apart.submit(_open_spec, name_or_path, weights).result()
        # a script that does not guard its entry: the workers say so
    return _open_spec(name_or_path, weights)


def _open_spec(name_or_path: StrPath, weights: StrPath | None) -> TokenizerSpec:
    return get_tokenizer(name_or_path, weights=weights).spec
