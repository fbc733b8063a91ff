"""Compute the losses of the training objectives (paper section 3).

`hma_model.config.OBJECTIVES` states what each objective predicts, sees and hides; `network.masking` draws it.

B batch, T frames, h,w token grid, S = h*w, M hidden tokens or chunks, K = stride * action dim.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import torch
import torch.nn.functional as F
from torch import Tensor

from hma_data.errors import HMAError
from hma_model.config import CROP_EDGE, OBJECTIVES, HMAConfig, Objective, Readout
from hma_model.network.conditioning import Groups, align
from hma_model.network.copying import frames_before
from hma_model.network.draws import randn, uniform
from hma_model.network.masking import (
    VideoMask,
    corrupt_tokens,
    draw_pairs_mask,
    draw_video_mask,
    drop_chunks,
)
from hma_model.network.network import Network
from hma_model.network.stem import patches_before, to_digits
from hma_model.network.trunks.contract import TimePositions, paired_times

if TYPE_CHECKING:
    from hma_data.loading.rows import Batch

ACTION_LOSS_WEIGHT = 0.5  # relative to the video loss
FLAT = 16  # see _weights


@dataclass
class Output:
    """The result of a training or validation pass.

    Attributes:
        loss: scalar to minimise.
        video_loss: scalar, nats a token or squared error of the noise; None where video is not predicted.
        action_loss: scalar; None where actions are not predicted.
        per_sample: (B,) detached, each sample's video loss, or its action loss if there is no video loss.
        masked: (B, T, h, w) bool, the tokens of the video loss.
        objective: the objective of the pass.
        video_logits: (B, T, h, w, F, V) float32 of the discrete model outside training, else None; with a
            chain of digits each given the true digits before it.
    """

    loss: Tensor
    video_loss: Tensor | None
    action_loss: Tensor | None
    per_sample: Tensor
    masked: Tensor
    objective: str
    video_logits: Tensor | None = None


@dataclass(frozen=True)
class Layout:
    """The frames of a pass.

    Attributes:
        frames: for each frame of the pass the index of the frame of the window that it shows.
        previous: for each the index in the pass of the true frame before it, or -1.
        past: number of frames before the masked copies; all frames if there are none.
        times: their times.
    """

    frames: list[int]
    previous: list[int]
    past: int
    times: TimePositions

    @classmethod
    def of(cls, model: Network, count: int, objective: Objective) -> Self:
        """Return the frames of a pass over windows of `count` frames."""
        if model.config.training_pass == "window" or not objective.predicts_video or count < 2:
            order = list(range(count))
            return cls(order, [t - 1 for t in order], count, model.time_positions(count))
        # the last true frame is there only to be read
        if objective.readout:
            return cls.pairs(model, count, past=count)
        layout = cls.pairs(model, count, past=count - 1)
        if model.training or not model.config.discrete:  # else the window's first frame is scored
            layout.times.wanted = layout.past
        return layout

    @classmethod
    def pairs(cls, model: Network, count: int, past: int) -> Self:
        """Return the first `past` frames of `count`, then a copy of each frame from the second on."""
        previous = [*range(-1, past - 1), *range(count - 1)]
        times = paired_times(model.config, past, count, model.device)
        return cls([*range(past), *range(1, count)], previous, past, times)

    @property
    def paired(self) -> bool:
        """Check whether masked copies of the frames follow the frames."""
        return self.past < len(self.frames)

    @property
    def predicted(self) -> slice:
        """Return the frames of the pass that predict video."""
        return slice(self.past if self.paired else 0, None)


def compute(
    model: Network, batch: "Batch", objective: str | None, generator: torch.Generator | None
) -> Output:
    """Compute the losses of one batch; `HMA.forward` explains the arguments."""
    config = model.config
    name = objective or draw_objective(config, generator)
    if name not in OBJECTIVES:
        raise HMAError("objective", f"{name!r} is unknown", "give one of " + ", ".join(OBJECTIVES))
    chosen = OBJECTIVES[name]
    stored = batch.tokens if config.discrete else batch.latents
    if stored is None:
        raise HMAError("batch", f"has no frames for a {config.kind} model", "use the model's tokenizer")
    places, groups = _optional(batch, "places"), Groups.of(batch.embodiment, len(batch.actions))
    frames = model.frame_values(stored, places)
    layout = Layout.of(model, batch.actions.shape[1], chosen)
    layout.times.places = None if places is None else groups.sort(places)

    video = _hide_tokens(config, batch, chosen, layout, generator)
    dropped = torch.zeros_like(batch.action_mask)  # what the model must predict, and so does not see
    if chosen.readout is not None:
        read = dropped.shape[1] - chosen.readout.lag  # the chunks after these have no frame to be read from
        dropped[:, :read] = drop_chunks(batch.action_mask[:, :read], generator)
    given = None
    if chosen.sees_actions:
        given = align(config, batch.actions, batch.action_mask & ~dropped, dropped.shape[1])
        given = given.frames(layout.frames) if layout.paired else given
    conditioning = model.condition(given, groups, layout.times.positions)
    x, shown = _embed(model, batch, frames, video, layout, groups, generator)
    features = model.trunk(x, conditioning, layout.times)

    video_loss = action_loss = logits = None
    masked, loss = video.masked, torch.zeros((), device=features.device)
    if chosen.readout is not None:
        action_loss, per_sample = _action_loss(
            model, features[:, : layout.past], batch, dropped, chosen.readout, groups, generator
        )
    if chosen.predicts_video:
        masked = masked[:, layout.predicted]
        own, before = readout_inputs(model, features, shown, video, layout, groups)
        targets = frames[:, 1:] if layout.paired else frames
        if config.video_loss == "regression":  # the motion that weighs is that of the true frames
            before = frames[:, :-1] if layout.paired else torch.cat([frames[:, :1], frames[:, :-1]], dim=1)
            before = groups.sort(before)
        video_loss, per_sample = _video_loss(model, own, targets, before, masked, groups, generator)
        if layout.paired:  # no copy is of the first frame
            masked = F.pad(masked, (0, 0, 1, 0))
        if config.discrete and not model.training:
            logits = _video_logits(model, features, own, before, frames, layout, groups)
        loss = loss + video_loss
    if action_loss is not None:
        loss = loss + ACTION_LOSS_WEIGHT * action_loss
    grid = config.token_grid if places is None else (-1, config.crop)
    masked = masked.to(features.device).unflatten(2, grid)
    return Output(loss, video_loss, action_loss, per_sample.detach(), masked, name, logits)


def readout_inputs(
    model: Network, features: Tensor, shown: Tensor, video: VideoMask, layout: Layout, groups: Groups
) -> tuple[Tensor, Tensor | None]:
    """Return what the readout takes of frames that predict video: features or conditions, and digits before.

    The digits before (B, T, S, F) are those of a discrete model that may copy them, else None.
    """
    config, previous = model.config, layout.previous[layout.predicted]
    own = model.video_features(features)[:, layout.predicted]
    if config.discrete:
        return own, frames_before(shown, previous, config)
    kept = None
    if config.copy_previous:
        hidden = groups.sort(video.masked.to(shown.device)).unsqueeze(-1)
        kept = patches_before(shown, hidden, previous, config.patch)
    return model.latent_readout(own, layout.times.positions[layout.predicted], kept), None


def _video_logits(
    model: Network,
    features: Tensor,
    own: Tensor,
    before: Tensor | None,
    frames: Tensor,
    layout: Layout,
    groups: Groups,
) -> Tensor:
    """Return the scores (B, T, h, w, F, V) of the window's frames; the first of pairs is scored as it is."""
    if layout.paired:
        own = torch.cat([model.video_features(features)[:, :1], own], dim=1)
        before = None if before is None else F.pad(before, (0, 0, 0, 0, 1, 0), value=-1)
    true = to_digits(groups.sort(frames), model.config.digits)
    scores = model.token_readout.split(model.token_readout(own.detach(), true, before))
    return groups.unsort(scores).unflatten(2, model.config.token_grid)


def draw_objective(config: HMAConfig, generator: torch.Generator | None) -> str:
    """Draw an objective by the configuration's weights."""
    names, weights = zip(*config.objectives.items())
    if len(names) == 1:
        return names[0]
    limits = torch.tensor(weights, dtype=torch.float64).cumsum(0)
    index = int((uniform((1,), generator).double() * limits[-1] >= limits).sum())
    return names[min(index, len(names) - 1)]


def _optional(batch: "Batch", name: str) -> Tensor | None:
    """Return a field that a caller's own class of batches may lack."""
    return getattr(batch, name, None)


def _hide_tokens(
    config: HMAConfig,
    batch: "Batch",
    objective: Objective,
    layout: Layout,
    generator: torch.Generator | None,
) -> VideoMask:
    """Draw the masked tokens of a pass and the corruption of the others; mask none without a video loss."""
    size, count = batch.action_mask.shape
    if layout.paired:
        places = _optional(batch, "places")
        tokens = None if places is None else config.views * places.shape[1]
        video = draw_pairs_mask(config, size, count, layout.past, generator, tokens)
        if places is not None:
            video.masked &= surrounded(config, places).unsqueeze(1).to(video.masked.device)
    else:
        video = draw_video_mask(config, size, count, generator, drift=objective.predicts_video)
    inside = _optional(batch, "frame_mask")
    if inside is not None:  # padding of a short episode has no loss
        video.masked &= inside[:, layout.frames].to(video.masked.device).unsqueeze(-1)
    if not objective.predicts_video:
        video.masked = torch.zeros_like(video.masked)
    return video


def surrounded(config: HMAConfig, places: Tensor) -> Tensor:
    """Return which tokens (B, V·S) of squares at `places` (B, S) have a loss: those far from a cut edge.

    An edge of the frame itself is not cut.
    """
    side, (rows, across) = config.crop, config.token_grid
    inside = torch.arange(side, device=places.device)
    first = places[:, :1]
    kept = []
    for begin, size in ((first // across, rows // config.views), (first % across, across)):
        near, far = (inside >= CROP_EDGE) | (begin == 0), (inside < side - CROP_EDGE) | (begin == size - side)
        kept.append(near & far)
    square = (kept[0].unsqueeze(2) & kept[1].unsqueeze(1)).flatten(1)
    return square.repeat(1, config.views)


def _embed(
    model: Network,
    batch: "Batch",
    true: Tensor,
    video: VideoMask,
    layout: Layout,
    groups: Groups,
    generator: torch.Generator | None,
) -> tuple[Tensor, Tensor]:
    """Mask, corrupt and embed the frames of a pass; return their embedding and them, sorted by embodiment.

    `true` are the values (B, T, S, …) of the window's frames. The model sees those of `batch.context`
    instead, if there are any.
    """
    context = _optional(batch, "context")
    frames = true if context is None else model.frame_values(context, _optional(batch, "places"))
    if layout.paired:
        frames = torch.cat([frames[:, : layout.past], true[:, 1:]], dim=1)
    if model.config.discrete:
        shown = groups.sort(corrupt_tokens(model.config, frames, video, generator))
        hidden = None
    else:
        masked = video.masked.to(frames.device).unsqueeze(-1)
        if spread := model.config.latent_noise:
            rate = spread * video.corruption.to(frames.device)[..., None, None]
            frames = frames + rate * randn(frames.shape, generator, frames.device)
        shown = groups.sort(frames)
        hidden = groups.sort(masked)
    corruption = groups.sort(video.corruption.to(frames.device))
    return model.embed(shown, hidden, layout.previous, corruption), shown


def _video_loss(
    model: Network,
    features: Tensor,
    frames: Tensor,
    before: Tensor | None,
    masked: Tensor,
    groups: Groups,
    generator: torch.Generator | None,
) -> tuple[Tensor, Tensor]:
    """Return the mean loss over masked tokens, and each sample's (B,), in the batch's order.

    `before` (B, T, S, F or C), sorted by embodiment as the features, are the digits of the frames before, or
    their patches if what moves weighs more.
    """
    masked, frames = groups.sort(masked), groups.sort(frames)
    counts, weights = masked.flatten(1).sum(1), None
    thins = model.training and model.config.discrete and model.token_readout.thins(features)
    if thins and before is not None:
        weights = _weights(model.config, frames, before, generator)
        masked = masked & (weights > 0)
    rows = masked.flatten().nonzero().squeeze(1)  # on the generator's device, so no wait for an accelerator
    sample = (rows // masked[0].numel()).to(features.device)
    rows = rows.to(features.device)
    whole = len(rows) == masked.numel()  # then nothing is picked out, which would cost as much as a block
    chosen, targets, near, weights = (
        values if values is None or whole else values.index_select(0, rows)
        for values in (
            features.flatten(0, 2),
            frames.flatten(0, 2),
            None if before is None else before.flatten(0, 2),
            None if weights is None else weights.flatten(),
        )
    )
    assert chosen is not None and targets is not None
    if model.config.discrete:
        losses = model.token_readout.loss(chosen, to_digits(targets, model.config.digits), near)
    else:
        losses = model.latent_readout.loss(targets, chosen, generator, near)
    losses = losses if weights is None else losses * weights
    return losses.sum() / max(int(counts.sum()), 1), groups.unsort(_means(losses, sample, counts))


def _weights(config: HMAConfig, frames: Tensor, before: Tensor, generator: torch.Generator | None) -> Tensor:
    """Draw what the losses of tokens (B, T, S) weigh; those of weight 0 need not be computed.

    Most of a simulator's frame is as in the frame before. Far from what changes, the loss of a token is
    nearly zero, and costs as much as another: one of FLAT such tokens is drawn, and weighs FLAT times as
    much, so that the expected loss is the same.
    """
    changes = (to_digits(frames, config.digits) != before).any(-1)
    side = config.token_grid[1] if frames.shape[2] == config.tokens_per_frame else config.crop
    near = F.max_pool2d(changes.float().unflatten(2, (-1, side)).flatten(0, 1), 3, 1, 1).view_as(changes) > 0
    drawn = uniform(frames.shape, generator, frames.device) < 1 / FLAT
    return torch.where(near, 1.0, FLAT * drawn)


def _action_loss(
    model: Network,
    features: Tensor,
    batch: "Batch",
    dropped: Tensor,
    readout: Readout,
    groups: Groups,
    generator: torch.Generator | None,
) -> tuple[Tensor, Tensor]:
    """Return the mean loss over predicted chunks, and each sample's (B,), in the batch's order."""
    predicted = batch.action_mask.clone()
    if readout.lag or model.config.action_alignment == "current":
        predicted &= dropped  # a chunk that the model saw is not predicted
    pooled = model.action_features(features)[:, readout.lag :]
    predicted = groups.sort(predicted[:, : pooled.shape[1]])
    chunks = groups.sort(batch.actions)
    losses, samples = [], []
    for name, span in groups.spans():
        sample, frame = predicted[span].nonzero(as_tuple=True)
        stem = model.stem(name)
        target = chunks[span, :, : stem.input.in_features][sample, frame]
        if not model.config.released:
            target = stem.normalizer(target)
        losses.append(model.head(name).loss(pooled[span][sample, frame], target, readout, generator))
        samples.append(sample + span.start)
    flat = torch.cat(losses)
    sample = torch.cat(samples)
    counts = sample.bincount(minlength=len(chunks))
    return flat.sum() / max(len(flat), 1), groups.unsort(_means(flat, sample, counts))


def _means(losses: Tensor, sample: Tensor, counts: Tensor) -> Tensor:
    """Return each sample's mean (B,) of losses (M,), of which it has `counts` (B,); 0 for one without any."""
    counts = counts.to(losses.device).clamp(min=1)
    return losses.new_zeros(len(counts)).index_add(0, sample, losses.detach()) / counts
