"""Make one shard: read, align, tokenize and write its episodes.

An episode that cannot be used is listed with its reason in the shard's footer. The shard is whole or
absent. Its bytes do not depend on the engine that runs the work.
"""

import json
import sys
import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from queue import Queue
from threading import Event, Thread
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.conversion.batching import Batches
from hma_data.conversion.engines.base import FIRST, Attempt, Report, Step, Work
from hma_data.conversion.episode_hash import Content, rows_kept
from hma_data.conversion.output import Made
from hma_data.conversion.plan import ShardUnit
from hma_data.cpu import usable_cores
from hma_data.episodes.align import to_clip
from hma_data.episodes.episode import Clip
from hma_data.episodes.images import prepared
from hma_data.errors import (
    HMAError,
    MissingDependencyError,
    OutputError,
    RegistryError,
    ShardError,
    TokenizerError,
)
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.schema import EpisodeRow, Footer, Refused, arrow_schema, flags_text, mask_columns
from hma_data.shards.stats import Stats
from hma_data.shards.writer import EpisodeRows, ShardWriter
from hma_data.sources.base import EpisodeRef, Source, open_source
from hma_data.storage.fetch import EPISODE_WAITS_S as WAITS_S
from hma_data.storage.fetch import disk_is_full, storage_is_away, worth_another_try
from hma_data.tokenizers.base import Tokenizer, TokenizerSpec, get_tokenizer

BATCH = 32  # frames decoded and tokenized together
BEAT_S = 20.0
FATAL = (
    TokenizerError,
    OutputError,
    ShardError,
    RegistryError,
    MissingDependencyError,
)  # not the fault of one episode


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


@dataclass(frozen=True)
class Tick:
    """Counts that a worker reports to the console."""

    frames: int = 0
    episodes: int = 0
    quarantined: int = 0
    bytes: int = 0


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
    job: Job, unit: ShardUnit, tokenizer: Tokenizer, report: Report, attempt: Attempt = FIRST
) -> Made:
    """Read, align, tokenize and write the episodes of one shard."""
    embodiment, strided = job.embodiment, job.facts["frames"] == "strided"
    cameras: list[str] = job.facts["cameras"]
    width = embodiment.chunk_dim if strided else embodiment.action_dim
    state_width = embodiment.state.dims if embodiment.state else 0
    schema = arrow_schema(tokenizer.spec, width, state_width, len(cameras), mask_columns(embodiment))
    rows: list[EpisodeRow] = []
    refused: list[Refused] = []
    stats = {"action": Stats.empty(embodiment.action_dim)}
    if state_width:
        stats["state"] = Stats.empty(state_width)

    with ExitStack() as committing:
        writer = committing.enter_context(ShardWriter(job.out / unit.name, schema, tokenizer.spec))
        decoded = _decoded(job, unit, tokenizer, report, attempt)
        ahead = prefetch(decoded) if not attempt.number else decoded  # one at a time: shows whose fault it is
        for item in _tokenized(ahead, tokenizer, report):
            if isinstance(item, Refused):
                refused.append(item)
                report(Tick(episodes=1, quarantined=1))
                continue
            start = writer.rows
            for piece in _cut(item, cameras, embodiment.stride if strided else 1):
                writer.add(piece)
            stats["action"].merge(Stats.of(item.clip.known_actions))
            if item.clip.known_states is not None:
                stats["state"].merge(Stats.of(item.clip.known_states))
            rows.append(_row(item, unit, start, writer.rows - start, len(cameras)))
            report(Tick(episodes=1))
        writer.close(Footer(job.facts, unit.name, unit.split, tuple(rows), tuple(refused), stats))
        with _signs_of_life(report):  # an upload may take longer than the limit for a hanging worker
            committing.close()
    return Made(unit.name, writer.bytes, writer.sha256)


@contextmanager
def _signs_of_life(report: Report) -> Iterator[None]:
    over = threading.Event()

    def beat() -> None:
        while not over.wait(BEAT_S):
            report(Tick())

    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@dataclass
class _Begin:
    index: int
    ref: EpisodeRef
    clip: Clip
    content: Content  # complete at the _End


@dataclass
class _Frames:
    camera: str
    frames: NDArray[np.uint8]


@dataclass
class _End:
    """The end of the episode that was begun."""


@dataclass
class _Whole:
    index: int
    ref: EpisodeRef
    clip: Clip
    content: str
    tokens: dict[str, NDArray[Any]]


Decoded = _Begin | _Frames | _End | Refused


def _decoded(
    job: Job, unit: ShardUnit, tokenizer: Tokenizer, report: Report, attempt: Attempt
) -> Iterator[Decoded]:
    """Yield for each episode a _Begin, its pictures in batches, and an _End; or a Refused.

    This runs ahead in a thread. An episode may begin again, or be refused, after some of its pictures; its
    earlier items are then void.
    """
    source = open_source(job.embodiment.source.format)
    for index, ref in unit.episodes:
        if ref.id in attempt.refused:
            yield Refused(ref.id, "Fatal", f"{ref.id}: reading it {attempt.refused[ref.id]}")
            continue
        report(Step(ref.id))
        for wait_s in (*WAITS_S, None):
            try:
                yield from _episode(job, source, tokenizer.spec, index, ref)
                break
            except (*FATAL, MemoryError):
                raise
            except Exception as fault:  # no fault of a decoder on one recording may end the job
                if disk_is_full(fault):
                    raise OutputError(
                        ref.id, f"there is no space to unpack it: {fault}", "free space"
                    ) from fault
                if wait_s is not None and worth_another_try(fault):
                    time.sleep(wait_s)
                    continue
                if storage_is_away(fault):
                    remedy = "everything finished is kept: run the same command again"
                    raise OutputError(job.source, f"storage does not answer: {fault}", remedy) from fault
                text = str(fault) if isinstance(fault, HMAError) else f"{type(fault).__name__}: {fault}"
                yield Refused(ref.id, type(fault).__name__, text)
                break


def _episode(job: Job, source: Source, spec: TokenizerSpec, index: int, ref: EpisodeRef) -> Iterator[Decoded]:
    clip = to_clip(source.read(job.source, ref.id, job.embodiment), job.embodiment)
    kept = rows_kept(clip, job.embodiment, job.facts["frames"])
    content = Content(clip, kept)
    yield _Begin(index, ref, clip, content)
    for name in job.facts["cameras"]:
        camera = job.embodiment.camera(name)
        for start in range(0, len(kept), BATCH):
            indices = clip.frame_indices[name][kept[start : start + BATCH]]
            stream = clip.episode.streams[name]
            frames = prepared(stream, indices, camera, spec.image_size, spec.resize_filter)
            content.add(start, frames)
            yield _Frames(name, frames)
    yield _End()


def _tokenized(items: Iterator[Decoded], tokenizer: Tokenizer, report: Report) -> Iterator[_Whole | Refused]:
    """Yield whole and refused episodes in order; a batch may hold frames of several episodes."""
    batches = Batches(tokenizer.encode, BATCH)
    waiting: deque[_Begin | Refused] = deque()
    begun: _Begin | None = None

    def ready() -> Iterator[_Whole | Refused]:
        while waiting:
            first = waiting[0]
            if isinstance(first, _Begin):
                if first is begun or not batches.whole(first.index):
                    return
                tokens = batches.take(first.index)
                yield _Whole(first.index, first.ref, first.clip, first.content.text(), tokens)
            else:
                yield first
            waiting.popleft()

    for item in items:
        if begun and isinstance(item, _Begin | Refused):  # its earlier items are void
            batches.drop(begun.index)
            waiting.pop()
            begun = None
        if isinstance(item, Refused):
            waiting.append(item)
        elif isinstance(item, _Begin):
            begun = item
            waiting.append(item)
        elif isinstance(item, _Frames):
            assert begun is not None
            report(Tick(frames=batches.add(begun.index, item.camera, item.frames)))
        else:
            begun = None
        yield from ready()
    report(Tick(frames=batches.flush()))
    yield from ready()


def _cut(item: _Whole, cameras: list[str], stride: int) -> Iterator[EpisodeRows]:
    """Yield the episode's rows, camera after camera; strided rows hold the whole chunk of actions."""
    clip = item.clip
    kept = len(clip) // stride
    actions: NDArray[np.float32] = clip.actions[: kept * stride].reshape(kept, -1)
    known, state_known = clip.action_known, clip.state_known
    if known is not None:
        known = np.all(known[: kept * stride].reshape(kept, -1), axis=1)
        actions = np.where(known[:, None], actions, np.float32(0))
    for camera in cameras:
        yield EpisodeRows(
            episode_index=item.index,
            timestamps=clip.timestamps[: kept * stride : stride],
            tokens=item.tokens[camera],
            actions=actions,
            states=None if clip.states is None else clip.states[: kept * stride : stride],
            camera=camera,
            action_known=known,
            state_known=None if state_known is None else state_known[: kept * stride : stride],
        )


def _row(item: _Whole, unit: ShardUnit, start: int, rows: int, cameras: int) -> EpisodeRow:
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
        length=rows // cameras,
        instruction=clip.episode.instruction,
        success=clip.episode.success,
        fingerprint=item.ref.fingerprint,
        skew_p50_ms=worst[0],
        skew_p95_ms=worst[1],
        skew_max_ms=worst[2],
        skew=json.dumps(skew),
        trimmed=clip.trimmed,
        flags=flags_text(clip.trimmed, clip.flags),
        group=item.ref.group,
        content=item.content,
    )


def prefetch[T](items: Iterable[T], depth: int = 2) -> Iterator[T]:
    """Yield the same items in the same order, read ahead by a thread.

    An error of `items` is raised in the place of the item.

    Args:
        items: used in the thread only.
        depth: how many items may wait.
    """
    queue: Queue[tuple[str, T | BaseException | None]] = Queue(maxsize=depth)
    stop = Event()

    def produce() -> None:
        try:
            for item in items:
                queue.put(("item", item))
                if stop.is_set():
                    return
            queue.put(("end", None))
        except BaseException as fault:  # the reader raises it
            queue.put(("fault", fault))

    thread = Thread(target=produce, daemon=True)
    thread.start()
    try:
        while True:
            kind, value = queue.get()
            if kind == "end":
                return
            if kind == "fault":
                assert isinstance(value, BaseException)
                raise value
            yield value  # type: ignore[misc]
    finally:
        stop.set()
        while thread.is_alive():  # the thread may be waiting to put one more
            while not queue.empty():
                queue.get_nowait()
            thread.join(timeout=0.05)
