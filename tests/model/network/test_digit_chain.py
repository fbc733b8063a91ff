"""Digits of a token that are predicted one after the other."""

import math

import pytest
import torch
import torch.nn.functional as F

from hma_data.loading.rows import Batch
from hma_model.evaluation.metrics import teacher_forced
from hma_model.generation.unmask import Decoding, TokenFrame
from hma_model.network.head import TokenReadout
from hma_model.network.stem import from_digits, split_tokens, to_digits
from tests.model.network_parts import seeded, small_batch, small_config, small_model

NAMES = ["arm", "hand.v1", "arm"]


def _batch(config):
    made = small_batch(config, NAMES)
    return Batch(NAMES, made.actions, made.action_mask, tokens=made.tokens)


@pytest.mark.parametrize("changes", [{}, {"factored": (5, 3, 2)}, {"factored": (4, 4), "merge": 2}], ids=str)
def test_the_loss_is_the_sum_over_digits_given_those_before(changes):
    model = small_model(digit_order="chain", **changes)
    readout, config = model.token_readout, model.config
    features = torch.randn(9, config.width, generator=seeded())
    digits = torch.stack([torch.randint(0, v, (9,), generator=seeded(v)) for v in config.digits], dim=1)
    expected = torch.zeros(9)

    def true_digit(scores, index):
        nonlocal expected
        own = digits[:, index]
        smoothing = config.label_smoothing
        expected += F.cross_entropy(scores[0, 0], own, reduction="none", label_smoothing=smoothing)
        return own.view(1, 1, -1)

    readout.decide(features.unsqueeze(0), true_digit)
    assert torch.allclose(readout.loss(features, digits), expected, atol=1e-4)


def test_a_digit_sees_those_before_it_and_no_other():
    readout = small_model(digit_order="chain", factored=(6, 6, 6)).token_readout
    features = torch.randn(1, 32, generator=seeded())
    digits = torch.tensor([[1, 2, 3]])
    before = readout.split(readout(features, digits))[0]
    for place in range(3):
        changed = digits.clone()
        changed[0, place] = 5
        after = readout.split(readout(features, changed))[0]
        assert [torch.equal(a, b) for a, b in zip(before, after)] == [i <= place for i in range(3)]


def test_it_learns_digits_that_agree_and_samples_them():
    torch.manual_seed(0)
    both = torch.randint(0, 4, (256,)).unsqueeze(1).expand(-1, 2)
    features, losses = torch.zeros(256, 32), {}
    for order in ("together", "chain"):
        readout = TokenReadout(small_config(factored=(4, 4), digit_order=order, label_smoothing=0.0))
        optimizer = torch.optim.Adam(readout.parameters(), lr=0.05)
        for _ in range(60):
            optimizer.zero_grad()
            loss = readout.loss(features, both).mean()
            loss.backward()
            optimizer.step()
        losses[order] = loss.item()
    assert abs(losses["together"] - 2 * math.log(4)) < 0.05 and abs(losses["chain"] - math.log(4)) < 0.05
    decoding, seeds = Decoding(temperature=1.0), [seeded()]
    frame = TokenFrame(torch.full((1, 256), 16), 16, decoding, seeds)
    frame.unmask(readout, features.unsqueeze(0), torch.zeros(1, 1), 256)
    drawn = to_digits(frame.values[0], (4, 4)).T
    assert (drawn[0] == drawn[1]).float().mean() > 0.95 and len(drawn[0].unique()) == 4


@pytest.mark.parametrize("changes", [{}, {"masked_input": "previous", "merge": 2}], ids=str)
def test_a_frame_in_one_pass_is_the_likeliest_digit_after_digit(changes):
    model = small_model(digit_order="chain", **changes)
    config, batch = model.config, small_batch(model.config, NAMES)
    how = {"unmask_steps": 1, "temperature": 0}
    made = model.generate(batch.tokens[:, :3], batch.actions, NAMES, frames=1, **how)[:, 0]
    window = batch.tokens[:, :4].clone()
    window[:, 3] = config.vocab_size
    digits = model.video_logits(window, batch.actions, NAMES)[:, 3].argmax(-1)
    tokens = from_digits(digits, config.digits).flatten(1)
    assert torch.equal(made, split_tokens(tokens, config.merge, config.vocab_size, config.token_grid))


def test_an_untrained_chain_changes_nothing():
    torch.manual_seed(0)
    together = small_model()
    chained = small_model(digit_order="chain")
    kept = together.state_dict()
    chained.load_state_dict({**chained.state_dict(), **kept})
    with torch.no_grad():
        for weight in chained.token_readout.chain.output:
            weight.zero_()
    batch = _batch(together.config)
    assert torch.equal(together(batch, None, seeded()).loss, chained(batch, None, seeded()).loss)
    assert torch.equal(teacher_forced(together, batch)[0], teacher_forced(chained, batch)[0])
