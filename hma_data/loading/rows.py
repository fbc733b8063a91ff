"""Decode row groups of a shard set, check them, and cut them into windows.

n windows, T frames, S values a frame, K = stride·A.
"""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.errors import ShardError
from hma_data.shards.reader import ShardSet
from hma_data.shards.schema import mask_columns, token_column
from hma_data.shards.windows import Ints, Short, WindowIndex

MIB = 2**20


@dataclass
class Rows:
    """Decoded rows, from which windows are cut."""

    tokens: NDArray[Any]
    actions: NDArray[np.float32]
    episode: NDArray[np.int32]
    frame: NDArray[np.int32]
    known: NDArray[np.bool_] | None  # True where the row's action is known; None where all are

    @classmethod
    def join(cls, parts: "Sequence[Rows]") -> "Rows":
        """Concatenate parts in their order."""
        if len(parts) == 1:
            return parts[0]
        columns = [[getattr(part, f.name) for part in parts] for f in fields(cls)]
        joined: list[Any] = [None if column[0] is None else np.concatenate(column) for column in columns]
        return cls(*joined)

    def __len__(self) -> int:
        return len(self.frame)

    def first(self, count: int) -> "Rows":
        """Return the first `count` rows."""
        columns = [getattr(self, f.name) for f in fields(Rows)]
        kept: list[Any] = [None if column is None else column[:count] for column in columns]
        return Rows(*kept)

    def cut(self, first: Ints, last: Ints | None, index: WindowIndex) -> dict[str, NDArray[Any]]:
        """Return the windows that start at rows `first` (n,).

        Args:
            last: (n,) last rows of their episodes, beyond which windows are padded; None pads no window.

        Returns:
            tokens (n, T, S), actions (n, T, K), episode (n,) and frame (n,). Where the set has marks or
            windows may be padded, also known (n, T) bool. Where windows may be padded, also inside (n, T)
            bool, True for frames of the episode.
        """
        found = {"episode": self.episode[first], "frame": self.frame[first]}
        if last is not None:
            return found | self._padded(first, last, index)
        found["tokens"] = self.tokens[first[:, None] + np.arange(0, index.span, index.row_stride)]
        found["actions"] = _spans(self.actions, index.span)[first].reshape(len(first), index.frames, -1)
        if self.known is not None:
            known = _spans(self.known[:, None], index.span)[first]
            found["known"] = np.all(known.reshape(len(first), index.frames, -1), axis=2)
        return found

    def _padded(self, first: Ints, last: Ints, index: WindowIndex) -> dict[str, NDArray[Any]]:
        every = first[:, None] + np.arange(index.span)
        inside = every <= last[:, None]
        every = np.minimum(every, last[:, None])
        actions = self.actions[every]
        actions[~inside] = 0
        known = inside if self.known is None else inside & self.known[every]
        return {
            "tokens": self.tokens[every[:, :: index.row_stride]],
            "actions": actions.reshape(len(first), index.frames, -1),
            "known": np.all(known.reshape(len(first), index.frames, -1), axis=2),
            "inside": inside[:, :: index.row_stride],
        }


def _spans(values: NDArray[Any], span: int) -> NDArray[Any]:
    """Return every run of `span` rows, without a copy: (N, A) -> (N - span + 1, span * A)."""
    rows, width = values.shape
    size = values.itemsize
    return np.ndarray(
        (max(0, rows - span + 1), span * width),
        values.dtype,
        buffer=np.ascontiguousarray(values),
        strides=(width * size, size),
    )


class Decoder:
    """The row groups of one split of a shard set, and their windows; the last used row groups stay decoded.

    Args:
        shards, split: the shard set and its split.
        frames, stride, short: see `WindowIndex.of`.
        cache_bytes: memory for decoded rows that are kept; at least two row groups are kept.

    Raises:
        ShardError: the set contradicts itself.
    """

    def __init__(
        self,
        shards: ShardSet,
        split: str,
        frames: int,
        stride: int | None = None,
        short: Short = "drop",
        cache_bytes: int = 256 * MIB,
    ) -> None:
        self.shards, self.split = shards, split
        _check_stride(shards)
        self.index = WindowIndex.of(shards, split, frames, stride, short)
        name, width = token_column(shards.spec)
        robot = shards.embodiment
        self._widths = {name: width, "action": robot.action_dim * shards.manifest.frame_stride}
        self._columns = [name, "action", "episode_index", "frame_index"]
        self._columns += [mask for mask in mask_columns(robot) if mask == "action_known"]
        self._names = shards.shards(split)
        self._kept: OrderedDict[int, Rows] = OrderedDict()
        self._keep = max(2, cache_bytes // max(1, self.group_bytes))

    @property
    def group_bytes(self) -> int:
        """Return the average bytes of a decoded row group."""
        rows = self.index.edges[-1] / max(1, len(self.index.groups))
        token = np.dtype(self.shards.spec.dtype).itemsize
        width, actions = self._widths.values()
        return int(rows * (width * token + actions * 4 + 9))

    def rows(self, group: int, whole: bool = True) -> Rows:
        """Return all rows that the windows starting in row group `group` need; its own rows come first.

        Args:
            whole: False leaves out the rows of the row groups after it.

        Raises:
            ShardError: the shard is missing or damaged, or its rows are not what the set says.
        """
        reach = self.index.reach(group) if whole else group
        if reach == group:
            return self._group(group)
        own = int(self.index.edges[group + 1] - self.index.edges[group])
        parts = [self._group(g) for g in range(group, reach + 1)]
        return Rows.join([parts[0], Rows.join(parts[1:]).first(self.index.span - 1)]).first(
            own + self.index.span - 1
        )

    def check(self) -> None:
        """Decode one row group, so that a fault of all row groups shows before the first batch."""
        if self.index.count:
            self.rows(int(self.index.units()[0]))

    def _group(self, group: int) -> Rows:
        if group not in self._kept:
            shard, number = (int(v) for v in self.index.groups[group])
            values = self.shards.read(self._names[shard], [number], self._columns)
            self._check(group, self._names[shard], values)
            tokens, actions, episode, frame, *known = (values[name] for name in self._columns)
            self._kept[group] = Rows(tokens, actions, episode, frame, known[0] if known else None)
            while len(self._kept) > self._keep:
                self._kept.popitem(last=False)
        self._kept.move_to_end(group)
        return self._kept[group]

    def _check(self, group: int, shard: str, values: dict[str, NDArray[Any]]) -> None:
        fault = self._fault(group, values)
        if fault:
            where = f"{self.shards.folder}/{shard}"
            raise ShardError(where, fault, f"hma shards verify {self.shards.folder} tells what is damaged")

    def _fault(self, group: int, values: dict[str, NDArray[Any]]) -> str:
        """Return how rows contradict the manifest or episodes.parquet; empty where they do not."""
        name, spec = self._columns[0], self.shards.spec
        tokens, actions, frame = values[name], values["action"], values["frame_index"]
        for column, width in self._widths.items():
            if values[column].shape[1:] != (width,):
                found = values[column].shape[1] if values[column].ndim > 1 else 1
                return f"has {found} values a row in column {column}, where its manifest says {width}"
        rows = int(self.index.edges[group + 1] - self.index.edges[group])
        if len(frame) != rows:
            number = self.index.groups[group, 1]
            return f"has {len(frame):,} rows in row group {number}, where its manifest says {rows:,}"
        if frame[self.index.episode_starts(group)].any():
            return "does not begin its episodes at the rows that episodes.parquet names"
        bad = np.flatnonzero(~np.isfinite(actions).all(axis=1))
        if len(bad):
            place = f"episode {values['episode_index'][bad[0]]} frame {frame[bad[0]]}"
            return f"has {len(bad):,} rows whose actions are not finite numbers, the first in {place}"
        if spec.vocab_size and int(tokens.max(initial=0)) >= spec.vocab_size:
            return f"has token {tokens.max()}, where {spec.name} knows 0 to {spec.vocab_size - 1}"
        if tokens.dtype.kind == "f" and not np.isfinite(tokens).all():
            return f"has {name} that are not finite numbers"
        return ""

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_kept": OrderedDict()}  # a worker decodes its own


def _check_stride(shards: ShardSet) -> None:
    stride, kept = shards.embodiment.stride, shards.manifest.frame_stride
    if kept < 1 or stride % kept:
        raise ShardError(
            shards.folder,
            f"keeps every {kept}. frame, which cannot give frames {stride} steps apart",
            "convert again with --frames all, or with a stride that it divides",
        )
