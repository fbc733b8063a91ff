"""Hold the state of a rollout row by row: time, frames, chunks, random numbers, and the cache.

A frame at time t lies in slot t mod R of its row: its tokens, its chunk, and its keys and values. With rotary
positions there is one slot more than the window has frames, for the pass that computes a finished frame and
the next one together. The times of the slots follow from the time of the newest frame, so a row that begins
anew only sets its time back.

B rows, n some rows, R slots, S tokens of a frame, C values of a patch, K = stride * action dim, N tokens of a
frame with its action tokens, T frames of a pass.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from hma_model.network.conditioning import ActionConditioning
from hma_model.network.draws import device_of
from hma_model.network.network import Network
from hma_model.network.trunks.contract import Carried, Conditioning, TimePositions, ring_times


@dataclass(frozen=True)
class Snapshot:
    """A copy of the state of n rows.

    Attributes:
        embodiments, times, pending: as of `RowState`.
        generators: the states of the generators.
        frames, chunks, known: the rows of the buffers.
        carried: the rows of what the trunk carries; None if there is nothing yet.
        caching: whether the rollout keeps keys and values.
        passive: whether the rollout has no actions; None if it has made no step.
    """

    embodiments: tuple[str, ...]
    times: tuple[int, ...]
    pending: tuple[int, ...]
    generators: tuple[Tensor | None, ...]
    frames: Tensor
    chunks: Tensor
    known: Tensor
    carried: Carried | None
    caching: bool
    passive: bool | None

    def take(self, rows: Sequence[int]) -> "Snapshot":
        """Return a copy of some of the rows, in this order; a row may be taken several times."""
        index = torch.tensor(rows, device=self.frames.device)
        kept: dict[str, Any] = {name: getattr(self, name)[index] for name in ("frames", "chunks", "known")}
        for name in ("embodiments", "times", "pending", "generators"):
            kept[name] = tuple(getattr(self, name)[row] for row in rows)
        return replace(self, **kept, carried=None if self.carried is None else self.carried.take(index))


@dataclass(frozen=True)
class Pass:
    """The inputs that the passes over one frame share.

    Attributes:
        past: (rows, T - 1, S) the frames before the new one that the first pass computes.
        times, conditioning: of the T frames.
        lanes: numbers of the step's rows among those of the pass; None if they are the same.
    """

    past: Tensor
    times: TimePositions
    conditioning: Conditioning
    lanes: Tensor | None = None

    def lay_out(self, values: Tensor) -> Tensor:
        """Return values of the step's rows (n, ...) as those of the pass's rows."""
        if self.lanes is None:
            return values
        laid = values.new_zeros(len(self.past), *values.shape[1:])
        laid[self.lanes] = values
        return laid


class RowState:
    """The state of B rows.

    Args:
        model: the model of the rollout.
        embodiments: the id of each row.
        generator: of the seeds of rows that get none.
        caching: False keeps all frames, so that R grows, and all are computed anew for each frame.

    Attributes:
        embodiments: the id of each row.
        times: the time of each row's next frame; 0 if the row has no prompt.
        pending: how many of each row's newest frames are not in the cache yet.
        generators: of each row's random numbers; None until a row without a seed draws.
        frames: (B, R, S) ids of the trunk's tokens, or scaled patches (B, R, S, C).
        chunks, known: (B, R, K) float32 raw and (B, R) bool, the chunk in force at each frame.
        carried: what the trunk carries of past frames; None until the first pass.
    """

    def __init__(
        self, model: Network, embodiments: Sequence[str], generator: torch.Generator | None, caching: bool
    ) -> None:
        self.model, self.config, self.shared, self.caching = model, model.config, generator, caching
        self.embodiments = list(embodiments)
        batch, config = len(self.embodiments), model.config
        self.times, self.pending = [0] * batch, [0] * batch
        self.generators: list[torch.Generator | None] = [None] * batch
        slots = config.frames + (not config.released)
        blank = self.blank(batch).unsqueeze(1)
        self.frames = torch.zeros_like(blank).repeat(1, slots, *[1] * (blank.dim() - 2))
        self.chunks = torch.zeros(batch, slots, model.widest_chunk(self.embodiments), device=model.device)
        self.known = torch.zeros(batch, slots, dtype=torch.bool, device=model.device)
        self.carried: Carried | None = None

    @property
    def slots(self) -> int:
        """Return R."""
        return self.frames.shape[1]

    def blank(self, rows: int) -> Tensor:
        """Return frames (n, S) of masked tokens, or of zero patches (n, S, C)."""
        shape, device = (rows, self.config.tokens_per_frame), self.model.device
        if self.config.discrete:
            return torch.full(shape, self.config.mask_id, device=device)
        return torch.zeros(*shape, self.config.patch_dim, device=device)

    def tensor(self, values: Sequence[int]) -> Tensor:
        """Return int64 numbers (n,) on the model's device; if they are equal or in order, without a copy."""
        first, count, device = values[0], len(values), self.model.device
        if all(value == first for value in values):
            return torch.full((count,), first, device=device)
        if list(values) == list(range(first, first + count)):
            return torch.arange(first, first + count, device=device)
        return torch.tensor(values, device=device)

    # -- frames and chunks --------------------------------------------------------------------------------

    def begin(
        self,
        rows: Sequence[int],
        names: Sequence[str],
        frames: Tensor,
        given: ActionConditioning,
        seeds: Sequence[int] | None,
    ) -> None:
        """Start rows anew at time 0 with frames (n, P, S) and the chunks (n, P, K) in force at them."""
        self._widen(given.chunks.shape[2])
        index, count, width = self.tensor(rows), frames.shape[1], given.chunks.shape[2]
        self.frames[index, :count] = frames
        self.chunks[index, :count, :width], self.known[index, :count] = given.chunks, given.known
        for i, row in enumerate(rows):
            self.embodiments[row] = names[i]
            self.times[row] = self.pending[row] = count
            self.generators[row] = None if seeds is None else self._seeded(seeds[i])

    def put_chunk(self, rows: Sequence[int], late: int, chunk: Tensor | None, known: Tensor | None) -> None:
        """Set the chunk (n, K) of the frame `late` before the next one; None for one that is not known."""
        index, slot = self.tensor(rows), self._slot(rows, late)
        if chunk is None:
            self.known[index, slot] = False
            return
        self.chunks[index, slot, : chunk.shape[1]] = chunk
        self.known[index, slot] = True if known is None else known

    def put_frame(self, rows: Sequence[int], frames: Tensor, generated: bool) -> None:
        """Add the next frame (n, S) of each row; generating it has computed the frames before it."""
        self.frames[self.tensor(rows), self._slot(rows)] = frames
        for row in rows:
            self.times[row] += 1
            self.pending[row] = 1 if generated else self.pending[row] + 1

    def newest(self, rows: Sequence[int]) -> Tensor:
        """Return the newest frame (n, S) of each row."""
        return self.frames[self.tensor(rows), self._slot(rows, 1)]

    def given(self, rows: Sequence[int], positions: Tensor) -> ActionConditioning:
        """Return the chunks (n, T, K) at times (n, T)."""
        index, slots = self.tensor(rows).unsqueeze(1), positions % self.slots
        return ActionConditioning(self.chunks[index, slots], self.known[index, slots])

    def past(self, rows: Sequence[int], positions: Tensor) -> Tensor:
        """Return the frames (n, T, S) at times (n, T)."""
        return self.frames[self.tensor(rows).unsqueeze(1), positions % self.slots]

    def slide(self, rows: Sequence[int]) -> None:
        """Drop the oldest frame of rows whose window is full, and give the others the times before theirs.

        Learned positions then change for each frame, so all of them are to be computed again.
        """
        full = [row for row in rows if self.times[row] == self.config.frames]
        if not full:
            return
        index = self.tensor(full)
        for buffer in (self.frames, self.chunks, self.known):
            buffer[index] = buffer[index].roll(-1, dims=1)
        for row in full:
            self.times[row] = self.pending[row] = self.config.frames - 1

    def grow(self, rows: Sequence[int]) -> None:
        """Make slots for the next frame of rows that keep all their frames."""
        if max(self.times[row] for row in rows) >= self.slots:
            self._reserve(2 * self.slots)

    def _reserve(self, slots: int) -> None:
        more = slots - self.slots
        if more > 0:
            frames, chunks, known = (
                torch.cat([x, x.new_zeros(len(x), more, *x.shape[2:])], dim=1)
                for x in (self.frames, self.chunks, self.known)
            )
            self.frames, self.chunks, self.known = frames, chunks, known

    def _widen(self, width: int) -> None:
        self.chunks = F.pad(self.chunks, (0, max(0, width - self.chunks.shape[2])))

    def _slot(self, rows: Sequence[int], late: int = 0) -> Tensor:
        return (self.tensor([self.times[row] for row in rows]) - late) % self.slots

    # -- random numbers -----------------------------------------------------------------------------------

    def drawing(self, rows: Sequence[int]) -> list[torch.Generator]:
        """Return the generator of each row; a row without one gets a seed."""
        found = []
        for row in rows:
            generator = self.generators[row]
            if generator is None:
                seed = torch.randint(2**62, (), generator=self.shared, device=device_of(self.shared))
                generator = self.generators[row] = self._seeded(int(seed))
            found.append(generator)
        return found

    def _seeded(self, seed: int) -> torch.Generator:
        """Return a generator that draws where the rollout's does; without one, on the model's device."""
        device = self.model.device if self.shared is None else self.shared.device
        return torch.Generator(device).manual_seed(seed)

    # -- the cache ----------------------------------------------------------------------------------------

    def carry(self, tokens: int, dtype: torch.dtype) -> Carried:
        """Return what the trunk carries for frames of N tokens; unless N or the type change, the same one."""
        device = self.model.device
        if self.carried is None or not self.carried.fits(self.slots, tokens, dtype, device):
            self.carried = self.model.trunk.carry(len(self.times), self.slots, tokens, dtype, device)
        return self.carried

    def cached_times(self, rows: Sequence[int], begin: Sequence[int], frames: int) -> TimePositions:
        """Return the times of a pass over T frames of each row, from the times `begin` on."""
        positions = self.tensor(begin).unsqueeze(1) + torch.arange(frames, device=self.model.device)
        batch, times = len(self.times), ring_times(self.config, positions, self.slots)
        chosen: slice | Tensor | None = self.tensor(rows)
        if list(rows) == list(range(rows[0], rows[0] + len(rows))):
            # A slice of the cache is a view; an index would copy it in every layer.
            chosen = None if len(rows) == batch else slice(rows[0], rows[0] + len(rows))
        assert times.slots is not None
        return replace(times, slots=times.slots * batch + self.tensor(rows).unsqueeze(1), rows=chosen)

    # -- snapshots ----------------------------------------------------------------------------------------

    def snapshot(self, rows: Sequence[int], passive: bool | None) -> Snapshot:
        """Return a copy of the state of rows, of which some may be the same."""
        states = tuple(None if one is None else one.get_state() for one in self.generators)
        lists = tuple(self.embodiments), tuple(self.times), tuple(self.pending), states
        buffers = self.frames, self.chunks, self.known
        return Snapshot(*lists, *buffers, self.carried, self.caching, passive).take(rows)

    def restore(self, rows: Sequence[int], kept: Snapshot) -> None:
        """Put rows into the state of a snapshot."""
        index, length, width = self.tensor(rows), kept.frames.shape[1], kept.chunks.shape[2]
        self._reserve(length)
        self._widen(width)
        self.frames[index, :length], self.known[index, :length] = kept.frames, kept.known
        self.chunks[index, :length, :width] = kept.chunks
        if kept.carried is not None:
            self.carry(kept.carried.tokens, kept.carried.memory[0].dtype).put(index, kept.carried)
        for i, row in enumerate(rows):
            self.embodiments[row] = kept.embodiments[i]
            self.times[row], self.pending[row] = kept.times[i], kept.pending[i]
            state, self.generators[row] = kept.generators[i], None
            if state is not None:
                generator = self.generators[row] = self._seeded(0)
                generator.set_state(state)
