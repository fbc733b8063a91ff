"""Small weights' files of the network tokenizers, with random numbers; drawn pictures to train on."""

import json
import runpy
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from hma_data.tokenizers.base import Tokenizer, TokenizerSpec
from hma_data.tokenizers.magvit2 import Magvit2, Magvit2Config

DRAW = runpy.run_path(str(Path(__file__).parents[2] / "recipes/tokenizer/draw.py"))
draw_scene, write_pictures = DRAW["draw_scene"], DRAW["write_pictures"]
TINY_MAGVIT2 = Magvit2Config(base=32, z=18, mult=(1, 1, 1, 1, 1), res_blocks=1)


def drawn_corpus(folder: Path, count: int) -> dict[str, object]:
    rng = np.random.default_rng([1, 2])
    write_pictures(folder / "drawn", (draw_scene(rng) for _ in range(count)))
    return {"kind": "drawn", "pictures": count}


def write_recipe(folder: Path, network: dict[str, object], pictures: int = 4, **training: object) -> Path:
    steps = {"steps": 6, "batch": 4, "crop": 32, "learning_rate": 0.02, "adam_learning_rate": 0.001}
    values = {
        "job": "tokenizer",
        "name": "small",
        "seed": 1,
        "corpus": str(folder),
        "network": network,
        "training": {**steps, "warmup_steps": 2, **training},
        "loss": {"l2": 10.0, "l1": 0.3, "gradient": 0.3, "ssim": 0.05},
        "sources": [drawn_corpus(folder, pictures)],
    }
    path = folder / "recipe.yaml"
    path.write_text(json.dumps(values))
    return path


class Stopped(Exception):
    """What `stop_at` raises."""


def stop_at(step: int) -> Callable[[str], None]:
    """Return a `report` that stops a training after a step."""

    def stop(line: str) -> None:
        if line.startswith(f"step {step}"):
            raise Stopped

    return stop


def frames(count: int, seed: int = 0, size: int = 256) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, (count, 8, 8, 3), np.uint8)
    grown = nn.functional.interpolate(
        torch.from_numpy(noise).permute(0, 3, 1, 2).float(), size=(size, size), mode="bilinear"
    )
    return grown.round().to(torch.uint8).permute(0, 2, 3, 1).contiguous().numpy()


def assert_contract(tokenizer: Tokenizer, pictures: np.ndarray) -> np.ndarray:
    """Check shapes and dtypes there and back, also of no pictures; return the decoded ones."""
    spec = tokenizer.spec
    assert isinstance(tokenizer, Tokenizer) and TokenizerSpec.from_json(spec.to_json()) == spec
    tokens = tokenizer.encode(pictures)
    assert tokens.shape == (len(pictures), *spec.cells) and tokens.dtype == np.dtype(spec.dtype)
    made = tokenizer.decode(tokens)
    assert made.shape == pictures.shape and made.dtype == np.uint8
    assert tokenizer.encode(pictures[:0]).shape == (0, *spec.cells)
    assert tokenizer.decode(tokens[:0]).shape == (0, *pictures.shape[1:])
    return made


def randomized(network: nn.Module, seed: int = 0) -> nn.Module:
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            drawn = torch.randn(parameter.shape, generator=generator)
            if parameter.ndim > 1:
                parameter.copy_(drawn * (2 / parameter[0].numel()) ** 0.5)
            else:
                parameter.copy_(1 + 0.1 * drawn if "norm" in name and "weight" in name else 0.1 * drawn)
    return network.eval()


def magvit2_state(config: Magvit2Config = TINY_MAGVIT2, seed: int = 0) -> dict[str, Tensor]:
    return {name: p.detach() for name, p in randomized(Magvit2(config), seed).named_parameters()}


def write_magvit2(path: Path, config: Magvit2Config = TINY_MAGVIT2, seed: int = 0) -> Path:
    save_file(magvit2_state(config, seed), path)
    return path


def altered(state: dict[str, Tensor], changes: dict[str, Tensor | None]) -> dict[str, Tensor]:
    """Return weights of which some are replaced, or left out where None."""
    whole: dict[str, Tensor | None] = {**state, **changes}
    return {name: tensor for name, tensor in whole.items() if tensor is not None}


def tiny_halves(
    channels: int = 4, width: int = 8, pooled: int = 0, seed: int = 0, scales: int = 3
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Encoder and decoder of a TAESD in its author's layout: one block a stage, numbered with the ReLUs."""
    generator = torch.Generator().manual_seed(seed)

    def conv(before: int, after: int, side: int = 3, bias: bool = True) -> dict[str, Tensor]:
        scale = (1 / (before * side**2)) ** 0.5
        made = {"weight": torch.randn(after, before, side, side, generator=generator) * scale}
        return made | ({"bias": torch.randn(after, generator=generator) * 0.1} if bias else {})

    def block() -> dict[str, Tensor]:
        parts = {f"conv.{i}.{k}": v for i in (0, 2, 4) for k, v in conv(width, width).items()}
        if pooled:
            parts |= {f"pool.0.{k}": v for k, v in conv(width, pooled, 1, False).items()}
            parts |= {"pool.1.weight": torch.ones(pooled), "pool.1.bias": torch.zeros(pooled)}
            parts |= {f"pool.3.{k}": v for k, v in conv(pooled, width, 1, False).items()}
        return parts

    encoder = [conv(3, width), block()]
    decoder: list[dict[str, Tensor]] = [{}, conv(channels, width), {}]  # clamp, convolution, ReLU
    for _ in range(scales):
        encoder += [conv(width, width, bias=False), block()]
        decoder += [block(), {}, conv(width, width, bias=False)]  # block, upsampling, convolution
    encoder.append(conv(width, channels))
    decoder += [block(), conv(width, 3)]
    encoder_state, decoder_state = (
        {f"{place}.{name}": t for place, layer in enumerate(half) for name, t in layer.items()}
        for half in (encoder, decoder)
    )
    return encoder_state, decoder_state


def write_tiny_pair(folder: Path, name: str = "taesd", **sizes: int) -> Path:
    for half, state in zip(("encoder", "decoder"), tiny_halves(**sizes), strict=True):
        torch.save(state, folder / f"{name}_{half}.pth")
    return folder


def write_tiny_whole(path: Path, **sizes: int) -> Path:
    encoder, decoder = tiny_halves(**sizes)
    whole = {f"encoder.layers.{key}": tensor for key, tensor in encoder.items()}
    for key, tensor in decoder.items():
        place, rest = key.split(".", 1)
        whole[f"decoder.layers.{int(place) - 1}.{rest}"] = tensor
    save_file(whole, path)
    return path


def scenes(count: int, size: int) -> np.ndarray:
    rng = np.random.default_rng(5)
    return np.stack([draw_scene(rng, size) for _ in range(count)])
