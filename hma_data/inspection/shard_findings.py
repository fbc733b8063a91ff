"""Report what in a shard set will hurt training.

Rates, pauses, and blank or still cameras were flagged by the conversion (`hma_data.episodes.align.rate_flags`
and `hma_data.episodes.images.picture_flags`). How well the tokens keep what moves is measured here.
"""

from collections.abc import Iterator

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hma_data.episodes.align import OFF_RATE, PAUSE, PAUSED, measured_hz, pause_remedy, rate_remedy
from hma_data.episodes.images import prepare, upright
from hma_data.episodes.movement import Kept, MovingPart, framing
from hma_data.errors import HMAError
from hma_data.registry.components import Camera
from hma_data.shards.preview import tokenizer_of
from hma_data.shards.reader import EpisodeReader, ShardSet
from hma_data.shards.recorded import Recorded
from hma_data.shards.schema import token_column
from hma_data.shards.windows import WINDOW, WindowIndex
from hma_data.sources.common.checks import Finding, Severity
from hma_data.sources.common.survey import listed, sampled
from hma_data.storage.paths import StrPath

MAX_LOST_SHARE = 0.1  # share of the windows above which the loss is a warning
MAX_MEASURED = 20  # flagged episodes of which the first with more than one row is measured


def rate_finding(shards: ShardSet) -> Finding | None:
    """Return a finding with the stated and a measured rate; None where no episode is flagged.

    It is an error where more than half of the episodes are flagged, because the stride is then wrong.
    """
    flagged = _flagged(shards, OFF_RATE)
    if not len(flagged):
        return None
    robot, count, total = shards.embodiment, len(flagged), len(shards.episodes)
    which, hz = _measured(shards, flagged)
    said = f"{count:,} of {total:,} episodes have another rate than the stated {robot.rate_hz:g} Hz"
    said += f", such as {which} with {hz:.3g} Hz" if hz else ""
    remedy = f"{rate_remedy(robot)}, and convert again with --overwrite"
    numbers = {"episodes": count, "hz": hz, "stated_hz": robot.rate_hz}
    return Finding("rate", "error" if count > total / 2 else "warn", said, remedy, numbers=numbers)


def pause_finding(shards: ShardSet) -> Finding | None:
    """Return a finding on the windows that pauses cost; None where no episode is flagged.

    It is a warning where they cost more than a tenth of the windows.
    """
    flagged, total = _flagged(shards, PAUSED), len(shards.episodes)
    if not len(flagged):
        return None
    count, which = len(flagged), flagged["id"][0].as_py()
    whole = int(np.maximum(0, shards.index("train").length - WINDOW * shards.row_stride + 1).sum())
    lost = whole - WindowIndex.of(shards, "train", WINDOW).count
    said = f"{count:,} of {total:,} episodes have a pause of {PAUSE:g} steps or more, such as {which}"
    said += f"; {lost:,} of {whole:,} training windows would cross one and are left out" if lost else ""
    _, hz = _measured(shards, flagged)
    severity: Severity = "warn" if lost > MAX_LOST_SHARE * whole else "info"
    numbers = {"episodes": count, "windows": lost}
    return Finding("gaps", severity, said, pause_remedy(shards.embodiment, hz), numbers=numbers)


def window_finding(shards: ShardSet) -> Finding | None:
    """Return a finding where no training episode is as long as a window; None otherwise."""
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
    total = len(shards.episodes)
    for camera in shards.manifest.cameras:
        for check, shown in (("blank", "one colour"), ("still", "one image")):
            ids = _flagged(shards, f"{check}_pictures:{camera}")["id"].to_pylist()
            if ids:
                said = f"camera {camera} shows {shown} throughout in {len(ids):,} of {total:,} episodes"
                remedy = (
                    "look at them with hma shards preview --only ID; hma convert --exclude leaves them out"
                )
                yield Finding(check, "warn", f"{said}: {listed(ids)}", remedy, camera, {"episodes": ids})


def _flagged(shards: ShardSet, flag: str) -> pa.Table:
    """Return the episodes of the set that have a flag."""
    return shards.episodes.filter(pc.match_substring(shards.episodes["flags"], f"{flag}="))


def _measured(shards: ShardSet, episodes: pa.Table) -> tuple[str, float | None]:
    """Return the id and the rate in Hz of the first episode that has more than one row."""
    reader = EpisodeReader(shards, ["timestamp"])
    for row in episodes[:MAX_MEASURED].to_pylist():
        times = reader.rows(row["shard"], row["row_start"], row["length"])["timestamp"]
        if hz := measured_hz(np.diff(times)):
            return row["id"], hz * shards.manifest.frame_stride
    return "", None


# -- how well the tokens keep what moves

EPISODES, FRAMES = 3, 12  # episodes compared, and frames of each, evenly spaced


def kept_findings(shards: ShardSet, weights: StrPath | None = None, device: str = "cpu") -> Iterator[Finding]:
    """Yield for each camera how well what moves is kept by the tokens, in a few episodes of all splits.

    It is a warning where the moving parts are lost, or where the crop cuts them off. Where the recording or
    the tokenizer is not at hand, one finding says so.

    Args:
        weights, device: of the tokenizer, as `get_tokenizer` takes them.
    """
    rows, spec = shards.episodes.take(sampled(len(shards.episodes), EPISODES)).to_pylist(), shards.spec
    try:
        opened = tokenizer_of(shards, weights, device)
        recorded = [(row, Recorded(shards, row)) for row in rows]
        for name in shards.manifest.cameras:
            kept, part = Kept(), MovingPart()
            camera, reader = shards.embodiment.camera(name), EpisodeReader(shards, shards.columns([name]))
            for row, recording in recorded:
                picks = np.array(sampled(row["length"], FRAMES))
                tokens = reader.episode(row, name)[token_column(spec)[0]][picks]
                raw = recording.raw(name, picks)
                seen = prepare(raw, camera, spec.image_size, spec.resize_filter)
                kept.add(seen, opened.decode(shards.tokens(tokens)))
                part.add(upright(raw, camera))
            yield _finding(camera, kept, part)
    except (HMAError, OSError, ImportError) as fault:
        said = f"token quality was not measured: {' '.join(str(fault).split())}"
        yield Finding("tokens", "info", said)


def _finding(camera: Camera, kept: Kept, part: MovingPart) -> Finding:
    """Return what was measured of a camera, and what to do where the robot is lost."""
    framed = framing(camera, part.box, *part.size)
    said = f"camera {camera.name}: {kept}"
    numbers = {"moving_share": kept.share, "psnr_moving_db": kept.psnr_db, "change_shown": kept.change_shown}
    if not kept.lost and not (framed and framed.cut_off):
        return Finding("tokens", "info", said, key=camera.key, numbers=numbers)
    said += "; the tokenizer does not reconstruct the robot" if kept.lost else ""
    said += f"; {framed.fault}" if framed else ""
    remedy = f"set {framed.words} in the YAML" if framed else "use another tokenizer, see hma tokenizer list"
    remedy += ", and convert again with --overwrite; hma shards preview shows both"
    return Finding("tokens", "warn", said, remedy, camera.key, numbers)
