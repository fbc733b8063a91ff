"""Read the episodes of a unit of work one by one, ahead of what is made of them.

Episodes come as items (see `Item`), so that no more than a few frames are in memory. An episode that cannot
be read becomes a refusal with its reason; what is no episode's fault ends the job. Several outputs may be
made of what is read once.

n frames of a camera, H×W pixels, or S×S where they are resized.
"""

import json
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Event, Thread
from typing import Any, cast

import numpy as np

from hma_data.arrays import Array, Images, Indices, Ints
from hma_data.conversion.engines import Attempt, Report, Step
from hma_data.conversion.extend import kept_frames
from hma_data.conversion.plan import ShardUnit, camera_fault, read_clip
from hma_data.episodes.align import pauses, rate_flags
from hma_data.episodes.episode import Clip, OneByOne, Stream
from hma_data.episodes.idle import idle_rows
from hma_data.episodes.images import PictureCheck, picture_flags
from hma_data.errors import (
    EpisodeError,
    HMAError,
    MissingDependencyError,
    OutputError,
    RegistryError,
    ShardError,
    TokenizerError,
)
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.schema import EpisodeRow, Footer, Refused, RowLayout, flags_text
from hma_data.shards.stats import Stats
from hma_data.sources.base import EpisodeRef, Expecting, Source
from hma_data.sources.lerobot.language import to_text
from hma_data.storage.fetch import EPISODE_WAITS_S as WAITS_S
from hma_data.storage.fetch import disk_is_full, storage_is_away, worth_another_try

SIGN_EVERY_S = 20.0
PREFETCHED = 3  # items
FATAL = TokenizerError, OutputError, ShardError, RegistryError, MissingDependencyError  # no episode's fault


@dataclass(frozen=True)
class Job:
    """The values a worker needs to make any unit of a conversion."""

    source: str
    embodiment: Embodiment
    tokenizer: str
    weights: str | None
    device: str
    out: Path
    facts: dict[str, Any]

    @property
    def layout(self) -> RowLayout:
        """Return which frames become rows, and in which columns."""
        return RowLayout.of_plan(self.facts, self.embodiment)


@dataclass(frozen=True)
class Tick:
    """Counts that a worker reports to the console."""

    frames: int = 0
    episodes: int = 0
    quarantined: int = 0
    bytes: int = 0


@dataclass(frozen=True)
class Seen:
    """The size of a camera's recorded frames in pixels, reported in the first episode of a unit."""

    camera: str
    height: int
    width: int


@dataclass(eq=False)
class ReadEpisode:
    """An episode on its way from the recording to the output.

    Attributes:
        kept: (N,) frames of the clip that become rows.
        flags: of its grid and its frames, see `rate_flags` and `picture_flags`.
        language: what is said about its moments, at seconds from the clip's first frame.
        content: hash over what was read of it, where the output keeps one.
        read: whether all its frames are in the queue, or encoded.
        waiting: frames that are in the queue.
        tokens: camera -> tokens of the frames that are encoded.
    """

    index: int
    ref: EpisodeRef
    clip: Clip
    kept: Ints
    flags: dict[str, int]
    language: Sequence[Mapping[str, Any]] = ()
    content: str = ""
    read: bool = False
    waiting: int = 0
    tokens: defaultdict[str, list[Array]] = field(default_factory=lambda: defaultdict(list))


@dataclass(frozen=True)
class Frames:
    """The next frames (n, H, W, 3) of a camera of the episode that was begun."""

    camera: str
    frames: Images


class End:
    """The end of the episode that was begun: all its frames have come."""


# An episode is begun by itself, goes on with its frames, and ends with End; or it is refused.
Item = ReadEpisode | Frames | End | Refused
ReadFrames = Callable[[ReadEpisode, Report | None], Iterator[Frames]]
Show = Callable[[str, int, Ints], tuple[Images, Images]]


def read_unit(
    job: Job,
    source: Source,
    unit: ShardUnit,
    readers: Sequence[ReadFrames],
    report: Report,
    attempt: Attempt,
) -> Iterator[tuple[int, Item]]:
    """Read the episodes of a unit once for all outputs, each as the items that `Item` names.

    This runs ahead in a thread. An episode may begin again, or be refused, after some of its frames; its
    earlier items are then void. One output may refuse an episode that another takes.

    Args:
        readers: of each output: yields the frames of an episode as the output needs them, and adds to the
            episode's flags; the last is given `report` for the first episode, to report what it has seen.

    Yields:
        the number of an output, and its next item.
    """
    if isinstance(source, Expecting):
        with suppress(HMAError):  # reading raises it too, for the episode at fault
            source.expect(job.source, [ref.id for _, ref in unit.episodes])
    for place, (index, ref) in enumerate(unit.episodes):
        missing = dict(enumerate(readers))  # of the outputs that do not have the episode yet
        if ref.id in attempt.refused:
            refused = Refused(ref.id, "Fatal", f"{ref.id}: reading it {attempt.refused[ref.id]}")
            yield from ((output, refused) for output in missing)
            continue
        report(Step(ref.id))
        for wait_s in (*WAITS_S, None):
            try:
                for output, item in _read(job, source, index, ref, missing, None if place else report):
                    if isinstance(item, End):
                        del missing[output]
                    yield output, item
                break
            except (*FATAL, MemoryError):
                raise
            except Exception as fault:  # no fault of a decoder on one recording may end the job
                if disk_is_full(fault):
                    text = f"there is no space to unpack it: {fault}"
                    raise OutputError(ref.id, text, "free space") from fault
                if wait_s is not None and worth_another_try(fault):
                    time.sleep(wait_s)
                    continue
                if storage_is_away(fault):
                    remedy = "everything finished is kept: run the same command again"
                    raise OutputError(job.source, f"storage does not answer: {fault}", remedy) from fault
                text = str(fault) if isinstance(fault, HMAError) else f"{type(fault).__name__}: {fault}"
                refused = Refused(ref.id, type(fault).__name__, text)
                yield from ((output, refused) for output in missing)
                break


def _read(
    job: Job,
    source: Source,
    index: int,
    ref: EpisodeRef,
    readers: Mapping[int, ReadFrames],
    report: Report | None,
) -> Iterator[tuple[int, Item]]:
    """Yield the items of an episode for each output in turn; raise the fault of one when the others end."""
    episode = _begin(job, source, index, ref)
    if len(readers) > 1:
        streams = episode.clip.episode.streams
        for name, stream in list(streams.items()):
            streams[name] = _DecodedOnce(stream)
    going: dict[int, Iterator[Frames]] = {}
    for output, frames in readers.items():
        own = replace(episode, flags=dict(episode.flags), tokens=defaultdict(list))
        going[output] = frames(own, report if output == max(readers) else None)
        yield output, own
    fault: EpisodeError | None = None
    while going:
        for output in list(going):
            try:
                item = next(going[output], None)
            except EpisodeError as refused:
                fault = refused
                del going[output]
                continue
            if item is None:
                del going[output]
            yield output, item or End()
    if fault is not None:
        raise fault


class _DecodedOnce:
    """A stream that keeps the frames it decoded last, for several readers that go on in step."""

    def __init__(self, stream: Stream) -> None:
        self.timestamps = stream.timestamps
        self._stream = stream
        self._indices: Ints = np.zeros(0, np.int64)
        self._frames: Images = np.zeros((0, 1, 1, 3), np.uint8)

    def frames(self, indices: Indices) -> Images:
        """See episode.Stream."""
        wanted = np.asarray(indices, np.int64)
        if not np.isin(wanted, self._indices).all():
            distinct = np.unique(wanted)
            self._frames = self._stream.frames(distinct)
            self._indices = distinct
        return self._frames[np.searchsorted(self._indices, wanted)]

    def each(self, indices: Indices, least: int = 0) -> Iterator[Images]:
        """See episode.OneByOne."""
        own = self._stream if isinstance(self._stream, OneByOne) else None
        if own and least:
            return iter(own.each(indices, least))
        try:
            return iter(self.frames(indices))
        except EpisodeError:
            if own is None:
                raise
            return iter(own.each(indices))  # they may differ in size


def _begin(job: Job, source: Source, index: int, ref: EpisodeRef) -> ReadEpisode:
    layout = job.layout
    clip = read_clip(source, job.source, ref.id, job.embodiment, layout.cameras)
    kept = kept_frames(clip, layout)
    flags = rate_flags(clip, job.embodiment)
    if job.facts["settings"].get("drop_idle"):
        idle = idle_rows(clip, job.embodiment, kept, layout.frame_stride)
        kept = kept[~idle]
        flags |= {"idle_frames": int(idle.sum())} if idle.any() else {}
    return ReadEpisode(index, ref, clip, kept, flags, _language(clip))


def frames_of(
    job: Job, episode: ReadEpisode, count: int, report: Report | None, show: Show
) -> Iterator[Frames]:
    """Yield the frames of every camera for the next `count` rows, then for those after; flag what they show.

    Args:
        show: (camera, first row, frames of the clip (n,)) -> its frames (n, H, W, 3) as the output takes
            them, and as they are checked.
    """
    cameras = job.layout.cameras
    checks = {name: PictureCheck() for name in cameras}
    for start in range(0, len(episode.kept), count):
        for name in cameras:
            try:
                if report and not start:
                    report(Seen(name, *episode.clip.frames_at(name, episode.kept[:1]).shape[1:3]))
                frames, checked = show(name, start, episode.kept[start : start + count])
            except EpisodeError as fault:
                if len(cameras) == 1:
                    raise
                raise camera_fault(episode.ref.id, name, cameras, fault) from fault
            checks[name].add(checked)
            yield Frames(name, frames)
    for name, seen in checks.items():
        episode.flags |= picture_flags(seen, job.embodiment.quality, episode.ref.id, name)


def _language(clip: Clip) -> list[dict[str, Any]]:
    """Return what is said about the moments of a clip; what held before it begins holds from its start."""
    items = clip.episode.metadata.get("language", ())
    camera, indices = next(iter(clip.frame_indices.items()))
    times = clip.episode.streams[camera].timestamps
    start = float(times[indices[0]] - times[0])
    later = [dict(item) | {"timestamp": item["timestamp"] - start} for item in items]
    kept = [item for item in later if 0 <= item["timestamp"] <= clip.timestamps[-1] + 1e-4]
    before = {
        item["style"]: item | {"timestamp": 0.0}
        for item in later
        if item["timestamp"] < 0 and item["column"] == "persistent"
    }
    return [*before.values(), *kept]


class UnitNotes:
    """What is noted of a unit's episodes while they are written: the content of its footer."""

    def __init__(self, job: Job, unit: ShardUnit) -> None:
        self._facts, self._unit = job.facts, unit
        self._rows: list[EpisodeRow] = []
        self._refused: list[Refused] = []
        self._stats = job.layout.empty_stats()

    def refuse(self, item: Refused, report: Report) -> None:
        """Note an episode that goes to quarantine."""
        self._refused.append(item)
        report(Tick(episodes=1, quarantined=1))

    def add(self, item: ReadEpisode, start: int, report: Report) -> None:
        """Note an episode that is written, from row `start` on."""
        self._stats["action"].merge(Stats.of(item.clip.known_actions))
        if item.clip.known_states is not None:
            self._stats["state"].merge(Stats.of(item.clip.known_states))
        self._rows.append(_row(item, self._unit, start, len(item.kept)))
        report(Tick(episodes=1))

    def footer(self) -> Footer:
        """Return the footer of the unit."""
        rows, refused = tuple(self._rows), tuple(self._refused)
        return Footer(self._facts, self._unit.name, self._unit.split, rows, refused, self._stats)


def _row(item: ReadEpisode, unit: ShardUnit, start: int, rows: int) -> EpisodeRow:
    clip = item.clip
    skew = {name: [float(v) for v in np.percentile(ms, [50, 95, 100])] for name, ms in clip.skew_ms.items()}
    worst = max(skew.values(), key=lambda values: values[2], default=[0.0, 0.0, 0.0])
    return EpisodeRow(
        episode_index=item.index,
        id=item.ref.id,
        split=unit.split,
        shard=unit.name,
        row_start=start,
        rows=rows,
        length=rows,
        instruction=clip.episode.instruction,
        success=clip.episode.success,
        fingerprint=item.ref.fingerprint,
        skew_p50_ms=worst[0],
        skew_p95_ms=worst[1],
        skew_max_ms=worst[2],
        skew=json.dumps(skew),
        trimmed=clip.trimmed,
        flags=flags_text(clip.trimmed, clip.flags | item.flags, pauses(clip.timestamps)),
        group=item.ref.group,
        content=item.content,
        language=to_text(item.language),
    )


@contextmanager
def signs_of_life(report: Report) -> Iterator[None]:
    """Report from a thread while the block runs, so that the engine does not count it as hung."""
    over = Event()

    def beat() -> None:
        while not over.wait(SIGN_EVERY_S):
            report(Tick())

    thread = Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def prefetch[T](items: Iterator[T]) -> Iterator[T]:
    """Yield the same items in the same order; a thread reads up to PREFETCHED of them ahead.

    An error of `items` is raised in the place of the item.
    """
    end = object()
    pool = ThreadPoolExecutor(1)
    try:
        ahead = deque(pool.submit(next, items, end) for _ in range(PREFETCHED))
        while (item := ahead.popleft().result()) is not end:
            ahead.append(pool.submit(next, items, end))
            yield cast(T, item)
    finally:
        pool.shutdown(cancel_futures=True)
