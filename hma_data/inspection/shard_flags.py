"""Report what a conversion flagged in a shard set: rates, pauses, blank and still cameras, short episodes.

The flags are set by `hma_data.episodes.align.rate_flags` and `hma_data.episodes.images.picture_flags`.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pyarrow.compute as pc

from hma_data.episodes.align import OFF_RATE, PAUSE, PAUSED, measured_hz, pause_remedy, rate_remedy
from hma_data.shards.reader import EpisodeReader, ShardSet
from hma_data.sources.common.checks import Finding, Severity
from hma_data.sources.common.survey import listed

MAX_LOST_SHARE = 0.1  # share of the windows above which the loss is a warning
MAX_MEASURED = 20  # flagged episodes of which the first with more than one row is measured


def rate_finding(shards: ShardSet) -> Finding | None:
    """Return a finding with the stated and a measured rate; None where no episode is flagged.

    It is an error where more than half of the episodes are flagged, because the stride is then wrong.
    """
    episodes = shards.episodes
    flagged = episodes.filter(pc.match_substring(episodes["flags"], f"{OFF_RATE}="))
    if not len(flagged):
        return None
    robot, count, total = shards.embodiment, len(flagged), len(episodes)
    which, hz = next(_measured(shards, flagged[:MAX_MEASURED].to_pylist()), ("", None))
    said = f"{count:,} of {total:,} episodes have another rate than the stated {robot.rate_hz:g} Hz"
    said += f", such as {which} with {hz:.3g} Hz" if hz else ""
    remedy = f"{rate_remedy(robot)}, and convert again with --overwrite"
    numbers = {"episodes": count, "hz": hz, "stated_hz": robot.rate_hz}
    return Finding("rate", "error" if count > total / 2 else "warn", said, remedy, numbers=numbers)


def pause_finding(shards: ShardSet) -> Finding | None:
    """Return a finding on the windows that pauses cost; None where no episode is flagged.

    It is a warning where they cost more than a tenth of the windows.
    """
    from hma_data.shards.windows import WINDOW, WindowIndex

    episodes = shards.episodes
    flagged = episodes.filter(pc.match_substring(episodes["flags"], f"{PAUSED}="))
    if not len(flagged):
        return None
    count, which = len(flagged), flagged["id"][0].as_py()
    whole = int(np.maximum(0, shards.index("train").length - WINDOW * shards.row_stride + 1).sum())
    lost = whole - WindowIndex.of(shards, "train", WINDOW).count
    said = f"{count:,} of {len(episodes):,} episodes have a pause of {PAUSE:g} steps or more, such as {which}"
    said += f"; {lost:,} of {whole:,} training windows would cross one and are left out" if lost else ""
    hz = next((hz for _, hz in _measured(shards, flagged[:MAX_MEASURED].to_pylist())), None)
    severity: Severity = "warn" if lost > MAX_LOST_SHARE * whole else "info"
    numbers = {"episodes": count, "windows": lost}
    return Finding("gaps", severity, said, pause_remedy(shards.embodiment, hz), numbers=numbers)


def window_finding(shards: ShardSet) -> Finding | None:
    """Return a finding where no training episode is as long as a window; None otherwise."""
    from hma_data.shards.windows import WINDOW, WindowIndex

    if not shards.manifest.splits["train"]["episodes"] or WindowIndex.of(shards, "train", WINDOW).count:
        return None
    lengths = np.sort(shards.index("train").length)
    rows, longest, usual = WINDOW * shards.row_stride, int(lengths[-1]), int(lengths[len(lengths) // 10])
    said = f"no window to train on: {WINDOW} frames need {rows} rows, the longest episode has {longest}"
    fits, frames, remedies = max(usual // WINDOW, 1), longest // shards.row_stride, []  # as `hma doctor -e`
    if longest >= WINDOW and fits < shards.row_stride:
        hz = shards.embodiment.rate_hz / shards.manifest.frame_stride / fits
        remedies.append(f"set target_hz: {hz:.3g} in its YAML and convert again with --overwrite")
    if frames > 1:
        remedies.append(f"train with windows of fewer frames (frames={frames})")
    return Finding("windows", "error", said, ", or ".join(remedies) or "record longer episodes")


def picture_findings(shards: ShardSet) -> Iterator[Finding]:
    """Yield a finding for each camera that shows one colour, or one image, throughout some episodes."""
    episodes = shards.episodes
    for camera in shards.manifest.cameras:
        for check, shown in (("blank", "one colour"), ("still", "one image")):
            flagged = episodes.filter(pc.match_substring(episodes["flags"], f"{check}_pictures:{camera}="))
            if not len(flagged):
                continue
            ids = flagged["id"].to_pylist()
            said = f"camera {camera} shows {shown} throughout in {len(ids):,} of {len(episodes):,} episodes"
            remedy = "look at them with hma shards preview --only ID; hma convert --exclude leaves them out"
            yield Finding(check, "warn", f"{said}: {listed(ids)}", remedy, camera, {"episodes": ids})


def _measured(shards: ShardSet, rows: list[dict[str, Any]]) -> Iterator[tuple[str, float]]:
    """Yield the id and the rate in Hz of each episode that has more than one row."""
    reader = EpisodeReader(shards, ["timestamp"])
    for row in rows:
        times = reader.rows(row["shard"], row["row_start"], row["length"])["timestamp"]
        if hz := measured_hz(np.diff(times)):
            yield row["id"], hz * shards.manifest.frame_stride
