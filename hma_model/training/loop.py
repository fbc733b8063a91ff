"""Train a model in one plain loop, which resumes an interrupted run.

    result = train(load_recipe("discrete_tiny", ["data=[shards/arm, shards/hand]"]), out="runs/first")

The run's folder holds recipe.json, environment.json, metrics.jsonl and checkpoints/step-XXXXXXXX. Running it
again resumes from the newest checkpoint; on a CPU the result is bit for bit that of a run without the
interruption. On SIGTERM and SIGINT the run saves a checkpoint before it ends.
"""

import re
import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from hma_data.errors import UsageError
from hma_data.storage.paths import StrPath, as_text
from hma_model.checkpoint import io as checkpoints
from hma_model.training.logging import RunLog, read_metrics
from hma_model.training.parallel import World, join
from hma_model.training.recipe import Recipe
from hma_model.training.report import write_report
from hma_model.training.run import Run
from hma_model.training.runtime import choose_device, enough_memory, own_folder, stop_on_signals, writable
from hma_model.training.trackers import Tracker, open_trackers


@dataclass(frozen=True)
class TrainResult:
    """The result of a run.

    Attributes:
        out: the run's folder.
        checkpoint: the newest checkpoint, to push, to evaluate or to generate from.
        step: number of finished steps; fewer than the recipe's if the run was interrupted.
        losses: (step, training loss) of every step.
        evaluations: lines of kind eval in metrics.jsonl.
        masked_val_loss: the loss of the last evaluation: nats a token of fully masked frames given the true
            past (continuous: the diffusion loss); None without validation windows.
        baseline: nats a token of the training frequencies on the same windows; None without a baseline.
        interrupted: a signal ended the run early.
        skipped: number of steps skipped because of a bad loss or gradient.
        seconds: time spent in steps, all sessions together.
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
    out: StrPath | None = None,
    on_progress: Callable[[dict[str, Any]], None] | None = None,
    show: bool = True,
    force: bool = False,
) -> TrainResult:
    """Train a model, or resume its training.

    Args:
        recipe: see `hma_model.training.recipe`.
        out: str or path of the run's folder; by default the recipe's.
        on_progress: called after every step with its line of metrics.jsonl.
        show: print progress to standard error.
        force: resume although the recipe or the shards have changed.

    Raises:
        UsageError: no folder is named.
        RecipeError: the recipe does not fit the data, or differs from that of the run in the folder.
        ShardError: the shard sets cannot be combined.
        OutputError: the folder holds something else, cannot be written, or another run uses it.
        TrainingError: a loss or gradient is bad (it names the windows); memory is short; a rank is lost.
        CheckpointError: a checkpoint cannot be written, or none of them can be read.
    """
    chosen = recipe.out if out is None else out
    if chosen is None:
        raise UsageError("out", "is not given", "name the run's folder with --out or out=DIR")
    named = as_text(chosen)
    if not named.strip() or "\0" in named:
        raise UsageError("out", f"is {named!r}, no name of a folder", "name the run's folder with --out DIR")
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]+:/", named):
        raise UsageError("out", f"is {named!r}, no folder of this machine", "train here, then hma hub push")
    device = choose_device(recipe.device)
    with join(device) as world:
        return _trained(recipe, Path(named), device, world, on_progress, show, force)


def _trained(
    recipe: Recipe,
    folder: Path,
    device: torch.device,
    world: World,
    on_progress: Callable[[dict[str, Any]], None] | None,
    show: bool,
    force: bool,
) -> TrainResult:
    cuda = [device] if device.type == "cuda" else []
    with (
        writable(folder),
        enough_memory(),
        ExitStack() as stack,
        torch.random.fork_rng(devices=cuda),
    ):
        world.once(lambda: stack.enter_context(own_folder(folder)))
        run = Run(recipe, folder, device, world)
        kept, noted = run.resume(force)
        if not run.step:
            run.begin()
        run.prepare(kept)
        trackers: list[Tracker] = []
        world.once(lambda: trackers.extend(open_trackers(recipe, folder, run.step)))
        shown = show and world.main
        with RunLog(folder, recipe.steps, run.step, shown, world.main, trackers, run.nats) as log:
            for text in noted + run.remarks():
                log.note(text)
            with stop_on_signals() as stop:
                _loop(run, log, stop, on_progress)
        result = _result(run, interrupted=run.step < recipe.steps)
        if recipe.report:
            world.once(lambda: write_report(result.out))
        return result


def _loop(
    run: Run, log: RunLog, stop: threading.Event, on_progress: Callable[[dict[str, Any]], None] | None
) -> None:
    recipe, stopped = run.recipe, False
    while run.step < recipe.steps and not stopped:
        facts = run.advance()
        log.step(facts)
        if on_progress:
            on_progress(facts)
        stopped = _agreed(run.world, stop)
        last = run.step == recipe.steps
        if (last or _due(run.step, recipe.eval_every)) and run.held_out:
            log.evaluation({**run.evaluate(), "mixture": run.train_data.realised()})
            log.pictures(run.out, run.step)
            if complaint := run.complaint():
                log.note(complaint)
        if last or stopped or _due(run.step, recipe.checkpoint_every):
            log.sync()
            run.save()
    if run.world.main and any(row["samples"] for row in run.train_data.realised()):
        log.note(f"drawn: {_shares(run)}")
    if stopped:
        log.note(f"stopped by a signal and saved at step {run.step}; the same command goes on")


def _shares(run: Run) -> str:
    rows = sorted(run.train_data.realised(), key=lambda row: -row["intended"])
    return ", ".join(f"{r['embodiment']} {r['realised']:.1%} ({r['intended']:.1%} intended)" for r in rows)


def _agreed(world: World, stop: threading.Event) -> bool:
    """Check whether any rank was asked to stop, so that all stop after the same step."""
    return bool(world.sum(torch.tensor([float(stop.is_set())]))[0])


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
