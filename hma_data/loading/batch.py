"""Assemble the batches that the model takes from windows of several embodiments.

B batch, T frames, h·w grid, c·H·W latents, A action dims, K = stride·A.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hma_data.shards.reader import ShardSet
from hma_data.shards.windows import Ints, Short

Pieces = Mapping[str, tuple[Ints, dict[str, NDArray[Any]]]]  # embodiment -> places in the batch, windows


@dataclass
class Batch:
    """A batch of windows, as the model takes it.

    Attributes:
        embodiment: B ids; may mix.
        actions: (B, T, Kmax) float32 raw; rows of narrower embodiments are zero at the end.
        action_mask: (B, T) bool, True where all steps of the chunk are known.
        tokens: (B, T, h, w) int64, or None.
        latents: (B, T, c, H, W) float32 as stored, or None.
        episode, frame: (B,) int64, the episode of the window and the frame it starts at.
        camera: (B,) int64, index of the camera among those of the shard set.
        frame_mask: (B, T) bool, False where a short episode was padded; such frames give no loss. None where
            episodes are not padded.
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

    def __len__(self) -> int:
        return len(self.embodiment)

    def to(self, device: torch.device | str) -> "Batch":
        """Return the same batch on another device."""
        return self._map(lambda value: value.to(device, non_blocking=True))

    def pin_memory(self) -> "Batch":
        """Return the same batch in pinned memory; a DataLoader with pin_memory=True calls this."""
        return self._map(Tensor.pin_memory)

    def _map(self, change: Any) -> "Batch":
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return Batch(**{k: change(v) if isinstance(v, Tensor) else v for k, v in values.items()})


def assemble(sets: Mapping[str, ShardSet], names: list[str], pieces: Pieces, short: Short) -> Batch:
    """Assemble one batch from the pieces of each embodiment."""
    size = len(names)
    width = max(windows["actions"].shape[2] for _, windows in pieces.values())
    frames = next(iter(pieces.values()))[1]["actions"].shape[1]
    spec = next(iter(sets.values())).spec
    discrete = spec.kind == "discrete"
    shape = spec.grid if discrete else (spec.channels or 1, *spec.grid)
    actions = np.zeros((size, frames, width), np.float32)
    pictures = np.empty((size, frames, *shape), np.int64 if discrete else np.float32)
    known, inside = np.ones((size, frames), np.bool_), np.ones((size, frames), np.bool_)
    where = {key: np.empty(size, np.int64) for key in ("episode", "frame", "camera")}
    for places, windows in pieces.values():
        actions[places, :, : windows["actions"].shape[2]] = windows["actions"]
        pictures[places] = windows["tokens"].reshape(len(places), frames, *shape)
        if "known" in windows:
            known[places] = windows["known"]
        if "inside" in windows:
            inside[places] = windows["inside"]
        for key, values in where.items():
            values[places] = windows[key]
    return Batch(
        embodiment=names,
        actions=torch.from_numpy(actions),
        action_mask=torch.from_numpy(known),
        tokens=torch.from_numpy(pictures) if discrete else None,
        latents=None if discrete else torch.from_numpy(pictures),
        **{key: torch.from_numpy(values) for key, values in where.items()},
        frame_mask=torch.from_numpy(inside) if short == "pad" else None,
    )


def as_batch(batch: Batch) -> Batch:
    """Return the batch unchanged: a `collate_fn` for datasets that make whole batches."""
    return batch
