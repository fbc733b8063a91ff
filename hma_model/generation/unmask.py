"""A frame's tokens or patches, unmasked in a few passes (arXiv 2202.04200).

Each pass predicts the tokens still masked, and keeps some: which ones is drawn at random or decided by
confidence, how many is the cosine schedule's. Tokens once kept stay.

B batch, S tokens of a frame, k tokens unmasked in a pass, D width, C values of a patch.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from hma_model.network.embed import from_digits
from hma_model.network.head import LatentReadout, TokenReadout
from hma_model.network.masking import uniform


@dataclass(frozen=True)
class Decoding:
    """How frames are unmasked.

    Attributes:
        steps: passes a frame.
        temperature: 0 takes the likeliest token, else it divides the logits; of the diffusion head, the share
            of fresh noise in a step.
        order: "random" or "confidence"; patches have no confidence.
        sample_steps: of the diffusion head; None for the configuration's.
        generator: of every random draw.
    """

    steps: int = 2
    temperature: float = 0.0
    order: str = "random"
    sample_steps: int | None = None
    generator: torch.Generator | None = None


class TokenFrame:
    """A frame of discrete tokens on its way from all masked to none.

    Attributes:
        values: (B, S) int64 ids, the vocabulary's size meaning masked.
    """

    def __init__(self, values: Tensor, mask_id: int, decoding: Decoding) -> None:
        self.values, self.mask_id, self.decoding = values, mask_id, decoding
        self.rank = uniform(values.shape, decoding.generator, values.device)

    def unmask(self, readout: TokenReadout, features: Tensor, position: Tensor, count: int) -> None:
        """Predict from the frame's features (B, S, D) at its time (1,), and keep `count` more tokens."""
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
        """Token ids (B, k) and the logarithm of their probabilities (B, k), each digit by itself."""
        digits, confidence = [], torch.zeros(features.shape[:2], device=features.device)
        for scores in readout(features).split(list(readout.factored), dim=-1):
            digit = _draw(scores, self.decoding)
            digits.append(digit)
            if self.decoding.order == "confidence":
                confidence += scores.log_softmax(-1).gather(-1, digit.unsqueeze(-1)).squeeze(-1)
        return from_digits(torch.stack(digits, dim=-1), readout.factored), confidence


class PatchFrame:
    """A frame of patches on its way from all masked to none.

    Attributes:
        values: (B, S, C) scaled patches.
        masked: (B, S) bool.
    """

    def __init__(self, values: Tensor, decoding: Decoding) -> None:
        self.values, self.decoding = values, decoding
        self.masked = torch.ones(values.shape[:2], dtype=torch.bool, device=values.device)
        self.rank = uniform(values.shape[:2], decoding.generator, values.device)

    def unmask(self, readout: LatentReadout, features: Tensor, position: Tensor, count: int) -> None:
        """Draw `count` more patches from the frame's features (B, S, D) at its time (1,)."""
        chosen = _top(self.rank, self.masked, count)
        conditions = _gather(readout(features.unsqueeze(1), position).squeeze(1), chosen)
        way = self.decoding
        patches = readout.diffusion.sample(
            conditions.flatten(0, 1), way.sample_steps, way.temperature, way.generator
        ).view(*chosen.shape, -1)
        self.values = self.values.scatter(1, chosen.unsqueeze(-1).expand_as(patches), patches)
        self.masked = self.masked.scatter(1, chosen, False)


def _top(score: Tensor, masked: Tensor, count: int) -> Tensor:
    """The (B, k) masked tokens of the highest scores."""
    return score.masked_fill(~masked, -torch.inf).topk(count, dim=1).indices


def _gather(features: Tensor, chosen: Tensor) -> Tensor:
    """(B, S, D) at the tokens (B, k) -> (B, k, D)."""
    return features.gather(1, chosen.unsqueeze(-1).expand(-1, -1, features.shape[-1]))


def _draw(scores: Tensor, decoding: Decoding) -> Tensor:
    """A digit's value (B, k) from its scores (B, k, V)."""
    if decoding.temperature > 0:
        noise = uniform(scores.shape, decoding.generator, scores.device).clamp(min=1e-20)
        scores = (
            scores / decoding.temperature - (-noise.log()).log()
        )  # the largest is a draw from the softmax
    return scores.argmax(-1)
