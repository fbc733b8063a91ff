"""Health checks of recordings and shard sets: what will hurt training, by severity.

Of a recording, what its own inspection finds; with an embodiment, also what a sample of its episodes
shows once they are read and aligned. Of a shard set, its integrity and what its statistics show.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hma_data.align import to_clip
from hma_data.embodiment import Embodiment, find
from hma_data.episode import Clip
from hma_data.errors import HMAError
from hma_data.sources.base import detect, open_source

Severity = Literal["error", "warn", "info"]
SEVERITIES: tuple[Severity, ...] = ("info", "warn", "error")
WINDOW = 12  # frames of the model's window, by default
PAIRS = 16  # neighbouring pictures compared in an episode


@dataclass(frozen=True)
class Finding:
    """One thing a check found.

    Attributes:
        check: its name, stable for programs.
        severity: error: unusable or wrong; warn: look before training; info: good to know.
        message: what was met, with the numbers.
        remedy: what to do; may be empty.
    """

    check: str
    severity: Severity
    message: str
    remedy: str = ""

    def to_json(self) -> dict[str, str]:
        """Plain values for `--json`."""
        return asdict(self)


def examine(target: str, embodiment: str | None = None, sample: int = 20) -> list[Finding]:
    """Everything the checks find, worst first.

    Args:
        target: a recording, or the folder of a shard set.
        embodiment: id or YAML; needed to look into a recording's episodes.
        sample: how many episodes are read, evenly spaced.

    Raises:
        RegistryError: no such embodiment.
    """
    if (Path(target) / "manifest.json").is_file():
        found = list(_shard_set(Path(target)))
    else:
        found = list(_recording(target, find(embodiment) if embodiment else None, sample))
    return sorted(found, key=lambda finding: -SEVERITIES.index(finding.severity))


# -- recordings


def _recording(uri: str, robot: Embodiment | None, sample: int) -> Iterator[Finding]:
    try:
        source = open_source(robot.source.format if robot else detect(uri))
        inspection = source.inspect(uri)
    except HMAError as fault:
        yield Finding("readable", "error", str(fault))
        return
    for problem in inspection.problems:
        yield Finding("recording", "warn", problem)
    if not inspection.episodes:
        yield Finding("episodes", "error", "the recording has no episodes")
    elif robot is None:
        yield Finding("looked-into", "info", "episodes were not read", "give --embodiment to look into them")
    else:
        yield from _episodes(uri, robot, sample)


def _episodes(uri: str, robot: Embodiment, sample: int) -> Iterator[Finding]:
    source = open_source(robot.source.format)
    names = source.episode_ids(uri)
    chosen = [names[i] for i in np.unique(np.linspace(0, len(names) - 1, sample).astype(int))]
    refused: Counter[str] = Counter()
    clips: list[Clip] = []
    pictures: list[Pictured] = []
    for name in chosen:
        try:
            clip = to_clip(source.read(uri, name, robot), robot)
            pictures += [_pictured(clip, camera.name) for camera in robot.cameras]
            clips.append(clip)
        except HMAError as fault:
            refused[fault.fault] += 1
    for reason, count in refused.most_common(5):
        severity: Severity = "warn" if clips else "error"
        yield Finding("usable", severity, f"{count} of {len(chosen)} episodes looked at: {reason}")
    if clips:
        yield from _times(clips, robot)
        yield from _numbers(np.concatenate([clip.known_actions for clip in clips]), robot)
        yield from _looks(pictures, robot)


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
    for stream in clips[0].skew_ms:
        late = float(np.percentile(np.concatenate([clip.skew_ms[stream] for clip in clips]), 95))
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


@dataclass(frozen=True)
class Pictured:
    """What neighbouring pictures of one camera in one episode look like.

    Attributes:
        still: share of neighbours that are the same, byte for byte.
        spread: standard deviation over all values.
        red, blue: means.
        size: (height, width).
    """

    camera: str
    still: float
    spread: float
    red: float
    blue: float
    size: tuple[int, int]


def _pictured(clip: Clip, camera: str) -> Pictured:
    firsts = np.unique(np.linspace(0, max(len(clip) - 2, 0), PAIRS).astype(int))
    both = np.unique(np.concatenate([firsts, np.minimum(firsts + 1, len(clip) - 1)]))
    frames = clip.frames_at(camera, both)
    place = {int(frame): i for i, frame in enumerate(both)}
    pairs = [(place[int(i)], place[int(i) + 1]) for i in firsts if int(i) + 1 in place]
    same = [np.array_equal(frames[a], frames[b]) for a, b in pairs]
    height, width = frames.shape[1:3]
    means = frames.mean(axis=(0, 1, 2))
    share = float(np.mean(same)) if same else 0.0
    return Pictured(camera, share, float(frames.std()), float(means[0]), float(means[2]), (height, width))


def _looks(seen: list[Pictured], robot: Embodiment) -> Iterator[Finding]:
    for camera in robot.cameras:
        mine = [look for look in seen if look.camera == camera.name]
        sizes = sorted({look.size for look in mine})
        if len(sizes) > 1:
            yield Finding("size", "warn", f"camera {camera.name} has pictures of several sizes: {sizes}")
        elif camera.size and sizes and sizes[0] != camera.size:
            said = f"camera {camera.name} is {list(sizes[0])} pixels, its YAML says {list(camera.size)}"
            yield Finding("size", "info", said)
        flat = sum(look.spread < 2 for look in mine)
        if flat:
            said = f"camera {camera.name} shows nothing (one colour) in {flat} of {len(mine)} episodes"
            yield Finding("blank", "warn", said, "is it another camera's key?")
        still = float(np.mean([look.still for look in mine]))
        if still > 0.5:
            said = f"camera {camera.name}: {still:.0%} of neighbouring pictures are the same"
            yield Finding("still", "warn", said, "the camera may run slower than frequency_hz")
        red, blue = (float(np.mean([getattr(look, side) for look in mine])) for side in ("red", "blue"))
        swapped = blue > 1.25 * red if camera.color == "rgb" else red > 1.25 * blue
        if swapped and max(red, blue) > 20:
            said = f"camera {camera.name} is bluish (red {red:.0f}, blue {blue:.0f})"
            other = "bgr" if camera.color == "rgb" else "rgb"
            yield Finding("colour", "info", said, f"look at a preview: color: {other}?")


# -- shard sets


def _shard_set(folder: Path) -> Iterator[Finding]:
    from hma_data.shards.manifest import Manifest
    from hma_data.shards.verify import verify

    wrong = verify(folder)
    for problem in wrong:
        yield Finding("integrity", "error", problem, "run the same hma convert again")
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
