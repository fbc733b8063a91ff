"""Measure how well a model predicts: its loss, a baseline that ignores all input, and its rollouts.

The loss is the cross-entropy in nats a token of each fully masked frame, given the true frames and actions
before it. It is averaged over the frames from the second on. The baseline is the same cross-entropy for the
frequencies of the training tokens: a model that ignores its input would reach it. A rollout continues from
its own predictions. Rollouts are made with the true actions and with shuffled ones, those of another window;
the difference shows how much the model uses the actions. Which window gets which actions is drawn several
times, and the figures of shuffled actions are means over the draws.

B batch, T frames, P frames of the prompt, h,w grid, F digits, V values a digit, S pixels a side, C cameras.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypedDict, Unpack

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hma_data.errors import UsageError
from hma_data.loading.dataset import Batch, WindowDataset
from hma_data.loading.views import FIRST, Cameras, Views, view_count
from hma_data.shards.reader import ShardSet
from hma_data.storage.paths import StrPath
from hma_model.checkpoint.folder import Checkpoint, require_tokenizer
from hma_model.config import OBJECTIVES
from hma_model.evaluation.metrics import perplexity, psnr, ssim, teacher_forced

if TYPE_CHECKING:
    from hma_data.tokenizers.base import Tokenizer
    from hma_model.network.model import HMA

BASELINE_FRAMES = 200_000
DRAWS = 5  # of other windows' actions
FOLLOWS_DB = 0.5  # gain of the last frame's PSNR from which a model is said to follow its actions
PSNR_LIMIT = 60.0  # dB; the PSNR of equal pictures, and with it a mean over frames, would be infinite


class Sampling(TypedDict, total=False):
    """Options of `HMA.generate` that a rollout passes on to it."""

    unmask_steps: int
    temperature: float
    order: str
    sample_steps: int | None
    guidance: float
    noise_level: float
    precision: str
    compile: bool


@dataclass
class Means:
    """Sums and counts of sample values by embodiment."""

    sums: dict[str, float] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)

    def add(self, names: Sequence[str], values: Tensor | NDArray[Any]) -> None:
        """Add one value a sample, (B,)."""
        for name, value in zip(names, values.tolist()):
            self.sums[name] = self.sums.get(name, 0.0) + value
            self.counts[name] = self.counts.get(name, 0) + 1

    def by_embodiment(self) -> dict[str, float]:
        """Return the mean of each embodiment, sorted by id."""
        return {name: self.sums[name] / self.counts[name] for name in sorted(self.sums)}

    def mean(self) -> float:
        """Return the mean over all samples; NaN if there are none."""
        return sum(self.sums.values()) / max(sum(self.counts.values()), 1) if self.counts else float("nan")


def windows(
    data: StrPath | ShardSet,
    split: str,
    frames: int,
    count: int,
    batch_size: int = 8,
    cameras: Cameras = FIRST,
) -> Iterator[Batch]:
    """Yield up to `count` windows of a split in batches; they are evenly spaced and always the same."""
    dataset = WindowDataset(data, split, frames, cameras=cameras)
    chosen = np.unique(np.linspace(0, len(dataset) - 1, min(count, len(dataset))).astype(np.int64))
    for start in range(0, len(chosen) if len(dataset) else 0, batch_size):
        yield dataset.batch(chosen[start : start + batch_size])


@torch.no_grad()
def validation_losses(
    model: "HMA", batches: Iterable[Batch], seed: int = 0, objective: str = "forward"
) -> tuple[Means, Means]:
    """Return the losses and accuracies of the windows, by embodiment.

    Where a discrete model predicts video from actions, the loss is that of `teacher_forced`. Any other loss
    is the training loss of the objective, under masks and noise drawn from `seed`; it has no accuracy.
    """
    losses, accuracy, training = Means(), Means(), model.training
    drawn = OBJECTIVES[objective]
    exact = model.config.kind == "discrete" and drawn.predicts_video and drawn.sees_actions
    model.eval()
    for number, batch in enumerate(batches):
        batch = batch.to(model.device)
        if exact:
            nats, hits = teacher_forced(model, batch)
            losses.add(batch.embodiment, nats.mean(dim=1))
            accuracy.add(batch.embodiment, hits.mean(dim=1))
        else:
            generator = torch.Generator().manual_seed(seed * 1_000_003 + number)
            losses.add(batch.embodiment, model(batch, objective, generator).per_sample)
    model.train(training)
    return losses, accuracy


def masked_val_loss(model: "HMA", batches: Iterable[Batch]) -> float:
    """Return the mean loss over windows: nats a token of each fully masked frame given the true past."""
    return validation_losses(model, batches)[0].mean()


def digit_frequencies(
    shards: ShardSet,
    max_frames: int = BASELINE_FRAMES,
    cameras: Cameras = FIRST,
    factored: Sequence[int] | None = None,
) -> list[NDArray[np.float64]]:
    """Return the frequency of each value of each digit in train: F arrays (V,), add-one smoothed.

    `factored` states the values of each digit, low digit first; by default it is the tokenizer's.

    Of more than `max_frames` frames, only row groups spread evenly over them are counted, about `max_frames`
    frames at most.
    """
    factored = factored or shards.spec.factored or (shards.spec.vocab_size or 1,)
    counts = [np.ones(values) for values in factored]
    files = list(zip(shards.shards("train"), shards.row_groups("train")))
    groups = [(name, group) for name, rows in files for group in range(len(rows))]
    stride = max(1, -(-sum(sum(rows) for _, rows in files) // max_frames))
    columns = Views.of(shards, cameras).columns
    for name, group in groups[::stride]:
        read = shards.read(name, [group], columns)
        tokens = np.concatenate([read[column].astype(np.int64).ravel() for column in columns])
        for digit, values in enumerate(factored):
            counts[digit] += np.bincount(tokens % values, minlength=values)
            tokens //= values
    return [count / count.sum() for count in counts]


def unconditional_baseline(
    train: Mapping[str, ShardSet] | Sequence[StrPath | ShardSet],
    batches: Iterable[Batch],
    cameras: Cameras = FIRST,
    factored: Sequence[int] | None = None,
    merge: int = 1,
) -> Means:
    """Return the cross-entropy of each embodiment's training frequencies, which ignores all input.

    Args:
        train: shard sets (or the str or path of each), whose train frames are counted, digit by digit.
        batches: validation windows of discrete tokens.
        cameras: as `WindowDataset` takes them.
        factored: values of each digit, low digit first; by default the tokenizer's.
        merge: the side of a square of tokens that counts as one, as `HMAConfig.merge`.

    Returns:
        Nats a token by embodiment, over the frames from the second on, as in `masked_val_loss`.
    """
    sets = train.values() if isinstance(train, Mapping) else [_opened(item) for item in train]
    scores = {
        s.embodiment.id: [np.log(p) for p in digit_frequencies(s, cameras=cameras, factored=factored)]
        for s in sets
    }
    means = Means()
    for batch in batches:
        assert batch.tokens is not None
        for name, tokens in zip(batch.embodiment, batch.tokens[:, 1:].numpy()):
            nats, rest = np.zeros(tokens.shape), tokens.copy()
            for digit in scores[name]:
                nats -= digit[rest % len(digit)]
                rest //= len(digit)
            means.add([name], np.array([nats.mean() * merge**2]))
    return means


@dataclass(frozen=True)
class Pictures:
    """A rollout and the truth, both uint8 (B, T, S, C·S, 3); the first P frames are the prompt."""

    prompt: int
    predicted: NDArray[np.uint8]
    truth: NDArray[np.uint8]


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
    known = batch.action_mask[:, : first + count].to(model.device)
    predicted = model.generate(
        given, chunks, batch.embodiment, count, generator=generator, known=known, **sampling
    )
    if truth is None:
        truth = decode(tokenizer, stored[:, : first + count])
    made = decode(tokenizer, predicted)
    return Pictures(first, np.concatenate([truth[:, :first], made], axis=1), truth)


def default_prompt(length: int) -> int:
    """Return how many frames of a window of this length a rollout starts from."""
    return max(1, length // 3)


def decode(tokenizer: "Tokenizer", stored: Tensor) -> NDArray[np.uint8]:
    """Decode ids (B, T, C·h, w) or latents (B, T, c, C·H, W) to pictures (B, T, S, C·S, 3), side by side."""
    views = stored.flatten(0, 1).cpu().numpy()
    dtype = np.uint32 if tokenizer.spec.kind == "discrete" else np.dtype(tokenizer.spec.dtype)
    cameras = np.split(views.astype(dtype), views.shape[-2] // tokenizer.spec.grid[0], axis=-2)
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


def shuffled_actions(batch: Batch, begin: int = 0, seed: int = 0, draw: int = 0) -> Tensor:
    """Replace each window's chunks from `begin` on by those of another window of the same embodiment.

    Every `draw` pairs the windows anew. A window that is the only one of its embodiment gets its own chunks
    in reverse. Return (B, T, K).
    """
    actions = batch.actions.clone()
    source = batch.actions[:, begin:]
    rng = np.random.default_rng([seed, 1 + draw])
    for name in dict.fromkeys(batch.embodiment):
        own = rng.permutation([i for i, other in enumerate(batch.embodiment) if other == name])
        if len(own) == 1:
            actions[own, begin:] = source[own].flip(1)
        else:
            actions[own, begin:] = source[np.roll(own, 1)]
    return actions


def shuffled(batch: Batch, begin: int = 0, seed: int = 0, draw: int = 0) -> Batch:
    """Return the windows with the chunks of `shuffled_actions`, which are known where they were."""
    masks = replace(batch, actions=batch.action_mask)
    known = shuffled_actions(masks, begin, seed, draw)
    return replace(batch, actions=shuffled_actions(batch, begin, seed, draw), action_mask=known)


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
        `baseline_loss`, `perplexity` and `accuracy`. For rollouts with the `true` actions, with `shuffled`
        actions, and for `copy`, which repeats the last frame of the prompt: `psnr` and `ssim` over the
        horizon, `psnr_last` and `psnr_by_frame`. `psnr_action_gain_last` is `psnr_last` of true minus that of
        shuffled.

    Raises:
        CheckpointError: the model was trained on another tokenizer.
        UsageError: the split has no window.
    """
    shards = _opened(data)
    require_tokenizer(model.config, shards.spec, shards.folder)
    length = frames or model.config.frames
    first = default_prompt(length) if prompt is None else prompt
    cameras = cameras_for(model, shards, cameras)
    if not len(WindowDataset(shards, split, length, cameras=cameras)):
        raise UsageError(shards.folder, f"has no window of {length} frames in {split}", "use another split")

    def chosen() -> Iterator[Batch]:
        return windows(shards, split, length, count, batch_size, cameras)

    table = _losses(model, shards, chosen, cameras, draws)
    scores: dict[str, list[_Scores]] = {"true": [], "shuffled": [], "copy": []}
    for number, batch in enumerate(chosen()):
        roll = partial(rollout, model, tokenizer, prompt=first, seed=seed + number, **sampling)
        true = roll(batch)
        still = true.predicted.copy()
        still[:, first:] = still[:, first - 1 : first]
        scores["true"].append(_Scores.of(true))
        scores["copy"].append(_Scores.of(replace(true, predicted=still)))
        for draw in range(draws):
            other = shuffled(batch, first - 1, seed, draw)
            scores["shuffled"].append(_Scores.of(roll(other, truth=true.truth)))
    figures = {name: _Scores.means(parts) for name, parts in scores.items()}
    return {
        "embodiment": shards.embodiment.id,
        "split": split,
        "windows": sum(len(part.psnr) for part in scores["true"]),
        "frames": length,
        "prompt": first,
        "draws": draws,
        "against": "decoded tokens",
        "cameras": cameras if isinstance(cameras, str) else ", ".join(cameras),
        **table,
        **figures,
        "psnr_action_gain_last": figures["true"]["psnr_last"] - figures["shuffled"]["psnr_last"],
    }


def verdict(found: Mapping[str, Any]) -> str:
    """Return a sentence about the result of `evaluate`: whether the model follows its actions."""
    said = f"{found['psnr_action_gain_last']:+.1f} dB on the last frame, true less shuffled actions"
    if found["psnr_action_gain_last"] >= FOLLOWS_DB:
        return f"follows its actions: {said}"
    return f"does not follow its actions yet ({said})"


def _losses(
    model: "HMA", shards: ShardSet, chosen: Callable[[], Iterator[Batch]], cameras: Cameras, draws: int
) -> dict[str, Any]:
    losses, accuracy = validation_losses(model, chosen())
    if model.config.kind == "continuous":
        return {"loss": losses.mean()}
    other = (shuffled(batch, draw=draw) for draw in range(draws) for batch in chosen())
    return {
        "loss": losses.mean(),
        "shuffled_loss": masked_val_loss(model, other),
        "baseline_loss": unconditional_baseline(
            [shards], chosen(), cameras, model.config.factored, model.config.merge
        ).mean(),
        "perplexity": perplexity(losses.mean()),
        "accuracy": accuracy.mean(),
    }


@dataclass(frozen=True)
class _Scores:
    """PSNR (B, P) in dB and SSIM (B, P) of predicted frames."""

    psnr: NDArray[np.float64]
    ssim: NDArray[np.float64]

    @classmethod
    def of(cls, pictures: Pictures) -> "_Scores":
        truth, predicted = (part[:, pictures.prompt :] for part in (pictures.truth, pictures.predicted))
        size, shape = truth.shape[:2], (-1, *truth.shape[2:])
        truth, predicted = truth.reshape(shape), predicted.reshape(shape)
        signal = np.minimum(psnr(truth, predicted), PSNR_LIMIT)
        return cls(signal.reshape(size), ssim(truth, predicted).reshape(size))

    @staticmethod
    def means(parts: "list[_Scores]") -> dict[str, Any]:
        by_frame = np.concatenate([part.psnr for part in parts]).mean(axis=0)
        return {
            "psnr": float(by_frame.mean()),
            "psnr_last": float(by_frame[-1]),
            "psnr_by_frame": [round(float(value), 3) for value in by_frame],
            "ssim": float(np.concatenate([part.ssim for part in parts]).mean()),
        }


def _opened(item: StrPath | ShardSet) -> ShardSet:
    return item if isinstance(item, ShardSet) else ShardSet(item)
