"""Inspect a recording: report what is in it, and whether an embodiment fits it."""

from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any

import numpy as np

from hma_data.episodes.align import to_clip
from hma_data.episodes.episode import Clip
from hma_data.errors import HMAError, SourceError
from hma_data.registry.embodiment import Embodiment, find
from hma_data.sources.base import SAMPLE, Inspection, Source, detect, of_another_format, open_source
from hma_data.sources.common.checks import SEVERITIES, Finding
from hma_data.sources.common.survey import CHECKS
from hma_data.storage.paths import StrPath, as_text

TRIED = 20  # episodes tried until one can be read


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
    source = open_source(robot.source.format if robot else detect(uri))
    try:
        inspection = source.inspect(uri, episodes)
    except SourceError as fault:
        raise of_another_format(uri, robot.source.format if robot else detect(uri), fault) from fault
    found = list(inspection.findings)
    facts: dict[str, str] = {}
    if robot:
        facts = _fit(uri, robot, source, inspection, found)
    report = inspection.to_json()
    report["findings"] = [finding.to_json() for finding in found]
    report["problems"] = [str(finding) for finding in found if finding.severity != "info"]
    report["checks"] = results(inspection.checks, found)
    return report | ({"embodiment": facts} if robot else {})


def results(made: Iterable[str], found: Iterable[Finding]) -> dict[str, str]:
    """Return the result of each check: ok, the worst severity found, or "not looked at" where impossible."""
    told = dict.fromkeys(CHECKS, "not looked at") | dict.fromkeys(made, "ok")
    for finding in sorted(found, key=lambda one: SEVERITIES.index(one.severity)):
        told[finding.check] = finding.severity
    return told


def _fit(
    uri: str, robot: Embodiment, source: Source, inspection: Inspection, found: list[Finding]
) -> dict[str, str]:
    """Return facts on the first episode that the embodiment can read; add the faults to `found`."""
    facts = {"embodiment": f"{robot.id}, {robot.action_dim} action dims"}
    faults: list[HMAError] = []
    names: list[str] = []
    try:
        names = [ref.id for ref in source.index(uri, robot)]
    except HMAError as fault:
        faults.append(fault)
    for name in names[:TRIED]:
        try:
            clip = to_clip(source.read(uri, name, robot), robot)
            pictures = clip.frames_at(robot.primary_camera.name, np.arange(min(len(clip), 2)))
            break
        except HMAError as fault:
            faults.append(fault)
    else:
        first = faults[0] if faults else SourceError(uri, "has no episodes")
        said = f"{robot.id} does not fit: {first}{_alike(robot, inspection)}"
        found.append(Finding("fits", "error", said))
        return facts
    if faults:
        said = f"{len(faults)} of the first {len(faults) + 1} episodes cannot be used: {faults[0]}"
        found.append(Finding("usable", "warn", said, numbers={"refused": len(faults)}))
    facts["first episode"] = f"{name}: {len(clip)} frames on the grid, {clip.trimmed} trimmed at its ends"
    facts["pictures"] = "×".join(map(str, pictures.shape[1:]))
    return facts | _measured(clip, robot, found)


def _alike(robot: Embodiment, inspection: Inspection) -> str:
    """Return a hint with recorded keys whose names are near to those that the YAML names."""
    known = [key.key for key in inspection.keys]
    wanted = [camera.key for camera in robot.cameras] + [part.key for part in robot.action.components]
    missing = [key for key in wanted if key not in known and not key.startswith("/")]
    near = [alike for key in missing for alike in get_close_matches(key, known, n=2)]
    return f" (recorded keys like it: {', '.join(near)})" if near else ""


def _measured(clip: Clip, robot: Embodiment, found: list[Finding]) -> dict[str, str]:
    """Return rate, skew and constant actions of the clip; add a rate other than the YAML's to `found`."""
    intervals = np.diff(clip.timestamps)
    measured = 1 / float(np.median(intervals)) if len(intervals) and np.median(intervals) > 0 else None
    facts = {"rate on the grid": f"{measured:.3g} Hz" if measured else "unknown"}
    for stream, skew in clip.skew_ms.items():
        p50, p95, most = np.percentile(skew, [50, 95, 100])
        facts[f"skew of {stream}"] = f"p50 {p50:.1f} ms, p95 {p95:.1f} ms, max {most:.1f} ms"
    if measured and isinstance(robot.frequency_hz, float) and abs(measured / robot.rate_hz - 1) > 0.1:
        said = f"{robot.id} says {robot.rate_hz:g} Hz, the recording's grid ticks at {measured:.3g} Hz"
        found.append(Finding("rate", "warn", said, numbers={"hz": measured, "stated_hz": robot.rate_hz}))
    constant = np.flatnonzero(clip.actions.std(axis=0) == 0)
    if len(constant):
        names = robot.action.names()
        facts["constant in it"] = "action " + ", ".join(names[i] for i in constant)
    return facts
