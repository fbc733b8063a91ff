"""Put the streams of a recording on one clock.

Cameras, actions and states tick at their own rates. Here they are brought onto the times of
the embodiment's primary camera, or onto a fixed grid; how far each had to be moved is the skew.

Times are float64 seconds. T target times, S source times, A values a sample.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hma_data.embodiment import Embodiment
from hma_data.episode import Clip, Episode, Floats, Signal
from hma_data.errors import AlignmentError, EpisodeError

Moved = tuple[NDArray[np.int64], Floats]


def nearest(source_times: Floats, target_times: Floats) -> Moved:
    """Index (T,) of the sample nearest to each target time, and skew_ms (T,); ties go to the earlier."""
    after = np.clip(
        np.searchsorted(source_times, target_times, side="left"), 1, max(len(source_times) - 1, 1)
    )
    before = after - 1
    after = np.minimum(after, len(source_times) - 1)
    nearer = np.abs(source_times[after] - target_times) < np.abs(source_times[before] - target_times)
    index: NDArray[np.int64] = np.where(nearer, after, before)
    return index, np.abs(source_times[index] - target_times) * 1e3


def hold(source_times: Floats, target_times: Floats) -> Moved:
    """Index (T,) of the sample in force at each target time, the last stamped at or before it; its age in ms.

    Target times before the first sample get index 0 and a negative age; `to_clip` trims them.
    """
    index = np.searchsorted(source_times, target_times, side="right") - 1
    return np.maximum(index, 0), (target_times - source_times[np.maximum(index, 0)]) * 1e3


def interpolate(
    source_times: Floats, values: NDArray[np.float32], target_times: Floats
) -> tuple[NDArray[np.float32], Floats]:
    """Values (T, A) linear between neighbours, and skew_ms (T,): the distance to the nearest sample."""
    columns = [np.interp(target_times, source_times, column) for column in values.T.astype(np.float64)]
    return np.stack(columns, axis=1).astype(np.float32), nearest(source_times, target_times)[1]


def to_clip(episode: Episode, embodiment: Embodiment) -> Clip:
    """The episode on the embodiment's grid.

    Raises:
        EpisodeError: no frames, no actions, values that are not finite, times that do not rise.
        AlignmentError: streams do not overlap, or one is further off than `sync.max_skew_ms`.
    """
    if not episode.actions:
        raise EpisodeError(episode.id, "has no actions")
    clip = _shared_index(episode, embodiment) if episode.rate_stamped else _aligned(episode, embodiment)
    for name, values in (("actions", clip.actions), ("states", clip.states)):
        if values is not None and not np.isfinite(values).all():
            frame = int(np.argwhere(~np.isfinite(values).all(axis=1))[0, 0])
            raise EpisodeError(episode.id, f"{name} are not finite at frame {frame}")
    return clip


def _shared_index(episode: Episode, embodiment: Embodiment) -> Clip:
    """RLDS, HDF5, LeRobot: frame i, action i and state i belong together."""
    lengths = {name: len(stream.timestamps) for name, stream in episode.streams.items()}
    lengths |= {f"action component {i}": len(signal.values) for i, signal in enumerate(episode.actions)}
    lengths |= {f"state component {i}": len(signal.values) for i, signal in enumerate(episode.states)}
    if len(set(lengths.values())) != 1:
        raise EpisodeError(
            episode.id, "its streams differ in length: " + ", ".join(f"{k} {v}" for k, v in lengths.items())
        )
    times = episode.streams[embodiment.primary_camera.name].timestamps
    _check_times(episode.id, embodiment.primary_camera.name, times)
    shift = embodiment.sync.action_shift
    index = np.arange(max(0, -shift), len(times) - max(0, shift))
    if not len(index):
        raise EpisodeError(episode.id, f"has {len(times)} frames, sync.action_shift is {shift}")
    return Clip(
        episode=episode,
        timestamps=times[index] - times[index[0]],
        actions=_join(episode.actions)[index + shift],
        states=_join(episode.states)[index] if episode.states else None,
        frame_indices=dict.fromkeys(episode.streams, index),
        skew_ms={
            name: np.abs(stream.timestamps - times)[index] * 1e3 for name, stream in episode.streams.items()
        },
        trimmed=abs(shift),
    )


def _join(signals: tuple[Signal, ...]) -> NDArray[np.float32]:
    return np.concatenate([signal.values for signal in signals], axis=1)


def _aligned(episode: Episode, embodiment: Embodiment) -> Clip:
    """Bags: every stream is moved onto the grid by the method the embodiment names."""
    sync = embodiment.sync
    clocks: list[tuple[str, Floats, str]] = [
        *((name, stream.timestamps, sync.images) for name, stream in episode.streams.items()),
        *((f"action/{i}", signal.timestamps, sync.actions) for i, signal in enumerate(episode.actions)),
        *((f"state/{i}", signal.timestamps, sync.states) for i, signal in enumerate(episode.states)),
    ]
    for name, times, _ in clocks:
        _check_times(episode.id, name, times)
    grid, trimmed = _grid(episode, embodiment, clocks)

    skew: dict[str, Floats] = {}
    indices: dict[str, NDArray[np.int64]] = {}
    mover: dict[str, Callable[[Floats, Floats], Moved]] = {
        "nearest": nearest,
        "hold": hold,
        "interpolate": nearest,
    }
    for name, stream in episode.streams.items():
        indices[name], skew[name] = mover[sync.images](stream.timestamps, grid)

    def moved(kind: str, signals: tuple[Signal, ...], method: str) -> NDArray[np.float32]:
        parts = []
        for i, signal in enumerate(signals):
            if method == "interpolate":
                values, skew[f"{kind}/{i}"] = interpolate(signal.timestamps, signal.values, grid)
            else:
                index, skew[f"{kind}/{i}"] = mover[method](signal.timestamps, grid)
                values = signal.values[index]
            parts.append(values)
        return np.concatenate(parts, axis=1)

    actions = moved("action", episode.actions, sync.actions)
    states = moved("state", episode.states, sync.states) if episode.states else None
    _check_skew(episode.id, skew, sync.max_skew_ms, grid)
    return Clip(episode, grid - grid[0], actions, states, indices, skew, trimmed)


def _grid(
    episode: Episode, embodiment: Embodiment, clocks: list[tuple[str, Floats, str]]
) -> tuple[Floats, int]:
    """Target times where every stream is running, and how many frames lie outside.

    A held value stays in force after its last sample; anything else ends with it. Edges may reach
    `max_skew_ms` (half a period without one) beyond a stream's samples.
    """
    sync = embodiment.sync
    primary = episode.streams[embodiment.primary_camera.name].timestamps
    start, stop = -np.inf, np.inf
    for name, times, method in clocks:
        if name == embodiment.primary_camera.name and not sync.rate_hz:
            continue
        period = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        reach = sync.max_skew_ms / 1e3 if sync.max_skew_ms else period / 2
        start = max(start, float(times[0]) - (reach if method == "nearest" else 0.0))
        if method == "nearest":
            stop = min(stop, float(times[-1]) + reach)
        elif method == "interpolate":
            stop = min(stop, float(times[-1]))
        elif sync.max_skew_ms:  # hold
            stop = min(stop, float(times[-1]) + max(reach, period))
    if sync.rate_hz:
        first, last = max(float(primary[0]), start), min(float(primary[-1]), stop)
        every = (
            first + np.arange(max(0, int(np.floor((last - first) * sync.rate_hz + 1e-6)) + 1)) / sync.rate_hz
        )
        grid, total = every, len(every)
    else:
        grid, total = primary[(primary >= start) & (primary <= stop)], len(primary)
    if not len(grid):
        spans = ", ".join(f"{name} {times[0]:.3f} to {times[-1]:.3f} s" for name, times, _ in clocks)
        raise AlignmentError(
            episode.id, f"its streams never run together: {spans}", "check the topics, or stamp: receive"
        )
    return grid, total - len(grid)


def _check_times(episode_id: str, name: str, times: Floats) -> None:
    if not len(times):
        raise EpisodeError(episode_id, f"{name} has no samples")
    if not np.isfinite(times).all():
        raise EpisodeError(episode_id, f"{name} has times that are not finite")
    backwards = np.flatnonzero(np.diff(times) < 0)
    if len(backwards):
        i = int(backwards[0])
        raise AlignmentError(
            episode_id,
            f"{name} goes back in time at sample {i + 1}: {times[i]:.6f} then {times[i + 1]:.6f} s",
            "try stamp: receive",
        )


def _check_skew(episode_id: str, skew: dict[str, Floats], limit_ms: float | None, grid: Floats) -> None:
    if limit_ms is None:
        return
    for name, values in skew.items():
        worst = int(np.argmax(values))
        if values[worst] > limit_ms:
            raise AlignmentError(
                episode_id,
                f"{name} is {values[worst]:.1f} ms off at {grid[worst] - grid[0]:.3f} s, "
                f"sync.max_skew_ms is {limit_ms:g}",
                "raise max_skew_ms, or leave the episode in quarantine",
            )
