"""Store a checkpoint in half the bytes: weights in float16, statistics as they are.

python recipes/world/half.py CHECKPOINT OUT
"""

import argparse
from pathlib import Path

from hma_data.console import run_script
from hma_model.checkpoint import io
from hma_model.checkpoint.folder import Checkpoint
from hma_model.network.model import HMA


def main() -> None:
    """Write the checkpoint anew."""
    parser = argparse.ArgumentParser(description="Store a checkpoint in float16")
    parser.add_argument("checkpoint")
    parser.add_argument("out", type=Path)
    given = parser.parse_args()
    model, stored = HMA.from_pretrained(given.checkpoint), Checkpoint.open(given.checkpoint)
    io.save_like(model, given.out, stored, half=True)


if __name__ == "__main__":
    run_script(main)
