"""`magvit2` and `magvit2-plain`: encode with Open-MAGVIT2, the discrete tokenizer of the paper's release.

Both take 256×256 pictures and give 16×16 ids of 18 bits, two digits of 512. They load 1X's
`magvit2.ckpt` (the default), TencentARC's checkpoints, and plain safetensors of `encoder.*` and
`decoder.*`. Widths, levels and blocks are derived from the weights. Some checkpoints, 1X's among them,
hold averaged weights (`model_ema.*`) beside the plain ones: `magvit2` uses the averaged weights. The
paper's own loader overwrites the averaged weights with the plain ones: `magvit2-plain` gives that
loader's ids.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from hma_data.errors import TokenizerError
from hma_data.tokenizers.base import TokenizerSpec
from hma_data.tokenizers.checkpoints import (
    Tensors,
    digest_of,
    fill,
    find_weights,
    numbers,
    one_file,
    read_config,
    read_tensors,
    shapes_of,
)
from hma_data.tokenizers.magvit2_network import Magvit2, Magvit2Config
from hma_data.tokenizers.network import NetworkTokenizer, grid_of, open_device

VERSION = 1
IMAGE_SIZE = 256
WHAT = "an Open-MAGVIT2 tokenizer"
FILES = ("model.safetensors", "magvit2.safetensors", "magvit2.ckpt")
FIRST = "encoder.conv_in.weight"
AVERAGED = "model_ema."
# Projections around a learned codebook; a network that has them is a VQGAN or IBQ, not Open-MAGVIT2.
FOREIGN = ("quant_conv.", "post_quant_conv.", "quantize.embedding")


def choose_weights(tensors: Mapping[str, torch.Tensor], where: object, *, averaged: bool = True) -> Tensors:
    """Return the parameters of encoder and decoder in a checkpoint, under their plain names.

    The trainer's prefix is removed, and parameters of the loss (the discriminator) are left out.

    Args:
        averaged: whether to take the averaged weights if there are any.

    Raises:
        TokenizerError: the checkpoint holds no such network, or averages only a part of it.
    """
    prefixes = [name.removesuffix(FIRST) for name in tensors if name.endswith(FIRST)]
    if not prefixes:
        raise TokenizerError(where, f"lacks {FIRST}: not the weights of {WHAT}", "name other weights")
    prefix = min(prefixes, key=len)
    named = {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}
    foreign = [name for name in named if name.startswith(FOREIGN)]
    if foreign:
        raise TokenizerError(where, f"has {foreign[0]}: not the weights of {WHAT}", "name other weights")
    plain = {name: t for name, t in named.items() if name.startswith(("encoder.", "decoder."))}
    if not averaged or not any(name.startswith(AVERAGED) for name in named):
        return plain
    keys = {name: AVERAGED + name.replace(".", "") for name in plain}
    missing = [key for key in keys.values() if key not in named]
    if missing:
        raise TokenizerError(
            where, f"its averaged weights lack {missing[0]} ({len(missing)} in all)", "fetch it again"
        )
    return {name: named[key] for name, key in keys.items()}


def derive_config(tensors: Mapping[str, torch.Tensor], where: object) -> Magvit2Config:
    """Derive the network's shape from the shapes of its weights.

    Raises:
        TokenizerError: the weights are not those of such a network.
    """
    with shapes_of(where, WHAT):
        base, colours = tensors[FIRST].shape[:2]
        if colours != 3:
            raise ValueError(f"it takes {colours} channels of pixels")
        levels = len(numbers(tensors, "encoder.down."))
        widths = [tensors[f"encoder.down.{i}.block.0.conv1.weight"].shape[0] for i in range(levels)]
        if any(width % base for width in widths):
            raise ValueError(f"widths {widths} are no multiples of {base}")
        return Magvit2Config(
            base=base,
            z=tensors["encoder.conv_out.weight"].shape[0],
            mult=tuple(width // base for width in widths),
            res_blocks=len(numbers(tensors, "encoder.down.0.block.")),
            adaptive=any(name.startswith("decoder.adaptive.") for name in tensors),
        )


def check_config(config: Magvit2Config, stated: Mapping[str, Any], where: object) -> None:
    """Raise TokenizerError if a `config.json` beside the weights contradicts them."""
    derived = {
        "base_channels": config.base,
        "z_channels": config.z,
        "ch_mult": list(config.mult),
        "num_res_blocks": config.res_blocks,
    }
    for key, value in derived.items():
        if key in stated and stated[key] != value:
            raise TokenizerError(
                where, f"the config.json beside it says {key} {stated[key]!r}, its weights say {value!r}"
            )


def read_network(path: Path, *, averaged: bool = True) -> Magvit2:
    """Read the network from a weights' file, with its averaged weights or the plain ones.

    Raises:
        TokenizerError: the file cannot be read, or holds another network.
    """
    tensors = choose_weights(read_tensors(path), path, averaged=averaged)
    config = derive_config(tensors, path)
    check_config(config, read_config(path.parent), path)
    with torch.device("meta"):
        network = Magvit2(config)
    fill(network, tensors, path)
    return network


def load(name: str, *, weights: str | None, device: str, averaged: bool) -> NetworkTokenizer:
    """Return the tokenizer; `hma_data.tokenizers.base.get_tokenizer` calls this.

    Args:
        weights: a file, a folder with one of `FILES`, or `hf://…`; None takes 1X's from the hub.
        averaged: whether to take the averaged weights if there are any.

    Raises:
        TokenizerError: the weights cannot be obtained or used, or there is no such device.
    """
    place = open_device(name, device)
    path = one_file(find_weights(name, weights), FILES, name)
    network = read_network(path, averaged=averaged)
    config = network.config
    spec = TokenizerSpec(
        name=name,
        version=VERSION,
        kind="discrete",
        image_size=IMAGE_SIZE,
        grid=grid_of(IMAGE_SIZE, config.stride, path),
        vocab_size=2**config.z,
        factored=config.factored,
        dtype="uint32",
        weights_sha256=digest_of([path]),
    )

    def encode(pixels: torch.Tensor) -> torch.Tensor:
        return network.to_ids(network.encoder(pixels))

    def decode(ids: torch.Tensor) -> torch.Tensor:
        codes = network.from_ids(ids)
        return network.decoder(codes.to(network.decoder.conv_in.weight.dtype))

    return NetworkTokenizer(spec, network, place, encode, decode)
