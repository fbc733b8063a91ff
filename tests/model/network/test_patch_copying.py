"""A latent readout that can keep of the frame before what stays."""

import pytest
import torch

from hma_data.loading.rows import Batch
from hma_model.network.head import DiffusionHead
from hma_model.network.stem import patchify
from hma_model.training.scheduled_sampling import forwarded
from tests.model.network_parts import seeded, small_batch, small_model

NAMES = ["arm", "hand.v1", "arm"]
CHANGES = [{}, {"training_pass": "pairs", "masked_input": "previous"}]


def _model(share: int | None = None, **changes):
    model = small_model(kind="continuous", copy_previous=True, **changes)
    linear = model.latent_readout.copy.linear
    with torch.no_grad():
        if share is not None:
            linear.weight.zero_()
            linear.bias.fill_(100.0 if share else -200.0)
    return model


def _batch(config, still=False):
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
    readout = _model().latent_readout
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


@pytest.mark.parametrize("changes", CHANGES, ids=str)
def test_shares_of_nothing_change_nothing(changes):
    without, model = small_model(kind="continuous", **changes), _model(0, **changes)
    model.load_state_dict({**model.state_dict(), **without.state_dict()})
    batch = _batch(without.config)
    assert torch.equal(without(batch, None, seeded()).loss, model(batch, None, seeded()).loss)
    made = [
        one.eval().generate(batch.latents[:, :2], batch.actions, NAMES, frames=2, generator=seeded())
        for one in (without, model)
    ]
    assert torch.equal(*made)


@pytest.mark.parametrize("cache", [True, False])
@pytest.mark.parametrize("changes", CHANGES, ids=str)
def test_what_is_kept_whole_stays_as_it_is(nothing_more, changes, cache):
    model = _model(1, **changes).eval()
    batch = _batch(model.config)
    made = model.generate(batch.latents[:, :2], batch.actions, NAMES, frames=2, cache=cache)
    assert torch.allclose(made, batch.latents[:, 1:2].expand_as(made), atol=1e-6)


def test_a_predicted_past_keeps_the_frame_before(nothing_more):
    model = _model(1)
    batch = _batch(model.config)
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
        model = _model(1, training_pass="pairs", latent_noise=noise)
        model(_batch(model.config, still=True), "forward", seeded())
    quiet, noisy = (target.abs().max() for target in targets)
    assert quiet < 1e-6 and noisy > 0.01


def test_nothing_is_kept_of_what_is_masked(targets):
    model = _model(1, corrupt_max=0.0)
    batch = _batch(model.config)
    batch = Batch(["arm"] * 3, batch.actions, batch.action_mask, latents=batch.latents)  # one order of rows
    masked = model(batch, "forward", seeded()).masked.flatten(2)
    patches = patchify(batch.latents * model.config.latent_scale, model.config.patch)
    before = torch.cat([torch.zeros_like(patches[:, :1]), patches[:, :-1]], dim=1)
    hidden = torch.cat([torch.ones_like(masked[:, :1]), masked[:, :-1]], dim=1)
    expected = patches - before.masked_fill(hidden.unsqueeze(-1), 0)
    assert torch.allclose(targets[0], expected[masked], atol=1e-6)
