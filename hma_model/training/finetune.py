"""Train a new stem and head for a robot on a trained trunk, which is frozen or tuned too.

    result = finetune("runs/base", ["shards/my_arm"], out="runs/my_arm", freeze_trunk=True)

With a frozen trunk the result can be pushed to the hub that the trunk came from, beside its other robots.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import yaml

from hma_data.errors import UsageError
from hma_data.storage.paths import StrPath, as_text
from hma_model.training.recipe import load_recipe

if TYPE_CHECKING:
    from hma_model.training.loop import TrainResult

RECIPE = "finetune"


def finetune(
    source: StrPath,
    data: Sequence[StrPath],
    *,
    out: StrPath | None = None,
    freeze_trunk: bool = False,
    overrides: Sequence[str] = (),
    recipe: StrPath = RECIPE,
    **options: Any,
) -> "TrainResult":
    """Train on a checkpoint's trunk; run it again to resume.

    Args:
        source: str or path of a checkpoint or a run's folder, a URI, or a hub repository, also
            `org/name@revision`.
        data: str or path of folders of shards, made with the checkpoint's tokenizer.
        out: str or path of the run's folder; by default the one that the overrides name.
        freeze_trunk: train only the stems and heads.
        overrides: `key=value` strings that override the recipe.
        recipe: name, or str or path of a YAML.
        options: `show`, `force`, `on_progress` of `hma_model.training.loop.train`.

    Raises:
        UsageError: no shards, or no folder for the run.
        CheckpointError: the shards are of another tokenizer, or state other actions for the robot.
        HubError: there is no such checkpoint.
    """
    from hma_model.training.loop import train

    if not data:
        raise UsageError("--data", "names no shards", "give the folder of hma convert")
    given = {
        "start": as_text(source),
        "data": [as_text(folder) for folder in data],
        "freeze": "trunk" if freeze_trunk else "nothing",
    }
    ours = [f"{key}={yaml.safe_dump(value, default_flow_style=True)}" for key, value in given.items()]
    return train(load_recipe(recipe, [*ours, *overrides]), out=out, **options)
