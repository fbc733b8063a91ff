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
from hma_model.network.trunks.contract import Carried, Conditioning, TimePositions, window_times


class Passes:
    """The passes over the frames of a rollout.

    Args:
        model, engine: the model, and its trunk as it is run.
        state: the rows.
        caching: keep keys and values of past frames.

    Attributes:
        passive: no actions at all; None as long as no step has told.
    """

    def __init__(self, model: Network, engine: Engine, state: RowState, caching: bool) -> None:
        self.model, self.config, self.engine, self.state = model, model.config, engine, state
        self.caching = caching
        self.passive: bool | None = None

    def begin(self, rows: list[int]) -> list[Pass]:
        """Return the pass that all rows share; without a cache, one for the rows of each time."""
        if self.caching:
            self.catch_up(rows)
            every = list(range(len(self.state.times)))
            if self.engine.compiled is None or len(rows) == len(every):
                return [self._newest(rows)]
            # Compiled code has one shape, so idle rows compute too. Their next step writes the slots again.
            return [replace(self._newest(every), lanes=self.state.tensor(rows))]
        times = self.state.times
        ages = dict.fromkeys(times[row] for row in rows)
        return [self._whole(rows, [i for i, row in enumerate(rows) if times[row] == age]) for age in ages]

    def features(
        self, frame: TokenFrame | PatchFrame, passes: list[Pass], first: bool
    ) -> tuple[Tensor, Tensor]:
        """Return the new frames' features (n, N, D) and their times (1 or n, 1)."""
        found = [self._compute(frame, part, first) for part in passes]
        if len(found) == 1:
            return found[0]
        order = torch.cat([part.among for part in passes if part.among is not None]).argsort()
        times = torch.cat([time.expand(len(features), 1) for features, time in found])
        return torch.cat([features for features, _ in found])[order], times[order]

    def inputs(
        self, frame: TokenFrame | PatchFrame, part: Pass, first: bool
    ) -> tuple[Tensor, Conditioning, TimePositions, Carried | None]:
        """Return the inputs of the trunk for a pass."""
        whole = first or not self.caching
        fresh = part.past if whole or self.config.masked_input == "previous" else part.past[:, :0]
        values = torch.cat([fresh, part.lay_out(frame.values).unsqueeze(1)], dim=1)
        masked = torch.zeros(values.shape[:3], dtype=torch.bool, device=values.device)
        masked[:, -1] = part.lay_out(frame.masked)
        x = self.model.embed(values, masked.unsqueeze(-1))
        if not self.caching:
            return x, part.conditioning, part.times, None
        conditioning = part.conditioning if first else part.conditioning.last()
        times = part.times if first else part.times.last()
        return x if whole else x[:, -1:].contiguous(), conditioning, times, self._carried()

    def catch_up(self, rows: list[int]) -> None:
        """Add all pending frames but the newest to the cache."""
        pending = self.state.pending
        for count in sorted({pending[row] - 1 for row in rows if pending[row] > 1}):
            late = [row for row in rows if pending[row] == count + 1]
            self._past_features(late, count, late=1)
            for row in late:
                pending[row] = 1

    def newest_features(self, rows: list[int]) -> Tensor:
        """Return the features (n, 1, N, D) of the newest frames."""
        if self.caching:
            self.catch_up(rows)
            features = self._past_features(rows, 1, late=0)[:, -1:]
            if self.config.action_alignment == "previous":  # else the chunk is still to be put there
                for row in rows:
                    self.state.pending[row] = 0
            return features
        times, made = self.state.times, dict[int, Tensor]()
        for age in dict.fromkeys(times[row] for row in rows):
            own = [row for row in rows if times[row] == age]
            places = window_times(self.config, age, self.model.device)
            made |= zip(own, self._known_features(own, places, None)[:, -1:])
        return torch.stack([made[row] for row in rows])

    def _newest(self, rows: list[int]) -> Pass:
        """Return the pass over the newest frame and the next one with a cache."""
        last = self.config.frames - 1 if self.config.released else max(self.state.times)
        begin = [max(min(self.state.times[row], last) - 1, 0) for row in rows]  # of idle rows any will do
        times = self.state.cached_times(rows, begin, 2)
        times.wanted = 1
        past = self.state.past(rows, times.positions[:, :1])
        return Pass(past, times, self._condition(rows, times.positions))

    def _whole(self, rows: list[int], members: list[int]) -> Pass:
        """Return the pass over all frames and the next one of those rows of a step that are at one time."""
        chosen = [rows[i] for i in members]
        times = window_times(self.config, self.state.times[chosen[0]] + 1, self.model.device)
        past = self.state.past(chosen, times.positions[:-1].unsqueeze(0))
        conditioning = self._condition(chosen, times.positions.unsqueeze(0))
        return Pass(past, times, conditioning, among=self.state.tensor(members))

    def _past_features(self, rows: list[int], count: int, late: int) -> Tensor:
        """Add `count` known frames, `late` before the next one, to the cache; return their features."""
        begin = [self.state.times[row] - count - late for row in rows]
        return self._known_features(rows, self.state.cached_times(rows, begin, count), self._carried())

    def _known_features(self, rows: list[int], times: TimePositions, carried: Carried | None) -> Tensor:
        """Return the features (n, T, N, D) of known frames at times that all rows share, or (n, T) ones."""
        positions = times.positions if times.positions.dim() > 1 else times.positions.unsqueeze(0)
        x = self.model.embed(self.state.past(rows, positions))
        return self.engine.trunk(x, self._condition(rows, positions), times, carried)

    def _compute(self, frame: TokenFrame | PatchFrame, part: Pass, first: bool) -> tuple[Tensor, Tensor]:
        """Compute a pass: all its frames if it is the first or there is no cache, else the new one."""
        x, conditioning, times, carried = self.inputs(frame, part, first)
        trunk = self.engine.compiled or self.engine.trunk
        features = trunk(x, conditioning, times, carried)[:, -1]
        at = times.positions[..., -1:].view(-1, 1)
        if part.lanes is None:
            return features, at
        return features[part.lanes], at if len(at) == 1 else at[part.lanes]

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
        """Return the conditioning of rows at times (1 or n, T); it is the same in every pass."""
        groups = Groups.of([self.state.embodiments[row] for row in rows], len(rows))
        skips = self.passive and self.config.absent_action != "embedding"
        given = None if skips else self.state.given(rows, positions)
        return self.model.condition(given, groups, positions, unsort=True)
