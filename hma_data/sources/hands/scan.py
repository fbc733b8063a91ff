"""Run a detector over whole videos, and store what it finds.

`detect` writes a table for a folder once, and `labels: landmarks` then reads it: all runs become episodes,
and the table can be corrected by hand. `scan_cached` is used by `labels: detector` while it reads: detections
are cached by the content of the video and the models, so a second conversion does not run the detector again.
"""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hma_data.errors import OutputError, SourceError
from hma_data.sources.base import file_fingerprint
from hma_data.sources.common.video_file import VideoFile
from hma_data.sources.hands.detect import VERSION, Detector, Hand, MediaPipeHands
from hma_data.sources.hands.layout import HandsLayout, videos_of
from hma_data.sources.hands.models import HandModels, load_models
from hma_data.sources.hands.runs import SIDES, HandLabels, labels_from_rows
from hma_data.sources.hands.table import read_columns
from hma_data.storage.files import atomic_path, cache_folder
from hma_data.storage.paths import StrPath, as_path, as_text

BATCH = 8  # frames decoded together: 200 MB of 4K pictures
_LEAST = 0.5  # least presence of a hand that is stored


@dataclass(frozen=True)
class Found:
    """Hands found in one video, one row a hand.

    Attributes:
        length: frames of the video.
        frames: (R,) int64.
        sides: (R,) int64, 0 left, 1 right.
        scores: (R,) float32.
        landmarks: (R, 42) float32, fractions; may lie outside the picture.
    """

    length: int
    frames: NDArray[np.int64]
    sides: NDArray[np.int64]
    scores: NDArray[np.float32]
    landmarks: NDArray[np.float32]

    def labels(self, least: float = 0.0) -> HandLabels:
        """Return labels of every frame, without hands below a score."""
        good = self.scores >= least
        parts = {"landmarks": self.landmarks[good]}
        every = range(self.length)
        return labels_from_rows(self.frames[good], self.sides[good], self.scores[good], parts, every)


def scan(video: VideoFile, detector: Detector, frames: Iterable[int] | None = None) -> Found:
    """Run a detector over a video's frames in order.

    Args:
        frames: which frames, all by default; the detector treats them as consecutive.

    Raises:
        EpisodeError: a frame cannot be decoded.
    """
    chosen = np.fromiter(range(len(video)) if frames is None else frames, np.int64)
    hands: list[tuple[int, Hand]] = []
    detector.reset()
    for start in range(0, len(chosen), BATCH):
        batch = chosen[start : start + BATCH]
        for index, picture in zip(batch.tolist(), video.frames(batch)):
            hands += [(index, hand) for hand in detector.detect(picture)]
    return Found(
        len(video),
        np.array([index for index, _ in hands], np.int64),
        np.array([SIDES.index(hand.side) for _, hand in hands], np.int64),
        np.array([hand.score for _, hand in hands], np.float32),
        np.array([hand.points.reshape(-1) for _, hand in hands], np.float32).reshape(-1, 42),
    )


def detect(folder: StrPath, out: StrPath, models: StrPath | None = None, mirrored: bool = False) -> int:
    """Find the hands in all videos of a folder and write them as a table; see hands_table.

    Args:
        folder: str or path of a folder of videos, or of one video.
        out: str or path of the file to write, .parquet.
        models: str or path of a folder or bundle; None takes $HMA_HAND_MODELS.
        mirrored: the pictures are mirrored.

    Returns:
        the number of hands found.

    Raises:
        SourceError: no videos, no models.
        EpisodeError: a video is damaged.
    """
    final = as_path(out)
    if final.suffix != ".parquet":
        raise OutputError(final, "is no name of a parquet file", "let it end in .parquet")
    detector = MediaPipeHands(load_models(models), mirrored=mirrored)
    found = {
        name: scan(VideoFile(video.path), detector) for name, video in videos_of(as_text(folder)).items()
    }
    _write(final, found)
    return sum(len(each.frames) for each in found.values())


def scan_cached(path: Path, detector: Detector, models: HandModels, layout: HandsLayout) -> Found:
    """Return the hands of a video; run the detector only where they are not cached.

    Raises:
        EpisodeError: the video is damaged.
    """
    video = VideoFile(path)
    facts = (VERSION, file_fingerprint(path), len(video), models.digest, layout.mirrored)
    key = hashlib.sha256(repr(facts).encode()).hexdigest()[:32]
    kept = cache_folder() / "hands" / f"{key}.parquet"
    if kept.is_file():
        try:
            return _read(kept, len(video))
        except (SourceError, KeyError, ValueError):
            kept.unlink(missing_ok=True)  # damaged: it is made again
    found = scan(video, detector)
    try:
        _write(kept, {path.name: found})
    except OutputError:
        return found  # the cache cannot be written: continue without it
    return found


def _write(final: Path, found: dict[str, Found]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows = [(name, each) for name, each in found.items() if len(each.frames)]
    names = np.repeat([name for name, _ in rows], [len(each.frames) for _, each in rows])
    joined = {
        field: np.concatenate([getattr(each, field) for each in found.values()])
        for field in ("frames", "sides", "scores", "landmarks")
    }
    table = pa.table(
        {
            "video": pa.array(names.tolist(), pa.string()),
            "frame": pa.array(joined["frames"]),
            "side": pa.array([SIDES[side] for side in joined["sides"]], pa.string()),
            "score": pa.array(joined["scores"]),
            "landmarks": pa.FixedSizeListArray.from_arrays(pa.array(joined["landmarks"].reshape(-1)), 42),
        }
    )
    with atomic_path(final) as part:
        pq.write_table(table, part, compression="zstd")


def _read(path: Path, length: int) -> Found:
    try:
        columns = read_columns(path)
    except SourceError as fault:
        if fault.fault != "has no rows":
            raise
        nothing = np.zeros(0, np.int64)
        return Found(length, nothing, nothing, np.zeros(0, np.float32), np.zeros((0, 42), np.float32))
    return Found(
        length,
        np.asarray(columns["frame"], np.int64),
        np.array([SIDES.index(side) for side in columns["side"]], np.int64),
        np.asarray(columns["score"], np.float32),
        np.array(columns["landmarks"], np.float32).reshape(-1, 42),
    )
