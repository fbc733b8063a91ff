"""A readout that keeps tokens of the frame before, and predicts the digits of a token in turn."""

import math

import pytest
import torch

from hma_data.loading.rows import Batch
from hma_model.evaluation.metrics import teacher_forced
from hma_model.network.copying import frames_before, known_digits
from hma_model.network.head import DiffusionHead
from hma_model.network.stem import from_digits, patchify, split_tokens
from hma_model.training.scheduled_sampling import forwarded
from tests.model.network_parts import seeded, small_batch, small_config, small_model

NAMES = ["arm", "hand.v1", "arm"]
CHAIN = {"digit_order": "chain"}
CHANGES = [
    {},
    CHAIN,
    {"digit_order": "chain", "factored": (4, 4), "merge": 2},
    {"factored": (5, 3, 2)},
    {"digit_order": "chain", "training_pass": "pairs", "masked_input": "previous"},
]


def _model(**changes):
    model = small_model(copy_previous=True, **changes)
    gain = model.token_readout.copy
    with torch.no_grad():
        gain.linear.weight.copy_(torch.randn(gain.linear.weight.shape, generator=seeded(7)))
        gain.linear.bias.copy_(torch.randn(gain.linear.bias.shape, generator=seeded(8)))
    return model


def _batch(config):
    made = small_batch(config, NAMES)
    return Batch(NAMES, made.actions, made.action_mask, tokens=made.tokens)


def _near(digits, config, share=0.7):
    other = torch.stack(
        [torch.randint(0, v, (len(digits),), generator=seeded(v + 9)) for v in config.digits], 1
    )
    before = torch.where(torch.rand(digits.shape, generator=seeded(3)) < share, digits, other)
    before[::4] = -1
    return before


@pytest.mark.parametrize("changes", CHANGES[:4], ids=str)
def test_the_loss_is_that_of_gains_written_out(changes):
    model = _model(label_smoothing=0.0, **changes)
    readout, config = model.token_readout, model.config
    rows, count = 16, len(config.digits)
    features = torch.randn(rows, config.width, generator=seeded())
    digits = torch.stack([torch.randint(0, v, (rows,), generator=seeded(v)) for v in config.digits], dim=1)
    before, chained = _near(digits, config), config.digit_order == "chain"
    alone = [part.double() for part in readout(features, digits).split(list(config.digits), dim=-1)]
    gains = readout.copy.linear(features * readout.copy.multiplier).double().view(rows, count, 3)
    per_token = count // config.merge**2
    for row in range(rows):
        expected = 0.0
        for place in range(count):
            differs = [int(digits[row, i] != before[row, i]) for i in range(place)]
            own = differs[place // per_token * per_token :]
            state = (2 if any(own) else int(any(differs))) if chained else 0
            scores = alone[place][row].clone()
            if before[row, place] >= 0:
                scores[before[row, place]] += gains[row, place, state]
            expected -= float(scores.log_softmax(-1)[digits[row, place]].detach())
        found = float(readout.loss(features, digits, before)[row].detach())
        assert math.isclose(found, expected, abs_tol=1e-4)


@pytest.mark.parametrize("changes", CHANGES[:4], ids=str)
def test_digits_are_chosen_from_the_scores_of_the_loss(changes):
    model = _model(**changes)
    readout, config = model.token_readout, model.config
    features = torch.randn(9, config.width, generator=seeded())
    digits = torch.stack([torch.randint(0, v, (9,), generator=seeded(v)) for v in config.digits], dim=1)
    before, seen = _near(digits, config), []

    def true_digit(scores, first):
        seen.append(scores[0])
        return digits.T[first : first + scores.shape[1]].unsqueeze(0)

    readout.decide(features.unsqueeze(0), true_digit, before.unsqueeze(0))
    scores = readout.split(readout(features, digits, before)).transpose(0, 1)
    for place, made in enumerate(part for group in seen for part in group):
        assert torch.allclose(made, scores[place][:, : made.shape[-1]], atol=1e-5)


def test_a_masked_place_and_a_frame_without_one_before_gain_nothing():
    config = small_config(factored=(4, 4), copy_previous=True)
    frames = torch.tensor([[[0, 5, 16], [7, 16, 16]]])
    digits = frames_before(frames, [-1, 0, 1], config)
    assert torch.equal(digits[0, 0], torch.full((3, 2), -1))
    assert torch.equal(digits[0, 1:], known_digits(frames, config)[0])
    assert digits[0, 1].tolist() == [[0, 0], [1, 1], [-1, -1]]
    readout = _model(factored=(4, 4)).token_readout
    features = torch.randn(6, 32, generator=seeded())
    nothing = torch.full((6, 2), -1)
    assert torch.equal(readout(features, None, nothing), readout(features))


@pytest.mark.parametrize(
    ("changes", "more"),
    [({}, {"copy_previous": True}), (CHAIN, {"copy_previous": True}), ({}, CHAIN)],
    ids=str,
)
def test_an_untrained_gain_or_chain_changes_nothing(changes, more):
    torch.manual_seed(0)
    without, model = small_model(**changes), small_model(**changes, **more)
    model.load_state_dict({**model.state_dict(), **without.state_dict()})
    readout = model.token_readout
    with torch.no_grad():
        for parameter in readout.copy.parameters() if "copy_previous" in more else readout.chain.output:
            parameter.zero_()
    batch = _batch(without.config)
    assert torch.allclose(without(batch, None, seeded()).loss, model(batch, None, seeded()).loss)
    assert torch.allclose(teacher_forced(without, batch)[0], teacher_forced(model, batch)[0], atol=1e-5)


@pytest.mark.parametrize("changes", CHANGES, ids=str)
@pytest.mark.parametrize("copies", [True, False])
def test_a_frame_in_one_pass_is_the_likeliest_that_the_logits_say(changes, copies):
    model = _model(**changes) if copies else small_model(**changes)
    config, batch = model.config, small_batch(model.config, NAMES)
    how = {"unmask_steps": 1, "temperature": 0}
    made = model.generate(batch.tokens[:, :3], batch.actions, NAMES, frames=1, **how)[:, 0]
    window = batch.tokens[:, :4].clone()
    window[:, 3] = config.vocab_size
    digits = model.video_logits(window, batch.actions, NAMES)[:, 3].argmax(-1)
    tokens = from_digits(digits, config.digits).flatten(1)
    assert torch.equal(made, split_tokens(tokens, config.merge, config.vocab_size, config.token_grid))


def test_training_copies_the_past_that_it_shows():
    """A past whose digits are all replaced is copied as it is shown, not as it was."""
    model = small_model(copy_previous=True, training_pass="pairs", corrupt_max=0.2, label_smoothing=0.0)
    with torch.no_grad():
        model.token_readout.copy.linear.bias.fill_(30.0)  # whatever is before is copied
    batch = _batch(model.config)
    still = Batch(NAMES, batch.actions, batch.action_mask, tokens=batch.tokens[:, :1].expand_as(batch.tokens))
    corrupted = model(still, "forward", seeded()).loss
    model.config = model.config.replace(corrupt_max=0.0)
    assert model(still, "forward", seeded()).loss < 1e-3 < corrupted


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


# -- latents


LATENT_CHANGES = [{}, {"training_pass": "pairs", "masked_input": "previous"}]


def _latent_model(share: int | None = None, **changes):
    model = small_model(kind="continuous", copy_previous=True, **changes)
    linear = model.latent_readout.copy.linear
    with torch.no_grad():
        if share is not None:
            linear.weight.zero_()
            linear.bias.fill_(100.0 if share else -200.0)
    return model


def _latent_batch(config, still=False):
    made = small_batch(config, NAMES)
    latents = made.latents[:, :1].expand_as(made.latents) if still else made.latents
    return Batch(NAMES, made.actions, made.action_mask, latents=latents)


@pytest.fixture
def nothing_more(monkeypatch):
    """A diffusion head that draws nothing, so that a frame is what is kept."""

    def sample(self, condition, steps=None, temperature=0.0, generator=None):
        return torch.zeros(len(condition), self.values)

    monkeypatch.setattr(DiffusionHead, "sample", sample)


def test_the_head_learns_and_draws_the_difference_to_what_is_kept():
    readout = _latent_model().latent_readout
    width, values = readout.proj.out_features, readout.diffusion.values
    features, before = torch.randn(1, 1, 16, width), torch.randn(1, 1, 16, values)
    conditions = readout(features, torch.tensor([0]), before)
    shares = readout.copy.linear(features * readout.copy.multiplier).sigmoid()
    kept = (shares * before).view(16, values)
    own, patches = conditions[..., :width].view(16, width), torch.randn(16, values)
    loss = readout.loss(patches, conditions.view(16, -1), seeded())
    assert torch.allclose(loss, readout.diffusion.loss(patches - kept, own, seeded()))
    drawn = readout.sample(conditions.view(16, -1), 4, generator=seeded())
    assert torch.allclose(drawn, readout.diffusion.sample(own, 4, generator=seeded()) + kept)
    assert torch.equal(readout(features, torch.tensor([0]))[..., width:], torch.zeros(1, 1, 16, values))


@pytest.mark.parametrize("changes", LATENT_CHANGES, ids=str)
def test_shares_of_nothing_change_nothing(changes):
    without, model = small_model(kind="continuous", **changes), _latent_model(0, **changes)
    model.load_state_dict({**model.state_dict(), **without.state_dict()})
    batch = _latent_batch(without.config)
    assert torch.equal(without(batch, None, seeded()).loss, model(batch, None, seeded()).loss)
    made = [
        one.eval().generate(batch.latents[:, :2], batch.actions, NAMES, frames=2, generator=seeded())
        for one in (without, model)
    ]
    assert torch.equal(*made)


@pytest.mark.parametrize("cache", [True, False])
@pytest.mark.parametrize("changes", LATENT_CHANGES, ids=str)
def test_what_is_kept_whole_stays_as_it_is(nothing_more, changes, cache):
    model = _latent_model(1, **changes).eval()
    batch = _latent_batch(model.config)
    made = model.generate(batch.latents[:, :2], batch.actions, NAMES, frames=2, cache=cache)
    assert torch.allclose(made, batch.latents[:, 1:2].expand_as(made), atol=1e-6)


def test_a_predicted_past_keeps_the_frame_before(nothing_more):
    model = _latent_model(1)
    batch = _latent_batch(model.config)
    seen = forwarded(model, batch, 1.0, 1, seeded()).context
    for row in range(len(NAMES)):
        (at,) = (seen[row] != batch.latents[row]).flatten(1).any(1).nonzero().flatten().tolist()
        assert torch.allclose(seen[row, at], batch.latents[row, at - 1], atol=1e-6)


@pytest.fixture
def targets(monkeypatch):
    seen, loss = [], DiffusionHead.loss

    def spy(self, target, condition, generator=None):
        seen.append(target.detach())
        return loss(self, target, condition, generator)

    monkeypatch.setattr(DiffusionHead, "loss", spy)
    return seen


def test_a_still_window_leaves_nothing_to_draw_but_the_noise_of_its_past(targets):
    for noise in (0.0, 1.0):
        model = _latent_model(1, training_pass="pairs", latent_noise=noise)
        model(_latent_batch(model.config, still=True), "forward", seeded())
    quiet, noisy = (target.abs().max() for target in targets)
    assert quiet < 1e-6 and noisy > 0.01


def test_nothing_is_kept_of_what_is_masked(targets):
    model = _latent_model(1, corrupt_max=0.0)
    batch = _latent_batch(model.config)
    batch = Batch(["arm"] * 3, batch.actions, batch.action_mask, latents=batch.latents)  # one order of rows
    masked = model(batch, "forward", seeded()).masked.flatten(2)
    patches = patchify(batch.latents * model.config.latent_scale, model.config.patch)
    before = torch.cat([torch.zeros_like(patches[:, :1]), patches[:, :-1]], dim=1)
    hidden = torch.cat([torch.ones_like(masked[:, :1]), masked[:, :-1]], dim=1)
    expected = patches - before.masked_fill(hidden.unsqueeze(-1), 0)
    assert torch.allclose(targets[0], expected[masked], atol=1e-6)
