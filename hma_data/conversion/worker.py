"""Make one unit of a conversion: its episodes become a shard, a part of a LeRobotDataset, or both.

A unit is whole or absent. An episode that cannot be used is listed with its reason in the shard's footer, or
in the part's. The bytes do not depend on the engine that runs the work.

n frames of a camera, S×S pixels.
"""

import sys
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass

import numpy as np

from hma_data.arrays import Array, Float32s, Images, Ints
from hma_data.conversion.engines import Attempt, Report, Work
from hma_data.conversion.extend import Content
from hma_data.conversion.lerobot import LeRobotOutput, PartWriter
from hma_data.conversion.output import Made
from hma_data.conversion.plan import ShardUnit
from hma_data.conversion.reading import (
    End,
    Frames,
    Item,
    Job,
    ReadEpisode,
    Tick,
    UnitNotes,
    frames_of,
    prefetch,
    read_unit,
    signs_of_life,
)
from hma_data.cpu import usable_cores
from hma_data.episodes.images import prepared
from hma_data.shards.schema import Refused, RowLayout
from hma_data.shards.writer import ShardWriter
from hma_data.sources.base import open_source
from hma_data.tokenizers.base import Tokenizer, get_tokenizer

FRAMES_A_BATCH = 32  # decoded and tokenized together


@dataclass(frozen=True)
class MakeWork:
    """A maker of a worker's function; it can be pickled, so that any engine can send it.

    Attributes:
        job: of the shards, or of the LeRobotDataset.
        tokenizer: of the shards, if it is open already.
        beside: of the LeRobotDataset whose parts are made with the shards.
    """

    job: Job
    tokenizer: Tokenizer | None = None
    beside: Job | None = None

    def __call__(self, workers: int) -> Work:
        """Open source and output once for this worker, and return the worker's function."""
        job, beside = self.job, LeRobotOutput(self.beside) if self.beside else None
        source = open_source(job.embodiment.source.format)
        output = self._output(beside.batch if beside else FRAMES_A_BATCH)
        threads = max(1, usable_cores() // workers) if self.tokenizer is None else None

        def work(unit: ShardUnit, report: Report, attempt: Attempt) -> Made:
            if threads and "torch" in sys.modules:  # applies to the calling thread alone
                sys.modules["torch"].set_num_threads(threads)
            report(Tick())  # the worker's start, which may take seconds, is no part of the rate
            both = beside is not None and not beside.has(unit)
            readers = [output.frames, beside.frames] if beside and both else [output.frames]
            items = read_unit(job, source, unit, readers, report, attempt)
            # A second attempt reads one step at a time, which shows whose fault it is.
            items = items if attempt.number else prefetch(items)
            # The shards count what is done; the dataset gives signs of life alone.
            making = beside.making(unit, lambda _: report(Tick())) if beside and both else nullcontext()
            with making as part:
                done = output.make(unit, _of_first(items, part), report)
            report(Tick(bytes=done.bytes))
            return done

        return work

    def _output(self, batch: int) -> "ShardOutput | LeRobotOutput":
        if self.job.facts.get("to") == "lerobot":
            return LeRobotOutput(self.job)
        tokenizer = self.tokenizer
        if tokenizer is None:
            tokenizer = get_tokenizer(self.job.tokenizer, weights=self.job.weights, device=self.job.device)
        return ShardOutput(self.job, tokenizer, batch)


def _of_first(items: Iterator[tuple[int, Item]], others: PartWriter | None) -> Iterator[Item]:
    """Yield the items of the first output; add those of the second to its part."""
    for output, item in items:
        if output and others is not None:
            others.add(item)
        else:
            yield item


class ShardOutput:
    """The output of a conversion to shards: tokens of frames, and numbers.

    Args:
        batch: rows whose frames are decoded together.
    """

    def __init__(self, job: Job, tokenizer: Tokenizer, batch: int) -> None:
        self._job, self._tokenizer, self._batch = job, tokenizer, batch

    def frames(self, episode: ReadEpisode, report: Report | None) -> Iterator[Frames]:
        """Yield the frames of an episode as squares (n, S, S, 3); add what they show to its flags."""
        clip, spec = episode.clip, self._job.layout.tokenizer
        content = Content(clip, episode.kept)

        def show(name: str, start: int, rows: Ints) -> tuple[Images, Images]:
            camera, stream = self._job.embodiment.camera(name), clip.episode.streams[name]
            indices = clip.frame_indices[name][rows]
            frames = prepared(stream, indices, camera, spec.image_size, spec.resize_filter)
            content.add(name, start, frames)
            return frames, frames

        yield from frames_of(self._job, episode, self._batch, report, show)
        episode.content = content.text()

    def make(self, unit: ShardUnit, items: Iterator[Item], report: Report) -> Made:
        """Tokenize and write the episodes of one shard, whole or not at all."""
        layout = self._job.layout
        noted = UnitNotes(self._job, unit)
        with ExitStack() as committing:
            writer = committing.enter_context(
                ShardWriter(self._job.out / unit.name, layout.schema, self._tokenizer.spec)
            )
            for item in _tokenized(items, self._tokenizer, report):
                if isinstance(item, Refused):
                    noted.refuse(item, report)
                    continue
                start = writer.rows
                writer.add(item.index, _columns(item, layout))
                noted.add(item, start, report)
            writer.close(noted.footer())
            with signs_of_life(report):  # an upload may take longer than the limit for a hanging worker
                committing.close()
        return Made(unit.name, writer.bytes, writer.sha256)


def _tokenized(
    items: Iterator[Item], tokenizer: Tokenizer, report: Report
) -> Iterator[ReadEpisode | Refused]:
    """Yield whole and refused episodes in order; a batch may hold frames of several episodes."""
    batches = Batches(tokenizer.encode, FRAMES_A_BATCH)
    unfinished: deque[ReadEpisode | Refused] = deque()
    begun: ReadEpisode | None = None

    def ready() -> Iterator[ReadEpisode | Refused]:
        while unfinished:
            first = unfinished[0]
            if isinstance(first, ReadEpisode) and (first.waiting or not first.read):
                return
            yield unfinished.popleft()

    for item in items:
        if isinstance(item, Frames):
            assert begun is not None
            report(Tick(frames=batches.add(begun, item.camera, item.frames)))
        elif isinstance(item, End):
            assert begun is not None
            begun.read = True
            begun = None
        else:
            if begun is not None:  # it begins again or is refused: what came of it is void
                batches.drop(begun)
                unfinished.pop()
            unfinished.append(item)
            begun = item if isinstance(item, ReadEpisode) else None
        yield from ready()
    report(Tick(frames=batches.flush()))
    yield from ready()


def _columns(item: ReadEpisode, layout: RowLayout) -> dict[str, Array | None]:
    """Return the columns of the episode's rows; strided rows hold the whole chunk of actions."""
    clip, kept = item.clip, item.kept
    steps = len(kept) * layout.frame_stride
    actions: Float32s = clip.actions[:steps].reshape(len(kept), -1)
    known = clip.action_known
    if known is not None:
        known = np.all(known[:steps].reshape(len(kept), -1), axis=1)
        actions = np.where(known[:, None], actions, np.float32(0))
    return {
        **{column: np.concatenate(item.tokens[camera]) for camera, column in layout.token_columns.items()},
        "timestamp": clip.timestamps[kept],
        "action": actions,
        "state": None if clip.states is None else clip.states[kept],
        "action_known": known,
        "state_known": None if clip.state_known is None else clip.state_known[kept],
    }


class Batches:
    """A queue of frames for `encode`, which gets `size` frames at a time whatever the episodes' lengths.

    Args:
        encode: frames (n, S, S, 3) -> tokens (n, …); a frame's tokens do not depend on the other frames.
        size: frames a call; only `flush` makes a smaller call.
    """

    def __init__(self, encode: Callable[[Images], Array], size: int) -> None:
        self._encode, self._size = encode, size
        self._queue: deque[tuple[ReadEpisode, str, Images]] = deque()
        self._queued = 0

    def add(self, episode: ReadEpisode, camera: str, frames: Images) -> int:
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

    def drop(self, episode: ReadEpisode) -> None:
        """Forget the frames of an episode."""
        self._queue = deque(item for item in self._queue if item[0] is not episode)
        self._queued -= episode.waiting

    def _next(self, count: int) -> int:
        owners: list[tuple[ReadEpisode, str, int]] = []
        pieces: list[Images] = []
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
