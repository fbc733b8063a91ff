"""Check recordings and shard sets: what is in them, whether an embodiment fits, what will hurt training.

`inspect_recording` reports what a recording holds, and tries one episode as an embodiment's. `examine`
returns findings by severity: for a recording those of its inspection and, with an embodiment, those of a
sample of episodes read and aligned as this robot's; for a shard set those of its integrity and statistics.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.arrays import Array, Float32s, Floats
from hma_data.episodes.align import (
    hold,
    is_off_rate,
    matched,
    measured_hz,
    pause_remedy,
    rate_remedy,
    to_clip,
)
from hma_data.episodes.episode import Clip
from hma_data.episodes.images import describe_resize
from hma_data.episodes.movement import framing
from hma_data.episodes.offset import Offset, measure
from hma_data.errors import EpisodeError, HMAError, SourceError
from hma_data.inspection.infer import proposal
from hma_data.registry.components import Sync
from hma_data.registry.embodiment import ONE_INDEX, Embodiment, find
from hma_data.sources.base import SAMPLE, Inspection, LaidOut, Source, open_source
from hma_data.sources.common.checks import SEVERITIES, Finding, Severity
from hma_data.sources.common.choice import ids_for_robot
from hma_data.sources.common.survey import CHECKS, alike, sampled
from hma_data.sources.detect import detect, of_another_format
from hma_data.storage.paths import StrPath, as_text
from hma_data.storage.remote import is_remote, place

NOT_CHECKED = "not checked"  # the result of a check that the recording does not allow
MAX_TRIED = 20  # episodes tried until one can be read
TOKENIZER_SIDE = 256  # pixels: the side of most tokenizers' images
IMAGE_CHECKS = ("blank", "still", "colour", "size")  # they count only for cameras that are used
MIN_ASTRAY = 0.05  # least share of frames with the action of another frame that is reported
NO_EPISODES = Finding("readable", "error", "the recording has no episodes")


def _inspected(uri: str, robot: Embodiment | None, episodes: int) -> tuple[Source, Inspection]:
    format_name = robot.source.format if robot else detect(uri)
    source = open_source(format_name)
    try:
        if robot and isinstance(source, LaidOut):
            return source, source.inspect_as(uri, robot, episodes)
        return source, source.inspect(uri, episodes)
    except SourceError as fault:
        raise of_another_format(uri, format_name, fault) from fault


def _clips(
    uri: str, robot: Embodiment, source: Source, names: Iterable[str]
) -> Iterator[tuple[str, Clip | HMAError]]:
    """Yield each episode as the robot's clip, whose first and last frames can be decoded, or its fault.

    An error of any kind is a fault, because a conversion refuses such an episode and goes on.
    """
    for name in names:
        found: Clip | HMAError
        try:
            found = to_clip(source.read(uri, name, robot), robot)
            for camera in robot.cameras:
                found.frames_at(camera.name, np.unique([0, len(found) - 1]))
        except MemoryError:
            raise
        except HMAError as fault:
            found = fault
        except Exception as fault:
            text = f"stops its reader with {type(fault).__name__}: {fault}"
            found = EpisodeError(name, text, "report this as a bug of the reader")
        yield name, found


# -- hma inspect


def inspect_recording(
    uri: StrPath, embodiment: StrPath | None = None, episodes: int = SAMPLE
) -> dict[str, Any]:
    """Return the report of `hma inspect` as plain values.

    Args:
        uri: str or path of the recording, or its URI.
        embodiment: id, or str or path of a YAML; with it the first readable episode is aligned and checked.
        episodes: number of episodes to look into, spread evenly over all.

    Raises:
        SourceError: the recording cannot be read at all.
    """
    uri, robot = as_text(uri), find(embodiment) if embodiment else None
    source, inspection = _inspected(uri, robot, episodes)
    found = [one for one in inspection.findings if not (robot and _answered(one, robot))]
    report = inspection.to_json()
    if not inspection.episodes:
        found.append(NO_EPISODES)
    elif robot:
        report["embodiment"] = _fit(uri, robot, source, found)
    else:
        lack, held, offsets = proposal(inspection)
        report["facts"] |= {f"actions {name}": offset.measured for name, offset in offsets.items()}
        found += unanswered(inspection, lack, held, offsets)
    report["findings"] = [finding.to_json() for finding in found]
    report["problems"] = [str(finding) for finding in found if finding.severity != "info"]
    report["checks"] = dict.fromkeys(CHECKS, NOT_CHECKED) | dict.fromkeys(inspection.checks, "ok")
    for finding in sorted(found, key=lambda one: SEVERITIES.index(one.severity)):  # the worst one stays
        report["checks"][finding.check] = finding.severity
    return report


def _fit(uri: str, robot: Embodiment, source: Source, found: list[Finding]) -> dict[str, str]:
    """Return facts on the first episode that the embodiment can read; add the faults to `found`."""
    facts = {"embodiment": f"{robot.id}, {robot.action_dim} action dims"}
    faults: list[HMAError] = []
    names: list[str] = []
    try:
        names = ids_for_robot([ref.id for ref in source.index(uri, robot)], robot)
    except HMAError as fault:
        faults.append(fault)
    for _, clip in _clips(uri, robot, source, names[:MAX_TRIED]):
        if isinstance(clip, Clip):
            break
        faults.append(clip)
    else:
        first = faults[0] if faults else SourceError(uri, "has no episodes")
        found.append(Finding("fits", "error", f"{robot.id} does not fit: {first}"))
        return facts
    if faults:
        said = f"{len(faults)} of the first {len(faults) + 1} episodes cannot be used: {faults[0]}"
        found.append(Finding("usable", "warn", said, numbers={"refused": len(faults)}))
    facts["first episode"] = (
        f"{clip.episode.id}: {len(clip)} frames on the grid, {clip.trimmed} trimmed at its ends"
    )
    shapes = {camera.name: clip.frames_at(camera.name, np.arange(1)).shape[1:] for camera in robot.cameras}
    facts["images"] = "×".join(map(str, shapes[robot.primary_camera.name]))
    for camera in robot.cameras:
        height, width = shapes[camera.name][:2]
        said = describe_resize(camera, height, width, TOKENIZER_SIDE)
        facts[f"camera {camera.name}"] = said.removeprefix(f"{camera.name}: ")
    hz = measured_hz(np.diff(clip.timestamps))
    facts["rate on the grid"] = f"{hz:.3g} Hz" if hz else "unknown"
    for stream, skew in clip.skew_ms.items():
        p50, p95, most = np.percentile(skew, [50, 95, 100])
        facts[f"skew of {stream}"] = f"p50 {p50:.1f} ms, p95 {p95:.1f} ms, max {most:.1f} ms"
    for key, (offset, finding) in judged([clip], robot).items():
        facts[f"actions {key}"] = offset.measured
        found += [finding] if finding else []
    found += [one for one in _times([clip], robot) if one.check == "rate"]
    constant = _constant(clip.actions.std(axis=0), robot)
    return facts | ({"constant in it": "action " + ", ".join(constant)} if constant else {})


def _constant(deviations: Array, robot: Embodiment) -> list[str]:
    """Return the names of actions that never change; in a chunk, one name stands for several columns."""
    names = robot.action.names()
    keys = [part.key for part in robot.action.components for _ in range(part.dims)]
    if len(keys) == len(names):  # two keys may have values of one name
        names = [f"{key}'s {name}" if names.count(name) > 1 else name for key, name in zip(keys, names)]
    return list(dict.fromkeys(names[i % len(names)] for i in np.flatnonzero(deviations == 0)))


def unanswered(
    inspection: Inspection, lack: str, held: dict[str, float], offsets: dict[str, Offset]
) -> Iterator[Finding]:
    """Yield what the YAML of a robot needs and the recording does not have; the rest is as of `proposal`."""
    if lack:
        said = f"the recording {lack}"
        yield Finding(
            "robot", "warn", said, "record cameras and the robot's actions or joint states together"
        )
    for topic, seconds in held.items():
        said = f"{topic}: its last message is {seconds:.3g} s before the first frame, held throughout"
        yield Finding("offset", "warn", said, "do not train on constant actions: use another key", topic)
    if inspection.format in ONE_INDEX and not inspection.hz:
        yield Finding(
            "rate", "info", "the recording states no rate", "state frequency_hz in the robot's YAML"
        )
    # plain `hold` would pair these actions with the frame after theirs
    for name, offset in offsets.items():
        if offset.tolerance_ms and offset.after_ms:
            numbers = {"after_ms": offset.after_ms[0], "tolerance_ms": offset.tolerance_ms}
            said = f"{name} vs {offset.camera}: {offset.said}"
            yield Finding("offset", "info", said, f"set sync: {{{offset.pairing}}}", name, numbers)


# -- actions beside frames


def judged(clips: list[Clip], robot: Embodiment) -> dict[str, tuple[Offset, Finding | None]]:
    """Measure for each action key how actions lie between frames, and judge the YAML's pairing of both.

    Recordings made of steps, and grids of a fixed rate, have no such pairing.
    """
    sync, primary = robot.sync, robot.primary_camera.name
    if robot.source.format != "rosbag" or sync.rate_hz:
        return {}
    found: dict[str, tuple[Offset, Finding | None]] = {}
    for i, component in enumerate(robot.action.components):
        if component.key in found:
            continue  # a slice of the same values
        runs = [
            (clip.episode.actions[i].timestamps, clip.episode.streams[primary].timestamps) for clip in clips
        ]
        offset = measure(runs, primary)
        if offset:
            found[component.key] = offset, _astray(component.key, offset, runs, sync)
    return found


def _astray(key: str, offset: Offset, runs: list[tuple[Floats, Floats]], sync: Sync) -> Finding | None:
    """Return a finding where the YAML gives frames the actions of other frames."""
    if offset.after_ms is None or sync.actions == "interpolate":
        return None
    apart: list[Floats] = []
    for times, frames in runs:
        running = frames[(frames >= times[0]) & (frames <= times[-1])]
        own = hold(times, running, offset.tolerance_ms / 1e3)[0]
        given = matched(sync.actions, times, running, (sync.tolerance_ms or 0) / 1e3)[0]
        apart.append(times[given] - times[own])
    off = np.concatenate(apart)
    for side, share in (("before", float(np.mean(off < 0))), ("after", float(np.mean(off > 0)))):
        if share >= MIN_ASTRAY:
            stated = sync.actions + (f", tolerance_ms {sync.tolerance_ms:g}" if sync.tolerance_ms else "")
            fault = f"{share:.0%} of frames get the action of the frame {side} them"
            said = f"{key}: {fault} by actions: {stated}; {offset.said}"
            without = "" if offset.tolerance_ms else " without tolerance_ms"
            remedy = f"set sync: {{{offset.pairing}}}{without}"
            return Finding("offset", "warn", said, remedy, key, {"share": share})
    return None


# -- hma doctor


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


def _recording(uri: str, robot: Embodiment | None, sample: int) -> Iterator[Finding]:
    try:
        source, inspection = _inspected(uri, robot, sample)
    except HMAError as fault:
        yield Finding("readable", "error", str(fault))
        return
    if not inspection.episodes:
        yield NO_EPISODES
    elif robot is None:
        cameras = {info.key for info in inspection.keys if len(info.shape) == 3}
        blank = {finding.key for finding in inspection.findings if finding.check == "blank"}
        for finding in inspection.findings:  # a blank camera warns where no other is there to be used
            warns = finding.check == "blank" and cameras <= blank
            yield replace(finding, severity="warn") if warns else finding
        yield from unanswered(inspection, *proposal(inspection))
    else:
        yield from _for_robot(inspection, robot)
        yield from _episodes(uri, robot, source, sample, inspection)


def _answered(finding: Finding, robot: Embodiment) -> bool:
    """Check whether the YAML answers a finding: it pairs by index, has labels, or names the models."""
    layout = robot.source.layout or {}
    if finding.check == "hands":
        return "models" in layout or layout.get("labels", "detector") != "detector"
    return layout.get("pairing") == "index" and finding.check in ("skew", "rate")


def _for_robot(inspection: Inspection, robot: Embodiment) -> Iterator[Finding]:
    """Yield the inspection's findings that concern what this robot uses.

    Findings on constants are left out: `_numbers` reports them later, with the robot's names.
    """
    cameras = {camera.key: camera for camera in robot.cameras}
    for finding in inspection.findings:
        if finding.check == "constant" or _answered(finding, robot):
            continue
        if finding.check in IMAGE_CHECKS:
            camera = cameras.get(finding.key)
            if camera is None or (finding.check == "colour" and camera.color == "bgr"):
                continue
            finding = replace(finding, message=f"camera {camera.name}, {finding.message}")
        yield replace(finding, severity="warn") if finding.check == "blank" else finding
    for info in inspection.keys:
        camera = cameras.get(info.key)
        if camera and camera.size and len(info.shape) == 3 and tuple(info.shape[:2]) != tuple(camera.size):
            size, stated = list(info.shape[:2]), list(camera.size)
            said = f"camera {camera.name} is {size} pixels, its YAML says {stated}"
            yield Finding("size", "info", said, key=camera.key)
        upright = camera and not camera.flip and not camera.rotate
        box = info.moves_in if upright else None
        if camera and box and (framed := framing(camera, box, *info.shape[:2])):
            said = f"camera {camera.name}: {framed.fault}"
            yield Finding("crop", "warn", said, f"set {framed.words} in the YAML", camera.key)
        if camera and camera.color == "bgr" and info.swapped == "no":
            said = f"camera {camera.name} is stored with red first, its YAML says bgr"
            yield Finding("colour", "warn", said, "set color: rgb", camera.key)


def _episodes(
    uri: str, robot: Embodiment, source: Source, sample: int, inspection: Inspection
) -> Iterator[Finding]:
    try:
        names = ids_for_robot([ref.id for ref in source.index(uri, robot)], robot)
    except HMAError as fault:
        yield Finding("usable", "error", f"none of its episodes: {fault.fault}", fault.remedy)
        return
    chosen = [names[i] for i in sampled(len(names), sample)]
    refused: list[tuple[str, HMAError]] = []
    clips: list[Clip] = []
    for name, found in _clips(uri, robot, source, chosen):
        if isinstance(found, Clip):
            clips.append(found)
        else:
            refused.append((name, found))
    severity: Severity = "warn" if clips else "error"
    for which, first in alike(refused):
        said = f"{len(which)} of {len(chosen)} sampled episodes, such as {which[0]}: {first.fault}"
        numbers = {"refused": len(which), "looked_at": len(chosen)}
        yield Finding("usable", severity, said, first.remedy, numbers=numbers)
    if clips:
        told = any(one.check == "gaps" and one.key == robot.primary_camera.key for one in inspection.findings)
        yield from (one for one in _times(clips, robot) if not (told and one.check == "gaps"))
        yield from (finding for _, finding in judged(clips, robot).values() if finding)
        yield from _numbers(np.concatenate([clip.actions for clip in clips]), robot)
        yield from _states_as_actions(clips, robot)


def _states_as_actions(clips: list[Clip], robot: Embodiment) -> Iterator[Finding]:
    """Yield a finding where actions are no commands, but the state of the same frame."""
    recorded = [clip.states for clip in clips if clip.states is not None]
    if not recorded:
        return
    states, actions = np.concatenate(recorded), np.concatenate([clip.actions for clip in clips])
    moved = np.flatnonzero(actions.std(axis=0) > 0)
    same = [i for i in moved if (states == actions[:, i : i + 1]).all(axis=0).any()]
    if same:
        names = robot.action.names()
        said = f"equal the state of the same frame throughout: {', '.join(names[i] for i in same)}"
        remedy = "name the key of the commanded actions"
        if robot.source.format in ONE_INDEX:
            remedy += "; where none is recorded, sync: {action_shift: 1} takes the state of the next step"
        yield Finding("action", "warn", f"actions {said}", remedy)


def _times(clips: list[Clip], robot: Embodiment) -> Iterator[Finding]:
    from hma_data.shards.windows import WINDOW

    steps = np.concatenate([np.diff(clip.timestamps) for clip in clips])
    hz = measured_hz(steps)
    if hz and is_off_rate(hz, robot):
        said = f"the aligned frames have {hz:.3g} Hz, the YAML says {robot.rate_hz:g}"
        numbers = {"hz": hz, "stated_hz": robot.rate_hz}
        yield Finding("rate", "error", said, rate_remedy(robot), numbers=numbers)
    if hz and (steps > 3 / hz).any():
        said = f"frames pause for up to {steps.max():.3g} s; no window crosses pauses of a model step or more"
        yield Finding("gaps", "warn", said, pause_remedy(robot, hz))
    lengths = sorted(len(clip) for clip in clips)
    known = robot.states_rate or robot.stride_override  # else no stride, and so no window
    needed = WINDOW * robot.stride if known else 0  # the chunk of the last frame too
    short = sum(length < needed for length in lengths)
    if short:
        said = f"{short} of {len(clips)} episodes are shorter than a window, {needed} frames"
        fits = max(lengths[len(lengths) // 10] // WINDOW, 1)  # nine of ten episodes hold a window
        remedy = "set a smaller stride"
        if not robot.stride_override:
            remedy = f"set a higher target_hz, such as {robot.rate_hz / fits:.3g}"
        yield Finding("length", "warn", said, f"{remedy}, or fewer frames per window")
    for stream in dict.fromkeys(name for clip in clips for name in clip.skew_ms):
        moved = [clip.skew_ms[stream] for clip in clips if stream in clip.skew_ms]
        late = float(np.percentile(np.concatenate(moved), 95))
        if hz and late > 1e3 / hz:
            yield Finding("skew", "warn", f"{stream} was moved by {late:.1f} ms or more in 5 % of frames")


def _numbers(actions: Float32s, robot: Embodiment) -> Iterator[Finding]:
    names = robot.action.names()
    spread = actions.std(axis=0)
    if constant := _constant(spread, robot):
        said = f"never change in the sampled episodes: {', '.join(constant)}"
        yield Finding("constant", "warn", said, "remove them from the YAML if they never change")
    with np.errstate(divide="ignore", invalid="ignore"):
        far = (np.abs(actions - np.median(actions, axis=0)) / spread > 30).any(axis=0)
    wild = [f"{names[i]} {actions[:, i].min():.4g} to {actions[:, i].max():.4g}" for i in np.flatnonzero(far)]
    if wild:
        yield Finding("outliers", "warn", f"values more than 30 deviations off: {', '.join(wild)}")
    for part, span in robot.action.spans():
        values = actions[:, span]
        low, high = values.min(initial=np.inf), values.max(initial=-np.inf)
        if part.range and values.size and not part.range[0] <= low <= high <= part.range[1]:
            said = f"{part.key} lies in {low:.4g} to {high:.4g}, its range says {list(part.range)}"
            yield Finding("range", "warn", said, "correct the range, or the slice and key")
        if part.unit == "rad" and max(-low, high) > 4 * np.pi:
            said = f"{part.key} in rad reaches {max(-low, high):.4g}"
            yield Finding("unit", "warn", said, "are these degrees?")


def _shard_set(folder: Path) -> Iterator[Finding]:
    from hma_data.inspection.shard_findings import (
        kept_findings,
        pause_finding,
        picture_findings,
        rate_finding,
        window_finding,
    )
    from hma_data.shards.reader import ShardSet
    from hma_data.shards.verify import verify

    wrong = verify(folder)
    for problem in wrong:
        yield Finding("integrity", "error", problem)
    if wrong:
        return
    shards = ShardSet(folder)
    manifest = shards.manifest
    if manifest.quarantined:
        said = f"{manifest.quarantined:,} episodes refused, {manifest.episodes:,} kept"
        yield Finding("quarantine", "warn", f"{said}; reasons in quarantine.jsonl")
    if not manifest.splits["train"]["episodes"]:
        yield Finding("split", "error", "no episode is in the train split")
    elif short := window_finding(shards):
        yield short
    if not manifest.splits["val"]["episodes"]:
        yield Finding("split", "warn", "no episode is in the val split", "convert more than one episode")
    deviations = np.asarray(manifest.stats["action"]["std"], np.float64)
    if constant := _constant(deviations, manifest.embodiment):
        yield Finding("constant", "warn", f"never change: {', '.join(constant)}")
    if off_rate := rate_finding(shards):
        yield off_rate
    if paused := pause_finding(shards):
        yield paused
    yield from picture_findings(shards)
    yield from kept_findings(shards)
