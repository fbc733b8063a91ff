"""What is not known is not learned from: shards with marks, through the loader, to every loss."""

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
from hma_model.network.model import HMA
from tests.conftest import BlockTokenizer
from tests.data import hands_files as made
from tests.data.videos import encode

LENGTH, GONE = 30, range(10, 13)


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A video of two hands, one of which is gone for three frames that are masked."""
    folder = tmp_path_factory.mktemp("hands")
    encode(folder / "a.mp4", range(LENGTH))
    rows = made.rows("a", LENGTH, lambda side, i: side == "left" or i not in GONE)
    made.write_table(folder / "hands.csv", rows)
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


def other(batch: Batch) -> Batch:
    """The same, with anything where chunks are unknown."""
    actions = torch.where(batch.action_mask[..., None], batch.actions, torch.tensor(1e6))
    return replace(batch, actions=actions)


@pytest.mark.parametrize("objective", ["forward", "passive", "policy", "inverse", "full"])
def test_no_loss_depends_on_what_stands_in_unknown_chunks(model: HMA, batch: Batch, objective: str) -> None:
    losses = [model(each, objective, torch.Generator().manual_seed(0)).loss for each in (batch, other(batch))]
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
