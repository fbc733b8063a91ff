"""Masks, corruption, its level that the model is told, and the unmasking schedule."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hma_data.conversion.job import convert
from hma_data.loading.dataset import Batch, WindowDataset
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import ShardSet
from hma_model.checkpoint import io as checkpoint
from hma_model.config import HMAConfig
from hma_model.generation.unmask import masked_after
from hma_model.network.masking import VideoMask, corrupt_tokens, draw_video_mask, drop_chunks
from hma_model.network.model import HMA
from hma_model.network.stem import NoiseEmbedding, to_digits
from tests.conftest import BlockTokenizer
from tests.data import hands_files as made
from tests.model.network_parts import seeded, small_batch, small_config, small_model


def test_frames_are_masked_with_the_mean_of_the_cosine() -> None:
    mask = draw_video_mask(small_config(history_probability=0.0), 2000, 5, seeded())
    share = mask.masked.float().mean((0, 2))
    assert share[0] == 0
    assert (share[1:] - 2 / math.pi).abs().max() < 0.03


def test_a_long_history_stays_unmasked_as_often_as_configured() -> None:
    mask = draw_video_mask(small_config(history_probability=0.25), 2000, 5, seeded())
    visible = ~mask.masked.any(2)
    assert abs(visible[:, 1:4].all(1).float().mean().item() - 0.25) < 0.05


def test_frames_after_a_long_history_are_corrupted_more_and_more() -> None:
    mask = draw_video_mask(small_config(history_probability=1.0), 200, 8, seeded())
    assert (mask.corruption.diff(dim=1) >= -1e-6).all()
    assert (mask.corruption[:, -1] > mask.corruption[:, 0]).float().mean() > 0.9


def test_each_sample_of_a_batch_draws_its_own_mask() -> None:
    mask = draw_video_mask(small_config(), 64, 5, seeded())
    assert mask.masked.flatten(1).unique(dim=0).shape[0] > 60
    assert mask.corruption[:, 0].unique().numel() > 60


def test_digits_are_corrupted_at_the_given_rate_and_masked_tokens_hidden() -> None:
    config = small_config(factored=(64, 64), grid=(32, 32))
    tokens = torch.randint(0, 4096, (4, 2, 1024), generator=seeded())
    masked = torch.rand(4, 2, 1024, generator=seeded()) < 0.3
    corrupted = corrupt_tokens(config, tokens, VideoMask(masked, torch.full((4, 2), 0.2)), seeded(1))
    assert (corrupted[masked] == 4096).all() and (corrupted[~masked] < 4096).all()
    changed = to_digits(corrupted, (64, 64))[~masked] != to_digits(tokens, (64, 64))[~masked]
    assert (changed.float().mean(0) - 0.2 * 63 / 64).abs().max() < 0.02
    both = changed.all(-1).float().mean()
    assert abs(both - 0.04) < 0.01  # each digit by itself


def test_no_corruption_leaves_visible_tokens() -> None:
    config = small_config(corrupt_max=0.0)
    mask = draw_video_mask(config, 4, 5, seeded())
    tokens = torch.randint(0, 24, (4, 5, 16), generator=seeded())
    out = corrupt_tokens(config, tokens, mask, seeded())
    assert torch.equal(out[~mask.masked], tokens[~mask.masked])


def test_every_sample_hides_at_least_one_present_chunk() -> None:
    present = torch.rand(500, 6, generator=seeded()) < 0.4
    present[:, 3] = True
    assert (drop_chunks(present, seeded()) & present).any(1).all()


def test_unmasking_follows_the_cosine_and_ends_with_nothing_masked() -> None:
    assert [masked_after(s, 2, 256) for s in range(2)] == [182, 0]
    for steps in (1, 3, 8, 16):
        left = [masked_after(s, steps, 64) for s in range(steps)]
        assert left[-1] == 0 and left == sorted(left, reverse=True) and left[0] < 64


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


# -- shards with marks, through the loader, to every loss


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A video of two hands, one of which is gone for three frames that are masked."""
    folder = made.write_gap(tmp_path_factory.mktemp("hands"), "hands.csv")
    robot = made.hand_video("landmarks", missing="mask")
    values = robot.to_dict() | {"stride": 2}
    convert(Embodiment.from_values(values, "hands"), str(folder), BlockTokenizer(), folder / "out")
    return folder / "out"


@pytest.fixture(scope="module")
def batch(shards: Path) -> Batch:
    windows = WindowDataset(shards, "train", 4)
    batch = windows.batch(range(2, 14))
    assert 0 < int(batch.action_mask.sum()) < batch.action_mask.numel()
    return batch


@pytest.fixture(scope="module")
def model(shards: Path) -> HMA:
    torch.manual_seed(0)
    loaded = ShardSet(shards)
    config = HMAConfig(
        layers=1, width=16, heads=2, frames=4, grid=(8, 8), factored=(64, 64), tokenizer=loaded.spec.to_json()
    )
    model = HMA(config)
    stats = checkpoint.action_stats(loaded.manifest.stats, "shards")
    model.add_embodiment(loaded.embodiment, stats)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    return model.eval()


@pytest.mark.parametrize("objective", ["forward", "passive", "policy", "inverse", "full"])
def test_no_loss_depends_on_what_stands_in_unknown_chunks(model: HMA, batch: Batch, objective: str) -> None:
    anything = torch.where(batch.action_mask[..., None], batch.actions, torch.tensor(1e6))
    both = batch, replace(batch, actions=anything)
    losses = [model(each, objective, torch.Generator().manual_seed(0)).loss for each in both]
    assert torch.isfinite(losses[0]) and torch.equal(losses[0], losses[1])


@pytest.mark.parametrize("objective", ["forward", "policy", "inverse", "full"])
def test_a_batch_of_which_nothing_is_known_trains_without_nan(model, batch, objective) -> None:
    model.train()
    blind = replace(batch, action_mask=torch.zeros_like(batch.action_mask))
    out = model(blind, objective, torch.Generator().manual_seed(0))
    assert torch.isfinite(out.loss) and (out.action_loss is None or out.action_loss == 0)
    if out.loss.requires_grad:
        out.loss.backward()
        grads = [p.grad for p in model.parameters() if p.grad is not None]
        assert all(torch.isfinite(grad).all() for grad in grads)
    model.zero_grad(set_to_none=True)
    model.eval()


def test_logits_of_a_frame_change_with_a_chunk_that_becomes_unknown(model: HMA, batch: Batch) -> None:
    with torch.no_grad():
        seen = batch.tokens.clone()
        seen[:, 3] = model.config.vocab_size
        known = model.video_logits(seen, batch.actions, batch.embodiment, torch.ones_like(batch.action_mask))
        masked = model.video_logits(seen, batch.actions, batch.embodiment, batch.action_mask)
    changed = (known[:, 3] != masked[:, 3]).flatten(1).any(dim=1).numpy()
    hidden = (~batch.action_mask[:, :3]).any(dim=1).numpy()  # chunk k leads to frame k + 1
    np.testing.assert_array_equal(changed, hidden)
