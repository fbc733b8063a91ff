"""Decode row groups of a shard set, cut them into windows, and assemble the batches that the model takes.

n windows, B batch, T frames, S values a frame, h·w grid, c·H·W latents, A action dims, K = stride·A.
"""

import threading
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from shlex import quote
from typing import Any

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from torch import Tensor

from hma_data.arrays import Array, Bools, Float32s, Ints
from hma_data.errors import ShardError, UsageError
from hma_data.loading.views import FIRST_CAMERA, Cameras, Views, stacked
from hma_data.shards.reader import ShardSet
from hma_data.shards.schema import mask_columns, token_column
from hma_data.shards.windows import Short, WindowIndex
from hma_data.tokenizers.base import TokenizerSpec

MIB = 2**20


@dataclass
class Rows:
    """Decoded rows, from which windows are cut."""

    tokens: Array  # (N, S), or (N, V, S) of several cameras
    actions: Float32s
    episode: NDArray[np.int32]
    frame: NDArray[np.int32]
    known: Bools | None  # True where the row's action is known; None where all are

    def __post_init__(self) -> None:
        self._of_span: tuple[int, Float32s, Bools | None] | None = None

    @classmethod
    def join(cls, several: "Sequence[Rows]") -> "Rows":
        """Concatenate rows in their order."""
        if len(several) == 1:
            return several[0]
        columns = [[getattr(rows, f.name) for rows in several] for f in fields(cls)]
        joined: list[Any] = [None if column[0] is None else np.concatenate(column) for column in columns]
        return cls(*joined)

    def __len__(self) -> int:
        return len(self.frame)

    def first(self, count: int) -> "Rows":
        """Return the first `count` rows."""
        columns = [getattr(self, f.name) for f in fields(Rows)]
        kept: list[Any] = [None if column is None else column[:count] for column in columns]
        return Rows(*kept)

    def cut(
        self, first: Ints, last: Ints | None, index: WindowIndex, view: Ints | None = None
    ) -> dict[str, Array]:
        """Return the windows that start at rows `first` (n,).

        Args:
            last: (n,) last rows of their episodes, beyond which windows are padded; None pads no window.
            view: (n,) which of the V cameras each window takes; None takes all.

        Returns:
            tokens (n, T, S) or (n, T, V, S), actions (n, T, K), episode (n,) and frame (n,). Where the set
            has marks or windows may be padded, also known (n, T) bool. Where windows may be padded, also
            inside (n, T) bool, True for frames of the episode.
        """
        found: dict[str, Array] = {"episode": self.episode[first], "frame": self.frame[first]}
        if last is not None:
            return found | self._padded(first, last, index, view)
        found["tokens"] = self._frames(first[:, None] + index.offsets, view)
        actions, known = self._spans(index.span)
        found["actions"] = actions[first].reshape(len(first), index.frames, -1)
        if known is not None:
            found["known"] = np.all(known[first].reshape(len(first), index.frames, -1), axis=2)
        return found

    def _spans(self, span: int) -> tuple[Float32s, Bools | None]:
        """Return the actions (N - span + 1, span * A) and marks of every run of `span` rows; made once."""
        if self._of_span is None or self._of_span[0] != span:
            # Rows lie one after the other in memory, so a run of rows is a run of numbers: every window is a
            # view, and all windows of a pool share one copy of the actions.
            flat, width = self.actions.ravel(), self.actions.shape[1]
            known = None if self.known is None else sliding_window_view(self.known, span)
            self._of_span = span, sliding_window_view(flat, span * width)[::width], known
        return self._of_span[1:]

    def _frames(self, rows: Ints, view: Ints | None) -> Array:
        return self.tokens[rows] if view is None else self.tokens[rows, view[:, None]]

    def _padded(self, first: Ints, last: Ints, index: WindowIndex, view: Ints | None) -> dict[str, Array]:
        every = first[:, None] + np.arange(index.span)
        inside = every <= last[:, None]
        every = np.minimum(every, last[:, None])
        actions = self.actions[every]
        actions[~inside] = 0
        known = inside if self.known is None else inside & self.known[every]
        return {
            "tokens": self._frames(every[:, :: index.row_stride], view),
            "actions": actions.reshape(len(first), index.frames, -1),
            "known": np.all(known.reshape(len(first), index.frames, -1), axis=2),
            "inside": inside[:, :: index.row_stride],
        }


class RowDecoder:
    """The row groups of one split of a shard set, and their windows; the last used row groups stay decoded.

    Args:
        shards, split: the shard set and its split.
        frames, stride, short: see `WindowIndex.of`.
        cache_bytes: memory for decoded rows that are kept; at least two row groups are kept.
        cameras: see `hma_data.loading.views`.

    Raises:
        UsageError: `frames` is below 1, or the set lacks a camera.
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
        cameras: Cameras = FIRST_CAMERA,
    ) -> None:
        if frames < 1:
            raise UsageError("frames", f"a window must have at least 1, not {frames}")
        self.shards, self.split = shards, split
        self.views = Views.of(shards, cameras)
        recorded, kept = shards.embodiment.stride, shards.manifest.frame_stride
        if kept < 1 or recorded % kept:
            fault = f"keeps one of every {kept} recorded frames, but the stride is {recorded}"
            remedy = f"convert again with --frames all, or set a stride that is a multiple of {kept}"
            raise ShardError(shards.folder, fault, remedy)
        self.index = WindowIndex.of(shards, split, frames, stride, short)
        width = token_column(shards.spec)[1] * len(self.views.columns)
        robot = shards.embodiment
        action_width = robot.action_dim * shards.manifest.frame_stride
        self._row_bytes = width * np.dtype(shards.spec.dtype).itemsize + action_width * 4 + 9
        self._columns = ["action", "episode_index", "frame_index"]
        self._columns += [mask for mask in mask_columns(robot) if mask == "action_known"]
        self._names = shards.shards(split)
        self._kept: OrderedDict[int, Rows] = OrderedDict()
        self._keep = max(2, cache_bytes // max(1, self.group_bytes))
        self._lock = threading.Lock()  # of what is kept; threads decode side by side

    @property
    def group_bytes(self) -> int:
        """Return the average bytes of a decoded row group."""
        return int(self.index.edges[-1] / max(1, len(self.index.groups)) * self._row_bytes)

    @property
    def window_bytes(self) -> int:
        """Return the bytes of a window, about."""
        return self.index.frames * self._row_bytes

    def rows(self, group: int, whole: bool = True) -> Rows:
        """Return all rows that the windows starting in row group `group` need; its own rows come first.

        Args:
            whole: False leaves out the rows of the row groups after it.

        Raises:
            ShardError: the shard is missing or damaged.
        """
        reach = self.index.reach(group) if whole else group
        if reach == group:
            return self._group(group)
        own = self._group(group)
        after = Rows.join([self._group(g) for g in range(group + 1, reach + 1)])
        return Rows.join([own, after.first(self.index.span - 1)])

    def _group(self, group: int) -> Rows:
        with self._lock:
            rows = self._kept.get(group)
        if rows is None:
            rows = self._decoded(group)
        with self._lock:
            self._kept[group] = rows
            self._kept.move_to_end(group)
            while len(self._kept) > self._keep:
                self._kept.popitem(last=False)
        return rows

    def _decoded(self, group: int) -> Rows:
        shard, number = (int(v) for v in self.index.groups[group])
        values = self.shards.read(self._names[shard], [number], [*self.views.columns, *self._columns])
        self._check(self._names[shard], values)
        pictures = [values[name] for name in self.views.columns]
        tokens = pictures[0] if len(pictures) == 1 else np.stack(pictures, axis=1)
        actions, episode, frame, *known = (values[name] for name in self._columns)
        return Rows(tokens, actions, episode, frame, known[0] if known else None)

    def _check(self, shard: str, values: dict[str, Array]) -> None:
        """Raise ShardError for tokens or actions that would spoil the training without an error."""
        actions, episode, frame = (values[name] for name in self._columns[:3])
        size, fault = self.shards.spec.vocab_size, ""
        pictures = [values[name] for name in self.views.columns]
        highest = max(int(tokens.max(initial=0)) for tokens in pictures) if size else 0
        bad = np.flatnonzero(~np.isfinite(actions).all(axis=1))
        if len(bad):
            first = f"episode {episode[bad[0]]} frame {frame[bad[0]]}"
            fault = f"{len(bad):,} rows have actions that are not finite; the first is {first}"
        elif size and highest >= size:
            fault = f"token {highest} is outside the vocabulary, 0 to {size - 1}"
        elif any(tokens.dtype.kind == "f" and not np.isfinite(tokens).all() for tokens in pictures):
            fault = "latents are not finite"
        if fault:
            folder = self.shards.folder
            raise ShardError(f"{folder}/{shard}", fault, f"run: hma shards verify {quote(str(folder))}")

    def __getstate__(self) -> dict[str, Any]:
        kept = {key: value for key, value in self.__dict__.items() if key != "_lock"}
        return {**kept, "_kept": OrderedDict()}  # another process decodes its own

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _lock=threading.Lock())


@dataclass
class Batch:
    """A batch of windows, as the model takes it.

    Attributes:
        embodiment: B ids; may mix.
        actions: (B, T, Kmax) float32 raw; rows of narrower embodiments are zero at the end.
        action_mask: (B, T) bool, True where all steps of the chunk are known.
        tokens: (B, T, h, w) int64, or None. V views are stacked along the height: (B, T, V·h, w).
        latents: (B, T, c, H, W) float32 as stored, or None; V views as (B, T, c, V·H, W).
        episode, frame: (B,) int64, the episode of the window and the frame it starts at.
        camera: (B,) int64, index of the camera among those of the shard set; of stacked views, the first's.
        frame_mask: (B, T) bool, False where a short episode was padded; such frames give no loss. None where
            episodes are not padded.
        context: like `tokens` or `latents`, the frames that the model sees in their place; the loss is of the
            true ones. None for these.
        places: (B, S) int64, the places in the trunk's grid of one view that the frames show; None for all.
    """

    embodiment: list[str]
    actions: Tensor
    action_mask: Tensor
    tokens: Tensor | None = None
    latents: Tensor | None = None
    episode: Tensor | None = None
    frame: Tensor | None = None
    camera: Tensor | None = None
    frame_mask: Tensor | None = None
    context: Tensor | None = None
    places: Tensor | None = None

    def __len__(self) -> int:
        return len(self.embodiment)

    @property
    def stored(self) -> Tensor:
        """Return the frames as shards store them: the tokens or the latents."""
        stored = self.latents if self.tokens is None else self.tokens
        assert stored is not None
        return stored

    def to(self, device: torch.device | str) -> "Batch":
        """Return the same batch on another device."""
        return self._map(lambda value: value.to(device, non_blocking=True))

    def pin_memory(self) -> "Batch":
        """Return the same batch in pinned memory; a DataLoader with pin_memory=True calls this."""
        return self._map(Tensor.pin_memory)

    def _map(self, change: Any) -> "Batch":
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return Batch(**{k: change(v) if isinstance(v, Tensor) else v for k, v in values.items()})


def assemble(
    spec: TokenizerSpec,
    names: list[str],
    windows_of: Mapping[str, tuple[Ints, dict[str, Array]]],
    short: Short,
    views: int = 1,
    size: int | None = None,
) -> Iterator[Batch]:
    """Yield the batches that windows make, one after the other.

    Args:
        names: (n,) the embodiment of each sample.
        windows_of: embodiment -> the indices (m,) of its samples among all, and its windows.
        views: V, the cameras in each frame.
        size: B, which divides n; None: one batch of all.
    """
    count, cuts = len(names), [windows for _, windows in windows_of.values()]
    order = np.concatenate([samples for samples, _ in windows_of.values()])
    place = np.empty_like(order)  # of each sample among the cuts
    place[order] = np.arange(count)
    ends = np.cumsum([len(samples) for samples, _ in windows_of.values()]).tolist()
    widths = np.repeat([cut["actions"].shape[2] for cut in cuts], np.diff(ends, prepend=0))
    frames = cuts[0]["actions"].shape[1]
    actions = np.zeros((count, frames, widths.max()), np.float32)
    known, inside = np.ones((count, frames), np.bool_), np.ones((count, frames), np.bool_)
    for start, end, cut in zip([0, *ends], ends, cuts):
        actions[start:end, :, : cut["actions"].shape[2]] = cut["actions"]
        known[start:end] = cut.get("known", True)
        inside[start:end] = cut.get("inside", True)
    tokens = np.concatenate([cut["tokens"] for cut in cuts])
    where = {key: np.concatenate([cut[key] for cut in cuts]) for key in ("episode", "frame", "camera")}
    discrete, size = spec.kind == "discrete", size or count

    def pictures(values: Array) -> Tensor:
        taken = stacked(values, spec, views)
        return torch.from_numpy(np.ascontiguousarray(taken, np.int64 if discrete else np.float32))

    for start in range(0, count, size):
        at = place[start : start + size]
        taken = pictures(tokens[at])
        yield Batch(
            embodiment=names[start : start + size],
            actions=torch.from_numpy(actions[at, :, : widths[at].max()]),
            action_mask=torch.from_numpy(known[at]),
            tokens=taken if discrete else None,
            latents=None if discrete else taken,
            **{key: torch.from_numpy(values[at].astype(np.int64)) for key, values in where.items()},
            frame_mask=torch.from_numpy(inside[at]) if short == "pad" else None,
        )


def as_batch(batch: Batch) -> Batch:
    """Return the batch unchanged: a `collate_fn` for datasets that make whole batches."""
    return batch
