"""Roll a model out from the first frames of windows, and decode what it predicts.

B batch, T frames, P frames of the prompt, h,w grid, S pixels a side, C cameras.
"""

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypedDict, Unpack

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hma_data.errors import UsageError
from hma_data.loading.dataset import Batch
from hma_data.loading.views import FIRST, Cameras, view_count
from hma_data.shards.reader import ShardSet
from hma_data.tokenizers.network import NetworkTokenizer
from hma_model.checkpoint.folder import Checkpoint
from hma_model.generation.commands import OutsideRangeWarning

if TYPE_CHECKING:
    from hma_data.tokenizers.base import Tokenizer
    from hma_model.network.model import HMA


class Sampling(TypedDict, total=False):
    """Options of `HMA.generate` that a rollout passes on to it."""

    unmask_steps: int
    temperature: float | None
    order: str
    sample_steps: int | None
    guidance: float
    noise_level: float
    precision: str
    compile: bool


@dataclass(frozen=True)
class Pictures:
    """A rollout and the truth, both uint8 (B, T, S, C·S, 3); the first P frames are the prompt.

    Attributes:
        stored: (B, T - P, …) the predicted tokens or latents.
        finite: (B, T - P) bool, False where the model predicted NaN or infinity; such a frame is black.
    """

    prompt: int
    predicted: NDArray[np.uint8]
    truth: NDArray[np.uint8]
    stored: Tensor
    finite: NDArray[np.bool_]


def rollout(
    model: "HMA",
    tokenizer: "Tokenizer",
    batch: Batch,
    frames: int | None = None,
    *,
    prompt: int | None = None,
    seed: int = 0,
    truth: NDArray[np.uint8] | None = None,
    **sampling: Unpack[Sampling],
) -> Pictures:
    """Predict the frames that follow the first frames of each window, given its actions.

    Args:
        model: in eval mode.
        tokenizer: the tokenizer that the model was trained on.
        batch: windows of T frames; their tokens are the truth, and their unknown chunks are masked.
        frames: how many to predict; by default all after the prompt.
        prompt: P true frames to start from; by default a third of the window, at least one.
        seed: of every random draw.
        truth: the decoded frames of another rollout of the same windows, which are then not decoded again.
        sampling: options of `HMA.generate`.

    Raises:
        UsageError: the prompt and the frames do not fit the windows, or one of them is empty.
    """
    length = batch.actions.shape[1]
    first = default_prompt(length) if prompt is None else prompt
    count = length - first if frames is None else frames
    if first < 1 or count < 1 or first + count > length:
        raise UsageError("rollout", f"{first} + {count} frames do not fit windows of {length}")
    stored = batch.tokens if model.config.kind == "discrete" else batch.latents
    assert stored is not None
    given, chunks = stored[:, :first].to(model.device), batch.actions
    chunks = chunks[:, : first + count].to(model.device)
    generator = torch.Generator().manual_seed(seed)
    known = batch.action_mask[:, : first + count].to(model.device) & model.config.sees_actions
    passive = model.config.absent_action != "embedding" and not known.any()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OutsideRangeWarning)  # nobody chose these commands
        predicted = model.generate(
            given, None if passive else chunks, batch.embodiment, count, generator=generator,
            known=None if passive else known, **sampling,
        ).cpu()  # fmt: skip
    if truth is None:
        truth = decode(tokenizer, stored[:, : first + count])
    finite = np.ones(predicted.shape[:2], np.bool_)
    if predicted.is_floating_point():
        finite = predicted.isfinite().flatten(2).all(dim=2).cpu().numpy()
    made = decode(tokenizer, predicted.nan_to_num(0, 0, 0))
    made[~finite] = 0
    return Pictures(first, np.concatenate([truth[:, :first], made], axis=1), truth, predicted, finite)


def default_prompt(length: int) -> int:
    """Return how many frames of a window of this length a rollout starts from."""
    return max(1, length // 3)


def decode(tokenizer: "Tokenizer", stored: Tensor) -> NDArray[np.uint8]:
    """Decode ids (B, T, C·h, w) or latents (B, T, c, C·H, W) to pictures (B, T, S, C·S, 3), side by side."""
    views, rows = stored.flatten(0, 1), tokenizer.spec.grid[0]
    if isinstance(tokenizer, NetworkTokenizer) and not stored.is_cpu:  # tokens stay on the GPU
        kept = views if tokenizer.spec.kind == "discrete" else views.half()
        pictures = torch.cat([tokenizer.pictures(view) for view in kept.split(rows, -2)], 2).numpy(force=True)
    else:
        dtype = np.uint32 if tokenizer.spec.kind == "discrete" else np.dtype(tokenizer.spec.dtype)
        cameras = np.split(views.cpu().numpy().astype(dtype), views.shape[-2] // rows, axis=-2)
        pictures = np.concatenate([tokenizer.decode(view) for view in cameras], axis=2)
    return pictures.reshape(*stored.shape[:2], *pictures.shape[1:])


def cameras_for(model: "HMA", shards: ShardSet, cameras: Cameras | None = None) -> Cameras:
    """Return the cameras that a model sees: those given, or those that it was trained on.

    Raises:
        UsageError: these are more or fewer than the views of the model.
    """
    if cameras is None and "origin" in vars(model):
        card = Checkpoint.open(vars(model)["origin"]).card(shards.embodiment.id)
        cameras = card.get("data", {}).get("cameras")
    cameras = FIRST if cameras is None else cameras
    if (count := view_count(cameras)) != model.config.views:
        fault = f"are {count} in a frame, but the model takes {model.config.views}"
        raise UsageError(
            "cameras", fault, f"name {model.config.views} of {', '.join(shards.manifest.cameras)}"
        )
    return cameras
