"""Check the actions that callers give a rollout, and assign them to frames.

n rows, P frames of a prompt, K = stride * action dim of the widest of the rows' embodiments.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from hma_data.errors import HMAError
from hma_model.network.conditioning import ActionConditioning
from hma_model.network.network import Network


def prompt_chunks(
    model: Network, names: Sequence[str], actions: Tensor | None, known: Tensor | None, frames: int
) -> ActionConditioning:
    """Return the chunk at each of P known frames.

    Where actions align with the current frame, the last frame has none yet: a step gives it.

    Args:
        names: n embodiments.
        actions: (n, P - 1 or more, K) raw; None for no actions.
        known: (n, P - 1 or more) bool; None if all are.
        frames: P.

    Raises:
        HMAError: the shapes are others.
    """
    batch, width, device = len(names), model.widest_chunk(names), model.device
    chunks = torch.zeros(batch, frames, width, device=device)
    given = ActionConditioning(chunks, torch.zeros(batch, frames, dtype=torch.bool, device=device))
    if actions is None or frames == 1:
        return given
    if actions.shape[0] != batch or actions.shape[1] < frames - 1 or actions.shape[2] < width:
        fault = f"actions have the shape {tuple(actions.shape)} for a prompt of {frames} frames"
        raise HMAError("prompt", fault, f"give ({batch}, {frames - 1} or more, {width})")
    if known is not None and (known.shape[0] != batch or known.shape[1] < frames - 1):
        fault = f"known has the shape {tuple(known.shape)} for a prompt of {frames} frames"
        raise HMAError("prompt", fault, f"give ({batch}, {frames - 1} or more)")
    late = int(model.config.action_alignment == "previous")
    conditioned = given.frames(slice(late, frames - 1 + late))  # a view
    conditioned.chunks[:] = actions[:, : frames - 1, :width].to(device).float()
    conditioned.known[:] = True if known is None else known[:, : frames - 1].to(device)
    return given


def step_chunk(model: Network, names: Sequence[str], chunk: Tensor) -> Tensor:
    """Return the chunk (n, K) of a step on the model's device; raise HMAError if its shape is another."""
    width = model.widest_chunk(names)
    if chunk.dim() != 2 or chunk.shape[0] != len(names) or chunk.shape[1] < width:
        raise HMAError("step", f"a chunk has the shape {tuple(chunk.shape)}", f"give ({len(names)}, {width})")
    return chunk[:, :width].to(model.device).float()
