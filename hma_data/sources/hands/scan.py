"""Run the detector over whole videos: for labels, and for `hma inspect`.

`labels: detector` uses `scan_cached` while it reads: detections are cached by the content of the video and
the models.

R hands found.
"""

from collections import Counter
from collections.abc import Iterable
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.errors import HMAError
from hma_data.registry.components import HandsLayout
from hma_data.sources.common.checks import Finding
from hma_data.sources.common.inspection import Inspection, KeyInfo
from hma_data.sources.common.places import file_fingerprint, local_path
from hma_data.sources.common.survey import Series, Survey, sampled
from hma_data.sources.common.video_file import VideoFile
from hma_data.sources.hands.detect import VERSION, Hand, HandModels, MediaPipeHands
from hma_data.sources.hands.runs import (
    POINTS,
    SIDES,
    HandLabels,
    Header,
    Video,
    header_of,
    labels_from_rows,
    videos_of,
)
from hma_data.storage.files import atomic_path, cache_folder, short_sha256

BATCH_FRAMES = 8  # frames decoded together: 200 MB of 4K images
TABLE_SUFFIXES = (".csv", ".json", ".npz", ".npy", ".parquet", ".h5", ".hdf5")  # a robot's numbers, perhaps
MAX_FILES_BESIDE = 2_000  # files among which they are looked for
ROBOT_VIDEOS_PAGE = "docs/adding-a-robot.md, HDF5 with separate videos"
MAX_VIDEOS = 5  # that an inspection searches for hands
FRAMES_PER_VIDEO = 12


def scan(name: str, video: VideoFile, detector: MediaPipeHands, frames: Iterable[int] | None = None) -> Any:
    """Run a detector over a video's frames in order; the detector treats `frames`, if given, as consecutive.

    Returns:
        an arrow table of R rows as `labels: landmarks` reads it: video, frame, side, score, landmarks.

    Raises:
        EpisodeError: a frame cannot be decoded.
    """
    import pyarrow as pa

    chosen = np.fromiter(range(len(video)) if frames is None else frames, np.int64)
    hands: list[tuple[int, Hand]] = []
    detector.reset()
    for start in range(0, len(chosen), BATCH_FRAMES):
        batch = chosen[start : start + BATCH_FRAMES]
        for index, image in zip(batch.tolist(), video.frames(batch), strict=True):
            hands += [(index, hand) for hand in detector.detect(image)]
    points = np.array([hand.points for _, hand in hands], np.float32).reshape(-1)
    return pa.table(
        {
            "video": pa.array([name] * len(hands), pa.string()),
            "frame": pa.array([index for index, _ in hands], pa.int64()),
            "side": pa.array([hand.side for _, hand in hands], pa.string()),
            "score": pa.array([hand.score for _, hand in hands], pa.float32()),
            "landmarks": pa.FixedSizeListArray.from_arrays(pa.array(points), 42),
        }
    )


def scan_cached(path: Path, detector: MediaPipeHands, models: HandModels, layout: HandsLayout) -> HandLabels:
    """Return the hands of a video; run the detector only where they are not cached.

    Raises:
        EpisodeError: the video is damaged.
    """
    import pyarrow.parquet as pq

    video = VideoFile(path)
    facts = (VERSION, file_fingerprint(path), len(video), models.digest, layout.mirrored)
    key = short_sha256(repr(facts), 32)
    kept = cache_folder() / "hands" / f"{key}.parquet"
    if not kept.is_file():
        with atomic_path(kept) as part:
            pq.write_table(scan(path.name, video, detector), part, compression="zstd")
    table = pq.read_table(kept)
    scores = table["score"].to_numpy()
    good = scores >= layout.min_score
    sides = np.array([SIDES.index(side) for side in table["side"].to_pylist()], np.int64)[good]
    landmarks = table["landmarks"].combine_chunks().flatten().to_numpy().reshape(-1, 42)[good]
    frames = table["frame"].to_numpy()[good]
    return labels_from_rows(frames, sides, scores[good], {"landmarks": landmarks}, range(len(video)))


# -- inspection


def inspect_videos(uri: str, episodes: int) -> Inspection:
    """Inspect hand videos: sizes, rates, codecs, and the share of frames that show hands."""
    videos, root = videos_of(uri), local_path(uri)
    survey = Survey(len(videos))
    survey.links(root)
    near = islice((root if root.is_dir() else root.parent).rglob("*"), MAX_FILES_BESIDE)
    beside = Counter(item.suffix.lower() for item in near)
    if tables := ", ".join(f"{beside[suffix]:,} {suffix}" for suffix in TABLE_SUFFIXES if beside[suffix]):
        said = f"these videos are read as videos of hands; next to them are {tables}"
        survey.note(Finding("files", "info", said, f"for a robot's videos: {ROBOT_VIDEOS_PAGE}"))
    headers: dict[str, Header] = {}
    for name, video in videos.items():
        with survey.reading(name):
            headers[name] = header_of(video.path)
    chosen = survey.sample(list(headers), episodes)
    survey.made |= {"frames"} if chosen else set()
    for name in chosen:
        opened = partial(_film, name, videos[name], headers[name], survey)
        # few containers state a rate
        survey.look(name, {"video": opened}, headers[name].hz or None, "measured over its whole length")
    facts = {"keys": "each point also with /next (value at the next labelled frame) and /delta"}
    kinds = Counter((each.height, each.width, round(each.hz, 2), each.codec) for each in headers.values())
    if len(kinds) > 1:
        facts["videos"] = ", ".join(
            f"{count} of {width}×{height} at {hz:g} Hz {codec}"
            for (height, width, hz, codec), count in kinds.most_common(10)
        )
    try:
        facts |= _hands_in(videos, chosen[:MAX_VIDEOS], survey)
    except HMAError as fault:
        said = f"hands were not detected: {fault.where} {fault.fault}"
        survey.note(Finding("hands", "warn", said, fault.remedy, "video"))
    first = next(iter(headers.values()), Header(0, 0.0, 0, 0, ""))
    hz, size = first.hz or None, (first.height, first.width, 3)
    keys = [KeyInfo("video", "camera", size, "uint8", hz, codec=first.codec or None)]
    for point, width in POINTS.items():
        keys.append(KeyInfo(point, "vector", (width,), "float32", hz, ("x", "y") if width == 2 else None))
    lengths = [headers[name].frames if name in headers else 0 for name in videos]
    return survey.inspection("hands", uri, keys, lengths, facts, hz=hz, robot="human hands")


def _film(name: str, video: Video, header: Header, survey: Survey) -> Series:
    """Open a video; compare its packets with its header."""
    file = VideoFile(video.path)
    if header.frames and abs(len(file) - header.frames) > 1:
        said = f"{name}: holds {len(file):,} frames, its header states {header.frames:,}"
        numbers = {"frames": len(file), "stated": header.frames}
        survey.note(Finding("frames", "warn", said, key="video", numbers=numbers))
    return Series(None, file.frames, len(file), file.table.keys, header.codec, file.timestamps)


def _hands_in(videos: dict[str, Video], chosen: list[str], survey: Survey) -> dict[str, str]:
    """Return the shares of sampled frames with hands; note the sampled videos that show none."""
    detector = MediaPipeHands()
    survey.made.add("hands")
    every: list[list[str]] = []  # the sides of the hands in each frame
    for name in chosen:
        with survey.reading(name):
            file = VideoFile(videos[name].path)
            frames = sampled(len(file), FRAMES_PER_VIDEO)
            # The frames are far apart, so each is scanned alone and no hand is tracked between them.
            seen = [scan(name, file, detector, [index])["side"].to_pylist() for index in frames]
            every += seen
            if not any(seen):
                said = f"{name}: no hand in {len(seen)} sampled frames"
                survey.note(Finding("hands", "warn", said, key="video", numbers={"frames": len(seen)}))
    counts = {
        "left hand": sum("left" in sides for sides in every),
        "right hand": sum("right" in sides for sides in every),
        "both": sum(len(sides) == 2 for sides in every),
    }
    return {
        f"frames with {side}": f"{count / len(every):.0%} of {len(every)} sampled"
        for side, count in counts.items()
        if every
    }
