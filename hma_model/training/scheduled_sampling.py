"""Replace past frames by the model's own predictions in training, so that long rollouts drift less.

In some windows of a batch, a few past frames are replaced by the model's predictions, one after the other.
Each is predicted from the true frames before it and those already replaced. The target of the loss stays the
true frame. Such windows may begin late in the run, because predictions of an untrained model teach nothing.
(The paper corrupts the past at random instead; see `corrupt_max` and `history_probability`.)

B batch, T frames of a window, h,w token grid, c,H,W latents, D frames replaced.
"""

from dataclasses import replace

import torch
from torch import Tensor

from hma_data.loading.dataset import Batch
from hma_model.config import OBJECTIVES
from hma_model.network.conditioning import Groups, align
from hma_model.network.head import uniform
from hma_model.network.masking import VideoMask
from hma_model.network.model import HMA
from hma_model.network.objectives import Layout, readout_inputs
from hma_model.network.stem import from_digits, split_tokens, unpatchify

type Given = tuple[Tensor | None, Tensor, list[str]]  # chunks, which are known, the robot of each window

SAMPLE_STEPS = 8  # of the diffusion head; enough for a past to learn from


@torch.no_grad()
def forwarded(
    model: HMA, batch: Batch, share: float, depth: int, generator: torch.Generator | None = None
) -> Batch:
    """Return the batch, with past frames predicted by the model in some windows.

    Args:
        model: the model in training; its mode is restored afterwards.
        batch: a batch on the model's device.
        share: the probability that a window gets predicted frames.
        depth: D, the frames that are replaced, from a drawn start on; the first and the last stay true. A
            model of whole frames replaces all later ones too, by at most D predictions in a row.

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
    training = model.training
    model.eval()
    given = batch.actions[chosen] if model.config.sees_actions else None, batch.action_mask[chosen], names
    if model.config.whole_frames:
        places = None if batch.places is None else batch.places[chosen]
        known = torch.arange(frames, device=true.device) < first[chosen].unsqueeze(1)
        known = known.view(*known.shape, *[1] * (true.dim() - 2))
        for _ in range(depth):
            made = _all_predicted(model, context, given, generator, places)
            context = torch.where(known, context, made.to(context.dtype))
    else:
        for offset in range(depth):
            at = first[chosen] + offset
            context[rows, at] = _predicted(model, context, at, given, generator)
    model.train(training)
    seen = true.clone()
    seen[chosen] = context
    return replace(batch, context=seen)


def _all_predicted(
    model: HMA,
    context: Tensor,
    given: Given,
    generator: torch.Generator | None,
    places: Tensor | None,
) -> Tensor:
    """Predict every frame from the frames before it in one pass; the first stays.

    Each pass makes one more frame of a window what a rollout from its true frames would have.
    """
    config, (actions, known, names) = model.config, given
    groups = Groups.of(names, len(context))
    layout = Layout.of(model, context.shape[1], OBJECTIVES["forward" if config.sees_actions else "passive"])
    layout.times.wanted = layout.past
    grid = config.token_grid
    if places is not None:
        layout.times.places = groups.sort(places)
        grid = (config.views * config.crop, config.crop)
    chunks = None
    if actions is not None:
        chunks = align(config, actions, known, context.shape[1]).frames(layout.frames)
    frames = model.frame_values(context, places)
    shown = groups.sort(torch.cat([frames[:, : layout.past], frames[:, 1:]], dim=1))
    masked = torch.zeros(shown.shape[:3], dtype=torch.bool, device=shown.device)
    masked[:, layout.past :] = True
    if config.kind == "discrete":
        shown = shown.masked_fill(masked, config.mask_id)
    x = model.embed(shown, masked.unsqueeze(-1), layout.previous)
    features = model.trunk(x, model.condition(chunks, groups, layout.times.positions), layout.times)
    video = VideoMask(groups.unsort(masked), torch.zeros(masked.shape[:2], device=masked.device))
    own, before = readout_inputs(model, features, shown, video, layout, groups)
    if config.kind == "discrete":
        scores = model.token_readout.split(model.token_readout(own, None, before))
        tokens = groups.unsort(from_digits(model.token_readout.taken(scores), config.digits))
        made = split_tokens(tokens, config.merge, config.vocab_size, grid)
    else:
        patches = model.latent_readout.sample(own.flatten(0, 2), SAMPLE_STEPS, generator=generator)
        whole = groups.unsort(patches.view(*own.shape[:3], config.patch_dim))
        made = unpatchify(whole, config.patch, grid) / config.latent_scale
    return torch.cat([context[:, :1].to(made.dtype), made], dim=1)


def _predicted(
    model: HMA,
    context: Tensor,
    at: Tensor,
    given: Given,
    generator: torch.Generator | None,
) -> Tensor:
    """Predict frame `at` (n,) of each window, wholly masked, from the frames before it."""
    config, (actions, known, names) = model.config, given
    rows = torch.arange(len(at), device=at.device)
    if config.kind == "discrete":
        hidden = context.clone()
        hidden[rows, at] = config.vocab_size
        scores = model.video_logits(hidden, actions, names, known, frame=at)
        tokens = from_digits(model.token_readout.taken(scores[:, 0]), config.digits).flatten(1)
        return split_tokens(tokens, config.merge, config.vocab_size, config.token_grid)
    scaled = context.float() * config.latent_scale
    mask = torch.zeros(context.shape[:2] + context.shape[3:], dtype=torch.bool, device=context.device)
    mask[rows, at] = True
    conditions = model.video_conditions(scaled, mask, actions, names, known)[rows, at]
    patches = model.latent_readout.sample(conditions.flatten(0, 2), SAMPLE_STEPS, generator=generator)
    whole = patches.view(len(at), 1, -1, config.patch_dim)
    latents = unpatchify(whole, config.patch, config.token_grid)
    return (latents[:, 0] / config.latent_scale).to(context.dtype)
