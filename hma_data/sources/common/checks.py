"""Check the times and the images of a recording, and state what was found.

Times: rate, jitter, repeated stamps, stamps that go back, pauses, lost frames. T samples of a stream; times
are float64 seconds in the order of receipt.

Images: still, blank, of several sizes, red and blue swapped. That shows in images that were decoded from
JPEG or video and then stored without loss: every pixel is then a result of the conversion from YCbCr, which
gives only a quarter of all colours. The channel order in which all pixels are such results is the right one.
n images, H×W pixels, uint8 RGB.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from io import BytesIO
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hma_data.arrays import Array, Floats, Images, Ints
from hma_data.episodes.align import nearest
from hma_data.episodes.images import BLANK_LEVELS, PictureCheck
from hma_data.episodes.movement import MovingPart

Severity = Literal["error", "warn", "info"]
SEVERITIES: tuple[Severity, ...] = ("info", "warn", "error")
PAUSE, PAUSE_S = 10, 0.5  # a pause is longer than this many median intervals and this many seconds
RARE = 0.05  # largest share of pauses among the intervals, for a rate without them; one always may be
REGULAR = 0.8  # least share of intervals within a third of the median, for counting lost frames
STREAM = 0.5  # least such share for reporting pauses; below it, the topic carries events
MAX_LOST_SHARE = 0.01  # share of lost frames above which they are reported
# Times since 1970, of 2001 to 2103, and seconds a unit. Others may count from the start of a machine, in a
# smaller unit; only nanoseconds have none.
UNITS = ((1e17, 1e19, 1e-9), (1e15, 4.2e15, 1e-6), (1e12, 4.2e12, 1e-3), (1e9, 4.2e9, 1.0))
NAMED_UNITS = {  # endings of keys -> seconds a unit
    "s": 1.0, "sec": 1.0, "secs": 1.0, "seconds": 1.0, "ms": 1e-3, "msec": 1e-3, "us": 1e-6, "usec": 1e-6,
    "ns": 1e-9, "nsec": 1e-9,
}  # fmt: skip
TIMES = re.compile(rf"(.*/)?(time_?stamps?|times?|stamps?|t)(_({'|'.join(NAMED_UNITS)}))?")
STEPS_S = (1e-4, 5.0)  # between samples of a recording
DRIFT = 0.02  # share of the stated rate by which the measured rate may differ

PAIRS = 16  # pairs of neighbouring images compared, for a camera over all its episodes
PIXELS = 4096  # pixels of an image whose colours are checked
DISTINCT = 1_000  # least number of distinct colours for the YCbCr sign
SURE, CHANCE = 0.98, 0.6  # share of colours that YCbCr gives: least in the right order, most in the other
MAX_EQUAL_SHARE = 0.5  # least share of equal neighbours that is reported


@dataclass(frozen=True)
class Finding:
    """One result of a check.

    Attributes:
        check: its name, stable for programs.
        severity: error: unusable or wrong; warn: look before training; info: good to know.
        message: what was found, with the numbers.
        remedy: what to do; may be empty.
        key: the key of the recording that is affected; empty where the finding is about all of it.
        numbers: the numbers in the message, as plain values.
    """

    check: str
    severity: Severity
    message: str
    remedy: str = ""
    key: str = ""
    numbers: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return plain values for `--json`."""
        return asdict(self)

    def __str__(self) -> str:
        return f"{self.message} — {self.remedy}" if self.remedy else self.message


# -- times


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
    """Measure the timing of a stream from its times, (T,) seconds."""
    finite = np.isfinite(times)
    times = times[finite]
    steps = np.diff(times)
    hz, jitter_ms = rate(times)
    period = float(np.median(steps)) if len(steps) else 0.0
    regular = float(np.mean(np.abs(steps / period - 1) < 1 / 3)) if period > 0 else 0.0
    worst = int(np.argmax(steps)) if len(steps) else 0
    lost = None
    if regular >= REGULAR and len(steps) >= 8:
        # intervals that are multiples of the median one, without pauses; a late frame is not a lost one
        lost = max(int(np.sum(np.rint(_usual(steps, period) / period) - 1)), 0)
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
        lost=lost,
        infinite=int(np.sum(~finite)),
    )


def rate(times: Floats) -> tuple[float | None, float | None]:
    """Return Hz and jitter_ms, the standard deviation of the intervals; leave out a few pauses from both.

    Samples with equal stamps count once, as they give one frame. The rate comes from the median interval.
    Where bursts make the median and the mean differ by half, it comes from the mean interval.
    """
    steps = np.diff(times)
    steps = steps[steps != 0]
    if len(steps) < 2 or steps.sum() <= 0:
        return None, None
    median = float(np.median(steps))
    usual = _usual(steps, median)
    if len(steps) - len(usual) <= max(1, RARE * len(steps)) and usual.sum() > 0:
        steps = usual
    mean = float(np.mean(steps))
    period = median if 1 / 1.5 < median / mean < 1.5 else mean
    return 1 / period, float(np.std(steps) * 1e3)


def _usual(steps: Floats, period: float) -> Floats:
    """Return the intervals that are no pauses, given the median one."""
    return steps[steps <= pause_s(period)]


def pause_s(period: float) -> float:
    """Return the seconds beyond which an interval is a pause, given the median one."""
    return max(PAUSE * period, PAUSE_S)


def time_findings(key: str, times: StreamTimes, camera: bool = False, episode: str = "") -> Iterator[Finding]:
    """Yield what looks wrong with one stream's timestamps.

    Args:
        key: the stream's name.
        times: of the stream.
        camera: whether lost frames are reported.
        episode: its name, for the message; empty where there is only one.
    """
    where = f"{episode}: {key}" if episode else key

    def found(check: str, said: str, **numbers: float) -> Finding:
        return Finding(check, "warn", f"{where}: {said}", key=key, numbers=numbers)

    if times.infinite:
        yield found("finite", f"{times.infinite} times are not finite", count=times.infinite)
    if times.repeated:
        yield found("repeated", f"{times.repeated} timestamps equal the previous one", count=times.repeated)
    if times.back:
        yield found("back", f"{times.back} timestamps go back in time", count=times.back)
    if times.regular >= STREAM and times.gap_s > pause_s(times.period_s):
        said = f"pauses for {times.gap_s:.3g} s after {times.gap_at_s:.3g} s"
        yield found("gaps", said, gap_s=times.gap_s, at_s=times.gap_at_s)
    if camera and times.lost and times.lost > MAX_LOST_SHARE * times.count:
        said = f"has {times.count} frames; at its rate of {times.hz:.4g} Hz about {times.lost} are missing"
        yield found("frames", said, lost=times.lost, count=times.count)


def drift(
    key: str, measured_hz: float | None, stated_hz: float | None, source: str = "the recording states"
) -> Iterator[Finding]:
    """Yield a finding where the rates differ by more than DRIFT; `source` says who stated the rate."""
    if measured_hz and stated_hz and abs(measured_hz / stated_hz - 1) > DRIFT:
        said = f"{key}: runs at {measured_hz:.4g} Hz, {source} {stated_hz:.4g}"
        numbers = {"measured_hz": measured_hz, "stated_hz": stated_hz}
        yield Finding("rate", "warn", said, "state the true rate as frequency_hz in the YAML", key, numbers)


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


def seconds_a_unit(values: Array, key: str = "") -> float | None:
    """Return the length in seconds of one unit of a column of times; None where it is not clear.

    The unit follows from the ending of the key, from the size of the times, or from their steps.

    Args:
        values: (T,) as recorded.
        key: of the values, such as time_us.
    """
    times = np.asarray(values, np.float64).reshape(-1)
    steps = np.diff(times)
    if len(times) < 3 or not np.isfinite(times).all() or steps.min() < 0 or not steps.max() > 0:
        return None
    step = float(np.median(steps))
    units = [unit for least, most, unit in UNITS if least <= times[0] < most]
    if (named := TIMES.fullmatch(key.lower())) and named[4]:
        units = [NAMED_UNITS[named[4]], *units]
    if not units and not np.array_equal(times, np.round(times)):  # else frame numbers, or another unit
        units = [1.0]
    return next((unit for unit in units if STEPS_S[0] <= step * unit <= STEPS_S[1]), None)


def is_times(key: str, shape: tuple[int, ...]) -> bool:
    """Check whether a key holds one number a sample and is named like a column of times."""
    return shape in ((), (1,)) and bool(TIMES.fullmatch(key.lower()))


def seconds_of(values: Array, key: str = "") -> Floats | None:
    """Return a column of times (T,) in seconds from the earliest; None where its unit is not clear.

    Stamps may repeat or go back. The unit is found from the sorted, distinct stamps.
    """
    times = np.asarray(values).reshape(-1)
    if times.dtype.kind not in "fiu" or len(times) < 3:
        return None
    rising = np.unique(times[np.isfinite(times)] if times.dtype.kind == "f" else times)
    unit = seconds_a_unit(rising, key)
    if unit is None:
        return None
    origin = rising[0]  # subtracted while they are integers: float64 cannot hold nanoseconds since 1970
    shifted = times - origin if times.dtype.kind == "f" else times.astype(np.int64) - np.int64(origin)
    return shifted.astype(np.float64) * unit


# -- images


@dataclass
class CameraLook:
    """Statistics of one camera's images.

    Attributes:
        lossless: whether images are stored without loss, so that the YCbCr sign can be used.
        images: how many were added.
        sizes: (height, width) -> number of calls of `add` with it.
        changes: how often the size changes within an episode.
        neighbours, same: pairs of neighbouring images compared, and equal ones among them.
        blank, episodes: episodes in which the camera shows one colour; all sampled episodes.
        colours: some of the colours met.
        moving: where images change.
    """

    lossless: bool = True
    images: int = 0
    sizes: dict[tuple[int, int], int] = field(default_factory=dict)
    changes: int = 0
    neighbours: int = 0
    same: int = 0
    blank: int = 0
    episodes: int = 0
    colours: list[NDArray[np.uint8]] = field(default_factory=list)
    moving: MovingPart = field(default_factory=MovingPart)
    _check: PictureCheck | None = None
    _size: tuple[int, int] = (0, 0)

    def add(self, frames: Images, indices: Ints, again: bool = False) -> None:
        """Add images (n, H, W, 3) of one episode, and the rising indices (n,) of their frames.

        `again` says that they are of the same episode as the images before.
        """
        if not again:
            self.episodes, self.blank, self._check = self.episodes + 1, self.blank + 1, PictureCheck()
        self.images += len(frames)
        self.moving.add(frames)
        size = (int(frames.shape[1]), int(frames.shape[2]))
        self.changes += again and size != self._size
        self._size = size
        self.sizes[size] = self.sizes.get(size, 0) + 1
        pairs = np.flatnonzero(np.diff(indices) == 1)
        self.neighbours += len(pairs)
        self.same += sum(np.array_equal(frames[i], frames[i + 1]) for i in pairs)
        if self._check:
            self._check.add(frames)
            if self._check.contrast > BLANK_LEVELS:
                self.blank, self._check = self.blank - 1, None
        step = max(1, int(np.sqrt(size[0] * size[1] / PIXELS)))
        if self.lossless:
            self.colours += [frame[::step, ::step].reshape(-1, 3) for frame in frames]

    def swapped(self) -> tuple[str, str]:
        """Check whether red and blue are swapped; return the answer and its reason.

        The answer is sure, no (they are certainly in order), or empty where it is unknown.
        """
        if self.colours:
            # One number a colour: sorting rows takes twenty times as long.
            red, green, blue = np.concatenate(self.colours).astype(np.int64).T
            codes = np.unique((red << 16) + (green << 8) + blue)
            colours = np.stack([codes >> 16, codes >> 8, codes], axis=1).astype(np.uint8)
            straight, turned = ycbcr_share(colours), ycbcr_share(colours[:, ::-1])
            if straight is not None and turned is not None:
                if turned >= SURE and straight <= CHANCE:
                    return "sure", (
                        f"{turned:.0%} of its colours are those of a decoded JPEG with the two swapped, "
                        f"{straight:.0%} as stored"
                    )
                if straight >= SURE and turned <= CHANCE:
                    return "no", ""  # even where the scene is blue
        return "", ""


def ycbcr_share(colours: NDArray[np.uint8]) -> float | None:
    """Return the share of the RGB colours (m, 3) that JPEG's YCbCr can give; chance alone gives a quarter.

    Colours that are grey or at the edge of the range do not count. None where too few colours remain.
    """
    spread = colours.max(axis=1, initial=0).astype(int) - colours.min(axis=1, initial=255)
    inside = ((colours > 0) & (colours < 255)).all(axis=1) if len(colours) else np.zeros(0, bool)
    rgb = colours[inside & (spread > 8)].astype(np.float64)
    if len(rgb) < DISTINCT:
        return None
    rgb = rgb[:: max(1, len(rgb) // 20_000)]
    luma = rgb @ np.array([0.299, 0.587, 0.114])
    blue, red = (rgb[:, 2] - luma) / 1.772, (rgb[:, 0] - luma) / 1.402
    given = np.zeros(len(rgb), bool)
    for y in (np.floor(luma), np.ceil(luma)):
        for cb in (np.floor(blue), np.ceil(blue)):
            for cr in (np.floor(red), np.ceil(red)):
                back = [y + np.rint(1.402 * cr), y + np.rint(-0.344136 * cb - 0.714136 * cr),
                        y + np.rint(1.772 * cb)]  # fmt: skip
                given |= (np.stack(back, axis=1) == rgb).all(axis=1)
    return float(given.mean())


def choose(length: int, pairs: int, starts: Ints | None = None) -> Ints:
    """Choose frames (n,) of an episode, in runs of neighbours over its length; a single run in its middle.

    Args:
        length: of the episode.
        pairs: how many runs at most.
        starts: for each frame the frame at which its decoding begins, for videos. Runs then begin there
            and have three frames: where every other frame is a keyframe, encoders often repeat it between.
    """
    firsts = np.unique(np.linspace(0, max(length - 2, 0), max(pairs, 1)).astype(np.int64))
    if pairs <= 1:
        firsts = np.array([max(length - 2, 0) // 2])  # at its begin, a robot is where it always begins
    run = 2
    if starts is not None:
        firsts, run = np.unique(np.maximum(starts[firsts], 0)), 3
    return np.unique(np.minimum(firsts[:, None] + np.arange(run), length - 1))


def runs(indices: Ints) -> list[Ints]:
    """Divide the chosen frames into runs of neighbours, so that only one run of images is in memory."""
    return np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1)


def stacked(images: Sequence[Images] | Images) -> Iterator[tuple[int, Images]]:
    """Yield runs of images of one size as (n, H, W, 3), with the index at which each run begins."""
    start = 0
    for i in range(1, len(images) + 1):
        if i == len(images) or images[i].shape != images[start].shape:
            yield start, np.stack(list(images[start:i]))
            start = i


def one_channel(data: bytes) -> bool:
    """Check whether a JPEG or PNG is grey, by its header; False for bytes that are no image."""
    from PIL import Image

    try:
        with Image.open(BytesIO(data)) as image:
            return image.mode in ("1", "L", "LA")
    except (OSError, ValueError, Image.DecompressionBombError):
        return False


def picture_findings(looks: dict[str, CameraLook]) -> Iterator[Finding]:
    """Yield what looks wrong, camera by camera."""
    for key, look in looks.items():
        if not look.images:
            continue
        if len(look.sizes) > 1:
            said = ", ".join(f"{width}×{height}" for height, width in sorted(look.sizes))
            part = "; it changes within episodes" if look.changes else ""
            worst: Severity = "warn" if look.changes else "info"
            yield Finding("size", worst, f"{key}: images of several sizes, {said}{part}", key=key)
        if look.blank:
            said = f"{key}: shows only one colour in {look.blank} of {look.episodes} sampled episodes"
            # Where every episode is blank, the camera was never plugged in.
            severity: Severity = "info" if look.blank == look.episodes else "warn"
            numbers = {"blank": look.blank, "episodes": look.episodes}
            yield Finding("blank", severity, said, "check the camera's key in the YAML", key, numbers)
        share = look.same / max(look.neighbours, 1)
        if share > MAX_EQUAL_SHARE and look.blank < look.episodes:
            said = f"{key}: {share:.0%} of neighbouring images are equal"
            remedy = f"the camera may be {'frozen' if share == 1 else 'slower than its rate'}"
            yield Finding("still", "warn", said, remedy, key, {"share": share, "pairs": look.neighbours})
        sureness, reason = look.swapped()
        if sureness == "sure":
            said, remedy = f"{key}: red and blue are swapped: {reason}", "set color: bgr in the YAML"
            yield Finding("colour", "warn", said, remedy, key)
