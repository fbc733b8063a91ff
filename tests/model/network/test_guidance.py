"""Commands that are hidden in training, and guidance by what they change."""

from dataclasses import replace

import pytest
import torch

from hma_data.loading.rows import Batch
from tests.model.network_parts import small_batch, small_model

NAMES = ["arm", "hand.v1", "arm"]


def _seed(value: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(value)


def _batch(model) -> Batch:
    made = small_batch(model.config, NAMES)
    return Batch(NAMES, made.actions, made.action_mask, tokens=made.tokens, latents=made.latents)


@pytest.mark.parametrize("objective", ["forward", "policy"])
def test_dropped_commands_are_unknown_in_training_only(objective):
    dropping, plain = small_model(drop_commands=1.0, corrupt_max=0.0), small_model(corrupt_max=0.0)
    batch = _batch(plain)
    hidden = replace(batch, action_mask=torch.zeros_like(batch.action_mask))
    for training in (True, False):
        loss = dropping.train(training)(batch, objective, _seed()).loss
        same = hidden if training and objective == "forward" else batch
        assert torch.equal(loss, plain.train(training)(same, objective, _seed()).loss)


def test_a_share_of_the_windows_drops_all_commands(monkeypatch):
    from hma_model.network import objectives

    model, seen = small_model(drop_commands=0.3).train(), []
    original = objectives.condition
    monkeypatch.setattr(
        objectives, "condition", lambda *given: seen.append(given[1].known[:, 1:]) or original(*given)
    )
    for seed in range(100):
        model(_batch(model), "forward", _seed(seed))
    known = torch.cat(seen)
    assert (known.all(1) | ~known.any(1)).all() and abs(known.all(1).float().mean() - 0.7) < 0.08
