"""Train an embedded tokenizer from a recipe.

    train(Path("recipes/tokenizer/fsq.yaml"), Path("fsq.safetensors"), {"corpus": "/data/corpus"})

The loss needs no pretrained network: squared and absolute error, gradients at several scales, and SSIM.
Before the first step the network is the best linear code of patches (their principal components); the
other layers start near zero and learn the remaining error. At every report the run writes a weights'
file, and its state beside it. The same call resumes a run that was stopped, on any device.

B crops, S side of a crop, C latent channels.
"""

import hashlib
import json
import math
import platform
import time
from collections.abc import Callable, Iterator
from functools import partial
from io import BytesIO
from operator import gt
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from hma_data.cpu import in_order
from hma_data.errors import HMAError, RecipeError, TokenizerError
from hma_data.storage.files import opened_weights, remove_dead_parts, write_atomic
from hma_data.storage.kinds import one_line
from hma_data.storage.paths import StrPath, as_path
from hma_data.tokenizers.base import OTHER
from hma_data.tokenizers.checkpoints import fill, read_weights, save_weights
from hma_data.tokenizers.embedded import Autoencoder, FsqAutoencoder, VaeAutoencoder
from hma_data.tokenizers.network import open_device
from hma_data.tokenizers.shapes import FsqConfig, VaeConfig
from hma_data.tokenizers.training.eval import GREY, ssim_map
from hma_data.tokenizers.training.frames import Pool, draw_batch, load_pools
from hma_data.tokenizers.training.muon import Muon
from hma_data.tokenizers.training.recipe import LossRecipe, TokenizerRecipe, TrainingRecipe, load_recipe

# Step numbers, which no training reaches, of the batches that initialise and measure a network
START_STEP = 2**32 - 1
END_STEP = 2**32 - 2

EDGE_REACH, EDGE_CONTRAST = 4, 0.12  # pixels; difference of grey values in [0, 1]


def reconstruction_loss(made: Tensor, true: Tensor, weights: LossRecipe) -> tuple[Tensor, Tensor]:
    """Return the loss of (B, 3, S, S) images in [-1, 1], and the mean squared error in [0, 1] units."""
    made, true = (made + 1) / 2, (true + 1) / 2
    error = made - true
    squared = error.square().mean()
    share = _edge_weights(true, weights.edges) if weights.edges else true.new_ones(())
    loss = weights.l2 * (share * error.square()).mean()
    if weights.l1:
        loss = loss + weights.l1 * (share * error.abs()).mean()
    if weights.gradient:
        loss = loss + weights.gradient * _gradient_loss(made, true)
    if weights.ssim:
        shares = made.new_tensor(GREY).view(1, 3, 1, 1)
        grey = [(pictures * shares).sum(1, keepdim=True) for pictures in (made, true)]
        loss = loss + weights.ssim * (1 - ssim_map(*grey).mean())
    return loss, squared.detach()


def _edge_weights(true: Tensor, edges: float) -> Tensor:
    """Return weights (B, 1, S, S) of mean 1: pixels within EDGE_REACH of an edge count 1 + `edges` times."""
    grey = true.mean(1, keepdim=True)
    side = 2 * EDGE_REACH + 1
    highest = functional.max_pool2d(grey, side, 1, EDGE_REACH)
    lowest = -functional.max_pool2d(-grey, side, 1, EDGE_REACH)
    counts = 1 + edges * (highest - lowest > EDGE_CONTRAST).to(true.dtype)
    return counts / counts.mean()


def _gradient_loss(made: Tensor, true: Tensor) -> Tensor:
    """Return the mean absolute error of the differences of neighbours, at three scales."""
    error = made - true
    total = error.new_zeros(())
    for _ in range(3):
        total = total + error.diff(dim=2).abs().mean() + error.diff(dim=3).abs().mean()
        error = functional.avg_pool2d(error, 2)
    return total / 3


def start_linear(network: Autoencoder, crops: Tensor) -> None:
    """Set the linear paths to the principal components of the crops' patches, whitened and rotated.

    Args:
        crops: (B, 3, S, S) in [-1, 1].
    """
    encoder, decoder, stride = network.encoder, network.decoder, network.stride
    channels = encoder.linear.out_channels
    patches = functional.unfold(crops, stride, stride=stride).transpose(1, 2).flatten(0, 1).double()
    mean = patches.mean(0)
    _, values, basis = torch.linalg.svd(patches - mean, full_matrices=False)
    scale = values[:channels, None] / math.sqrt(len(patches))
    whiten = basis[:channels] / scale
    # Rotated at random, so that every channel carries a share of the strong components.
    turn = torch.linalg.qr(torch.randn(channels, channels, dtype=torch.float64))[0]
    back = network.linear_gain * (turn @ (basis[:channels] * scale)).T
    whiten = turn @ whiten
    with torch.no_grad():
        encoder.linear.weight.copy_(whiten.view(channels, 3, stride, stride))
        encoder.linear.bias.copy_(-(whiten @ mean))  # type: ignore[union-attr]
        encoder.head.weight.mul_(0.1)
        decoder.linear.weight.copy_(back[:, :, None, None])
        decoder.linear.bias.copy_(mean)  # type: ignore[union-attr]
        decoder.head.weight.mul_(0.1)


def start_from(network: Autoencoder, source: StrPath) -> str:
    """Set a network's weights to those of a file that a training wrote, of a network that is no larger.

    What the network has more of begins without a say: it decodes as the smaller one does.

    Args:
        network: the network to set.
        source: str or path of the file.

    Returns:
        The digest of the tokens that the file's encoder makes, see `tokens_sha256`.

    Raises:
        TokenizerError: there is no such file, or its weights are of another network.
    """
    path = as_path(source).expanduser()
    _, tensors, sha256 = read_weights(path, network.shape.format, network.shape)
    grown = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    for name, old in tensors.items():
        new = grown.get(name)
        if new is None or old.shape[2:] != new.shape[2:] or any(map(gt, old.shape, new.shape)):
            raise TokenizerError(path, f"does not fit into the recipe's network: {name}", OTHER)
        inner = tuple(map(slice, old.shape))
        new[inner[0]] = 0  # what is there does not hear what is new
        new[inner] = old
    fill(network, grown, path)
    return sha256


class TokenizerTraining:
    """A training in progress: network, averaged weights, optimizers, and the step it has reached."""

    def __init__(self, recipe: TokenizerRecipe, pools: list[Pool], device: torch.device) -> None:
        self.recipe, self.pools, self.step, self.seconds = recipe, pools, 0, 0.0
        torch.manual_seed(recipe.seed)
        config, tokens = recipe.network, ""
        network = FsqAutoencoder(config) if isinstance(config, FsqConfig) else VaeAutoencoder(config)
        if recipe.start is None:
            start_linear(network, self.batch(START_STEP, 256))
        else:
            tokens = start_from(network, recipe.start)
        network.encoder.requires_grad_(not recipe.training.decoder_only)
        self.tokens_sha256 = tokens if recipe.training.decoder_only else ""
        self.device = device
        self.network: Autoencoder = network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = {name: p.detach().clone() for name, p in self.network.named_parameters()}
        self.optimizers = _optimizers(self.network, recipe.training)

    def batch(self, step: int, count: int) -> Tensor:
        """Return the (B, 3, S, S) crops of a step, in the CPU's memory."""
        crops = draw_batch(self.pools, self.recipe.training.crop, count, self.recipe.seed, step)
        return torch.from_numpy(crops).permute(0, 3, 1, 2)

    def advance(self, crops: Tensor) -> float:
        """Take one step on its crops; return their mean squared error, pixels in [0, 1]."""
        training = self.recipe.training
        for optimizer, highest in zip(self.optimizers, (training.learning_rate, training.adam_learning_rate)):
            optimizer.param_groups[0]["lr"] = highest * training.rate(self.step)
        crops = crops.to(self.device)
        generator = torch.Generator().manual_seed((self.recipe.seed * 1_000_003 + self.step) % 2**63)
        made, latents = self.network(crops, generator)
        loss, squared = reconstruction_loss(made, crops, self.recipe.loss)
        (loss + 0.01 * _latent_penalty(latents)).backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        for optimizer in self.optimizers:
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        self.step += 1
        decay = min(training.ema, self.step / (self.step + 10))
        with torch.no_grad():
            for name, parameter in self.network.named_parameters():
                self.average[name].lerp_(parameter, 1 - decay)
        return float(squared)

    @torch.no_grad()
    def write_weights(self, path: Path, facts: dict[str, Any]) -> None:
        """Write the averaged weights as a tokenizer's file, with the facts of the training."""
        config = self.recipe.network
        if isinstance(config, VaeConfig):  # measure its scale on the averaged encoder
            network = VaeAutoencoder(config)
            network.load_state_dict(self.average)
            scale = round(1 / float(network.encoder(self.batch(END_STEP, 128)).std()), 4)
            config = config.model_copy(update={"latent_scale": scale})
        save_weights(path, config.format, config, self.average, facts, self.tokens_sha256)

    def save(self, path: Path) -> None:
        """Write what `resume` needs, atomically."""
        content = {
            "past": [self.recipe.course(), self._past_rates(self.step)],
            "step": self.step,
            "seconds": self.seconds,
            "network": self.network.state_dict(),
            "average": self.average,
            "optimizers": [optimizer.state_dict() for optimizer in self.optimizers],
        }
        state = BytesIO()
        torch.save(content, state)
        write_atomic(path, state.getvalue())

    def resume(self, path: Path) -> None:
        """Resume from a state that `save` wrote.

        Raises:
            RecipeError: the file is not such a state, or is of a training with other settings.
        """
        remedy = f"delete {path.name} to start again"
        try:
            state = torch.load(path, map_location=self.device, weights_only=True)
            past, step = state["past"], state["step"]
        except Exception as fault:  # torch raises many kinds of errors on a damaged file
            text = f"is not the saved state of a training: {one_line(fault, 120)}"
            raise RecipeError(path, text, remedy) from fault
        if past != [self.recipe.course(), self._past_rates(step)]:
            raise RecipeError(path, "is the state of a training with other settings", remedy)
        self.step, self.seconds, self.average = step, state["seconds"], state["average"]
        self.network.load_state_dict(state["network"])
        for optimizer, own in zip(self.optimizers, state["optimizers"], strict=True):
            optimizer.load_state_dict(own)

    def _past_rates(self, step: int) -> str:
        """Return a digest of the rates of all steps before this one."""
        rates = [round(self.recipe.training.rate(past), 9) for past in range(step)]
        return hashlib.sha256(repr(rates).encode()).hexdigest()


def _optimizers(network: Autoencoder, recipe: TrainingRecipe) -> list[torch.optim.Optimizer]:
    matrices: list[nn.Parameter] = []
    others: list[nn.Parameter] = []
    for name, parameter in network.named_parameters():
        if not parameter.requires_grad:
            continue
        inner = ".at" in name or ".down" in name or ".up" in name
        (matrices if inner and parameter.ndim == 4 else others).append(parameter)
    return [
        Muon(matrices, lr=recipe.learning_rate, decay=recipe.weight_decay),
        torch.optim.Adam(others, lr=recipe.adam_learning_rate, betas=(0.9, 0.99)),
    ]


def _latent_penalty(latents: Tensor) -> Tensor:
    """Return a penalty that keeps latents at zero mean, unit variance and short tails.

    In that range the squashing still has a gradient.
    """
    per_channel = latents.transpose(0, 1).flatten(1)
    spread = (per_channel.var(1) - 1).square().mean() + per_channel.mean(1).square().mean()
    return spread + functional.relu(latents.abs() - 2.5).square().mean()


def train(
    recipe_path: StrPath,
    out: StrPath,
    overrides: dict[str, Any] | None = None,
    *,
    device: str = "cpu",
    workers: int = 0,
    report: Callable[[str], None] = print,
    report_every: int = 100,
) -> dict[str, Any]:
    """Train as the recipe states and write the weights; resume a run that was stopped.

    Args:
        recipe_path: str or path of a YAML, see `hma_data.tokenizers.training.recipe.TokenizerRecipe`.
        out: str or path of the weights' file, rewritten at every report; `<out>.state` holds the run until
            it ends.
        overrides: values to replace in the recipe, by dotted key.
        device: device that trains the network: cpu, cuda, mps.
        workers: threads that draw crops ahead; 0 draws each batch when it is needed. The crops are the same.
        report: called with each line of progress.
        report_every: steps between reports.

    Returns:
        The facts in the file's metadata: recipe and corpus digests, seed, steps, training PSNR, seconds
        and machine.

    Raises:
        RecipeError: the recipe is not valid, its corpus is not there, or the state beside `out`
            is another training's.
        TokenizerError: there is no such device.
    """
    place, out = open_device("tokenizer train", device), as_path(out)
    recipe = load_recipe(recipe_path, overrides)
    torch.set_num_threads(recipe.training.threads)
    pools, corpus_sha256 = load_pools(recipe.sources, Path(recipe.corpus).expanduser())
    report("pictures: " + ", ".join(f"{pool.name} {len(pool.pictures)}" for pool in pools))
    state = out.with_name(out.name + ".state")
    threads = recipe.training.threads
    processor = torch.cuda.get_device_name(place) if place.type == "cuda" else f"{threads} thread"
    facts: dict[str, Any] = {
        "recipe": recipe.name,
        "recipe_sha256": recipe.digest(),
        "corpus_sha256": corpus_sha256,
        "seed": recipe.seed,
        "machine": f"{platform.machine()}, {processor}, torch {torch.__version__}",
    }
    remove_dead_parts(out.parent)  # of a run that was killed
    if not state.exists() and (told := _finished(out, facts, recipe.training.steps)):
        report(f"finished already after step {recipe.training.steps}")
        return told
    run = TokenizerTraining(recipe, pools, place)
    if state.exists():
        run.resume(state)
        report(f"resuming from step {run.step}")
    # Far below zero the slope of silu is a denormal number; denormal numbers make a step seven times slower.
    torch.set_flush_denormal(True)
    errors: list[float] = []
    last = time.monotonic()
    draw = partial(run.batch, count=recipe.training.batch)
    steps = range(run.step, recipe.training.steps)
    drawn: Iterator[Tensor] = map(draw, steps)
    if workers:  # threads draw ahead
        drawn = (crops for _, crops in in_order(draw, steps, workers))
    try:
        for crops in drawn:
            errors.append(run.advance(crops))
            now = time.monotonic()
            run.seconds, last = run.seconds + now - last, now
            if run.step % report_every == 0 or run.step == recipe.training.steps:
                psnr = round(-10 * math.log10(sum(errors) / len(errors)), 2)
                facts |= {"steps": run.step, "train_psnr_db": psnr, "seconds": round(run.seconds)}
                errors.clear()
                run.write_weights(out, facts)
                run.save(state)
                report(f"step {run.step}: training PSNR {psnr} dB, {run.seconds:.0f} s")
    finally:
        torch.set_flush_denormal(False)
    state.unlink(missing_ok=True)
    return facts


def _finished(out: Path, facts: dict[str, Any], steps: int) -> dict[str, Any] | None:
    """Return what the weights' file says of its training, if that is this one to its last step."""
    try:
        with opened_weights(out) as file:
            told: dict[str, Any] = json.loads((file.metadata() or {}).get("training", "{}"))
    except (HMAError, ValueError):
        return None
    asked = {key: facts[key] for key in ("recipe_sha256", "corpus_sha256", "seed")} | {"steps": steps}
    return told if asked.items() <= told.items() else None
