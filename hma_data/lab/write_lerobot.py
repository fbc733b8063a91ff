"""Write a LeRobotDataset v3.0 with lerobot's own writer.

    meta/info.json, meta/stats.json, meta/tasks.parquet, meta/episodes/…
    data/chunk-000/file-000.parquet                     action, observation.state, indices, timestamps
    videos/<camera feature>/chunk-000/file-000.mp4      H.264, lossy

The features are those that `hma registry export --to lerobot-features` prints for the embodiment.
T frames of an episode, A action dims, S state dims.
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.lab import imported
from hma_data.registry.embodiment import Embodiment
from hma_data.registry.export import lerobot_features


@dataclass(frozen=True)
class LeRobotEpisode:
    """One episode of T frames.

    Attributes:
        pictures: camera feature -> (T, H, W, 3) uint8 RGB.
        action: (T, A) float32, the command issued at each frame.
        state: (T, S) float32, seen at each frame.
            task: the task in words.
    """

    pictures: Mapping[str, NDArray[np.uint8]]
    action: NDArray[np.float32]
    state: NDArray[np.float32]
    task: str


def write_lerobot(folder: Path, embodiment: Embodiment, episodes: Iterable[LeRobotEpisode]) -> None:
    """Write one dataset; episodes are read one by one, so that only one is in memory.

    Args:
        folder: folder to make.
        embodiment: an embodiment that has a state, and a whole number of frames a second.
        episodes: the episodes; each has the embodiment's cameras and widths.

    Raises:
        MissingDependencyError: lerobot cannot be imported.
    """
    assert embodiment.frequency_hz and embodiment.frequency_hz == int(embodiment.frequency_hz)
    with imported("lerobot", "pip install 'lerobot[dataset]'"):
        from lerobot.configs.video import RGBEncoderConfig
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

    writer = LeRobotDataset.create(
        f"lab/{embodiment.id}",
        int(embodiment.frequency_hz),
        lerobot_features(embodiment),
        root=folder,
        robot_type=embodiment.robot,
        video_backend="pyav",
        rgb_encoder=RGBEncoderConfig(vcodec="h264", crf=18),
        encoder_threads=1,  # the output bytes depend on the number of threads
    )
    with _quiet():
        try:
            for episode in episodes:
                for frame in _frames(episode):
                    writer.add_frame(frame)
                writer.save_episode(parallel_encoding=False)  # otherwise it forks this process, once a camera
        finally:
            writer.finalize()  # after a failure too; else it would write to a removed folder when collected


def _frames(episode: LeRobotEpisode) -> Iterable[dict[str, Any]]:
    for row, (action, state) in enumerate(zip(episode.action, episode.state, strict=True)):
        pictures = {key: images[row] for key, images in episode.pictures.items()}
        yield {**pictures, "action": action, "observation.state": state, "task": episode.task}


@contextmanager
def _quiet() -> Iterator[None]:
    """Hide FFmpeg's report on each video and the progress bar of `datasets`."""
    import av.logging
    import datasets

    datasets.disable_progress_bars()
    av.logging.set_libav_level(av.logging.ERROR)
    try:
        yield
    finally:
        datasets.enable_progress_bars()
        av.logging.set_libav_level(av.logging.INFO)
