"""Generate frame after frame from a prompt and actions, with a cache over time.

    rollout = Rollout(model, "arm", batch=2)
    rollout.prompt(tokens, actions)
    frames = rollout.step(chunks)            # the frames that the chunks lead to
    rollout.reset([1], tokens, actions)      # row 1 begins anew; row 0 goes on
    chunks = rollout.act()                   # the chunks that the model itself would command
    rollout.observe(frames, chunks)          # what came of them, if it is known

All state belongs to a row (`hma_model.generation.state`). Rows begin, end and step independently of each
other, and a row generates the same frames whatever its neighbours are.

A frame costs one pass of the trunk for each step of unmasking (`hma_model.generation.passes`).

B rows, n rows of a step, P frames of a prompt, h,w token grid, S = h*w, K = stride * action dim, c channels,
H,W latent grid.
"""

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from hma_data.errors import HMAError
from hma_model.config import POLICY
from hma_model.generation.engine import Engine
from hma_model.generation.passes import Passes
from hma_model.generation.state import RowState, Snapshot
from hma_model.generation.unmask import Decoding, PatchFrame, TokenFrame, masked_after
from hma_model.network.conditioning import ActionConditioning, Groups, align, unknown
from hma_model.network.copying import known_digits
from hma_model.network.network import Network
from hma_model.network.stem import split_tokens, unpatchify


class Rollout:
    """B rollouts side by side.

    A frame sees itself and the `frames` - 1 frames before it (`frames` of the configuration). With rotary
    positions that window moves along. With learned positions the window is recomputed for each frame beyond
    its length.

    Args:
        model: any model; it is used as it is now, so call `eval()` on it before. Later changes of its weights
            may not reach the rollout.
        embodiment: one id for all, or one a row.
        batch: B.
        generator: of the seeds of rows that get none.
        cache: keep keys and values of past frames; without, each frame computes them anew.
        compile: compile the passes over one or two frames, on a GPU with CUDA graphs; the first frames then
            take a minute or more. A step of some rows then computes all of them.
        precision: "float32"; "bf16" or "int8" for products in these. In int8 a row's frames depend on the
            rows beside it.
        decoding: the settings of unmasking: unmask_steps, temperature, order, sample_steps, measure.

    Attributes:
        decoding: the settings of unmasking; they may be replaced between steps.
        state: the state of the rows.
        passes: of the trunk over their frames.
        uncertainty: (n,) of the rows of the last step, if `decoding` measures it. Of tokens, the mean entropy
            of what was predicted when a token of the trunk was decided, in nats. Of latents, the standard
            deviation of what might have been drawn for a value, in the tokenizer's units.
    """

    def __init__(
        self,
        model: Network,
        embodiment: str | Sequence[str],
        batch: int = 1,
        *,
        generator: torch.Generator | None = None,
        cache: bool = True,
        compile: bool = False,
        precision: str = "float32",
        **decoding: Any,
    ) -> None:
        self.model, self.config = model, model.config
        self.decoding = Decoding.of(model.config, **decoding)
        self.batch = batch
        self.engine = Engine(model, precision, compile and cache)
        Groups.of(embodiment, batch)  # checks that there are as many ids as rows
        names = [embodiment] * batch if isinstance(embodiment, str) else list(embodiment)
        self.state = RowState(model, names, generator, cache)
        self.passes = Passes(model, self.engine, self.state)
        self.told = False  # some prompt had actions

    # -- rows ---------------------------------------------------------------------------------------------

    def prompt(
        self,
        frames: Tensor,
        actions: Tensor | None,
        known: Tensor | None = None,
        *,
        seeds: Sequence[int] | None = None,
    ) -> None:
        """Start all rows anew from known frames.

        Args:
            frames: tokens (B, P, h, w) int64, or latents (B, P, c, H, W) as stored. If there are more than
                the window holds, the last are used.
            actions: (B, P - 1 or more, K) raw; chunk k holds the commands from frame k to k+1. Later chunks
                are not used. None for no actions.
            known: (B, P - 1 or more) bool, True where a chunk is known; by default all are.
            seeds: of each row's random numbers; by default they are drawn from the rollout's generator.
        """
        self.passes.passive, self.told = None, False
        self.reset(range(self.batch), frames, actions, known, seeds)

    @torch.no_grad()
    def reset(
        self,
        rows: Sequence[int],
        frames: Tensor,
        actions: Tensor | None,
        known: Tensor | None = None,
        seeds: Sequence[int] | None = None,
        embodiments: Sequence[str] | None = None,
    ) -> None:
        """Start some rows anew; the others are undisturbed.

        Args:
            rows: n numbers of rows.
            frames, actions, known, seeds: of these rows, as in `prompt`.
            embodiments: the rows' new ids; by default they keep theirs.
        """
        chosen = self._chosen(rows, len(frames), "prompt")
        values = self.model.frame_values(frames).to(self.model.device)
        names = list(embodiments or [self.state.embodiments[row] for row in chosen])
        given = _prompt_chunks(self.model, names, actions, known, values.shape[1])
        last = slice(max(values.shape[1] - self.config.frames, 0), None)
        self.state.begin(chosen, names, values[:, last], given.frames(last), seeds)
        self.told = self.told or actions is not None

    def fork(self, n: int, rows: Sequence[int] | None = None) -> "Rollout":
        """Return a new rollout that has some rows n times, side by side, with the same random numbers."""
        rows = [row for row in self._chosen(rows) for _ in range(n)]
        names = [self.state.embodiments[row] for row in rows]
        other = Rollout(
            self.model, names, len(rows), generator=self.state.shared, cache=self.state.caching,
            compile=self.engine.compiled is not None, precision=self.engine.precision,
            **vars(self.decoding),
        )  # fmt: skip
        other.restore(range(len(rows)), self.state.snapshot(rows, self.passes.passive))
        return other

    def snapshot(self, rows: Sequence[int] | None = None) -> Snapshot:
        """Return a copy of the state of some rows, by default all."""
        return self.state.snapshot(self._chosen(rows), self.passes.passive)

    def restore(self, rows: Sequence[int], snapshot: Snapshot) -> None:
        """Put rows into the state of a snapshot of as many rows, from any rollout with the same `cache`."""
        chosen = self._chosen(rows, len(snapshot.times), "snapshot")
        if snapshot.caching != self.state.caching:  # frames lie elsewhere
            raise HMAError("snapshot", f"is of cache={snapshot.caching}", "restore it into such a rollout")
        if self._clashes(snapshot.passive):
            raise HMAError(
                "snapshot", "some rows have actions and some have none", "give them always or never"
            )
        self.passes.passive = snapshot.passive if self.passes.passive is None else self.passes.passive
        self.told = self.told or bool(snapshot.known.any())
        self.state.restore(chosen, snapshot)

    def newest(self, rows: Sequence[int] | None = None) -> Tensor:
        """Return the newest frame of some rows, by default all, in the form of `step`."""
        return self._show(self.state.newest(self._chosen(rows)))

    def _chosen(self, rows: Sequence[int] | None, given: int | None = None, what: str = "") -> list[int]:
        """Return the numbers of rows; raise HMAError if they are none, or something is given of others."""
        chosen = list(range(self.batch) if rows is None else rows)
        if not chosen or len(set(chosen)) < len(chosen) or not 0 <= min(chosen) <= max(chosen) < self.batch:
            raise HMAError("rows", f"{chosen} are not rows", f"give some of 0 to {self.batch - 1}, each once")
        if given not in (None, len(chosen)):
            raise HMAError(what, f"has {given} rows, {len(chosen)} are chosen", "give one for each")
        return chosen

    def _clashes(self, passive: bool | None) -> bool:
        """Check whether rows with and without actions meet where their frames differ in tokens."""
        differ = self.config.absent_action != "embedding"
        return differ and None not in (self.passes.passive, passive) and self.passes.passive != passive

    # -- a step -------------------------------------------------------------------------------------------

    @torch.no_grad()
    def step(
        self,
        chunk: Tensor | None = None,
        following: Tensor | None = None,
        *,
        known: Tensor | None = None,
        rows: Sequence[int] | None = None,
    ) -> Tensor:
        """Generate the next frame of some rows.

        Args:
            chunk: (n, K) raw commands from the newest frame to the next one; None for no actions.
            following: (n, K) raw commands after the next frame. They condition it if the configuration aligns
                actions with the current frame (released weights). By default `chunk` is used again.
            known: (n,) bool, False where a row's commands are unknown; (n, 2) states `following` apart. By
                default all are known.
            rows: n numbers of rows, in the order of `chunk`; by default all.

        Returns:
            (n, h, w) int64 tokens, or (n, c, H, W) float32 latents as stored.
        """
        if not self.config.predicts_video:
            fault = f"was not trained to predict frames, but for {', '.join(self.config.objectives)}"
            raise HMAError(self.model.name, fault, "choose another checkpoint")
        chosen = self._begun(rows)
        self._make_room(chosen)
        self._take(chosen, chunk, following, known)
        with self.engine.computing(len(chosen)):
            values = self._frame(chosen)
        self.state.put_frame(chosen, values, generated=True)
        # A copy, because what is made in inference mode could not be changed in place.
        return self._show(values.clone())

    @torch.no_grad()
    def observe(
        self,
        frames: Tensor,
        chunk: Tensor | None = None,
        *,
        known: Tensor | None = None,
        rows: Sequence[int] | None = None,
    ) -> None:
        """Add the next frame of some rows, which is known and not generated.

        Args:
            frames: tokens (n, h, w) int64, or latents (n, c, H, W) as stored.
            chunk, known, rows: as in `step`; the commands that led to the frame.
        """
        chosen = self._chosen(self._begun(rows), len(frames), "observe")
        values = self.model.frame_values(frames.unsqueeze(1)).to(self.model.device)[:, 0]
        self._make_room(chosen)
        self._take(chosen, chunk, None, known)  # before the cache, whose tokens it decides
        if self.state.caching:
            with self.engine.computing(len(chosen)):
                self.passes.catch_up(chosen)
        self.state.put_frame(chosen, values, generated=False)

    @torch.no_grad()
    def act(self, rows: Sequence[int] | None = None) -> Tensor:
        """Predict the chunk to command from the newest frame of some rows on: `HMA.predict_actions`, cached.

        For models trained with the objective `policy` or `full`. With `step` after it, video and actions are
        rolled out together; with `observe` after it, the model acts.

        Args:
            rows: n numbers of rows; by default all.

        Returns:
            (n, K) float32 raw; those of narrower embodiments are padded with zeros.

        Raises:
            HMAError: no objective of the training trained the policy.
        """
        self.model.require_readout(POLICY)
        own = self._begun(rows)
        if self.config.action_alignment == "current":
            self.state.put_chunk(own, 1, None, None)  # it is the one that is asked for
        pending = list(self.state.pending)
        with self.engine.computing(len(own)):
            features = self.passes.newest_features(own)
        if self.passes.passive is None and not self.told:  # the step to come decides the cache's tokens
            self.state.pending = pending
        names = [self.state.embodiments[row] for row in own]
        groups = Groups.of(names, len(own))
        pooled = groups.sort(self.model.action_features(features.clone()))
        return self.model.read_chunks(pooled, groups, POLICY, self.state.drawing(own))[:, 0]

    def _begun(self, rows: Sequence[int] | None) -> list[int]:
        own = self._chosen(rows)
        for row in own:
            if not self.state.times[row]:
                raise HMAError("step", f"row {row} has no prompt", "reset the row first")
        return own

    def _make_room(self, rows: list[int]) -> None:
        if self.config.released:
            self.state.slide(rows)
        if not self.state.caching:
            self.state.grow(rows)

    def _frame(self, rows: list[int]) -> Tensor:
        """Return the next frame (n, S) of rows: begin with a masked one, and unmask it step by step."""
        frame, shared = self._blank(rows), self.passes.begin(rows)
        left = tokens = self.config.tokens_per_frame
        steps = 1 if self.config.whole_frames else self.decoding.unmask_steps
        for step in range(steps):
            count = left - masked_after(step, steps, tokens)
            if count <= 0:
                continue
            first = left == tokens
            if self.engine.whole is not None and isinstance(frame, TokenFrame) and not self.decoding.measure:
                # One graph for the pass and the choice of tokens; all draws are made before, outside of it.
                seen = frame.laid_out(shared.lay_out, self.model.token_readout, count)
                made = self.engine.whole(seen, count, *self.passes.inputs(frame, shared, first)).clone()
                frame.values = made if shared.lanes is None else made[shared.lanes]
            else:
                features, position = self.passes.features(frame, shared, first)
                own = features[:, :tokens]
                frame.unmask(self.engine.readout, own, position, count)  # type: ignore[arg-type]
            left -= count
        self.uncertainty = frame.uncertainty / self.config.latent_scale
        return frame.values

    # -- actions ------------------------------------------------------------------------------------------

    def _take(
        self, rows: list[int], chunk: Tensor | None, following: Tensor | None, known: Tensor | None
    ) -> None:
        """Store the chunk at the frame that it conditions."""
        if self._clashes(chunk is None):
            raise HMAError("step", "some steps have actions and some have none", "give them always or never")
        if self.passes.passive is None:
            self.passes.passive = chunk is None and not self.told
        if chunk is None:
            self.state.put_chunk(rows, 0, None, None)
            return
        if known is not None:
            known = known.to(self.model.device, torch.bool).view(len(rows), -1)
        now, then = (None, None) if known is None else (known[:, 0], known[:, -1])
        names = [self.state.embodiments[row] for row in rows]
        values = _step_chunk(self.model, names, chunk)
        if self.config.action_alignment == "current":
            self.state.put_chunk(rows, 1, values, now)
            now, values = then, values if following is None else _step_chunk(self.model, names, following)
        self.state.put_chunk(rows, 0, values, now)

    # -- in and out ---------------------------------------------------------------------------------------

    def _blank(self, rows: list[int]) -> TokenFrame | PatchFrame:
        """Return new frames (n, S) of rows, wholly masked."""
        values, generators = self.state.blank(len(rows)), self.state.drawing(rows)
        newest = self.state.newest(rows) if self.config.copy_previous else None
        if self.config.discrete:
            before = None if newest is None else known_digits(newest, self.config)
            return TokenFrame(values, self.config.mask_id, self.decoding, generators, before=before)
        return PatchFrame(values, self.decoding, generators, newest)

    def _show(self, values: Tensor) -> Tensor:
        config = self.config
        if config.discrete:
            return split_tokens(values, config.merge, config.vocab_size, config.token_grid)
        shown = unpatchify(values, config.patch, config.token_grid) / config.latent_scale
        return shown.round() if config.pixels else shown  # the scale is not exact in float32


# -- the actions that callers give


def _prompt_chunks(
    model: Network, names: Sequence[str], actions: Tensor | None, known: Tensor | None, frames: int
) -> ActionConditioning:
    """Return the chunk at each of P known frames.

    Where actions align with the current frame, the last frame has none yet: a step gives it.

    Args:
        names: n embodiments.
        actions: (n, P - 1 or more, K) raw; None for no actions.
        known: (n, P - 1 or more) bool; None if all are.
        frames: P.

    Raises:
        HMAError: the shapes are others.
    """
    batch, width, count = len(names), model.widest_chunk(names), frames - 1
    if actions is None or not count:
        return unknown(batch, frames, width, model.device)
    if known is None:
        known = torch.ones(actions.shape[:2], dtype=torch.bool)
    chunks, present = actions[:, :count, :width], known[:, :count]
    if chunks.shape != (batch, count, width) or present.shape != (batch, count):
        fault = f"actions and known have the shapes {tuple(actions.shape)} and {tuple(known.shape)}"
        wanted = f"({batch}, {count} or more, {width}) and ({batch}, {count} or more)"
        raise HMAError("prompt", fault, f"give {wanted} for {frames} frames")
    chunks, present = chunks.to(model.device).float(), present.to(model.device)
    return align(model.config, F.pad(chunks, (0, 0, 0, 1)), F.pad(present, (0, 1)), frames)


def _step_chunk(model: Network, names: Sequence[str], chunk: Tensor) -> Tensor:
    """Return the chunk (n, K) of a step on the model's device; raise HMAError if its shape is another."""
    width = model.widest_chunk(names)
    if chunk.dim() != 2 or chunk.shape[0] != len(names) or chunk.shape[1] < width:
        raise HMAError("step", f"a chunk has the shape {tuple(chunk.shape)}", f"give ({len(names)}, {width})")
    return chunk[:, :width].to(model.device).float()
