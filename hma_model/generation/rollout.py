"""Generate frame after frame from a prompt and actions, with a cache over time.

    rollout = Rollout(model, "arm", batch=1)
    rollout.prompt(tokens, actions)
    frame = rollout.step(chunk)              # the frame that the chunk leads to

A frame costs one pass for each step of unmasking. The first pass also adds the frame before it, now finished,
to the cache. Attention over time is causal, so the cached keys and values of a past frame never change. A
frame at time t lies in slot t mod R. With rotary positions there is one slot more than the window has frames,
for the pass that computes a finished frame and the next one together.

Each pass of unmasking (arXiv 2202.04200) predicts the tokens that are still masked, and keeps some of them
for good. The cosine schedule determines how many; they are chosen at random or by confidence.

B batch, P frames of a prompt, h,w token grid, S = h*w, k tokens unmasked in a pass, C values of a patch,
D width, K = stride * action dim, c channels, H,W latent grid, N tokens of a frame with its action tokens,
L layers, R slots, n frames of a pass.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from hma_data.errors import HMAError
from hma_model.config import HMAConfig
from hma_model.network.conditioning import ActionConditioning, Groups, condition, unknown
from hma_model.network.head import LatentReadout, TokenReadout, uniform
from hma_model.network.model import HMA
from hma_model.network.stem import from_digits, split_tokens, unpatchify
from hma_model.network.trunk import (
    Conditioning,
    LayerCache,
    TimePositions,
    Trunk,
    rotary_angles,
    window_times,
)

_NEVER = -(1 << 40)  # the time of an empty slot


class Cache:
    """The keys and values of every layer, and the time of the frame in each slot.

    Args:
        config: of the model.
        batch: B.
        tokens: N.
        like: a tensor whose device and dtype the keys and values get.
    """

    def __init__(self, config: HMAConfig, batch: int, tokens: int, like: Tensor) -> None:
        self.config = config
        self.slots = config.frames + (config.time_position == "rotary")
        time = (2, self.slots, batch, tokens, config.heads, config.head_dim)
        action = (2, batch, config.heads, self.slots, config.head_dim)
        crossed = "cross_attention" in config.conditioning
        self.layers = [
            LayerCache(like.new_zeros(time), like.new_zeros(action) if crossed else None)
            for _ in range(config.layers)
        ]
        self.times = torch.full((self.slots,), _NEVER, device=like.device)

    def time_positions(self, start: int, frames: int) -> TimePositions:
        """Return the times of a pass over n consecutive frames, and record their times in their slots."""
        positions = torch.arange(start, start + frames, device=self.times.device)
        slots = positions % self.slots
        self.times.index_copy_(0, slots, positions)
        age = positions.unsqueeze(1) - self.times
        allowed = (age >= 0) & (age < self.config.frames)
        return TimePositions(positions, allowed, rotary_angles(self.config, positions), slots=slots)


@dataclass(frozen=True)
class Decoding:
    """The settings of unmasking.

    Attributes:
        steps: number of passes a frame.
        temperature: 0 takes the likeliest token, else it divides the logits; for the diffusion head it is the
            share of fresh noise in a step.
        order: "random" or "confidence"; patches have no confidence.
        sample_steps: sampling steps of the diffusion head; None for the configuration's.
        generator: the generator of every random draw.
    """

    steps: int = 2
    temperature: float = 0.0
    order: str = "random"
    sample_steps: int | None = None
    generator: torch.Generator | None = None


def masked_after(step: int, steps: int, tokens: int) -> int:
    """Return how many tokens of a frame stay masked after step `step` of `steps` (cosine schedule)."""
    if step + 1 >= steps:
        return 0
    return min(math.ceil(math.cos((step + 1) / steps * math.pi / 2) * tokens), tokens - 1)


class TokenFrame:
    """A frame of discrete tokens that is unmasked step by step.

    Attributes:
        values: (B, S) int64 ids of the trunk's tokens; `mask_id` means masked.
    """

    def __init__(self, values: Tensor, mask_id: int, decoding: Decoding) -> None:
        self.values, self.mask_id, self.decoding = values, mask_id, decoding
        self.rank = uniform(values.shape, decoding.generator, values.device)

    def unmask(self, readout: TokenReadout, features: Tensor, position: Tensor, count: int) -> None:
        """Predict tokens from the frame's features (B, S, D) at its time (1,), and keep `count` more."""
        masked = self.values == self.mask_id
        if self.decoding.order == "random":
            chosen = _top(self.rank, masked, count)
            tokens, _ = self._sample(readout, _gather(features, chosen))
        else:
            everything, confidence = self._sample(readout, features)
            chosen = _top(confidence, masked, count)
            tokens = everything.gather(1, chosen)
        self.values = self.values.scatter(1, chosen, tokens)

    def _sample(self, readout: TokenReadout, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return token ids (B, k) and the sums (B, k) of the log probabilities of their digits."""
        digits: list[Tensor] = []
        confidence = torch.zeros(features.shape[:2], device=features.device)
        for scores in readout.one_by_one(features, digits):
            drawn = scores
            if self.decoding.temperature > 0:  # the largest of these sums is a sample from the softmax
                noise = uniform(scores.shape, self.decoding.generator, scores.device).clamp(min=1e-20)
                drawn = scores / self.decoding.temperature - (-noise.log()).log()
            digits.append(drawn.argmax(-1))
            if self.decoding.order == "confidence":
                confidence += scores.log_softmax(-1).gather(-1, digits[-1].unsqueeze(-1)).squeeze(-1)
        return from_digits(torch.stack(digits, dim=-1), readout.factored), confidence


class PatchFrame:
    """A frame of patches that is unmasked step by step.

    Attributes:
        values: (B, S, C) scaled patches.
        masked: (B, S) bool, True for masked patches.
    """

    def __init__(self, values: Tensor, decoding: Decoding) -> None:
        self.values, self.decoding = values, decoding
        self.masked = torch.ones(values.shape[:2], dtype=torch.bool, device=values.device)
        self.rank = uniform(values.shape[:2], decoding.generator, values.device)

    def unmask(self, readout: LatentReadout, features: Tensor, position: Tensor, count: int) -> None:
        """Draw `count` more patches from the frame's features (B, S, D) at its time (1,)."""
        chosen = _top(self.rank, self.masked, count)
        conditions = _gather(readout(features.unsqueeze(1), position).squeeze(1), chosen).flatten(0, 1)
        way = self.decoding
        patches = readout.diffusion.sample(conditions, way.sample_steps, way.temperature, way.generator)
        patches = patches.view(*chosen.shape, -1)
        self.values = self.values.scatter(1, chosen.unsqueeze(-1).expand_as(patches), patches)
        self.masked = self.masked.scatter(1, chosen, False)


def _top(score: Tensor, masked: Tensor, count: int) -> Tensor:
    """Return the indices (B, k) of the masked tokens with the highest scores."""
    return score.masked_fill(~masked, -torch.inf).topk(count, dim=1).indices


def _gather(features: Tensor, chosen: Tensor) -> Tensor:
    """Return the features (B, k, D) of the tokens (B, k) from (B, S, D)."""
    return features.gather(1, chosen.unsqueeze(-1).expand(-1, -1, features.shape[-1]))


class Rollout:
    """B rollouts side by side, one frame a step.

    A frame sees itself and the `frames` - 1 frames before it (`frames` of the configuration). With rotary
    positions that window moves along. With learned positions the window is recomputed for each frame beyond
    its length.

    Args:
        model: any model; it is used as it is, so call `eval()` on it before.
        embodiment: one id for all, or one a sample.
        batch: B.
        unmask_steps, temperature, order, sample_steps, generator: as in `HMA.generate`.
        cache: keep keys and values of past frames.
        compile: compile the passes over one or two frames, on a GPU with CUDA graphs; the first frames then
            take a minute or more.
    """

    def __init__(
        self,
        model: HMA,
        embodiment: str | Sequence[str],
        batch: int = 1,
        *,
        unmask_steps: int = 2,
        temperature: float = 0.0,
        order: str = "random",
        sample_steps: int | None = None,
        generator: torch.Generator | None = None,
        cache: bool = True,
        compile: bool = False,
    ) -> None:
        self.model, self.config = model, model.config
        self.decoding = Decoding(unmask_steps, temperature, order, sample_steps, generator)
        _check(self.decoding, self.config.kind)
        self.caching = cache
        self.compiled = _compiled(model.trunk) if compile and cache else None
        self.groups = Groups.of(embodiment, batch)
        self.sorted = Groups(self.groups.parts)  # the rollout's state is kept in this order
        self.batch = batch
        self.width = max(model.stem(name).input.in_features for name, _ in self.groups.parts)
        self.cache: Cache | None = None

    @torch.no_grad()
    def prompt(self, frames: Tensor, actions: Tensor | None) -> None:
        """Start a new rollout from known frames.

        Args:
            frames: tokens (B, P, h, w) int64, or latents (B, P, c, H, W) as stored. If there are more than
                the window holds, the last are used.
            actions: (B, P - 1 or more, K) raw; chunk k holds the commands from frame k to k+1. Later chunks
                are not used. None for no actions.
        """
        values = self.model.frame_values(frames).to(self.model.device)
        self.frames = self.groups.sort(values)
        self.given = self._condition_on(actions, frames.shape[1])
        self.passive = actions is None
        self.begun, self.cache = False, None
        self._keep(self.config.frames)
        self.fresh = self.time = self.frames.shape[1]  # fresh: frames not in the cache yet

    @torch.no_grad()
    def step(self, chunk: Tensor | None = None, following: Tensor | None = None) -> Tensor:
        """Generate the next frame.

        Args:
            chunk: (B, K) raw commands from the newest frame to the next one; None for no actions.
            following: (B, K) raw commands after the next frame. They condition it if the configuration aligns
                actions with the current frame (released weights). By default `chunk` is used again.

        Returns:
            (B, h, w) int64 tokens, or (B, c, H, W) float32 latents as stored.
        """
        self._take(chunk, following)
        self._slide()
        conditioning = self._condition(self.fresh + 1)
        frame = self._blank()
        left = tokens = self.config.tokens_per_frame
        for step in range(self.decoding.steps):
            count = left - masked_after(step, self.decoding.steps, tokens)
            if count > 0:
                features, position = self._features(frame, conditioning, first=left == tokens)
                own = features[:, :tokens]
                frame.unmask(self.model.readout, own, position, count)  # type: ignore[arg-type]
                left -= count
        self.frames = torch.cat([self.frames, frame.values.unsqueeze(1)], dim=1)
        self.time += 1
        self.fresh = 1 if self.caching else self.frames.shape[1]
        if self.caching and self.config.time_position == "rotary":
            self._keep(1)
        return self._show(frame.values)

    # -- one pass -----------------------------------------------------------------------------------------

    def _features(
        self, frame: TokenFrame | PatchFrame, conditioning: Conditioning, first: bool
    ) -> tuple[Tensor, Tensor]:
        """Return the new frame's features (B, N, D) and its time (1,)."""
        fresh = self.fresh if first or not self.caching else 0
        x = self._embed(frame, fresh)
        if not self.caching:
            times = window_times(self.config, fresh + 1, self.model.device)
            features = self.model.trunk(x, conditioning, times)
        else:
            times = self._cache().time_positions(self.time - fresh, fresh + 1)
            part = conditioning if first else conditioning.last()
            trunk = self.compiled if self.compiled and x.shape[1] <= 2 else self.model.trunk
            features = trunk(x, part, times, self._cache().layers)
        return features[:, -1], times.positions[-1:]

    def _embed(self, frame: TokenFrame | PatchFrame, fresh: int) -> Tensor:
        """Embed the last `fresh` frames and the new one as (B, fresh + 1, S, D)."""
        carries = self.config.masked_input == "previous"
        shown = max(fresh, int(carries))  # the new frame's masked tokens may need the frame before it
        past = self.frames[:, self.frames.shape[1] - shown :]
        values = torch.cat([past, frame.values.unsqueeze(1)], dim=1)
        if isinstance(frame, TokenFrame):
            return self.model.embed_tokens(values)[:, shown - fresh :]
        known = torch.zeros(past.shape[:3], dtype=torch.bool, device=past.device)
        masked = torch.cat([known, frame.masked.unsqueeze(1)], dim=1)
        return self.model.embed_patches(values, masked.unsqueeze(-1))[:, shown - fresh :]

    def _cache(self) -> Cache:
        if self.cache is None:
            appended = self.config.absent_tokens if self.passive else self.config.appended_tokens
            like = self.model.trunk.position.detach()
            if torch.is_autocast_enabled(like.device.type):
                like = like.to(torch.get_autocast_dtype(like.device.type))
            tokens = self.config.tokens_per_frame + appended
            self.cache = Cache(self.config, self.batch, tokens, like)
            if self.compiled is not None:  # static addresses: the compiled code writes them in place
                for layer in self.cache.layers:
                    for kept in (layer.time, layer.action):
                        if kept is not None:
                            torch._dynamo.mark_static_address(kept)
        return self.cache

    # -- state --------------------------------------------------------------------------------------------

    def _condition(self, frames: int) -> Conditioning:
        """Return the conditioning of the last frames, the new one included; it is the same in every pass."""
        skips = self.passive and self.config.absent_action != "embedding"
        given = None if skips else self.given.frames(slice(self.given.known.shape[1] - frames, None))
        positions = torch.arange(self.time + 1 - frames, self.time + 1, device=self.model.device)
        return condition(self.model, given, self.sorted, positions)

    def _condition_on(self, actions: Tensor | None, frames: int) -> ActionConditioning:
        """Return the chunk at each known frame; with `current` alignment `step` adds the last chunk."""
        given = unknown(self.model, self.sorted, frames)
        if actions is None or frames == 1:
            return given
        if actions.shape[1] < frames - 1 or actions.shape[2] < self.width:
            fault = f"actions have the shape {tuple(actions.shape)} for a prompt of {frames} frames"
            raise HMAError("prompt", fault, f"give (batch, {frames - 1} or more, {self.width})")
        late = int(self.config.action_alignment == "previous")
        conditioned = given.frames(slice(late, frames - 1 + late))  # a view
        chunks = self.groups.sort(actions.to(self.model.device))
        conditioned.chunks[:] = chunks[:, : frames - 1, : self.width].float()
        conditioned.known[:] = True
        return given

    def _take(self, chunk: Tensor | None, following: Tensor | None) -> None:
        """Store the chunk at the frame that it conditions, and add a slot for the new frame."""
        if self.begun and self.config.absent_action != "embedding" and self.passive != (chunk is None):
            raise HMAError("step", "some steps have actions and some have none", "give them always or never")
        self.passive = self.passive and chunk is None
        self.begun = True
        new = unknown(self.model, self.sorted, 1)
        if chunk is not None:
            values = self._chunk(chunk)
            if self.config.action_alignment == "current":
                self.given.chunks[:, -1], self.given.known[:, -1] = values, True
                values = values if following is None else self._chunk(following)
            new.chunks[:, 0], new.known[:, 0] = values, True
        self.given = ActionConditioning(
            torch.cat([self.given.chunks, new.chunks], 1), torch.cat([self.given.known, new.known], 1)
        )

    def _chunk(self, chunk: Tensor) -> Tensor:
        if chunk.shape[0] != self.batch or chunk.shape[-1] < self.width or chunk.dim() != 2:
            fault = f"a chunk has the shape {tuple(chunk.shape)}"
            raise HMAError("step", fault, f"give ({self.batch}, {self.width})")
        return self.groups.sort(chunk.to(self.model.device))[:, : self.width].float()

    def _slide(self) -> None:
        """Recompute the window when it moves with learned positions, which change for each of its frames."""
        if self.config.time_position == "learned" and self.time == self.config.frames:
            self._keep(self.config.frames - 1, ahead=1)
            self.fresh = self.time = self.frames.shape[1]
            if self.cache is not None:
                self.cache.times.fill_(_NEVER)

    def _keep(self, frames: int, ahead: int = 0) -> None:
        """Drop all but the last frames, and all chunks but theirs and the `ahead` chunks after them."""
        self.frames = self.frames[:, max(self.frames.shape[1] - frames, 0) :]
        kept = self.given.frames(slice(max(self.given.known.shape[1] - frames - ahead, 0), None))
        self.given = ActionConditioning(kept.chunks.clone(), kept.known.clone())

    # -- in and out ---------------------------------------------------------------------------------------

    def _blank(self) -> TokenFrame | PatchFrame:
        """Return a new frame, wholly masked."""
        shape, device = (self.batch, self.config.tokens_per_frame), self.model.device
        if self.config.kind == "discrete":
            mask_id = self.config.mask_id
            return TokenFrame(torch.full(shape, mask_id, device=device), mask_id, self.decoding)
        return PatchFrame(torch.zeros(*shape, self.config.patch_dim, device=device), self.decoding)

    def _show(self, values: Tensor) -> Tensor:
        values = self.groups.unsort(values)
        if self.config.kind == "discrete":
            config = self.config
            return split_tokens(values, config.merge, config.vocab_size, config.token_grid)
        latents = unpatchify(values.unsqueeze(1), self.config.patch, self.config.token_grid)
        return latents.squeeze(1) / self.config.latent_scale


def _compiled(trunk: Trunk) -> Callable[..., Tensor]:
    """Return the trunk compiled for passes of a fixed shape; a result is valid until the next pass."""
    mode = "reduce-overhead" if trunk.position.device.type == "cuda" else "default"
    compiled = torch.compile(trunk, dynamic=False, mode=mode)

    def call(*arguments: object) -> Tensor:
        torch.compiler.cudagraph_mark_step_begin()
        features: Tensor = compiled(*arguments)
        return features

    return call


def _check(decoding: Decoding, kind: str) -> None:
    orders = ("random", "confidence") if kind == "discrete" else ("random",)
    for name, value, allowed, remedy in (
        ("unmask_steps", decoding.steps, decoding.steps >= 1, "give at least 1"),
        ("temperature", decoding.temperature, decoding.temperature >= 0, "give at least 0"),
        ("order", decoding.order, decoding.order in orders, f"a {kind} model takes {' or '.join(orders)}"),
    ):
        if not allowed:
            raise HMAError(name, f"{value!r} is not allowed", remedy)


def generate(
    model: HMA,
    prompt: Tensor,
    actions: Tensor | None,
    embodiment: str | Sequence[str],
    frames: int,
    **decoding: object,
) -> Tensor:
    """Continue a prompt by `frames` frames; `HMA.generate` explains the arguments."""
    known = prompt.shape[1]
    rollout = Rollout(model, embodiment, prompt.shape[0], **decoding)  # type: ignore[arg-type]
    chunks: Sequence[Tensor | None] = [None] * (known + frames)
    if actions is not None:
        if actions.shape[1] < known + frames - 1:
            fault = f"there are {actions.shape[1]} chunks for {known} + {frames} frames"
            raise HMAError("actions", fault, f"give {known + frames}")
        chunks = [*actions.unbind(1), None]
    rollout.prompt(prompt, actions)
    made = [rollout.step(chunks[i], chunks[i + 1]) for i in range(known - 1, known - 1 + frames)]
    return torch.stack(made, dim=1)
