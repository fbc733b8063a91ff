"""Make the image and the film of a model card: recorded frames beside a short rollout."""

from collections.abc import Iterable
from pathlib import Path

from hma_data.episodes.sheets import cell_scale, gif_bytes, grid, png_bytes
from hma_data.errors import CheckpointError, UsageError
from hma_data.loading.dataset import WindowDataset
from hma_data.shards.preview import tokenizer_of
from hma_data.shards.reader import ShardSet
from hma_data.storage.files import write_atomic
from hma_data.storage.paths import StrPath
from hma_data.storage.remote import RemotePath
from hma_model.arrays import evenly
from hma_model.checkpoint import io as checkpoints
from hma_model.checkpoint.folder import FILM, SAMPLE, Checkpoint, require_tokenizer
from hma_model.evaluation.rollout_video import rollout_video
from hma_model.evaluation.rollouts import rollout
from hma_model.generation.decode import cameras_for

COLUMNS = 6  # frames in a row of the image


def add_samples(checkpoint: StrPath | Checkpoint, data: Iterable[StrPath]) -> list[Path]:
    """Write sample.png and sample.gif for the embodiment of each shard set, and update the model card.

    Args:
        checkpoint: an open one, or str or path of its folder, or of the folder of a training run.
        data: str or path of shard sets, one an embodiment.

    Returns:
        The paths of the images and films.
    """
    source, made = Checkpoint.open(checkpoint), []
    if source.bundled:
        remedy = "copy the folder and name the copy, or finetune it"
        raise CheckpointError(source.folder, "is part of the installed package, which is not changed", remedy)
    for folder in data:
        shards = ShardSet(folder)
        name = shards.embodiment.id
        source.chosen([name])  # raises if it is not there
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


def _shown(checkpoint: Checkpoint, shards: ShardSet) -> tuple[bytes, bytes]:
    """Return a PNG of recorded and predicted frames, and a GIF of both with their actions."""
    model = checkpoints.load(checkpoint, [shards.embodiment.id])
    require_tokenizer(model.config, shards.spec, shards.folder)
    cameras, length = cameras_for(model, shards), model.config.frames
    found = {split: WindowDataset(shards, split, length, cameras=cameras) for split in ("val", "train")}
    split = next((split for split, windows in found.items() if len(windows)), None)
    if split is None:
        fault = f"has no window of {length} frames"
        raise UsageError(shards.folder, fault, "give shards with longer episodes")
    windows = found[split]
    middle, tokenizer = len(windows) // 2, tokenizer_of(shards)
    true = rollout(model, tokenizer, windows.batch([middle]))
    picks = evenly(true.truth.shape[1], COLUMNS)
    rows = {
        "recorded, decoded from tokens": true.truth[0],
        f"predicted from frame {true.prompt} on": true.predicted[0],
    }
    scale, every = cell_scale(true.truth.shape[2])
    shown = [
        list(frames[picks].repeat(scale, 1).repeat(scale, 2)[:, ::every, ::every]) for frames in rows.values()
    ]
    film = rollout_video(model, tokenizer, shards, split=split, window=middle, prompt=true.prompt)
    return png_bytes(grid(shown, list(rows))), gif_bytes(film.frames, film.fps)
