"""Make the sample picture of a model card: the truth, a short rollout, and one with other actions."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hma_data.errors import CheckpointError, UsageError
from hma_data.storage.files import write_atomic
from hma_data.storage.paths import StrPath
from hma_model.checkpoint import io as checkpoints
from hma_model.checkpoint.folder import SAMPLE, Checkpoint, require_tokenizer

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hma_data.loading.dataset import Batch
    from hma_data.loading.views import Cameras
    from hma_data.shards.reader import ShardSet

COLUMNS, SIDE = 6, 128  # pictures in a row, and pixels of a side


def add_samples(checkpoint: StrPath, data: Iterable[StrPath]) -> list[Path]:
    """Write a sample.png for the embodiment of each shard set, and update the model card.

    Args:
        checkpoint: str or path of its folder, or of the folder of a training run.
        data: str or path of shard sets, one an embodiment.

    Returns:
        The paths of the pictures.

    Raises:
        CheckpointError: the checkpoint lacks the embodiment, or was trained on another tokenizer.
        UsageError: a shard set has no window long enough.
    """
    from hma_data.shards.reader import ShardSet

    source, made = Checkpoint.open(checkpoint), []
    for folder in data:
        shards = ShardSet(folder)
        name = shards.embodiment.id
        if name not in source.embodiments:
            known = ", ".join(source.embodiments) or "none"
            raise CheckpointError(source.folder, f"has no embodiment {name!r}", f"it has: {known}")
        path = source.folder / "embodiments" / name / SAMPLE
        write_atomic(path, _picture(source.folder, shards))
        made.append(path)
    checkpoints.write_readme(source.folder)
    return made


def _picture(checkpoint: Path, shards: "ShardSet") -> bytes:
    """Return a PNG of one window: truth, prediction, and prediction with other actions, over time."""
    from hma_data.episodes.sheets import grid, png_bytes
    from hma_data.shards.preview import tokenizer_of
    from hma_model.evaluation.evaluate import cameras_for, rollout

    model = checkpoints.load(checkpoint, [shards.embodiment.id])
    require_tokenizer(model.config, shards.spec, shards.folder)
    batch = _window(shards, model.config.frames, cameras_for(model, shards))
    tokenizer = tokenizer_of(shards)
    true = rollout(model, tokenizer, batch)
    backwards = replace(batch, actions=batch.actions.flip(1), action_mask=batch.action_mask.flip(1))
    other = rollout(model, tokenizer, backwards, truth=true.truth)
    picks = np.unique(np.linspace(0, true.truth.shape[1] - 1, COLUMNS).astype(int))
    rows = {
        "truth": true.truth[0],
        f"predicted from frame {true.prompt} on": true.predicted[0],
        "with the actions in reverse": other.predicted[0],
    }
    shown = [[_shown(frame) for frame in frames[picks]] for frames in rows.values()]
    return png_bytes(grid(shown, list(rows)))


def _window(shards: "ShardSet", frames: int, cameras: "Cameras") -> "Batch":
    """Return the middle window of the validation split, or of training if that has none."""
    from hma_data.loading.dataset import WindowDataset

    for split in ("val", "train"):
        windows = WindowDataset(shards, split, frames, cameras=cameras)
        if len(windows):
            return windows.batch([len(windows) // 2])
    raise UsageError(shards.folder, f"has no window of {frames} frames", "give shards with longer episodes")


def _shown(frame: "NDArray[np.uint8]") -> "NDArray[np.uint8]":
    """Return a frame near the size of the card: a small one enlarged, a large one subsampled."""
    side = frame.shape[0]
    if side < SIDE:
        scale = -(-SIDE // side)
        return frame.repeat(scale, 0).repeat(scale, 1)
    return frame[:: side // SIDE, :: side // SIDE]
