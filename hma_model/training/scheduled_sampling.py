"""Replace past frames by the model's own predictions in training, so that long rollouts drift less.

`forwarded`: in some windows of a batch, a few past frames are replaced by the model's predictions, one after
the other. Each is predicted from the true frames before it and those already replaced.

`rolled`: some windows begin with a rollout, drawn as in generation and with its cache. Windows are cut out of
longer batches for it, so that the whole past of a window may be the model's own, and far from the truth.

The target of the loss stays the true frame. The share of such windows may rise over the run, because
predictions of an untrained model teach nothing. (The paper corrupts the past at random instead; see
`corrupt_max` and `history_probability`.)

B batch, T frames of a window, L of a longer batch, h,w token grid, c,H,W latents, D frames replaced.
"""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from hma_data.loading.dataset import Batch
from hma_model.generation.rollout import generate
from hma_model.network.conditioning import Groups
from hma_model.network.head import uniform
from hma_model.network.stem import from_digits, split_tokens, unpatchify
from hma_model.network.trunk import Conditioning, TimePositions

if TYPE_CHECKING:
    from hma_model.network.model import HMA
    from hma_model.training.recipe import Recipe

type Under = tuple[Conditioning, Groups, TimePositions]

SAMPLE_STEPS = 8  # of the diffusion head; enough for a past to learn from


def share_at(step: int, recipe: "Recipe", share: float) -> float:
    """Return how much of `share` windows have predicted past frames in step `step`, counted from 0."""
    if step < recipe.self_forward_from:
        return 0.0
    along = (step + 1 - recipe.self_forward_from) / max(recipe.self_forward_over, 1)
    return share * min(along, 1.0)


def rolled(
    model: "HMA", batch: Batch, share: float, frames: int, generator: torch.Generator | None = None
) -> Batch:
    """Cut windows out of a longer batch; in some of them, the past is the model's rollout.

    Where a window begins is drawn, and so is the number of true frames, 2 to T, that all rollouts begin with.
    A rollout goes from these, the first of the longer batch, to the frame before the window's last.

    Args:
        model: the model in training; its mode is restored afterwards.
        batch: L frames on the model's device; padded ones (`frame_mask`) are left out where possible.
        share: the probability that a window's past is a rollout.
        frames: T, at most L.
    """
    size, length = batch.action_mask.shape
    where = "cpu" if generator is None else generator.device
    draws = uniform((3, size), generator, where).to(batch.actions.device)
    inside = torch.full((size,), length) if batch.frame_mask is None else batch.frame_mask.sum(1).cpu()
    room = (inside - frames).clamp(min=0).to(draws.device)
    begin = (draws[1] * (room + 1)).long().minimum(room)
    windows = _cut(batch, begin, frames)
    chosen = draws[0] < share
    prompt = 2 + int(float(draws[2, 0]) * (frames - 1))
    count = int(begin[chosen].max()) + frames - 1 - prompt if bool(chosen.any()) else 0
    if count < 1:
        return windows
    true = batch.tokens if batch.tokens is not None else batch.latents
    assert true is not None
    names = [name for name, taken in zip(batch.embodiment, chosen.tolist()) if taken]
    actions, known = (
        (batch.actions[chosen], batch.action_mask[chosen]) if model.config.sees_actions else (None, None)
    )
    training = model.training
    model.eval()
    made = generate(model, true[chosen, :prompt], actions, names, count, known, generator=generator)
    model.train(training)
    seen = true.clone()
    seen[chosen, prompt : prompt + count] = made.to(seen.dtype)
    context = _from(seen, begin, frames)
    shown = windows.tokens if windows.tokens is not None else windows.latents
    assert shown is not None
    context[:, -1] = shown[:, -1]
    return replace(windows, context=context)


def _cut(batch: Batch, begin: Tensor, frames: int) -> Batch:
    """Return the windows of a batch that begin at frame `begin` (B,)."""
    cut: dict[str, Any] = {
        name: _from(value, begin, frames)
        for name in ("actions", "action_mask", "tokens", "latents", "frame_mask")
        if (value := getattr(batch, name)) is not None
    }
    return replace(batch, **cut)


def _from(values: Tensor, begin: Tensor, frames: int) -> Tensor:
    """Return values (B, L, …) from `begin` (B,) on, as (B, T, …)."""
    rows = torch.arange(len(begin), device=values.device).unsqueeze(1)
    return values[rows, begin.unsqueeze(1) + torch.arange(frames, device=values.device)]


@torch.no_grad()
def forwarded(
    model: "HMA", batch: Batch, share: float, depth: int, generator: torch.Generator | None = None
) -> Batch:
    """Return the batch, with past frames predicted by the model in some windows.

    Args:
        model: the model in training; its mode is restored afterwards.
        batch: a batch on the model's device.
        share: the probability that a window gets predicted frames.
        depth: D, the number of consecutive frames that are replaced. Their start is drawn; the first and the
            last frame of the window stay true.

    Returns:
        The batch with `context`; the same batch if no window was drawn.
    """
    true = batch.tokens if batch.tokens is not None else batch.latents
    assert true is not None
    size, frames = true.shape[:2]
    where = "cpu" if generator is None else generator.device
    draws = uniform((2, size), generator, where).to(true.device)
    chosen = draws[0] < share
    if frames < 3 or not bool(chosen.any()):
        return batch
    depth = min(depth, frames - 2)
    first = 1 + (draws[1] * (frames - 1 - depth)).long()
    context, rows = true[chosen].clone(), torch.arange(int(chosen.sum()), device=true.device)
    names = [name for name, taken in zip(batch.embodiment, chosen.tolist()) if taken]
    earlier = None if batch.earlier is None else batch.earlier[chosen]
    training = model.training
    model.eval()
    groups, times = Groups.of(names, len(rows)), model.time_positions(frames)
    actions, known = batch.actions[chosen], batch.action_mask[chosen]
    conditioning = model.condition(actions if model.config.sees_actions else None, known, groups, times)
    for offset in range(depth):
        at = first[chosen] + offset
        context[rows, at] = _predicted(model, context, at, (conditioning, groups, times), earlier, generator)
    model.train(training)
    seen = (true if batch.context is None else batch.context).clone()
    seen[chosen] = context
    return replace(batch, context=seen)


def _predicted(
    model: "HMA",
    context: Tensor,
    at: Tensor,
    under: Under,
    earlier: Tensor | None,
    generator: torch.Generator | None,
) -> Tensor:
    """Predict frame `at` (n,) of each window, wholly masked, from the frames before it."""
    config, (conditioning, groups, times) = model.config, under
    rows = torch.arange(len(at), device=at.device)
    if config.kind == "discrete":
        hidden = context.clone()
        hidden[rows, at] = config.vocab_size
        scores = model.logits_under(conditioning, hidden, groups, times, first=earlier, frame=at)
        tokens = from_digits(scores[:, 0].argmax(-1), config.digits).flatten(1)
        return split_tokens(tokens, config.merge, config.vocab_size, config.token_grid)
    scaled = context.float() * config.latent_scale
    mask = torch.zeros(context.shape[:2] + context.shape[3:], dtype=torch.bool, device=context.device)
    mask[rows, at] = True
    conditions = model.conditions_under(conditioning, scaled, mask, groups, times, earlier)[rows, at]
    patches = model.latent_readout.sample(conditions.flatten(0, 2), SAMPLE_STEPS, generator=generator)
    whole = patches.view(len(at), 1, -1, config.patch_dim)
    latents = unpatchify(whole, config.patch, config.token_grid)
    return (latents[:, 0] / config.latent_scale).to(context.dtype)
