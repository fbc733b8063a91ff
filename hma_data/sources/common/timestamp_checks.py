"""Check the timestamps of a stream: rate, jitter, repeated stamps, stamps that go back, pauses, lost frames.

T samples of a stream; times are float64 seconds in the order of receipt.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.align import nearest
from hma_data.episodes.episode import Floats
from hma_data.sources.common.findings import Finding

PAUSE, PAUSE_S = 10, 0.5  # a pause is longer than this many median intervals and this many seconds
REGULAR = 0.8  # least share of intervals within a third of the median, for counting lost frames
STREAM = 0.5  # least such share for reporting pauses; below it, the topic carries events
LOST = 0.01  # share of lost frames above which they are reported
UNITS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3), (1e8, 1.0))  # least time since 1970, seconds a unit
TIMES = re.compile(r"(.*/)?(time_?stamps?|times?|stamps?|t)(_s|_sec|_ns)?")
STEPS_S = (1e-4, 5.0)  # between samples of a recording
DRIFT = 0.02  # share of the stated rate by which the measured rate may differ


@dataclass(frozen=True)
class StreamTimes:
    """The timing of one stream in one episode, measured from its timestamps.

    Attributes:
        hz, jitter_ms: rate and standard deviation of the intervals; None for fewer than two intervals, or
            where their sum is not positive.
        repeated, back: stamps equal to the one before, and stamps earlier than it.
        gap_s, gap_at_s: the longest interval, and its start in seconds after the earliest sample.
        period_s: the median interval.
        regular: share of intervals within a third of the median one.
        lost: frames missing at this rate, where the stream is regular; else None.
        infinite: stamps that are not finite.
    """

    count: int
    hz: float | None
    jitter_ms: float | None
    repeated: int
    back: int
    gap_s: float
    gap_at_s: float
    period_s: float
    regular: float
    lost: int | None
    infinite: int = 0


def measure(times: Floats) -> StreamTimes:
    """Measure the clock of a stream from its times, (T,) seconds."""
    finite = np.isfinite(times)
    times = times[finite]
    steps = np.diff(times)
    hz, jitter_ms = rate(times)
    period = float(np.median(steps)) if len(steps) else 0.0
    regular = float(np.mean(np.abs(steps / period - 1) < 1 / 3)) if period > 0 else 0.0
    worst = int(np.argmax(steps)) if len(steps) else 0
    return StreamTimes(
        count=len(times),
        hz=hz,
        jitter_ms=jitter_ms,
        repeated=int(np.sum(steps == 0)),
        back=int(np.sum(steps < 0)),
        gap_s=float(steps[worst]) if len(steps) else 0.0,
        gap_at_s=float(times[worst] - times.min()) if len(steps) else 0.0,
        period_s=period,
        regular=regular,
        lost=_lost(steps, period) if regular >= REGULAR and len(steps) >= 8 else None,
        infinite=int(np.sum(~finite)),
    )


def rate(times: Floats) -> tuple[float | None, float | None]:
    """Return Hz and jitter_ms, the standard deviation of the intervals.

    The rate comes from the median interval, which a pause does not change. Where bursts make the median and
    the mean differ by half, it comes from the mean interval.
    """
    steps = np.diff(times)
    if len(steps) < 2 or steps.sum() <= 0:
        return None, None
    median, mean = float(np.median(steps)), float(np.mean(steps))
    period = median if 1 / 1.5 < median / mean < 1.5 else mean
    return 1 / period, float(np.std(steps) * 1e3)


def _lost(steps: Floats, period: float) -> int:
    """Count lost frames from the intervals that are multiples of the median one; leave out pauses."""
    usual = steps[steps <= max(PAUSE * period, PAUSE_S)]
    return max(int(np.sum(np.rint(usual / period) - 1)), 0)  # a late frame is not a lost one


def findings(key: str, times: StreamTimes, camera: bool = False, episode: str = "") -> Iterator[Finding]:
    """Yield what looks wrong with one stream's timestamps.

    Args:
        key: the stream's name.
        times: of the stream.
        camera: whether lost frames are reported.
        episode: its name, for the message; empty where there is only one.
    """
    where = f"{episode}: {key}" if episode else key

    def found(check: str, said: str, remedy: str = "", **numbers: float) -> Finding:
        return Finding(check, "warn", f"{where}: {said}", remedy, key, numbers)

    if times.infinite:
        yield found("finite", f"{times.infinite} times are not finite", count=times.infinite)
    if times.repeated:
        yield found("repeated", f"{times.repeated} stamps are the one before again", count=times.repeated)
    if times.back:
        remedy = "stamp: receive would not" if not episode else ""
        yield found("back", f"{times.back} stamps go back in time", remedy, count=times.back)
    if times.regular >= STREAM and times.gap_s > max(PAUSE * times.period_s, PAUSE_S):
        said = f"pauses for {times.gap_s:.3g} s after {times.gap_at_s:.3g} s"
        yield found("gaps", said, gap_s=times.gap_s, at_s=times.gap_at_s)
    if camera and times.lost and times.lost > LOST * times.count:
        said = f"about {times.lost} frames are missing beside {times.count} by its rate of {times.hz:.4g} Hz"
        yield found("frames", said, lost=times.lost, count=times.count)


def drift(
    key: str, measured_hz: float | None, stated_hz: float | None, source: str = "the recording states"
) -> Iterator[Finding]:
    """Yield a finding where the rates differ by more than DRIFT; `source` says who stated the rate."""
    if measured_hz and stated_hz and abs(measured_hz / stated_hz - 1) > DRIFT:
        said = f"{key}: ticks at {measured_hz:.4g} Hz, {source} {stated_hz:.4g}"
        numbers = {"measured_hz": measured_hz, "stated_hz": stated_hz}
        yield Finding("rate", "warn", said, "frequency_hz is what the YAML says", key, numbers)


def skew(times: Floats, primary: Floats) -> tuple[float, float, float] | None:
    """Return p50, p95 and max in ms from each frame of the primary stream to the sample nearest to it.

    Only frames within the time span of `times` count; None where there are none.
    """
    times, primary = np.sort(times), np.sort(primary)
    if not len(times) or not len(primary):
        return None
    inside = primary[(primary >= times[0]) & (primary <= times[-1])]
    if not len(inside):
        return None
    p50, p95, most = np.percentile(nearest(times, inside)[1], [50, 95, 100])
    return float(p50), float(p95), float(most)


# -- columns of times whose unit is not stated


def seconds_a_unit(values: NDArray[Any]) -> float | None:
    """Return the length in seconds of one unit of a column of times; None where it is not clear.

    The unit follows from the size of the times and from their steps.

    Args:
        values: (T,) as recorded.
    """
    times = np.asarray(values, np.float64).reshape(-1)
    steps = np.diff(times)
    if len(times) < 3 or not np.isfinite(times).all() or steps.min() < 0 or not steps.max() > 0:
        return None
    step = float(np.median(steps))
    for least, unit in UNITS:
        if times[0] >= least:
            return unit if STEPS_S[0] <= step * unit <= STEPS_S[1] else None
    counted = np.array_equal(times, np.round(times))  # frame numbers, or times in another unit
    return 1.0 if not counted and STEPS_S[0] <= step <= STEPS_S[1] else None


def is_times(key: str, shape: tuple[int, ...]) -> bool:
    """Check whether a key holds one number a sample and is named like a column of times."""
    return shape in ((), (1,)) and bool(TIMES.fullmatch(key.lower()))


def seconds_of(values: NDArray[Any]) -> NDArray[np.float64] | None:
    """Return a column of times (T,) in seconds; None where its unit is not clear.

    Stamps may repeat or go back. The unit is found from the sorted, distinct stamps.
    """
    times = np.asarray(values).reshape(-1)
    if times.dtype.kind not in "fiu" or len(times) < 3:
        return None
    rising = np.unique(times[np.isfinite(times)] if times.dtype.kind == "f" else times)
    unit = seconds_a_unit(rising)
    if unit is None:
        return None
    origin = rising[0]  # subtracted while they are integers: float64 cannot hold nanoseconds since 1970
    shifted = times - origin if times.dtype.kind == "f" else times.astype(np.int64) - np.int64(origin)
    return shifted.astype(np.float64) * unit
