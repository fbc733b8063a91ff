"""Load training batches of windows from shards.

`MixtureDataset` streams: it decodes a pool of row groups of each embodiment, shuffles the windows in
them, and goes on to the next pool. The mixture draws the embodiment of each sample.
`WindowDataset` gives any window by number, for evaluation and small data.

The batches depend on (seed, step, rank) alone, never on the number of DataLoader workers: batch t of a rank
is made from lane t mod `lanes`, each lane owns its share of the row groups, and any process can compute
where a lane stands. A run can therefore be resumed exactly from one number per lane and embodiment.

B batch, T frames, h·w grid, c·H·W latents, A action dims, K = stride·A.
"""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from torch.utils.data import DataLoader, Dataset, IterableDataset, get_worker_info

from hma_data.errors import HMAError, ShardError, UsageError
from hma_data.loading.batch import Batch, as_batch, assemble
from hma_data.loading.mixture import TEMPERATURES, Draw, Mixture
from hma_data.loading.pools import Deal, Stream, pool_size
from hma_data.loading.rows import MIB, Decoder
from hma_data.shards.reader import ShardSet
from hma_data.shards.windows import Ints, Short
from hma_data.storage.paths import StrPath

__all__ = ["Batch", "MixtureDataset", "WindowDataset", "as_batch", "open_sets"]


def open_sets(data: Sequence[StrPath | ShardSet]) -> dict[str, ShardSet]:
    """Open shard sets; return embodiment id -> shard set.

    Args:
        data: for each set, the str or path of its folder, its URI, or the set itself.

    Raises:
        ShardError: there are none, two are of one embodiment, or their tokenizers differ.
    """
    sets: dict[str, ShardSet] = {}
    for item in data:
        shards = item if isinstance(item, ShardSet) else ShardSet(item)
        name = shards.embodiment.id
        if name in sets:
            raise ShardError(
                shards.folder,
                f"is of embodiment {name}, and so is {sets[name].folder}",
                "give each embodiment once",
            )
        sets[name] = shards
    if not sets:
        raise ShardError("data", "names no shard sets", "give at least one --out of hma convert")
    first = next(iter(sets.values()))
    for shards in sets.values():
        if shards.spec != first.spec:
            raise ShardError(
                shards.folder,
                f"was tokenized by {shards.spec.name} ({shards.spec.digest}), {first.folder} by "
                f"{first.spec.name} ({first.spec.digest})",
                "one mixture takes one tokenizer: convert again with the same",
            )
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

    Raises:
        ShardError: the set is damaged or contradicts itself.
    """

    def __init__(
        self,
        data: StrPath | ShardSet,
        split: str,
        frames: int = 12,
        stride: int | None = None,
        short: Short = "drop",
        cache_mib: int = 256,
    ) -> None:
        self.shards = data if isinstance(data, ShardSet) else ShardSet(data)
        _check_frames(frames)
        self._decoder = Decoder(self.shards, split, frames, stride, short, cache_mib * MIB)
        self._short: Short = short
        self.index = self._decoder.index

    def __len__(self) -> int:
        return self.index.count

    def __getitem__(self, window: int) -> Batch:
        return self.batch([window])

    def __getitems__(self, windows: list[int]) -> Batch:
        return self.batch(windows)  # a DataLoader calls this where a dataset makes whole batches

    def batch(self, windows: Sequence[int] | Ints) -> Batch:
        """Return those windows as one batch, in that order.

        Raises:
            IndexError: there are no numbers, or one is outside 0..len-1.
            ShardError: a shard is missing or damaged.
        """
        wanted = np.asarray(windows, np.int64)
        outside = wanted[(wanted < 0) | (wanted >= len(self))]
        if not len(wanted) or len(outside):
            which = f"window {outside[0]}" if len(outside) else "no window"
            raise IndexError(f"{which} of the {len(self)} of {self.shards.folder}")
        index = self.index
        first = index.first_rows(wanted)
        last = index.last_rows(wanted) if index.padded_episodes else None
        group = np.searchsorted(index.edges, first, side="right") - 1
        over = np.minimum(first + index.span - 1, index.last_rows(wanted)) >= index.edges[group + 1]
        places, cuts = [], []  # a window may continue in the next row group
        for key in np.unique(2 * group + over):
            chosen = np.flatnonzero(2 * group + over == key)
            rows = self._decoder.rows(int(key // 2), whole=bool(key % 2))
            edge = index.edges[key // 2]
            end = None if last is None else last[chosen] - edge
            cuts.append(rows.cut(first[chosen] - edge, end, index))
            places.append(chosen)
        joined = {name: np.concatenate([cut[name] for cut in cuts]) for name in cuts[0]}
        order = np.concatenate(places)
        joined["camera"] = index.cameras(wanted)[order]
        name = self.shards.embodiment.id
        return assemble({name: self.shards}, [name] * len(wanted), {name: (order, joined)}, self._short)


class MixtureDataset(IterableDataset[Batch]):
    """An endless stream of batches over a mixture of shard sets.

    Iterate it directly, or `batches(workers)` for decoding in other processes; both can be
    resumed with `state_dict` and `load_state_dict`. A torch DataLoader, or torchdata's
    StatefulDataLoader, with batch_size=None gives the same batches in the same order.

    Every lane reads all windows of an embodiment that has fewer windows than there are lanes in all ranks.
    The windows of other embodiments are divided, so that lanes and ranks never share a window.

    Args:
        data: shard sets, each of another embodiment.
        batch_size: B on this rank.
        frames: T.
        temperature, weights, groups, caps, max_epochs, samples, draw: of the mixture, see `Mixture.of`; the
            temperature is 3 for train and 4 for val by default.
        seed: of draws and shuffles.
        rank, world: number of this process, and of all processes that train together; their windows are
            disjoint.
        split: train or val.
        short: "drop" or "pad": what happens to episodes shorter than a window.
        pool: row groups decoded together for an embodiment and lane; None: as `memory_mib` allows, at most 8.
        lanes: independent streams per rank; at least the number of workers for full speed.
        memory_mib: memory for decoded rows in all lanes together, in MiB, about.

        Raises:
            ShardError: the sets do not fit together, or one has no window or is damaged.
            UsageError: a value is out of range.
    """

    def __init__(
        self,
        data: Sequence[StrPath | ShardSet],
        batch_size: int,
        frames: int = 12,
        *,
        temperature: float | None = None,
        weights: Mapping[str, float] | None = None,
        groups: Mapping[str, str] | None = None,
        caps: Mapping[str, float] | None = None,
        max_epochs: float | None = None,
        samples: int | None = None,
        draw: Draw = "per_sample",
        seed: int = 0,
        rank: int = 0,
        world: int = 1,
        split: str = "train",
        short: Short = "drop",
        pool: int | None = None,
        lanes: int = 4,
        memory_mib: int = 1024,
    ) -> None:
        if batch_size < 1 or not 0 <= rank < world:
            raise UsageError("batches", f"batch_size {batch_size}, rank {rank} of {world} is not possible")
        if lanes < 1 or (pool is not None and pool < 1):
            raise UsageError("batches", f"lanes {lanes}, pool {pool} must be at least 1")
        _check_frames(frames)
        self.sets = open_sets(data)
        self.batch_size, self.rank, self.world, self.lanes = batch_size, rank, world, lanes
        self.seed, self._short = seed, short
        share = memory_mib * MIB / len(self.sets)
        self._decoders = {
            name: Decoder(shards, split, frames, None, short, int(share / 5))
            for name, shards in self.sets.items()
        }
        _check_windows(self._decoders, frames, split)
        counts = {name: decoder.index.count for name, decoder in self._decoders.items()}
        self.mixture = Mixture.of(
            counts,
            TEMPERATURES.get(split, 3.0) if temperature is None else temperature,
            weights=weights,
            groups=groups,
            caps=caps,
            max_epochs=max_epochs,
            samples=samples,
            draw=draw,
            seed=seed,
        )
        self._pools = [pool or pool_size(d, share * 4 / 5 / lanes) for d in self._decoders.values()]
        self._deals: dict[int, Deal] = {}
        self._streams: dict[tuple[int, int], Stream] = {}
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
            step, taken = self._step, self._taken
            lane, draws = step % self.lanes, self._draws(step)
            self._step, self._taken = step + 1, _counted(taken, lane, draws)
            if (step - (self._origin or 0)) % workers == worker:
                try:
                    batch = self._make(lane, draws, taken[lane])
                except HMAError:
                    self._step, self._taken = step, taken
                    raise
                yield batch

    def batches(self, workers: int = 0, context: str = "spawn") -> Iterator[Batch]:
        """Yield the same batches, decoded by `workers` processes; `state_dict` counts what is yielded here.

        Args:
            context: how the processes start: spawn, fork, forkserver.

        Raises:
            ShardError: a shard is missing or damaged.
        """
        if not workers:
            yield from self
            return
        loader = DataLoader(
            _Carrier(self),
            batch_size=None,
            num_workers=workers,
            multiprocessing_context=context,
            prefetch_factor=4,
        )
        for batch in loader:
            if isinstance(batch, HMAError):
                raise batch
            lane, draws = self._step % self.lanes, self._draws(self._step)
            self._step, self._taken = self._step + 1, _counted(self._taken, lane, draws)
            yield batch

    def realised(self) -> list[dict[str, float | str | int]]:
        """Return what this rank has drawn of each embodiment beside what was intended: `Mixture.table`."""
        return self.mixture.table(self._taken.sum(axis=0))

    def _draws(self, step: int) -> Ints:
        """Return the embodiments (B,) of this rank's batch `step`, as indices."""
        if self.mixture.draw == "per_batch":
            return self.mixture.batch(step * self.world + self.rank, self.batch_size)
        whole = self.mixture.batch(step, self.batch_size * self.world)
        return whole[self.rank * self.batch_size : (self.rank + 1) * self.batch_size]

    def _make(self, lane: int, draws: Ints, taken: Ints) -> Batch:
        names = self.mixture.names
        pieces = {}
        order = np.argsort(draws, kind="stable")
        for places in np.split(order, np.flatnonzero(np.diff(draws[order])) + 1):
            which = int(draws[places[0]])
            stream = self._stream(lane, which)
            pieces[names[which]] = (places, stream.take(int(taken[which]), len(places)))
        return assemble(self.sets, [names[i] for i in draws], pieces, self._short)

    def _stream(self, lane: int, which: int) -> Stream:
        if (lane, which) not in self._streams:
            decoder = self._decoders[self.mixture.names[which]]
            if which not in self._deals:
                self._deals[which] = Deal.of(decoder.index, self.world * self.lanes)
            reader = self.rank * self.lanes + lane
            self._streams[lane, which] = Stream(
                decoder, self._deals[which], self.seed, reader, self._pools[which]
            )
        return self._streams[lane, which]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_streams": {}, "_deals": {}}  # a worker makes these anew

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
                    f"has {key} {state.get(key)}, this run has {mine}",
                    "go on with the settings and data it was saved with, or begin anew",
                )
        step, taken = _place(state, self._taken.shape, self.batch_size)
        if state.get("rank") != self.rank:
            taken = np.zeros_like(taken)
            for before in range(step):
                taken = _counted(taken, before % self.lanes, self._draws(before))
        self._step, self._taken = step, taken
        self._origin = state.get("origin") if get_worker_info() else None


class _Carrier(IterableDataset[Any]):
    """A dataset that yields its errors as items: torch would pass on only their text."""

    def __init__(self, dataset: MixtureDataset) -> None:
        self._dataset = dataset

    def __iter__(self) -> Iterator[Batch | HMAError]:
        try:
            yield from self._dataset
        except HMAError as fault:
            yield fault


def _place(state: Mapping[str, Any], shape: tuple[int, ...], batch_size: int) -> tuple[int, Ints]:
    """Return the step and the counts of a state; raise UsageError where they do not agree."""
    try:
        step, taken = int(state["step"]), np.asarray(state["taken"], np.int64)
    except (KeyError, TypeError, ValueError) as fault:
        raise UsageError("sampler state", f"is damaged: {fault}", "begin anew") from fault
    if step < 0 or taken.shape != shape or (taken < 0).any() or taken.sum() != step * batch_size:
        raise UsageError(
            "sampler state",
            f"is damaged: counts {taken.sum()} windows of {taken.shape} streams at step {step}, "
            f"not {step * batch_size} of {shape}",
            "begin anew",
        )
    return step, taken


def _check_frames(frames: int) -> None:
    if frames < 1:
        raise UsageError("frames", f"of a window must be at least 1, are {frames}")


def _check_windows(decoders: Mapping[str, Decoder], frames: int, split: str) -> None:
    """Raise ShardError where a set has no window, or where its first row group with windows is damaged."""
    for decoder in decoders.values():
        index = decoder.index
        if not index.count:
            raise ShardError(
                decoder.shards.folder,
                f"has no window of {frames} frames, {index.row_stride} rows apart, in {split} "
                f"({index.short_episodes} episodes, all shorter)",
                "use fewer frames, or leave this embodiment out",
            )
    with ThreadPoolExecutor(min(8, len(decoders))) as threads:
        list(threads.map(Decoder.check, decoders.values()))


def _counted(taken: Ints, lane: int, draws: Ints) -> Ints:
    counted = taken.copy()
    counted[lane] += np.bincount(draws, minlength=taken.shape[1])
    return counted
