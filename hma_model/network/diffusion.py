"""Predict patches of latents, or action chunks, by diffusion conditioned on the trunk's features.

A small MLP, modulated by the noise level and the condition, predicts the noise (paper section 3, with the
layers of arXiv 2406.11838) or the velocity (arXiv 2202.00512). The velocity determines the sample even at
full noise. Training draws one of 1000 levels of a cosine schedule by default. Sampling is DDIM with any
number of steps (arXiv 2010.02502).

M rows, C values of a sample, D width of the condition, W width of the head.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hma_model.config import HMAConfig
from hma_model.network.masking import randn, uniform

_LEVEL_VALUES = 256  # sinusoids that describe a noise level


def cosine_levels(steps: int) -> Tensor:
    """Return (steps,) float64, the signal's share of variance at each noise level (arXiv 2102.09672)."""
    time = torch.arange(steps + 1, dtype=torch.float64) / steps
    share = ((time + 0.008) / 1.008 * math.pi / 2).cos() ** 2
    noise = (1 - share[1:] / share[:-1]).clamp(max=0.999)
    return (1 - noise).cumprod(0)


class _Block(nn.Module):
    """A residual MLP whose input is shifted and scaled, and whose output is gated."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width, eps=1e-6)
        self.fc1 = nn.Linear(width, width)
        self.fc2 = nn.Linear(width, width)
        self.modulation = nn.Linear(width, 3 * width)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        shift, scale, gate = self.modulation(condition).chunk(3, dim=-1)
        hidden = torch.addcmul(shift, self.norm(x), 1 + scale)
        return x + gate * self.fc2(F.silu(self.fc1(hidden)))


class DiffusionHead(nn.Module):
    """The network that predicts the noise or the velocity of samples of `values` numbers."""

    levels: Tensor

    def __init__(self, config: HMAConfig, values: int) -> None:
        super().__init__()
        width = config.diffusion_width
        self.values, self.clip = values, config.diffusion_clip
        self.velocity = config.diffusion_target == "velocity"
        self.repeats, self.sample_steps = config.diffusion_repeats, config.diffusion_sample_steps
        self.input = nn.Linear(values, width)
        self.condition = nn.Linear(config.width, width)
        self.level_in = nn.Linear(_LEVEL_VALUES, width)
        self.level_out = nn.Linear(width, width)
        self.blocks = nn.ModuleList(_Block(width) for _ in range(config.diffusion_depth))
        self.modulation = nn.Linear(width, 2 * width)
        self.output = nn.Linear(width, values * (2 if config.diffusion_variance else 1))
        self.register_buffer("levels", cosine_levels(config.diffusion_train_steps).float(), persistent=False)
        self.initialize()

    def initialize(self) -> None:
        """Initialise the weights; modulations and the output start at zero, so each block is the identity."""
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.xavier_uniform_(module.weight)
                nn.init.zeros_(module.bias)
        for name, module in self.named_modules():
            if isinstance(module, nn.Linear) and name.endswith(("modulation", "output")):
                nn.init.zeros_(module.weight)

    def forward(self, noisy: Tensor, level: Tensor, condition: Tensor) -> Tensor:
        """Predict the target (M, C) float32 from samples (M, C), levels (M,) int64 and conditions (M, D)."""
        return self._predict(noisy, self._level(level), self.condition(condition))

    def loss(self, target: Tensor, condition: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return the squared error (M,) float32 of the prediction for samples (M, C), conditions (M, D)."""
        rows = target.shape[0]
        target, condition = (x.repeat(self.repeats, 1) for x in (target.float(), condition))
        draw = uniform((target.shape[0],), generator, target.device)
        level = (draw * len(self.levels)).long().clamp(max=len(self.levels) - 1)
        noise = randn(target.shape, generator, target.device)
        share = self.levels.float()[level].unsqueeze(-1)
        signal, spread = share.sqrt(), (1 - share).sqrt()
        predicted = self(signal * target + spread * noise, level, condition)
        wanted = signal * noise - spread * target if self.velocity else noise
        return F.mse_loss(predicted, wanted, reduction="none").mean(-1).view(self.repeats, rows).mean(0)

    @torch.no_grad()
    def sample(
        self,
        condition: Tensor,
        steps: int | None = None,
        temperature: float = 0.0,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Draw samples by DDIM.

        Args:
            condition: (M, D).
            steps: evaluations of the network, by default the configuration's, at most its training steps.
            temperature: share of fresh noise in a step; 0 is deterministic given the first noise.
            generator: of the first noise and the fresh noise.

        Returns:
            (M, C) float32.
        """
        total = len(self.levels)
        count = min(steps or self.sample_steps, total)
        levels = torch.linspace(total - 1, 0, count).round().long().tolist() if count > 1 else [total - 1]
        shares = [*self.levels.double()[levels].tolist(), 1.0]
        embedded = self.condition(condition)
        x = randn((condition.shape[0], self.values), generator, condition.device)
        for index, level in enumerate(levels):
            predicted = self._predict(x, self._level(torch.tensor([level], device=x.device)), embedded)
            x = self._step(x, predicted, shares[index], shares[index + 1], temperature, generator)
        return x

    def _step(
        self,
        x: Tensor,
        predicted: Tensor,
        share: float,
        after: float,
        eta: float,
        generator: torch.Generator | None,
    ) -> Tensor:
        """Make one DDIM step from a level whose signal share is `share` to one where it is `after`."""
        signal, spread = math.sqrt(share), math.sqrt(1 - share)
        clean = signal * x - spread * predicted if self.velocity else (x - spread * predicted) / signal
        clean = clean.clamp(-self.clip, self.clip)
        if after == 1.0:
            return clean
        noise = (x - signal * clean) / spread  # consistent with the clipped estimate
        fresh = eta * math.sqrt((1 - after) / (1 - share) * (1 - share / after))
        x = math.sqrt(after) * clean + math.sqrt(1 - after - fresh**2) * noise
        return x + fresh * randn(x.shape, generator, x.device) if fresh else x

    def _predict(self, noisy: Tensor, level: Tensor, condition: Tensor) -> Tensor:
        condition = F.silu(level + condition)
        x = self.input(noisy.to(self.input.weight.dtype))
        for block in self.blocks:
            x = block(x, condition)
        shift, scale = self.modulation(condition).chunk(2, dim=-1)
        x = torch.addcmul(shift, F.layer_norm(x, x.shape[-1:], eps=1e-6), 1 + scale)
        return self.output(x)[..., : self.values].float()

    def _level(self, level: Tensor) -> Tensor:
        half = _LEVEL_VALUES // 2
        rates = torch.exp(torch.arange(half, device=level.device) * (-math.log(10000) / half))
        angles = level.float().unsqueeze(-1) * rates
        waves = torch.cat([angles.cos(), angles.sin()], dim=-1).to(self.level_in.weight.dtype)
        return self.level_out(F.silu(self.level_in(waves)))
