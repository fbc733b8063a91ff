"""Estimate the memory that training needs, before its first step, and refuse what does not fit.

A process that needs more than there is ends without a word: the system kills it. The estimate adds up the
weights with their gradients and moments, what a forward pass keeps for the backward pass, and the process
itself. Its factors were fitted to measured peaks on a CPU (`tests/model/training/test_memory.py`).
On a GPU only the weights are refused beforehand: what does not fit there ends in an error, which names the
batch that would fit by the same estimate.

B windows a pass, T frames of a pass, S tokens of a frame, D width.
"""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import product
from pathlib import Path

import torch

from hma_data.errors import RecipeError, TrainingError
from hma_model.config import OBJECTIVES, HMAConfig
from hma_model.network.network import Network
from hma_model.training.data import share
from hma_model.training.recipe import Recipe

GIB = 2**30
SMALLER = "model.layers=4 model.width=128 model.heads=4"
_NO_MEMORY = re.compile("out of memory|can't allocate memory|not enough memory|bad_alloc", re.IGNORECASE)
PROCESS = 0.4 * GIB  # what a process gains before its first pass: kernels, threads, decoded rows
# A block keeps so many values for each value of its input, besides those of the MLP's hidden layer.
BLOCK_VALUES = 21.0
CHECKPOINT_VALUES = 9.0  # of a block that is recomputed
PASS_VALUES = 23.0  # of the embedding and of the backward pass through one block
BF16_SHARE = 0.7  # of float32's bytes: norms and sums stay float32
HIDDEN_SHARE = 0.8  # of the tokens are masked and predicted, at most, as a rule
SCORE_COPIES = 3  # scores, their softmax, and their gradient
KERNEL_VALUES = 6  # of a digit: numbers of 8 bytes of it and of the one before, its gain, its total
DIFFUSION_VALUES = 13.0  # of a layer of the diffusion head, for each of its width
UNET_VALUES = 9.0  # of a U-Net's block, for each value of its result
UNET_BF16_SHARE = 0.54


def activation_bytes(config: HMAConfig, recipe: Recipe, windows: int, device: torch.device) -> float:
    """Return the bytes that a pass over B windows on a device keeps for its backward pass."""
    predicts_video = any(OBJECTIVES[name].predicts_video for name in recipe.objectives)
    frames = recipe.frames  # a checkpoint's window may be another one
    predicted = frames - 1 if predicts_video else 0
    if config.trunk == "unet":
        return windows * _unet_bytes(config, recipe, predicted, _score_values(config, recipe, device))
    if config.training_pass == "pairs" and predicts_video:
        frames += predicted  # a masked copy of each frame from the second on
    values = windows * frames * (config.tokens_per_frame + config.appended_tokens) * config.width
    block = BLOCK_VALUES + config.mlp_ratio
    if recipe.precision == "bf16":
        block *= BF16_SHARE
    kept = CHECKPOINT_VALUES * config.layers + block if recipe.checkpointing else block * config.layers
    hidden = windows * predicted * config.tokens_per_frame * HIDDEN_SHARE
    if config.discrete:
        read = _score_values(config, recipe, device)
    else:
        read = int(DIFFUSION_VALUES * config.diffusion_depth * config.diffusion_width)
    return 4.0 * (values * (kept + PASS_VALUES) + hidden * read)


def _score_values(config: HMAConfig, recipe: Recipe, device: torch.device) -> int:
    """Return how many values are kept for the scores of a token."""
    if not config.discrete:
        return 0
    digits = config.digits
    if config.digit_order == "chain":
        return SCORE_COPIES * (sum(digits) + len(digits) * config.width)
    plain = len(set(digits)) == 1 and not config.label_smoothing
    if plain and device.type == "cpu" and not recipe.compile:  # `network.cross_entropy` keeps no scores
        return config.width + KERNEL_VALUES * len(digits)
    return SCORE_COPIES * sum(digits)


def _unet_bytes(config: HMAConfig, recipe: Recipe, predicted: int, scores: int) -> float:
    """Return the bytes that a U-Net's pass over one window keeps for its backward pass.

    A block keeps the same number of values for each of its result; most lie at the finest resolution.
    """
    places = config.tokens_per_frame // config.views
    if config.crop and recipe.whole_from == 1:
        places = config.crop**2
    sizes = [channels * places / 4**level for level, channels in enumerate(config.levels)]
    down_and_up = sum(sizes) + sum(sizes[:-1])
    blocks = UNET_VALUES * config.layers * down_and_up
    if recipe.checkpointing:  # what enters each block, and the values of the one that is recomputed
        blocks = config.layers * down_and_up + UNET_VALUES * sizes[0]
    every = any(not OBJECTIVES[name].predicts_video or OBJECTIVES[name].readout for name in recipe.objectives)
    computed = predicted + every * recipe.frames  # those before the predicted ones only then
    embedded = 2 * config.frames * places * config.views * config.width
    share = UNET_BF16_SHARE if recipe.precision == "bf16" else 1.0
    return 4.0 * (share * computed * (blocks + embedded) + predicted * scores * places * config.views)


def needed_bytes(
    model: Network, recipe: Recipe, device: torch.device, ranks: int = 1, passes: bool | None = None
) -> float:
    """Return the estimated bytes of one rank's training; the model may be on the device `meta`.

    Those of its passes are counted if `passes`; by default on a CPU only.
    """
    weights = sum(parameter.numel() for parameter in model.parameters())
    trained = weights
    if recipe.freeze == "trunk":
        trained = sum(p.numel() for module in (model.stems, model.heads) for p in module.parameters())
    values = weights + 3 * trained  # a gradient and two moments each
    if recipe.ema:
        values += trained + weights  # the averages, and the model that evaluates them
    of_weights = 4.0 * values / (ranks if recipe.parallel == "fsdp" else 1)
    if not (device.type != "cuda" if passes is None else passes):
        return of_weights
    return PROCESS + of_weights + activation_bytes(model.config, recipe, share(recipe, ranks)[1], device)


def free_bytes(device: torch.device) -> float:
    """Return the memory that a rank can still get: of a GPU all of it, else its share of what is free."""
    if device.type == "cuda":
        return float(torch.cuda.get_device_properties(device).total_memory)
    free = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    with suppress(OSError, ValueError, StopIteration):  # elsewhere than on Linux
        lines = Path("/proc/meminfo").read_text().splitlines()
        free = 1024.0 * int(next(line for line in lines if line.startswith("MemAvailable")).split()[1])
    with suppress(OSError, ValueError):  # a container's limit; "max" is none
        free = min(free, float(Path("/sys/fs/cgroup/memory.max").read_text()))
    return free / int(os.environ.get("LOCAL_WORLD_SIZE", "1"))


def require_memory(model: Network, recipe: Recipe, device: torch.device, ranks: int = 1) -> None:
    """Refuse a training that needs more memory than there is, and say which keys would make it fit.

    Args:
        model: the network, which may be on the device `meta`.
        recipe: its training.
        device: where it will be.
        ranks: of the run; those of this machine share its memory.

    Raises:
        RecipeError: the estimate is above the memory that is free.
    """
    needed, there = needed_bytes(model, recipe, device, ranks), free_bytes(device)
    if needed <= there:
        return
    remedy = _remedy(model, recipe, device, ranks, recipe.batch_size)
    weights = sum(parameter.numel() for parameter in model.parameters())
    what = f"{weights / 1e6:,.0f} million weights and {share(recipe, ranks)[1]} windows per pass"
    fault = f"needs about {needed / GIB:,.1f} GiB ({what}), and {there / GIB:,.1f} GiB are free"
    raise RecipeError("recipe: memory", fault, remedy)


@contextmanager
def memory_errors(model: Network, recipe: Recipe, device: torch.device, ranks: int = 1) -> Iterator[None]:
    """Convert an error of the block for want of memory into one that names the batch that would fit.

    Raises:
        TrainingError: the block needed more memory than there is.
    """
    try:
        yield
    except (RuntimeError, MemoryError) as fault:
        text = str(fault).partition("\n")[0][:200]
        if isinstance(fault, RuntimeError) and not _NO_MEMORY.search(text):
            raise
        remedy = _remedy(model, recipe, device, ranks, recipe.batch_size // 2)
        told = ": ".join(filter(None, ("too little for this model and batch", text)))
        raise TrainingError("memory", told, remedy) from fault


def _remedy(model: Network, recipe: Recipe, device: torch.device, ranks: int, most: int) -> str:
    """Return what to do: set the keys of the largest passes, of `most` windows or fewer, that should fit."""
    there = free_bytes(device)
    sizes = [most >> halvings for halvings in range(most.bit_length())]
    for checkpointing, size in product(dict.fromkeys((recipe.checkpointing, True)), sizes):
        keys = {"batch_size": size, "accumulate": -(-recipe.windows_per_step // size)}
        if checkpointing:
            keys["checkpointing"] = True
        even = size * keys["accumulate"] % ranks == 0
        smaller = recipe.model_copy(update=keys)
        if even and needed_bytes(model, smaller, device, ranks, passes=True) <= there:
            return "set " + " ".join(f"{key}={str(value).lower()}" for key, value in keys.items())
    return f"use a smaller network, as in {SMALLER}"
