"""Windows over a shard set, found by arithmetic: no list of windows, no scan of the shards.

A window is T frames `stride` apart with their T action chunks, so it spans T·stride recorded
rows of one episode and never leaves it. Rows of a split are numbered through all its shards;
windows are numbered in row order. Memory is per episode and row group, not per window.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hma_data.shards.reader import ShardSet

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class WindowIndex:
    """Every window of one split.

    Attributes:
        frames: T.
        row_stride: rows from one frame to the next.
        span: rows a window covers, T · row_stride.
        count: windows.
        short_episodes: episodes too short for a window; they are left out, and counted here.
        unit_first: (G+1,) number of windows before each row group; row group g starts windows
            unit_first[g] to unit_first[g+1].
        edges: (G+1,) first row of each row group.
        groups: (G, 2) shard index and row group in it.
        last_group: (G,) last row group that shares its shard, so how far reading may go on.
    """

    frames: int
    row_stride: int
    span: int
    count: int
    short_episodes: int
    unit_first: Ints
    edges: Ints
    groups: Ints
    last_group: Ints
    _starts: Ints  # (N,) first row of each episode that has windows
    _before: Ints  # (N+1,) windows before each

    @classmethod
    def of(cls, shards: ShardSet, split: str, frames: int, row_stride: int | None = None) -> "WindowIndex":
        """The windows of a split; `row_stride` None takes the embodiment's."""
        stride = row_stride or shards.row_stride
        span = frames * stride
        per_shard = shards.row_groups(split)
        sizes = np.array([rows for groups in per_shard for rows in groups], np.int64)
        edges = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        counts = np.array([len(groups) for groups in per_shard], np.int64)
        shard_of = np.repeat(np.arange(len(per_shard)), counts)
        shard_first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        within = np.arange(len(sizes)) - shard_first[shard_of]
        rows_before = edges[shard_first[:-1]] if len(counts) else np.zeros(0, np.int64)

        episodes = shards.index(split)
        windows = np.maximum(0, episodes.length - span + 1)
        starts = (
            rows_before[episodes.shard] + episodes.start if len(episodes.shard) else np.zeros(0, np.int64)
        )
        order = np.argsort(starts, kind="stable")
        keep = order[windows[order] > 0]
        before = np.concatenate([[0], np.cumsum(windows[keep])]).astype(np.int64)
        index = cls(
            frames,
            stride,
            span,
            int(before[-1]),
            int((windows == 0).sum()),
            np.zeros(0, np.int64),
            edges,
            np.stack([shard_of, within], axis=1).astype(np.int64),
            (shard_first[1:] - 1)[shard_of],
            starts[keep],
            before,
        )
        object.__setattr__(index, "unit_first", index._windows_before(edges))
        return index

    def _windows_before(self, rows: Ints) -> Ints:
        """How many windows start before each row."""
        if not len(self._starts):
            return np.zeros(len(rows), np.int64)
        at = np.searchsorted(self._starts, rows, side="right") - 1
        inside = np.minimum(rows - self._starts[at], np.diff(self._before)[at])
        return np.where(at < 0, 0, self._before[at] + inside)

    def first_rows(self, windows: Ints) -> Ints:
        """First row of each window."""
        at = np.searchsorted(self._before, windows, side="right") - 1
        return self._starts[at] + (windows - self._before[at])

    def units(self) -> Ints:
        """Row groups in which at least one window starts."""
        return np.flatnonzero(np.diff(self.unit_first) > 0)

    def reach(self, group: int) -> int:
        """Last row group needed for the windows that start in `group`."""
        needed = self.edges[group + 1] + self.span - 2
        last = int(np.searchsorted(self.edges, needed, side="right")) - 1
        return int(min(last, self.last_group[group]))
