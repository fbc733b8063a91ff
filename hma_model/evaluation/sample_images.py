"""Draw a picture of each robot: truth, prediction, and prediction with other actions."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hma_data.errors import HMAError
from hma_data.shards.reader import ShardSet
from hma_data.storage.files import write_atomic

if TYPE_CHECKING:
    from hma_data.tokenizers.base import Tokenizer
    from hma_model.network.model import HMA

FOLDER = "pictures"
COLUMNS = 8


def sample_pictures(
    model: "HMA", sets: Mapping[str, ShardSet], out: Path, step: int, *, frames: int, count: int, seed: int
) -> str:
    """Write `pictures/step-N-ID.png` for each robot.

    Args:
        model: the evaluated model.
        sets: shard sets with validation windows.
        out: the run's folder.
        step: number of finished steps.
        frames: of a window.
        count: windows of each robot.
        seed: of the rollouts.

    Returns:
        The reason for no pictures if the tokenizer is not available here; else an empty string.
    """
    from hma_data.shards.preview import tokenizer_of

    if not sets:
        return ""
    try:
        tokenizer = tokenizer_of(next(iter(sets.values())))
    except HMAError as fault:
        return f"no pictures: {fault}"
    training = model.training
    model.eval()
    for name, shards in sets.items():
        picture = _picture(model, tokenizer, shards, frames, count, seed)
        (out / FOLDER).mkdir(exist_ok=True)
        write_atomic(out / FOLDER / f"step-{step:08d}-{name}.png", picture)
    model.train(training)
    return ""


def newest_pictures(out: Path, names: Iterable[str]) -> dict[str, bytes]:
    """Return the last picture (PNG) of each robot that has one."""
    found = {}
    for name in names:
        paths = sorted((out / FOLDER).glob(f"step-????????-{name}.png"))
        if paths:
            found[name] = paths[-1].read_bytes()
    return found


def _picture(
    model: "HMA", tokenizer: "Tokenizer", shards: ShardSet, frames: int, count: int, seed: int
) -> bytes:
    from hma_data.episodes.sheets import grid, png_bytes
    from hma_model.evaluation.evaluate import rollout, shuffled_actions, windows

    rows, labels = [], []
    (batch,) = windows(shards, "val", frames, count, count)
    true = rollout(model, tokenizer, batch, seed=seed)
    swapped = shuffled_actions(batch, true.prompt - 1, seed)
    other = rollout(model, tokenizer, batch, actions=swapped, seed=seed, truth=true.truth)
    picks = np.unique(np.linspace(0, frames - 1, COLUMNS).astype(int))
    for i in range(len(true.truth)):
        for label, shown in (
            ("truth", true.truth[i]),
            (f"predicted from frame {true.prompt}", true.predicted[i]),
            ("with other actions", other.predicted[i]),
        ):
            rows.append(list(shown[picks]))
            labels.append(label)
    return png_bytes(grid(rows, labels))
