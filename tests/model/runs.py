"""A recipe small enough for tests, and a comparison of what runs leave."""

from pathlib import Path

import torch
from safetensors.torch import load_file

TINY = {
    "frames": 4, "batch_size": 4, "model": {"layers": 1, "width": 16, "heads": 2}, "device": "cpu",
    "steps": 6, "lr": 3e-3, "warmup": 2, "schedule": "cosine", "eval_every": 3, "eval_windows": 6,
    "checkpoint_every": 2, "report": False, "pictures": 0, "track": [],
}  # fmt: skip


def weights(folder: Path) -> dict[str, torch.Tensor]:
    """Every tensor of a checkpoint, by file and name."""
    return {
        f"{path.relative_to(folder)}:{name}": value
        for path in sorted(folder.rglob("*.safetensors"))
        for name, value in load_file(path).items()
    }


def same(one: Path, other: Path) -> bool:
    """Check whether two checkpoints have the same tensors, bit for bit."""
    a, b = weights(one), weights(other)
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)
