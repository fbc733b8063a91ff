"""Store a checkpoint in half the bytes: weights in float16, statistics and pictures as they are.

python recipes/world/half.py CHECKPOINT OUT
"""

import argparse
import shutil
from pathlib import Path

from save_like import save_like

from hma_data.console import run_script
from hma_model.checkpoint import io
from hma_model.checkpoint.folder import SHOWN, Checkpoint
from hma_model.hub.publish import located


def main() -> None:
    """Write the checkpoint anew."""
    parser = argparse.ArgumentParser(description="Store a checkpoint in float16")
    parser.add_argument("checkpoint")
    parser.add_argument("out", type=Path)
    given = parser.parse_args()
    stored = Checkpoint.open(located(given.checkpoint)[0])
    made = save_like(io.load(stored.folder), given.out, stored, half=True)
    for name in stored.embodiments:
        for part in SHOWN:
            shown = stored.folder / "embodiments" / name / part
            if shown.is_file():
                shutil.copyfile(shown, made.folder / "embodiments" / name / part)
    io.write_readme(made.folder)


if __name__ == "__main__":
    run_script(main)
