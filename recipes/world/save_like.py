"""Write a changed model with the descriptions of the checkpoint that it came from."""

from collections.abc import Mapping
from typing import Any

from hma_data.storage.paths import StrPath
from hma_model.checkpoint import io
from hma_model.checkpoint.folder import Checkpoint
from hma_model.network.model import HMA


def save_like(
    model: HMA,
    folder: StrPath,
    like: Checkpoint,
    cards: Mapping[str, dict[str, Any]] | None = None,
    half: bool = False,
) -> Checkpoint:
    """Write a model with the YAML, statistics and cards of a checkpoint of the same embodiments.

    Args:
        model: has exactly the embodiments of `like`.
        folder: as of `io.save`.
        like: the checkpoint.
        cards: other cards than its own.
        half: as of `io.save`.

    Raises:
        CheckpointError: as `io.save`.
    """
    robots = like.embodiments
    return io.save(
        model,
        folder,
        embodiment_yaml={name: like.embodiment(name).to_yaml() for name in robots},
        stats={name: like.stats(name) for name in robots},
        cards=cards or {name: like.card(name) for name in robots},
        half=half,
    )
