"""Give a checkpoint to a tokenizer that was trained on from its own, so that it may be trained on too.

    python recipes/world/carry.py CHECKPOINT TOKENIZER OUT

The weights stay as they are. Only do this where most tokens stay the same; then train on its shards.
"""

import argparse
from pathlib import Path

from save_like import save_like

from hma_data.console import run_script
from hma_data.tokenizers.base import get_tokenizer
from hma_model.checkpoint.folder import Checkpoint
from hma_model.network.model import HMA


def main() -> None:
    """Write the checkpoint anew under the tokenizer's spec."""
    parser = argparse.ArgumentParser(description="Give a checkpoint to a tokenizer that was trained on")
    parser.add_argument("checkpoint")
    parser.add_argument("tokenizer")
    parser.add_argument("out", type=Path)
    given = parser.parse_args()
    model, stored = HMA.from_pretrained(given.checkpoint), Checkpoint.open(given.checkpoint)
    spec = get_tokenizer(given.tokenizer).spec
    if (spec.grid, tuple(spec.factored or ())) != (model.config.grid, model.config.factored):
        parser.error(f"{given.tokenizer} has other tokens than {given.checkpoint}")
    model.config = model.config.replace(tokenizer=spec.to_json())
    save_like(model, given.out, stored)


if __name__ == "__main__":
    run_script(main)
