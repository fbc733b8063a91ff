"""Define the tokenizer interface: encode images to discrete ids or continuous latents, and decode them.

N images, h·w grid, c channels. Images are uint8 RGB (N, S, S, 3) with S = `spec.image_size`.
A module of this package makes one tokenizer or a family; `get_tokenizer` imports it on use.
"""

import json
import math
from collections.abc import Mapping
from copy import copy
from dataclasses import asdict, dataclass, field, replace
from importlib import import_module
from typing import Any, Literal, Protocol, cast, runtime_checkable

import numpy as np

from hma_data.arrays import Array, Images
from hma_data.episodes.images import Filter
from hma_data.errors import MissingDependencyError, TokenizerError
from hma_data.plugins import TOKENIZER_GROUP, installed
from hma_data.storage.files import short_sha256
from hma_data.storage.paths import StrPath, as_text
from hma_data.tokenizers.catalog import CATALOG, Entry, find_entry

OTHER = "name the weights of this tokenizer"  # remedy where a file holds something else


@dataclass(frozen=True)
class TokenizerSpec:
    """Everything that decides the meaning of the tokens. Two equal specs give the same tokens.

    Attributes:
        name: name that `get_tokenizer` takes.
        version: version of the code, raised when the same weights would give other tokens.
        kind: discrete ids or continuous latents.
        image_size: side of the square image in pixels.
        grid: (h, w) of the tokens or latents.
        vocab_size: number of ids; None when continuous.
        factored: sizes whose product is the vocabulary, low digit first: id = d0 + factored[0]*d1.
        channels: number c of latent channels; None when discrete.
        latent_scale: factor by which a model multiplies stored latents.
        dtype: dtype of the stored values: uint16, uint32 or float16; uint8 for pixels.
        resize_filter: filter that resizes images to `image_size`; it is part of the spec because it
            changes the tokens.
        weights_sha256: SHA-256 of the weights' file, or of the file whose encoder it kept; empty when there
            are no weights.
        colors: of a palette, six hex digits each, in the order of the digits' values; else empty.
    """

    name: str
    version: int
    kind: Literal["discrete", "continuous"]
    image_size: int
    grid: tuple[int, int]
    vocab_size: int | None = None
    factored: tuple[int, ...] = field(default=())
    channels: int | None = None
    latent_scale: float = 1.0
    dtype: str = "uint32"
    resize_filter: Filter = "area"
    weights_sha256: str = ""
    colors: str = ""

    @classmethod
    def discrete(
        cls, name: str, version: int, size: int, stride: int, factored: tuple[int, ...], **values: Any
    ) -> "TokenizerSpec":
        """Return the spec of a tokenizer that makes ids of digits `factored` from cells of stride² pixels."""
        grid, vocab_size = (size // stride, size // stride), math.prod(factored)
        return cls(name, version, "discrete", size, grid, vocab_size, factored, **values)

    @classmethod
    def continuous(
        cls, name: str, version: int, size: int, stride: int, channels: int, **values: Any
    ) -> "TokenizerSpec":
        """Return the spec of a tokenizer that makes float16 latents from cells of stride² pixels."""
        grid, values = (size // stride, size // stride), {"dtype": "float16", **values}
        return cls(name, version, "continuous", size, grid, channels=channels, **values)

    def to_json(self) -> dict[str, Any]:
        """Return plain values, as the manifest and the checkpoint hold them, with the colours if any."""
        values = json.loads(json.dumps(asdict(self)))
        return values if self.colors else {key: one for key, one in values.items() if key != "colors"}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "TokenizerSpec":
        """Return the spec that `to_json` wrote."""
        return cls(
            **{**values, "grid": tuple(values["grid"]), "factored": tuple(values.get("factored") or ())}
        )

    @property
    def cells(self) -> tuple[int, ...]:
        """Return the shape of an image's ids, (h, w), or of its latents, (c, h, w)."""
        return self.grid if self.kind == "discrete" else (self.channels or 0, *self.grid)

    @property
    def weights_digest(self) -> str:
        """Return twelve hex digits of the SHA-256 of the weights, or of the colours; empty for neither."""
        return self.weights_sha256[:12] or (short_sha256(self.colors, 12) if self.colors else "")

    @property
    def digest(self) -> str:
        """Return sixteen hex digits of the SHA-256 over all attributes."""
        return short_sha256(json.dumps(self.to_json(), sort_keys=True))


@runtime_checkable
class Tokenizer(Protocol):
    """An object with `spec`, `encode` and `decode`.

    A tokenizer with a network exposes it as `.network`, with `.network.encoder` and `.network.decoder`.
    """

    spec: TokenizerSpec

    def encode(self, frames: Images) -> Array:
        """Encode (N, S, S, 3) uint8 RGB to (N, h, w) uint32 ids, or to (N, c, h, w) float16 latents."""

    def decode(self, tokens: Array) -> Images:
        """Decode what `encode` returns to (N, S, S, 3) uint8 RGB."""


def get_tokenizer(name_or_path: StrPath, *, weights: StrPath | None = None, device: str = "cpu") -> Tokenizer:
    """Return the tokenizer of that name, ready to use: `load` of its module makes it.

    Args:
        name_or_path: a name of `hma tokenizer list`; `NAME:FILTER` gives its spec another `resize_filter`.
        weights: str or path of a file (or folder) to take the weights from instead of the usual place, or
            `hf://[datasets/]ORGANISATION/NAME[@REVISION]/FILE`.
        device: device that runs the network: cpu, cuda, mps.

    Raises:
        TokenizerError: there is no such tokenizer, or its weights cannot be used.
        MissingDependencyError: a package that it needs is not installed.
        PluginError: the package that adds it is broken.
    """
    return _opened(as_text(name_or_path), None if weights is None else as_text(weights), device)


def reopened(spec: Mapping[str, Any], device: str = "cpu") -> Tokenizer:
    """Return the tokenizer of a spec's values, as in a checkpoint; raise as `get_tokenizer`.

    A palette is made of the colours in the spec. No file is opened that a spec names.
    """
    return _opened(full_name(spec), None, device, spec.get("colors"))


def _opened(name: str, weights: str | None, device: str, colors: Any = None) -> Tokenizer:
    entry = usable_entry(name)
    keywords = {"weights": weights, "device": device, **entry.arguments}
    if "colors" in keywords:
        keywords["colors"] = colors
    if entry.name in CATALOG:
        tokenizer: Tokenizer = import_module(entry.module).load(entry.name, **keywords)
    else:
        tokenizer = _of_package(entry, keywords)
    spec = filtered(tokenizer.spec, name)
    if spec != tokenizer.spec:  # the filter is applied before `encode`, so only the spec states it
        tokenizer = copy(tokenizer)
        tokenizer.spec = spec
    return tokenizer


def filtered(spec: TokenizerSpec, name: str) -> TokenizerSpec:
    """Return the spec with the filter in which a tokenizer's name ends, if it ends in one."""
    return replace(spec, resize_filter=cast(Filter, name.partition(":")[2] or spec.resize_filter))


def full_name(spec: Mapping[str, Any]) -> str:
    """Return the name, with its filter, by which `get_tokenizer` makes the tokenizer of a spec's values."""
    return f"{spec['name']}:{spec.get('resize_filter', 'area')}"


def usable_entry(name: str) -> Entry:
    """Return the entry of that name; raise if there is none, or if a package that it needs is missing."""
    entry = find_entry(name)
    if missing := entry.missing():
        raise MissingDependencyError(name, f"needs {', '.join(missing)}", entry.extra)
    return entry


def _of_package(entry: Entry, keywords: dict[str, Any]) -> Tokenizer:
    """Return the tokenizer that an installed package adds; raise PluginError if the package is broken."""
    plugin = installed(TOKENIZER_GROUP)[entry.name]
    module = plugin.call(f"importing {entry.module}", import_module, entry.module)
    tokenizer = plugin.call("load()", lambda: module.load(entry.name, **keywords))
    if not isinstance(tokenizer, Tokenizer) or not isinstance(tokenizer.spec, TokenizerSpec):
        kind = type(tokenizer).__name__
        raise plugin.broken(f"load() returns {kind}, not a hma_data.tokenizers.base.Tokenizer")
    if tokenizer.spec.name != entry.name:
        raise plugin.broken(f"its spec is named {tokenizer.spec.name!r}, not {entry.name!r}")
    return tokenizer


def check_frames(frames: Array, spec: TokenizerSpec) -> None:
    """Raise TokenizerError unless frames are (N, S, S, 3) uint8."""
    size = spec.image_size
    if frames.ndim != 4 or frames.shape[1:] != (size, size, 3) or frames.dtype != np.uint8:
        raise TokenizerError(
            spec.name,
            f"takes uint8 images (N, {size}, {size}, 3), was given {frames.dtype} {tuple(frames.shape)}",
            "resize with hma_data.episodes.images.resize",
        )


def check_tokens(tokens: Array, spec: TokenizerSpec) -> None:
    """Raise TokenizerError unless tokens have the grid of `spec`, and are ids of its vocabulary or finite."""
    kind = {"float16": np.floating, "uint8": np.uint8}.get(spec.dtype, np.integer)
    if tokens.shape[1:] != spec.cells or not np.issubdtype(tokens.dtype, kind):
        form = f"{spec.dtype} (N, {', '.join(map(str, spec.cells))})"
        raise TokenizerError(spec.name, f"decodes {form}, was given {tokens.dtype} {tokens.shape}")
    if not np.isfinite(tokens).all():
        raise TokenizerError(spec.name, "decodes finite latents, was given others")
    if spec.vocab_size and tokens.size and (int(tokens.max()) >= spec.vocab_size or int(tokens.min()) < 0):
        raise TokenizerError(
            spec.name,
            f"ids must be in 0..{spec.vocab_size - 1}, but these are in {tokens.min()}..{tokens.max()}",
        )
