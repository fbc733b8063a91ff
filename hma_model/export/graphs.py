"""State what the exported graphs compute: a stem for each robot, and one step that all robots share.

    actions = stem(chunks)                             # of the newest frame and of the next one
    image, *state = step(actions, *state, *draws)      # the next frame

A step is a frame of a `Rollout` with a cache, for one row: fixed shapes, no control that depends on data. All
state is passed in and out. A prompt needs no graph of its own: each of its frames is written into the state
`frame` before the step that would have predicted the next one.

The graph works with the digits of tokens. The trunk's own ids have up to 62 bits, and runtimes compute such
numbers inexactly or not at all.

S tokens of a frame, F digits of a token, V values of a digit, D width, L layers, K = stride * action dim,
C values of a patch, k tokens unmasked in a pass.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hma_data.errors import CheckpointError
from hma_data.tokenizers.base import Tokenizer
from hma_data.tokenizers.network import NetworkTokenizer
from hma_model.generation.unmask import masked_after
from hma_model.network.conditioning import ActionConditioning, Groups, condition
from hma_model.network.head import sampling_levels
from hma_model.network.network import Network
from hma_model.network.stem import from_digits, patchify, to_digits, unpatchify
from hma_model.network.trunks.contract import Carried, Conditioning, TimePositions, ring_times


@dataclass(frozen=True)
class Port:
    """An input of the step's graph.

    Attributes:
        law: of numbers to draw for each step, "uniform" in [0, 1) or "normal"; "" for what is not drawn.
    """

    name: str
    shape: tuple[int, ...]
    dtype: str
    law: str = ""


def require_exportable(model: Network, tokenizer: Tokenizer) -> None:
    """Raise CheckpointError for a model or tokenizer whose graphs are not written."""
    config, where = model.config, model.name
    if not config.predicts_video:
        raise CheckpointError(where, "was not trained to predict frames", "export another checkpoint")
    if config.released or config.absent_action != "embedding":
        fault = "has the layout of the paper's released weights, whose window cannot roll"
        raise CheckpointError(where, fault, "export a model that hma train made")
    if not config.pixels and not isinstance(tokenizer, NetworkTokenizer):
        fault = f"has the tokenizer {tokenizer.spec.name}, which has no network to export"
        raise CheckpointError(where, fault, "export a model of another tokenizer")


class StemGraph(nn.Module):
    """Map the chunks (2, K) at the newest frame and at the next one to what the step takes of them.

    A chunk with a NaN is unknown. What comes out is (2, D), or (2, D + L * 2D) if the stem has its own
    modulation.
    """

    def __init__(self, model: Network, embodiment: str) -> None:
        super().__init__()
        self.stem, self.groups = model.stem(embodiment), Groups.of(embodiment, 1)
        self.config, self.absent = model.config, model.trunk.absent

    def forward(self, chunks: Tensor) -> Tensor:
        """Return the step's input `actions`."""
        known = ~torch.isnan(chunks).any(1)
        given = ActionConditioning(torch.nan_to_num(chunks).unsqueeze(0), known.unsqueeze(0))
        # The modulation that robots share belongs to the step.
        trunk = SimpleNamespace(config=self.config, absent=self.absent, modulation=None)
        made = condition(trunk, lambda _: self.stem, given, self.groups, torch.arange(2))
        assert made.embedding is not None
        parts = [made.embedding[0]]
        if made.modulation is not None:
            parts.append(made.modulation[:, 0].transpose(0, 1).flatten(1))
        return torch.cat(parts, dim=1)


class StepGraph(nn.Module):
    """Predict the next frame from the state, and return its image and the next state.

    Args:
        model: its weights are used as they are at the export.
        tokenizer: the model's.
        unmask_steps: passes in which a frame is decoded.

    Attributes:
        actions: the input that the stem gives.
        state: inputs that come back as outputs `next_…`. At first all are zero.
        draws: the other inputs.
    """

    def __init__(self, model: Network, tokenizer: Tokenizer, unmask_steps: int = 2) -> None:
        super().__init__()
        self.trunk: Any = model.trunk
        self.readout: Any = model.readout
        self.config = model.config
        self.decoder = tokenizer.network if isinstance(tokenizer, NetworkTokenizer) else None
        self.tokenizer, config = tokenizer, model.config
        self.steps = 1 if config.whole_frames else unmask_steps
        self.slots, self.discrete = config.frames + 1, config.discrete
        own = "modulation" in config.conditioning and not config.shared_modulation
        width = config.width * (1 + 2 * config.layers * own)
        self.actions = Port("actions", (2, width), "float32")
        memory = [tuple(one.shape) for one in self._carried().memory]
        self.state = [
            Port("time", (1,), "int32"),
            Port("frame", config.frame_shape, "int32" if self.discrete else "float32"),
            *(Port(f"memory_{i}", shape, "float32") for i, shape in enumerate(memory)),
        ]
        self.draws = list(self._draws())
        self._make_tables()

    def _make_tables(self) -> None:
        """Make what the network keeps for later calls: tensors made during an export have no values."""
        if self.discrete:
            for digits in (self.config.factored, self.config.digits):
                to_digits(torch.zeros(1, dtype=torch.int64), digits)
        elif self.readout.draws:
            sampling_levels(len(self.readout.diffusion.alpha_bars), self.config.diffusion_sample_steps)

    @property
    def inputs(self) -> list[Port]:
        """Return all inputs in the order of `forward`."""
        return [self.actions, *self.state, *self.draws]

    @property
    def outputs(self) -> list[str]:
        """Return the names of all outputs in the order of `forward`."""
        return ["image", *(f"next_{port.name}" for port in self.state), *["uncertainty"][: self.discrete]]

    def _draws(self) -> Iterator[Port]:
        config, tokens = self.config, self.config.tokens_per_frame
        if self.steps > 1:
            yield Port("rank", (1, tokens), "float32", "uniform")
        if self.discrete:
            yield Port("noise", (1, len(config.digits), tokens, max(config.digits)), "float32", "uniform")
            yield Port("temperature", (), "float32")
        elif self.readout.draws:
            yield Port("noise", (tokens, config.patch_dim), "float32", "normal")

    def _carried(self) -> Carried:
        config = self.config
        tokens = config.tokens_per_frame + config.appended_tokens
        return self.trunk.carry(1, self.slots, tokens, torch.float32, torch.device("cpu"))

    def forward(self, actions: Tensor, time: Tensor, frame: Tensor, *rest: Tensor) -> tuple[Tensor, ...]:
        """Return the image (S, V·S, 3) uint8, the next time and frame, the memory, and the entropy of tokens.

        Args:
            actions: what the stem gives.
            time: (1,) of the newest frame.
            frame: the newest one: tokens (h, w), or latents (c, H, W) as stored.
            rest: the memory, then the draws.
        """
        count = len(self.state) - 2
        past = self._carried()
        for own, given in zip(past.memory, rest[:count], strict=True):
            own.copy_(given)
        draws = dict(zip((port.name for port in self.draws), rest[count:], strict=True))
        times = ring_times(self.config, torch.cat([time, time + 1]).long().unsqueeze(0), self.slots)
        times.wanted = 1
        conditioning = self._condition(actions)
        if not self.discrete:
            stored = self._patches(frame, conditioning, times, past, draws)
            return self._image(stored), time + 1, stored, *past.memory
        stored, nats = self._tokens(frame, conditioning, times, past, draws)
        return self._image(stored), time + 1, stored, *past.memory, nats

    def _condition(self, actions: Tensor) -> Conditioning:
        config = self.config
        embedding, own = actions.unsqueeze(0).split([config.width, actions.shape[1] - config.width], dim=-1)
        modulation = None
        if self.trunk.modulation is not None:
            modulation = self.trunk.modulation(embedding)
        elif own.shape[-1]:
            modulation = own.unflatten(-1, (config.layers, -1)).permute(2, 0, 1, 3)
        return Conditioning(embedding, modulation, tokens=embedding if config.appended_tokens else None)

    def _passes(
        self, conditioning: Conditioning, times: TimePositions, past: Carried, embed: Any, rank: Tensor | None
    ) -> Iterator[tuple[Tensor, Tensor | None, slice]]:
        """Yield for each pass the features (1, S, D), the places (1, k) that it decides, and their numbers.

        The caller writes what it decides before the next pass. The places are None if all are decided.
        """
        tokens = left = self.config.tokens_per_frame
        masked = torch.ones(1, tokens, dtype=torch.bool)
        for step in range(self.steps):
            count = left - masked_after(step, self.steps, tokens)
            if count <= 0:
                continue
            pair = embed(masked)
            if left == tokens:
                features = self.trunk(pair, conditioning, times, past)
            else:
                features = self.trunk(pair[:, 1:].contiguous(), conditioning.last(), times.last(), past)
            places = None
            if rank is not None:
                places = rank.masked_fill(~masked, -1.0).topk(count, dim=1).indices
                masked = masked.scatter(1, places, False)
            yield features[:, -1, :tokens], places, slice(tokens - left, tokens - left + count)
            left -= count

    # -- tokens

    def _tokens(
        self, frame: Tensor, conditioning: Conditioning, times: TimePositions, past: Carried, draws: Any
    ) -> tuple[Tensor, Tensor]:
        """Return the next frame's tokens (h, w) int32, and their mean entropy (1,) as of `Rollout`."""
        squares = patchify(self._ids(frame)[None, None], self.config.merge)
        before = to_digits(squares, self.config.factored).flatten(2)  # of a square of tokens side by side
        digits, nats = torch.zeros_like(before), torch.zeros(1)
        shown = torch.zeros(before.shape[:2], dtype=torch.bool)
        uniform = draws["noise"].clamp(1e-20, 1 - 2**-24)
        gumbel = (-uniform.log()).log() * -draws["temperature"]
        values = max(self.config.digits)

        def embed(masked: Tensor) -> Tensor:
            return self.trunk.embed.of_digits(
                torch.stack([before, digits], 1), torch.stack([shown, masked], 1), [-1, 0]
            )

        for features, places, own in self._passes(conditioning, times, past, embed, draws.get("rank")):
            noise = gumbel[:, :, own]
            copied = _at(before, places) if self.config.copy_previous else None
            unsure: list[Tensor] = []

            def choose(
                scores: Tensor, first: int, noise: Tensor = noise, unsure: list[Tensor] = unsure,
                copied: Tensor | None = copied,
            ) -> Tensor:  # fmt: skip
                unsure.append(scores)
                drawn = scores + noise[:, first : first + scores.shape[1], :, : scores.shape[3]]
                return self.readout.taken(drawn, copied)

            made = self.readout.decide(_at(features, places), choose, copied)
            digits = _put(digits, places, made.transpose(1, 2))
            likely = torch.cat([_widened(scores, values) for scores in unsure], dim=1).softmax(-1)
            nats = nats - (likely * likely.clamp_min(1e-30).log()).sum((1, 2, 3))
        apart = digits.unflatten(-1, (-1, len(self.config.factored)))
        ids = from_digits(apart, self.config.factored)[0]
        tokens = unpatchify(ids, self.config.merge, self.config.token_grid)[0]
        return tokens.int(), nats / digits.shape[1]

    def _ids(self, stored: Tensor) -> Tensor:
        """Return tokens int32 as int64 ids; those from 2³¹ on have become negative."""
        ids = stored.long()
        return ids % 2**32 if self.config.vocab_size > 2**31 else ids

    # -- patches of latents

    def _patches(
        self, frame: Tensor, conditioning: Conditioning, times: TimePositions, past: Carried, draws: Any
    ) -> Tensor:
        """Return the next frame's latents (c, H, W) as stored."""
        config = self.config
        before = patchify(frame.unsqueeze(0) * config.latent_scale, config.patch)
        patches = torch.zeros_like(before)

        def embed(masked: Tensor) -> Tensor:
            hidden = torch.stack([torch.zeros_like(masked), masked], 1).unsqueeze(-1)
            return self.trunk.embed_frames(torch.stack([before, patches], 1), hidden, [-1, 0], None)

        kept = before.unsqueeze(1) if config.copy_previous else None
        for features, places, own in self._passes(conditioning, times, past, embed, draws.get("rank")):
            conditions = self.readout(features.unsqueeze(1), times.positions[:, -1], kept)[:, 0]
            noise = draws["noise"][own] if "noise" in draws else None
            made = self.readout.sample(_at(conditions, places)[0], None, 0.0, noise).unsqueeze(0)
            patches = _put(patches, places, made)
        latents = unpatchify(patches[0], config.patch, config.token_grid) / config.latent_scale
        return latents.round() if config.pixels else latents

    # -- images

    def _image(self, stored: Tensor) -> Tensor:
        """Return the image (S, V·S, 3) uint8 of a frame as stored, its views side by side."""
        views = stored.unsqueeze(0).chunk(self.config.views, dim=-2)
        if self.config.pixels:
            images = [view.clamp(0, 255) for view in views]
        else:
            assert isinstance(self.tokenizer, NetworkTokenizer)
            # Latents are decoded as shards store them.
            kept = [self._ids(view) if self.discrete else view.half().float() for view in views]
            images = [self.tokenizer.pixels(view).add(1).mul(127.5).round().clamp(0, 255) for view in kept]
        return torch.cat(images, dim=-1)[0].permute(1, 2, 0).to(torch.uint8)


def _widened(scores: Tensor, values: int) -> Tensor:
    """Return the scores (1, F, k, V) of a digit with so many values; none is likelier for it."""
    missing = values - scores.shape[-1]
    return F.pad(scores, (0, missing), value=torch.finfo(scores.dtype).min) if missing else scores


def _at(values: Tensor, places: Tensor | None) -> Tensor:
    """Return the values (1, k, …) at places (1, k) of (1, S, …); None means all places."""
    return values if places is None else values.gather(1, _wide(places, values))


def _put(values: Tensor, places: Tensor | None, made: Tensor) -> Tensor:
    """Return values (1, S, …) with those of the places replaced."""
    return made if places is None else values.scatter(1, _wide(places, made), made)


def _wide(places: Tensor, values: Tensor) -> Tensor:
    return places.unsqueeze(-1).expand(-1, -1, values.shape[-1])


def example(ports: Sequence[Port]) -> list[Tensor]:
    """Return inputs of zeros."""
    return [torch.zeros(port.shape, dtype=getattr(torch, port.dtype)) for port in ports]
