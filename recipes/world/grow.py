"""Give a checkpoint more layers without changing what it computes, so that it may be trained on.

    python recipes/world/grow.py CHECKPOINT LAYERS OUT

Each new layer is a copy of the one before it whose branches add nothing yet: the maps that end them are zero.
So it begins with the features of a trained layer, and the network's answers stay what they were.
"""

import argparse
from pathlib import Path

import torch
from save_like import save_like
from torch import Tensor

from hma_data.console import run_script
from hma_model.checkpoint import io
from hma_model.checkpoint.folder import Checkpoint
from hma_model.hub.publish import located
from hma_model.network.model import HMA

ENDS = ("space.proj", "time.proj", "mlp.fc2", "modulation_out", "action.proj")  # of a block's branches


def main() -> None:
    """Write the checkpoint with more layers."""
    parser = argparse.ArgumentParser(description="Give a checkpoint more layers")
    parser.add_argument("checkpoint")
    parser.add_argument("layers", type=int)
    parser.add_argument("out", type=Path)
    given = parser.parse_args()
    stored = Checkpoint.open(located(given.checkpoint)[0])
    config = stored.config
    if not config.layers < given.layers <= 2 * config.layers:
        most = 2 * config.layers
        parser.error(f"{given.checkpoint} has {config.layers} layers: take {config.layers + 1} to {most}")
    shared = config.shared_modulation and config.modulation_out == "trunk"
    apart = "modulation" in config.conditioning and not shared
    if apart or ("add" in config.conditioning and config.add_at == "layers"):
        parser.error(f"{given.checkpoint} has parts of its layers outside of the trunk")
    small = io.load(stored.folder)
    large = HMA(config.replace(layers=given.layers))
    large.load_trunk(grown(small.trunk_state(), config.layers, given.layers), stored.trunk())
    for name in stored.embodiments:
        io.add_embodiment(large, stored, name)
    save_like(large, given.out, stored)


def sources(before: int, after: int) -> list[tuple[int, bool]]:
    """Return, for each layer of the grown trunk, the old layer that it comes from and whether it is new.

    >>> sources(4, 6)
    [(0, False), (1, False), (1, True), (2, False), (3, False), (3, True)]
    """
    more = after - before
    copied = {before * number // more - 1 for number in range(1, more + 1)}
    return [(layer, new) for layer in range(before) for new in (False, True) if not new or layer in copied]


def grown(state: dict[str, Tensor], before: int, after: int) -> dict[str, Tensor]:
    """Return a trunk's tensors with copied layers."""
    chosen = sources(before, after)
    made = {name: value for name, value in state.items() if not name.startswith("trunk.blocks.")}
    for name, value in made.items():
        if name.startswith("trunk.modulation."):  # one row a layer
            made[name] = value[[layer for layer, _ in chosen]]
    for place, (layer, new) in enumerate(chosen):
        before_it = f"trunk.blocks.{layer}."
        for name, value in state.items():
            if name.startswith(before_it):
                part = name.removeprefix(before_it)
                silent = new and part.rpartition(".")[0] in ENDS
                made[f"trunk.blocks.{place}.{part}"] = torch.zeros_like(value) if silent else value.clone()
    return made


if __name__ == "__main__":
    run_script(main)
