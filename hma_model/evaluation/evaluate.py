"""Measure how well a model predicts one shard set: its losses, and its rollouts beside baselines.

A rollout continues from its own predictions. Rollouts are made with the true actions, with shuffled ones
(those of another window) and with none; `copy` repeats the last frame of the prompt. The difference shows how
much the model uses the actions. Which window gets which actions is drawn several times, and the figures of
shuffled actions are means over the draws. `KEY_95` is the 95 % interval of the mean KEY over windows.

The protocol of the paper's evaluation, on request: the last frame alone is predicted, from all true frames
before it, once with the true actions and in several draws with Gaussian ones.

B batch, T frames, P predicted frames, N windows.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
import torch
from numpy.typing import NDArray

from hma_data.errors import UsageError
from hma_data.loading.dataset import Batch, WindowDataset
from hma_data.loading.views import Cameras
from hma_data.shards.reader import ShardSet
from hma_data.storage.paths import StrPath
from hma_model.checkpoint.folder import require_tokenizer
from hma_model.config import OBJECTIVES
from hma_model.evaluation.commands import gaussian, shuffled, shuffled_actions, without_commands
from hma_model.evaluation.intervals import interval, rounded, summary
from hma_model.evaluation.losses import (
    Means,
    digit_frequencies,
    masked_val_loss,
    opened,
    unconditional_baseline,
    validation_losses,
    windows,
)
from hma_model.evaluation.metrics import masked_scores, perplexity, psnr, ssim, teacher_forced
from hma_model.evaluation.perceptual import Judge, Networks
from hma_model.evaluation.rollouts import Pictures, Sampling, cameras_for, decode, default_prompt, rollout

if TYPE_CHECKING:
    from hma_data.tokenizers.base import Tokenizer
    from hma_model.network.model import HMA

__all__ = [
    "Means", "Pictures", "Sampling", "cameras_for", "decode", "default_prompt", "digit_frequencies",
    "evaluate", "masked_val_loss", "measure", "rollout", "shuffled", "shuffled_actions",
    "unconditional_baseline", "validation_losses", "verdict", "windows",
]  # fmt: skip

DRAWS = 5  # of other windows' actions, and of Gaussian ones
FOLLOWS_DB = 0.5  # gain of the last frame's PSNR from which a model is said to follow its actions
PSNR_LIMIT = 60.0  # dB; the PSNR of equal pictures, and with it a mean over frames, would be infinite
PAPER_BATCH = 4  # the paper's perplexity is a mean over batches of so many windows
ROLLOUTS = ("true", "shuffled", "none", "copy")
Floats = NDArray[np.float64]


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
    batches: list[Batch] = field(default_factory=list)
    predicted: dict[str, list[torch.Tensor]] = field(default_factory=dict)


def evaluate(
    model: "HMA",
    tokenizer: "Tokenizer",
    data: StrPath | ShardSet,
    *,
    split: str = "val",
    count: int = 32,
    frames: int | None = None,
    prompt: int | None = None,
    batch_size: int = 16,
    draws: int = DRAWS,
    seed: int = 0,
    cameras: Cameras | None = None,
    **sampling: Unpack[Sampling],
) -> dict[str, Any]:
    """Compute a model's figures on one shard set; rollouts are compared with the decoded true tokens.

    Args:
        model: a model that has the embodiment of the shard set.
        tokenizer: the tokenizer of the shard set.
        data: str or path of the shard set, its URI, or the set itself.
        split: train or val.
        count: windows, evenly spaced; all windows if the split has fewer.
        frames: T of a window; by default the model's.
        prompt: true frames a rollout starts from.
        draws: how often each window gets the actions of another one; figures are means over the draws.
        seed: of the rollouts.
        cameras: as `WindowDataset` takes them; None takes those that the model was trained on.
        sampling: options of `HMA.generate` for the rollouts.

    Returns:
        `loss` (nats a token); for discrete models also `shuffled_loss` (given another window's actions),
        `baseline_loss`, `perplexity`, `accuracy`, and both of `masked_scores`. For rollouts with the `true`
        actions, with `shuffled` ones, with `none`, and for `copy`: `psnr` and `ssim` over the horizon,
        `psnr_last`, `psnr_by_frame` and `ssim_by_frame`. `psnr_action_gain_last` is `psnr_last` of true minus
        that of shuffled. `notes` says in words what else must be known, and `missing` why a metric is absent.

    Raises:
        CheckpointError: the model was trained on another tokenizer.
        UsageError: the split has no window.
    """
    return measure(
        model, tokenizer, data, split=split, count=count, frames=frames, prompt=prompt, batch_size=batch_size,
        draws=draws, seed=seed, cameras=cameras, **sampling,
    ).found  # fmt: skip


def measure(
    model: "HMA",
    tokenizer: "Tokenizer",
    data: StrPath | ShardSet,
    *,
    split: str = "val",
    count: int = 32,
    frames: int | None = None,
    prompt: int | None = None,
    batch_size: int = 16,
    draws: int = DRAWS,
    seed: int = 0,
    cameras: Cameras | None = None,
    paper: bool = False,
    networks: Networks | None = None,
    on_frames: Callable[[int], None] = lambda frames: None,
    **sampling: Unpack[Sampling],
) -> Measured:
    """Compute the figures of `evaluate`, and keep what pictures are drawn from.

    Args:
        paper: also follow the paper's protocol.
        networks: what measures LPIPS, FID and FVD.
        on_frames: is told after each batch of rollouts how many frames it predicted.

    The other arguments and the errors are those of `evaluate`.
    """
    shards = opened(data)
    require_tokenizer(model.config, shards.spec, shards.folder)
    length = frames or model.config.frames
    first = default_prompt(length) if prompt is None else prompt
    cameras = cameras_for(model, shards, cameras)
    if not len(WindowDataset(shards, split, length, cameras=cameras)):
        fault = f"has no window of {length} frames in {split}"
        raise UsageError(shards.folder, fault, "give another --split or fewer --frames")
    batches = list(windows(shards, split, length, count, batch_size, cameras))
    table, by_window = _losses(model, shards, batches, cameras, draws, seed)
    roll = partial(rollout, model, tokenizer, **sampling)
    scores: dict[str, list[_Scores]] = {name: [] for name in ROLLOUTS}
    predicted: dict[str, list[torch.Tensor]] = {"true": [], "shuffled": [], "none": []}
    judge, still = Judge(networks or Networks()), 0
    for number, batch in enumerate(batches):
        own = _counted(partial(roll, prompt=first, seed=seed + number), on_frames)
        true = own(batch)
        judge.add("truth", true.truth[:, first:])
        still += int((true.truth[:, first:] == true.truth[:, first - 1 : first]).all(axis=(1, 2, 3, 4)).sum())

        def keep(name: str, pictures: Pictures, judge: Judge = judge) -> "_Scores":
            judge.add(name, pictures.predicted[:, first:])
            return _Scores.of(pictures, judge)

        scores["true"].append(keep("true", true))
        copied = true.predicted.copy()
        copied[:, first:] = copied[:, first - 1 : first]
        everywhere = np.ones_like(true.finite)
        scores["copy"].append(keep("copy", replace(true, predicted=copied, finite=everywhere)))
        others = [own(shuffled(batch, first - 1, seed, draw), truth=true.truth) for draw in range(draws)]
        pairs = [keep("shuffled", others[0]), *(_Scores.of(other, judge) for other in others[1:])]
        scores["shuffled"].append(_Scores.mean(pairs))
        none = own(without_commands(batch), truth=true.truth)
        scores["none"].append(keep("none", none))
        for name, made in (("true", true), ("shuffled", others[0]), ("none", none)):
            predicted[name].append(made.stored)
    joined = {name: _Scores.join(parts) for name, parts in scores.items()}
    figures = {name: joined[name].figures(seed) for name in ROLLOUTS}
    for name, part in joined.items():
        by_window |= {f"{name}.psnr": part.psnr.mean(axis=1), f"{name}.psnr_last": part.psnr[:, -1]}
        by_window |= {f"{name}.ssim": part.ssim.mean(axis=1)}
        if part.lpips is not None:
            by_window[f"{name}.lpips"] = part.lpips.mean(axis=1)
    gain = by_window["true.psnr_last"] - by_window["shuffled.psnr_last"]
    by_window["psnr_action_gain_last"] = gain
    frechet, missing = judge.figures(length - first)
    for name in ROLLOUTS:
        figures[name] |= frechet.get(name, {})
    extra: dict[str, Any] = {}
    if paper:
        extra["paper"] = _paper(roll, batches, shards, by_window, draws, seed, on_frames)
    found = {
        "embodiment": shards.embodiment.id,
        "split": split,
        "windows": len(gain),
        "frames": length,
        "prompt": first,
        "draws": draws,
        "against": "decoded tokens",
        "cameras": cameras if isinstance(cameras, str) else ", ".join(cameras),
        **table,
        **figures,
        **summary("psnr_action_gain_last", gain, seed, digits=6),
        **extra,
        "missing": missing
        | ({} if paper else {"paper": "not measured: --paper follows the paper's protocol"}),
        "notes": _notes(model, joined, table, still, len(gain)),
        "seconds_a_frame": round(1 / shards.embodiment.effective_hz, 6),
    }
    return Measured(found, by_window, batches, predicted)


def _counted(roll: Callable[..., Pictures], on_frames: Callable[[int], None]) -> Callable[..., Pictures]:
    """Return a function that rolls out, and then tells how many frames it predicted."""

    def counting(batch: Batch, **options: Any) -> Pictures:
        made = roll(batch, **options)
        on_frames(made.finite.size)
        return made

    return counting


def verdict(found: Mapping[str, Any]) -> str:
    """Return a sentence about the result of `evaluate`: whether the model follows its actions."""
    gain = found["psnr_action_gain_last"]
    if gain is None:
        return "cannot be judged: its predictions are not finite"
    said = f"{gain:+.1f} dB on the last frame, true less shuffled actions"
    if gain >= FOLLOWS_DB:
        return f"follows its actions: {said}"
    return f"does not follow its actions yet ({said})"


def _losses(
    model: "HMA", shards: ShardSet, batches: list[Batch], cameras: Cameras, draws: int, seed: int
) -> tuple[dict[str, Any], dict[str, Floats]]:
    """Return the losses, and by the name of each the values (N,) of the windows."""
    if model.config.kind == "continuous":
        loss = np.array(validation_losses(model, batches)[0].samples)
        return summary("loss", loss, digits=6), {"loss": loss}
    forced = [teacher_forced(model, batch.to(model.device)) for batch in batches]
    nats, hits = (torch.cat(part).double().cpu().numpy() for part in zip(*forced, strict=True))
    other = (shuffled(batch, draw=draw) for draw in range(draws) for batch in batches)
    drawn = [torch.Generator().manual_seed(seed * 1_000_003 + number) for number in range(len(batches))]
    masked = [masked_scores(model, batch.to(model.device), g) for batch, g in zip(batches, drawn)]
    masked_nats, masked_hits = (torch.cat(part).double().cpu().numpy() for part in zip(*masked, strict=True))
    by_window = {"loss": nats.mean(axis=1), "accuracy": hits.mean(axis=1)}
    by_window |= {"masked_loss": masked_nats, "masked_accuracy": masked_hits}
    table: dict[str, Any] = summary("loss", by_window["loss"], seed, digits=6) | {
        "shuffled_loss": masked_val_loss(model, other),
        "baseline_loss": unconditional_baseline(
            [shards], batches, cameras, model.config.factored, model.config.merge
        ).mean(),
    }
    table |= _perplexity("perplexity", by_window["loss"], seed)
    table |= summary("accuracy", by_window["accuracy"], seed, digits=6)
    table |= _perplexity("masked_perplexity", masked_nats, seed)
    table |= summary("masked_accuracy", masked_hits[np.isfinite(masked_hits)], seed, digits=6)
    table |= {"loss_by_frame": rounded(nats.mean(axis=0)), "accuracy_by_frame": rounded(hits.mean(axis=0))}
    return table, by_window


def _perplexity(name: str, nats: Floats, seed: int) -> dict[str, Any]:
    """Return exp of the mean of losses (N,), with its interval."""
    nats = nats[np.isfinite(nats)]
    if not len(nats):
        return {name: None, f"{name}_95": None}
    ends = [perplexity(float(end)) for end in interval(nats, seed)]
    return {name: perplexity(float(nats.mean())), f"{name}_95": [round(end, 4) for end in ends]}


def _paper(
    roll: Callable[..., Pictures],
    batches: list[Batch],
    shards: ShardSet,
    by_window: dict[str, Floats],
    draws: int,
    seed: int,
    on_frames: Callable[[int], None],
) -> dict[str, Any]:
    """Follow the paper's protocol: its perplexity, and ΔPSNR of a last frame under Gaussian actions."""
    scores: dict[str, list[_Scores]] = {"true": [], "gaussian": []}
    for number, batch in enumerate(batches):
        last = _counted(partial(roll, prompt=batch.actions.shape[1] - 1, seed=seed + number), on_frames)
        true = last(batch)
        scores["true"].append(_Scores.of(true))
        drawn = (
            gaussian(batch, shards.manifest.stats["action"], (seed * 1_009 + number) * 101 + draw)
            for draw in range(draws)
        )
        scores["gaussian"].append(
            _Scores.mean([_Scores.of(last(other, truth=true.truth)) for other in drawn])
        )
    true_db, gaussian_db = (_Scores.join(scores[name]).psnr[:, 0] for name in ("true", "gaussian"))
    by_window["paper.delta_psnr"] = true_db - gaussian_db
    found = summary("psnr_last", true_db, seed) | summary("gaussian_psnr_last", gaussian_db, seed)
    found |= summary("delta_psnr", true_db - gaussian_db, seed) | {"draws": draws}
    if "accuracy" in by_window:  # exp of each batch's mean, then the mean: above the exp of the mean
        nats = by_window["loss"]
        parts = np.array_split(nats, range(PAPER_BATCH, len(nats), PAPER_BATCH))
        found["perplexity"] = rounded(np.mean([perplexity(float(part.mean())) for part in parts]))
    return found


def _notes(
    model: "HMA", joined: "Mapping[str, _Scores]", table: Mapping[str, Any], still: int, count: int
) -> list[str]:
    """Return what must be known to read the figures."""
    notes, config = [], model.config
    if wrong := sum(int((~part.finite).sum()) for part in joined.values()):
        total = sum(part.finite.size for part in joined.values())
        notes.append(f"{wrong} of {total} predicted frames are NaN or infinite: the checkpoint has diverged")
    if table["loss"] is None:
        notes.append("the loss is not finite: the checkpoint has diverged")
    if 2 * still > count:
        notes.append(
            f"the true pictures of {still} of {count} windows never change: a copy of the prompt is perfect "
            "there, and the figures say nothing about the actions"
        )
    blind = any(not OBJECTIVES[name].sees_actions for name, often in config.objectives.items() if often)
    if not config.drop_commands and not blind:
        notes.append("the model was not trained without commands, so its rollouts with none may be poor")
    return notes


@dataclass(frozen=True)
class _Scores:
    """PSNR (B, P) in dB, SSIM (B, P) and LPIPS (B, P) of predicted frames; NaN where one is not finite."""

    psnr: Floats
    ssim: Floats
    lpips: Floats | None
    finite: NDArray[np.bool_]

    @classmethod
    def of(cls, pictures: Pictures, judge: Judge | None = None) -> "_Scores":
        truth, predicted = (part[:, pictures.prompt :] for part in (pictures.truth, pictures.predicted))
        size, shape = truth.shape[:2], (-1, *truth.shape[2:])
        truth, predicted = truth.reshape(shape), predicted.reshape(shape)
        signal = np.minimum(psnr(truth, predicted), PSNR_LIMIT)
        parts = [signal, ssim(truth, predicted)]
        if judge and judge.networks.lpips:
            parts.append(judge.networks.lpips(truth, predicted))
        parts = [np.where(pictures.finite, part.reshape(size), np.nan) for part in parts]
        return cls(parts[0], parts[1], parts[2] if len(parts) > 2 else None, pictures.finite)

    @classmethod
    def mean(cls, draws: "list[_Scores]") -> "_Scores":
        """Return the means over draws."""
        return cls._combined(draws, partial(np.mean, axis=0), partial(np.all, axis=0))

    @classmethod
    def join(cls, batches: "list[_Scores]") -> "_Scores":
        return cls._combined(batches, np.concatenate, np.concatenate)

    @classmethod
    def _combined(
        cls, parts: "list[_Scores]", rule: Callable[..., Any], of_finite: Callable[..., Any]
    ) -> "_Scores":
        far = None if parts[0].lpips is None else rule([part.lpips for part in parts])
        psnrs, ssims = rule([part.psnr for part in parts]), rule([part.ssim for part in parts])
        return cls(psnrs, ssims, far, of_finite([part.finite for part in parts]))

    def figures(self, seed: int) -> dict[str, Any]:
        """Return the means over windows, with their intervals."""
        found = summary("psnr", self.psnr.mean(axis=1), seed, digits=6)
        found |= summary("psnr_last", self.psnr[:, -1], seed, digits=6)
        found |= _by_frame("psnr", self.psnr, seed) | summary("ssim", self.ssim.mean(axis=1), seed, digits=6)
        found |= _by_frame("ssim", self.ssim, seed)
        if self.lpips is not None:
            found |= summary("lpips", self.lpips.mean(axis=1), seed) | _by_frame("lpips", self.lpips, seed)
        return found


def _by_frame(name: str, values: Floats, seed: int) -> dict[str, Any]:
    """Return the means of values (N, P) over windows and their intervals: P pairs."""
    return {
        f"{name}_by_frame": rounded(values.mean(axis=0), 3 if name == "psnr" else 4),
        f"{name}_by_frame_95": rounded(interval(values, seed).T),
    }
