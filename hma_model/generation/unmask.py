"""Unmask a frame step by step (arXiv 2202.04200).

Each pass predicts the tokens that are still masked, and keeps some of them for good. The cosine schedule
determines how many; they are chosen at random or by confidence. Each sample draws from a generator of its
own, so that its numbers do not depend on the other samples.

B batch, S tokens of a frame, k tokens unmasked in a pass, C values of a patch, D width.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from hma_data.errors import HMAError
from hma_model.config import HMAConfig
from hma_model.network.draws import uniform
from hma_model.network.head import LatentReadout, RegressionReadout, TokenReadout

# The likeliest tokens leave out what is small and moves, because each of its places is unlikely: a pusher's
# disc is gone after a frame. Draws by the trained frequencies scatter specks over the picture.
TEMPERATURE = 0.5


@dataclass(frozen=True)
class Decoding:
    """The settings of unmasking.

    Attributes:
        unmask_steps: number of passes a frame.
        temperature: 0 takes the likeliest token, else it divides the logits; for the diffusion head it is the
            share of fresh noise in a step.
        order: "random" or "confidence"; patches have no confidence.
        sample_steps: sampling steps of the diffusion head; None for the configuration's.
        measure: add up how unsure the model is of what it decides; see `uncertainty` of the frames.
    """

    unmask_steps: int = 2
    temperature: float = TEMPERATURE
    order: str = "random"
    sample_steps: int | None = None
    measure: bool = False

    @classmethod
    def of(cls, config: HMAConfig, temperature: float | None = None, **others: Any) -> "Decoding":
        """Return the settings for a model, with its own temperature by default; raise as `check`."""
        if temperature is None:
            drawn = config.discrete and not config.whole_frames  # one pass cannot make draws agree
            temperature = TEMPERATURE if drawn else 0.0
        made = cls(temperature=temperature, **others)
        check(made, config)
        return made


def masked_after(step: int, steps: int, tokens: int) -> int:
    """Return how many tokens of a frame stay masked after step `step` of `steps` (cosine schedule)."""
    if step + 1 >= steps:
        return 0
    return min(math.ceil(math.cos((step + 1) / steps * math.pi / 2) * tokens), tokens - 1)


class TokenFrame:
    """A frame of discrete tokens that is unmasked step by step.

    Attributes:
        values: (B, S) int64 ids of the trunk's tokens; `mask_id` means masked.
        before: (B, S, F) int64 digits of the frame before; None for models that do not copy it.
        nats: (B,) entropy of the predictions of the tokens decided so far, if it is measured.
    """

    def __init__(
        self,
        values: Tensor,
        mask_id: int,
        decoding: Decoding,
        generators: Sequence[torch.Generator],
        rank: Tensor | None = None,
        noise: Tensor | None = None,
        before: Tensor | None = None,
    ) -> None:
        self.values, self.mask_id, self.decoding = values, mask_id, decoding
        self.generators = generators
        self.rank = _ranks(values, generators) if rank is None else rank
        self.noise, self.before = noise, before
        self.nats = torch.zeros(len(values), device=values.device)

    def laid_out(
        self, lay_out: Callable[[Tensor], Tensor], readout: TokenReadout, count: int
    ) -> "TokenFrame":
        """Return the frames in other rows, with all draws made for a pass that keeps `count` more tokens."""
        values, rank = lay_out(self.values), lay_out(self.rank)
        asked = count if self.decoding.order == "random" else values.shape[1]
        noise = self._noise(readout, asked)
        noise = None if noise is None else lay_out(noise)
        before = None if self.before is None else lay_out(self.before)
        return TokenFrame(values, self.mask_id, self.decoding, (), rank, noise, before)

    @property
    def masked(self) -> Tensor:
        """Return (B, S) bool, True for masked tokens."""
        return self.values == self.mask_id

    def unmask(self, readout: TokenReadout, features: Tensor, position: Tensor, count: int) -> None:
        """Predict tokens from features (B, S, D) of frames at times (1 or B, 1), and keep `count` more."""
        self.values = self.unmasked(readout, features, count)

    @property
    def uncertainty(self) -> Tensor:
        """Return the mean entropy (B,) of what was predicted for a token when it was decided, in nats."""
        return self.nats / self.values.shape[1]

    def unmasked(self, readout: TokenReadout, features: Tensor, count: int) -> Tensor:
        """Return the tokens (B, S) with `count` more of them predicted from features (B, S, D)."""
        masked = self.masked
        if self.decoding.order == "random":
            chosen = _top(self.rank, masked, count)
            before = None if self.before is None else _gather(self.before, chosen)
            tokens, _, entropy = self._sample(readout, _gather(features, chosen), before)
        else:
            everything, confidence, entropy = self._sample(readout, features, self.before)
            chosen = _top(confidence, masked, count)
            tokens = everything.gather(1, chosen)
            entropy = entropy.gather(1, chosen) if self.decoding.measure else entropy
        if self.decoding.measure:
            self.nats = self.nats + entropy.sum(1)
        return self.values.scatter(1, chosen, tokens)

    def _sample(
        self, readout: TokenReadout, features: Tensor, before: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return token ids (B, k); if asked for, their log probabilities and the entropies, both (B, k)."""
        way, sure, unsure = self.decoding, [], []
        noise = self._noise(readout, features.shape[1]) if self.noise is None else self.noise

        def choose(scores: Tensor, first: int) -> Tensor:
            drawn = scores  # with noise, the largest of the sums is a sample from the softmax
            if noise is not None:
                n, digits, _, values = scores.shape
                drawn = scores + noise[:n, first : first + digits, :, :values]
            taken = readout.taken(drawn, before)
            if way.measure:
                unsure.append(torch.special.entr(scores.softmax(-1)).sum((1, -1)))
            if way.order == "confidence":
                sure.append(scores.log_softmax(-1).gather(-1, taken.unsqueeze(-1)).squeeze(-1).sum(1))
            return taken

        tokens = readout.ids(readout.decide(features, choose, before).transpose(1, 2))
        confidence, entropy = (sum(some, torch.zeros(())) for some in (sure, unsure))
        return tokens, confidence, entropy

    def _noise(self, readout: TokenReadout, tokens: int) -> Tensor | None:
        """Return Gumbel noise (n, F, k, V) for k tokens, times the temperature; None at 0."""
        if not self.decoding.temperature:
            return None
        shape = len(self.generators), len(readout.factored), tokens, max(readout.factored)
        noise = uniform(shape, self.generators, self.values.device).clamp(min=1e-20)
        return (-noise.log()).log() * -self.decoding.temperature


class PatchFrame:
    """A frame of patches that is unmasked step by step.

    Attributes:
        values: (B, S, C) scaled patches.
        masked: (B, S) bool, True for masked patches.
        before: (B, S, C) those of the frame before; None for models that do not copy it.
        variance: (B,) of the values of the patches drawn so far, summed over patches, if it is measured.
    """

    def __init__(
        self,
        values: Tensor,
        decoding: Decoding,
        generators: Sequence[torch.Generator],
        before: Tensor | None = None,
    ) -> None:
        self.values, self.decoding, self.generators, self.before = values, decoding, generators, before
        self.masked = torch.ones(values.shape[:2], dtype=torch.bool, device=values.device)
        self.rank = _ranks(values, generators)
        self.variance = torch.zeros(len(values), device=values.device)

    @property
    def uncertainty(self) -> Tensor:
        """Return the standard deviation (B,) of what might have been drawn for a value, in scaled latents.

        It is NaN of a readout that draws nothing.
        """
        return (self.variance / self.values.shape[1]).sqrt()

    def unmask(
        self, readout: LatentReadout | RegressionReadout, features: Tensor, position: Tensor, count: int
    ) -> None:
        """Draw `count` more patches from features (B, S, D) of frames at times (1 or B, 1)."""
        chosen = _top(self.rank, self.masked, count)
        before = None if self.before is None else self.before.unsqueeze(1)
        conditions = readout(features.unsqueeze(1), position, before).squeeze(1)
        conditions = _gather(conditions, chosen).flatten(0, 1)
        way = self.decoding

        def draw(generators: Sequence[torch.Generator]) -> Tensor:
            drawn = readout.sample(conditions, way.sample_steps, way.temperature, generators)
            return drawn.view(len(generators), chosen.shape[1], -1)

        patches = draw(self.generators)
        if not readout.draws:
            self.variance = torch.full_like(self.variance, torch.nan)
        elif way.measure:  # half the squared difference of two draws is their variance
            copies = [torch.Generator(one.device) for one in self.generators]
            for own, copied in zip(self.generators, copies, strict=True):
                copied.set_state(own.get_state())  # measuring takes none of the rollout's numbers
            other = draw(copies)
            variance = (patches - other).square().mean(-1).sum(1) / 2
            self.variance = self.variance + variance
        self.values = self.values.scatter(1, chosen.unsqueeze(-1).expand_as(patches), patches)
        self.masked = self.masked.scatter(1, chosen, False)


def _ranks(values: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
    """Return random ranks (B, S) of the tokens of frames."""
    return uniform(values.shape[:2], generators, values.device)


def _top(score: Tensor, masked: Tensor, count: int) -> Tensor:
    """Return the indices (B, k) of the masked tokens with the highest scores."""
    return score.masked_fill(~masked, -torch.inf).topk(count, dim=1).indices


def _gather(features: Tensor, chosen: Tensor) -> Tensor:
    """Return the features (B, k, D) of the tokens (B, k) from (B, S, D)."""
    return features.gather(1, chosen.unsqueeze(-1).expand(-1, -1, features.shape[-1]))


def check(decoding: Decoding, config: HMAConfig) -> None:
    """Raise HMAError for a setting that a model does not take."""
    kind, warmth = config.kind, decoding.temperature
    orders = ("random", "confidence") if kind == "discrete" else ("random",)
    for name, value, allowed, remedy in (
        ("unmask_steps", decoding.unmask_steps, decoding.unmask_steps >= 1, "give at least 1"),
        ("temperature", warmth, 0 <= warmth < math.inf, "give a number of at least 0"),
        ("order", decoding.order, decoding.order in orders, f"a {kind} model takes {' or '.join(orders)}"),
    ):
        if not allowed:
            raise HMAError(name, f"{value!r} is not allowed", remedy)
