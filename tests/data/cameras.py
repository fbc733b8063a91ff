"""Recordings of a robot with three cameras of three sizes; colours tell camera, episode and frame."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.lerobot.writer import LeRobotEpisode, write_lerobot
from hma_data.tokenizers.base import Tokenizer
from tests.conftest import BlockTokenizer

SIZES = {"top": (64, 64), "wrist": (32, 32), "side": (64, 96)}
LENGTHS = (9, 8, 10)
ACTION = "{space: joint_delta, components: [{key: %s, dims: 2, names: [a, b]}]}"


def arm(source: str = "hdf5") -> Embodiment:
    keys = {"hdf5": ("actions", "obs/%s"), "lerobot": ("action", "observation.images.%s")}[source]
    cameras = [
        f"  - {{name: {name}, key: {keys[1] % name}, size: [{height}, {width}]}}\n"
        for name, (height, width) in SIZES.items()
    ]
    return Embodiment.from_yaml(
        f"id: three_{source}\nkind: simulation\nfrequency_hz: 10\ntarget_hz: 5\naction: {ACTION % keys[0]}\n"
        f"cameras:\n{''.join(cameras)}source: {{format: {source}}}\n"
        + ("state: {components: [{key: observation.state, dims: 1}]}\n" if source == "lerobot" else "")
    )


def pictures(camera: str, episode: int, length: int) -> np.ndarray:
    """Flat pictures (T, H, W, 3): red is the camera, green the episode, blue the frame."""
    made = np.empty((length, *SIZES[camera], 3), np.uint8)
    made[..., 0], made[..., 1] = 17 * (1 + 4 * list(SIZES).index(camera)), 17 * (1 + episode)
    made[..., 2] = 17 * np.arange(length)[:, None, None]
    return made


def actions(episode: int, length: int) -> np.ndarray:
    return np.stack([np.full(length, episode), np.sin(np.arange(length))], axis=1).astype(np.float32)


def write_hdf5(path: Path) -> Path:
    with h5py.File(path, "w") as file:
        for episode, length in enumerate(LENGTHS):
            group = file.create_group(f"data/demo_{episode}")
            group["actions"] = actions(episode, length)
            for camera in SIZES:
                group[f"obs/{camera}"] = pictures(camera, episode, length)
    return path


def three_shards(folder: Path, tokenizer: Tokenizer | None = None, **chosen: Any) -> Path:
    """Convert such a recording with all its cameras into a folder here, and return that folder."""
    settings = Settings(cameras=("all",), **chosen)
    recording = write_hdf5(folder / "three.hdf5")
    convert(arm(), recording, tokenizer or BlockTokenizer(), folder / "set", settings=settings)
    return folder / "set"


def write_dataset(folder: Path) -> Path:
    episodes = [
        LeRobotEpisode(
            pictures={f"observation.images.{camera}": pictures(camera, i, length) for camera in SIZES},
            action=actions(i, length),
            state=np.zeros((length, 1), np.float32),
            task="look",
        )
        for i, length in enumerate(LENGTHS)
    ]
    write_lerobot(folder, arm("lerobot"), episodes)
    return folder
