"""What is in a recording, and whether an embodiment fits it."""

from difflib import get_close_matches
from typing import Any

import numpy as np

from hma_data.align import to_clip
from hma_data.embodiment import Embodiment, find
from hma_data.errors import HMAError, SourceError
from hma_data.sources.base import detect, open_source

TRIED = 20  # episodes looked at for one that can be read


def inspect_recording(uri: str, embodiment: str | None = None) -> dict[str, Any]:
    """Everything `hma inspect` says, as plain values.

    Args:
        uri: of the recording.
        embodiment: id or YAML; with it the first readable episode is aligned and checked.

    Raises:
        SourceError: the recording cannot be read at all.
    """
    robot = find(embodiment) if embodiment else None
    name = robot.source.format if robot else detect(uri)
    report = open_source(name).inspect(uri).to_json()
    report["problems"] = list(report["problems"])
    if robot:
        _check(report, uri, robot)
    return report


def _check(report: dict[str, Any], uri: str, robot: Embodiment) -> None:
    """Add what the embodiment makes of the first episode, or why it cannot."""
    known = [key["key"] for key in report["keys"]]
    wanted = [camera.key for camera in robot.cameras] + [part.key for part in robot.action.components]
    source = open_source(robot.source.format)
    report["embodiment"] = {"embodiment": f"{robot.id}, {robot.action_dim} action dims"}
    faults: list[HMAError] = []
    for first in source.episode_ids(uri)[:TRIED]:
        try:
            clip = to_clip(source.read(uri, first, robot), robot)
            pictures = clip.frames_at(robot.primary_camera.name, np.arange(min(len(clip), 2)))
            break
        except HMAError as fault:
            faults.append(fault)
    else:
        first_fault = faults[0] if faults else SourceError(uri, "has no episodes")
        near = [
            get_close_matches(key, known, n=2)
            for key in wanted
            if key not in known and not key.startswith("/")
        ]
        hint = (
            f" (recorded keys like it: {', '.join(key for keys in near for key in keys)})"
            if any(near)
            else ""
        )
        report["problems"].append(f"{robot.id} does not fit: {first_fault}{hint}")
        return
    if faults:
        report["problems"].append(
            f"{len(faults)} of the first {len(faults) + 1} episodes cannot be used: {faults[0]}"
        )
    intervals = np.diff(clip.timestamps)
    measured = 1 / float(np.median(intervals)) if len(intervals) and np.median(intervals) > 0 else None
    facts = {
        "first episode": f"{first}: {len(clip)} frames on the grid, {clip.trimmed} trimmed at its ends",
        "pictures": "×".join(map(str, pictures.shape[1:])),
        "rate on the grid": f"{measured:.3g} Hz" if measured else "unknown",
    }
    for stream, skew in clip.skew_ms.items():
        p50, p95, most = np.percentile(skew, [50, 95, 100])
        facts[f"skew of {stream}"] = f"p50 {p50:.1f} ms, p95 {p95:.1f} ms, max {most:.1f} ms"
    if measured and isinstance(robot.frequency_hz, float) and abs(measured / robot.rate_hz - 1) > 0.1:
        report["problems"].append(
            f"{robot.id} says {robot.rate_hz:g} Hz, the recording's grid ticks at {measured:.3g} Hz"
        )
    constant = np.flatnonzero(clip.known_actions.std(axis=0) == 0)
    if len(constant):
        names = robot.action.names()
        facts["constant in it"] = "action " + ", ".join(names[i] for i in constant)
    report["embodiment"] |= facts
