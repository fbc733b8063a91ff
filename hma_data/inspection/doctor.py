"""Check recordings and shard sets for what will hurt training, by severity.

For a recording, the checks are those of its inspection. With an embodiment, a sample of the episodes is also
read and aligned as this robot's, and checked. For a shard set, the checks cover its integrity and its
statistics.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.align import to_clip
from hma_data.episodes.episode import Clip
from hma_data.errors import HMAError, SourceError
from hma_data.registry.components import Camera
from hma_data.registry.embodiment import Embodiment, find
from hma_data.sources.base import SAMPLE, Inspection, detect, of_another_format, open_source
from hma_data.sources.common.checks import SEVERITIES, Finding, Severity
from hma_data.sources.common.survey import sampled
from hma_data.storage.paths import StrPath, as_text
from hma_data.storage.remote import is_remote, place

WINDOW = 12  # frames of the model's window, by default
LOOKS = ("blank", "still", "colour", "size")  # checks of pictures; they count only for cameras that are used


def examine(target: StrPath, embodiment: StrPath | None = None, sample: int = SAMPLE) -> list[Finding]:
    """Return all findings of the checks, worst first.

    Args:
        target: str or path (or URI) of a recording, or of the folder of a shard set.
        embodiment: id, or str or path of a YAML; with it a recording's episodes are read and aligned as this
            robot's.
        sample: number of episodes to look into, evenly spaced.

    Raises:
        RegistryError: there is no such embodiment.
    """
    target = as_text(target)
    if _is_shard_set(target):
        found = list(_shard_set(place(target)))
    else:
        found = list(_recording(target, find(embodiment) if embodiment else None, sample))
    return sorted(found, key=lambda finding: -SEVERITIES.index(finding.severity))


def _is_shard_set(target: str) -> bool:
    try:
        folder = place(target)
        if (folder / "manifest.json").is_file():
            return True
        return not is_remote(folder) and any(folder.glob("train/shard-*.parquet"))  # an unfinished set
    except HMAError:
        return False  # a scheme that only a source knows


# -- recordings


def _recording(uri: str, robot: Embodiment | None, sample: int) -> Iterator[Finding]:
    try:
        source = open_source(robot.source.format if robot else detect(uri))
        inspection = source.inspect(uri, sample)
    except SourceError as fault:
        stated = robot.source.format if robot else ""
        yield Finding("readable", "error", str(of_another_format(uri, stated, fault) if stated else fault))
        return
    except HMAError as fault:
        yield Finding("readable", "error", str(fault))
        return
    if not inspection.episodes:
        yield Finding("episodes", "error", "the recording has no episodes")
    elif robot is None:
        yield from inspection.findings
    else:
        yield from _for_robot(inspection, robot)
        yield from _episodes(uri, robot, sample, inspection)


def _for_robot(inspection: Inspection, robot: Embodiment) -> Iterator[Finding]:
    """Yield the inspection's findings that concern what this robot uses.

    Findings on constants are left out: `_numbers` reports them later, with the robot's names.
    """
    cameras = {camera.key: camera for camera in robot.cameras}
    for finding in inspection.findings:
        if finding.check == "constant":
            continue
        if finding.check in LOOKS:
            camera = cameras.get(finding.key)
            if camera is None or (finding.check == "colour" and camera.color == "bgr"):
                continue
            finding = replace(finding, message=f"camera {camera.name}, {finding.message}")
        yield replace(finding, severity="warn") if finding.check == "blank" else finding
    for info in inspection.keys:
        if info.key in cameras:
            yield from _as_stated(cameras[info.key], info.shape, info.swapped)


def _as_stated(camera: Camera, shape: tuple[int, ...], swapped: str | None) -> Iterator[Finding]:
    """Compare a camera's size and colours with its YAML."""
    if camera.size and len(shape) == 3 and tuple(shape[:2]) != tuple(camera.size):
        said = f"camera {camera.name} is {list(shape[:2])} pixels, its YAML says {list(camera.size)}"
        yield Finding("size", "info", said, key=camera.key)
    if camera.color == "bgr" and swapped == "no":
        said = f"camera {camera.name} is stored in order, red first; its YAML says bgr"
        yield Finding("colour", "warn", said, "color: rgb", camera.key)


def _episodes(uri: str, robot: Embodiment, sample: int, inspection: Inspection) -> Iterator[Finding]:
    source = open_source(robot.source.format)
    try:
        names = [ref.id for ref in source.index(uri, robot)]
    except HMAError as fault:
        yield Finding("usable", "error", f"none of its episodes: {fault.fault}", fault.remedy)
        return
    chosen = [names[i] for i in sampled(len(names), sample)]
    refused: dict[tuple[str, str], list[str]] = {}
    clips: list[Clip] = []
    for name in chosen:
        try:
            clip = to_clip(source.read(uri, name, robot), robot)
            for camera in robot.cameras:  # can they be decoded? the inspection judged the pictures
                clip.frames_at(camera.name, np.array([len(clip) - 1]))
            clips.append(clip)
        except HMAError as fault:
            refused.setdefault((fault.fault, fault.remedy), []).append(name)
    for (reason, remedy), which in sorted(refused.items(), key=lambda item: -len(item[1]))[:5]:
        severity: Severity = "warn" if clips else "error"
        said = f"{len(which)} of {len(chosen)} episodes looked at, such as {which[0]}: {reason}"
        numbers = {"refused": len(which), "looked_at": len(chosen)}
        yield Finding("usable", severity, said, remedy, numbers=numbers)
    if clips:
        told = any(one.check == "gaps" and one.key == robot.primary_camera.key for one in inspection.findings)
        yield from (one for one in _times(clips, robot) if not (told and one.check == "gaps"))
        yield from _numbers(np.concatenate([clip.actions for clip in clips]), robot)


def _times(clips: list[Clip], robot: Embodiment) -> Iterator[Finding]:
    steps = np.concatenate([np.diff(clip.timestamps) for clip in clips])
    period = float(np.median(steps)) if len(steps) else 0.0
    if period > 0 and abs(period * robot.rate_hz - 1) > 0.1:
        said = f"the grid ticks at {1 / period:.3g} Hz, the YAML says {robot.rate_hz:g}"
        yield Finding("rate", "error", said, "correct frequency_hz, or sync.rate_hz")
    if period > 0 and (steps > 3 * period).any():
        yield Finding("gaps", "warn", f"frames pause for up to {steps.max():.3g} s", "split or trim there")
    needed = (WINDOW - 1) * robot.stride + 1
    short = sum(len(clip) < needed for clip in clips)
    if short:
        said = f"{short} of {len(clips)} episodes are shorter than a window, {needed} frames"
        yield Finding("length", "warn", said, "a higher target_hz, or fewer frames a window")
    for stream in dict.fromkeys(name for clip in clips for name in clip.skew_ms):
        moved = [clip.skew_ms[stream] for clip in clips if stream in clip.skew_ms]
        late = float(np.percentile(np.concatenate(moved), 95))
        if period > 0 and late > 1e3 * period:
            yield Finding("skew", "warn", f"{stream} was moved by {late:.1f} ms or more in 5 % of frames")


def _numbers(actions: NDArray[np.float32], robot: Embodiment) -> Iterator[Finding]:
    names = robot.action.names()
    spread = actions.std(axis=0)
    constant = [names[i] for i in np.flatnonzero(spread == 0)]
    if constant:
        said = f"never change in the episodes looked at: {', '.join(constant)}"
        yield Finding("constant", "warn", said, "leave them out, if they never do")
    with np.errstate(divide="ignore", invalid="ignore"):
        far = np.abs(actions - np.median(actions, axis=0)) / spread
    wild = [f"{names[i]} {actions[:, i].min():.4g} to {actions[:, i].max():.4g}" for i in _columns(far > 30)]
    if wild:
        yield Finding("outliers", "warn", f"values more than 30 deviations off: {', '.join(wild)}")
    at = 0
    for part in robot.action.components:
        values = actions[:, at : at + part.dims]
        at += part.dims
        if part.range and values.size and not part.range[0] <= values.min() <= values.max() <= part.range[1]:
            lies = f"{values.min():.4g} to {values.max():.4g}"
            said = f"{part.key} lies in {lies}, its range says {list(part.range)}"
            yield Finding("range", "warn", said, "correct range, or slice and key")
        if part.unit == "rad" and np.abs(values).max(initial=0) > 4 * np.pi:
            said = f"{part.key} in rad reaches {np.abs(values).max():.4g}"
            yield Finding("unit", "warn", said, "are these degrees?")


def _columns(wrong: NDArray[np.bool_]) -> list[int]:
    return [int(i) for i in np.flatnonzero(wrong.any(axis=0))]


# -- shard sets


def _shard_set(folder: Path) -> Iterator[Finding]:
    from hma_data.shards.manifest import Manifest
    from hma_data.shards.verify import verify

    wrong = verify(folder)
    for problem in wrong:
        yield Finding("integrity", "error", problem)
    if wrong:
        return
    manifest = Manifest.load(folder)
    kept = sum(split["episodes"] for split in manifest.splits.values())
    if manifest.quarantined:
        said = f"{manifest.quarantined:,} episodes beside {kept:,} kept; reasons in quarantine.jsonl"
        yield Finding("quarantine", "warn", said)
    if not manifest.splits["train"]["episodes"]:
        yield Finding("split", "error", "no episode is in the train split")
    if not manifest.splits["val"]["episodes"]:
        yield Finding("split", "warn", "no episode is in the val split", "convert more than one episode")
    deviations = np.asarray(manifest.stats["action"]["std"], np.float64)
    names = manifest.embodiment.action.names()
    constant = [names[i % len(names)] for i in np.flatnonzero(deviations == 0)]
    if constant:
        yield Finding("constant", "warn", f"never change: {', '.join(dict.fromkeys(constant))}")
