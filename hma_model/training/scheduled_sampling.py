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
from hma_model.network.conditioning import Groups, align
from hma_model.network.copying import frames_before
from hma_model.network.draws import device_of, uniform
from hma_model.network.model import HMA
from hma_model.network.stem import from_digits, patches_before, split_tokens, unpatchify

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
            model of whole frames replaces all from the drawn start to the last but one, at least D.

    Returns:
        The batch with `context`; the same batch if no window was drawn.
    """
    size, frames = batch.stored.shape[:2]
    draws = uniform((2, size), generator, device_of(generator))
    if frames < 3 or not bool((draws[0] < share).any()):
        return batch
    depth = min(depth, frames - 2)
    first = 1 + (draws[1] * (frames - 1 - depth)).long()
    end = torch.full_like(first, frames - 1) if model.config.whole_frames else first + depth
    context, training = batch.stored.clone(), model.training
    model.eval()
    for at in range(1, frames - 1):
        rows = ((draws[0] < share) & (first <= at) & (at < end)).nonzero().flatten()
        if len(rows):
            context[rows, at] = _predicted(model, batch, context[:, : at + 1], rows, generator)
    model.train(training)
    return replace(batch, context=context)


def _predicted(
    model: HMA, batch: Batch, context: Tensor, rows: Tensor, generator: torch.Generator | None
) -> Tensor:
    """Predict the last frame of some windows of `context`, wholly masked, from the frames before it.

    Nothing else is computed where the trunk allows it.
    """
    config, past, grid = model.config, context.shape[1] - 1, model.config.token_grid
    rows = rows.to(context.device)
    groups = Groups.of([batch.embodiment[row] for row in rows.tolist()], len(rows))
    times = model.time_positions(past + 1)
    times.wanted = past
    places = None
    if batch.places is not None:
        places = batch.places[rows]
        times.places, grid = groups.sort(places), (config.views * config.crop, config.crop)
    given = None
    if config.sees_actions:
        given = align(config, batch.actions[rows], batch.action_mask[rows], past + 1)
    shown = groups.sort(model.frame_values(context[rows], places))
    hidden = torch.zeros(*shown.shape[:3], 1, dtype=torch.bool, device=shown.device)
    hidden[:, past] = True
    if config.discrete:
        shown[:, past] = config.mask_id
    x = model.embed(shown, hidden)
    features = model.trunk(x, model.condition(given, groups, times.positions), times)
    own = model.video_features(features)[:, past:]
    if config.discrete:
        before = frames_before(shown, [past - 1], config)
        scores = model.token_readout.split(model.token_readout(own, None, before))
        tokens = groups.unsort(from_digits(model.token_readout.taken(scores), config.digits))
        return split_tokens(tokens, config.merge, config.vocab_size, grid)[:, 0].to(context.dtype)
    kept = patches_before(shown, hidden, [past - 1], config.patch) if config.copy_previous else None
    conditions = model.latent_readout(own, times.positions[past:], kept)
    patches = model.latent_readout.sample(conditions.flatten(0, 2), SAMPLE_STEPS, generator=generator)
    whole = groups.unsort(patches.view(*own.shape[:3], config.patch_dim))
    return (unpatchify(whole, config.patch, grid)[:, 0] / config.latent_scale).to(context.dtype)
