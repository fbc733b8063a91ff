"""What the model predicts, as a picture a robot: truth, prediction, and prediction with other actions."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hma_data.errors import HMAError
from hma_data.files import write_atomic
from hma_data.shards.reader import ShardSet

if TYPE_CHECKING:
    from hma_data.tokenizers.base import Tokenizer
    from hma_model.model import HMA
    from hma_model.recipe import Recipe

FOLDER = "pictures"
COLUMNS = 8


def sample_pictures(
    model: "HMA", sets: Mapping[str, ShardSet], out: Path, step: int, recipe: "Recipe"
) -> str:
    """Write `pictures/step-N-ID.png` for each robot.

    Args:
        model: as it is evaluated.
        sets: shard sets with validation windows.
        out: the run's folder.
        step: steps done.
        recipe: says how many windows.

    Returns:
        Why there are none, where the tokenizer cannot be had here; nothing otherwise.
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
        picture = _picture(model, tokenizer, shards, recipe)
        (out / FOLDER).mkdir(exist_ok=True)
        write_atomic(out / FOLDER / f"step-{step:08d}-{name}.png", picture)
    model.train(training)
    return ""


def newest_pictures(out: Path, names: Iterable[str]) -> dict[str, bytes]:
    """The last picture of each robot that has one, PNG."""
    found = {}
    for name in names:
        paths = sorted((out / FOLDER).glob(f"step-????????-{name}.png"))
        if paths:
            found[name] = paths[-1].read_bytes()
    return found


def _picture(model: "HMA", tokenizer: "Tokenizer", shards: ShardSet, recipe: "Recipe") -> bytes:
    from hma_data.sheets import grid, png_bytes
    from hma_model.evaluate import rollout, shuffled_actions, windows

    rows, labels = [], []
    (batch,) = windows(shards, "val", recipe.frames, recipe.pictures, recipe.pictures)
    true = rollout(model, tokenizer, batch, seed=recipe.seed)
    swapped = shuffled_actions(batch, true.prompt - 1, recipe.seed)
    other = rollout(model, tokenizer, batch, actions=swapped, seed=recipe.seed, truth=true.truth)
    picks = np.unique(np.linspace(0, recipe.frames - 1, COLUMNS).astype(int))
    for i in range(len(true.truth)):
        for label, frames in (
            ("truth", true.truth[i]),
            (f"predicted from frame {true.prompt}", true.predicted[i]),
            ("with other actions", other.predicted[i]),
        ):
            rows.append(list(frames[picks]))
            labels.append(label)
    return png_bytes(grid(rows, labels))
