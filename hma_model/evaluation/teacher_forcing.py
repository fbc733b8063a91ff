"""Compute the loss of every frame of a window, fully masked, given the true past, in one pass.

The input is the true frames of the window, then each frame from the second on again, masked, at the same
time. A frame sees itself and the true frames before it, so one pass replaces one pass for each frame.

B batch, T frames, h,w grid, S = h*w.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from hma_model.evaluation.metrics import token_hits, token_nats
from hma_model.network.conditioning import ActionConditioning, Groups, align, condition
from hma_model.network.trunk import TimePositions, rotary_angles

if TYPE_CHECKING:
    from hma_data.loading.dataset import Batch
    from hma_model.config import HMAConfig
    from hma_model.network.model import HMA


@torch.no_grad()
def teacher_forced(model: "HMA", batch: "Batch") -> tuple[Tensor, Tensor]:
    """Score each frame from the second on, fully masked, given as much true past as a window holds.

    Args:
        model: a discrete model in eval mode.
        batch: a batch on the model's device.

    Returns:
        nats (B, T-1) float32 a token, averaged over the frame, and accuracy (B, T-1) of whole tokens.
    """
    assert batch.tokens is not None
    count, held = batch.tokens.shape[1], model.config.frames
    if count <= held:
        return _scored(model, batch, _at_once(model, batch), slice(1, None))
    first = _part(batch, slice(held))
    parts = [_scored(model, first, _at_once(model, first), slice(1, None))]
    for t in range(held, count):  # the past of such a frame begins after the first frame of the batch
        own = _part(batch, slice(t + 1 - held, t + 1))
        assert own.tokens is not None
        seen = own.tokens.clone()
        seen[:, -1] = model.config.vocab_size
        logits = model.video_logits(seen, own.actions, own.embodiment, own.action_mask)
        parts.append(_scored(model, own, logits[:, -1:], slice(-1, None)))
    nats, hits = (torch.cat(part, dim=1) for part in zip(*parts, strict=True))
    return nats, hits


def _at_once(model: "HMA", batch: "Batch") -> Tensor:
    """Return scores (B, T-1, h, w, F, V) of the masked frames, computed in one pass."""
    assert batch.tokens is not None
    config, frames = model.config, batch.tokens.flatten(2)
    count, groups = frames.shape[1], Groups.of(batch.embodiment, len(frames))
    given = align(config, batch.actions, batch.action_mask, count)
    both = ActionConditioning(*(torch.cat([x, x[:, 1:]], dim=1) for x in (given.chunks, given.known)))
    times = _times(config, count, frames.device)
    masked = torch.full_like(frames[:, 1:], config.vocab_size)
    x = model.embed_tokens(groups.sort(torch.cat([frames, masked], dim=1)))
    features = model.trunk(x, condition(model, both, groups, times.positions), times)
    scores = model.token_readout(model.video_features(features)[:, count:])
    return groups.unsort(model.token_readout.split(scores)).unflatten(2, config.token_grid)


def _times(config: "HMAConfig", frames: int, device: torch.device) -> TimePositions:
    """Return the times of the true and the masked frames; each sees itself and the true frames before."""
    positions = torch.cat([torch.arange(frames), torch.arange(1, frames)]).to(device)
    true = torch.arange(len(positions), device=device) < frames
    before = positions.unsqueeze(1) > positions
    allowed = (before & true) | torch.eye(len(positions), dtype=torch.bool, device=device)
    return TimePositions(positions, allowed, rotary_angles(config, positions))


def _part(batch: "Batch", frames: slice) -> "Batch":
    assert batch.tokens is not None
    known = batch.action_mask[:, frames]
    return replace(batch, tokens=batch.tokens[:, frames], actions=batch.actions[:, frames], action_mask=known)


def _scored(model: "HMA", batch: "Batch", logits: Tensor, frames: slice) -> tuple[Tensor, Tensor]:
    assert batch.tokens is not None
    true, factored = batch.tokens[:, frames], model.config.factored
    nats = token_nats(logits, true, factored).mean(dim=(2, 3))
    return nats, token_hits(logits, true, factored).float().mean(dim=(2, 3))
