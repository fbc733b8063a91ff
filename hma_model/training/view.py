"""Show a training run in Rerun: its losses and rates, and a held-out window beside its prediction."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hma_data.errors import UsageError
from hma_data.inspection.view import View
from hma_data.loading.dataset import WindowDataset
from hma_data.shards.preview import tokenizer_of
from hma_data.shards.reader import ShardSet
from hma_data.storage.paths import StrPath, as_path
from hma_model.checkpoint import io as checkpoints
from hma_model.checkpoint.folder import Checkpoint
from hma_model.evaluation.actions import shuffled
from hma_model.evaluation.rollouts import rollout
from hma_model.generation.decode import cameras_for
from hma_model.training.logging import read_metrics
from hma_model.training.report import Figures


def view_run(out: StrPath, window: int = 0, data: Sequence[StrPath] = ()) -> View:
    """Show a run's figures on the timeline `step`, and a rollout on `time` and `frame`.

    Args:
        out: str or path of the run's folder, or of a checkpoint.
        window: number of the held-out window that is rolled out.
        data: str or path of shard sets, of which the first with a robot of the checkpoint is shown; none
            takes those that the run's recipe names, if they are still there.

    Raises:
        CheckpointError: there is no checkpoint.
        UsageError: neither figures nor shards are there, the data is of other robots, or no such window.
    """
    out, sets = as_path(out), list(map(ShardSet, data))
    checkpoint = Checkpoint.open(out, [one.embodiment.id for one in sets])
    sets = sets or checkpoint.shards()
    shards = next((one for one in sets if one.embodiment.id in checkpoint.embodiments), None)
    if not checkpoint.config.predicts_video:
        sets, shards = [], None
    kept = Figures()
    for line in read_metrics(out):
        kept.add(line)
    figures = kept.points()
    if data and shards is None:
        names = ", ".join(checkpoint.embodiments)
        raise UsageError(data[0], f"has a robot that is not in the checkpoint, which has: {names}")
    if shards is None and not figures:
        raise UsageError(out, "has no metrics.jsonl and none of its shards are here", "name a shard set too")
    if shards is None:
        view = View(out.absolute().name, np.zeros(0))
    else:
        view = _rolled(out, checkpoint, shards, window)
    for entity, points in figures.items():
        view.steps(entity, points[:, 0].astype(int).tolist(), points[:, 1].tolist())
    return view


def _rolled(out: Path, checkpoint: Checkpoint, shards: ShardSet, window: int) -> View:
    """Return a view of one window: the truth, the prediction, and that with other actions."""
    robot, frames = shards.embodiment, checkpoint.config.frames
    model = checkpoints.load(checkpoint, [robot.id]).eval()
    windows = WindowDataset(shards, "val", frames, cameras=cameras_for(model, shards))
    if window >= len(windows):
        fault = f"{shards.folder} has {len(windows)} held-out windows of {frames} frames, the first is 0"
        raise UsageError("--episode", fault)
    batch, tokenizer = windows.batch([window]), tokenizer_of(shards)
    true = rollout(model, tokenizer, batch)
    other = rollout(model, tokenizer, shuffled(batch, true.prompt - 1), truth=true.truth)
    view = View(f"{out.absolute().name} {robot.id}", np.arange(frames) / robot.effective_hz)
    films = {"truth": true.truth, "predicted": true.predicted, "actions_reversed": other.predicted}
    for name, film in films.items():
        view.pictures(f"cameras/{name}", [film[0]])
    view.curves("actions", batch.actions[0, :, : robot.action_dim].numpy(), robot.action.names())
    view.text(
        f"{out}: {robot.id}, held-out window {window} of {len(windows)}. The first {true.prompt} of {frames} "
        "frames are given; `actions_reversed` is predicted with the window's actions in reverse."
    )
    return view
