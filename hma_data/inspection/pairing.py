"""Judge how a bag's commands are paired with its pictures: what `infer` proposes, what a YAML does.

`hma_data.episodes.offset` measures how the commands lie between the pictures.
"""

from collections.abc import Iterator

import numpy as np

from hma_data.episodes.align import hold, matched
from hma_data.episodes.episode import Clip, Floats
from hma_data.episodes.offset import Offset, measure
from hma_data.registry.components import Sync
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.common.checks import Finding

ASTRAY = 0.05  # least share of pictures with the command of another picture that is reported


def proposed(offsets: dict[str, Offset]) -> Iterator[Finding]:
    """Yield a finding for commands that plain `hold` would pair with the picture after theirs."""
    for name, offset in offsets.items():
        if offset.tolerance_ms and offset.after_ms:
            numbers = {"after_ms": offset.after_ms[0], "tolerance_ms": offset.tolerance_ms}
            said = f"{name} beside {offset.camera}: {offset.said}"
            yield Finding("offset", "info", said, f"set sync: {{{offset.pairing}}}", name, numbers)


def judged(clips: list[Clip], robot: Embodiment) -> dict[str, tuple[Offset, Finding | None]]:
    """Measure for each action key how commands lie between pictures, and judge the YAML's pairing of both.

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
    """Return a finding where the YAML gives pictures the commands of other pictures."""
    if offset.after_ms is None or sync.actions == "interpolate":
        return None
    apart: list[Floats] = []
    for times, pictures in runs:
        running = pictures[(pictures >= times[0]) & (pictures <= times[-1])]
        own = hold(times, running, offset.tolerance_ms / 1e3)[0]
        given = matched(sync.actions, times, running, (sync.tolerance_ms or 0) / 1e3)[0]
        apart.append(times[given] - times[own])
    off = np.concatenate(apart)
    for side, share in (("before", float(np.mean(off < 0))), ("after", float(np.mean(off > 0)))):
        if share >= ASTRAY:
            stated = sync.actions + (f", tolerance_ms {sync.tolerance_ms:g}" if sync.tolerance_ms else "")
            fault = f"{share:.0%} of pictures get the command of the picture {side} them"
            said = f"{key}: {fault} by actions: {stated}; {offset.said}"
            remedy = f"set sync: {{{offset.pairing}}}" + (
                "" if offset.tolerance_ms else " without tolerance_ms"
            )
            return Finding("offset", "warn", said, remedy, key, {"share": share})
    return None
