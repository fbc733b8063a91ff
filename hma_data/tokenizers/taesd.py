"""`taesd` and `taef2`: encode with tiny continuous tokenizers that are fast on a CPU.

`taesd` makes the latents of Stable Diffusion 1 and 2 (4×32×32), `taef2` those of FLUX.2 (32×32×32).
Latents are stored as the encoder makes them; both encoders are distilled to latents that need no scale
(`latent_scale` 1). Two layouts of weights are read. Diffusers writes an `AutoencoderTiny` as one file of
`encoder.layers.N.*` and `decoder.layers.N.*`. The author writes two files, one for the encoder and one
for the decoder, of `N.*`. Neither diffusers nor the author's code is needed.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hma_data.errors import TokenizerError
from hma_data.tokenizers.base import TokenizerSpec
from hma_data.tokenizers.checkpoints import (
    HALVES,
    SUFFIXES,
    Tensors,
    digest_of,
    fill,
    find_weights,
    numbers,
    pair_of,
    read_config,
    read_tensors,
    shapes_of,
)
from hma_data.tokenizers.network import NetworkTokenizer, grid_of, open_device
from hma_data.tokenizers.taesd_network import Layer, TinyAutoencoder, TinyConfig

VERSION = 1
IMAGE_SIZE = 256
WHAT = "a TAESD tokenizer"
WHOLE = ("diffusion_pytorch_model.safetensors", "diffusion_pytorch_model.bin")
# Values that an AutoencoderTiny's config.json must have if it states them; the network supports no others.
KNOWN = {"act_fn": "relu", "upsample_fn": "nearest", "upsampling_scaling_factor": 2, "shift_factor": 0.0}


def find_files(name: str, path: Path) -> list[Path]:
    """Return the one file of encoder and decoder, or their two files.

    Raises:
        TokenizerError: the folder holds neither, or one file of the pair is missing.
    """
    if path.is_dir():
        for whole in (*WHOLE, f"{name}.safetensors"):
            if (path / whole).is_file():
                return [path / whole]
        for suffix in SUFFIXES:
            pair = [path / f"{name}_{half}{suffix}" for half in HALVES]
            if all(file.is_file() for file in pair):
                return pair
        raise TokenizerError(
            path, f"holds neither {WHOLE[0]} nor {name}_encoder and {name}_decoder", "name another folder"
        )
    return pair_of(path) or [path]


def read_halves(files: list[Path]) -> Tensors:
    """Read all weights, named `<half>.<number>.…`.

    Raises:
        TokenizerError: a file cannot be read, or holds other tensors than those of encoder and decoder.
    """
    if len(files) == 2:
        return {
            f"{half}.{key}": tensor
            for half, file in zip(HALVES, files, strict=True)
            for key, tensor in read_tensors(file).items()
        }
    tensors = {key.replace(".layers.", ".", 1): t for key, t in read_tensors(files[0]).items()}
    foreign = [key for key in tensors if not key.startswith(("encoder.", "decoder."))]
    if foreign:
        raise TokenizerError(files[0], f"has {foreign[0]}: not the weights of {WHAT}", "name other weights")
    return tensors


def in_order(tensors: Mapping[str, Tensor]) -> Tensors:
    """Rename the weights to `<half>.layers.<place>.…`; layers without weights have no place."""
    places = {
        f"{half}.{number}": f"{half}.layers.{place}"
        for half in HALVES
        for place, number in enumerate(numbers(tensors, f"{half}."))
    }
    named = {}
    for key, tensor in tensors.items():
        half, number, *rest = key.split(".")
        named[".".join([places.get(f"{half}.{number}", f"{half}.{number}"), *rest])] = tensor
    return named


def derive_config(tensors: Mapping[str, Tensor], where: object) -> TinyConfig:
    """Derive the layers from the names and shapes that `in_order` returned.

    Raises:
        TokenizerError: the weights are not those of such a network.
    """
    with shapes_of(where, WHAT):
        halves = [
            tuple(_layer(tensors, f"{half}.layers.{place}") for place in numbers(tensors, f"{half}.layers."))
            for half in HALVES
        ]
        return TinyConfig(*halves)


def _layer(tensors: Mapping[str, Tensor], prefix: str) -> Layer:
    if f"{prefix}.conv.0.weight" not in tensors:
        after, before = tensors[f"{prefix}.weight"].shape[:2]
        return Layer("conv" if f"{prefix}.bias" in tensors else "scale", before, after)
    after, before = tensors[f"{prefix}.conv.0.weight"].shape[:2]
    pool = tensors.get(f"{prefix}.pool.0.weight")
    return Layer("block", before, after, 0 if pool is None else pool.shape[0])


def _check_config(stated: Mapping[str, Any], where: object) -> float:
    """Return the scale of the latents that a config.json states; raise TokenizerError for another network."""
    for key, value in KNOWN.items():
        if stated.get(key, value) != value:
            raise TokenizerError(where, f"its config.json asks for {key} {stated[key]!r}, known is {value!r}")
    scale = stated.get("scaling_factor", 1.0)
    if not isinstance(scale, int | float) or not 0 < scale < 1e6:
        raise TokenizerError(where, f"its config.json says scaling_factor {scale!r}, which is no scale")
    return float(scale)


def read_network(files: list[Path]) -> TinyAutoencoder:
    """Read the network from one file or from a pair.

    Raises:
        TokenizerError: the files cannot be read, or hold another network.
    """
    where = _names(files)
    tensors = in_order(read_halves(files))
    config = derive_config(tensors, where)
    with torch.device("meta"):
        network = TinyAutoencoder(config)
    fill(network, tensors, where)
    return network


def _names(files: Iterable[Path]) -> str:
    return " and ".join(map(str, files))


def load(name: str, *, weights: str | None, device: str, channels: int) -> NetworkTokenizer:
    """Return the tokenizer; `hma_data.tokenizers.base.get_tokenizer` calls this.

    Args:
        weights: a file, one file of a pair, a folder, or `hf://…`; None takes them from the hub.
        channels: number of latent channels that a tokenizer of this name has.

    Raises:
        TokenizerError: the weights cannot be obtained or used, or there is no such device.
    """
    place = open_device(name, device)
    files = find_files(name, find_weights(name, weights))
    network = read_network(files)
    if network.config.channels != channels:
        fault = f"has latents of {network.config.channels} channels, {name} has {channels}"
        raise TokenizerError(_names(files), fault, "name the weights of this tokenizer")
    # A config.json beside a pair of files belongs to other weights.
    stated = read_config(files[0].parent) if files[0].name in WHOLE else {}
    spec = TokenizerSpec(
        name=name,
        version=VERSION,
        kind="continuous",
        image_size=IMAGE_SIZE,
        grid=grid_of(IMAGE_SIZE, network.config.stride, files[0]),
        channels=channels,
        latent_scale=_check_config(stated, files[0].parent),
        dtype="float16",
        weights_sha256=digest_of(files),
    )
    return NetworkTokenizer(spec, network, place, network.encoder, network.decoder)
