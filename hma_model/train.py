"""Training: one plain loop that goes on where it was cut.

    result = train(load_recipe("discrete_tiny", ["data=[shards/arm, shards/hand]"]), out="runs/first")

The run's folder holds recipe.json, environment.json, metrics.jsonl and checkpoints/step-XXXXXXXX. Running it
again resumes from the newest checkpoint: on a CPU bit for bit as if it had never stopped. SIGTERM and SIGINT
save before they end the run.
"""

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hma_data.errors import CheckpointError, RecipeError, TrainingError, UsageError
from hma_data.files import write_atomic
from hma_data.loader import Batch, MixtureDataset, WindowDataset, open_sets
from hma_data.shards.reader import ShardSet
from hma_model import checkpoint as checkpoints
from hma_model.checkpoint import Checkpoint, action_stats, training_checkpoints
from hma_model.config import ActionSpace
from hma_model.evaluate import (
    Means,
    digit_frequencies,
    unconditional_baseline,
    validation_losses,
    windows,
)
from hma_model.files import remove_partial, to_json
from hma_model.metrics import perplexity
from hma_model.model import HMA
from hma_model.optim import lr_scale, make_optimizer, set_lr
from hma_model.recipe import Recipe
from hma_model.resume import State, data_digests, read_state, restore, seed_for, write_state
from hma_model.runlog import RunLog, read_metrics
from hma_model.runtime import ENVIRONMENT, RECIPE, choose_device, environment, own_folder, stop_on_signals

NAMED = 4  # windows named in an error


@dataclass(frozen=True)
class TrainResult:
    """What a run came to.

    Attributes:
        out: the run's folder.
        checkpoint: its newest checkpoint, which can be pushed, evaluated and generated from.
        step: steps done; less than the recipe's where the run was interrupted.
        losses: (step, training loss) of every step.
        evaluations: lines of kind eval in metrics.jsonl.
        masked_val_loss: of the last evaluation: nats a token of fully masked frames given the true past
            (continuous: the diffusion loss); None where there are no validation windows.
        baseline: nats a token of the training frequencies on the same windows; None likewise.
        interrupted: a signal ended the run early.
        skipped: steps left out for losses that were not numbers.
        seconds: spent in steps, all sessions together.
    """

    out: Path
    checkpoint: Path
    step: int
    losses: list[tuple[int, float]]
    evaluations: list[dict[str, Any]]
    masked_val_loss: float | None
    baseline: float | None
    interrupted: bool
    skipped: int
    seconds: float


def train(
    recipe: Recipe,
    *,
    out: str | Path | None = None,
    on_progress: Callable[[dict[str, Any]], None] | None = None,
    show: bool = True,
    force: bool = False,
) -> TrainResult:
    """Train, or go on training.

    Args:
        recipe: see `hma_model.recipe`.
        out: the run's folder; by default the recipe's.
        on_progress: called after every step with its line of metrics.jsonl.
        show: progress on standard error.
        force: go on although the recipe or the shards have changed.

    Raises:
        UsageError: no folder is named.
        RecipeError: the recipe does not fit the data, or differs from that of the run in the folder.
        ShardError: the shards do not go together.
        OutputError: the folder holds something else, cannot be written, or another run is at work in it.
        TrainingError: a loss is not a number; it names the windows.
        CheckpointError: a checkpoint cannot be written or none of them can be read.
    """
    if out is None and recipe.out is None:
        raise UsageError("out", "is not given", "name the run's folder with --out or out=DIR")
    folder = Path(out or recipe.out or "")
    device = choose_device(recipe.device)
    cuda = [device] if device.type == "cuda" else []
    with own_folder(folder), torch.random.fork_rng(devices=cuda):
        run = Run(recipe, folder, device)
        noted = run.resume(force)
        if not run.step:
            run.begin()
        with RunLog(folder, recipe.steps, run.step, show) as log, stop_on_signals() as stop:
            for text in noted + run.remarks():
                log.note(text)
            _loop(run, log, stop, on_progress)
        return _result(run, interrupted=run.step < recipe.steps)


def _loop(
    run: "Run", log: RunLog, stop: threading.Event, on_progress: Callable[[dict[str, Any]], None] | None
) -> None:
    recipe = run.recipe
    while run.step < recipe.steps and not stop.is_set():
        facts = run.advance()
        log.step(facts)
        if on_progress:
            on_progress(facts)
        last = run.step == recipe.steps
        if (last or _due(run.step, recipe.eval_every)) and run.held_out:
            log.evaluation(run.evaluate())
        if last or stop.is_set() or _due(run.step, recipe.checkpoint_every):
            run.save()
    if stop.is_set():
        log.note(f"stopped by a signal and saved at step {run.step}; the same command goes on")


class Run:
    """Model, optimizer and data of a run, and its steps.

    Args:
        recipe: what to train.
        out: the run's folder; it is there.
        device: where the model is.
    """

    def __init__(self, recipe: Recipe, out: Path, device: torch.device) -> None:
        if not recipe.data:
            raise RecipeError("recipe: data", "names no shards", "add data=[FOLDER, …]")
        self.recipe, self.out, self.device = recipe, out, device
        self.sets = open_sets(recipe.data)
        self.data = _dataset(recipe, self.sets)
        self.digests = data_digests(self.sets)
        spec = next(iter(self.sets.values())).spec
        torch.manual_seed(seed_for(recipe.seed, "init"))
        self.model = HMA(recipe.network(spec))
        for shards in self.sets.values():
            stats = action_stats(shards.manifest.stats, shards.folder)
            self.model.add_embodiment(ActionSpace.of(shards.embodiment, stats))
        self.model.to(device).train()
        self.optimizer = make_optimizer(self.model, recipe)
        self.held_out = {
            name: s for name, s in self.sets.items() if len(WindowDataset(s, "val", recipe.frames))
        }
        self.step, self.skipped, self.seconds = 0, 0, 0.0
        self.evaluation: dict[str, Any] = {}
        self._baseline: Means | None = None
        self._batches: Iterator[Batch] | None = None

    def remarks(self) -> list[str]:
        """What somebody who watches should know."""
        missing = sorted(set(self.sets) - set(self.held_out))
        return (
            [f"no validation windows of {self.recipe.frames} frames: {', '.join(missing)}"] if missing else []
        )

    @torch.no_grad()
    def begin(self) -> None:
        """Give the readout the log frequencies of the training tokens, so that no step is spent on them."""
        if self.recipe.readout_bias == "zero" or self.model.config.kind != "discrete":
            return
        shares = [
            [p * digit for digit in digit_frequencies(shards)]
            for p, shards in zip(self.data.mixture.p, self.sets.values())
        ]
        bias = np.log(np.concatenate([sum(digits) for digits in zip(*shares)]))
        own = self.model.token_readout.linear.bias
        own.copy_(torch.from_numpy(bias).to(own))

    # -- a step

    def advance(self) -> dict[str, Any]:
        """One update of the weights; returns its line of metrics.jsonl."""
        recipe, begun = self.recipe, time.monotonic()
        torch.manual_seed(seed_for(recipe.seed, "dropout", self.step))
        lr = set_lr(self.optimizer, lr_scale(self.step, recipe))
        self.optimizer.zero_grad(set_to_none=True)
        losses, objectives, total, batches = Means(), set(), 0.0, []
        for part in range(recipe.accumulate):
            batch = self._next()
            generator = torch.Generator().manual_seed(seed_for(recipe.seed, "masks", self.step, part))
            with self._autocast():
                output = self.model(batch, generator=generator)
            (output.loss / recipe.accumulate).backward()
            total += float(output.loss.detach()) / recipe.accumulate
            losses.add(batch.embodiment, output.per_sample)
            objectives.add(output.objective)
            batches.append((batch, output.per_sample))
        norm = float(torch.nn.utils.clip_grad_norm_(self.model.parameters(), recipe.clip))
        self.step += 1
        if math.isfinite(total) and math.isfinite(norm):
            self.optimizer.step()
        else:
            self._not_finite(total, norm, batches)
        spent = time.monotonic() - begun
        self.seconds += spent
        return {
            "step": self.step,
            "loss": total,
            "loss_by_embodiment": losses.by_embodiment(),
            "objectives": sorted(objectives),
            "lr": lr,
            "grad_norm": norm,
            "windows": recipe.windows_per_step,
            "step_seconds": round(spent, 6),
            "skipped": self.skipped,
        }

    def _next(self) -> Batch:
        if self._batches is None:
            self._batches = self.data.batches(self.recipe.workers)
        return next(self._batches).to(self.device)

    def _autocast(self) -> Any:
        if self.recipe.precision == "fp32":
            return nullcontext()
        return torch.autocast(self.device.type, torch.bfloat16)

    def _not_finite(self, loss: float, norm: float, batches: list[tuple[Batch, Tensor]]) -> None:
        if self.recipe.nonfinite == "skip":
            self.skipped += 1
            return
        raise TrainingError(
            f"step {self.step}",
            f"the loss is {loss}, the gradient's norm {norm}; windows: {_culprits(batches)}",
            "look at these with hma shards preview, lower lr, or go on without such steps by nonfinite=skip",
        )

    # -- evaluation and checkpoints

    def evaluate(self) -> dict[str, Any]:
        """Validation loss beside its baseline; returns the line of metrics.jsonl."""
        recipe, begun = self.recipe, time.monotonic()

        def held_out() -> Iterator[Batch]:
            for shards in self.held_out.values():
                yield from windows(shards, "val", recipe.frames, recipe.eval_windows, recipe.batch_size)

        with self._autocast():
            losses, accuracy = validation_losses(self.model, held_out(), recipe.seed)
        facts: dict[str, Any] = {
            "step": self.step,
            "loss": losses.mean(),
            "loss_by_embodiment": losses.by_embodiment(),
            "windows": sum(losses.counts.values()),
        }
        if self.model.config.kind == "discrete":
            if self._baseline is None:
                self._baseline = unconditional_baseline(self.sets, held_out())
            facts["perplexity"] = perplexity(facts["loss"])
            facts["accuracy"] = accuracy.mean()
            facts["accuracy_by_embodiment"] = accuracy.by_embodiment()
            facts["baseline"] = self._baseline.mean()
            facts["baseline_by_embodiment"] = self._baseline.by_embodiment()
        self.evaluation = {**facts, "seconds": round(time.monotonic() - begun, 3)}
        return self.evaluation

    def save(self) -> Path:
        """Write checkpoints/step-N, and delete all but the last few."""
        path = self.out / "checkpoints" / f"step-{self.step:08d}"
        state = State(
            step=self.step,
            recipe=self.recipe.identity(),
            data=self.digests,
            sampler=self.data.state_dict(),
            skipped=self.skipped,
            seconds=self.seconds,
            evaluation=self.evaluation,
        )
        checkpoints.save(
            self.model,
            path,
            embodiment_yaml={name: s.embodiment.to_yaml() for name, s in self.sets.items()},
            stats={name: s.manifest.stats for name, s in self.sets.items()},
            cards={name: self._card(name, s) for name, s in self.sets.items()},
            tokenizer=next(iter(self.sets.values())).spec.to_json(),
            training=lambda folder: write_state(folder, state, self.optimizer),
        )
        for old in training_checkpoints(self.out)[: -self.recipe.keep_last]:
            checkpoints.remove(old)
        return path

    def _card(self, name: str, shards: ShardSet) -> dict[str, Any]:
        figures = (("val_loss", "loss"), ("baseline_loss", "baseline"), ("accuracy", "accuracy"))
        metrics = {
            ours: self.evaluation[f"{theirs}_by_embodiment"].get(name)
            for ours, theirs in figures
            if f"{theirs}_by_embodiment" in self.evaluation
        }
        train = shards.manifest.splits.get("train", {})
        data: dict[str, Any] = {key: train.get(key) for key in ("episodes", "frames")}
        if "://" in shards.manifest.source:  # a path would only be of use here
            data["source"] = shards.manifest.source
        return {"data": data, "metrics": metrics, "training": {"steps": self.step, "seed": self.recipe.seed}}

    def resume(self, force: bool) -> list[str]:
        """Go to where the newest readable checkpoint stands; returns what there is to say about it.

        Raises:
            RecipeError: recipe or shards differ from the run's.
            CheckpointError: there are checkpoints, and none can be read.
        """
        remove_partial(self.out / "checkpoints")
        notes: list[str] = []
        paths = training_checkpoints(self.out)
        for path in reversed(paths):
            try:
                kept = Checkpoint.open(path)
                state = read_state(kept)
                if not force:
                    state.require_same(self.recipe.identity(), self.digests, self.out)
                restore(kept, self.model, self.optimizer)
            except CheckpointError as fault:
                if path == paths[0]:
                    raise
                notes.append(f"passed over a damaged checkpoint: {fault}")
                continue
            notes += self._continue(state, force)
            break
        write_atomic(self.out / RECIPE, to_json(self.recipe.values()))
        write_atomic(self.out / ENVIRONMENT, to_json(environment(self.device)))
        return notes

    def _continue(self, state: State, force: bool) -> list[str]:
        self.step, self.skipped, self.seconds = state.step, state.skipped, state.seconds
        self.evaluation = state.evaluation
        notes = [f"going on from step {state.step}"]
        try:
            self.data.load_state_dict(state.sampler)
        except UsageError as fault:
            if not force:
                raise
            notes.append(f"the sampler begins anew: {fault}")
        return notes


def _dataset(recipe: Recipe, sets: dict[str, ShardSet]) -> MixtureDataset:
    mixture = recipe.mixture
    data = MixtureDataset(
        list(sets.values()),
        recipe.batch_size,
        recipe.frames,
        temperature=mixture.temperature,
        weights=mixture.weights or None,
        draw=mixture.draw,
        seed=seed_for(recipe.seed, "sampler"),
    )
    count = sum(data.mixture.counts)
    if recipe.windows_per_step > count:
        raise RecipeError(
            "recipe: batch_size",
            f"{recipe.windows_per_step} windows a step are more than the {count} there are",
            "lower batch_size or accumulate, or add data",
        )
    return data


def _culprits(batches: list[tuple[Batch, Tensor]]) -> str:
    """The windows whose losses are not numbers; all where every single loss is one."""
    bad, every = [], []
    for batch, losses in batches:
        places = zip(batch.embodiment, _numbers(batch.episode), _numbers(batch.frame), losses.tolist())
        for name, episode, frame, loss in places:
            text = f"{name} episode {episode} frame {frame}"
            every.append(text)
            if not math.isfinite(loss):
                bad.append(text)
    named = bad or every
    return "; ".join(named[:NAMED]) + (f" and {len(named) - NAMED} more" if len(named) > NAMED else "")


def _numbers(values: Tensor | None) -> Iterator[Any]:
    return iter(values.tolist()) if values is not None else iter(lambda: "?", None)


def _due(step: int, every: int) -> bool:
    return every > 0 and step % every == 0


def _result(run: Run, interrupted: bool) -> TrainResult:
    lines = read_metrics(run.out)
    evaluations = [line for line in lines if line["kind"] == "eval"]
    return TrainResult(
        out=run.out,
        checkpoint=checkpoints.resolve(run.out),
        step=run.step,
        losses=[(line["step"], line["loss"]) for line in lines if line["kind"] == "train"],
        evaluations=evaluations,
        masked_val_loss=run.evaluation.get("loss"),
        baseline=run.evaluation.get("baseline"),
        interrupted=interrupted,
        skipped=run.skipped,
        seconds=run.seconds,
    )
