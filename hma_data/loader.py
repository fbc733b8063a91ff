"""Windows from shards into training batches.

`MixtureDataset` streams: it decodes a few row groups of each embodiment, shuffles the windows in
them, and goes on to the next; which embodiment a sample comes from is the mixture's draw.
`WindowDataset` gives any window by number, for evaluation and small data.

What comes out depends on (seed, step, rank) alone, never on the number of DataLoader workers:
batch t of a rank is made from lane t mod `lanes`, each lane owns its share of the row groups,
and any process can work out where a lane stands. So a run is resumed exactly from two numbers
a lane and embodiment.

B batch, T frames, h·w grid, c·H·W latents, A action dims, K = stride·A.
"""

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, IterableDataset, get_worker_info

from hma_data.errors import ShardError, UsageError
from hma_data.mixture import Mixture
from hma_data.shards.reader import RowGroupCache, ShardSet
from hma_data.shards.schema import mask_columns, token_column
from hma_data.windows import Ints, WindowIndex


@dataclass
class Batch:
    """Windows, as the model takes them.

    Attributes:
        embodiment: B ids; may mix.
        actions: (B, T, Kmax) float32 raw; rows of narrower embodiments are zero at the end.
        action_mask: (B, T) bool, True where the chunk is known: all of its steps are.
        tokens: (B, T, h, w) int64, or None.
        latents: (B, T, c, H, W) float32 as stored, or None.
        episode, frame: (B,) int64, where the window comes from.
    """

    embodiment: list[str]
    actions: Tensor
    action_mask: Tensor
    tokens: Tensor | None = None
    latents: Tensor | None = None
    episode: Tensor | None = None
    frame: Tensor | None = None

    def __len__(self) -> int:
        return len(self.embodiment)

    def to(self, device: torch.device | str) -> "Batch":
        """The same batch elsewhere."""
        return self._map(lambda value: value.to(device, non_blocking=True))

    def pin_memory(self) -> "Batch":
        """Called by a DataLoader with pin_memory=True."""
        return self._map(Tensor.pin_memory)

    def _map(self, change: Any) -> "Batch":
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return Batch(**{k: change(v) if isinstance(v, Tensor) else v for k, v in values.items()})


@dataclass
class _Rows:
    """Decoded rows, contiguous; windows are cut from them."""

    tokens: NDArray[Any]
    actions: NDArray[np.float32]
    episode: NDArray[np.int32]
    frame: NDArray[np.int32]
    known: NDArray[np.bool_]  # whether the row's action is

    def cut(self, first: Ints, index: WindowIndex) -> dict[str, NDArray[Any]]:
        """Windows that start at these rows: tokens (n, T, S), actions (n, T, K), known (n, T), …"""
        steps = first[:, None] + np.arange(0, index.span, index.row_stride)
        every = first[:, None] + np.arange(index.span)
        chunks = self.actions[every].reshape(len(first), index.frames, -1)
        known = np.all(self.known[every].reshape(len(first), index.frames, -1), axis=2)
        return {
            "tokens": self.tokens[steps],
            "actions": chunks,
            "known": known,
            "episode": self.episode[first],
            "frame": self.frame[first],
        }


class _SplitReader:
    """Row groups of one shard set and split, decoded, with the windows in them."""

    def __init__(self, shards: ShardSet, split: str, frames: int, stride: int | None, cache: int) -> None:
        self.shards, self.split = shards, split
        self.index = WindowIndex.of(shards, split, frames, stride)
        self._token_name = token_column(shards.spec)[0]
        self._columns = [self._token_name, "action", "episode_index", "frame_index"]
        self._masks = [name for name in mask_columns(shards.embodiment) if name == "action_known"]
        self._cache = RowGroupCache(shards, split, self._columns + self._masks, cache)

    def rows(self, group: int) -> _Rows:
        """All rows that the windows starting in row group `group` need."""
        parts = [
            self._cache.get(*map(int, self.index.groups[g]))
            for g in range(group, self.index.reach(group) + 1)
        ]
        extra = self.index.span - 1  # rows past the group that its windows may need
        kept = int(self.index.edges[group + 1] - self.index.edges[group]) + extra
        names = self._columns + self._masks
        if len(parts) == 1:
            found = [parts[0][name] for name in names]
        else:
            found = [np.concatenate([part[name] for part in parts])[:kept] for name in names]
        if not self._masks:
            found.append(np.ones(len(found[0]), np.bool_))
        return _Rows(*found)


def open_sets(data: Sequence[str | Path | ShardSet]) -> dict[str, ShardSet]:
    """Shard sets by embodiment id.

    Raises:
        ShardError: none given, two of one embodiment, or sets of different tokenizers.
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


def _assemble(
    sets: Mapping[str, ShardSet], names: list[str], pieces: Mapping[str, tuple[Ints, dict[str, NDArray[Any]]]]
) -> Batch:
    """One batch from the pieces of each embodiment; `pieces[name]` = (places in the batch, windows)."""
    size = len(names)
    width = max(windows["actions"].shape[2] for _, windows in pieces.values())
    frames = next(iter(pieces.values()))[1]["actions"].shape[1]
    actions = np.zeros((size, frames, width), np.float32)
    known = np.ones((size, frames), np.bool_)
    episode, frame = np.zeros(size, np.int64), np.zeros(size, np.int64)
    spec = next(iter(sets.values())).spec
    discrete = spec.kind == "discrete"
    shape = spec.grid if discrete else (spec.channels or 1, *spec.grid)
    tokens = np.empty((size, frames, *shape), np.int64 if discrete else np.float32)
    for places, windows in pieces.values():
        actions[places, :, : windows["actions"].shape[2]] = windows["actions"]
        known[places] = windows["known"]
        episode[places], frame[places] = windows["episode"], windows["frame"]
        tokens[places] = windows["tokens"].reshape(len(places), frames, *shape)
    return Batch(
        embodiment=names,
        actions=torch.from_numpy(actions),
        action_mask=torch.from_numpy(known),
        tokens=torch.from_numpy(tokens) if discrete else None,
        latents=None if discrete else torch.from_numpy(tokens),
        episode=torch.from_numpy(episode),
        frame=torch.from_numpy(frame),
    )


class WindowDataset(Dataset[Batch]):
    """Windows of one shard set by number.

    Args:
        data: the shard set.
        split: train or val.
        frames: T.
        stride: rows between frames; None takes the embodiment's.
        cache: decoded row groups kept.
    """

    def __init__(
        self,
        data: str | Path | ShardSet,
        split: str,
        frames: int = 12,
        stride: int | None = None,
        cache: int = 16,
    ) -> None:
        self.shards = data if isinstance(data, ShardSet) else ShardSet(data)
        self._reader = _SplitReader(self.shards, split, frames, stride, cache)
        self.index = self._reader.index

    def __len__(self) -> int:
        return self.index.count

    def __getitem__(self, window: int) -> Batch:
        return self.batch([window])

    def batch(self, windows: Sequence[int] | Ints) -> Batch:
        """Those windows, in that order.

        Raises:
            IndexError: a number outside 0..len-1.
        """
        wanted = np.asarray(windows, np.int64)
        if len(wanted) and (wanted.min() < 0 or wanted.max() >= len(self)):
            raise IndexError(f"window {wanted.max()} of {len(self)}")
        first = self.index.first_rows(wanted)
        groups = np.searchsorted(self.index.edges, first, side="right") - 1
        name = self.shards.embodiment.id
        parts = []
        for group in np.unique(groups):
            places = np.flatnonzero(groups == group)
            rows = self._reader.rows(int(group))
            parts.append((places, rows.cut(first[places] - self.index.edges[group], self.index)))
        order = np.concatenate([places for places, _ in parts])
        joined = {key: np.concatenate([cut[key] for _, cut in parts]) for key in parts[0][1]}
        return _assemble({name: self.shards}, [name] * len(wanted), {name: (order, joined)})


class _LaneStream:
    """An endless, shuffled sequence of one embodiment's windows for one of `streams` readers.

    Window j is a pure function of j: epoch after epoch, the stream's row groups in a new order, a
    pool of them at a time, the windows of a pool shuffled.
    """

    def __init__(self, reader: _SplitReader, seed: int, stream: int, streams: int, pool: int) -> None:
        self._reader, self._pool = reader, pool
        self._entropy = [seed, zlib.crc32(reader.shards.embodiment.id.encode()), stream]
        index = reader.index
        groups = index.units()
        parts = -(-streams // len(groups))  # few row groups: several streams share one, window by window
        if index.count < streams:
            stream, streams, parts = 0, 1, 1  # fewer windows than readers: all of them see all
        every = np.stack([np.tile(groups, parts), np.repeat(np.arange(parts), len(groups))], axis=1)
        self._units = every[stream::streams]
        self._parts = parts
        sizes = np.diff(index.unit_first)[self._units[:, 0]]
        self._sizes = (sizes - self._units[:, 1] + parts - 1) // parts
        if self._sizes.sum() == 0:  # its share is empty: a part beyond a small group's windows
            self._units, self._parts, self._sizes = every[: len(groups)], 1, np.diff(index.unit_first)[groups]
        self.length = int(self._sizes.sum())
        self._at: tuple[int, int] | None = None

    def take(self, start: int, count: int) -> dict[str, NDArray[Any]]:
        """Windows start to start + count of the sequence."""
        parts = []
        while count:
            epoch, offset = divmod(start, self.length)
            order, ends = self._rounds(epoch)
            number = int(np.searchsorted(ends, offset, side="right"))
            self._load(epoch, number, order)
            inside = offset - (int(ends[number - 1]) if number else 0)
            some = min(count, int(ends[number]) - offset)
            parts.append(self._rows.cut(self._first[inside : inside + some], self._reader.index))
            start, count = start + some, count - some
        return (
            parts[0]
            if len(parts) == 1
            else {key: np.concatenate([p[key] for p in parts]) for key in parts[0]}
        )

    def _rounds(self, epoch: int) -> tuple[Ints, Ints]:
        order = np.random.default_rng([*self._entropy, epoch]).permutation(len(self._units))
        return order, np.cumsum(np.add.reduceat(self._sizes[order], np.arange(0, len(order), self._pool)))

    def _load(self, epoch: int, number: int, order: Ints) -> None:
        if self._at == (epoch, number):
            return
        index = self._reader.index
        loaded, firsts, offset = [], [], 0
        for unit in order[number * self._pool : (number + 1) * self._pool]:
            group, part = (int(v) for v in self._units[unit])
            rows = self._reader.rows(group)
            windows = np.arange(index.unit_first[group] + part, index.unit_first[group + 1], self._parts)
            firsts.append(index.first_rows(windows) - index.edges[group] + offset)
            loaded.append(rows)
            offset += len(rows.frame)
        first = np.concatenate(firsts)
        self._first = first[np.random.default_rng([*self._entropy, epoch, number]).permutation(len(first))]
        join = (lambda arrays: arrays[0]) if len(loaded) == 1 else np.concatenate
        self._rows = _Rows(*(join([getattr(rows, f.name) for rows in loaded]) for f in fields(_Rows)))
        self._at = (epoch, number)


class MixtureDataset(IterableDataset[Batch]):
    """An endless stream of batches over a mixture of shard sets.

    Iterate it directly, or `batches(workers)` for decoding in other processes; both can be
    resumed with `state_dict` and `load_state_dict`. A torch DataLoader with batch_size=None
    gives the same batches in the same order.

    Args:
        data: shard sets, each of another embodiment.
        batch_size: B on this rank.
        frames: T.
        temperature, weights, draw: of the mixture.
        seed: of draws and shuffles.
        rank, world: this process among those that train together; their windows are disjoint.
        pool: row groups decoded together for an embodiment and lane.
        lanes: independent streams a rank; at least the number of workers for full speed.

    Raises:
        ShardError: sets that do not go together, or one without a single window.
    """

    def __init__(
        self,
        data: Sequence[str | Path | ShardSet],
        batch_size: int,
        frames: int = 12,
        *,
        temperature: float = 3.0,
        weights: Mapping[str, float] | None = None,
        draw: Literal["per_sample", "per_batch"] = "per_sample",
        seed: int = 0,
        rank: int = 0,
        world: int = 1,
        split: str = "train",
        pool: int = 4,
        lanes: int = 4,
    ) -> None:
        if batch_size < 1 or not 0 <= rank < world:
            raise UsageError("batches", f"batch_size {batch_size}, rank {rank} of {world} is not possible")
        self.sets = open_sets(data)
        self.batch_size, self.rank, self.world, self.pool, self.lanes = batch_size, rank, world, pool, lanes
        self.seed = seed
        cache = 2 * pool + 2
        self._readers = {name: _SplitReader(s, split, frames, None, cache) for name, s in self.sets.items()}
        for reader in self._readers.values():
            if not reader.index.count:
                raise ShardError(
                    reader.shards.folder,
                    f"has no window of {frames} frames, {reader.index.row_stride} steps apart, in {split} "
                    f"({reader.index.short_episodes} episodes are shorter)",
                    "use fewer frames, or leave this embodiment out",
                )
        counts = {name: reader.index.count for name, reader in self._readers.items()}
        self.mixture = Mixture.of(counts, temperature, weights=weights, draw=draw, seed=seed)
        self._streams: dict[tuple[int, int], _LaneStream] = {}
        self._step = 0
        self._taken: Ints = np.zeros((lanes, len(counts)), np.int64)

    def __iter__(self) -> Iterator[Batch]:
        """Batches from where `load_state_dict` left off; in a DataLoader worker, that worker's share."""
        info = get_worker_info()
        worker, workers = (info.id, info.num_workers) if info else (0, 1)
        step, taken = self._step, self._taken.copy()
        turn = 0
        while True:
            lane, draws = step % self.lanes, self._draws(step)
            if turn % workers == worker:
                batch = self._make(lane, draws, taken[lane])
                if info is None:
                    self._step, self._taken = step + 1, _counted(taken, lane, draws)
                yield batch
            taken = _counted(taken, lane, draws)
            step, turn = step + 1, turn + 1

    def batches(self, workers: int = 0) -> Iterator[Batch]:
        """The same batches, decoded by `workers` processes; `state_dict` follows what was taken from here."""
        if not workers:
            yield from self
            return
        loader = DataLoader(
            self, batch_size=None, num_workers=workers, multiprocessing_context="spawn", prefetch_factor=4
        )
        for batch in loader:
            lane, draws = self._step % self.lanes, self._draws(self._step)
            self._step, self._taken = self._step + 1, _counted(self._taken, lane, draws)
            yield batch

    def _draws(self, step: int) -> Ints:
        """(B,) embodiments of this rank's batch `step`."""
        if self.mixture.draw == "per_batch":
            return self.mixture.batch(step * self.world + self.rank, self.batch_size)
        whole = self.mixture.batch(step, self.batch_size * self.world)
        return whole[self.rank * self.batch_size : (self.rank + 1) * self.batch_size]

    def _make(self, lane: int, draws: Ints, taken: Ints) -> Batch:
        names = self.mixture.names
        pieces = {}
        for which in np.unique(draws):
            places = np.flatnonzero(draws == which)
            stream = self._stream(lane, int(which))
            pieces[names[which]] = (places, stream.take(int(taken[which]), len(places)))
        return _assemble(self.sets, [names[i] for i in draws], pieces)

    def _stream(self, lane: int, which: int) -> _LaneStream:
        if (lane, which) not in self._streams:
            reader = self._readers[self.mixture.names[which]]
            number, streams = self.rank * self.lanes + lane, self.world * self.lanes
            self._streams[lane, which] = _LaneStream(reader, self.seed, number, streams, self.pool)
        return self._streams[lane, which]

    def state_dict(self) -> dict[str, Any]:
        """Where the stream stands, after the last batch that was taken."""
        return {
            "step": self._step,
            "taken": self._taken.tolist(),
            "names": list(self.mixture.names),
            "batch_size": self.batch_size,
            "world": self.world,
            "seed": self.seed,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from `state_dict`.

        Raises:
            UsageError: it is of another mixture.
        """
        mine = self.state_dict()
        for key in ("names", "batch_size", "world", "seed"):
            if state[key] != mine[key]:
                raise UsageError("sampler state", f"has {key} {state[key]}, this run has {mine[key]}")
        taken = np.asarray(state["taken"], np.int64)
        if taken.shape != self._taken.shape:
            raise UsageError("sampler state", f"is of {len(taken)} lanes, this run has {self.lanes}")
        self._step, self._taken = int(state["step"]), taken


def _counted(taken: Ints, lane: int, draws: Ints) -> Ints:
    counted = taken.copy()
    counted[lane] += np.bincount(draws, minlength=taken.shape[1])
    return counted
