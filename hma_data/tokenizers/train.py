"""Train the embedded tokenizer from a recipe.

    train(Path("recipes/tokenizer/fsq.yaml"), Path("fsq.safetensors"), {"corpus": "/data/corpus"})

The loss is what can be had without a pretrained network: squared and absolute error, gradients at
several scales, and SSIM. Before the first step the network is the best linear code of 16×16 patches
(their principal components); the rest starts at zero and learns what is left. A weights' file is
written at every report, so a run can be stopped at any time.

B crops, S side of a crop, C latent channels.
"""

import hashlib
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from torch import Tensor, nn
from torch.nn import functional

from hma_data.errors import RecipeError
from hma_data.tokenizers.corpus import DrawnSource, FileSource, Pool, PushtSource, draw_batch, load_pools
from hma_data.tokenizers.eval import ssim_map
from hma_data.tokenizers.fsq import save_weights
from hma_data.tokenizers.fsq_network import STRIDE, FsqAutoencoder, FsqConfig
from hma_data.tokenizers.muon import Muon
from hma_data.yaml_io import read_yaml


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class NetworkRecipe(_Strict):
    """`FsqConfig` as a recipe says it."""

    levels: list[list[int]]
    width: tuple[int, int]
    hidden: int
    encoder_blocks: tuple[int, int]
    decoder_blocks: tuple[int, int, int]
    fine_width: int

    @model_validator(mode="after")
    def _is_a_network(self) -> "NetworkRecipe":
        self.config()
        return self

    def config(self) -> FsqConfig:
        """The network's shape."""
        return FsqConfig.from_json(self.model_dump())


class TrainingRecipe(_Strict):
    """How long and how fast.

    Attributes:
        steps: of the optimizer.
        batch, crop: crops a step, and their side in pixels, a multiple of 16.
        learning_rate: the highest, of Muon (matrices) in units of the spectral norm.
        adam_learning_rate: the highest, of Adam (biases, first and last layers).
        warmup_steps: of linear rise; from there the rate falls linearly to nothing.
        ema: decay of the averaged weights, which are the ones kept.
        threads: of torch; the result depends on it in the last bits only.
    """

    steps: int = Field(gt=0)
    batch: int = Field(gt=0)
    crop: int = Field(gt=0, multiple_of=STRIDE)
    learning_rate: float = Field(gt=0)
    adam_learning_rate: float = Field(gt=0)
    warmup_steps: int = Field(ge=0, default=100)
    ema: float = Field(ge=0, lt=1, default=0.998)
    threads: int = Field(gt=0, default=1)


class LossRecipe(_Strict):
    """Weights of the parts of the loss; pixels in [0, 1]."""

    l2: float = Field(ge=0)
    l1: float = Field(ge=0)
    gradient: float = Field(ge=0)
    ssim: float = Field(ge=0)


class TokenizerRecipe(_Strict):
    """A whole training, so that it can be done again."""

    job: Literal["tokenizer"]
    name: str
    seed: int = Field(ge=0)
    corpus: str
    network: NetworkRecipe
    training: TrainingRecipe
    loss: LossRecipe
    sources: list[FileSource | PushtSource | DrawnSource] = Field(min_length=1)

    def digest(self) -> str:
        """SHA-256 over all but where the corpus lies."""
        values = self.model_dump(mode="json", exclude={"corpus"})
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def load_recipe(path: Path, overrides: dict[str, Any] | None = None) -> TokenizerRecipe:
    """The recipe of a YAML file; `overrides` replace values by dotted key (`training.steps`).

    Raises:
        RecipeError: the file or an override is not valid.
    """
    values = read_yaml(path, RecipeError)
    for key, value in (overrides or {}).items():
        *parents, last = key.split(".")
        node = values
        for parent in parents:
            node = node.get(parent) if isinstance(node, dict) else None
        if not isinstance(node, dict):
            raise RecipeError(path, f"has no key {key!r} to override")
        node[last] = value
    try:
        return TokenizerRecipe.model_validate(values)
    except ValidationError as fault:
        first = fault.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise RecipeError(path, f"{place}: {first['msg']}, got {first['input']!r:.80}") from fault


def reconstruction_loss(made: Tensor, true: Tensor, weights: LossRecipe) -> tuple[Tensor, Tensor]:
    """The loss of (B, 3, S, S) pictures in [-1, 1], and the mean squared error in [0, 1] units."""
    made, true = (made + 1) / 2, (true + 1) / 2
    squared = functional.mse_loss(made, true)
    loss = weights.l2 * squared
    if weights.l1:
        loss = loss + weights.l1 * functional.l1_loss(made, true)
    if weights.gradient:
        loss = loss + weights.gradient * _gradient_loss(made, true)
    if weights.ssim:
        loss = loss + weights.ssim * (1 - ssim_map(_grey(made), _grey(true)).mean())
    return loss, squared.detach()


def _grey(pictures: Tensor) -> Tensor:
    weights = pictures.new_tensor([0.299, 0.587, 0.114]).view(1, 3, 1, 1)
    return (pictures * weights).sum(1, keepdim=True)


def _gradient_loss(made: Tensor, true: Tensor) -> Tensor:
    """Mean absolute error of the differences of neighbours, at three scales."""
    error = made - true
    total = error.new_zeros(())
    for _ in range(3):
        total = total + error.diff(dim=2).abs().mean() + error.diff(dim=3).abs().mean()
        error = functional.avg_pool2d(error, 2)
    return total / 3


def start_linear(network: FsqAutoencoder, crops: Tensor) -> None:
    """Set the linear paths to the principal components of the crops' patches, whitened and turned.

    Args:
        crops: (B, 3, S, S) in [-1, 1].
    """
    channels = network.config.channels
    patches = functional.unfold(crops, STRIDE, stride=STRIDE).transpose(1, 2).flatten(0, 1).double()
    mean = patches.mean(0)
    _, values, basis = torch.linalg.svd(patches - mean, full_matrices=False)
    scale = values[:channels, None] / math.sqrt(len(patches))
    whiten = basis[:channels] / scale
    # Turned at random, so that every channel carries a share of the strong components.
    turn = torch.linalg.qr(torch.randn(channels, channels, dtype=torch.float64))[0]
    # 1.7 u is the least-squares estimate of z from u = erf(z/√2), z standard normal.
    back = 1.7 * (turn @ (basis[:channels] * scale)).T
    whiten = turn @ whiten
    with torch.no_grad():
        network.encoder.linear.weight.copy_(whiten.view(channels, 3, STRIDE, STRIDE))
        network.encoder.linear.bias.copy_(-(whiten @ mean))  # type: ignore[union-attr]
        network.encoder.head.weight.mul_(0.1)
        network.decoder.linear.weight.copy_(back[:, :, None, None])
        network.decoder.linear.bias.copy_(mean)  # type: ignore[union-attr]
        network.decoder.head.weight.mul_(0.1)


class _Average:
    """Exponential moving average of a network's parameters."""

    def __init__(self, network: nn.Module, decay: float) -> None:
        self.decay, self.step = decay, 0
        self.values = {name: p.detach().clone() for name, p in network.named_parameters()}

    @torch.no_grad()
    def update(self, network: nn.Module) -> None:
        self.step += 1
        decay = min(self.decay, self.step / (self.step + 10))
        for name, parameter in network.named_parameters():
            self.values[name].lerp_(parameter, 1 - decay)


def _optimizers(network: FsqAutoencoder, recipe: TrainingRecipe) -> list[torch.optim.Optimizer]:
    matrices, others = [], []
    for name, parameter in network.named_parameters():
        inner = ".at" in name or ".down" in name or ".up" in name
        (matrices if inner and parameter.ndim == 4 else others).append(parameter)
    return [
        Muon(matrices, lr=recipe.learning_rate),
        torch.optim.Adam(others, lr=recipe.adam_learning_rate, betas=(0.9, 0.99)),
    ]


def _rate(step: int, recipe: TrainingRecipe) -> float:
    rise = min(1.0, (step + 1) / max(1, recipe.warmup_steps))
    return rise * min(1.0, 1.25 * (1 - step / recipe.steps) + 0.002)


def _batch(pools: list[Pool], recipe: TokenizerRecipe, step: int) -> Tensor:
    crops = draw_batch(pools, recipe.training.crop, recipe.training.batch, recipe.seed, step)
    return torch.from_numpy(crops).permute(0, 3, 1, 2)


def _latent_penalty(latents: Tensor) -> Tensor:
    """Keeps latents where the squashing still has a slope: zero mean, unit variance, no far tails."""
    per_channel = latents.transpose(0, 1).flatten(1)
    spread = (per_channel.var(1) - 1).square().mean() + per_channel.mean(1).square().mean()
    return spread + functional.relu(latents.abs() - 2.5).square().mean()


def train(
    recipe_path: Path,
    out: Path,
    overrides: dict[str, Any] | None = None,
    *,
    report: Callable[[str], None] = print,
    report_every: int = 100,
    start_from: Path | None = None,
) -> dict[str, Any]:
    """Train as the recipe says and write the weights.

    Args:
        recipe_path: YAML, see `TokenizerRecipe`.
        out: the weights' file; rewritten at every tenth report and at the end.
        overrides: values to replace in the recipe, by dotted key.
        report: takes a line of progress.
        report_every: steps between reports.
        start_from: weights of an earlier run of the same network to go on from.

    Returns:
        what the file's metadata says: recipe and corpus digests, steps, training PSNR.

    Raises:
        RecipeError: the recipe is not valid, or its corpus is not there.
        TokenizerError: `start_from` is not a weights' file of this network.
    """
    recipe = load_recipe(recipe_path, overrides)
    torch.set_num_threads(recipe.training.threads)
    torch.manual_seed(recipe.seed)
    pools, corpus_digest = load_pools(list(recipe.sources), Path(recipe.corpus).expanduser(), recipe.seed)
    report("pictures: " + ", ".join(f"{pool.name} {len(pool.pictures)}" for pool in pools))
    network = _network(recipe, pools, start_from)
    optimizers = _optimizers(network, recipe.training)
    average = _Average(network, recipe.training.ema)
    facts = {"recipe": recipe.name, "recipe_sha256": recipe.digest(), "corpus_sha256": corpus_digest, "seed": recipe.seed}  # fmt: skip
    started, squared = time.monotonic(), 0.0
    for step in range(recipe.training.steps):
        squared += _step(network, optimizers, _batch(pools, recipe, step), recipe, step)
        average.update(network)
        done = step + 1
        if done % report_every == 0 or done == recipe.training.steps:
            mean = squared / ((done - 1) % report_every + 1)
            facts |= {"steps": done, "train_psnr_db": round(-10 * math.log10(mean), 2)}
            report(f"step {done}: training PSNR {facts['train_psnr_db']} dB, {time.monotonic() - started:.0f} s")
            squared = 0.0
            if done % (10 * report_every) == 0 or done == recipe.training.steps:
                save_weights(out, recipe.network.config(), average.values, facts)
    return facts


def _network(recipe: TokenizerRecipe, pools: list[Pool], start_from: Path | None) -> FsqAutoencoder:
    from hma_data.tokenizers.fsq import read_weights

    network = FsqAutoencoder(recipe.network.config())
    if start_from is None:
        first = draw_batch(pools, recipe.training.crop, 256, recipe.seed, -1 % 2**32)
        start_linear(network, torch.from_numpy(np.ascontiguousarray(first.transpose(0, 3, 1, 2))))
    else:
        config, tensors, _ = read_weights(start_from)
        if config != recipe.network.config():
            raise RecipeError(start_from, "holds another network than the recipe's")
        network.load_state_dict(tensors)
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload,no-any-return]


def _step(
    network: FsqAutoencoder,
    optimizers: list[torch.optim.Optimizer],
    crops: Tensor,
    recipe: TokenizerRecipe,
    step: int,
) -> float:
    rate = _rate(step, recipe.training)
    for optimizer, highest in zip(
        optimizers, (recipe.training.learning_rate, recipe.training.adam_learning_rate)
    ):
        optimizer.param_groups[0]["lr"] = highest * rate
    made, latents = network(crops)
    loss, squared = reconstruction_loss(made, crops, recipe.loss)
    loss = loss + 0.01 * _latent_penalty(latents)
    loss.backward()
    nn.utils.clip_grad_norm_(network.parameters(), 1.0)
    for optimizer in optimizers:
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
    return float(squared)
