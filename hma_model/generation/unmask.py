"""Unmask a frame step by step (arXiv 2202.04200).

Each pass predicts the tokens that are still masked, and keeps some of them for good. The cosine schedule
determines how many; they are chosen at random or by confidence. Each sample draws from a generator of its
own, so that its numbers do not depend on the other samples.

B batch, S tokens of a frame, k tokens unmasked in a pass, C values of a patch, D width.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from hma_data.errors import HMAError
from hma_model.network.head import Generators, LatentReadout, TokenReadout, uniform


@dataclass(frozen=True)
class Decoding:
    """The settings of unmasking.

    Attributes:
        steps: number of passes a frame.
        temperature: 0 takes the likeliest token, else it divides the logits; for the diffusion head it is the
            share of fresh noise in a step.
        order: "random" or "confidence"; patches have no confidence.
        sample_steps: sampling steps of the diffusion head; None for the configuration's.
    """

    steps: int = 2
    temperature: float = 0.0
    order: str = "random"
    sample_steps: int | None = None


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

    def __init__(
        self,
        values: Tensor,
        mask_id: int,
        decoding: Decoding,
        generators: Generators,
        rank: Tensor | None = None,
    ) -> None:
        self.values, self.mask_id, self.decoding = values, mask_id, decoding
        self.generators = generators
        self.rank = uniform(values.shape, generators, values.device) if rank is None else rank

    @property
    def masked(self) -> Tensor:
        """Return (B, S) bool, True for masked tokens."""
        return self.values == self.mask_id

    def unmask(self, readout: TokenReadout, features: Tensor, position: Tensor, count: int) -> None:
        """Predict tokens from features (B, S, D) of frames at times (1 or B, 1), and keep `count` more."""
        self.values = self.unmasked(readout, features, count)

    def unmasked(self, readout: TokenReadout, features: Tensor, count: int) -> Tensor:
        """Return the tokens (B, S) with `count` more of them predicted from features (B, S, D)."""
        masked = self.masked
        if self.decoding.order == "random":
            chosen = _top(self.rank, masked, count)
            tokens, _ = self._sample(readout, _gather(features, chosen))
        else:
            everything, confidence = self._sample(readout, features)
            chosen = _top(confidence, masked, count)
            tokens = everything.gather(1, chosen)
        return self.values.scatter(1, chosen, tokens)

    def _sample(self, readout: TokenReadout, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return token ids (B, k) and, if the order asks for them, the log probabilities (B, k) of these."""
        scores = readout.split(readout(features)).transpose(1, 2)  # (B, F, k, V)
        drawn = scores
        if self.decoding.temperature > 0:  # the largest of these sums is a sample from the softmax
            noise = uniform(scores.shape, self.generators, scores.device).clamp(min=1e-20)
            drawn = scores / self.decoding.temperature - (-noise.log()).log()
        digits = drawn.argmax(-1, keepdim=True)
        confidence = features
        if self.decoding.order == "confidence":
            confidence = scores.log_softmax(-1).gather(-1, digits).sum(1).squeeze(-1)
        return readout.ids(digits.squeeze(-1).transpose(1, 2)), confidence


class PatchFrame:
    """A frame of patches that is unmasked step by step.

    Attributes:
        values: (B, S, C) scaled patches.
        masked: (B, S) bool, True for masked patches.
    """

    def __init__(self, values: Tensor, decoding: Decoding, generators: Generators) -> None:
        self.values, self.decoding, self.generators = values, decoding, generators
        self.masked = torch.ones(values.shape[:2], dtype=torch.bool, device=values.device)
        self.rank = uniform(values.shape[:2], generators, values.device)

    def unmask(self, readout: LatentReadout, features: Tensor, position: Tensor, count: int) -> None:
        """Draw `count` more patches from features (B, S, D) of frames at times (1 or B, 1)."""
        chosen = _top(self.rank, self.masked, count)
        conditions = _gather(readout(features.unsqueeze(1), position).squeeze(1), chosen).flatten(0, 1)
        way = self.decoding
        patches = readout.diffusion.sample(conditions, way.sample_steps, way.temperature, self.generators)
        patches = patches.view(*chosen.shape, -1)
        self.values = self.values.scatter(1, chosen.unsqueeze(-1).expand_as(patches), patches)
        self.masked = self.masked.scatter(1, chosen, False)


def _top(score: Tensor, masked: Tensor, count: int) -> Tensor:
    """Return the indices (B, k) of the masked tokens with the highest scores."""
    return score.masked_fill(~masked, -torch.inf).topk(count, dim=1).indices


def _gather(features: Tensor, chosen: Tensor) -> Tensor:
    """Return the features (B, k, D) of the tokens (B, k) from (B, S, D)."""
    return features.gather(1, chosen.unsqueeze(-1).expand(-1, -1, features.shape[-1]))


def check(decoding: Decoding, kind: str) -> None:
    """Raise HMAError for a setting that a model of this kind does not take."""
    orders = ("random", "confidence") if kind == "discrete" else ("random",)
    for name, value, allowed, remedy in (
        ("unmask_steps", decoding.steps, decoding.steps >= 1, "give at least 1"),
        ("temperature", decoding.temperature, decoding.temperature >= 0, "give at least 0"),
        ("order", decoding.order, decoding.order in orders, f"a {kind} model takes {' or '.join(orders)}"),
    ):
        if not allowed:
            raise HMAError(name, f"{value!r} is not allowed", remedy)
