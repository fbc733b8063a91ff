"""How unsure a model is of a frame: measured without changing it, in nats or in units of latents."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from hma_data.loading.dataset import Batch
from hma_model.generation.rollout import Rollout
from hma_model.network.head import randn
from hma_model.network.model import HMA
from tests.model.network_parts import ARM, small_config, small_model
from tests.model.true_world import tiny_model

ROBOT = "rails_03"


def measuring(model: HMA, robot: str, rows: int = 1, **options: Any) -> Rollout:
    rollout = Rollout(model, robot, rows, **options)
    rollout.decoding = replace(rollout.decoding, measure=True)
    return rollout


def latents(rows: int, model: HMA) -> Tensor:
    shape = (rows, 2, model.config.channels, *model.config.grid)
    return torch.randn(shape, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("options", [{}, {"order": "confidence", "unmask_steps": 3}])
def test_the_entropy_is_measured_and_changes_nothing(options: dict[str, Any]) -> None:
    model = tiny_model(ROBOT)
    prompt = torch.randint(0, 8**6, (2, 2, 8, 8), generator=torch.Generator().manual_seed(0))
    width = model.embodiments[ROBOT].chunk_dim
    frames, entropies = [], []
    for made in (Rollout, measuring):
        rollout = made(model, ROBOT, 2, **options)  # type: ignore[operator]
        rollout.prompt(prompt, torch.zeros(2, 1, width), seeds=[1, 2])
        frames.append(rollout.step(torch.ones(2, width)))
        entropies.append(rollout.uncertainty[:2])
    assert torch.equal(*frames)
    assert (entropies[0] == 0).all()
    assert (entropies[1] > 0).all() and (entropies[1] <= 6 * math.log(8) * model.config.merge**2 + 1e-3).all()


def test_a_model_that_knows_nothing_has_the_entropy_of_the_vocabulary() -> None:
    model = tiny_model(ROBOT)
    for weight in model.readout.parameters():
        torch.nn.init.zeros_(weight)
    rollout = measuring(model, ROBOT)
    rollout.prompt(torch.zeros(1, 1, 8, 8, dtype=torch.int64), None)
    rollout.step(torch.zeros(1, model.embodiments[ROBOT].chunk_dim))
    assert rollout.uncertainty.item() == pytest.approx(6 * math.log(8) * model.config.merge**2, rel=1e-4)


@pytest.mark.parametrize("options", [{}, {"temperature": 1.0, "unmask_steps": 3}])
def test_the_spread_of_latents_is_measured_and_changes_nothing(options: dict[str, Any]) -> None:
    model = small_model(kind="continuous")
    frames, spreads = [], []
    for made in (Rollout, measuring, measuring):
        rollout = made(model, "arm", 2, **options)  # type: ignore[operator]
        rollout.prompt(latents(2, model), torch.zeros(2, 1, ARM.chunk_dim), seeds=[1, 2])
        frames.append(torch.stack([rollout.step(torch.ones(2, ARM.chunk_dim)) for _ in range(3)]))
        spreads.append(rollout.uncertainty[:2])
    assert torch.equal(frames[0], frames[1]) and torch.equal(frames[0], frames[2])
    assert (spreads[0] == 0).all() and (spreads[1] > 0).all() and torch.equal(spreads[1], spreads[2])


def test_a_row_has_the_spread_that_it_has_alone() -> None:
    model, found = small_model(kind="continuous"), []
    prompt = latents(3, model)
    for rows in ([0, 1, 2], [1]):
        rollout = measuring(model, "arm", len(rows))
        rollout.prompt(prompt[rows], torch.zeros(len(rows), 1, ARM.chunk_dim), seeds=rows)
        rollout.step(torch.ones(len(rows), ARM.chunk_dim))
        found.append(rollout.uncertainty[rows.index(1)])
    torch.testing.assert_close(*found)


def test_the_spread_is_the_standard_deviation_of_the_draws_in_the_tokenizers_units(monkeypatch) -> None:
    model = small_model(kind="continuous", latent_scale=0.5, grid=(32, 32))

    def draw(conditions: Tensor, steps: Any, temperature: Any, generators: Any) -> Tensor:
        return 3 + 0.2 * randn((len(conditions), model.config.patch_dim), generators, conditions.device)

    monkeypatch.setattr(model.readout, "sample", draw)
    rollout = measuring(model, "arm")
    rollout.prompt(latents(1, model), torch.zeros(1, 1, ARM.chunk_dim), seeds=[0])
    made = rollout.step(torch.ones(1, ARM.chunk_dim))
    assert made.std().item() == pytest.approx(0.4, rel=0.05)
    assert rollout.uncertainty.item() == pytest.approx(0.4, rel=0.05)


@pytest.mark.slow
def test_a_trained_model_is_less_sure_of_what_nobody_can_know() -> None:
    """A command of 1 leads to a frame that is always the same, one of -1 to one of ±1 everywhere."""
    torch.manual_seed(0)
    config = small_config(
        kind="continuous", grid=(4, 4), channels=1, latent_scale=1.0, frames=2, corrupt_max=0.0,
        history_probability=0.0, training_pass="pairs", whole_share=1.0,
    )  # fmt: skip
    model = HMA(config)
    model.add_embodiment(replace(ARM, mean=(0.0,) * 3, std=(1.0,) * 3))
    optimizer, steps = torch.optim.AdamW(model.parameters(), 5e-3), 400
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = 5e-3 * (1 - step / steps)
        command = torch.randint(0, 2, (16,)) * 2.0 - 1
        sign = torch.randint(0, 2, (16,)) * 2.0 - 1
        after = torch.where(command > 0, 0.5, sign)
        film = torch.stack([torch.zeros(16), after], dim=1)[:, :, None, None, None].expand(-1, -1, 1, 4, 4)
        chunks = command[:, None, None].expand(-1, 2, ARM.chunk_dim).contiguous()
        known = torch.ones(16, 2, dtype=torch.bool)
        loss = model(Batch(["arm"] * 16, chunks, known, latents=film.contiguous()), "forward").loss
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    rollout = measuring(model.eval(), "arm", 16, unmask_steps=1)
    rollout.prompt(torch.zeros(16, 1, 1, 4, 4), None, seeds=range(16))
    command = torch.tensor([1.0, -1.0]).repeat(8)
    made = rollout.step(command[:, None].expand(-1, ARM.chunk_dim))
    sure, unsure = rollout.uncertainty[0::2], rollout.uncertainty[1::2]
    assert (made[0::2].mean((1, 2, 3)) - 0.5).abs().max() < 0.1
    assert sure.max() < 0.2 and unsure.min() > 0.5
