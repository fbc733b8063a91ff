"""How unsure a model is of a frame: measured without changing it, and log V where it knows nothing."""

import math

import pytest
import torch

from hma_model.generation.rollout import Rollout
from tests.model.simulate.worlds import tiny_model

ROBOT = "rails_03"


@pytest.mark.parametrize("options", [{}, {"order": "confidence", "unmask_steps": 3}, {"guidance": 2.0}])
def test_the_entropy_is_measured_and_changes_nothing(options: dict[str, object]) -> None:
    from dataclasses import replace

    model = tiny_model(ROBOT)
    prompt = torch.randint(0, 8**6, (2, 2, 8, 8), generator=torch.Generator().manual_seed(0))
    width = model.embodiments[ROBOT].chunk_dim
    frames, entropies = [], []
    for measure in (False, True):
        rollout = Rollout(model, ROBOT, 2, **options)  # type: ignore[arg-type]
        rollout.decoding = replace(rollout.decoding, measure=measure)
        rollout.prompt(prompt, torch.zeros(2, 1, width), seeds=[1, 2])
        frames.append(rollout.step(torch.ones(2, width)))
        entropies.append(rollout.entropy[:2])
    assert torch.equal(*frames)
    assert (entropies[0] == 0).all()
    assert (entropies[1] > 0).all() and (entropies[1] <= 6 * math.log(8) * model.config.merge**2 + 1e-3).all()


def test_a_model_that_knows_nothing_has_the_entropy_of_the_vocabulary() -> None:
    from dataclasses import replace

    model = tiny_model(ROBOT)
    for weight in model.readout.parameters():
        torch.nn.init.zeros_(weight)
    rollout = Rollout(model, ROBOT, 1)
    rollout.decoding = replace(rollout.decoding, measure=True)
    rollout.prompt(torch.zeros(1, 1, 8, 8, dtype=torch.int64), None)
    rollout.step(torch.zeros(1, model.embodiments[ROBOT].chunk_dim))
    assert rollout.entropy.item() == pytest.approx(6 * math.log(8) * model.config.merge**2, rel=1e-4)
