"""The Push-T set of DINO-WM (pusht_noise): download, repack, train, score.

    python -m recipes.public.dino_wm build/dino_wm        # from the repository's folder

Published is a zip file with train/ and val/, each with states.pth, velocities.pth and rel_actions.pth, padded
to the longest episode, and obses/episode_000.mp4 and on. An HDF5 file beside the folder of videos gets the
rows of an episode, as many as its video has frames. seq_lengths.pkl and shapes.pkl are not read, because
unpickling runs code.

Scored as docs/evaluation.md of Nano World Models says (github.com/simchowitzlabpublic/nano-world-model): 256
windows of val of four frames, five recorded frames apart, drawn with their seed; one frame is given.
"""

import argparse
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import av
import h5py
import numpy as np

from hma_data.console import run_script
from hma_data.errors import SourceError
from hma_data.storage.files import atomic_path, write_atomic
from hma_model.evaluation.metrics import psnr
from recipes.public.rollouts import Images
from recipes.public.sets import Chosen, Figures, Protocol, PublicSet, checked_file, gaussian_ssim, run

URL = "https://osf.io/download/k2d8w/"
SHA256 = "442f5dee246edf670964ed7bdecd248683cd6d00580fa0e4d458abb53f92da08"
WINDOWS, SEED = 256, 42
NUMBERS = {"action": "rel_actions.pth", "state": "states.pth", "velocity": "velocities.pth"}


def download(folder: Path, given: argparse.Namespace) -> None:
    """Download and unpack the set; one that is unpacked is kept."""
    unpacked = folder / ".unpacked"
    if unpacked.is_file():
        return
    archive = folder / "pusht_noise.zip"
    if not archive.is_file():
        checked_file(URL, SHA256, archive)
    with zipfile.ZipFile(archive) as zipped:
        names = [name for name in zipped.namelist() if not Path(name).name.startswith("._")]
        zipped.extractall(folder, names)
    write_atomic(unpacked, "")


def prepare(source: Path, out: Path) -> tuple[Path, Path]:
    """Write the HDF5 files of train and val into the folders with their videos.

    Raises:
        SourceError: a part is missing or damaged.
    """
    found = sorted(path.parent for path in source.rglob("rel_actions.pth"))
    parts = {path.name: path for path in found if path.name in ("train", "val")}
    if len(parts) < 2:
        said = f"holds {', '.join(parts) or 'neither'} of train and val"
        raise SourceError(source, said, "give the folder pusht_noise")
    for part in parts.values():
        write_rows(part)
    return parts["train"], parts["val"]


def write_rows(folder: Path) -> None:
    """Write episode_N.hdf5 with the numbers of obses/episode_N.mp4; files that are there are kept."""
    numbers = {key: tensor(folder / name) for key, name in NUMBERS.items()}
    videos = sorted((folder / "obses").glob("episode_*.mp4"))
    most = {key: values.shape[:2] for key, values in numbers.items()}
    if not videos or set(most.values()) != {(len(videos), most["action"][1])}:
        said = f"has {len(videos)} videos, and numbers of {most} episodes and rows"
        raise SourceError(folder, said, "unpack the set again")
    for video in videos:
        final = folder / f"{video.stem}.hdf5"
        if final.is_file():
            continue
        name, rows = video.stem.removeprefix("episode_"), frame_count(video)
        number = int(name) if name.isdecimal() else len(videos)
        if number >= len(videos) or not 0 < rows <= most["action"][1]:
            said = f"has {rows} frames, number {name}; the numbers are of {most['action']} episodes and rows"
            raise SourceError(video, said, "unpack the set again")
        with atomic_path(final) as part, h5py.File(part, "w") as file:
            for key, values in numbers.items():
                file[key] = values[number, :rows]


def tensor(path: Path) -> Any:
    """Return a tensor's values (N, T, V) as float32; no code of the file is run.

    Raises:
        SourceError: the file is missing, damaged, or holds something else than a tensor.
    """
    import torch

    try:
        values = torch.load(path, map_location="cpu", weights_only=True)
        found = values.float().numpy()
        if found.ndim != 3:
            raise ValueError(found.shape)
        return found
    except Exception as fault:  # torch raises several kinds
        raise SourceError(path, f"is no tensor: {type(fault).__name__}", "unpack the set again") from fault


def frame_count(path: Path) -> int:
    """Return the frames of a video."""
    try:
        with av.open(str(path)) as container:
            stated = container.streams.video[0].frames
            return stated or sum(1 for _ in container.decode(video=0))
    except (av.FFmpegError, IndexError) as fault:
        raise SourceError(path, f"is no video: {fault}", "unpack the set again") from fault


def choose(lengths: Sequence[int], stride: int) -> Chosen:
    """Return the windows that the published figures are of, in their order.

    Their loader shuffles the episodes, lists all windows, and draws among them without replacement.
    """
    order = np.arange(len(lengths))
    np.random.RandomState(SEED).shuffle(order)
    span = PROTOCOL.frames * stride
    every = [(one, start) for one in order.tolist() for start in range(lengths[one] - span + 1)]
    drawn = np.random.RandomState(SEED).choice(len(every), min(WINDOWS, len(every)), replace=False)
    return [every[number] for number in drawn]


def figures(true: Images, made: Images) -> Figures:
    """Return PSNR and SSIM (11×11, Gaussian) of the predicted frames."""
    return {
        "psnr_db": float(psnr(true, made, 80.0).mean()),
        "ssim": float(gaussian_ssim(true, made).mean()),
    }


PROTOCOL = Protocol(
    frames=4,
    context=1,
    size=256,
    choose=choose,
    figures=figures,
    scored_from=1,
    published={"NanoWM-B/2, 100k steps": {"psnr_db": 33.19, "ssim": 0.982, "lpips": 0.016}},
    notes=(
        "NanoWM-B/2: docs/evaluation.md of simchowitzlabpublic/nano-world-model; 158 M parameters.",
        "Frames are compared at 256 px; ours are enlarged from the tokenizer's size.",
        "lpips: their page says AlexNet, their code takes VGG; trace both.",
    ),
)
SET = PublicSet("dino_wm_pusht", download, prepare, PROTOCOL)

if __name__ == "__main__":
    run_script(lambda: run(SET))
