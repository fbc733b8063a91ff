"""Write LeRobotDatasets with lerobot's own writer.

Episodes are read one by one, so that only one is in memory.

T frames of an episode, A action dims, S state dims.
"""

import json
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.errors import MissingDependencyError, SourceError, install_command
from hma_data.registry.embodiment import Embodiment
from hma_data.registry.export import lerobot_features
from hma_data.storage.files import read_json

ORIGIN = "synthetic.json"  # beside a dataset whose episodes no robot recorded: what made them


def origin_of(folder: Path) -> dict[str, Any]:
    """Return what made the episodes of a dataset: `made_by` of the plan of shards; empty for a recording."""
    path = folder / ORIGIN
    return read_json(path, SourceError) if path.is_file() else {}


@dataclass(frozen=True)
class LeRobotEpisode:
    """One episode of T frames for LeRobot."""

    pictures: Mapping[str, Sequence[NDArray[np.uint8]] | NDArray[np.uint8]]  # camera -> T/hold of (H, W, 3)
    action: NDArray[np.float32]  # (T, A), the action issued at each frame
    state: NDArray[np.float32] | None  # (T, S), seen at each frame
    task: str  # in words
    further: Mapping[str, NDArray[Any]] = field(default_factory=dict)  # other features -> (T, values)
    hold: int = 1  # rows for which an image stands


def write_lerobot(
    folder: Path,
    embodiment: Embodiment,
    episodes: Iterable[LeRobotEpisode],
    on_progress: Callable[[int, str], None] = lambda done, words: None,
    made_by: Mapping[str, Any] | None = None,
) -> None:
    """Write a LeRobotDataset v3.0 with lerobot's own writer; videos are H.264.

    The features are those that `hma registry export --to lerobot-features` prints for the embodiment, and
    the further ones of the first episode.

    Args:
        folder: folder to make.
        embodiment: one with a whole number of frames a second.
        episodes: at least one; each has the embodiment's cameras and widths, and the same further features.
        on_progress: called with the frames written so far, and what is done.
        made_by: what made episodes that no robot recorded; it and the embodiment are then written too.

    Raises:
        MissingDependencyError: lerobot cannot be imported.
    """
    assert embodiment.frequency_hz
    on_progress(0, "loading lerobot")  # its imports take seconds
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of lerobot's own imports
            from lerobot.configs.video import RGBEncoderConfig
            from lerobot.datasets.lerobot_dataset import LeRobotDataset
    except ImportError as fault:
        raise MissingDependencyError("lerobot", f"cannot be imported: {fault}", install_command()) from fault

    rest = iter(episodes)
    first = next(rest)
    further = {
        key: {"dtype": str(values.dtype), "shape": values.shape[1:], "names": None}
        for key, values in first.further.items()
    }
    writer = LeRobotDataset.create(
        f"lab/{embodiment.id}",
        int(embodiment.frequency_hz),
        lerobot_features(embodiment) | further,
        root=folder,
        robot_type=embodiment.robot,
        video_backend="pyav",
        rgb_encoder=RGBEncoderConfig(vcodec="h264", crf=18),
        encoder_threads=1,  # the output bytes depend on the number of threads
    )
    done = 0
    on_progress(done, "writing frames")
    with _quiet():
        try:
            for episode in chain([first], rest):
                for row, action in enumerate(episode.action):
                    values: dict[str, Any] = {"action": action, "task": episode.task}
                    values |= {key: shown[row // episode.hold] for key, shown in episode.pictures.items()}
                    values |= {key: array[row] for key, array in episode.further.items()}
                    if episode.state is not None:
                        values["observation.state"] = episode.state[row]
                    writer.add_frame(values)
                    done += 1
                    on_progress(done, "writing frames")
                on_progress(done, "encoding videos")
                writer.save_episode(parallel_encoding=False)  # otherwise it forks this process, once a camera
        finally:
            writer.finalize()  # after a failure too; else it would write to a removed folder when collected
    if made_by is not None:
        (folder / "embodiment.yaml").write_text(embodiment.to_yaml(), encoding="utf-8")
        (folder / ORIGIN).write_text(json.dumps(made_by, indent=1), encoding="utf-8")


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
