"""The noise of the past that the model is told."""

import pytest
import torch

from hma_model.network.stem import NoiseEmbedding
from tests.model.network_parts import seeded, small_batch, small_model

NAMES = ["arm", "hand.v1", "arm", "arm"]


def _embedded_level(model, batch, monkeypatch, objective="forward"):
    """Return the corruption (B, T) that a pass tells the model, and the ids (B, T, S) that it embeds."""
    told, tokens = [], []
    noise, embed = NoiseEmbedding.forward, model.embed
    monkeypatch.setattr(NoiseEmbedding, "forward", lambda self, x: told.append(x) or noise(self, x))
    monkeypatch.setattr(model, "embed", lambda *given: tokens.append(given[0]) or embed(*given))
    model(batch, objective, seeded())
    return told[0], tokens[0]


@pytest.mark.parametrize("training_pass", ["window", "pairs"])
@pytest.mark.parametrize("objective", ["forward", "policy"])
def test_the_level_that_is_told_is_the_share_of_digits_that_were_replaced(
    training_pass, objective, monkeypatch
):
    values = {"grid": (16, 16), "factored": (64, 64), "corrupt_max": 0.3, "history_probability": 0.5}
    model = small_model(told_noise=True, training_pass=training_pass, **values)
    batch = small_batch(model.config, NAMES)
    told, tokens = _embedded_level(model, batch, monkeypatch, objective)
    true = batch.tokens.flatten(2)[[0, 2, 3, 1]]  # sorted by embodiment
    if tokens.shape[1] > true.shape[1]:
        true = torch.cat([true[:, :4], true[:, 1:]], dim=1)
    masked = tokens == model.config.mask_id
    both = torch.stack([tokens % 64 != true % 64, tokens // 64 != true // 64])
    replaced = (both & ~masked).sum((0, 3)) / (2 * (~masked).sum(2)).clamp(min=1)
    seen = (~masked).sum(2) > 100
    assert seen.sum() > 8 and told.std() > 0.05
    assert (replaced - told * 63 / 64)[seen].abs().max() < 0.15


def test_a_clean_frame_is_as_without_the_embedding():
    told, plain = (small_model(told_noise=on, corrupt_max=0.0) for on in (True, False))
    plain.load_state_dict({n: t for n, t in told.state_dict().items() if "noise" not in n})
    assert told.trunk.noise is not None and told.trunk.noise.weight.abs().sum() > 0
    batch = small_batch(told.config, NAMES)
    assert torch.equal(told(batch, None, seeded()).loss, plain(batch, None, seeded()).loss)
    assert torch.equal(
        told.video_logits(batch.tokens, batch.actions, NAMES),
        plain.video_logits(batch.tokens, batch.actions, NAMES),
    )


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_the_embedding_learns_from_noise_in_the_past(kind):
    model = small_model(kind=kind, told_noise=True, latent_noise=0.5, training_pass="pairs").train()
    model(small_batch(model.config, NAMES), "forward", seeded()).loss.backward()
    assert model.trunk.noise.weight.grad.abs().sum() > 0
