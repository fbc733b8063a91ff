"""A recipe small enough for tests, runs that are killed, and a comparison of what runs leave."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from hma_model.training.loop import train
from hma_model.training.recipe import Recipe

TINY = {
    "frames": 4, "batch_size": 4, "model": {"layers": 1, "width": 16, "heads": 2}, "device": "cpu",
    "steps": 6, "lr": 3e-3, "warmup": 2, "schedule": "cosine", "eval_every": 3, "eval_windows": 6,
    "checkpoint_every": 2, "report": False, "pictures": 0, "track": [],
    "precision": "fp32",
}  # fmt: skip


def kill_at(step: int) -> Callable[[dict[str, Any]], None]:
    def kill(facts: dict[str, Any]) -> None:
        if facts["step"] == step:
            raise KeyboardInterrupt

    return kill


def train_until(recipe: Recipe, out: Path, step: int) -> None:
    with pytest.raises(KeyboardInterrupt):
        train(recipe, out=out, show=False, on_progress=kill_at(step))


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return {
        f"{path.relative_to(folder)}:{name}": value
        for path in sorted(folder.rglob("*.safetensors"))
        for name, value in load_file(path).items()
    }


def same(one: Path, other: Path) -> bool:
    a, b = weights(one), weights(other)
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)
