"""Make the picture and the film of a model card: the truth, a short rollout, and one with other actions."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hma_data.errors import CheckpointError, UsageError
from hma_data.storage.files import write_atomic
from hma_data.storage.paths import StrPath
from hma_data.storage.remote import RemotePath
from hma_model.checkpoint import io as checkpoints
from hma_model.checkpoint.folder import EMBEDDED, FILM, SAMPLE, Checkpoint, require_tokenizer

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hma_data.loading.dataset import WindowDataset
    from hma_data.loading.views import Cameras
    from hma_data.shards.reader import ShardSet

COLUMNS, SIDE = 6, 128  # pictures in a row, and pixels of a side


def add_samples(checkpoint: StrPath | Checkpoint, data: Iterable[StrPath]) -> list[Path]:
    """Write sample.png and sample.gif for the embodiment of each shard set, and update the model card.

    Args:
        checkpoint: an open one, or str or path of its folder, or of the folder of a training run.
        data: str or path of shard sets, one an embodiment.

    Returns:
        The paths of the pictures and films.

    Raises:
        CheckpointError: the checkpoint lacks the embodiment, or was trained on another tokenizer.
        UsageError: a shard set has no window long enough.
    """
    from hma_data.shards.reader import ShardSet

    source, made = Checkpoint.open(checkpoint), []
    if source.folder == EMBEDDED:
        remedy = "copy the folder and name the copy, or finetune it"
        raise CheckpointError(source.folder, "comes along with the package, which stays as it is", remedy)
    for folder in data:
        shards = ShardSet(folder)
        name = shards.embodiment.id
        if name not in source.embodiments:
            known = ", ".join(source.embodiments) or "none"
            raise CheckpointError(source.folder, f"has no embodiment {name!r}", f"it has: {known}")
        home = source.folder / "embodiments" / name
        for part, content in zip((SAMPLE, FILM), _shown(source, shards)):
            write_atomic(home / part, content)
            made.append(home / part)
    checkpoints.write_readme(source)
    return made


def at_hand(checkpoint: Checkpoint, embodiments: Iterable[str] | None = None) -> list[RemotePath | Path]:
    """Return the shard sets of a run that are still here, of the robots that have no film yet.

    Args:
        embodiments: ids; None for all.
    """
    lacking = {name for name in checkpoint.chosen(embodiments) if FILM not in checkpoint.pictures(name)}
    sets = checkpoint.shards() if checkpoint.config.predicts_video else []
    return [shards.folder for shards in sets if shards.embodiment.id in lacking]


def _shown(checkpoint: Checkpoint, shards: "ShardSet") -> tuple[bytes, bytes]:
    """Return a PNG of truth and predictions over a window, and a GIF of both with the commands."""
    from hma_data.episodes.sheets import gif_bytes, grid, png_bytes
    from hma_data.shards.preview import tokenizer_of
    from hma_model.evaluation.rollout_video import rollout_video
    from hma_model.evaluation.rollouts import rollout
    from hma_model.generation.decode import cameras_for

    model = checkpoints.load(checkpoint, [shards.embodiment.id])
    require_tokenizer(model.config, shards.spec, shards.folder)
    split, windows = _windows(shards, model.config.frames, cameras_for(model, shards))
    middle, tokenizer = len(windows) // 2, tokenizer_of(shards)
    batch = windows.batch([middle])
    true = rollout(model, tokenizer, batch)
    backwards = replace(batch, actions=batch.actions.flip(1), action_mask=batch.action_mask.flip(1))
    other = rollout(model, tokenizer, backwards, truth=true.truth)
    picks = np.unique(np.linspace(0, true.truth.shape[1] - 1, COLUMNS).astype(int))
    rows = {
        "truth": true.truth[0],
        f"predicted from frame {true.prompt} on": true.predicted[0],
        "with the actions in reverse": other.predicted[0],
    }
    shown = [[_sized(frame) for frame in frames[picks]] for frames in rows.values()]
    film = rollout_video(model, tokenizer, shards, split=split, window=middle, prompt=true.prompt)
    return png_bytes(grid(shown, list(rows))), gif_bytes(film.frames, film.fps)


def _windows(shards: "ShardSet", frames: int, cameras: "Cameras") -> "tuple[str, WindowDataset]":
    """Return the windows of the validation split, or of training if that has none."""
    from hma_data.loading.dataset import WindowDataset

    for split in ("val", "train"):
        windows = WindowDataset(shards, split, frames, cameras=cameras)
        if len(windows):
            return split, windows
    raise UsageError(shards.folder, f"has no window of {frames} frames", "give shards with longer episodes")


def _sized(frame: "NDArray[np.uint8]") -> "NDArray[np.uint8]":
    """Return a frame near the size of the card: a small one enlarged, a large one subsampled."""
    side = frame.shape[0]
    if side < SIDE:
        scale = -(-SIDE // side)
        return frame.repeat(scale, 0).repeat(scale, 1)
    return frame[:: side // SIDE, :: side // SIDE]
