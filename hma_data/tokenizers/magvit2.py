"""`magvit2` and `magvit2-plain`: encode with Open-MAGVIT2, the discrete tokenizer of the paper's release.

Both take 256×256 images and give 16×16 ids of 18 bits, two digits of 512. They load 1X's
`magvit2.ckpt` (the default), and plain safetensors of `encoder.*` and `decoder.*`. Widths, levels and
blocks are derived from the weights. Some checkpoints, 1X's among them,
hold averaged weights (`model_ema.*`) beside the plain ones: `magvit2` uses the averaged weights. The
paper's own loader overwrites the averaged weights with the plain ones: `magvit2-plain` gives that
loader's ids.

The network is a convolutional autoencoder whose latents are reduced to their signs (lookup-free
quantisation, Yu et al. 2024). Parameter names are those of the released checkpoints. Later checkpoints of
Open-MAGVIT2, whose decoder has adaptive group norms, are refused.

B images, S side, z channels of the code, h = S / 2^(levels-1). Pixels are in [-1, 1].
"""

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from hma_data.errors import TokenizerError
from hma_data.tokenizers.base import OTHER, TokenizerSpec
from hma_data.tokenizers.checkpoints import (
    Tensors,
    digest_of,
    fill,
    find_weights,
    numbers,
    one_file,
    read_tensors,
    shapes_of,
)
from hma_data.tokenizers.network import NetworkTokenizer, open_device

VERSION = 1
IMAGE_SIZE = 256
WHAT = "an Open-MAGVIT2 tokenizer"
FILES = ("model.safetensors", "magvit2.safetensors", "magvit2.ckpt")
FIRST_WEIGHT = "encoder.conv_in.weight"
AVERAGED = "model_ema."
# Projections around a learned codebook; a network that has them is a VQGAN or IBQ, not Open-MAGVIT2.
FOREIGN = ("quant_conv.", "post_quant_conv.", "quantize.embedding")
GROUPS, EPS = 32, 1e-6


@dataclass(frozen=True)
class Magvit2Config:
    """The network's shape.

    Attributes:
        base: channels at the image's own size.
        z: channels of the code, which is the number of bits of a token.
        mult: channels of each level as multiples of `base`; each level except the last halves the side.
        res_blocks: residual blocks a level.
    """

    base: int = 128
    z: int = 18
    mult: tuple[int, ...] = (1, 1, 2, 2, 4)
    res_blocks: int = 2

    @property
    def stride(self) -> int:
        """Return the number of pixels a token covers along each side."""
        return 2 ** (len(self.mult) - 1)

    @property
    def factored(self) -> tuple[int, ...]:
        """Return the sizes of two digits, low digit first, as equal as z allows; one digit if z is 1."""
        return (2 ** (self.z - self.z // 2), 2 ** (self.z // 2)) if self.z > 1 else (2,)


class ResBlock(nn.Module):
    """A residual block: x + conv2(silu(norm2(conv1(silu(norm1(x)))))), 3×3 and without bias.

    If the widths differ, a 1×1 convolution of x replaces x in the sum.
    """

    def __init__(self, before: int, after: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.GroupNorm(GROUPS, before, eps=EPS), nn.GroupNorm(GROUPS, after, eps=EPS)
        self.conv1 = nn.Conv2d(before, after, 3, padding=1, bias=False)
        self.conv2 = nn.Conv2d(after, after, 3, padding=1, bias=False)
        self.nin_shortcut = nn.Identity() if before == after else nn.Conv2d(before, after, 1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        h = self.conv1(functional.silu(self.norm1(x)))
        h = self.conv2(functional.silu(self.norm2(h)))
        return h + self.nin_shortcut(x)


def _blocks(before: int, after: int, count: int) -> nn.Sequential:
    return nn.Sequential(*(ResBlock(before if i == 0 else after, after) for i in range(count)))


def _level(blocks: nn.Sequential, name: str, change: nn.Module | None) -> nn.Sequential:
    """Return residual blocks, then what halves or doubles the side, under the release's names."""
    return nn.Sequential(OrderedDict({"block": blocks} | ({name: change} if change else {})))


class Upsample(nn.Module):
    """An upsampling by 2: a 3×3 convolution makes four times the channels, which become 2×2 pixels.

    Of the output channels of the convolution, the image channel varies fastest.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(width, 4 * width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        batch, width, height, side = x.shape
        cells = self.conv1(x).view(batch, 2, 2, width, height, side)
        return cells.permute(0, 3, 4, 1, 5, 2).reshape(batch, width, 2 * height, 2 * side)


class Encoder(nn.Module):
    """The encoder: (B, 3, S, S) pixels -> (B, z, h, h), whose signs are the code."""

    def __init__(self, config: Magvit2Config) -> None:
        super().__init__()
        widths = [config.base * m for m in (1, *config.mult)]
        self.conv_in = nn.Conv2d(3, config.base, 3, padding=1, bias=False)
        self.down = nn.Sequential()
        for i, (before, after) in enumerate(pairwise(widths), start=1):
            halving = nn.Conv2d(after, after, 3, stride=2, padding=1) if i < len(config.mult) else None
            self.down.append(_level(_blocks(before, after, config.res_blocks), "downsample", halving))
        self.mid_block = _blocks(widths[-1], widths[-1], config.res_blocks)
        self.norm_out = nn.GroupNorm(GROUPS, widths[-1], eps=EPS)
        self.conv_out = nn.Conv2d(widths[-1], config.z, 1)

    def forward(self, pixels: Tensor) -> Tensor:
        x = self.mid_block(self.down(self.conv_in(pixels)))
        return self.conv_out(functional.silu(self.norm_out(x)))


class Decoder(nn.Module):
    """The decoder: (B, z, h, h) codes of -1 and 1 -> (B, 3, S, S) pixels, about [-1, 1]."""

    def __init__(self, config: Magvit2Config) -> None:
        super().__init__()
        widths = [config.base * m for m in (*config.mult, config.mult[-1])]
        self.conv_in = nn.Conv2d(config.z, widths[-1], 3, padding=1)
        self.mid_block = _blocks(widths[-1], widths[-1], config.res_blocks)
        self.up = nn.ModuleList()  # the finest level first; each takes the output of the next
        for after, before in pairwise(widths):
            doubling = Upsample(after) if len(self.up) else None
            self.up.append(_level(_blocks(before, after, config.res_blocks), "upsample", doubling))
        self.norm_out = nn.GroupNorm(GROUPS, widths[0], eps=EPS)
        self.conv_out = nn.Conv2d(widths[0], 3, 3, padding=1)

    def forward(self, codes: Tensor) -> Tensor:
        x = self.mid_block(self.conv_in(codes))
        for level in reversed(self.up):
            x = level(x)
        return self.conv_out(functional.silu(self.norm_out(x)))


class Magvit2(nn.Module):
    """An autoencoder of `encoder` and `decoder`, with a quantiser between them that has no parameters.

    A channel above zero is a 1. Bit c of an id is channel c, the lowest first. The paper's release
    stores ids in this order (its `flip`); upstream's order is the reverse.
    """

    def __init__(self, config: Magvit2Config) -> None:
        super().__init__()
        self.config = config
        self.encoder = Encoder(config)
        self.decoder = Decoder(config)

    def to_ids(self, latents: Tensor) -> Tensor:
        """Return the ids of latents: (B, z, h, w) -> (B, h, w) int64."""
        bits = (latents > 0).to(torch.int64)
        weights = 2 ** torch.arange(self.config.z, device=latents.device)
        return (bits * weights.view(1, -1, 1, 1)).sum(1)

    def from_ids(self, ids: Tensor) -> Tensor:
        """Return the codes of ids: (B, h, w) int64 -> (B, z, h, w) float32 of -1 and 1."""
        shifts = torch.arange(self.config.z, device=ids.device).view(1, -1, 1, 1)
        return ((ids.unsqueeze(1) >> shifts) & 1).float() * 2 - 1


def choose_weights(tensors: Mapping[str, Tensor], where: object, *, averaged: bool = True) -> Tensors:
    """Return the parameters of encoder and decoder in a checkpoint, under their plain names.

    The trainer's prefix is removed, and parameters of the loss (the discriminator) are left out. With
    `averaged`, the averaged weights are taken if there are any. Raise TokenizerError if the checkpoint holds
    another network, or averages only a part of it.
    """
    # Copies of the weights have longer prefixes; the shortest is that of the network itself.
    prefixes = [name.removesuffix(FIRST_WEIGHT) for name in tensors if name.endswith(FIRST_WEIGHT)]
    prefix = min(prefixes, key=len, default="")
    named = {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}
    if foreign := [name for name in named if name.startswith(FOREIGN)]:
        raise TokenizerError(where, f"does not hold the weights of {WHAT}: has {foreign[0]}", OTHER)
    plain = {name: t for name, t in named.items() if name.startswith(("encoder.", "decoder."))}
    if not averaged or not any(name.startswith(AVERAGED) for name in named):
        return plain
    with shapes_of(where, WHAT):
        return {name: named[AVERAGED + name.replace(".", "")] for name in plain}


def derive_config(tensors: Mapping[str, Tensor]) -> Magvit2Config:
    """Return the network's shape, derived from the shapes of its weights."""
    base = tensors[FIRST_WEIGHT].shape[0]
    levels = len(numbers(tensors, "encoder.down."))
    widths = [tensors[f"encoder.down.{i}.block.0.conv1.weight"].shape[0] for i in range(levels)]
    return Magvit2Config(
        base=base,
        z=tensors["encoder.conv_out.weight"].shape[0],
        mult=tuple(width // base for width in widths),
        res_blocks=len(numbers(tensors, "encoder.down.0.block.")),
    )


def read_network(path: Path, *, averaged: bool = True) -> Magvit2:
    """Read the network from a weights' file; raise TokenizerError if the file holds another one."""
    tensors = choose_weights(read_tensors(path), path, averaged=averaged)
    with shapes_of(path, WHAT), torch.device("meta"):
        network = Magvit2(derive_config(tensors))
    fill(network, tensors, path)
    return network


def load(name: str, *, weights: str | None, device: str, averaged: bool) -> NetworkTokenizer:
    """Return the tokenizer; `hma_data.tokenizers.base.get_tokenizer` states the arguments and the errors.

    Args:
        weights: a file, a folder with one of `FILES`, or `hf://…`; None takes 1X's from the hub.
        averaged: whether to take the averaged weights if there are any.
    """
    place = open_device(name, device)
    path = one_file(find_weights(name, weights), FILES, name)
    network = read_network(path, averaged=averaged)
    config = network.config
    sha256 = digest_of([path])
    spec = TokenizerSpec.discrete(
        name, VERSION, IMAGE_SIZE, config.stride, config.factored, weights_sha256=sha256
    )

    def encode(pixels: Tensor) -> Tensor:
        return network.to_ids(network.encoder(pixels))

    def decode(ids: Tensor) -> Tensor:
        codes = network.from_ids(ids)
        return network.decoder(codes.to(network.decoder.conv_in.weight.dtype))

    return NetworkTokenizer(spec, network, place, encode, decode)
