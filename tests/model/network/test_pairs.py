"""Training on pairs: the true frames, and masked copies that see the true frames before them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from hma_data.loading.rows import Batch
from hma_model.evaluation.metrics import teacher_forced
from hma_model.network.masking import draw_pairs_mask
from hma_model.network.model import HMA
from hma_model.network.objectives import Layout
from hma_model.network.stem import merge_tokens, split_tokens, to_digits
from hma_model.network.trunks.transformer import sinusoids
from tests.model.network_parts import seeded, small_batch, small_config, small_model

WHOLE = {
    "training_pass": "pairs", "whole_share": 1.0, "corrupt_max": 0.0, "history_probability": 0.0,
    "label_smoothing": 0.0,
}  # fmt: skip
NAMES = ["arm", "hand.v1", "arm"]


def _batch(model: HMA) -> Batch:
    made = small_batch(model.config, NAMES)
    return Batch(NAMES, made.actions, made.action_mask, tokens=made.tokens, latents=made.latents)


@pytest.mark.parametrize(
    "changes", [{}, {"masked_input": "previous"}, {"merge": 2}, {"digit_order": "chain"}], ids=str
)
@pytest.mark.parametrize("objective", ["forward", "full"])
def test_whole_copies_have_the_loss_of_each_frame_after_its_true_past(changes, objective):
    model = small_model(**changes, **WHOLE)
    batch = _batch(model)
    if objective == "full":  # hides chunks, so the frames are compared without any
        batch = replace(batch, action_mask=torch.zeros_like(batch.action_mask))
        batch.action_mask[:, 0] = True
    output = model(batch, objective, seeded())
    nats, _ = teacher_forced(model, batch)
    if objective == "forward":
        assert torch.allclose(output.per_sample, nats.mean(dim=1), atol=1e-5)
    shape = (*batch.tokens.shape[:2], *model.config.token_grid)
    assert output.masked.shape == shape
    assert output.masked[:, 1:].all() and not output.masked[:, 0].any()
    assert output.video_logits is not None and output.video_logits.shape[:4] == shape


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
@pytest.mark.parametrize("objective", ["forward", "passive", "policy", "inverse", "full"])
def test_every_objective_trains_on_pairs(kind, objective):
    model = small_model(kind=kind, training_pass="pairs", masked_input="previous").train()
    output = model(_batch(model), objective, seeded())
    output.loss.backward()
    gradients = [p.grad for p in model.trunk.parameters() if p.grad is not None]
    assert output.loss.isfinite() and all(g.isfinite().all() for g in gradients)
    assert sum(g.abs().sum() for g in gradients) > 0


def test_a_copy_sees_neither_other_copies_nor_later_frames():
    model = small_model(masked_input="previous", **WHOLE)
    batch = _batch(model)
    before = model(batch, "forward", seeded()).video_logits
    changed = replace(batch, tokens=batch.tokens.clone())
    changed.tokens[:, 3:] = (changed.tokens[:, 3:] + 5) % model.config.vocab_size
    after = model(changed, "forward", seeded()).video_logits
    assert torch.equal(before[:, :4], after[:, :4]) and not torch.equal(before[:, 4], after[:, 4])


@pytest.mark.parametrize("changes", [WHOLE, {"history_probability": 0.0}], ids=["pairs", "window"])
def test_padding_has_no_loss(changes):
    model = small_model(**changes)
    batch = _batch(model)
    inside = torch.ones(3, model.config.frames, dtype=torch.bool)
    inside[1, 3:] = False
    batch.frame_mask = inside
    output = model(batch, "forward", seeded())
    assert not output.masked[1, 3:].any() and output.masked[1, 1:3].any()


def test_half_of_the_copies_are_wholly_masked_and_the_past_never():
    config = small_config(training_pass="pairs", whole_share=0.5, grid=(8, 8))
    mask = draw_pairs_mask(config, 400, 6, 5, seeded())
    assert mask.masked.shape == (400, 10, 64) and not mask.masked[:, :5].any()
    assert abs(mask.masked[:, 5:].all(2).float().mean().item() - 0.5) < 0.06
    assert (mask.corruption[:, 5:] == 0).all() and (mask.corruption[:, :5] > 0).all()


def test_noise_in_the_past_of_latents_has_the_spread_of_its_corruption(monkeypatch):
    model, seen = small_model(kind="continuous", training_pass="pairs", latent_noise=2.0), []
    original = model.embed
    monkeypatch.setattr(model, "embed", lambda *given: seen.append(given[0]) or original(*given))
    batch = _batch(model)
    model(batch, "forward", seeded())
    rate = draw_pairs_mask(model.config, 3, 5, 4, seeded()).corruption[:, :4]
    true = model.frame_values(batch.latents)[[0, 2, 1]][:, :4]  # sorted by embodiment
    noise = (seen[0][:, :4] - true).flatten(2)
    assert (noise.std(dim=2) / (2 * rate[[0, 2, 1]]) - 1).abs().max() < 0.25


@pytest.mark.parametrize(("objective", "past"), [("forward", 4), ("full", 5), ("policy", 5)])
def test_only_an_objective_that_reads_it_has_the_last_true_frame(objective, past):
    from hma_model.config import OBJECTIVES

    model = small_model(training_pass="pairs")
    layout = Layout.of(model, 5, OBJECTIVES[objective])
    assert layout.past == past
    assert layout.frames == [*range(past), *((1, 2, 3, 4) if objective != "policy" else ())]


@pytest.mark.parametrize("objective", ["policy", "inverse"])
def test_frames_that_actions_are_read_from_are_not_corrupted_like_a_rollout(objective, monkeypatch):
    from hma_model.network import objectives

    model, rates = small_model(corrupt_max=0.1, history_probability=1.0), []
    original = objectives.corrupt_tokens
    monkeypatch.setattr(
        objectives, "corrupt_tokens", lambda *given: rates.append(given[2].corruption) or original(*given)
    )
    model(_batch(model), objective, seeded())
    assert rates[0].max() <= 0.1 and np.ptp(rates[0].numpy(), axis=1).max() == 0


def test_sinusoids_tell_neighbours_from_others():
    places = sinusoids((8, 8), 64)
    assert places.shape == (64, 64) and abs(places.std().item() - 0.5) < 0.1
    distance = torch.cdist(places, places).fill_diagonal_(torch.inf)
    nearest = distance.argmin(1)
    rows, columns = torch.arange(64) // 8, torch.arange(64) % 8
    assert ((rows - nearest // 8).abs() + (columns - nearest % 8).abs() == 1).all()


def test_squares_of_tokens_become_one_and_come_apart_again():
    tokens = torch.randint(0, 32768, (2, 3, 6, 4), generator=seeded())
    merged = merge_tokens(tokens, 2, 32768)
    assert merged.shape == (2, 3, 6) and merged.max() < 32768**4
    assert torch.equal(split_tokens(merged, 2, 32768, (3, 2)), tokens)
    digits = to_digits(merged[0, 0, 3], (32768,) * 4)  # second row of squares, second column
    assert torch.equal(digits, tokens[0, 0, 2:4, 2:4].flatten())
    tokens[1, 2, 5, 0] = 32768
    masked = merge_tokens(tokens, 2, 32768) == 32768**4
    assert masked.nonzero().tolist() == [[1, 2, 4]]


@pytest.mark.parametrize("factored", [(6, 4), (4, 4, 4), (5, 3, 2)])
def test_the_embedding_and_the_loss_are_sums_over_the_digits(factored):
    model = small_model(factored=factored, label_smoothing=0.1)
    config, embed, readout = model.config, model.trunk.embed, model.token_readout
    tokens = torch.randint(0, config.vocab_size, (2, 3, 16), generator=seeded())
    digits = to_digits(tokens, factored)
    rows = [weight[digits[..., i]].double() for i, weight in enumerate(embed.digits)]
    assert torch.allclose(model.embed(tokens).double(), sum(rows), atol=1e-5)

    features = torch.randn(7, config.width, generator=seeded())
    goal = torch.stack([torch.randint(0, v, (7,), generator=seeded(v)) for v in factored], dim=1)
    scores = (features.double() @ readout.linear.weight.double().T + readout.linear.bias.double()).split(
        factored, 1
    )
    logs = [part.log_softmax(1) for part in scores]
    expected = sum(
        -0.9 * log.gather(1, goal[:, i : i + 1]).squeeze(1) - 0.1 * log.mean(1) for i, log in enumerate(logs)
    )
    if readout.multiplier == 1:
        assert torch.allclose(readout.loss(features, goal).double(), expected, atol=1e-4)
