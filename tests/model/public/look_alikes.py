"""Small copies of the layouts of public Push-T sets: a disc moves as it is told, a square lies about."""

import json
import zlib
from itertools import product
from pathlib import Path

import h5py
import numpy as np
import torch
from numpy.typing import NDArray

from hma_data.episodes.sheets import write_mp4


def write_zarr(folder: Path, values: NDArray, chunks: tuple[int, ...], compressor: str | None = None) -> None:
    """Write an array as Zarr's format 2 has it; `blosc` are frames that hold their bytes as they are."""
    folder.mkdir(parents=True)
    facts = {"zarr_format": 2, "shape": values.shape, "chunks": chunks, "dtype": values.dtype.str}
    facts |= {"compressor": compressor and {"id": compressor}, "fill_value": 0, "order": "C", "filters": None}
    (folder / ".zarray").write_text(json.dumps(facts))
    for at in product(*(range(-(-side // chunk)) for side, chunk in zip(values.shape, chunks))):
        part = values[tuple(slice(i * chunk, (i + 1) * chunk) for i, chunk in zip(at, chunks))]
        whole = np.zeros(chunks, values.dtype)
        whole[tuple(slice(side) for side in part.shape)] = part
        data = whole.tobytes()
        if compressor == "zlib":
            data = zlib.compress(data)
        elif compressor == "blosc":
            sizes = np.array([len(data), len(data), len(data) + 16], "<u4")
            data = bytes([2, 1, 0x2, values.itemsize]) + sizes.tobytes() + data
        (folder / ".".join(map(str, at))).write_bytes(data)


def push(seed: int, frames: int, side: int) -> tuple[NDArray[np.uint8], NDArray, NDArray]:
    """Return images (T, side, side, 3), targets (T, 2) and states (T, 5) in px of 512."""
    rng = np.random.default_rng(seed)
    targets = np.cumsum(rng.normal(0, 20, (frames, 2)), axis=0).clip(-200, 200) + 256
    places = np.vstack([[256, 256], targets[:-1]])
    images = np.full((frames, side, side, 3), 255, np.uint8)
    for image, (x, y) in zip(images, (places * side / 512).astype(int)):
        image[side // 4 : side // 2, side // 4 : side // 2] = (119, 136, 153)
        image[y - 3 : y + 3, x - 3 : x + 3] = (65, 105, 225)
    states = np.hstack([places, np.full((frames, 3), 192.0)])
    return images, targets.astype(np.float32), states.astype(np.float32)


def gpc(folder: Path, episodes: int = 6, frames: int = 20) -> Path:
    """Write world_model_data; its images are floats of 0 to 255."""
    made = [push(number, frames + number, 96) for number in range(episodes)]
    images, actions, states = (np.concatenate(series) for series in zip(*made, strict=True))
    zarr = folder / "world_model_data" / "dataset_domain" / "all_data" / "domain18.zarr"
    write_zarr(zarr / "data" / "img", images.astype(np.float32), (16, 96, 96, 3), "zlib")
    write_zarr(zarr / "data" / "action", actions, (100, 2), "blosc")
    write_zarr(zarr / "data" / "state", states, (100, 5), "blosc")
    ends = np.cumsum([len(one) for one, _, _ in made])
    write_zarr(zarr / "meta" / "episode_ends", ends, (len(ends),))
    (zarr / ".zgroup").write_text('{"zarr_format": 2}')
    return folder


def dino_wm(folder: Path, episodes: int = 6, frames: int = 24) -> Path:
    """Write pusht_noise; train and val are alike."""
    for seed, part in enumerate(("train", "val")):
        place = folder / "pusht_noise" / part
        made = [push(100 * seed + number, frames + number, 224) for number in range(episodes)]
        longest = frames + episodes - 1
        numbers = {"rel_actions.pth": 2, "states.pth": 5, "velocities.pth": 2}
        padded = {name: torch.zeros(episodes, longest, width) for name, width in numbers.items()}
        for number, (images, targets, states) in enumerate(made):
            write_mp4(place / "obses" / f"episode_{number:03d}.mp4", images, 10)
            padded["states.pth"][number, : len(images)] = torch.from_numpy(states)
            moves = torch.from_numpy(targets - states[:, :2])
            padded["rel_actions.pth"][number, : len(images)] = moves
        for name, values in padded.items():
            torch.save(values.double(), place / name)
    return folder


def iws(folder: Path, episodes: int = 6, frames: int = 20) -> Path:
    for seed, part in enumerate(("train", "val")):
        (folder / part).mkdir(parents=True)
        for number in range(episodes):
            images, targets, states = push(100 * seed + number, frames, 128)
            with h5py.File(folder / part / f"episode_{number}.hdf5", "w") as file:
                file["action"] = np.hstack([targets, targets[::-1]]) / 512
                file["env_state"] = np.hstack([states, states[:, :2]]) / 512
                file["robot_bases"] = np.zeros((frames, 2, 4, 4), np.float32)
                file["obs/ee_pos"] = np.zeros((frames, 2, 4, 4), np.float32)
                file["obs/joint_pos"] = np.zeros((frames, 14), np.float32)
                file.create_dataset("obs/images/top_pov", data=images, chunks=(1, 128, 128, 3))
    return folder
