"""The MuJoCo Push-T set of Interactive World Simulator: download, train, score.

    python -m recipes.public.iws build/iws --episodes 1000        # from the repository's folder

Published are HDF5 files, one an episode, in train/ and val/; they are read as they are. An episode has about
15 MB; with --episodes only so many of train are downloaded.

Scored as its validation does (github.com/WangYixuan12/interactive_world_sim): the first 200 frames of every
fourth episode of val. The first frame is given, and counts.
"""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

from hma_data.console import run_script
from hma_data.errors import SourceError
from recipes.public.rollouts import Images
from recipes.public.sets import (
    Chosen,
    Figures,
    Protocol,
    PublicSet,
    gaussian_ssim,
    hub_files,
    run,
    squared_error,
)

REPOSITORY = "yixuan1999/interactive-world-sim-mujoco-data"
EVERY = 4  # episode of val is scored
SPAN = 2.0  # of values from 0 to 1, as their metrics count: the images of their models go from -1 to 1


def download(folder: Path, given: argparse.Namespace) -> None:
    wanted = range(given.episodes) if given.episodes else None
    train = [f"train/episode_{number}.hdf5" for number in wanted] if wanted else ["train/episode_*.hdf5"]
    hub_files(REPOSITORY, [*train, "val/episode_*.hdf5"], folder)


def prepare(source: Path, out: Path) -> tuple[Path, Path]:
    """Return train and val.

    Raises:
        SourceError: one is not there.
    """
    for part in ("train", "val"):
        if not any((source / part).glob("episode_*.hdf5")):
            raise SourceError(source / part, "holds no episode_N.hdf5", f"give the folder of {REPOSITORY}")
    return source / "train", source / "val"


def choose(lengths: Sequence[int], stride: int) -> Chosen:
    fit = [number for number in range(0, len(lengths), EVERY) if lengths[number] >= PROTOCOL.frames * stride]
    return [(number, 0) for number in fit]


def figures(true: Images, made: Images) -> Figures:
    """Return the squared error of values from 0 to 1, and the SSIM (11×11, Gaussian) as they count it."""
    return {
        "mse": squared_error(true, made),
        "ssim": float(gaussian_ssim(true, made, SPAN * 255).mean()),
        "ssim_usual": float(gaussian_ssim(true, made).mean()),
    }


def finish(means: Figures) -> Figures:
    """Add the PSNR of the mean squared error over all frames, as they count it, and as is usual."""
    mse = max(means["mse"], 1e-10)
    return means | {
        "psnr_db": 10 * math.log10(SPAN**2 / mse),
        "psnr_usual_db": 10 * math.log10(1 / mse),
    }


PROTOCOL = Protocol(
    frames=200,
    context=1,
    size=128,
    choose=choose,
    figures=figures,
    finish=finish,
    scored_from=0,
    notes=(
        "psnr_db and ssim as they count: a span of 2 for values from 0 to 1, 6.02 dB more than usual.",
        "Their figures: their validation prints them, arXiv 2603.08546 has them.",
        "UIQI, FID and FVD are not computed here.",
    ),
)
SET = PublicSet("iws_pusht", download, prepare, PROTOCOL)

if __name__ == "__main__":
    run_script(lambda: run(SET))
