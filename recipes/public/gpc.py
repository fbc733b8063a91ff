"""The Push-T set of GPC and DriftWorld (han2019/gpc_pushT_data): download, repack, train, score.

    python -m recipes.public.gpc build/gpc        # from the repository's folder

Published are Zarr folders with data/img, data/state, data/action and meta/episode_ends. Each becomes an HDF5
file; as DriftWorld trains on the first 500 episodes of each, later ones are held out.

Scored as DriftWorld's main_eval_metrics.py does (github.com/Susie-Lu/driftworld): the first 1,000 windows of
64 frames in order, which overlap, and which the model was trained on; four frames are given. Further rows are
of windows of episodes that were held out.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from hma_data.console import run_script
from hma_data.errors import SourceError
from hma_data.storage.files import atomic_path
from hma_model.evaluation.metrics import psnr, ssim
from recipes.public.rollouts import Images
from recipes.public.sets import (
    Chosen,
    Figures,
    Protocol,
    PublicSet,
    every_window,
    hub_files,
    run,
    squared_error,
)
from recipes.public.zarr2 import ZarrArray

REPOSITORY, PART = "han2019/gpc_pushT_data", "world_model_data"
TRAINED = 500  # episodes of each folder that DriftWorld trains on
WINDOWS = 1000


def download(folder: Path, given: argparse.Namespace) -> None:
    hub_files(REPOSITORY, [f"{PART}/**"], folder)


def prepare(source: Path, out: Path) -> tuple[Path, Path]:
    """Repack every Zarr folder below `source`; those that are there are kept.

    Numbers before their names keep DriftWorld's order, in which domain10 comes before domain2.

    Raises:
        SourceError: there is none, or one is damaged.
    """
    folders = sorted(path.parent for path in source.rglob("*.zarr/.zgroup"))
    if not folders:
        raise SourceError(source, "holds no folder NAME.zarr", f"give the {PART} of {REPOSITORY}")
    wanted = {out / f"{number:03d}_{folder.stem}.hdf5": folder for number, folder in enumerate(folders)}
    for stale in set(out.glob("*.hdf5")) - set(wanted):  # of a download that was not whole
        stale.unlink()
    for final, folder in wanted.items():
        if not final.is_file():
            with atomic_path(final) as part:
                repack(folder, part)
    return out, out


def repack(folder: Path, path: Path) -> None:
    """Write the episodes of a Zarr folder as data/demo_N of an HDF5 file."""
    series = {key: ZarrArray(folder / "data" / key) for key in ("img", "state", "action")}
    stored = ZarrArray(folder / "meta" / "episode_ends")
    ends = stored.rows(0, len(stored)).astype(np.int64).ravel()
    lengths = {key: len(values) for key, values in series.items()}
    if not len(ends) or (np.diff(ends, prepend=0) <= 0).any() or ends[-1] > min(lengths.values()):
        said = f"has episodes that end at {ends[-3:].tolist()}, and series of {lengths} rows"
        raise SourceError(folder, said, "download the set again")
    with h5py.File(path, "w") as file:
        for number, (start, end) in enumerate(zip([0, *ends[:-1]], ends)):
            demo = file.create_group(f"data/demo_{number}")
            for key in ("state", "action"):
                demo[key] = series[key].rows(int(start), int(end)).astype(np.float32)
            images = as_pixels(series["img"].rows(int(start), int(end)), folder)
            chunk = (1, *images.shape[1:])
            demo.create_dataset("img", data=images, chunks=chunk, compression="gzip", compression_opts=1)
        if len(ends) > TRAINED:
            names = [f"demo_{number}" for number in range(len(ends))]
            file["mask/train"], file["mask/valid"] = names[:TRAINED], names[TRAINED:]


def as_pixels(values: NDArray[Any], folder: Path) -> Images:
    """Return images as uint8; they may be stored as floats of 0 to 255."""
    if values.dtype == np.uint8:
        return values
    if values.min() < 0 or not 1 < values.max() <= 255:
        said = f"has images of {values.min():g} to {values.max():g}, not of 0 to 255"
        raise SourceError(folder / "data" / "img", said, "convert them to uint8")
    return np.rint(values).astype(np.uint8)


def choose(lengths: Sequence[int], stride: int) -> Chosen:
    return every_window(lengths, PROTOCOL.frames * stride)[:WINDOWS]


def figures(true: Images, made: Images) -> Figures:
    """Return their figures: the squared error is of values from -1 to 1, PSNR and SSIM (7×7) of 8 bits."""
    return {
        "mse": 4 * squared_error(true, made),
        "psnr_db": float(psnr(true, made, 100.0).mean()),
        "ssim": float(ssim(true, made).mean()),
    }


PROTOCOL = Protocol(
    frames=64,
    context=4,
    size=96,
    choose=choose,
    figures=figures,
    scored_from=4,
    notes=(
        "DriftWorld's figures: its main_eval_metrics.py prints them, arXiv 2607.15065 has them.",
        "split train: windows of episodes that the model was trained on, as theirs. lpips: trace AlexNet.",
    ),
)
SET = PublicSet("gpc_pusht", download, prepare, PROTOCOL, scored="train")

if __name__ == "__main__":
    run_script(lambda: run(SET))
