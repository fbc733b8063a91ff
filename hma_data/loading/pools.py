"""Give each of several readers an endless, shuffled sequence of a shard set's windows.

Row groups (parts of them where there are few) are divided among the readers so that all readers have about
the same number of windows. A reader decodes a pool of row groups at a time. It orders the windows of a pool
so that windows that share a row are far apart (`spread`). Everything is a pure function of (seed, set,
reader, position in the sequence), so continuing from any position costs the decoding of one pool.
"""

import zlib
from dataclasses import dataclass

import numpy as np

from hma_data.arrays import Array, Ints
from hma_data.loading.rows import RowDecoder, Rows
from hma_data.shards.schema import joined
from hma_data.shards.windows import WindowIndex

UNITS = 8  # at least so many per reader: with fewer units, shares are less equal
LARGEST_POOL = 8  # row groups


def pool_size(decoder: RowDecoder, budget: float) -> int:
    """Return the number of row groups to decode together within `budget` bytes: 1 to LARGEST_POOL."""
    return int(np.clip(budget // max(1, decoder.group_bytes), 1, LARGEST_POOL))


def spread(rows: Ints, span: int, rng: np.random.Generator) -> tuple[Ints, int]:
    """Return a random order of windows in which those that share a row are far apart.

    The windows fill a table of `m` columns, row by row; m is so large that the windows of a column are at
    least `span` rows apart. The columns follow one another in random order, and so do the windows in each.
    Windows that are too near to the end of the column before come late in their own column.

    Args:
        rows: (n,) first row of each window, ascending.
        span: rows a window covers.

    Returns:
        the order (n,), and `apart`: any 1 + apart windows in a row share no row.
    """
    count = len(rows)
    m = int((np.searchsorted(rows, rows + span) - np.arange(count)).max(initial=1))
    lines = -(-count // m)
    apart = max(0, (lines - 1) // 3)
    columns: list[Ints] = []
    for b in rng.permutation(m):
        column = rng.permutation(np.arange(b, count, m))
        if columns and apart:
            near = np.zeros(lines + 2, np.bool_)  # by row of the table, one more at either end
            line = (columns[-1][-apart:] - b) // m + 1
            near[line] = near[line + 1] = True
            late = near[column // m + 1]
            column = np.concatenate([column[~late], column[late]])
        columns.append(column)
    return np.concatenate(columns), apart


@dataclass(frozen=True)
class UnitAssignment:
    """The assignment of units to readers.

    A unit is (row group, part); a part has every `parts`-th window of the group.

    Attributes:
        units: (U, 2).
        sizes: (U,) number of windows in each unit.
        owner: (U,) the reader; -1: all readers.
        parts: number of parts of a row group.
    """

    units: Ints
    sizes: Ints
    owner: Ints
    parts: int

    @classmethod
    def of(cls, index: WindowIndex, readers: int) -> "UnitAssignment":
        """Give every window to one reader; with fewer windows than readers, give all to every reader."""
        groups = index.units()
        if index.count < readers:
            units = np.stack([groups, np.zeros_like(groups)], axis=1)
            return cls(units, np.diff(index.unit_first)[groups], np.full(len(groups), -1), 1)
        parts = -(-UNITS * readers // len(groups)) if readers > 1 and len(groups) < UNITS * readers else 1
        while np.minimum(np.diff(index.unit_first), parts).sum() < readers:  # a few groups have most windows
            parts *= 2
        units = np.stack([np.repeat(groups, parts), np.tile(np.arange(parts), len(groups))], axis=1)
        windows = np.diff(index.unit_first)[units[:, 0]]
        sizes = np.maximum(0, windows - units[:, 1] + parts - 1) // parts
        units, sizes = units[sizes > 0], sizes[sizes > 0]
        order = np.argsort(-sizes, kind="stable")  # the largest first, in alternating direction: equal sums
        turn, reader = np.divmod(np.arange(len(units)), readers)
        owner = np.empty(len(units), np.int64)
        owner[order] = np.where(turn % 2, readers - 1 - reader, reader)
        return cls(units, sizes, owner, parts)

    def of_reader(self, reader: int) -> tuple[Ints, Ints]:
        """Return the units of a reader and their sizes."""
        mine = (self.owner == reader) | (self.owner < 0)
        return self.units[mine], self.sizes[mine]


class WindowSequence:
    """The sequence of windows of one reader.

    Args:
        decoder: of the shard set.
        assignment: which reader reads which units.
        seed: of the order.
        reader: number of this reader.
        pool: row groups decoded together.
    """

    def __init__(
        self,
        decoder: RowDecoder,
        assignment: UnitAssignment,
        seed: int,
        reader: int,
        pool: int,
    ) -> None:
        self._decoder, self._pool, self._parts = decoder, pool, assignment.parts
        self._entropy = [seed, zlib.crc32(decoder.shards.embodiment.id.encode()), reader]
        self._units, self._sizes = assignment.of_reader(reader)
        self.length = int(self._sizes.sum())
        self._epoch: tuple[int, Ints, Ints] | None = None
        self._begin = self._end = 0  # the part of the sequence that the decoded pool holds
        self._rows: Rows | None = None
        self._view: Ints | None = None

    def take(self, start: int, count: int) -> dict[str, Array]:
        """Return windows start to start + count of the sequence: those of `Rows.cut`, and camera (n,)."""
        cuts = []
        while count:
            if self._rows is None or not self._begin <= start < self._end:
                self._rows = self._load(start)
            some = min(count, self._end - start)
            chosen = slice(start - self._begin, start - self._begin + some)
            last = None if self._last is None else self._last[chosen]
            view = None if self._view is None else self._view[chosen]
            cut = self._rows.cut(self._first[chosen], last, self._decoder.index, view)
            cut["camera"] = self._camera[chosen]
            cuts.append(cut)
            start, count = start + some, count - some
        return joined(cuts)

    def _rounds(self, epoch: int) -> tuple[Ints, Ints]:
        """Return the order of the units in an epoch, and the number of windows up to the end of each pool."""
        if self._epoch is None or self._epoch[0] != epoch:
            order = np.random.default_rng([*self._entropy, epoch]).permutation(len(self._units))
            firsts = np.arange(0, len(order), self._pool)
            self._epoch = (epoch, order, np.cumsum(np.add.reduceat(self._sizes[order], firsts)))
        return self._epoch[1:]

    def _load(self, start: int) -> Rows:
        """Decode the pool that holds window `start` of the sequence."""
        epoch, offset = divmod(start, self.length)
        order, ends = self._rounds(epoch)
        number = int(np.searchsorted(ends, offset, side="right"))
        self._begin = start - offset + (int(ends[number - 1]) if number else 0)
        self._end = start - offset + int(ends[number])
        self._rows = None  # free the last pool before the next is decoded
        index = self._decoder.index
        units = self._units[order[number * self._pool : (number + 1) * self._pool]]
        loaded, firsts, lasts, offset = [], [], [], 0
        for group in np.unique(units[:, 0]).tolist():
            rows = self._decoder.rows(group)
            chosen = np.zeros(self._parts, np.bool_)
            chosen[units[units[:, 0] == group, 1]] = True
            windows = np.arange(index.unit_first[group], index.unit_first[group + 1])
            windows = windows[chosen[(windows - windows[0]) % self._parts]]
            shift = offset - index.edges[group]
            firsts.append(index.first_rows(windows) + shift)
            lasts.append(index.last_rows(windows) + shift)
            loaded.append(rows)
            offset += len(rows)
        first = np.concatenate(firsts)
        mixed, _ = spread(first, index.span, np.random.default_rng([*self._entropy, epoch, number]))
        self._first = first[mixed]
        self._last = np.concatenate(lasts)[mixed] if index.padded_episodes else None
        draws = np.random.default_rng([*self._entropy, epoch, number, 1]).integers(0, 2**31, len(first))
        self._camera, self._view = self._decoder.views.taken(draws)
        return Rows.join(loaded)
