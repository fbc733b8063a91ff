"""Read the trunk's features out as video tokens, conditions of the diffusion head and action chunks.

B batch, T frames, S tokens of a frame, D width, F digits, V values of a digit, K = stride * action dim.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hma_model.config import ActionSpace, HMAConfig
from hma_model.network.diffusion import DiffusionHead
from hma_model.network.trunk import rows_at
from hma_model.objective import Readout


class TokenReadout(nn.Module):
    """The readout of the discrete model: scores of every digit's values, and their cross-entropy."""

    def __init__(self, config: HMAConfig) -> None:
        super().__init__()
        self.factored, self.smoothing = config.factored, config.label_smoothing
        self.multiplier = config.base_width / config.width if config.mup else 1.0
        self.linear = nn.Linear(config.width, sum(config.factored))
        nn.init.normal_(self.linear.weight, std=0.02)
        nn.init.zeros_(self.linear.bias)

    def forward(self, features: Tensor) -> Tensor:
        """Map features (..., D) to scores (..., sum of V) float32, digit after digit, low digit first."""
        return self.linear(features * self.multiplier if self.multiplier != 1 else features).float()

    def split(self, scores: Tensor) -> Tensor:
        """Split scores (..., sum of V) into (..., F, max V); pad shorter digits with the lowest number."""
        widest = max(self.factored)
        if min(self.factored) == widest:
            return scores.unflatten(-1, (-1, widest))
        parts = scores.split(list(self.factored), dim=-1)
        lowest = torch.finfo(scores.dtype).min
        return torch.stack(
            [F.pad(part, (0, widest - part.shape[-1]), value=lowest) for part in parts], dim=-2
        )

    def loss(self, features: Tensor, digits: Tensor) -> Tensor:
        """Return the cross-entropy (M,), summed over digits, of features (M, D) and digits (M, F)."""
        parts = self(features).split(list(self.factored), dim=-1)
        losses = [
            F.cross_entropy(part, digits[:, i], reduction="none", label_smoothing=self.smoothing)
            for i, part in enumerate(parts)
        ]
        return torch.stack(losses).sum(0)


class LatentReadout(nn.Module):
    """The readout of the continuous model: conditions for the diffusion head, and the head itself."""

    def __init__(self, config: HMAConfig) -> None:
        super().__init__()
        self.proj = nn.Linear(config.width, config.width)
        self.norm = nn.LayerNorm(config.width, eps=1e-6)
        times = config.frames if config.time_position == "learned" else 1
        self.position = nn.Parameter(torch.zeros(times, config.tokens_per_frame, config.width))
        self.diffusion = DiffusionHead(config, config.patch_dim)
        nn.init.normal_(self.proj.weight, std=config.width**-0.5)
        nn.init.zeros_(self.proj.bias)

    def forward(self, features: Tensor, positions: Tensor) -> Tensor:
        """Map features (B, T, S, D) of frames at the times (T,) to conditions (B, T, S, D)."""
        return self.norm(self.proj(features)) + rows_at(self.position, positions)


class ActionHead(nn.Module):
    """The head that predicts action chunks of one embodiment from a frame's pooled features.

    `policy` predicts the chunk to command from the frame on; `inverse` predicts the chunk that led to it.
    """

    def __init__(self, config: HMAConfig, space: ActionSpace) -> None:
        super().__init__()
        self.diffusion: DiffusionHead | None = None
        outputs = space.chunk_dim
        if config.action_loss == "diffusion":
            self.diffusion = DiffusionHead(config, space.chunk_dim)
            outputs = config.width
        self.multiplier = config.base_width / config.width if config.mup else 1.0
        self.policy = nn.Linear(config.width, outputs)
        self.inverse = nn.Linear(config.width, outputs)
        for linear in (self.policy, self.inverse):
            nn.init.normal_(linear.weight, std=config.width**-0.5 if self.diffusion else 0.02)
            nn.init.zeros_(linear.bias)

    def forward(self, features: Tensor, readout: Readout) -> Tensor:
        """Map features (M, D) to chunks (M, K), or to the conditions (M, D) of a diffusion head."""
        linear: nn.Linear = getattr(self, readout.name)
        return linear(features * self.multiplier if self.multiplier != 1 else features)

    def loss(
        self, features: Tensor, target: Tensor, readout: Readout, generator: torch.Generator | None = None
    ) -> Tensor:
        """Return the loss (M,) float32 of features (M, D) and target chunks (M, K)."""
        predicted = self(features, readout)
        if self.diffusion is not None:
            return self.diffusion.loss(target, predicted, generator)
        return F.mse_loss(predicted.float(), target.float(), reduction="none").mean(-1)

    def predict(self, features: Tensor, readout: Readout, generator: torch.Generator | None = None) -> Tensor:
        """Predict chunks (M, K) float32 from features (M, D)."""
        predicted = self(features, readout)
        return (
            predicted.float()
            if self.diffusion is None
            else self.diffusion.sample(predicted, generator=generator)
        )
