"""Gather what a sample of episodes shows; the same for every format.

For each episode a source names its keys, and how each is read (`Series`). `look` reads them: the numbers, a
few images, and times where there are any. A defect of a key becomes one finding, however many episodes
have it. Bags hand in the same while they are read message by message.

T samples of a key in an episode, A values a sample.
"""

import re
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.arrays import Array, Floats, Images, Ints
from hma_data.episodes.align import divide_remedy
from hma_data.errors import HMAError
from hma_data.sources.common import checks
from hma_data.sources.common.checks import CameraLook, Finding, Severity, StreamTimes, is_times, seconds_of
from hma_data.sources.common.inspection import Inspection, KeyInfo
from hma_data.sources.common.places import unfollowed

CHECKS = {  # the checks of an inspection, in the order they are printed
    "readable": "episodes that can be read",
    "files": "files and metadata",
    "keys": "the same keys in every episode",
    "text": "task texts",
    "rows": "keys of equal length",
    "frames": "frames missing or too many",
    "repeated": "repeated timestamps",
    "back": "timestamps that go back",
    "stamps": "usable timestamps",
    "gaps": "pauses",
    "rate": "rate as stated",
    "skew": "skew between streams",
    "offset": "timing of actions and frames",
    "padding": "actions of the last steps",
    "finite": "NaN and infinity",
    "constant": "values that never change",
    "size": "images of equal size",
    "blank": "images of one colour",
    "still": "repeated images",
    "colour": "order of red and blue",
    "hands": "hands in the images",
}
LOSSY = ("jpeg", "h264", "av1", "hevc", "vp8", "vp9", "mpeg4", "mjpeg")
MAX_NAMES = 5  # faults and episodes named at most
FLOAT32_MAX = float(np.finfo(np.float32).max)
MAX_VALUES = 20_000_000  # numbers of one key of an episode
MAX_LENGTHS = 1_000  # episodes whose lengths an inspection has
_COMMANDS = re.compile(r"(^|[^a-z])(actions?|commands?|cmd|ctrl|control|targets?)([^a-z]|$)")


@dataclass(frozen=True)
class Series:
    """How a key of one episode is read. Every function may raise an HMAError.

    Attributes:
        numbers: returns the values (T, …) of a vector.
        frames: returns the images (H, W, 3) of the given frames of a camera.
        count: frames of the camera.
        starts: for each frame the one at which its decoding begins; of films.
        codec: of the images.
        times: (T,) seconds of a key with a clock of its own.
        info: the key, where only reading it shows what it is.
    """

    numbers: Callable[[], Array] | None = None
    frames: Callable[[Ints], Sequence[Images] | Images] | None = None
    count: int = 0
    starts: Ints | None = None
    codec: str | None = None
    times: Floats | None = None
    info: KeyInfo | None = None


@dataclass
class _Numbers:
    """The range of one vector over the episodes; `low` and `high` are (A,)."""

    low: Array
    high: Array
    rows: int = 0
    infinite: int = 0
    values: int = 0
    episodes: int = 0
    first: str = ""  # where the first value that is not finite was found
    last: str = ""  # the last episode that has such a value


class Survey:
    """The collected results of the sampled episodes.

    Args:
        episodes: how many the recording has.
        alone: whether findings leave out the names of episodes (a bag that is one episode).
        by_field: whether the episodes are bags: a YAML picks single fields of a message, so that constant
            ones do no harm, and may divide an episode.
    """

    def __init__(self, episodes: int, alone: bool = False, by_field: bool = False) -> None:
        self.episodes, self.alone, self.by_field = episodes, alone, by_field
        self.looked: list[str] = []
        self.looks: dict[str, CameraLook] = {}
        self.infos: dict[str, KeyInfo] = {}  # of the first episode that has the key
        self.pairs = 1  # of neighbouring frames looked at, for a camera of an episode
        self.made: set[str] = {"readable"}
        self._faults: dict[tuple[str, str], HMAError] = {}  # (episode, key or "") -> why
        self._numbers: dict[str, _Numbers] = {}
        self._times: defaultdict[str, dict[str, StreamTimes]] = defaultdict(dict)  # key -> episode -> times
        self._skew: dict[str, tuple[float, float, float] | None] = {}  # of the last episode
        self._found: list[tuple[str, Finding]] = []  # with the name of the episode, or ""
        self._shown: dict[str, str] = {}  # camera -> the episode last looked at

    # -- what sources hand in

    def sample(self, names: Sequence[str], wanted: int) -> list[str]:
        """Choose the episodes to look into, spread evenly over all."""
        chosen = [names[i] for i in sampled(len(names), wanted)] if names else []
        self.pairs = max(1, checks.PAIRS // max(len(chosen), 1))
        return chosen

    @contextmanager
    def reading(self, name: str, key: str = "") -> Iterator[None]:
        """Note an error as a fault of an episode, or of a key of it."""
        try:
            yield
        except HMAError as fault:
            self.fault(name, fault, key)

    def look(
        self,
        name: str,
        keys: Mapping[str, Callable[[], Series]],
        hz: float | None = None,
        source: str = "the recording states",
    ) -> int:
        """Read what an episode has at each key: all numbers and times, and some frames.

        Args:
            name: of the episode.
            keys: how each is opened.
            hz: the rate that clocks are compared with; `source` says who stated it.

        Returns:
            the frames of the first camera that can be opened; 0 where there is none.
        """
        self.episode(name)
        first: Series | None = None
        for key, opened in keys.items():
            with self.reading(name, key):
                series = opened()
                if series.info:
                    self.infos.setdefault(key, series.info)
                first = first or (series if series.frames else None)
                values = series.numbers() if series.numbers else None
                times = series.times
                if values is not None:
                    self.numbers(name, key, values)
                    if times is None and is_times(key, values.shape[1:]):
                        times = seconds_of(values, key)
                if times is not None:
                    clock = self.times(name, key, times, camera=bool(series.frames))
                    self.made |= {"rate"} if hz else set()
                    for found in checks.drift(f"{name}: {key}", clock.hz, hz, source):
                        self.note(found)
                if series.frames and first and series.count:
                    self._frames(name, key, series.frames, series)
                    if first.times is not None and times is not None and series is not first:
                        period_s = checks.measure(first.times).period_s
                        self.skew(key, checks.skew(times, first.times), period_s)
        return first.count if first else 0

    def _frames(self, name: str, key: str, frames: Callable[..., Any], series: Series) -> None:
        for run in checks.runs(checks.choose(series.count, self.pairs, series.starts)):
            for start, images in checks.stacked(frames(run)):
                self.pictures(name, key, images, run[start : start + len(images)], series.codec)

    def links(self, root: Path, told: Collection[Path] = ()) -> None:
        """Note the links under a folder that are not followed; see `unfollowed`."""
        for found in unfollowed(root, told):
            self.note(found)

    def episode(self, name: str) -> None:
        """Note that an episode is sampled."""
        self.looked.append(name)

    def fault(self, name: str, fault: HMAError, key: str = "") -> None:
        """Note an episode, or a key of it, that cannot be read."""
        self._faults.setdefault((name, key), fault)

    def note(self, finding: Finding, name: str = "") -> None:
        """Add a finding of a recording, or of one episode; those that say the same become one."""
        self.made.add(finding.check)
        self._found.append((name, finding))

    def lengths(self, name: str, length: int, sizes: Mapping[str, int], wanted: Sequence[str]) -> None:
        """Note the rows of an episode's keys, and the keys that are missing."""
        self.made |= {"keys", "rows"}
        absent = [key for key in wanted if key not in sizes]
        if absent:
            self.note(
                Finding("keys", "warn", f"{name}: has no {listed(absent)}", numbers={"keys": absent}), name
            )
        odd = {key: sizes[key] for key in wanted if key in sizes and sizes[key] != length}
        if odd:
            said = listed([f"{key} has {size}" for key, size in odd.items()])
            self.note(Finding("rows", "warn", f"{name}: of {length} frames, {said}", numbers=odd), name)

    def numbers(self, name: str, key: str, values: Array, begin: int = 0) -> None:
        """Add a vector (T, …) of an episode, or the part of it that begins at step `begin`."""
        if values.dtype.kind not in "fiub" or not len(values):
            return
        self.made |= {"finite", "constant"}
        flat: Array = values.reshape(len(values), -1)
        blank = np.full(flat.shape[1], np.nan)
        held = self._numbers.setdefault(key, _Numbers(blank, blank.copy()))
        if len(held.low) != flat.shape[1]:
            return  # another width than before: the source reports it
        infinite = 0
        if flat.dtype.kind == "f":
            finite = np.isfinite(flat)
            infinite = int(finite.size - np.count_nonzero(finite))
        if infinite:
            if not held.infinite:
                step = begin + int(np.argwhere(~finite)[0, 0])
                held.first = f"{name}: {key} is not finite at step {step}"
            held.episodes += held.last != name
            held.last = name
            flat = np.where(finite, flat, np.nan)
        held.low = np.fmin(held.low, np.fmin.reduce(flat, axis=0))
        held.high = np.fmax(held.high, np.fmax.reduce(flat, axis=0))
        held.rows += len(flat)
        held.values += flat.size
        held.infinite += infinite

    def pictures(self, name: str, key: str, frames: Images, indices: Ints, codec: str | None) -> None:
        """Add some images (n, H, W, 3) of an episode's camera, and the indices of their frames."""
        self.made |= {"size", "blank", "colour"} | ({"still"} if (np.diff(indices) == 1).any() else set())
        look = self.looks.setdefault(key, CameraLook(lossless=codec not in LOSSY))
        look.add(frames, indices, again=self._shown.get(key) == name)
        self._shown[key] = name

    def times(
        self, name: str, key: str, seconds: Floats, camera: bool = False, back_remedy: str = ""
    ) -> StreamTimes:
        """Add the times (T,) of one key of an episode, in the order of receipt; return what they show.

        `back_remedy` is what helps where they go back.
        """
        self.made |= {"repeated", "back", "gaps"} | ({"frames"} if camera else set())
        found = self._times[key][name] = checks.measure(seconds)
        for one in checks.time_findings(key, found, camera, "" if self.alone else name):
            remedy = back_remedy if one.check == "back" else one.remedy
            if one.check == "gaps" and camera and self.by_field:  # a bag may be divided there
                remedy = f"no window crosses it; {divide_remedy(checks.pause_s(found.period_s))}"
            self.note(replace(one, remedy=remedy), name)
        return found

    def skew(self, key: str, found: tuple[float, float, float] | None, period_s: float) -> None:
        """Note how far a stream is from the primary stream's frames; `period_s` is their median interval."""
        self.made.add("skew")
        self._skew[key] = found
        own = max((times.period_s for times in self._times[key].values()), default=0.0)
        if found and found[1] > 1e3 * max(period_s, own):
            said = f"{key}: p95 {found[1]:.1f} ms from the first camera's frames, max {found[2]:.1f} ms"
            numbers = dict(zip(("p50_ms", "p95_ms", "max_ms"), found, strict=True))
            remedy = "the stream pauses or loses messages; check the recording"
            self.note(Finding("skew", "warn", said, remedy, key, numbers))

    # -- results

    def rate(self, key: str) -> float | None:
        """Return the first rate in Hz that was measured by the clock of a key."""
        return next((times.hz for times in self._times[key].values() if times.hz), None)

    def inspection(
        self,
        format: str,
        uri: str,
        keys: Iterable[KeyInfo],
        lengths: Sequence[int],
        facts: Mapping[str, str],
        **about: Any,
    ) -> Inspection:
        """Return the inspection; `lengths` are of the readable episodes, `about` more of its attributes."""
        measured = tuple(map(self.key, keys))
        return Inspection(
            format=format,
            uri=uri,
            episodes=self.episodes,
            keys=measured,
            frames=sum(lengths) if len(lengths) == self.episodes else None,
            lengths=tuple(lengths[:MAX_LENGTHS]),
            facts={name: fact for name, fact in facts.items() if fact},
            looked_at=len(self.looked),
            findings=self.findings(measured),
            checks=tuple(check for check in CHECKS if check in self.made),
            **about,
        )

    def key(self, info: KeyInfo) -> KeyInfo:
        """Return the key with what was measured of it."""
        held, look = self._numbers.get(info.key), self.looks.get(info.key)
        clock = info.topic.name if info.topic else info.key
        times = self._times[clock].values()
        if held is not None:
            still, ends = _still(held), _finite(held)
            info = replace(
                info,
                constant=bool(still) and len(still) == len(held.low) and not held.infinite,
                still=tuple(still),
                low=float(ends.min()) if len(ends) else None,
                high=float(ends.max()) if len(ends) else None,
            )
        if times:
            rates = [one.hz for one in times if one.hz]
            jitters = [one.jitter_ms for one in times if one.jitter_ms is not None]
            stated = info.hz and any(abs(one / info.hz - 1) <= checks.DRIFT for one in rates)
            info = replace(
                info,
                hz=info.hz if stated or not rates else float(np.median(rates)),
                jitter_ms=float(np.median(jitters)) if jitters else info.jitter_ms,
                skew_ms=self._skew.get(clock),
            )
        if look is not None:
            info = replace(info, swapped=look.swapped()[0] or None)
            if len(look.sizes) == 1:  # of images of one size, which metadata may state wrong
                shape = (*next(iter(look.sizes)), *info.shape[2:])
                info = replace(info, shape=shape, moves_in=look.moving.box)
        return info

    def findings(self, keys: Sequence[KeyInfo]) -> tuple[Finding, ...]:
        """Return all findings, check by check."""
        found = [
            *self._readable(keys), *_merged(self._found), *self._finite(), *self._constant(keys),
            *checks.picture_findings(self.looks),
        ]  # fmt: skip
        order = list(CHECKS)
        return tuple(sorted(found, key=lambda one: order.index(one.check) if one.check in order else 99))

    def _readable(self, keys: Sequence[KeyInfo]) -> Iterator[Finding]:
        faulty = dict.fromkeys(name for name, _ in self._faults)
        looked = len(faulty | dict.fromkeys(self.looked))
        whole = sum(not key for _, key in self._faults)
        severity: Severity = "error" if whole and whole >= looked else "warn"
        groups = alike((name, fault) for (name, _), fault in self._faults.items())
        for names, first in groups[:MAX_NAMES]:
            said = f"{first.where}: {first.fault}"
            if len(names) > 1:
                named = said if said.startswith(names[0]) else f"{names[0]}: {said}"
                said = f"{len(names):,} of {looked:,} sampled episodes, such as {named}"
            yield Finding("readable", severity, said, first.remedy, numbers={"episodes": len(names)})
        rest = sum(len(names) for names, _ in groups[MAX_NAMES:])
        if rest:
            said = f"{rest:,} more of {looked:,} sampled episodes cannot be read"
            yield Finding("readable", severity, said, numbers={"episodes": rest})
        missing = any(one.check == "files" and one.severity == "warn" for _, one in self._found)
        shown = any(look.images for look in self.looks.values())
        told = bool(groups) and severity == "error"  # no episode could be read at all
        if (faulty or missing) and not shown and not told and any(key.kind == "camera" for key in keys):
            yield Finding("readable", "error", "no image of the sampled episodes can be read")

    def _finite(self) -> Iterator[Finding]:
        for key, held in self._numbers.items():
            if held.infinite:
                said = f"{held.first} ({held.infinite:,} of {held.values:,} values checked"
                said += f", in {held.episodes} episodes)" if held.episodes > 1 else ")"
                numbers = {"count": held.infinite, "values": held.values}
                yield Finding("finite", "warn", said, key=key, numbers=numbers)
            furthest = float(max(_finite(held), key=abs, default=0.0))
            if abs(furthest) > FLOAT32_MAX:
                said = f"{key} reaches {furthest:.3g}, float32 holds up to {FLOAT32_MAX:.3g}"
                remedy = "an episode that uses it as action or state is refused"
                yield Finding("finite", "warn", said, remedy, key, {"value": furthest})

    def _constant(self, keys: Sequence[KeyInfo]) -> Iterator[Finding]:
        names = {info.key: info.names for info in keys}
        whole: list[str] = []
        for key, held in self._numbers.items():
            still, command = _still(held), bool(_COMMANDS.search(key.lower()))
            if not still:
                continue
            if len(still) == len(held.low) and not command:
                whole.append(key)
                continue
            stated = names.get(key)
            said = (
                "" if len(held.low) == 1 else f" in dim{'s' * (len(still) > 1)} {', '.join(map(str, still))}"
            )
            if stated and len(stated) == len(held.low):
                said = f" in {listed([stated[i] for i in still])}"
            severity: Severity = "warn" if command and not self.by_field else "info"
            numbers = {"dims": still, "rows": held.rows}
            yield Finding("constant", severity, f"{key} never changes{said}", key=key, numbers=numbers)
        if whole:
            said = f"never change at all: {listed(whole)}"
            yield Finding("constant", "info", said, numbers={"keys": whole})


def _still(held: _Numbers) -> list[int]:
    """Return the indices of the values that never change."""
    return [int(i) for i in np.flatnonzero(held.low == held.high)] if held.rows > 1 else []


def _finite(held: _Numbers) -> Array:
    """Return the smallest and largest finite number of each value."""
    ends = np.array([*held.low, *held.high])
    return ends[np.isfinite(ends)]


def alike(faults: Iterable[tuple[str, HMAError]]) -> list[tuple[list[str], HMAError]]:
    """Group (episode, fault) by what the faults say, whatever their numbers; the largest group first.

    Returns:
        For each group the names of its episodes, and the first fault.
    """
    groups: dict[tuple[str, str], tuple[dict[str, None], HMAError]] = {}
    for name, fault in faults:
        kind = _plain(fault.fault), _plain(fault.remedy)
        groups.setdefault(kind, ({}, fault))[0][name] = None
    found = [(list(names), first) for names, first in groups.values()]
    return sorted(found, key=lambda group: -len(group[0]))


def _merged(found: list[tuple[str, Finding]]) -> Iterator[Finding]:
    """Yield one finding for each check and key, or of those without key that say the same: the first.

    Its message tells how many others there are.
    """
    together: dict[tuple[str, str, str], list[tuple[str, Finding]]] = {}
    for name, one in found:
        about = one.key or _plain(one.message.removeprefix(name))
        together.setdefault((one.check, one.severity, about), []).append((name, one))
    for (name, first), *more in together.values():
        others = len({other for other, _ in more} - {name})
        told = f"and in {others:,} more episodes" if others else f"and {len(more)} more like it"
        yield replace(first, message=f"{first.message} ({told})") if more else first


def _plain(text: str) -> str:
    """Return a text with 0 for each number, so that texts of one kind are equal."""
    return re.sub(r"\d[\d.,]*", "0", text)


def sampled(count: int, wanted: int) -> list[int]:
    """Return the indices of `wanted` episodes or frames, spread evenly over all `count`."""
    return [int(i) for i in np.unique(np.linspace(0, count - 1, min(wanted, count)).astype(np.int64))]


def listed(words: Sequence[str], limit: int = 8) -> str:
    """Return the first `limit` words, and how many more there are."""
    more = f" and {len(words) - limit} more" if len(words) > limit else ""
    return ", ".join(words[:limit]) + more
