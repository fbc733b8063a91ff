"""What `hma inspect` says of hand videos: sizes, rates and codecs, and in how many frames hands are."""

from collections import Counter

import numpy as np

from hma_data.errors import EpisodeError, HMAError, MissingDependencyError
from hma_data.sources.base import Inspection, KeyInfo
from hma_data.sources.findings import Finding
from hma_data.sources.hands_layout import Header, Video, header_of, videos_of
from hma_data.sources.hands_models import load_models
from hma_data.sources.hands_runs import POINTS
from hma_data.sources.hands_scan import scan
from hma_data.sources.video_file import VideoFile

LOOKED_AT, FRAMES = 5, 12  # videos that hands are looked for in, and frames of each
LISTED = 1_000


def inspect_videos(uri: str, episodes: int) -> Inspection:
    """See HandsSource.inspect."""
    videos = videos_of(uri)
    headers: dict[str, Header] = {}
    problems = []
    for name, video in videos.items():
        try:
            headers[name] = header_of(video.path)
        except EpisodeError as fault:
            problems.append(str(fault))
    kinds = Counter((each.height, each.width, round(each.hz, 2), each.codec) for each in headers.values())
    facts = {"keys": "each point also with /next (value at the next labelled frame) and /delta"}
    if len(kinds) > 1:
        facts["videos"] = ", ".join(
            f"{count} of {width}×{height} at {hz:g} Hz {codec}"
            for (height, width, hz, codec), count in kinds.most_common(10)
        )
    try:
        seen = _hands_in(videos, headers)
        facts |= seen[0]
        problems += seen[1]
    except MissingDependencyError as fault:
        facts["hands"] = f"not looked for: {fault.where} {fault.fault}; {fault.remedy}"
    except HMAError as fault:
        facts["hands"] = f"not looked for: {fault}"
    first = next(iter(headers.values()), None)
    hz = first.hz if first else None
    size = (first.height, first.width, 3) if first else (0, 0, 3)
    keys = [KeyInfo("video", "camera", size, "uint8", hz, codec=first.codec if first else None)]
    for point, width in POINTS.items():
        names = ("x", "y") if width == 2 else None
        keys.append(KeyInfo(point, "vector", (width,), "float32", hz, names))
    lengths = [each.frames for each in headers.values()]
    return Inspection(
        format="hands",
        uri=uri,
        episodes=len(videos),
        keys=tuple(keys),
        frames=sum(lengths),
        lengths=tuple(lengths[:LISTED]),
        hz=hz,
        robot="human hands",
        findings=tuple(Finding("recording", "warn", said) for said in problems),
        facts=facts,
    )


def _hands_in(videos: dict[str, Video], headers: dict[str, Header]) -> tuple[dict[str, str], list[str]]:
    """Shares of frames with hands in a sample, and videos of it that have none or cannot be decoded."""
    from hma_data.sources.hands_detect import MediaPipeHands

    detector = MediaPipeHands(load_models())
    looked = 0
    sides: Counter[str] = Counter()
    problems = []
    for name in list(headers)[:LOOKED_AT]:
        try:
            file = VideoFile(videos[name].path)
            chosen = np.unique(np.linspace(0, len(file) - 1, FRAMES).astype(np.int64))
            seen = []
            for index in chosen.tolist():  # far apart, so nothing is followed from one to the next
                found = scan(file, detector, [index])
                seen.append(tuple(found.sides.tolist()))
        except EpisodeError as fault:
            problems.append(str(fault))
            continue
        looked += len(seen)
        sides["left hand"] += sum(0 in each for each in seen)
        sides["right hand"] += sum(1 in each for each in seen)
        sides["both"] += sum(len(each) == 2 for each in seen)
        if not any(seen):
            problems.append(f"{name}: no hand in {len(seen)} frames looked at")
    share = {
        f"frames with {side}": f"{sides[side] / looked:.0%} of {looked} looked at"
        for side in ("left hand", "right hand", "both")
        if looked
    }
    return share, problems
