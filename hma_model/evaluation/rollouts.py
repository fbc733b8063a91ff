"""Roll a model out from the first frames of windows.

B batch, T frames, P frames of the prompt, S pixels a side, C cameras.
"""

import warnings
from dataclasses import dataclass
from typing import TypedDict, Unpack

import numpy as np
import torch
from torch import Tensor

from hma_data.arrays import Bools, Images
from hma_data.errors import UsageError
from hma_data.loading.dataset import Batch
from hma_data.tokenizers.base import Tokenizer
from hma_model.generation.commands import OutsideRangeWarning
from hma_model.generation.decode import decode, default_prompt
from hma_model.network.model import HMA


class Sampling(TypedDict, total=False):
    """Options of `HMA.generate` that a rollout passes on to it."""

    unmask_steps: int
    temperature: float | None
    order: str
    sample_steps: int | None
    precision: str
    compile: bool


@dataclass(frozen=True)
class RolloutImages:
    """A rollout and the truth, both uint8 (B, T, S, C·S, 3); the first P frames are the prompt.

    Attributes:
        stored: (B, T - P, …) the predicted tokens or latents.
        finite: (B, T - P) bool, False where the model predicted NaN or infinity; such a frame is black.
    """

    prompt: int
    predicted: Images
    truth: Images
    stored: Tensor
    finite: Bools


def rollout(
    model: HMA,
    tokenizer: Tokenizer,
    batch: Batch,
    frames: int | None = None,
    *,
    prompt: int | None = None,
    seed: int = 0,
    truth: Images | None = None,
    **sampling: Unpack[Sampling],
) -> RolloutImages:
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
    seen = slice(first + count)
    given, chunks = batch.stored[:, :first].to(model.device), batch.actions[:, seen].to(model.device)
    generator = torch.Generator().manual_seed(seed)
    known = batch.action_mask[:, seen].to(model.device) & model.config.sees_actions
    passive = model.config.absent_action != "embedding" and not known.any()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OutsideRangeWarning)  # nobody chose these actions
        predicted = model.generate(
            given, None if passive else chunks, batch.embodiment, count, generator=generator,
            known=None if passive else known, **sampling,
        ).cpu()  # fmt: skip
    if truth is None:
        truth = decode(tokenizer, batch.stored[:, seen])
    finite = finite_frames(predicted)
    made = decode(tokenizer, predicted)
    made[~finite] = 0  # black, so that a page shows that there is no prediction
    return RolloutImages(first, np.concatenate([truth[:, :first], made], axis=1), truth, predicted, finite)


def finite_frames(stored: Tensor) -> Bools:
    """Return which frames (B, T) of predicted tokens or latents are free of NaN and infinity."""
    return stored.isfinite().flatten(2).all(dim=2).numpy(force=True)
