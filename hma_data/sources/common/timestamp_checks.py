"""Check the timestamps of a stream: rate, jitter, repeated stamps, stamps that go back, pauses, lost frames.

T samples of a stream; times are float64 seconds in the order of receipt.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hma_data.episodes.align import nearest
from hma_data.episodes.episode import Floats
from hma_data.sources.common.findings import Finding

PAUSE, PAUSE_S = 10, 0.5  # a pause is longer than this many median intervals and this many seconds
REGULAR = 0.8  # least share of intervals within a third of the median, for counting lost frames
STREAM = 0.5  # least such share for reporting pauses; below it, the topic carries events
LOST = 0.01  # share of lost frames above which they are reported
DRIFT = 0.02  # share of the stated rate by which the measured rate may differ


@dataclass(frozen=True)
class Clock:
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


def clock_of(times: Floats) -> Clock:
    """Measure the clock of a stream from its times, (T,) seconds."""
    finite = np.isfinite(times)
    times = times[finite]
    steps = np.diff(times)
    hz, jitter_ms = rate(times)
    period = float(np.median(steps)) if len(steps) else 0.0
    regular = float(np.mean(np.abs(steps / period - 1) < 1 / 3)) if period > 0 else 0.0
    worst = int(np.argmax(steps)) if len(steps) else 0
    return Clock(
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


def findings(key: str, clock: Clock, camera: bool = False, episode: str = "") -> Iterator[Finding]:
    """Yield what looks wrong with one stream's timestamps.

    Args:
        key: the stream's name.
        clock: of the stream.
        camera: whether lost frames are reported.
        episode: its name, for the message; empty where there is only one.
    """
    where = f"{episode}: {key}" if episode else key

    def found(check: str, said: str, remedy: str = "", **numbers: float) -> Finding:
        return Finding(check, "warn", f"{where}: {said}", remedy, key, numbers)

    if clock.infinite:
        yield found("finite", f"{clock.infinite} times are not finite", count=clock.infinite)
    if clock.repeated:
        yield found("repeated", f"{clock.repeated} stamps are the one before again", count=clock.repeated)
    if clock.back:
        remedy = "stamp: receive would not" if not episode else ""
        yield found("back", f"{clock.back} stamps go back in time", remedy, count=clock.back)
    if clock.regular >= STREAM and clock.gap_s > max(PAUSE * clock.period_s, PAUSE_S):
        said = f"pauses for {clock.gap_s:.3g} s after {clock.gap_at_s:.3g} s"
        yield found("gaps", said, gap_s=clock.gap_s, at_s=clock.gap_at_s)
    if camera and clock.lost and clock.lost > LOST * clock.count:
        said = f"about {clock.lost} frames are missing beside {clock.count} by its rate of {clock.hz:.4g} Hz"
        yield found("frames", said, lost=clock.lost, count=clock.count)


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
