"""Write LeRobotDatasets with lerobot's own writer.

Episodes are read one by one, so that only one is in memory.

T frames of an episode, A action dims, S state dims.
"""

import json
import logging
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from hma_data.arrays import Array, Float32s, Images
from hma_data.errors import MissingDependencyError, SourceError, install_command
from hma_data.registry.embodiment import Embodiment
from hma_data.registry.export import lerobot_features
from hma_data.storage.files import read_json

ORIGIN = "synthetic.json"  # beside a dataset whose episodes no robot recorded: what made them
SYNTHETIC = "synthetic"  # a column of 1 in lerobot's own recordings of an evaluation in a model


def origin_of(find: Callable[[str], Path]) -> dict[str, Any]:
    """Return what made the episodes of a dataset: `made_by` of the plan of shards; empty for a recording.

    Args:
        find: returns the path of a file of the dataset, which need not exist.
    """
    path, info = find(ORIGIN), find("meta/info.json")
    if path.is_file():
        return read_json(path, SourceError)
    if not info.is_file() or SYNTHETIC not in read_json(info, SourceError).get("features", {}):
        return {}
    ranges = read_json(find("meta/stats.json"), SourceError).get(SYNTHETIC, {})
    return {"by": "lerobot-eval", "synthetic": True} if ranges.get("max") == [1.0] else {}


@dataclass(frozen=True)
class LeRobotEpisode:
    """One episode of T frames for LeRobot."""

    pictures: Mapping[str, Sequence[Images] | Images]  # camera -> T/hold of (H, W, 3)
    action: Float32s  # (T, A), the action issued at each frame
    state: Float32s | None  # (T, S), seen at each frame
    task: str  # in words
    further: Mapping[str, Array] = field(default_factory=dict)  # other features -> (T, values)
    hold: int = 1  # rows for which an image stands


class DatasetWriter:
    """A LeRobotDataset v3.0 in the making, by lerobot's own writer; videos are H.264.

    An episode's rows are added one by one, then it is saved or dropped. The folder is whole when `close` has
    returned.

    Raises:
        MissingDependencyError: lerobot cannot be imported.
    """

    def __init__(
        self, folder: Path, name: str, fps: int, features: dict[str, dict[str, Any]], robot: str | None
    ) -> None:
        config, dataset = load_lerobot()
        sides = [side for item in features.values() if item["dtype"] == "video" for side in item["shape"][:2]]
        # H.264 has half as many colours as pixels a side, which an odd side does not allow.
        pixels = "yuv444p" if any(side % 2 for side in sides) else "yuv420p"
        self._failures, self._folder = _PictureFailures(), folder
        self._writer = dataset.create(
            f"lab/{name}",
            fps,
            features,
            root=folder,
            robot_type=robot,
            video_backend="pyav",
            rgb_encoder=config(vcodec="h264", crf=18, pix_fmt=pixels),
            encoder_threads=1,  # the output bytes depend on the number of threads
        )

    def add_row(self, values: dict[str, Any]) -> None:
        """Add a row of the episode: feature -> value, and its "task"."""
        self._writer.add_frame(values)
        self._failures.check()

    def save_episode(self) -> None:
        """Encode the videos of the rows added since the episode before, and write them."""
        with _quiet():
            self._writer.save_episode(parallel_encoding=False)  # else it forks this process, once a camera

    def drop_episode(self) -> None:
        """Forget the rows added since the episode before."""
        self._writer.clear_episode_buffer()

    def close(self) -> None:
        """Complete the files; after a failure too, or lerobot would write to a removed folder later."""
        self._failures.close()
        with _quiet():
            self._writer.finalize()
        _share_videos(self._folder)


class _PictureFailures(logging.Handler):
    """The errors of lerobot's writer of images, which it only logs: an episode would lack frames."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self._log = logging.getLogger("lerobot.datasets.image_writer")
        self._log.addHandler(self)
        self._propagates, self._log.propagate = self._log.propagate, False
        self._found: list[BaseException] = []

    def emit(self, record: logging.LogRecord) -> None:
        words = record.args if isinstance(record.args, tuple) else ()
        faults = [item for item in words if isinstance(item, BaseException)]
        self._found += faults or [OSError(record.getMessage())]

    def check(self) -> None:
        if self._found:
            raise self._found[0]

    def close(self) -> None:
        """Stop listening."""
        self._log.removeHandler(self)
        self._log.propagate = self._propagates
        super().close()


def load_lerobot() -> tuple[Any, Any]:
    """Return lerobot's settings of an encoder and its dataset; the import takes seconds."""
    from tqdm import tqdm

    tqdm.set_lock(threading.RLock())  # its own is of several processes, and a worker that is killed leaks it
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of lerobot's own imports
            from lerobot.configs.video import RGBEncoderConfig
            from lerobot.datasets.lerobot_dataset import LeRobotDataset
    except ImportError as fault:
        raise MissingDependencyError("lerobot", f"cannot be imported: {fault}", install_command()) from fault
    return RGBEncoderConfig, LeRobotDataset


def write_lerobot(
    folder: Path,
    embodiment: Embodiment,
    episodes: Iterable[LeRobotEpisode],
    on_progress: Callable[[int, str], None] = lambda done, words: None,
    made_by: Mapping[str, Any] | None = None,
) -> None:
    """Write a LeRobotDataset v3.0 of episodes, one by one; see `DatasetWriter`.

    The features are those that `hma registry export --to lerobot-features` prints for the embodiment, and
    the further ones of the first episode.

    Args:
        folder: folder to make.
        embodiment: one with a whole number of frames a second.
        episodes: at least one; each has the embodiment's cameras and widths, and the same further features.
        on_progress: called with the frames written so far, and what is done.
        made_by: what made episodes that no robot recorded; it and the embodiment are then written too.
    """
    assert embodiment.frequency_hz
    on_progress(0, "loading lerobot")
    load_lerobot()
    rest = iter(episodes)
    first = next(rest)
    further = {
        key: {"dtype": str(values.dtype), "shape": values.shape[1:], "names": None}
        for key, values in first.further.items()
    }
    features = lerobot_features(embodiment) | further
    writer = DatasetWriter(folder, embodiment.id, int(embodiment.frequency_hz), features, embodiment.robot)
    done = 0
    on_progress(done, "writing frames")
    try:
        for episode in chain([first], rest):
            for row, action in enumerate(episode.action):
                values: dict[str, Any] = {"action": action, "task": episode.task}
                values |= {key: shown[row // episode.hold] for key, shown in episode.pictures.items()}
                values |= {key: array[row] for key, array in episode.further.items()}
                if episode.state is not None:
                    values["observation.state"] = episode.state[row]
                writer.add_row(values)
                done += 1
                on_progress(done, "writing frames")
            on_progress(done, "encoding videos")
            writer.save_episode()
    finally:
        writer.close()
    _sort_stats(folder)
    if made_by is not None:
        (folder / "embodiment.yaml").write_text(embodiment.to_yaml(), encoding="utf-8")
        (folder / ORIGIN).write_text(json.dumps(made_by, indent=1), encoding="utf-8")


def join_datasets(parts: Sequence[Path], folder: Path, name: str) -> None:
    """Join LeRobotDatasets of the same features into a new one, by lerobot's own aggregation.

    Args:
        parts: their folders, in the order of the episodes.
        folder: of the new one; it does not exist.
    """
    load_lerobot()
    from lerobot.datasets import aggregate

    bars, aggregate.tqdm = aggregate.tqdm, SimpleNamespace(tqdm=lambda items, desc: items)
    try:
        with _quiet():
            aggregate.aggregate_datasets([f"lab/{name}"] * len(parts), f"lab/{name}", list(parts), folder)
    finally:
        aggregate.tqdm = bars
    _share_videos(folder)
    _sort_stats(folder)


def _sort_stats(folder: Path) -> None:
    """Sort the statistics of a dataset: lerobot writes its features in another order in each process."""
    stats = folder / "meta" / "stats.json"
    stats.write_text(json.dumps(read_json(stats, SourceError), indent=4, sort_keys=True), encoding="utf-8")


def set_splits(folder: Path, splits: Mapping[str, str]) -> None:
    """State the splits of a LeRobotDataset: name -> `from:to`, of episodes."""
    load_lerobot()
    from lerobot.datasets.io_utils import load_info, write_info

    info = load_info(folder)
    info.splits = dict(splits)
    write_info(info, folder)


def _share_videos(folder: Path) -> None:
    """Give videos the permissions of the other files: lerobot makes some as private temporary files."""
    about = folder / "meta" / "info.json"
    if about.is_file():
        for video in folder.rglob("*.mp4"):
            video.chmod(about.stat().st_mode & 0o777)


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
