"""Run the trunk over the frames of a rollout's rows, with a cache over time.

A frame costs one pass for each step of unmasking. The first pass also adds the frame before it, now finished,
to the cache. Attention over time is causal, so the cached keys and values of a past frame never change.

n rows of a step, S tokens of a frame, N tokens with action tokens, T frames of a pass, D width.
"""

from dataclasses import replace

import torch
from torch import Tensor

from hma_model.generation.engine import Engine
from hma_model.generation.state import Pass, RowState
from hma_model.generation.unmask import PatchFrame, TokenFrame
from hma_model.network.conditioning import Groups
from hma_model.network.network import Network
from hma_model.network.trunks.contract import Carried, Conditioning, TimePositions


class Passes:
    """The passes over the frames of a rollout.

    Args:
        model, engine: the model, and its trunk as it is run.
        state: the rows.

    Attributes:
        passive: no actions at all; None as long as no step has told.
    """

    def __init__(self, model: Network, engine: Engine, state: RowState) -> None:
        self.model, self.config, self.engine, self.state = model, model.config, engine, state
        self.passive: bool | None = None

    def begin(self, rows: list[int]) -> Pass:
        """Return the inputs that the passes over the next frame of the rows share."""
        self.catch_up(rows)
        every = list(range(len(self.state.times)))
        if self.engine.compiled is None or len(rows) == len(every):
            return self._newest(rows)
        # Compiled code has one shape, so idle rows compute too. Their next step writes the slots again.
        return replace(self._newest(every), lanes=self.state.tensor(rows))

    def features(self, frame: TokenFrame | PatchFrame, shared: Pass, first: bool) -> tuple[Tensor, Tensor]:
        """Return the new frames' features (n, N, D) and their times (1 or n, 1).

        The first pass also computes the frame before the new one.
        """
        x, conditioning, times, carried = self.inputs(frame, shared, first)
        trunk = self.engine.compiled or self.engine.trunk
        features = trunk(x, conditioning, times, carried)[:, -1]
        at = times.positions[..., -1:].view(-1, 1)
        if shared.lanes is None:
            return features, at
        return features[shared.lanes], at if len(at) == 1 else at[shared.lanes]

    def inputs(
        self, frame: TokenFrame | PatchFrame, shared: Pass, first: bool
    ) -> tuple[Tensor, Conditioning, TimePositions, Carried]:
        """Return the inputs of the trunk for a pass."""
        fresh = shared.past if first or self.config.masked_input == "previous" else shared.past[:, :0]
        values = torch.cat([fresh, shared.lay_out(frame.values).unsqueeze(1)], dim=1)
        masked = torch.zeros(values.shape[:3], dtype=torch.bool, device=values.device)
        masked[:, -1] = shared.lay_out(frame.masked)
        x = self.model.embed(values, masked.unsqueeze(-1))
        if first:
            return x, shared.conditioning, shared.times, self._carried()
        return x[:, -1:].contiguous(), shared.conditioning.last(), shared.times.last(), self._carried()

    def catch_up(self, rows: list[int]) -> None:
        """Add all pending frames but the newest to the cache."""
        pending = self.state.pending
        if not self.state.caching:
            for row in rows:
                pending[row] = self.state.times[row]
        for count in sorted({pending[row] - 1 for row in rows if pending[row] > 1}):
            late = [row for row in rows if pending[row] == count + 1]
            self._past_features(late, count, late=1)
            for row in late:
                pending[row] = 1

    def newest_features(self, rows: list[int]) -> Tensor:
        """Return the features (n, 1, N, D) of the newest frames."""
        self.catch_up(rows)
        features = self._past_features(rows, 1, late=0)[:, -1:]
        if self.config.action_alignment == "previous":  # else the chunk is still to be put there
            for row in rows:
                self.state.pending[row] = 0
        return features

    def _newest(self, rows: list[int]) -> Pass:
        """Return the pass over the newest frame and the next one."""
        last = self.config.frames - 1 if self.config.released else max(self.state.times)
        begin = [max(min(self.state.times[row], last) - 1, 0) for row in rows]  # of idle rows any will do
        times = self.state.cached_times(rows, begin, 2)
        times.wanted = 1
        past = self.state.past(rows, times.positions[:, :1])
        return Pass(past, times, self._condition(rows, times.positions))

    def _past_features(self, rows: list[int], count: int, late: int) -> Tensor:
        """Add `count` known frames, `late` before the next one, to the cache; return their features."""
        times = self.state.cached_times(rows, [self.state.times[row] - count - late for row in rows], count)
        x = self.model.embed(self.state.past(rows, times.positions))
        return self.engine.trunk(x, self._condition(rows, times.positions), times, self._carried())

    def _carried(self) -> Carried:
        appended = self.config.absent_tokens if self.passive else self.config.appended_tokens
        device, dtype = self.model.device.type, self.model.dtype
        if torch.is_autocast_enabled(device):
            dtype = torch.get_autocast_dtype(device)
        before = self.state.carried
        # Outside inference mode, because a row may be restored later, and inference tensors refuse that.
        with torch.inference_mode(False), torch.no_grad():
            carried = self.state.carry(self.config.tokens_per_frame + appended, dtype)
        if self.engine.compiled is not None and carried is not before:
            # CUDA graphs replay with the addresses of their recording. Memory that is not marked would be
            # copied into the graph's own before each pass, and what a pass writes would be lost.
            for memory in carried.memory:
                torch._dynamo.mark_static_address(memory)
        return carried

    def _condition(self, rows: list[int], positions: Tensor) -> Conditioning:
        """Return the conditioning of rows at times (n, T); it is the same in every pass."""
        groups = Groups.of([self.state.embodiments[row] for row in rows], len(rows))
        skips = self.passive and self.config.absent_action != "embedding"
        given = None if skips else self.state.given(rows, positions)
        return self.model.condition(given, groups, positions, unsort=True)
