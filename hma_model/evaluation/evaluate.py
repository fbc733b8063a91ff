"""Measure how well a model predicts one shard set: its losses, and its rollouts beside baselines.

A rollout continues from its own predictions. Rollouts are made with the true actions, with shuffled ones
(those of another window) and with none; `copy` repeats the last frame of the prompt. The difference shows how
much the model uses the actions. Which window gets which actions is drawn several times, and the figures of
shuffled actions are means over the draws. `KEY_95` is the 95 % interval of the mean KEY over windows, by
whole recordings.

The protocol of the paper's evaluation, on request: the last frame alone is predicted, from all true frames
before it, once with the true actions and in several draws with Gaussian ones.

B batch, T frames, P predicted frames, N windows.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch

from hma_data.arrays import Floats, Ints
from hma_data.errors import UsageError
from hma_data.loading.dataset import Batch, WindowDataset
from hma_data.loading.views import Cameras
from hma_data.shards.reader import ShardSet
from hma_data.storage.paths import StrPath
from hma_data.tokenizers.base import Tokenizer
from hma_model.checkpoint.folder import require_tokenizer
from hma_model.config import OBJECTIVES
from hma_model.evaluation.actions import gaussian, shuffled, without_actions
from hma_model.evaluation.intervals import NATURAL, SHARE, rounded, summary
from hma_model.evaluation.losses import (
    episodes_of,
    no_window,
    unconditional_baseline,
    validation_losses,
    windows,
)
from hma_model.evaluation.metrics import (
    PSNR_GAIN_RANGE,
    PSNR_RANGE,
    masked_scores,
    perplexity,
    perplexity_summary,
    teacher_forced,
)
from hma_model.evaluation.perceptual import NO_NETWORKS, FeatureCollector, Networks
from hma_model.evaluation.rollouts import RolloutImages, rollout
from hma_model.evaluation.scores import ROLLOUT_KINDS, Rolled, Scores, combined, figures_of, scores_of
from hma_model.generation.decode import cameras_for, default_prompt
from hma_model.network.model import HMA

DRAWS = 5  # of other windows' actions, and of Gaussian ones
PAPER_BATCH = 4  # the paper's perplexity is a mean over batches of so many windows


@dataclass(frozen=True)
class EvaluationSettings:
    """The choices that decide the figures, beside the checkpoint and the shard set.

    Attributes:
        split: train or val.
        windows: their number, evenly spaced; all windows if the split has fewer.
        frames: T of a window; by default the model's.
        prompt: true frames a rollout starts from.
        draws: how often each window gets the actions of another one; figures are means over the draws.
        seed: of the rollouts.
        cameras: as `WindowDataset` takes them; None takes those that the model was trained on.
        paper: also follow the paper's protocol.
        state: simulated episodes of a laboratory robot; of others any number measures the recorded state; 0
            measures no state.
        sampling: options of `HMA.generate` for the rollouts.
    """

    split: str = "val"
    windows: int = 64
    frames: int | None = None
    prompt: int | None = None
    batch_size: int = 16
    draws: int = DRAWS
    seed: int = 0
    cameras: Cameras | None = None
    paper: bool = False
    state: int = 0
    sampling: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class WindowPlan:
    """What the settings come to for a model and a shard set.

    Attributes:
        cameras: that the windows show.
        frames, prompt: T of a window, and how many of its frames are given.
        windows: their number.
    """

    cameras: Cameras
    frames: int
    prompt: int
    windows: int

    @classmethod
    def of(cls, model: HMA, shards: ShardSet, settings: EvaluationSettings) -> "WindowPlan":
        """Return the plan; raise CheckpointError or UsageError where the three do not fit together."""
        require_tokenizer(model.config, shards.spec, shards.folder)
        cameras = cameras_for(model, shards, settings.cameras)
        frames = settings.frames or model.config.frames
        prompt = default_prompt(frames) if settings.prompt is None else settings.prompt
        if prompt >= frames:
            fault = f"{prompt} true frames leave none to predict in windows of {frames}"
            raise UsageError("--prompt", fault, "give fewer, or more --frames")
        there = len(WindowDataset(shards, settings.split, frames, cameras=cameras))
        if not there:
            raise no_window(shards, settings.split, frames)
        return cls(cameras, frames, prompt, min(settings.windows, there))

    def predicted_frames(self, settings: EvaluationSettings) -> int:
        """Return how many frames the rollouts predict."""
        kinds = 2 + settings.draws  # true actions, none, and each draw of shuffled ones
        of_paper = 1 + settings.draws if settings.paper else 0
        return self.windows * ((self.frames - self.prompt) * kinds + of_paper)


@dataclass
class Measured:
    """The result of `measure`.

    Attributes:
        found: the figures, plain values.
        by_window: values (N,) of each window, by the name of the figure.
        batches: the windows.
        predicted: the predicted tokens or latents of each batch, by the kind of rollout.
    """

    found: dict[str, Any]
    by_window: dict[str, Floats]
    batches: list[Batch]
    predicted: dict[str, list[torch.Tensor]]


def measure(
    model: HMA,
    tokenizer: Tokenizer,
    data: StrPath | ShardSet,
    settings: EvaluationSettings = EvaluationSettings(),
    networks: Networks = NO_NETWORKS,
    on_frames: Callable[[int], None] = lambda frames: None,
) -> Measured:
    """Compute a model's figures on one shard set; rollouts are compared with the decoded true tokens.

    `found` has `loss` (nats a token); for discrete models also `shuffled_loss` (given another window's
    actions), `loss_action_gain` (by how much that is higher), `baseline_loss`, `perplexity`, `accuracy`, and
    both of `masked_scores`. For the rollouts `true`, `shuffled`, `none` and `copy` it has what `figures_of`
    gives. `psnr_action_gain_last` is `psnr_last` of true minus that of shuffled. `unmoved_windows` counts
    those whose true images never change. `notes` says what else must be known, and `missing` why a metric is
    absent.

    Args:
        model: a model that has the embodiment of the shard set.
        tokenizer: the tokenizer of the shard set.
        data: str or path of the shard set, its URI, or the set itself.
        settings: the options; `state` is not measured here.
        networks: the networks of LPIPS, FID and FVD.
        on_frames: is told after each rollout how many frames are predicted so far.

    Raises:
        CheckpointError: the model was trained on another tokenizer.
        UsageError: the split has no window, or the prompt leaves no frame to predict.
    """
    shards = data if isinstance(data, ShardSet) else ShardSet(data)
    plan = WindowPlan.of(model, shards, settings)
    first, seed, draws = plan.prompt, settings.seed, settings.draws
    batches = list(
        windows(shards, settings.split, plan.frames, settings.windows, settings.batch_size, plan.cameras)
    )
    if not model.config.sees_actions:  # it knows only how frames without actions go on
        batches = [without_actions(batch) for batch in batches]
    episodes = episodes_of(batches)
    recordings = shards.recordings(episodes)  # windows of one resemble each other
    table, by_window = _losses(model, shards, batches, recordings, plan.cameras, draws, seed)
    on_frames(0)  # the losses are done: the clock of the time left starts here
    predicted = 0

    def roll(batch: Batch, **options: Any) -> RolloutImages:
        nonlocal predicted
        made = rollout(model, tokenizer, batch, **options, **settings.sampling)
        predicted += made.finite.size
        on_frames(predicted)
        return made

    rolled = Rolled(first, FeatureCollector(networks))
    for number, batch in enumerate(batches):
        rolled.add(batch, partial(roll, prompt=first, seed=seed + number), draws, seed)
    joined = {kind: combined(parts) for kind, parts in rolled.scores.items()}
    for kind, scores in joined.items():
        by_window |= {f"{kind}.{name}": values.mean(axis=1) for name, values in scores.items()}
        by_window[f"{kind}.psnr_last"] = scores["psnr"][:, -1]
    gain = by_window["true.psnr_last"] - by_window["shuffled.psnr_last"]
    by_window["psnr_action_gain_last"] = gain
    frechet, missing = rolled.judge.figures(plan.frames - first)
    count, distinct = len(gain), len(np.unique(recordings))
    figures = {
        kind: figures_of(joined[kind], seed, recordings) | frechet.get(kind, {}) for kind in ROLLOUT_KINDS
    }
    extra: dict[str, Any] = {}
    if settings.paper:
        extra["paper"] = _paper(roll, batches, recordings, shards, by_window, draws, seed)
    else:
        missing = {**missing, "paper": "not measured: --paper follows the paper's protocol"}
    found = {
        "embodiment": shards.embodiment.id,
        "split": settings.split,
        "windows": count,
        "unmoved_windows": rolled.still,
        "episodes": len(np.unique(episodes)),
        "recordings": distinct,
        "frames": plan.frames,
        "prompt": first,
        "draws": draws,
        "sees_actions": model.config.sees_actions,
        "merge": model.config.merge,
        "against": "decoded tokens",
        "cameras": plan.cameras if isinstance(plan.cameras, str) else ", ".join(plan.cameras),
        **table,
        **figures,
        **summary("psnr_action_gain_last", gain, seed, 6, recordings, PSNR_GAIN_RANGE),
        **extra,
        "missing": missing,
        "notes": _notes(model, joined, table, rolled.still, count, distinct),
        "seconds_a_frame": round(1 / shards.embodiment.effective_hz, 6),
    }
    by_window["recording"] = recordings.astype(np.float64)
    return Measured(found, by_window, batches, rolled.predicted)


def _losses(
    model: HMA,
    shards: ShardSet,
    batches: list[Batch],
    recordings: Ints,
    cameras: Cameras,
    draws: int,
    seed: int,
) -> tuple[dict[str, Any], dict[str, Floats]]:
    """Return the losses, and by the name of each the values (N,) of the windows."""
    if model.config.kind == "continuous":
        loss = np.array(validation_losses(model, batches)[0].samples)
        return summary("loss", loss, digits=6, episodes=recordings, within=NATURAL), {"loss": loss}
    nats, hits = _joined(teacher_forced(model, batch.to(model.device)) for batch in batches)
    masked = []
    for number, batch in enumerate(batches):
        drawn = torch.Generator().manual_seed(seed * 1_000_003 + number)
        masked.append(masked_scores(model, batch.to(model.device), drawn))
    masked_nats, masked_hits = _joined(masked)
    other = (shuffled(batch, seed=seed, draw=draw) for draw in range(draws) for batch in batches)
    shuffled_loss = np.reshape(validation_losses(model, other)[0].samples, (draws, -1)).mean(axis=0)
    by_window = {"loss": nats.mean(axis=1), "accuracy": hits.mean(axis=1)}
    by_window |= {"masked_loss": masked_nats, "masked_accuracy": masked_hits}
    table = summary("loss", by_window["loss"], seed, 6, recordings, NATURAL) | {
        "shuffled_loss": shuffled_loss.mean(),
        "baseline_loss": unconditional_baseline([shards], batches, model.config, cameras).mean(),
    }
    gain = shuffled_loss - by_window["loss"]
    table |= summary("loss_action_gain", gain, seed, 6, recordings)
    if table["loss"] is not None:  # a model that takes squares of tokens as one has a loss of squares
        table["stored_loss"] = round(table["loss"] / model.config.merge**2, 6)
    table |= perplexity_summary("perplexity", by_window["loss"], seed, recordings)
    table |= summary("accuracy", by_window["accuracy"], seed, 6, recordings, SHARE)
    table |= perplexity_summary("masked_perplexity", masked_nats, seed, recordings)
    finite = np.isfinite(masked_hits)
    table |= summary("masked_accuracy", masked_hits[finite], seed, 6, recordings[finite], SHARE)
    table |= {"loss_by_frame": rounded(nats.mean(axis=0)), "accuracy_by_frame": rounded(hits.mean(axis=0))}
    return table, by_window


def _joined(pairs: Iterable[tuple[torch.Tensor, torch.Tensor]]) -> tuple[Floats, Floats]:
    nats, hits = (torch.cat(part).double().numpy(force=True) for part in zip(*pairs, strict=True))
    return nats, hits


def _paper(
    roll: Callable[..., RolloutImages],
    batches: list[Batch],
    recordings: Ints,
    shards: ShardSet,
    by_window: dict[str, Floats],
    draws: int,
    seed: int,
) -> dict[str, Any]:
    """Follow the paper's protocol: its perplexity, and ΔPSNR of a last frame under Gaussian actions."""
    scores: dict[str, list[Scores]] = {"true": [], "gaussian": []}
    for number, batch in enumerate(batches):
        last = partial(roll, prompt=batch.actions.shape[1] - 1, seed=seed + number)
        true = last(batch)
        scores["true"].append(scores_of(true))
        drawn = (
            gaussian(batch, shards.manifest.stats["action"], (seed * 1_009 + number) * 101 + draw)
            for draw in range(draws)
        )
        others = [scores_of(last(other, truth=true.truth)) for other in drawn]
        scores["gaussian"].append(combined(others, partial(np.mean, axis=0)))
    true_db, gaussian_db = (combined(parts)["psnr"][:, 0] for parts in scores.values())
    by_window["paper.delta_psnr"] = true_db - gaussian_db
    mean = partial(summary, seed=seed, episodes=recordings)
    found = mean("psnr_last", true_db, within=PSNR_RANGE)
    found |= mean("gaussian_psnr_last", gaussian_db, within=PSNR_RANGE)
    found |= mean("delta_psnr", true_db - gaussian_db, within=PSNR_GAIN_RANGE) | {"draws": draws}
    if "accuracy" in by_window:  # exp of each batch's mean, then the mean: above the exp of the mean
        nats = by_window["loss"]
        parts = np.array_split(nats, range(PAPER_BATCH, len(nats), PAPER_BATCH))
        found["perplexity"] = rounded(np.mean([perplexity(float(part.mean())) for part in parts]))
    return found


def _notes(
    model: HMA, joined: Mapping[str, Scores], table: Mapping[str, Any], still: int, count: int, whole: int
) -> list[str]:
    """Return what must be known to read the figures; `count` windows are of `whole` recordings."""
    notes, config = [], model.config
    if config.kind == "discrete" and config.merge > 1:
        square = f"square of {config.merge}×{config.merge} tokens"
        notes.append(
            f"loss, perplexity and accuracy are per {square}: compare only models of the same square; "
            "nats/token is comparable for all models of this tokenizer"
        )
    if not config.sees_actions:
        notes.append("it was trained without action inputs, so all rollouts ignore actions")
    finite = np.isfinite(np.concatenate([part["psnr"].ravel() for part in joined.values()]))
    if wrong := int((~finite).sum()):
        notes.append(
            f"{wrong} of {finite.size} predicted frames are NaN or infinite: the checkpoint has diverged"
        )
    if table["loss"] is None:
        notes.append("the loss is not finite: the checkpoint has diverged")
    if 2 * still > count:
        notes.append(
            f"the recorded images of {still} of {count} windows never change: a copy of the prompt is "
            "perfect there, so the figures say nothing about actions"
        )
    blind = any(not OBJECTIVES[name].sees_actions for name, often in config.objectives.items() if often)
    if not blind:
        notes.append("the model was not trained without actions, so its rollouts without actions may be poor")
    if whole == 1:
        notes.append(
            "all windows come from one recording, so no figure has an interval: convert more of them, or "
            "use a larger --val-fraction"
        )
    return notes
