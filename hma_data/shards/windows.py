"""Find the windows of a shard set by arithmetic, without a list of windows or a scan of the shards.

A window is T frames `stride` apart with their T action chunks, so it spans T·stride recorded
rows of one episode and never leaves it. It crosses no pause as long as a step of the model, `stride` recorded
steps: time would jump in it. Such pauses divide an episode into pieces; most episodes are one piece. Rows of
a split are numbered through all its shards; windows are numbered in row order. The index takes memory per
piece and row group, not per window.

A piece shorter than a window is dropped or padded. A padded piece gives one window from its first row;
the missing frames repeat its last row and are masked. Attention is causal in time, so frames after the last
real frame change no prediction before them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, pairwise
from typing import Any, Literal

import numpy as np

from hma_data.arrays import Ints
from hma_data.shards.reader import EpisodeIndex, ShardSet
from hma_data.shards.schema import flag_pauses

Short = Literal["drop", "pad"]

WINDOW = 12  # frames of the model's window, by default


@dataclass(frozen=True)
class WindowIndex:
    """An index of the windows of one split.

    Attributes:
        frames: T.
        row_stride: rows from one frame to the next.
        span: rows a window covers, T · row_stride.
        count: number of windows.
        short_episodes: number of episodes left out because they, or all their pieces, are too short.
        padded_episodes: number of short pieces that are padded and give one window.
        edges: (G+1,) first row of each row group.
        groups: (G, 2) shard index and row group in it.
    """

    frames: int
    row_stride: int
    span: int
    count: int
    short_episodes: int
    padded_episodes: int
    edges: Ints
    groups: Ints
    _starts: Ints  # (N,) first row of each piece that has windows
    _lengths: Ints  # (N,) rows of each piece
    _before: Ints  # (N+1,) number of windows before each piece

    @classmethod
    def of(
        cls,
        shards: ShardSet,
        split: str,
        frames: int,
        row_stride: int | None = None,
        short: Short = "drop",
    ) -> "WindowIndex":
        """Return the index of a split.

        Args:
            frames: T.
            row_stride: rows between frames; None takes the embodiment's.
            short: "drop" or "pad" for pieces shorter than a window; a piece of a single frame is always
                dropped.
        """
        stride = row_stride or shards.row_stride
        span = frames * stride
        edges, groups = _row_groups(shards.row_groups(split))
        episodes = shards.index(split)
        owner, starts, lengths = _pieces(shards, split, episodes, stride * shards.manifest.frame_stride)
        windows = np.maximum(0, lengths - span + 1)
        padded = (windows == 0) & (lengths > stride) & (short == "pad")
        windows[padded] = 1
        order = np.argsort(starts, kind="stable")
        keep = order[windows[order] > 0]
        before = np.concatenate([[0], np.cumsum(windows[keep])]).astype(np.int64)
        used = np.zeros(len(episodes.length), np.bool_)
        used[owner[keep]] = True
        return cls(
            frames=frames,
            row_stride=stride,
            span=span,
            count=int(before[-1]),
            short_episodes=int((~used).sum()),
            padded_episodes=int(padded.sum()),
            edges=edges,
            groups=groups,
            _starts=starts[keep],
            _lengths=lengths[keep],
            _before=before,
        )

    @cached_property
    def unit_first(self) -> Ints:
        """Return (G+1,) windows before the row groups; group g starts unit_first[g] to unit_first[g+1]."""
        if not len(self._starts):
            return np.zeros(len(self.edges), np.int64)
        at = np.searchsorted(self._starts, self.edges, side="right") - 1
        inside = np.minimum(self.edges - self._starts[at], np.diff(self._before)[at])
        return np.where(at < 0, 0, self._before[at] + inside)

    @cached_property
    def offsets(self) -> Ints:
        """Return the rows (T,) of a window's frames after its first row."""
        return np.arange(0, self.span, self.row_stride)

    def _piece(self, windows: Ints) -> Ints:
        return np.searchsorted(self._before, windows, side="right") - 1

    def first_rows(self, windows: Ints) -> Ints:
        """Return the first row of each window."""
        at = self._piece(windows)
        return self._starts[at] + (windows - self._before[at])

    def last_rows(self, windows: Ints) -> Ints:
        """Return the last row of each window's piece; beyond it the window is padded."""
        at = self._piece(windows)
        return self._starts[at] + self._lengths[at] - 1

    def units(self) -> Ints:
        """Return the row groups in which at least one window starts."""
        return np.flatnonzero(np.diff(self.unit_first) > 0)

    def reach(self, group: int) -> int:
        """Return the last row group that windows from `group` need: `group` unless an episode goes on."""
        after = self.unit_first[group + 1]
        if after == self.unit_first[group]:
            return group
        last = np.array([after - 1])
        row = min(int(self.first_rows(last)[0]) + self.span - 1, int(self.last_rows(last)[0]))
        return int(np.searchsorted(self.edges, row, side="right")) - 1


def episode_pieces(shards: ShardSet, row: Mapping[str, Any], row_stride: int | None = None) -> list[range]:
    """Return the rows of each piece of an episode.

    Args:
        shards: the set.
        row: of the episode in episodes.parquet.
        row_stride: rows between frames; None takes the embodiment's.
    """
    every = shards.manifest.frame_stride
    stride = (row_stride or shards.row_stride) * every
    return pieces(flag_pauses(row["flags"] or ""), row["length"], stride, every)


def pieces(pauses: Mapping[int, int], length: int, stride: int, frame_stride: int = 1) -> list[range]:
    """Return the rows of each piece of one episode, as `WindowIndex` divides all of a split.

    Args:
        pauses: recorded frame -> recorded steps to the next one.
        length: rows of the episode.
        stride: least recorded steps of a pause that divides an episode.
        frame_stride: recorded steps a row.
    """
    after = {frame // frame_stride + 1 for frame, steps in pauses.items() if steps >= stride}
    edges = [0, *sorted(row for row in after if row < length), length]
    return [range(begin, end) for begin, end in pairwise(edges)]


def _row_groups(per_shard: list[tuple[int, ...]]) -> tuple[Ints, Ints]:
    """Return the first rows (G+1,) and the places (G, 2) of all row groups of a split."""
    edges = np.cumsum([0, *chain(*per_shard)], dtype=np.int64)
    places = [(shard, group) for shard, groups in enumerate(per_shard) for group in range(len(groups))]
    return edges, np.array(places, np.int64).reshape(-1, 2)


def _pieces(shards: ShardSet, split: str, episodes: EpisodeIndex, stride: int) -> tuple[Ints, Ints, Ints]:
    """Return the episode's entry (N,), the first row (N,) and the rows (N,) of each piece, in their order.

    Args:
        stride: least recorded steps of a pause that divides an episode.
    """
    sizes = np.array([sum(groups) for groups in shards.row_groups(split)], np.int64)
    starts = (np.cumsum(sizes) - sizes)[episodes.shard] + episodes.start  # through all shards of the split
    entry, row, steps = episodes.pauses.T
    cut = (steps >= stride) & (row + 1 < episodes.length[entry])
    if not cut.any():
        return np.arange(len(starts)), starts, episodes.length
    owner = np.concatenate([np.arange(len(starts)), entry[cut]])
    begin = np.concatenate([np.zeros(len(starts), np.int64), row[cut] + 1])
    order = np.lexsort((begin, owner))
    owner, begin = owner[order], begin[order]
    last = np.append(np.diff(owner) > 0, True)
    end = np.where(last, episodes.length[owner], np.append(begin[1:], 0))
    return owner, starts[owner] + begin, end - begin
