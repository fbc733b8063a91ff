"""Load training batches of windows from shards.

`MixtureDataset` streams: it decodes a pool of row groups of each embodiment, shuffles the windows in
them, and goes on to the next pool. The mixture draws the embodiment of each sample.
`WindowDataset` gives any window by number, for evaluation and small data.

The batches depend on (seed, step, rank) alone, never on the number of DataLoader workers: batch t of a rank
is made from lane t mod `lanes`, each lane owns its share of the row groups, and any process can compute
where a lane stands. A run can therefore be resumed exactly from one number per lane and embodiment.

B batch, T frames, h·w grid, c·H·W latents, A action dims, K = stride·A.
"""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any

import numpy as np
from torch import cuda
from torch.utils.data import Dataset, IterableDataset, get_worker_info

from hma_data.arrays import Indices, Ints
from hma_data.errors import ShardError, UsageError
from hma_data.loading.mixture import TEMPERATURES, Mixture
from hma_data.loading.pools import UnitAssignment, WindowSequence, pool_size
from hma_data.loading.rows import MIB, Batch, RowDecoder, as_batch, assemble
from hma_data.loading.views import FIRST_CAMERA, Cameras, Views, by_number, view_count
from hma_data.shards.reader import ShardSet
from hma_data.shards.schema import joined
from hma_data.shards.windows import Short
from hma_data.storage.paths import StrPath

AHEAD, AHEAD_BYTES = 32, 8 * MIB  # most batches of a lane that are cut together, and their windows

__all__ = ["Batch", "MixtureDataset", "WindowDataset", "as_batch", "open_sets"]


def open_sets(data: Sequence[StrPath | ShardSet], cameras: Cameras = FIRST_CAMERA) -> dict[str, ShardSet]:
    """Open shard sets; return embodiment id -> shard set.

    Args:
        data: for each set, the str or path of its folder, its URI, or the set itself.
        cameras: the cameras that windows will take, see `hma_data.loading.views`.

    Raises:
        ShardError: there are none, two are of one embodiment, or their tokenizers differ.
        UsageError: a set lacks a camera.
    """
    sets: dict[str, ShardSet] = {}
    for item in data:
        shards = item if isinstance(item, ShardSet) else ShardSet(item)
        name = shards.embodiment.id
        if name in sets:
            fault = f"has embodiment {name}, and so has {sets[name].folder}"
            remedy = "give each embodiment once; hma shards merge makes one set of several"
            raise ShardError(shards.folder, fault, remedy)
        Views.of(shards, cameras)
        sets[name] = shards
    if not sets:
        raise ShardError("data", "names no shard sets", "give the --out of at least one hma convert")
    first, *others = sets.values()
    for shards in others:
        if shards.spec != first.spec:
            mine, other = (f"{spec.name} ({spec.digest})" for spec in (shards.spec, first.spec))
            fault = f"was tokenized by {mine}, but {first.folder} by {other}"
            raise ShardError(shards.folder, fault, "a mixture needs one tokenizer: convert one of them again")
    return sets


class WindowDataset(Dataset[Batch]):
    """The windows of one shard set, by number.

    A torch DataLoader takes it with `collate_fn=as_batch`.

    Args:
        data: str or path of the shard set, its URI, or the set itself.
        split: train or val.
        frames: T.
        stride: rows between frames; None takes the embodiment's.
        short: "drop" or "pad": what happens to episodes shorter than a window.
        cache_mib: memory for decoded row groups that are kept, in MiB.
        cameras: `first`, `drawn`, a name, or the names of several cameras, whose views are stacked along the
            height of the token grid. With `drawn`, a window's camera follows from its number.

    Raises:
        ShardError: the set is damaged or contradicts itself.
        UsageError: the set lacks a camera.
    """

    def __init__(
        self,
        data: StrPath | ShardSet,
        split: str,
        frames: int = 12,
        stride: int | None = None,
        short: Short = "drop",
        cache_mib: int = 256,
        cameras: Cameras = FIRST_CAMERA,
    ) -> None:
        self.shards = data if isinstance(data, ShardSet) else ShardSet(data)
        self._decoder = RowDecoder(self.shards, split, frames, stride, short, cache_mib * MIB, cameras)
        self._short: Short = short
        self._views = view_count(cameras)
        self.index = self._decoder.index

    def __len__(self) -> int:
        return self.index.count

    def __getitem__(self, window: int) -> Batch:
        return self.batch([window])

    def __getitems__(self, windows: list[int]) -> Batch:
        return self.batch(windows)  # a DataLoader calls this where a dataset makes whole batches

    def batch(self, windows: Indices) -> Batch:
        """Return those windows as one batch, in that order.

        Raises:
            IndexError: there are no numbers, or one is outside 0..len-1.
            ShardError: a shard is missing or damaged.
        """
        numbers = np.asarray(windows, np.int64)
        if not len(numbers) or numbers.min() < 0 or numbers.max() >= len(self):
            raise IndexError(f"window numbers must be 0 to {len(self) - 1} in {self.shards.folder}")
        index = self.index
        first = index.first_rows(numbers)
        last = index.last_rows(numbers) if index.padded_episodes else None
        group = np.searchsorted(index.edges, first, side="right") - 1
        over = np.minimum(first + index.span - 1, index.last_rows(numbers)) >= index.edges[group + 1]
        camera, view = self._decoder.views.taken(by_number(numbers))
        samples, cuts = [], []  # a window may continue in the next row group
        for key in np.unique(2 * group + over):
            chosen = np.flatnonzero(2 * group + over == key)
            rows = self._decoder.rows(int(key // 2), whole=bool(key % 2))
            edge = index.edges[key // 2]
            end = None if last is None else last[chosen] - edge
            views = None if view is None else view[chosen]
            cuts.append(rows.cut(first[chosen] - edge, end, index, views))
            samples.append(chosen)
        order = np.concatenate(samples)
        name = self.shards.embodiment.id
        cut = {name: (order, joined(cuts) | {"camera": camera[order]})}
        return next(assemble(self.shards.spec, [name] * len(numbers), cut, self._short, self._views))


class MixtureDataset(IterableDataset[Batch]):
    """An endless stream of batches over a mixture of shard sets.

    Iterate it directly, or `batches(workers)` for batches made ahead by threads; both can be
    resumed with `state_dict` and `load_state_dict`. A torch DataLoader, or torchdata's
    StatefulDataLoader, with batch_size=None gives the same batches in the same order.

    Every lane reads all windows of an embodiment that has fewer windows than there are lanes in all ranks.
    The windows of other embodiments are divided, so that lanes and ranks never share a window.

    Args:
        data: shard sets, each of another embodiment.
        batch_size: B on this rank.
        frames: T.
        temperature: of the mixture; by default 3 for train and 4 for val.
        seed: of draws and shuffles.
        rank, world: number of this process, and of all processes that train together; their windows are
            disjoint.
        split: train or val.
        short: "drop" or "pad": what happens to episodes shorter than a window.
        pool: row groups decoded together for an embodiment and lane; None: as `memory_mib` allows, at most 8.
        lanes: independent streams per rank; a multiple of the number of workers for full speed.
        memory_mib: memory for decoded rows in all lanes together, in MiB, about.
        cameras: `first`, `drawn` (a camera for each window), a name, or the names of several cameras, whose
            views are stacked along the height of the token grid.
        mixture: weights, groups, caps, max_epochs, samples and draw, as in `Mixture.of`.

    Raises:
        ShardError: the sets do not fit together, or one has no window.
        UsageError: a value is out of range, or a set lacks a camera.
    """

    def __init__(
        self,
        data: Sequence[StrPath | ShardSet],
        batch_size: int,
        frames: int = 12,
        *,
        temperature: float | None = None,
        seed: int = 0,
        rank: int = 0,
        world: int = 1,
        split: str = "train",
        short: Short = "drop",
        pool: int | None = None,
        lanes: int = 4,
        memory_mib: int = 1024,
        cameras: Cameras = FIRST_CAMERA,
        **mixture: Any,
    ) -> None:
        if not 0 <= rank < world:
            raise UsageError("rank", f"{rank} is not one of 0 to {world - 1}")
        for name, value in (("batch_size", batch_size), ("lanes", lanes), ("pool", pool)):
            if value is not None and value < 1:
                raise UsageError(name, f"must be at least 1, not {value}")
        self.sets = open_sets(data, cameras)
        self._cameras = cameras if isinstance(cameras, str) else list(cameras)
        self.batch_size, self.rank, self.world, self.lanes = batch_size, rank, world, lanes
        self.seed, self._short = seed, short
        share = memory_mib * MIB / len(self.sets)
        self._decoders = {
            name: RowDecoder(shards, split, frames, None, short, int(share / 5), cameras)
            for name, shards in self.sets.items()
        }
        for decoder in self._decoders.values():
            _require_windows(decoder)
        counts = {name: decoder.index.count for name, decoder in self._decoders.items()}
        temperature = TEMPERATURES.get(split, 3.0) if temperature is None else temperature
        self.mixture = Mixture.of(counts, temperature, seed=seed, **mixture)
        self._pools = [pool or pool_size(d, share * 4 / 5 / lanes) for d in self._decoders.values()]
        self._assignments: dict[int, UnitAssignment] = {}
        self._sequences: dict[tuple[int, int], WindowSequence] = {}
        self._drawn: dict[int, Ints] = {}
        self._ahead: dict[int, tuple[int, Iterator[Batch]]] = {}  # lane -> its next step, and batches
        self._step = 0
        self._origin: int | None = None  # in a DataLoader worker: the step that worker 0 began with
        self._taken: Ints = np.zeros((lanes, len(counts)), np.int64)

    def __iter__(self) -> Iterator[Batch]:
        """Yield batches from where `load_state_dict` left off; in a DataLoader worker, the worker's share."""
        info = get_worker_info()
        worker, workers = (info.id, info.num_workers) if info else (0, 1)
        if info and self._origin is None:
            self._origin = self._step  # the DataLoader asks worker 0 for this one
        while True:
            mine = (self._step - (self._origin or 0)) % workers == worker
            # Batches of a lane are cut ahead only where the lane stays with this worker.
            batch = self._batch(ahead=self.lanes % workers == 0) if mine else None
            self._advance()
            if batch is not None:
                yield batch

    def batches(self, workers: int = 0) -> Iterator[Batch]:
        """Yield the same batches, made ahead by `workers` threads; `state_dict` counts what is yielded here.

        Reading, decompressing and copying release the interpreter's lock, and a thread's batches need not be
        sent to another process. A lane is made by one thread at a time, so more threads than lanes wait.

        Raises:
            ShardError: a shard is missing or damaged.
        """
        if not workers:
            yield from self
            return
        for batch in self._made_ahead(workers):
            self._advance()
            yield batch

    def _advance(self) -> None:
        """Count the windows of this step's batch as taken, and go to the next step."""
        self._taken[self._step % self.lanes] += self._counts(self._draws(self._step))
        self._step += 1

    def _counts(self, draws: Ints) -> Ints:
        return np.bincount(draws, minlength=len(self.sets))

    def _made_ahead(self, workers: int) -> Iterator[Batch]:
        """Yield the batches; while those of a lane are taken, its next ones are made."""
        pool, blocks = ThreadPoolExecutor(workers, "batches"), self._blocks()
        try:
            begun = deque(pool.submit(self._made, *next(blocks)) for _ in range(self.lanes))
            while True:
                made = []
                for _ in range(self.lanes):
                    made.append(begun.popleft().result())
                    begun.append(pool.submit(self._made, *next(blocks)))
                    yield made[-1][0]
                for batches in list(zip(*made, strict=True))[1:]:
                    yield from batches
        finally:
            pool.shutdown(wait=False, cancel_futures=True)

    def _blocks(self) -> Iterator[tuple[int, Ints, Ints]]:
        """Yield what the batches are made from that are cut together: lane, draws, and what was taken before.

        The blocks are those of the first batch of each lane, then the next ones of each lane, and so on.
        """
        step, taken = self._step, self._taken.copy()
        while True:
            for i in range(self.lanes):
                lane, draws = (step + i) % self.lanes, self._drawn_ahead(step + i)
                yield lane, draws, taken[lane].copy()
                taken[lane] += self._counts(draws)
            step += self.lanes * self._some

    def _made(self, lane: int, draws: Ints, taken: Ints) -> list[Batch]:
        batches = self._cut(lane, draws, taken)
        pin = cuda.is_available()  # so that copies to the GPU need not be waited for
        return [batch.pin_memory() if pin else batch for batch in batches]

    def realised(self) -> list[dict[str, float | str | int]]:
        """Return what this rank has drawn of each embodiment beside what was intended: `Mixture.table`."""
        return self.mixture.table(self._taken.sum(axis=0))

    def _draws(self, step: int) -> Ints:
        """Return the embodiments (B,) of this rank's batch `step`, as indices; a few are remembered."""
        if step not in self._drawn:
            if len(self._drawn) > 4 * AHEAD * self.lanes:
                self._drawn.clear()
            size = self.batch_size
            if self.mixture.draw == "per_batch":
                self._drawn[step] = self.mixture.batch(step * self.world + self.rank, size)
            else:  # every rank draws for all, and takes its part
                whole = self.mixture.batch(step, size * self.world)
                self._drawn[step] = whole[self.rank * size : (self.rank + 1) * size]
        return self._drawn[step]

    @cached_property
    def _some(self) -> int:
        """Return the number of batches of a lane that are cut together: with many sets, that is faster."""
        largest = self.batch_size * max(decoder.window_bytes for decoder in self._decoders.values())
        return int(np.clip(AHEAD_BYTES // largest, 1, AHEAD))

    def _drawn_ahead(self, step: int) -> Ints:
        return np.concatenate([self._draws(step + i * self.lanes) for i in range(self._some)])

    def _batch(self, ahead: bool) -> Batch:
        """Return this step's batch; with `ahead`, it is cut with the next ones of its lane."""
        step, lane = self._step, self._step % self.lanes
        expected, batches = self._ahead.get(lane, (step, iter(())))
        batch = next(batches, None) if expected == step else None
        if batch is None:
            draws = self._drawn_ahead(step) if ahead else self._draws(step)
            batches = self._cut(lane, draws, self._taken[lane])
            batch = next(batches)
        self._ahead[lane] = step + self.lanes, batches
        return batch

    def _cut(self, lane: int, draws: Ints, taken: Ints) -> Iterator[Batch]:
        names = self.mixture.names
        windows_of = {}
        order, ends = np.argsort(draws, kind="stable"), np.cumsum(np.bincount(draws)).tolist()
        for which, (start, end) in enumerate(zip([0, *ends], ends)):
            if end > start:
                cut = self._sequence(lane, which).take(int(taken[which]), end - start)
                windows_of[names[which]] = (order[start:end], cut)
        spec, views = next(iter(self.sets.values())).spec, view_count(self._cameras)
        drawn = [names[i] for i in draws]
        return assemble(spec, drawn, windows_of, self._short, views, self.batch_size)

    def _sequence(self, lane: int, which: int) -> WindowSequence:
        if (lane, which) not in self._sequences:
            decoder = self._decoders[self.mixture.names[which]]
            if which not in self._assignments:
                self._assignments[which] = UnitAssignment.of(decoder.index, self.world * self.lanes)
            reader = self.rank * self.lanes + lane
            self._sequences[lane, which] = WindowSequence(
                decoder, self._assignments[which], self.seed, reader, self._pools[which]
            )
        return self._sequences[lane, which]

    def __getstate__(self) -> dict[str, Any]:
        # A worker makes these anew: decoded rows are large, and iterators cannot be sent.
        return {**self.__dict__, "_sequences": {}, "_assignments": {}, "_ahead": {}}

    def state_dict(self) -> dict[str, Any]:
        """Return the position of the stream after the last batch taken, as plain values of a few kB."""
        return {
            "step": self._step,
            "rank": self.rank,
            "origin": self._origin,
            "taken": self._taken.tolist(),
            **self._identity(),
        }

    def _identity(self) -> dict[str, Any]:
        """Return all values that decide which windows come, except the position."""
        index = next(iter(self._decoders.values())).index
        return {
            "names": list(self.mixture.names),
            "counts": list(self.mixture.counts),
            "p": [float(f"{p:.9g}") for p in self.mixture.p],  # the same on every processor
            "draw": self.mixture.draw,
            "batch_size": self.batch_size,
            "frames": index.frames,
            "short": self._short,
            "world": self.world,
            "lanes": self.lanes,
            "pools": self._pools,
            "seed": self.seed,
            "cameras": self._cameras,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`, with any number of workers.

        The state may come from any rank. A state of another rank costs about 20 µs a step, because the draws
        are made again.

        Raises:
            UsageError: the state is of another mixture.
        """
        for key, mine in self._identity().items():
            if state.get(key) != mine:
                raise UsageError(
                    "sampler state",
                    f"was saved with {key} {state.get(key)}, but this run has {mine}",
                    "continue with the same settings and data, or start a new run",
                )
        step = int(state["step"])
        self._step, self._taken = step, np.array(state["taken"], np.int64)
        # Lanes of another rank took windows of other sets. What this rank had taken follows from its draws.
        if state.get("rank") != self.rank:
            self._step, self._taken = 0, np.zeros_like(self._taken)
            while self._step < step:
                self._advance()
        self._ahead.clear()  # cut after other windows
        self._origin = state.get("origin") if get_worker_info() else None


def _require_windows(decoder: RowDecoder) -> None:
    """Raise ShardError where no episode of a set is as long as a window."""
    index, episodes, remedy = decoder.index, "0 episodes", "leave this embodiment out"
    if index.count:
        return
    if index.short_episodes:
        episodes = f"{index.short_episodes} episodes, all shorter"
        remedy = "raise target_hz in its YAML and run hma convert again, or use fewer frames"
    windows = f"no window of {index.frames} frames, {index.row_stride} rows apart"
    raise ShardError(decoder.shards.folder, f"has {windows}, in {decoder.split} ({episodes})", remedy)
