"""`raw`, `raw-128` and `raw-64`: store pixels unchanged, for baselines and for models of pixels.

Frames are stored channels first, (3, S, S) uint8, so that they have the layout of a continuous
tokenizer's latents with one cell per pixel. A model maps them to [0, 1] with `spec.latent_scale`.
"""

import numpy as np

from hma_data.arrays import Array, Images
from hma_data.errors import TokenizerError
from hma_data.tokenizers.base import TokenizerSpec, check_frames, check_tokens


class RawTokenizer:
    """A tokenizer that returns its pixels unchanged; see `hma_data.tokenizers.base.Tokenizer`."""

    def __init__(self, name: str, image_size: int) -> None:
        self.spec = TokenizerSpec.continuous(name, 1, image_size, 1, 3, latent_scale=1 / 255, dtype="uint8")

    def encode(self, frames: Images) -> Images:
        """Return (N, S, S, 3) uint8 frames as (N, 3, S, S) uint8."""
        check_frames(frames, self.spec)
        return np.ascontiguousarray(frames.transpose(0, 3, 1, 2))

    def decode(self, tokens: Array) -> Images:
        """Return (N, 3, S, S) uint8 tokens as (N, S, S, 3) uint8 frames."""
        check_tokens(tokens, self.spec)
        return np.ascontiguousarray(tokens.transpose(0, 2, 3, 1))


def load(name: str, *, weights: str | None, device: str, image_size: int = 256) -> RawTokenizer:
    """Return the tokenizer of that name. It has no weights and no network, so `device` has no effect.

    Raises:
        TokenizerError: weights were given.
    """
    if weights is not None:
        raise TokenizerError(name, f"has no weights, was given {weights}", "leave the weights out")
    return RawTokenizer(name, image_size)
