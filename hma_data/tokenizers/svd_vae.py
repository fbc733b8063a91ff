"""`svd-vae`: encode with the autoencoder of Stable Video Diffusion, the paper's continuous tokenizer.

It takes 256×256 pictures and gives 4×32×32 latents: the mean of the posterior, stored unscaled as
float16. A model multiplies them by `latent_scale` (0.18215). Frames are encoded one by one; the decoder,
which works on videos, gets videos of one frame. The network is diffusers' `AutoencoderKLTemporalDecoder`.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from hma_data.tokenizers.base import TokenizerSpec
from hma_data.tokenizers.checkpoints import (
    digest_of,
    fill,
    find_weights,
    numbers,
    one_file,
    read_tensors,
    shapes_of,
    stated_scale,
)
from hma_data.tokenizers.network import NetworkTokenizer, open_device

VERSION = 1
IMAGE_SIZE = 256
LATENT_SCALE = 0.18215
WHAT = "an AutoencoderKLTemporalDecoder"
FILES = (
    "diffusion_pytorch_model.safetensors",
    "diffusion_pytorch_model.fp16.safetensors",
    "vae/diffusion_pytorch_model.safetensors",
    "vae/diffusion_pytorch_model.fp16.safetensors",
    "diffusion_pytorch_model.bin",
)


def derive_config(tensors: Mapping[str, Tensor]) -> dict[str, Any]:
    """Return the arguments of diffusers' class, derived from the shapes of the weights."""
    levels = numbers(tensors, "encoder.down_blocks.")
    widths = [tensors[f"encoder.down_blocks.{i}.resnets.0.conv1.weight"].shape[0] for i in levels]
    return {
        "down_block_types": ("DownEncoderBlock2D",) * len(widths),
        "block_out_channels": tuple(widths),
        "layers_per_block": len(numbers(tensors, "encoder.down_blocks.0.resnets.")),
        "latent_channels": tensors["quant_conv.weight"].shape[0] // 2,
    }


def read_network(path: Path) -> Any:
    """Read the network from a weights' file; raise TokenizerError if it is another one."""
    from diffusers import AutoencoderKLTemporalDecoder

    tensors = read_tensors(path)
    with shapes_of(path, WHAT):
        network: Any = AutoencoderKLTemporalDecoder(**derive_config(tensors))
    fill(network, tensors, path)
    return network


def load(name: str, *, weights: str | None, device: str) -> NetworkTokenizer:
    """Return the tokenizer; `hma_data.tokenizers.base.get_tokenizer` states the arguments and the errors.

    Args:
        weights: a file, a folder as diffusers writes it, or `hf://…`; None takes them from the hub.
    """
    place = open_device(name, device)
    path = one_file(find_weights(name, weights), FILES, name)
    network = read_network(path)
    stride = 2 ** (len(network.config.block_out_channels) - 1)
    facts = {"latent_scale": stated_scale(path.parent, LATENT_SCALE), "weights_sha256": digest_of([path])}
    channels = network.config.latent_channels
    spec = TokenizerSpec.continuous(name, VERSION, IMAGE_SIZE, stride, channels, **facts)

    def encode(pixels: Tensor) -> Tensor:
        return network.encode(pixels).latent_dist.mean

    def decode(latents: Tensor) -> Tensor:
        return network.decode(latents, num_frames=1).sample

    return NetworkTokenizer(spec, network, place, encode, decode)
