"""Commands that are hidden in training, and guidance by what they change."""

from dataclasses import replace

import pytest
import torch

from hma_data.loading.rows import Batch
from hma_model.generation.rollout import Rollout
from hma_model.network.stem import from_digits
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


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
@pytest.mark.parametrize("changes", [{}, {"masked_input": "previous"}, {"time_position": "learned"}], ids=str)
def test_guidance_of_nothing_is_the_rollout_without_actions(kind, changes):
    model = small_model(kind=kind, frames=4, **changes)
    batch = small_batch(model.config, NAMES, frames=7)
    prompt = (batch.tokens if kind == "discrete" else batch.latents)[:, :2]
    none = torch.zeros(3, 7, dtype=torch.bool)

    def made(**how):
        return model.generate(prompt, batch.actions, NAMES, 5, temperature=0.7, generator=_seed(), **how)

    assert torch.allclose(made(guidance=0.0).float(), made(known=none).float(), atol=1e-4)
    almost = made(guidance=1 + 1e-7).float()  # has twins, but they change nothing
    assert torch.allclose(almost, made().float(), atol=1e-4)
    assert not torch.equal(made(guidance=3.0), made())


@pytest.mark.parametrize("order", ["together", "chain"])
def test_the_scores_go_beyond_those_with_commands(order):
    model = small_model(digit_order=order)
    batch = small_batch(model.config, NAMES)
    window = batch.tokens[:, :3].clone()
    window[:, 2] = model.config.vocab_size
    how = {"unmask_steps": 1, "temperature": 0, "guidance": 2.5}
    made = model.generate(batch.tokens[:, :2], batch.actions, NAMES, 1, **how)[:, 0]
    none = torch.zeros(3, 3, dtype=torch.bool)
    with_commands, without = (
        model.video_logits(window, batch.actions[:, :3], NAMES, known, _last(window, made))[:, 2]
        for known in (None, none)
    )
    guided = without + 2.5 * (with_commands - without)
    tokens = from_digits(guided.argmax(-1), model.config.digits)
    assert torch.equal(made, tokens)


def _last(window, frame):
    return torch.cat([window[:, :-1], frame.unsqueeze(1)], dim=1)


def test_guided_rows_fork_reset_and_come_back_as_without_neighbours():
    model = small_model()
    batch = small_batch(model.config, NAMES)
    tokens, chunks = batch.tokens, batch.actions

    def begun(rows):
        rollout = Rollout(model, [NAMES[row] for row in rows], len(rows), guidance=2.0, temperature=1.0)
        rollout.prompt(tokens[rows, :2], chunks[rows], seeds=rows)
        return rollout

    alone = [begun([row]) for row in range(3)]
    expected = [torch.stack([one.step(chunks[[row], t]) for t in (1, 2)]) for row, one in enumerate(alone)]
    rollout = begun([0, 1, 2])
    rollout.step(chunks[[2], 1], rows=[2])
    kept = rollout.snapshot([2])
    rollout.reset([0], tokens[[0], :2], chunks[[0]], seeds=[0])
    rollout.step(chunks[:2, 1], rows=[0, 1])
    forked = rollout.fork(2)
    rollout.step(chunks[[2], 2], rows=[2])
    rollout.restore([2], kept)
    last = rollout.step(chunks[:, 2])
    assert all(torch.equal(last[row], expected[row][1, 0]) for row in range(3))
    assert torch.equal(forked.step(chunks[:, 2].repeat_interleave(2, 0)), last.repeat_interleave(2, 0))
