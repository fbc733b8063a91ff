"""A new robot begins with the stem of its like: which one, and at another stride."""

import shutil
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from hma_data.errors import CheckpointError
from hma_data.shards.reader import ShardSet
from hma_model.checkpoint import io as checkpoint
from hma_model.checkpoint.folder import action_stats
from hma_model.checkpoint.io import Checkpoint
from hma_model.config import ActionSpace
from hma_model.evaluation.losses import validation_losses, windows
from hma_model.hub import publish as hub
from hma_model.network.stem import Stem
from hma_model.training import new_stem
from hma_model.training.loop import TrainResult, finetune, train
from hma_model.training.recipe import make_recipe
from tests.hostile import flip
from tests.model.robots import CONFIG
from tests.model.runs import TINY, weights
from tests.model.shards import make_shards

SHORT = ["steps=1", "lr=1e-12", "warmup=1", "eval_every=0", "report=false", "pictures=0", "device=cpu"]


@pytest.fixture(scope="module")
def base(tmp_path_factory) -> TrainResult:
    """A run on two robots of two dims, and one of three."""
    folder = tmp_path_factory.mktemp("base")
    robots = [("arm", 2, 0), ("cart", 2, 7), ("hand", 3, 1)]
    data = [str(make_shards(folder / name, name, dims=dims, seed=seed)) for name, dims, seed in robots]
    return train(make_recipe({**TINY, "data": data, "steps": 30, "lr": 1e-2}), out=folder / "run", show=False)


@pytest.fixture
def twin(tmp_path) -> Path:
    return make_shards(tmp_path / "twin", "twin", seed=0)


def tune(base, data, out, *changes, freeze=True) -> TrainResult:
    return finetune(base, [data], out=out, freeze_trunk=freeze, overrides=[*SHORT, *changes], show=False)


@given(st.integers(1, 6), st.integers(1, 6), st.integers(0, 3), st.integers(0, 3))
def test_a_command_that_is_held_means_the_same_at_every_stride(steps, own_steps, waves, own_waves):
    torch.manual_seed(0)
    spaces = [ActionSpace("a", 2, n, (1.0, 2.0), (3.0, 4.0), (True, False)) for n in (steps, own_steps)]
    theirs, own = (Stem(CONFIG, space, n) for space, n in zip(spaces, (waves, own_waves)))
    if theirs.waves is not None:
        kept = theirs.waves.weight.detach().view(-1, 2 * steps, 2, waves)
        torch.nn.init.normal_(kept[..., : min(waves, own_waves)])
    fitted = new_stem._fitted(theirs.state_dict(), own.state_dict(), steps, own_steps)
    own.load_state_dict(fitted)
    held = torch.randn(3, 4, 2)
    a, b = (stem(held.repeat(1, 1, n)) for stem, n in ((theirs, steps), (own, own_steps)))
    assert torch.allclose(a, b, atol=1e-5)


def test_the_stem_with_the_lowest_loss_is_taken(base, twin, tmp_path):
    opened, shards = Checkpoint.open(base.checkpoint), ShardSet(twin)
    model = checkpoint.load(base.checkpoint)
    model.add_embodiment(shards.embodiment, action_stats(shards.manifest.stats, "twin"))
    before = {name: value.clone() for name, value in model.state_dict().items()}
    chosen = new_stem.choose(model, "twin", opened, shards, "first", "forward")
    assert all(torch.equal(before[name], value) for name, value in model.state_dict().items())
    given: dict = {"batch_size": new_stem.WINDOWS}

    def loss() -> float:
        found = windows(shards, "train", new_stem.FRAMES, new_stem.WINDOWS, **given)
        return validation_losses(model, found)[0].mean()

    losses = {"": loss()}
    for name in ("arm", "cart"):
        new_stem.copy_stem(model, "twin", opened, name)
        losses[name] = loss()
    assert chosen is not None and chosen.fresh_loss == losses[""]
    assert (chosen.loss, chosen.like) == min((value, name) for name, value in losses.items())


def test_a_new_robot_begins_with_it_and_the_card_says_so(base, twin, tmp_path):
    home = tmp_path / "hub" / "team" / "model"
    hub.push(base.checkpoint, home)
    like, fresh = (tune(home, twin, tmp_path / way, f"new_stem={way}") for way in ("like", "fresh"))
    cards = [Checkpoint.open(run.checkpoint).card("twin")["training"] for run in (like, fresh)]
    source = cards[0]["stem_from"]
    assert source in ("arm", "cart") and "stem_from" not in cards[1]
    found = weights(like.checkpoint)
    for name in ("input.weight", "output.weight", "norm.weight"):
        parts = (found[f"embodiments/{one}/stem.safetensors:{name}"] for one in ("twin", source))
        assert torch.allclose(*parts, atol=1e-6), name
    again = tune(home, twin, tmp_path / "like", "new_stem=like", "steps=1")
    assert Checkpoint.open(again.checkpoint).card("twin")["training"]["stem_from"] == source


def test_a_damaged_like_robot_is_named_with_the_way_without_it(base, twin, tmp_path):
    damaged = shutil.copytree(base.checkpoint, tmp_path / "damaged one")
    stem = damaged / "embodiments/arm/stem.safetensors"
    flip(-9)(stem)
    with pytest.raises(CheckpointError, match=r"embodiments/arm/stem\.safetensors: .*new_stem=fresh"):
        tune(damaged, twin, tmp_path / "run", freeze=False)
    assert tune(damaged, twin, tmp_path / "run", "new_stem=fresh", freeze=False).step == 1


def test_a_new_stem_has_the_waves_of_its_like(base, twin, tmp_path):
    arm = make_shards(tmp_path / "arm", "arm")
    waved = tune(base.out, arm, tmp_path / "waved", "model.action_waves=3", "steps=2", "lr=1e-2")
    like, fresh = (tune(waved.out, twin, tmp_path / way, f"new_stem={way}") for way in ("like", "fresh"))
    key = "embodiments/twin/stem.safetensors:waves.weight"
    assert weights(like.checkpoint)[key].shape[1] == 2 * 3 * 4 and key not in weights(fresh.checkpoint)


def test_only_robots_with_as_many_dims_are_tried_the_nearest_rate_first():
    cards: dict = {
        "slow": {"action_dim": 2, "effective_hz": 1.0}, "near": {"action_dim": 2, "effective_hz": 9.0},
        "wide": {"action_dim": 3, "effective_hz": 10.0}, "none": {},
        "odd": {"action_dim": 2, "effective_hz": "x"},
    }  # fmt: skip

    class Robot:
        action_dim, effective_hz = 2, 10.0

    assert new_stem.candidates(cards, Robot()) == ["near", "slow", "odd"]  # type: ignore[arg-type]
