"""The checkpoint that comes along with the package, or one of its kind that knows nothing."""

from pathlib import Path

import pytest

from hma_data.lab.family import embodiment
from hma_data.tokenizers.base import get_tokenizer
from hma_model.checkpoint import folder, io
from hma_model.checkpoint.folder import CONFIG
from hma_model.config import ActionSpace, HMAConfig
from hma_model.network.model import HMA


def use(made: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make `embedded` the name of the checkpoint in a folder."""
    for module in (folder,):
        monkeypatch.setattr(module, "EMBEDDED", made)
    return made


def embedded(scratch: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder that `embedded` names; it is made in `scratch` if the package has none."""
    if (folder.EMBEDDED / CONFIG).is_file():
        return folder.EMBEDDED
    own = embodiment("arm2_02")
    config = HMAConfig(
        layers=1, width=32, heads=2, frames=4, grid=(8, 8), factored=(8,) * 6, training_pass="pairs",
        shared_modulation=True, tokenizer=get_tokenizer("fsq-8").spec.to_json(),
    )  # fmt: skip
    model = HMA(config)
    stats = {"action": {"mean": [0.0] * own.action_dim, "std": [1.0] * own.action_dim}}
    model.add_embodiment(ActionSpace.of(own, folder.action_stats(stats, own.id)))
    io.save(model, scratch, embodiment_yaml={own.id: own.to_yaml()}, stats={own.id: stats}, cards={})
    return use(scratch, monkeypatch)
