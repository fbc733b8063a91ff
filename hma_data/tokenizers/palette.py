"""`palette-64`: a token is the colours of 2×2 pixels, each the nearest one of a short list.

Edges stay as sharp as the pixels, and a model that chooses among colours cannot mix two: in a long rollout a
guess does not fade to grey. The list is for clean images of few colours, as simulators draw them, not for
photographs; `fit` makes one of other images. The embedded list is that of the laboratory's robots.

B images, S pixels a side, h·w grid, K colours. Pixels inside the network are in [-1, 1].
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import save
from torch import Tensor, nn

from hma_data.arrays import Array, Images
from hma_data.errors import TokenizerError
from hma_data.storage.files import write_atomic
from hma_data.tokenizers.base import TokenizerSpec
from hma_data.tokenizers.catalog import CATALOG, EMBEDDED
from hma_data.tokenizers.checkpoints import find_weights
from hma_data.tokenizers.network import NetworkTokenizer, open_device
from hma_data.tokenizers.shapes import CELL, MOST_COLORS, palette_spec, parse_colors, read_colors

BITS = 5  # of a channel in the table of nearest colours
ROUNDS = 40  # of k-means
AT_ONCE = 2**16  # colours whose distances to all centres are in memory


class Nearest(nn.Module):
    """The encoder: pixels (B, 3, S, S) -> ids (B, h, w), by a table of colours in steps of 8."""

    table: Tensor
    worth: Tensor

    def __init__(self, colors: Tensor) -> None:
        super().__init__()
        steps = (torch.arange(2**BITS) + 0.5) * 2 ** (8 - BITS)
        places = torch.cartesian_prod(steps, steps, steps)
        self.register_buffer("table", torch.cdist(places, colors.float()).argmin(1))
        self.register_buffer("worth", len(colors) ** torch.arange(CELL**2))

    def forward(self, pixels: Tensor) -> Tensor:
        steps = pixels.add(1).mul(127.5).round().long() >> (8 - BITS)
        digits = self.table[(steps[:, 0] << 2 * BITS) | (steps[:, 1] << BITS) | steps[:, 2]]
        squares = digits.unflatten(2, (-1, CELL)).unflatten(1, (-1, CELL)).transpose(2, 3)
        return (squares.flatten(3) * self.worth).sum(-1)


class Shown(nn.Module):
    """The decoder: ids (B, h, w) -> pixels (B, 3, S, S)."""

    colors: Tensor
    worth: Tensor

    def __init__(self, colors: Tensor) -> None:
        super().__init__()
        self.register_buffer("colors", colors.float() / 127.5 - 1)
        self.register_buffer("worth", len(colors) ** torch.arange(CELL**2))

    def forward(self, ids: Tensor) -> Tensor:
        digits = ids.unsqueeze(-1) // self.worth % len(self.colors)
        squares = digits.unflatten(3, (CELL, CELL)).transpose(2, 3)
        return self.colors[squares.flatten(3, 4).flatten(1, 2)].permute(0, 3, 1, 2)


class Palette(NetworkTokenizer):
    """The tokenizer. On a CPU it looks colours up itself: the same bytes in a fraction of the time."""

    def __init__(self, spec: TokenizerSpec, colors: NDArray[np.uint8], device: torch.device) -> None:
        network, values = nn.Module(), torch.from_numpy(colors.copy())
        network.encoder, network.decoder = nearest, shown = Nearest(values), Shown(values)
        self._colors, self._table = colors, nearest.table.numpy().astype(np.uint8)
        self._worth = [len(colors) ** place for place in range(CELL**2)]
        super().__init__(spec, network, device, nearest, shown, light=True)
        self.batch = 16 if device.type == "cpu" else self.batch

    def _encode_batch(self, frames: Images) -> Array:
        if self.device.type != "cpu":
            return super()._encode_batch(frames)
        red, green, blue = np.moveaxis(frames >> (8 - BITS), -1, 0).astype(np.uint16)
        digits = self._table[red << 2 * BITS | green << BITS | blue].astype(self.spec.dtype)
        tokens = np.zeros((len(frames), *self.spec.cells), self.spec.dtype)
        for place, worth in enumerate(self._worth):
            row, column = divmod(place, CELL)
            tokens += digits[:, row::CELL, column::CELL] * worth
        return tokens

    def _decode_batch(self, tokens: Array) -> Images:
        if self.device.type != "cpu":
            return super()._decode_batch(tokens)
        size = self.spec.image_size
        frames = np.empty((len(tokens), size, size, 3), np.uint8)
        for place, worth in enumerate(self._worth):
            row, column = divmod(place, CELL)
            frames[:, row::CELL, column::CELL] = self._colors[tokens // worth % len(self._colors)]
        return frames


def load(name: str, *, weights: str | None, device: str, image_size: int, colors: Any) -> NetworkTokenizer:
    """Return the tokenizer; `hma_data.tokenizers.base.get_tokenizer` states the arguments and the errors.

    Args:
        weights: a file that `read_colors` reads.
        colors: those of a spec, as `TokenizerSpec.colors`, instead of a file.
    """
    place = open_device(name, device)
    if colors:
        chosen = parse_colors(colors, name)
    else:
        chosen = read_colors(find_weights(name, weights) if weights else EMBEDDED / CATALOG[name].file)
    return Palette(palette_spec(name, image_size, chosen), chosen, place)


def write(path: Path, colors: NDArray[np.uint8]) -> None:
    """Write colours (K, 3) as a file that `weights=` takes."""
    write_atomic(path, save({"colors": colors}))


def fit(films: Iterable[Images], count: int = MOST_COLORS) -> NDArray[np.uint8]:
    """Return at most `count` colours (K, 3) for films (N, S, S, 3), by k-means.

    Each different colour counts by the fourth root of its pixels, so that small objects keep theirs. The
    search begins at the commonest colour, and at those that are far from the ones before.

    Raises:
        TokenizerError: the films have fewer than two colours.
    """
    pixels = np.zeros(2**24, np.int64)  # of each colour there is
    for film in films:
        red, green, blue = film.reshape(-1, 3).T.astype(np.int64)
        np.add.at(pixels, red << 16 | green << 8 | blue, 1)
    values = np.flatnonzero(pixels)
    if len(values) < 2:
        raise TokenizerError("images", "show fewer than two colours", "name images of the robot's scene")
    colors = np.stack([values >> 16, values >> 8 & 255, values & 255], axis=1).astype(np.float32)
    weights, centres = pixels[values] ** 0.25, colors[pixels[values].argmax()][None]
    nearest = ((colors - centres) ** 2).sum(1)
    while len(centres) < min(count, len(colors)):
        centres = np.concatenate([centres, colors[[(nearest * weights).argmax()]]])
        nearest = np.minimum(nearest, ((colors - centres[-1]) ** 2).sum(1))
    for _ in range(ROUNDS):
        parts = torch.from_numpy(colors).split(AT_ONCE)
        own = torch.cat([torch.cdist(part, torch.from_numpy(centres)).argmin(1) for part in parts]).numpy()
        total = np.bincount(own, weights, len(centres))[:, None]
        sums = np.stack([np.bincount(own, weights * colors[:, axis], len(centres)) for axis in range(3)], 1)
        centres = np.where(total > 0, sums / np.maximum(total, 1e-9), centres).astype(np.float32)
    return np.unique(centres.round().astype(np.uint8), axis=0)
