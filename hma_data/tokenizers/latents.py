"""`svd-vae`, `taesd` and `taef2`: encode with the continuous tokenizers of published diffusion models.

`svd-vae` is the paper's: the autoencoder of Stable Video Diffusion (`AutoencoderKLTemporalDecoder` of
diffusers). A 256×256 image gives 4×32×32 latents: the mean of the posterior, stored unscaled as float16. A
model multiplies them by `latent_scale` (0.18215). The decoder works on videos; it gets videos of one frame.

`taesd` and `taef2` are tiny networks that are fast on a CPU: `taesd` makes the latents of Stable Diffusion 1
and 2 (4×32×32), `taef2` those of FLUX.2 (32×32×32), both distilled to latents that need no scale. Two layouts
of weights are read. Diffusers writes an `AutoencoderTiny` as one file of `encoder.layers.N.*` and
`decoder.layers.N.*`. The author writes two files, one for the encoder and one for the decoder, of `N.*`. The
network consists of 3×3 convolutions, ReLUs and residual blocks in sequence, so its layers are derived from
the weights: a convolution without a bias halves (encoder) or doubles (decoder) the side. Sizes and order
follow Ollin Boer Bohan's TAESD, whose weights expect pixels in [0, 1].

B images, S side, c channels, h side of the grid. Pixels are in [-1, 1].
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from hma_data.errors import TokenizerError
from hma_data.tokenizers.base import OTHER, TokenizerSpec
from hma_data.tokenizers.checkpoints import (
    HALVES,
    SUFFIXES,
    Tensors,
    digest_of,
    fill,
    find_weights,
    numbers,
    one_file,
    pair_of,
    read_tensors,
    shapes_of,
    stated_scale,
)
from hma_data.tokenizers.network import NetworkTokenizer, open_device

VERSION = 1
IMAGE_SIZE = 256
SVD_SCALE = 0.18215
SVD_FILES = (
    "diffusion_pytorch_model.safetensors",
    "diffusion_pytorch_model.fp16.safetensors",
    "vae/diffusion_pytorch_model.safetensors",
    "vae/diffusion_pytorch_model.fp16.safetensors",
    "diffusion_pytorch_model.bin",
)
TINY_FILES = ("diffusion_pytorch_model.safetensors", "diffusion_pytorch_model.bin")
LATENT_LIMIT = 3.0  # the tiny decoder squeezes latents into (-LIMIT, LIMIT)
POOL_GROUPS = 4


# -- svd-vae


def derive_svd_config(tensors: Mapping[str, Tensor]) -> dict[str, Any]:
    """Return the arguments of diffusers' class, derived from the shapes of the weights."""
    levels = numbers(tensors, "encoder.down_blocks.")
    widths = [tensors[f"encoder.down_blocks.{i}.resnets.0.conv1.weight"].shape[0] for i in levels]
    return {
        "down_block_types": ("DownEncoderBlock2D",) * len(widths),
        "block_out_channels": tuple(widths),
        "layers_per_block": len(numbers(tensors, "encoder.down_blocks.0.resnets.")),
        "latent_channels": tensors["quant_conv.weight"].shape[0] // 2,
    }


def _svd(name: str, path: Path, place: torch.device) -> NetworkTokenizer:
    from diffusers import AutoencoderKLTemporalDecoder

    path = one_file(path, SVD_FILES, name)
    tensors = read_tensors(path)
    with shapes_of(path, "an AutoencoderKLTemporalDecoder"):
        network: Any = AutoencoderKLTemporalDecoder(**derive_svd_config(tensors))
    fill(network, tensors, path)
    stride = 2 ** (len(network.config.block_out_channels) - 1)
    facts = {"latent_scale": stated_scale(path.parent, SVD_SCALE), "weights_sha256": digest_of([path])}
    channels = network.config.latent_channels
    spec = TokenizerSpec.continuous(name, VERSION, IMAGE_SIZE, stride, channels, **facts)

    def encode(pixels: Tensor) -> Tensor:
        return network.encode(pixels).latent_dist.mean

    def decode(latents: Tensor) -> Tensor:
        return network.decode(latents, num_frames=1).sample

    return NetworkTokenizer(spec, network, place, encode, decode)


# -- taesd and taef2


class Block(nn.Module):
    """A residual block: relu(x + three convolutions of x).

    With `pooled` channels, a normalised 1×1 branch is first added to x.
    """

    def __init__(self, before: int, after: int, pooled: int) -> None:
        super().__init__()
        self.conv = nn.Sequential(
            nn.Conv2d(before, after, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(after, after, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(after, after, 3, padding=1),
        )
        self.skip = nn.Identity() if before == after else nn.Conv2d(before, after, 1, bias=False)
        self.pool: nn.Module | None = None
        if pooled:
            self.pool = nn.Sequential(
                nn.Conv2d(before, pooled, 1, bias=False),
                nn.GroupNorm(POOL_GROUPS, pooled),
                nn.ReLU(),
                nn.Conv2d(pooled, before, 1, bias=False),
            )

    def forward(self, x: Tensor) -> Tensor:
        if self.pool is not None:
            x = x + self.pool(x)
        return functional.relu(self.conv(x) + self.skip(x))


def _scales(layer: nn.Module) -> bool:
    """Check whether a layer halves or doubles the side."""
    return isinstance(layer, nn.Conv2d) and layer.bias is None


class Layers(nn.Module):
    """A half of the network: the layers of `tensors` below `<half>.layers.`, in sequence."""

    def __init__(self, tensors: Mapping[str, Tensor], half: str, stride: int) -> None:
        super().__init__()
        places = numbers(tensors, f"{half}.layers.")
        self.layers = nn.ModuleList(_layer(tensors, f"{half}.layers.{place}", stride) for place in places)


class Encoder(Layers):
    """The encoder: (B, 3, S, S) pixels -> (B, c, h, h) latents."""

    def forward(self, pixels: Tensor) -> Tensor:
        x = pixels.add(1).div(2)
        for layer in self.layers:
            x = layer(x)
        return x


class Decoder(Layers):
    """The decoder: (B, c, h, h) latents -> (B, 3, S, S) pixels, about [-1, 1]."""

    def forward(self, latents: Tensor) -> Tensor:
        first, *others = self.layers
        x = functional.relu(first(torch.tanh(latents / LATENT_LIMIT) * LATENT_LIMIT))
        for layer in others:
            x = layer(functional.interpolate(x, scale_factor=2) if _scales(layer) else x)
        return x.mul(2).sub(1)


def _layer(tensors: Mapping[str, Tensor], prefix: str, stride: int) -> nn.Module:
    if f"{prefix}.conv.0.weight" in tensors:
        after, before = tensors[f"{prefix}.conv.0.weight"].shape[:2]
        pool = tensors.get(f"{prefix}.pool.0.weight")
        return Block(before, after, 0 if pool is None else pool.shape[0])
    after, before = tensors[f"{prefix}.weight"].shape[:2]
    keeps = f"{prefix}.bias" in tensors
    return nn.Conv2d(before, after, 3, stride=1 if keeps else stride, padding=1, bias=keeps)


class TinyAutoencoder(nn.Module):
    """An autoencoder of `encoder` and `decoder`, built from the names and shapes of its weights.

    Attributes:
        channels: number of latent channels.
        stride: number of pixels a latent covers along each side.
    """

    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        super().__init__()
        self.encoder, self.decoder = Encoder(tensors, "encoder", 2), Decoder(tensors, "decoder", 1)
        layers = self.encoder.layers
        self.channels = tensors[f"encoder.layers.{len(layers) - 1}.weight"].shape[0]
        self.stride = 2 ** sum(map(_scales, layers))


def _read_halves(files: list[Path]) -> Tensors:
    """Read all weights, named `<half>.layers.<place>.…`; layers without weights have no place."""
    if len(files) == 1:
        named = {key.replace(".layers.", ".", 1): t for key, t in read_tensors(files[0]).items()}
    else:
        halves = zip(HALVES, files, strict=True)
        named = {f"{half}.{key}": t for half, file in halves for key, t in read_tensors(file).items()}
    places = {
        f"{half}.{number}": f"{half}.layers.{place}"
        for half in HALVES
        for place, number in enumerate(numbers(named, f"{half}."))
    }
    renamed = {}
    for key, tensor in named.items():
        layer = ".".join(key.split(".")[:2])
        renamed[key.replace(layer, places.get(layer, layer), 1)] = tensor
    return renamed


def read_tiny(files: list[Path]) -> TinyAutoencoder:
    """Read the network from one file or from a pair; raise TokenizerError if it is another one."""
    where = " and ".join(map(str, files))
    tensors = _read_halves(files)
    with shapes_of(where, "a TAESD tokenizer"), torch.device("meta"):
        network = TinyAutoencoder(tensors)
    fill(network, tensors, where)
    return network


def _tiny(name: str, path: Path, place: torch.device, channels: int) -> NetworkTokenizer:
    halves = (f"{name}_{HALVES[0]}{suffix}" for suffix in SUFFIXES)
    file = one_file(path, (*TINY_FILES, f"{name}.safetensors", *halves), name)
    files = pair_of(file) or [file]
    network = read_tiny(files)
    if network.channels != channels:
        fault = f"has latents of {network.channels} channels, {name} has {channels}"
        raise TokenizerError(files[0], fault, OTHER)
    # A config.json beside a pair of files belongs to other weights.
    scale = stated_scale(file.parent, 1.0) if file.name in TINY_FILES else 1.0
    facts = {"latent_scale": scale, "weights_sha256": digest_of(files)}
    spec = TokenizerSpec.continuous(name, VERSION, IMAGE_SIZE, network.stride, channels, **facts)
    return NetworkTokenizer(spec, network, place, network.encoder, network.decoder)


def load(name: str, *, weights: str | None, device: str, channels: int | None = None) -> NetworkTokenizer:
    """Return the tokenizer; `hma_data.tokenizers.base.get_tokenizer` states the arguments and the errors.

    Args:
        weights: a file, one file of a pair, a folder, or `hf://…`; None takes them from the hub.
        channels: number of latent channels that a tiny network of this name has; None for `svd-vae`.
    """
    place = open_device(name, device)
    path = find_weights(name, weights)
    return _svd(name, path, place) if channels is None else _tiny(name, path, place, channels)
