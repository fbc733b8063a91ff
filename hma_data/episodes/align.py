"""Align the streams of a recording on one clock.

Cameras, actions and states tick at their own rates. This module moves them onto the times of the
embodiment's primary camera, or onto a fixed grid. The skew is the distance by which a value was moved.

Times that differ by rounding alone count as one time (see `rounding`). Samples may have equal stamps:
`hold` and `interpolate` take the last of them, which is in force from then on; `nearest` takes the first.
Frames of the primary camera with equal stamps give one frame of the grid. Stamps that go back in time are
refused.

Times are float64 seconds. T target times, S source times, A values a sample.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hma_data.arrays import Bools, Float32s, Floats, Ints
from hma_data.episodes.episode import Clip, Episode, Known, Signal
from hma_data.episodes.rotations import between, linear
from hma_data.errors import AlignmentError, EpisodeError
from hma_data.registry.components import Component
from hma_data.registry.embodiment import ONE_INDEX, Embodiment

Matches = tuple[Ints, Floats]
Timed = tuple[str, Floats, str, float]  # name, times, method and tolerance in seconds of a stream
RATE_TOLERANCE = 0.1  # share of the stated rate by which the measured one may differ
OFF_RATE = "off_rate_frames"  # the flag of an episode whose grid has another rate
PAUSED, PAUSE = "paused_frames", 3.0  # the flag of frames before a pause; its least length in median steps
ROUNDING_S = 1e-7  # the error of periods added up over hours; far below any sensor's interval


class TimedSignal(NamedTuple):
    """A signal with its name, its components, and the method and tolerance that move it onto the grid."""

    name: str
    signal: Signal
    components: tuple[Component, ...]
    method: str
    tolerance_s: float


def rounding(*times: Floats) -> float:
    """Return the seconds by which equal times may differ: 100 ns and 4 units in the largest's last place.

    A float64 of seconds since 1970 is exact to 0.24 µs, so the result is 1.1 µs for such times.
    """
    largest = max((float(np.abs(some[[0, -1]]).max()) for some in times if len(some)), default=0.0)
    return ROUNDING_S + 4 * float(np.spacing(largest))


def nearest(source_times: Floats, target_times: Floats) -> Matches:
    """Return the index (T,) of the sample nearest to each target time, and skew_ms (T,).

    Of two samples equally near, the earlier one is taken; of samples with equal stamps, the first.
    """
    after = np.clip(
        np.searchsorted(source_times, target_times, side="left"), 1, max(len(source_times) - 1, 1)
    )
    before = after - 1
    after = np.minimum(after, len(source_times) - 1)
    # A tie takes the earlier sample, and rounding must not decide a tie.
    farther = np.abs(source_times[before] - target_times) - np.abs(source_times[after] - target_times)
    chosen = np.where(farther > rounding(source_times, target_times), after, before)
    # Samples with equal stamps: the first of them.
    index: Ints = np.searchsorted(source_times, source_times[chosen], side="left")
    return index, np.abs(source_times[index] - target_times) * 1e3


def hold(source_times: Floats, target_times: Floats, tolerance_s: float = 0.0) -> Matches:
    """Return the index (T,) of the sample in force at each target time, and its distance in ms (T,).

    The sample in force is the last one stamped at or before the target time, or at most `tolerance_s` after
    it. Target times before the first sample get index 0 and a negative distance; `to_clip` trims them.
    """
    close = rounding(source_times, target_times)
    found = np.searchsorted(source_times, target_times + tolerance_s + close, side="right") - 1
    index = np.maximum(found, 0)
    age = target_times - source_times[index]
    # Within the tolerance the sample is later than the frame: its distance counts, not its sign.
    age = np.where((found < 0) | (age > -close), age, -age)
    return index, np.where(found < 0, age, np.maximum(age, 0)) * 1e3


def interpolate(source_times: Floats, values: Float32s, target_times: Floats) -> tuple[Float32s, Floats]:
    """Return values (T, A), linear between neighbours, and skew_ms (T,), the distance to the nearest one."""
    found = linear(source_times, values.astype(np.float64), target_times)
    return found.astype(np.float32), nearest(source_times, target_times)[1]


def matched(method: str, source_times: Floats, target_times: Floats, tolerance_s: float = 0.0) -> Matches:
    """Return the index (T,) of the sample that a method gives each target time, and skew_ms (T,).

    The tolerance is for `hold` alone. For `interpolate`, the result is that of `nearest`.
    """
    if method == "hold":
        return hold(source_times, target_times, tolerance_s)
    return nearest(source_times, target_times)


def to_clip(episode: Episode, embodiment: Embodiment) -> Clip:
    """Return the episode on the embodiment's grid.

    Raises:
        EpisodeError: it has no frames, no actions or none that is known, or values that are not finite.
        AlignmentError: times go back, streams do not overlap, or a stream is further off than
            `sync.max_skew_ms` and may not be masked.
    """
    if not episode.actions:
        raise EpisodeError(episode.id, "has no actions")
    clip = _shared_index(episode, embodiment) if episode.rate_stamped else _aligned(episode, embodiment)
    if clip.action_known is not None and not clip.action_known.any():
        raise EpisodeError(episode.id, f"none of its {len(clip)} actions is known: all would be masked")
    for name, values in (("actions", clip.actions), ("states", clip.states)):
        if values is not None and not np.isfinite(values).all():
            frame = int(np.argwhere(~np.isfinite(values).all(axis=1))[0, 0])
            raise EpisodeError(episode.id, f"{name} are not finite at frame {frame}")
    return clip


# -- streams of one index


def _shared_index(episode: Episode, embodiment: Embodiment) -> Clip:
    """Build the clip of an RLDS, HDF5 or LeRobot episode: frame i, action i and state i belong together."""
    lengths = {name: len(stream.timestamps) for name, stream in episode.streams.items()}
    lengths |= {one.name: len(one.signal.values) for one in _signals(episode, embodiment)}
    if len({*lengths.values()}) != 1:
        listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise EpisodeError(episode.id, f"its streams differ in length: {listed}")
    times = episode.streams[embodiment.primary_camera.name].timestamps
    _check_times(episode.id, embodiment.primary_camera.name, times, _clock_remedy(embodiment))
    shift = embodiment.sync.action_shift
    index = np.arange(max(0, -shift), len(times) - max(0, shift))
    if not len(index):
        raise EpisodeError(episode.id, f"it has {len(times)} frames, but sync.action_shift is {shift}")
    actions, action_known = _join(episode.actions, index + shift)
    states, state_known = _join(episode.states, index) if episode.states else (None, None)
    skew = {name: np.abs(stream.timestamps - times)[index] * 1e3 for name, stream in episode.streams.items()}
    return Clip(
        episode, times[index] - times[index[0]], actions, states, dict.fromkeys(episode.streams, index),
        skew, abs(shift), 0, action_known, state_known,
    )  # fmt: skip


def _join(signals: Sequence[Signal], index: Ints) -> tuple[Float32s, Known]:
    values = np.concatenate([signal.values for signal in signals], axis=1)[index]
    return _masked(values, [None if signal.known is None else signal.known[index] for signal in signals])


def _masked(values: Float32s, marks: Sequence[Known]) -> tuple[Float32s, Known]:
    """Return the values with zeros in rows where a mark is False, and the known rows (None without marks)."""
    stated = [mark for mark in marks if mark is not None]
    if not stated:
        return values, None
    known: Bools = np.logical_and.reduce(stated)
    return np.where(known[:, None], values, np.float32(0)), known


def _signals(episode: Episode, embodiment: Embodiment) -> list[TimedSignal]:
    """Return all signals: first those of the actions, then those of the states.

    The name is the component's key, as in the YAML. Where a camera or an action has that name already, the
    kind (action or state) comes before it. Components of one key share a name.
    """
    sync, taken = embodiment.sync, {*episode.streams}
    states = embodiment.state.components if embodiment.state else ()
    found: list[TimedSignal] = []
    for kind, signals, components, method, tolerance_ms in (
        ("action", episode.actions, embodiment.action.components, sync.actions, sync.tolerance_ms),
        ("state", episode.states, states, sync.states, None),
    ):
        apart = len(signals) == len(components)
        for i, signal in enumerate(signals):
            own = components[i : i + 1] if apart else components
            key = own[0].key if apart else kind
            name = f"{kind} {key}" if key in taken else key
            found.append(TimedSignal(name, signal, own, method, (tolerance_ms or 0) / 1e3))
        taken |= {one.name for one in found}
    return found


# -- streams of their own clocks


def _aligned(episode: Episode, embodiment: Embodiment) -> Clip:
    """Build the clip of a bag: move every stream onto the grid by the method that the embodiment names."""
    sync, primary = embodiment.sync, embodiment.primary_camera.name
    signals = _signals(episode, embodiment)
    timed: list[Timed] = [(name, one.timestamps, sync.images, 0.0) for name, one in episode.streams.items()]
    timed += [(one.name, one.signal.timestamps, one.method, one.tolerance_s) for one in signals]
    for name, times, *_ in timed:
        _check_times(episode.id, name, times, _clock_remedy(embodiment))
    frames = np.unique(episode.streams[primary].timestamps)  # equal stamps give one frame of the grid
    repeated = len(episode.streams[primary].timestamps) - len(frames)
    if repeated > len(frames):
        total = repeated + len(frames)
        fault = f"{repeated} of {total} frames of {primary} have the same timestamp as the previous frame"
        raise AlignmentError(episode.id, fault, _clock_remedy(embodiment))
    grid, trimmed = _grid(episode.id, frames, embodiment, timed)

    skew: dict[str, Floats] = {}
    indices: dict[str, Ints] = {}
    for name, stream in episode.streams.items():
        indices[name], skew[name] = matched(sync.images, stream.timestamps, grid)
    # A frame exactly at the limit stays in, whatever its stamp's last digit.
    limit = sync.max_skew_ms and sync.max_skew_ms + 1e3 * rounding(grid, frames)
    moved, marks = [], []
    for one in signals:
        values, known, off = _moved(one, grid)
        skew[one.name] = np.maximum(skew.get(one.name, off), off)  # components of one key share a name
        if limit and sync.beyond == "mask":
            near = off <= limit
            known = near if known is None else known & near
        moved.append(values)
        marks.append(known)
    if limit:
        refusing = skew if sync.beyond == "refuse" else {name: skew[name] for name in indices}
        for name, off_ms in refusing.items():
            worst = int(np.argmax(off_ms))
            if off_ms[worst] > limit:
                far = f"{off_ms[worst]:.1f} ms off at {grid[worst] - grid[0]:.3f} s"
                fault = f"{name} is {far}; sync.max_skew_ms is {sync.max_skew_ms:g}"
                remedy = "raise max_skew_ms, or leave the episode in quarantine"
                raise AlignmentError(episode.id, fault, remedy)

    count = len(episode.actions)
    actions, action_known = _masked(np.concatenate(moved[:count], axis=1), marks[:count])
    states, state_known = None, None
    if episode.states:
        states, state_known = _masked(np.concatenate(moved[count:], axis=1), marks[count:])
    return Clip(
        episode, grid - grid[0], actions, states, indices, skew, trimmed,
        0 if sync.rate_hz else repeated, action_known, state_known,
    )  # fmt: skip


def _moved(one: TimedSignal, grid: Floats) -> tuple[Float32s, Known, Floats]:
    """Return the values (T, A) of a signal on the grid, which of them are known (T,), and skew_ms (T,)."""
    signal = one.signal
    if one.method != "interpolate":
        index, skew = matched(one.method, signal.timestamps, grid, one.tolerance_s)
        return signal.values[index], None if signal.known is None else signal.known[index], skew
    values, skew = interpolate(signal.timestamps, signal.values, grid)
    start = 0
    for component in one.components:
        span = slice(start, start := start + component.dims)
        if component.representation:
            values[:, span] = between(
                signal.timestamps, signal.values[:, span], grid, component.representation, component.unit
            )
    if signal.known is None:
        return values, None, skew
    # An interpolated value is known if both of its neighbours are, or the one sample that it hits.
    before, age_ms = hold(signal.timestamps, grid)
    exact = age_ms <= 1e3 * rounding(signal.timestamps, grid)
    after = np.minimum(before + ~exact, len(signal.values) - 1)
    return values, signal.known[before] & signal.known[after], skew


def _grid(episode_id: str, frames: Floats, embodiment: Embodiment, timed: list[Timed]) -> tuple[Floats, int]:
    """Return the target times at which every stream is running, and the number of frames outside them.

    A held value stays in force after its last sample; every other stream ends with its last sample. The grid
    may reach `max_skew_ms` (without one, half a period) beyond a stream's samples.
    """
    sync = embodiment.sync
    close = rounding(*(times for _, times, *_ in timed))
    start, stop = -np.inf, np.inf
    for name, times, method, tolerance_s in timed:
        if name == embodiment.primary_camera.name and not sync.rate_hz:
            continue
        period = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        reach = sync.max_skew_ms / 1e3 if sync.max_skew_ms else period / 2
        start = max(start, float(times[0]) - (reach if method == "nearest" else tolerance_s))
        if method == "nearest":
            stop = min(stop, float(times[-1]) + reach)
        elif method == "interpolate":
            stop = min(stop, float(times[-1]))
        elif sync.max_skew_ms:  # hold
            stop = min(stop, float(times[-1]) + max(reach, period))
    if sync.rate_hz:
        first, last = max(float(frames[0]), start), min(float(frames[-1]), stop)
        count = max(0, int(np.floor((last - first + close) * sync.rate_hz)) + 1)
        grid, total = first + np.arange(count) / sync.rate_hz, count
    else:
        grid, total = frames[(frames >= start - close) & (frames <= stop + close)], len(frames)
    if not len(grid):
        spans = ", ".join(f"{name} {times[0]:.3f} to {times[-1]:.3f} s" for name, times, *_ in timed)
        fault = f"its streams do not overlap in time: {spans}"
        raise AlignmentError(episode_id, fault, _clock_remedy(embodiment))
    return grid, total - len(grid)


def _clock_remedy(embodiment: Embodiment) -> str:
    """Return what helps where times cannot be used: only messages of bags have a second clock."""
    if embodiment.source.format == "rosbag" and embodiment.sync.stamp != "receive":
        return "check the topics, or try sync: {stamp: receive}"
    return "correct the recording's times, or leave the episode out with --exclude"


def _check_times(episode_id: str, name: str, times: Floats, remedy: str) -> None:
    if not len(times):
        raise EpisodeError(episode_id, f"{name} has no samples")
    if not np.isfinite(times).all():
        raise EpisodeError(episode_id, f"{name} has times that are not finite")
    backwards = np.flatnonzero(np.diff(times) < 0)
    if len(backwards):
        i = int(backwards[0])
        fault = f"{name} goes back in time at sample {i + 1}: {times[i]:.6f} then {times[i + 1]:.6f} s"
        raise AlignmentError(episode_id, fault, remedy)


# -- the rate of a grid


def measured_hz(steps: Floats) -> float | None:
    """Return the rate of a grid in Hz from its steps (N,) in seconds: that of the median one, if above 0."""
    period = float(np.median(steps)) if len(steps) else 0.0
    return 1 / period if period > 0 else None


def is_off_rate(hz: float, embodiment: Embodiment) -> bool:
    """Check whether the measured rate of a grid differs from the one that the embodiment states, if any."""
    stated = embodiment.sync.rate_hz or embodiment.frequency_hz
    return isinstance(stated, float) and abs(hz / stated - 1) > RATE_TOLERANCE


def rate_flags(clip: Clip, embodiment: Embodiment) -> dict[str, int]:
    """Return the counts of a clip's grid, none of them 0.

    OFF_RATE: its frames where it is off the embodiment's rate. PAUSED: frames before a pause, see `pauses`.
    """
    hz = measured_hz(np.diff(clip.timestamps))
    if not hz:
        return {}
    flags = {OFF_RATE: len(clip)} if is_off_rate(hz, embodiment) else {}
    paused = len(pauses(clip.timestamps))
    return flags | ({PAUSED: paused} if paused else {})


def pauses(times: Floats) -> dict[int, int]:
    """Return where a grid's time jumps: frame -> median steps to the next frame, if PAUSE or more.

    A pause as long as a step of the model ends a window there, see `hma_data.shards.windows`.
    """
    steps = np.diff(times)
    ratios = steps * (measured_hz(steps) or 0.0)
    found = np.flatnonzero(ratios >= PAUSE)
    return dict(zip(found.tolist(), np.rint(ratios[found]).astype(np.int64).tolist(), strict=True))


def pause_remedy(embodiment: Embodiment, hz: float | None) -> str:
    """Return what can be done about the pauses in a grid of `hz`; empty unless it is a bag's."""
    if embodiment.source.format != "rosbag" or not hz:
        return ""
    stride = embodiment.stride if embodiment.states_rate else embodiment.stride_override or 1
    return divide_remedy((max(PAUSE, stride) - 0.5) / hz)


def divide_remedy(gap_s: float) -> str:
    """Return what divides a bag at the pauses of its primary camera that are longer than `gap_s`."""
    return f"source.segments: {{gap_s: {gap_s:.2g}}} in the YAML makes the parts episodes of their own"


def rate_remedy(embodiment: Embodiment) -> str:
    """Return what to correct in the YAML where `is_off_rate`."""
    return "correct frequency_hz" + ("" if embodiment.source.format in ONE_INDEX else ", or sync.rate_hz")
