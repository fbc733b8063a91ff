"""Make one shard: read, align, tokenize and write its episodes.

An episode that cannot be used is listed with its reason in the shard's footer. The shard is whole or
absent. Its bytes do not depend on the engine that runs the work.

n frames of a camera, S×S pixels.
"""

import json
import sys
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event, Thread
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from hma_data.conversion.engines import FIRST_ATTEMPT, Attempt, Report, Step, Work
from hma_data.conversion.extend import Content, kept_frames
from hma_data.conversion.output import Made
from hma_data.conversion.plan import ShardUnit, camera_fault, read_clip
from hma_data.cpu import usable_cores
from hma_data.episodes.align import pauses, rate_flags
from hma_data.episodes.episode import Clip
from hma_data.episodes.images import PictureCheck, picture_flags, prepared
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
from hma_data.shards.writer import EpisodeRows, ShardWriter
from hma_data.sources.base import EpisodeRef, Expecting, Source, open_source
from hma_data.storage.fetch import EPISODE_WAITS_S as WAITS_S
from hma_data.storage.fetch import disk_is_full, storage_is_away, worth_another_try
from hma_data.tokenizers.base import Tokenizer, get_tokenizer

FRAMES_A_BATCH = 32  # decoded and tokenized together
SIGN_EVERY_S = 20.0
FATAL = TokenizerError, OutputError, ShardError, RegistryError, MissingDependencyError  # no episode's fault

Frames = NDArray[np.uint8]


@dataclass(frozen=True)
class Job:
    """The values a worker needs to make any shard of a conversion."""

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
    """The size of a camera's recorded frames in pixels, reported in the first episode of a shard."""

    camera: str
    height: int
    width: int


@dataclass(frozen=True)
class MakeWork:
    """A maker of a worker's function; it can be pickled, so that any engine can send it."""

    job: Job
    tokenizer: Tokenizer | None = None

    def __call__(self, workers: int) -> Work:
        """Open the tokenizer once for this worker, and return the worker's function."""
        tokenizer = self.tokenizer
        if tokenizer is None:
            tokenizer = get_tokenizer(self.job.tokenizer, weights=self.job.weights, device=self.job.device)
        threads = max(1, usable_cores() // workers) if self.tokenizer is None else None
        job = self.job

        def work(unit: ShardUnit, report: Report, attempt: Attempt) -> Made:
            if threads and "torch" in sys.modules:  # applies to the calling thread alone
                sys.modules["torch"].set_num_threads(threads)
            done = make_shard(job, unit, tokenizer, report, attempt)
            report(Tick(bytes=done.bytes))
            return done

        return work


def make_shard(
    job: Job, unit: ShardUnit, tokenizer: Tokenizer, report: Report, attempt: Attempt = FIRST_ATTEMPT
) -> Made:
    """Read, align, tokenize and write the episodes of one shard."""
    layout = job.layout
    rows: list[EpisodeRow] = []
    refused: list[Refused] = []
    stats = layout.empty_stats()

    with ExitStack() as committing:
        writer = committing.enter_context(ShardWriter(job.out / unit.name, layout.schema, tokenizer.spec))
        report(Tick())  # the worker's start, which may take seconds, is no part of the rate
        decoded = _decoded(job, unit, report, attempt)
        ahead = prefetch(decoded) if not attempt.number else decoded  # one at a time: shows whose fault it is
        for item in _tokenized(ahead, tokenizer, report):
            if isinstance(item, Refused):
                refused.append(item)
                report(Tick(episodes=1, quarantined=1))
                continue
            start = writer.rows
            writer.add(_cut(item, layout))
            stats["action"].merge(Stats.of(item.clip.known_actions))
            if item.clip.known_states is not None:
                stats["state"].merge(Stats.of(item.clip.known_states))
            rows.append(_row(item, unit, start, writer.rows - start))
            report(Tick(episodes=1))
        writer.close(Footer(job.facts, unit.name, unit.split, tuple(rows), tuple(refused), stats))
        with _signs_of_life(report):  # an upload may take longer than the limit for a hanging worker
            committing.close()
    return Made(unit.name, writer.bytes, writer.sha256)


@contextmanager
def _signs_of_life(report: Report) -> Iterator[None]:
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


@dataclass(eq=False)
class _Episode:
    """An episode on its way from the recording to the shard.

    Attributes:
        content: hash over what was read of it.
        read: whether all its frames are in the queue, or encoded.
        waiting: frames that are in the queue.
        tokens: camera -> tokens of the frames that are encoded.
        flags: of its grid and its frames, see `rate_flags` and `picture_flags`.
    """

    index: int
    ref: EpisodeRef
    clip: Clip
    content: Content
    read: bool = False
    waiting: int = 0
    tokens: defaultdict[str, list[NDArray[Any]]] = field(default_factory=lambda: defaultdict(list))
    flags: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class _Frames:
    """The next frames (n, S, S, 3) of a camera of the episode that was begun."""

    camera: str
    frames: Frames


class _End:
    """The end of the episode that was begun: all its frames have come."""


# An episode is begun by itself, goes on with its frames, and ends with _End; or it is refused.
Decoded = _Episode | _Frames | _End | Refused


def _decoded(job: Job, unit: ShardUnit, report: Report, attempt: Attempt) -> Iterator[Decoded]:
    """Read the episodes of a shard, each as the items that `Decoded` names.

    This runs ahead in a thread. An episode may begin again, or be refused, after some of its frames; its
    earlier items are then void.
    """
    source = open_source(job.embodiment.source.format)
    if isinstance(source, Expecting):
        with suppress(HMAError):  # reading raises it too, for the episode at fault
            source.expect(job.source, [ref.id for _, ref in unit.episodes])
    for place, (index, ref) in enumerate(unit.episodes):
        if ref.id in attempt.refused:
            yield Refused(ref.id, "Fatal", f"{ref.id}: reading it {attempt.refused[ref.id]}")
            continue
        report(Step(ref.id))
        for wait_s in (*WAITS_S, None):
            try:
                yield from _episode(job, source, index, ref, None if place else report)
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
                yield Refused(ref.id, type(fault).__name__, text)
                break


def _episode(
    job: Job, source: Source, index: int, ref: EpisodeRef, report: Report | None = None
) -> Iterator[Decoded]:
    layout = job.layout
    spec = layout.tokenizer
    clip = read_clip(source, job.source, ref.id, job.embodiment, layout.cameras)
    kept = kept_frames(clip, layout)
    content = Content(clip, kept)
    episode = _Episode(index, ref, clip, content, flags=rate_flags(clip, job.embodiment))
    yield episode
    for name in layout.cameras:
        camera, stream = job.embodiment.camera(name), clip.episode.streams[name]
        seen = PictureCheck()
        try:
            if report:
                report(Seen(name, *clip.frames_at(name, kept[:1]).shape[1:3]))
            for start in range(0, len(kept), FRAMES_A_BATCH):
                indices = clip.frame_indices[name][kept[start : start + FRAMES_A_BATCH]]
                frames = prepared(stream, indices, camera, spec.image_size, spec.resize_filter)
                content.add(start, frames)
                seen.add(frames)
                yield _Frames(name, frames)
        except EpisodeError as fault:
            if len(layout.cameras) == 1:
                raise
            raise camera_fault(ref.id, name, layout.cameras, fault) from fault
        episode.flags |= picture_flags(seen, job.embodiment.quality, ref.id, name)
    yield _End()


def _tokenized(
    items: Iterator[Decoded], tokenizer: Tokenizer, report: Report
) -> Iterator[_Episode | Refused]:
    """Yield whole and refused episodes in order; a batch may hold frames of several episodes."""
    batches = Batches(tokenizer.encode, FRAMES_A_BATCH)
    unfinished: deque[_Episode | Refused] = deque()
    begun: _Episode | None = None

    def ready() -> Iterator[_Episode | Refused]:
        while unfinished:
            first = unfinished[0]
            if isinstance(first, _Episode) and (first.waiting or not first.read):
                return
            yield unfinished.popleft()

    for item in items:
        if isinstance(item, _Frames):
            assert begun is not None
            report(Tick(frames=batches.add(begun, item.camera, item.frames)))
        elif isinstance(item, _End):
            assert begun is not None
            begun.read = True
            begun = None
        else:
            if begun is not None:  # it begins again or is refused: what came of it is void
                batches.drop(begun)
                unfinished.pop()
            unfinished.append(item)
            begun = item if isinstance(item, _Episode) else None
        yield from ready()
    report(Tick(frames=batches.flush()))
    yield from ready()


def _cut(item: _Episode, layout: RowLayout) -> EpisodeRows:
    """Return the episode's rows; strided rows hold the whole chunk of actions."""
    clip, kept = item.clip, layout.kept(len(item.clip))
    steps = len(kept) * layout.frame_stride
    actions: NDArray[np.float32] = clip.actions[:steps].reshape(len(kept), -1)
    known = clip.action_known
    if known is not None:
        known = np.all(known[:steps].reshape(len(kept), -1), axis=1)
        actions = np.where(known[:, None], actions, np.float32(0))
    first, *further = layout.token_columns.items()
    return EpisodeRows(
        episode_index=item.index,
        timestamps=clip.timestamps[kept],
        tokens=np.concatenate(item.tokens[first[0]]),
        actions=actions,
        states=None if clip.states is None else clip.states[kept],
        further={column: np.concatenate(item.tokens[camera]) for camera, column in further},
        action_known=known,
        state_known=None if clip.state_known is None else clip.state_known[kept],
    )


def _row(item: _Episode, unit: ShardUnit, start: int, rows: int) -> EpisodeRow:
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
        content=item.content.text(),
    )


class Batches:
    """A queue of frames for `encode`, which gets `size` frames at a time whatever the episodes' lengths.

    Args:
        encode: frames (n, S, S, 3) -> tokens (n, …); a frame's tokens do not depend on the other frames.
        size: frames a call; only `flush` makes a smaller call.
    """

    def __init__(self, encode: Callable[[Frames], NDArray[Any]], size: int) -> None:
        self._encode, self._size = encode, size
        self._queue: deque[tuple[_Episode, str, Frames]] = deque()
        self._queued = 0

    def add(self, episode: _Episode, camera: str, frames: Frames) -> int:
        """Queue the next frames of an episode's camera; return how many frames were encoded by this call."""
        self._queue.append((episode, camera, frames))
        self._queued += len(frames)
        episode.waiting += len(frames)
        encoded = 0
        while self._queued >= self._size:
            encoded += self._next(self._size)
        return encoded

    def flush(self) -> int:
        """Encode the frames that are left; return their number."""
        return self._next(self._queued) if self._queued else 0

    def drop(self, episode: _Episode) -> None:
        """Forget the frames of an episode."""
        self._queue = deque(item for item in self._queue if item[0] is not episode)
        self._queued -= episode.waiting

    def _next(self, count: int) -> int:
        owners: list[tuple[_Episode, str, int]] = []
        pieces: list[Frames] = []
        left = count
        while left:
            episode, camera, frames = self._queue.popleft()
            if len(frames) > left:
                self._queue.appendleft((episode, camera, frames[left:]))
                frames = frames[:left]
            owners.append((episode, camera, len(frames)))
            pieces.append(frames)
            left -= len(frames)
        tokens = self._encode(pieces[0] if len(pieces) == 1 else np.concatenate(pieces))
        self._queued -= count
        at = 0
        for episode, camera, length in owners:
            episode.tokens[camera].append(tokens[at : at + length])
            episode.waiting -= length
            at += length
        return count


def prefetch[T](items: Iterator[T], depth: int = 3) -> Iterator[T]:
    """Yield the same items in the same order; a thread reads up to `depth` of them ahead.

    An error of `items` is raised in the place of the item.
    """
    end = object()
    pool = ThreadPoolExecutor(1)
    try:
        ahead = deque(pool.submit(next, items, end) for _ in range(depth))
        while (item := ahead.popleft().result()) is not end:
            ahead.append(pool.submit(next, items, end))
            yield cast(T, item)
    finally:
        pool.shutdown(cancel_futures=True)
