"""The diffusion head against the closed form of a Gaussian, and its schedule."""

import math

import pytest
import torch
from torch import Tensor

from hma_model.network.head import CLIP, DiffusionHead, cosine_levels
from tests.model.network_parts import small_config

TARGETS = pytest.mark.parametrize("target", ["noise", "velocity"])


class _Gaussian(DiffusionHead):
    """Knows the best prediction for samples from N(mean, spread^2)."""

    def __init__(self, mean: float, spread: float, target: str = "noise") -> None:
        super().__init__(small_config(kind="continuous", diffusion_target=target), 4)
        self.mean, self.spread = mean, spread

    def _level(self, level: Tensor) -> Tensor:
        return self.levels[level].unsqueeze(-1)

    def _predict(self, noisy: Tensor, level: Tensor, condition: Tensor) -> Tensor:
        variance = level * self.spread**2 + 1 - level
        away = (noisy - level.sqrt() * self.mean) / variance
        noise = (1 - level).sqrt() * away
        if not self.velocity:
            return noise
        return level.sqrt() * noise - (1 - level).sqrt() * (self.mean + self.spread**2 * level.sqrt() * away)


@TARGETS
@pytest.mark.parametrize("temperature", [0.0, 1.0])
@pytest.mark.parametrize(("steps", "tolerance"), [(1000, 0.03), (100, 0.05), (20, 0.15)])
def test_sampling_gives_the_distribution_back(steps, tolerance, temperature, target) -> None:
    head = _Gaussian(mean=0.7, spread=0.5, target=target)
    generator = torch.Generator().manual_seed(0)
    samples = head.sample(torch.zeros(4000, 32), steps, temperature, generator)
    assert abs(samples.mean().item() - 0.7) < tolerance
    assert abs(samples.std().item() - 0.5) < tolerance


def test_levels_fall_from_signal_to_noise_along_the_cosine() -> None:
    levels = cosine_levels(1000)
    assert (levels.diff() < 0).all() and levels[0] > 0.999 and levels[-1] < 1e-4
    expected = math.cos((0.5 + 0.008) / 1.008 * math.pi / 2) ** 2 / math.cos(0.008 / 1.008 * math.pi / 2) ** 2
    assert levels[499].item() == pytest.approx(expected, rel=1e-6)


def test_a_single_step_from_the_velocity_gives_the_mean() -> None:
    head = _Gaussian(mean=0.7, spread=0.5, target="velocity")
    samples = head.sample(torch.zeros(1000, 32), 1, generator=torch.Generator().manual_seed(0))
    assert (samples - 0.7).abs().max() < 1e-3


def test_the_velocity_is_the_turn_from_the_sample_to_the_noise() -> None:
    """With v = a*noise - s*sample, sample = a*noisy - s*v and noise = s*noisy + a*v (arXiv 2202.00512)."""
    head = DiffusionHead(small_config(kind="continuous", diffusion_target="velocity"), 4)
    told: list[tuple[Tensor, Tensor, Tensor]] = []

    def forward(noisy: Tensor, level: Tensor, condition: Tensor) -> Tensor:
        told.append((noisy, level, condition))
        return torch.zeros_like(noisy)

    head.forward = forward  # type: ignore[method-assign]
    target = torch.randn(300, 4, generator=torch.Generator().manual_seed(1))
    loss = head.loss(target, torch.zeros(300, 32), torch.Generator().manual_seed(0))
    ((noisy, level, _),) = told
    share = cosine_levels(1000)[level].unsqueeze(-1)
    noise = (noisy.double() - share.sqrt() * target) / (1 - share).sqrt()
    velocity = share.sqrt() * noise - (1 - share).sqrt() * target
    assert torch.allclose(loss.double(), velocity.square().mean(-1), rtol=1e-3, atol=1e-5)
    assert torch.allclose(share.sqrt() * noisy - (1 - share).sqrt() * velocity, target.double(), atol=1e-5)


def test_estimates_are_clipped_in_every_step() -> None:
    head = _Gaussian(mean=50.0, spread=0.1)
    samples = head.sample(torch.zeros(16, 32), 10, 0.0, torch.Generator().manual_seed(0))
    assert samples.abs().max() <= CLIP


def test_a_new_head_predicts_no_noise() -> None:
    head = DiffusionHead(small_config(kind="continuous"), 4)
    loss = head.loss(torch.randn(2000, 4), torch.randn(2000, 32), torch.Generator().manual_seed(0))
    assert loss.shape == (2000,) and abs(loss.mean().item() - 1) < 0.05


def test_variance_outputs_are_there_but_not_read() -> None:
    head = DiffusionHead(small_config(kind="continuous", diffusion_variance=True), 4)
    noise = head(torch.randn(3, 4), torch.tensor([0, 500, 999]), torch.randn(3, 32))
    assert head.output.out_features == 8 and noise.shape == (3, 4)
