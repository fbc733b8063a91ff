"""Inspect hand videos for `hma inspect`: sizes, rates, codecs, and the share of frames that show hands."""

from collections import Counter

import numpy as np

from hma_data.errors import EpisodeError, HMAError, MissingDependencyError
from hma_data.sources.base import Inspection, KeyInfo, local_path, unfollowed
from hma_data.sources.common import checks
from hma_data.sources.common.checks import Finding
from hma_data.sources.common.survey import Survey, sampled
from hma_data.sources.common.video_file import VideoFile
from hma_data.sources.hands.layout import Header, Video, header_of, videos_of
from hma_data.sources.hands.models import load_models
from hma_data.sources.hands.runs import POINTS
from hma_data.sources.hands.scan import scan

LOOKED_AT, FRAMES = 5, 12  # most videos that are searched for hands, and frames of each
LISTED = 1_000


def inspect_videos(uri: str, episodes: int) -> Inspection:
    """See HandsSource.inspect."""
    videos = videos_of(uri)
    survey = Survey(len(videos))
    for link in unfollowed(local_path(uri)):
        survey.note(link)
    headers: dict[str, Header] = {}
    for name, video in videos.items():
        try:
            headers[name] = header_of(video.path)
        except EpisodeError as fault:
            survey.fault(name, fault)
    chosen = [list(headers)[i] for i in sampled(len(headers), episodes)] if headers else []
    for name in chosen:
        _look(name, videos[name], headers[name], survey, max(1, checks.PAIRS // len(chosen)))
    facts = {"keys": "each point also with /next (value at the next labelled frame) and /delta"}
    kinds = Counter((each.height, each.width, round(each.hz, 2), each.codec) for each in headers.values())
    if len(kinds) > 1:
        facts["videos"] = ", ".join(
            f"{count} of {width}×{height} at {hz:g} Hz {codec}"
            for (height, width, hz, codec), count in kinds.most_common(10)
        )
    try:
        facts |= _hands_in(videos, chosen[:LOOKED_AT], survey)
    except MissingDependencyError as fault:
        facts["hands"] = f"not looked for: {fault.where} {fault.fault}; {fault.remedy}"
    except HMAError as fault:
        facts["hands"] = f"not looked for: {fault}"
    first = next(iter(headers.values()), None)
    lengths = [each.frames for each in headers.values()]
    keys = tuple(survey.key(key) for key in _keys(first))
    return Inspection(
        format="hands",
        uri=uri,
        episodes=len(videos),
        keys=keys,
        frames=sum(lengths),
        lengths=tuple(lengths[:LISTED]),
        hz=first.hz if first else None,
        robot="human hands",
        facts=facts,
        looked_at=len(survey.looked),
        findings=survey.findings(keys),
        checks=survey.checks(),
    )


def _keys(first: Header | None) -> list[KeyInfo]:
    hz = first.hz if first else None
    size = (first.height, first.width, 3) if first else (0, 0, 3)
    keys = [KeyInfo("video", "camera", size, "uint8", hz, codec=first.codec if first else None)]
    for point, width in POINTS.items():
        keys.append(KeyInfo(point, "vector", (width,), "float32", hz, ("x", "y") if width == 2 else None))
    return keys


def _look(name: str, video: Video, header: Header, survey: Survey, pairs: int) -> None:
    """Hand one video's times and some pictures to the survey; compare its packets with its header."""
    survey.made |= {"frames", "rate"}
    try:
        file = VideoFile(video.path)
        survey.episode(name)
        clock = survey.times(name, "video", file.timestamps, camera=True)
        source = "measured over its whole length"  # few containers state a rate
        for found in checks.drift(f"{name}: video", clock.hz, header.hz or None, source):
            survey.note(found)
        if header.frames and abs(len(file) - header.frames) > 1:
            said = f"{name}: holds {len(file):,} frames, its header states {header.frames:,}"
            numbers = {"frames": len(file), "stated": header.frames}
            survey.note(Finding("frames", "warn", said, key="video", numbers=numbers))
        for run in checks.runs(checks.choose(len(file), pairs, file.table.keys)):
            survey.pictures(name, "video", file.frames(run), run, header.codec)
        file.close()
    except EpisodeError as fault:
        survey.fault(name, fault)


def _hands_in(videos: dict[str, Video], chosen: list[str], survey: Survey) -> dict[str, str]:
    """Return the shares of sampled frames with hands; note the sampled videos that show none."""
    from hma_data.sources.hands.detect import MediaPipeHands

    detector = MediaPipeHands(load_models())
    survey.made.add("hands")
    looked = 0
    sides: Counter[str] = Counter()
    for name in chosen:
        try:
            file = VideoFile(videos[name].path)
            frames = np.unique(np.linspace(0, len(file) - 1, FRAMES).astype(np.int64))
            # The frames are far apart, so each is scanned alone and no hand is tracked between them.
            seen = [tuple(scan(file, detector, [index]).sides.tolist()) for index in frames.tolist()]
        except EpisodeError as fault:
            survey.fault(name, fault)
            continue
        looked += len(seen)
        sides["left hand"] += sum(0 in each for each in seen)
        sides["right hand"] += sum(1 in each for each in seen)
        sides["both"] += sum(len(each) == 2 for each in seen)
        if not any(seen):
            said = f"{name}: no hand in {len(seen)} frames looked at"
            survey.note(Finding("hands", "warn", said, key="video", numbers={"frames": len(seen)}))
    return {
        f"frames with {side}": f"{sides[side] / looked:.0%} of {looked} looked at"
        for side in ("left hand", "right hand", "both")
        if looked
    }
