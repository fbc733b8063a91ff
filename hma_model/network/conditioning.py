"""Compute the trunk's conditioning from a batch's actions, embodiment by embodiment.

The samples of a mixed batch are sorted by embodiment. The trunk then processes the whole batch at once, and
each stem and modulation is called once.

B batch, T frames, D width, K = stride * action dim, L layers.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor

from hma_data.errors import HMAError
from hma_model.config import HMAConfig
from hma_model.network.stem import Stem
from hma_model.network.trunks.contract import Conditioning, Trunk, rows_at

type FindStem = Callable[[str], Stem]  # by the id of an embodiment


@dataclass(frozen=True)
class Groups:
    """The samples of a batch by embodiment, each embodiment's samples side by side.

    Attributes:
        parts: embodiment id and number of samples, in order.
        order, inverse: (B,) indices that sort the samples, and that undo it; None if sorted already.
    """

    parts: tuple[tuple[str, int], ...]
    order: list[int] | None = None
    inverse: list[int] | None = None

    @classmethod
    def of(cls, embodiment: str | Sequence[str], batch: int) -> Self:
        """Sort the batch's embodiments, keeping the order of first appearance."""
        if isinstance(embodiment, str):
            return cls(((embodiment, batch),))
        if len(embodiment) != batch:
            fault = f"there are {len(embodiment)} ids for a batch of {batch}"
            raise HMAError("embodiment", fault, "give one id for each sample")
        counts = Counter(embodiment)  # in the order of first appearance
        rank = {name: index for index, name in enumerate(counts)}
        order = sorted(range(batch), key=lambda sample: rank[embodiment[sample]])
        parts = tuple(counts.items())
        if order == list(range(batch)):
            return cls(parts)
        inverse = sorted(range(batch), key=lambda sample: order[sample])
        return cls(parts, order, inverse)

    @property
    def batch(self) -> int:
        """Return B, the number of samples."""
        return sum(size for _, size in self.parts)

    def sort(self, x: Tensor) -> Tensor:
        """Return the samples sorted by embodiment."""
        return x if self.order is None else x[self.order]

    def unsort(self, x: Tensor) -> Tensor:
        """Return sorted samples in the batch's own order."""
        return x if self.inverse is None else x[self.inverse]

    def spans(self) -> list[tuple[str, slice]]:
        """Return the slice of each embodiment among the sorted samples."""
        ends = list(accumulate((size for _, size in self.parts), initial=0))
        return [(name, slice(ends[i], ends[i + 1])) for i, (name, _) in enumerate(self.parts)]


@dataclass
class ActionConditioning:
    """The chunk in force at each frame.

    Attributes:
        chunks: (B, T, K) float32 raw.
        known: (B, T) bool, False where there is no chunk or it is hidden.
    """

    chunks: Tensor
    known: Tensor

    def frames(self, chosen: slice | list[int]) -> "ActionConditioning":
        """Return the chunks at those frames."""
        return ActionConditioning(self.chunks[:, chosen], self.known[:, chosen])


def align(config: HMAConfig, actions: Tensor, known: Tensor | None, frames: int) -> ActionConditioning:
    """Assign chunks (B, >= T-1, K), of which some are known (B, >= T-1), to the frames they condition."""
    late = config.action_alignment == "previous"
    if actions.shape[1] < frames - late:
        fault = f"there are {actions.shape[1]} chunks for {frames} frames"
        raise HMAError("actions", fault, f"give {frames} chunks")
    if known is None:
        known = torch.ones(actions.shape[:2], dtype=torch.bool, device=actions.device)
    if not late:
        return ActionConditioning(actions[:, :frames], known[:, :frames])
    shifted = F.pad(actions[:, : frames - 1], (0, 0, 1, 0))
    return ActionConditioning(shifted, F.pad(known[:, : frames - 1], (1, 0)))


def unknown(batch: int, frames: int, width: int, device: torch.device) -> ActionConditioning:
    """Return chunks (B, T, K) of zeros, none of them known."""
    known = torch.zeros(batch, frames, dtype=torch.bool, device=device)
    return ActionConditioning(torch.zeros(batch, frames, width, device=device), known)


def condition(
    trunk: Trunk,
    find_stem: FindStem,
    given: ActionConditioning | None,
    groups: Groups,
    positions: Tensor,
    unsort: bool = False,
) -> Conditioning:
    """Return the trunk's conditioning for the samples, in the order of `groups`.

    Args:
        trunk: that of the model.
        find_stem: returns the stem of an embodiment; each is called once.
        given: in the batch's order; None for no actions at all.
        groups: the batch's embodiments.
        positions: (T,) int64, the times of the frames; (B, T) in the batch's order if the samples' differ.
        unsort: return it in the batch's own order.
    """
    config, frames = trunk.config, positions.shape[-1]
    absent = rows_at(trunk.absent, positions).expand(groups.batch, frames, -1)
    if given is None:
        if config.absent_action == "skip":
            return Conditioning()
        if config.absent_action == "tokens":
            return Conditioning(tokens=absent if unsort else groups.sort(absent))
        widest = max(find_stem(name).input.in_features for name, _ in groups.parts)
        given = unknown(groups.batch, frames, widest, absent.device)
    if positions.dim() > 1:
        absent = groups.sort(absent)
    chunks, known = groups.sort(given.chunks), groups.sort(given.known).unsqueeze(-1)
    shown = torch.ones_like(known) if config.absent_action == "tokens" else known
    embeddings, modulations, outs = [], [], []
    for name, span in groups.spans():
        stem = find_stem(name)
        width = stem.input.in_features
        if chunks.shape[-1] < width:
            fault = f"a chunk has {chunks.shape[-1]} values, but {name} needs {width}"
            raise HMAError("actions", fault, "flatten stride x action_dim values into a chunk")
        embedded = stem(chunks[span, :, :width].masked_fill(~shown[span], 0))
        embedding = torch.where(shown[span], embedded, absent[span])
        embeddings.append(embedding)
        if stem.modulation is None:
            continue
        modulations.append(stem.modulation(embedding))
        if stem.modulation.out is not None:
            outs.append((embedding.shape[0], *stem.modulation.out))
    embedding = _cat(embeddings, 0)
    tokens = torch.where(known, embedding, absent) if config.appended_tokens else None
    if trunk.modulation is not None:
        modulations = [trunk.modulation(embedding)]
    modulation = _cat(modulations, 1) if modulations else None
    if not unsort or groups.inverse is None:
        return Conditioning(embedding, modulation, outs or None, tokens)
    order = torch.tensor([groups.order, groups.inverse], device=embedding.device)
    embedding, tokens = embedding[order[1]], None if tokens is None else tokens[order[1]]
    modulation = None if modulation is None else modulation[:, order[1]]
    return Conditioning(embedding, modulation, outs or None, tokens, (order[0], order[1]) if outs else None)


def _cat(parts: list[Tensor], dim: int) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(parts, dim)
