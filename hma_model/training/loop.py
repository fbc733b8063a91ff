"""Train a model in one plain loop, which resumes an interrupted run.

    result = train(load_recipe("discrete_tiny", ["data=[shards/arm, shards/hand]"]), out="runs/first")
    result = finetune("runs/first", ["shards/my_arm"], out="runs/my_arm", freeze_trunk=True)

The run's folder holds recipe.json, environment.json, metrics.jsonl and checkpoints/step-XXXXXXXX. Running it
again resumes from the newest checkpoint; on a CPU the result is bit for bit that of a run without the
interruption. On SIGTERM and SIGINT the run saves a checkpoint before it ends.
"""

import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml

from hma_data.errors import UsageError
from hma_data.storage.paths import StrPath, as_text
from hma_model.checkpoint.folder import resolve
from hma_model.training.logging import RunLog, Tracker, open_trackers, read_metrics
from hma_model.training.memory import memory_errors
from hma_model.training.parallel import join
from hma_model.training.recipe import Recipe, load_recipe, recipe_for
from hma_model.training.report import write_report
from hma_model.training.run import Run
from hma_model.training.runtime import choose_device, own_folder, run_errors, stop_on_signals


@dataclass(frozen=True)
class TrainResult:
    """The result of a run."""

    out: Path  # the run's folder
    checkpoint: Path  # the newest checkpoint, to push, to evaluate or to generate from
    step: int  # number of finished steps; fewer than the recipe's if the run was interrupted
    losses: list[tuple[int, float]]  # (step, training loss) of every step
    evaluations: list[dict[str, Any]]  # lines of kind eval in metrics.jsonl
    # the loss of the last evaluation, in nats a token of fully masked frames given the true past (continuous:
    # the diffusion loss), and that of the training frequencies on the same windows; None without windows
    masked_val_loss: float | None
    baseline: float | None
    interrupted: bool  # a signal ended the run early
    skipped: int  # number of steps skipped because a loss or gradient was not finite
    seconds: float  # time spent in steps, all sessions together


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
    if chosen is None or not as_text(chosen).strip():
        raise UsageError("out", "is not given", "name the run's folder with --out or out=DIR")
    folder = as_text(chosen)
    if "://" in folder:
        raise UsageError("out", f"is {folder!r}, not a local folder", "train here, then hma hub push")
    device = choose_device(recipe.device)
    cuda = [device] if device.type == "cuda" else []
    if cuda:
        torch.cuda.set_device(device)  # FSDP takes the current one
    with join(device) as ranks, run_errors(Path(folder)), ExitStack() as stack, torch.random.fork_rng(cuda):
        ranks.once(lambda: stack.enter_context(own_folder(Path(folder))))
        run = Run(recipe, Path(folder), device, ranks)
        stack.enter_context(memory_errors(run.model, run.recipe, device, ranks.size))
        kept = run.resume(force)
        if kept is None:
            run.begin()
        run.prepare(kept)
        run.note_settings()
        trackers: list[Tracker] = []
        ranks.once(lambda: trackers.extend(open_trackers(recipe, run.out, run.step)))
        log = RunLog(run.out, recipe.steps, run.step, show and ranks.main, ranks.main, trackers)
        with log, stop_on_signals() as stop:
            _loop(run, log, stop, on_progress)
        result = _result(run)
        if recipe.report:
            ranks.once(lambda: write_report(result.out))
        return result


def finetune(
    source: StrPath,
    data: Sequence[StrPath],
    *,
    out: StrPath | None = None,
    freeze_trunk: bool = False,
    overrides: Sequence[str] = (),
    recipe: StrPath | None = None,
    **options: Any,
) -> TrainResult:
    """Train new stems and heads on a checkpoint's trunk, frozen or tuned too; run it again to resume.

    With a frozen trunk the result can be pushed to the hub of the trunk, beside its other robots.

    Args:
        source: str or path of a checkpoint or a run's folder, a URI, or a hub repository, also
            `org/name@revision`; `embedded` is the bundled one of the data's tokenizer.
        data: str or path of folders of shards, made with the checkpoint's tokenizer; for a tuned trunk of
            colours also with other colours.
        out: str or path of the run's folder; by default the one that the overrides name.
        freeze_trunk: train only the stems and heads.
        overrides: `key=value` strings that override the recipe.
        recipe: name, or str or path of a YAML; by default `finetune_tiny` for the bundled
            transformer, `finetune_colors` for the bundled U-Nets, else `finetune`.
        options: `show`, `force`, `on_progress` of `train`.

    Raises:
        UsageError: no shards, or no folder for the run.
        CheckpointError: the shards are of another tokenizer, or state other actions for the robot.
        HubError: there is no such checkpoint.
    """
    if not data:
        raise UsageError("--data", "names no shards", "give the folder of hma convert")
    given = {
        "start": as_text(source),
        "data": [as_text(folder) for folder in data],
        "freeze": "trunk" if freeze_trunk else "nothing",
    }
    ours = [f"{key}={yaml.safe_dump(value, default_flow_style=True)}" for key, value in given.items()]
    return train(load_recipe(recipe or recipe_for(source, data[0]), [*ours, *overrides]), out=out, **options)


def _loop(
    run: Run, log: RunLog, stop: threading.Event, on_progress: Callable[[dict[str, Any]], None] | None
) -> None:
    recipe, stopped = run.recipe, False
    _show_notes(run, log)
    if run.step:  # the next line may take minutes
        log.note(f"continues after step {run.step:,}" if run.done < 1 else "the run is finished already")
    while run.done < 1 and not stopped:
        facts = run.advance()
        log.step(facts)
        if on_progress:
            on_progress(facts)
        asked = run.ranks.sum(torch.tensor([float(stop.is_set())]))  # all ranks stop after the same step
        stopped = bool(asked[0])
        last = run.done >= 1
        if run.held_out.sets and (last or _due(run.step, recipe.eval_every)):
            if last:
                log.note("training is finished; measuring the held-out loss")
            log.evaluation({**run.evaluate(), "mixture": run.train_data.realised()})
            log.pictures(run.out, run.step)
            _show_notes(run, log)
        if last or stopped or _due(run.step, recipe.checkpoint_every):
            log.sync()
            run.save()
    rows = sorted(run.train_data.realised(), key=lambda row: -row["intended"])
    if run.ranks.main and any(row["samples"] for row in rows):
        shares = (f"{r['embodiment']} {r['realised']:.1%} (mixture {r['intended']:.1%})" for r in rows)
        log.note(f"windows: {', '.join(shares)}")
    if stopped:
        log.note(f"stopped by a signal and saved at step {run.step}; run the same command to continue")


def _show_notes(run: Run, log: RunLog) -> None:
    for text in run.notes:
        log.note(text)
    run.notes.clear()


def _due(step: int, every: int) -> bool:
    return every > 0 and step % every == 0


def _result(run: Run) -> TrainResult:
    losses, evaluations = list[tuple[int, float]](), list[dict[str, Any]]()
    for line in read_metrics(run.out):
        if line["kind"] == "train":
            losses.append((line["step"], line["loss"]))
        else:
            evaluations.append(line)
    return TrainResult(
        out=run.out,
        checkpoint=resolve(run.out),
        step=run.step,
        losses=losses,
        evaluations=evaluations,
        masked_val_loss=run.evaluation.get("loss"),
        baseline=run.evaluation.get("baseline"),
        interrupted=run.done < 1,
        skipped=run.skipped,
        seconds=run.seconds,
    )
