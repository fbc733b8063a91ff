"""Draw one picture of a folder's frames: the originals, then one row of decoded frames for each tokenizer.

python recipes/tokenizer/contact_sheet.py FOLDER docs/tokenizers.jpg [--columns 6] [--tokenizer fsq-16 …]
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from hma_data.console import run_script
from hma_data.episodes.images import resize
from hma_data.episodes.sheets import grid
from hma_data.tokenizers.base import get_tokenizer
from hma_data.tokenizers.training.eval import psnr_db
from hma_data.tokenizers.training.frames import read_films

SIDE = 256


def main() -> None:
    """Read, encode, decode and draw the frames."""
    parser = argparse.ArgumentParser(description="Draw what tokenizers make of some frames")
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--columns", type=int, default=6)
    parser.add_argument("--tokenizer", action="append")
    arguments = parser.parse_args()
    frames = np.concatenate(list(read_films(arguments.folder, SIDE)))
    shown = np.linspace(0, len(frames) - 1, arguments.columns).astype(int)
    rows, labels = [list(frames[shown])], ["original, 256 x 256"]
    for name in arguments.tokenizer or ["fsq-16", "vae-8", "fsq-8"]:
        tokenizer = get_tokenizer(name)
        spec = tokenizer.spec
        true = frames if spec.image_size == SIDE else resize(frames, spec.image_size)
        made = tokenizer.decode(tokenizer.encode(true))
        enlarged = [cv2.resize(picture, (SIDE, SIDE), interpolation=cv2.INTER_NEAREST) for picture in made]
        rows.append([np.asarray(enlarged[index], np.uint8) for index in shown])
        cells = "x".join(map(str, spec.grid)) + (" tokens" if spec.kind == "discrete" else " latents")
        size, level = f"{spec.image_size} x {spec.image_size}", psnr_db(true, made).mean()
        labels.append(f"{name}: {cells}, {size}, {level:.1f} dB over {len(made)}")
    sheet = grid(rows, labels)
    cv2.imwrite(str(arguments.out), sheet[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 82])


if __name__ == "__main__":
    run_script(main)
