"""Small embodiments, models and checkpoints for the tests of this folder."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hma_data.registry.embodiment import Embodiment
from hma_data.tokenizers.base import TokenizerSpec
from hma_model.checkpoint import io as checkpoint
from hma_model.config import HMAConfig
from hma_model.network.model import HMA

SPEC = TokenizerSpec(
    name="raw", version=1, kind="discrete", image_size=16, grid=(2, 3), vocab_size=64, factored=(8, 8)
)
CONFIG = HMAConfig(
    layers=1, width=16, heads=2, frames=4, grid=(2, 3), factored=(8, 8), tokenizer=SPEC.to_json()
)


class Blocks:
    spec = SPEC

    def decode(self, tokens: np.ndarray) -> np.ndarray:
        rows = np.repeat(tokens, 8, axis=1)
        cells = np.repeat(rows, 6, axis=2)[:, :, :16]
        return np.repeat((cells * 4).astype(np.uint8)[..., None], 3, axis=3)


def yaml(name: str, dims: int = 2, stride: int = 2, space: str = "joint_position") -> str:
    return f"""
id: {name}
robot: an arm
kind: simulation
frequency_hz: 10
stride: {stride}
action:
  space: {space}
  components: [{{key: actions, dims: {dims}}}]
cameras: [{{name: top, key: obs/image}}]
source: {{format: hdf5}}
license: apache-2.0
"""


def stats(dims: int = 2) -> dict[str, Any]:
    return {"action": {"mean": [0.25] * dims, "std": [2.0 + i for i in range(dims)], "count": 7}}


def make_model(names: dict[str, int], seed: int = 0, config: HMAConfig = CONFIG) -> HMA:
    torch.manual_seed(seed)
    model = HMA(config)
    for name, dims in names.items():
        values = checkpoint.action_stats(stats(dims), name)
        model.add_embodiment(Embodiment.from_yaml(yaml(name, dims)), values)
    return model.eval()


def save(folder: Path, names: dict[str, int], seed: int = 0, **given: Any) -> HMA:
    model = given.pop("model", None) or make_model(names, seed)
    checkpoint.save(
        model,
        folder,
        embodiment_yaml={name: yaml(name, dims) for name, dims in names.items()},
        stats={name: stats(dims) for name, dims in names.items()},
        cards={name: {"data": {"windows": 12}, "metrics": {"val_loss": 1.5}} for name in names},
        **given,
    )
    return model


def edit_card(folder: Path, name: str, **facts: Any) -> None:
    path = folder / "embodiments" / name / "card.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | facts))
    checkpoint.write_readme(folder)
