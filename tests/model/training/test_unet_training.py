"""Training of the U-Net: finetuning, resuming, ranks, recomputed blocks, and what does not fit refused."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hma_data.errors import CheckpointError, HubError, RecipeError
from hma_data.tokenizers.base import TokenizerSpec
from hma_data.tokenizers.shapes import palette_spec
from hma_model.checkpoint.folder import Checkpoint, resolve
from hma_model.config import HMAConfig
from hma_model.hub import publish as hub
from hma_model.network.model import HMA
from hma_model.network.stem import from_digits, to_digits
from hma_model.training.colors import carried, recolored
from hma_model.training.loop import TrainResult, finetune, train
from hma_model.training.recipe import Recipe, make_recipe
from tests.model.network.test_unet import COLORS, stored, unet
from tests.model.runs import TINY, same, train_until, weights
from tests.model.shards import make_shards
from tests.model.training.test_parallel import close, curve, spread

SPEC = TokenizerSpec("raw", 1, "continuous", 16, (4, 4), channels=2, dtype="float16")
UNET = {
    "trunk": "unet", "layers": 1, "levels": (8, 16), "width": 16, "heads": 2, "patch": 1,
    "shared_modulation": True, "training_pass": "pairs", "whole_share": 1.0, "video_loss": "regression",
    "copy_previous": True, "told_noise": True, "latent_noise": 0.1,
}  # fmt: skip
TUNE = ["steps=3", "device=cpu", "report=false", "pictures=0", "track=[]", "eval_every=0", "batch_size=4"]


@pytest.fixture(scope="module")
def shards(tmp_path_factory) -> list[str]:
    folder = tmp_path_factory.mktemp("shards")
    return [str(make_shards(folder / name, name, dims, spec=SPEC)) for name, dims in (("arm", 2), ("leg", 4))]


def recipe(data: list[str], **changes: object) -> Recipe:
    given = {"objectives": {"forward": 1, "policy": 1}, "model": UNET, "eval_every": 0, **changes}
    return make_recipe({**TINY, "data": data, **given})


@pytest.fixture(scope="module")
def base(shards, tmp_path_factory) -> TrainResult:
    return train(recipe(shards[:1]), out=tmp_path_factory.mktemp("base") / "run", show=False)


def test_a_run_that_was_killed_ends_with_the_same_bits(base, shards, tmp_path):
    train_until(recipe(shards[:1]), tmp_path / "run", 3)
    assert same(train(recipe(shards[:1]), out=tmp_path / "run", show=False).checkpoint, base.checkpoint)


@pytest.mark.parametrize("freeze", [True, False])
def test_a_new_robot_is_tuned_published_and_pulled(base, shards, tmp_path, freeze):
    out = tmp_path / "run"
    tuned = finetune(base.out, shards[1:], out=out, freeze_trunk=freeze, overrides=TUNE, show=False)
    assert (
        Checkpoint.open(tuned.checkpoint).trunk_sha256 == Checkpoint.open(base.checkpoint).trunk_sha256
    ) == (freeze)
    home = tmp_path / "team" / "model"
    hub.push(base.checkpoint, home)
    if not freeze:
        with pytest.raises(HubError, match="another trunk"):
            hub.push(tuned.checkpoint, home, ["leg"])
        return
    hub.push(tuned.checkpoint, home, ["leg"])
    model = hub.from_pretrained(home)
    assert set(model.embodiments) == {"arm", "leg"} and model.config.trunk == "unet"
    assert "unet of levels 8-16" in (home / "README.md").read_text()


@pytest.mark.parametrize(
    ("changes", "fault", "said"),
    [
        ({"model.trunk": "transformer"}, RecipeError, "trunk: is 'transformer', the checkpoint .* 'unet'"),
        ({"model.levels": "[8, 8]"}, RecipeError, "model.levels"),
    ],
)
def test_another_trunk_than_the_checkpoints_is_refused(base, shards, tmp_path, changes, fault, said):
    more = [f"{key}={value}" for key, value in changes.items()]
    with pytest.raises(fault, match=said):
        finetune(base.out, shards[1:], out=tmp_path / "run", overrides=[*TUNE, *more], show=False)


def test_latents_of_another_size_or_tokenizer_are_refused(base, tmp_path):
    for name, grid, said in (
        ("raw", (8, 8), "grid is .4, 4"),
        ("vae", (4, 4), "tokenizer 'raw', the data is of 'vae'"),
    ):
        spec = TokenizerSpec(name, 1, "continuous", 16, grid, channels=2, dtype="float16")
        made = make_shards(tmp_path / name, "arm", spec=spec)
        with pytest.raises(CheckpointError, match=said):
            finetune(base.out, [made], out=tmp_path / "run", overrides=TUNE, show=False)


def test_recomputed_blocks_give_the_same_gradients(base):
    from tests.model.network.test_unet import LATENTS, stored, unet
    from tests.model.network_parts import small_batch

    found = []
    for checkpointing in (False, True):
        model = unet(**LATENTS).train()
        model.trunk.checkpointing = checkpointing
        batch = small_batch(model.config, ["arm"])
        batch.latents = stored(model, 1, 4)
        model(batch, "full", torch.Generator().manual_seed(0)).loss.backward()
        found.append([p.grad for p in model.parameters() if p.grad is not None])
    assert all(map(torch.equal, *found)) and len(found[0]) == len(found[1])


@pytest.mark.slow
def test_two_sharded_ranks_give_the_curve_and_the_weights_of_one(shards, tmp_path):
    few = {"batch_size": 1, "accumulate": 4, "weight_decay": 0.5}
    alone = train(recipe(shards, **few), out=tmp_path / "alone", show=False)
    told = spread(recipe(shards, parallel="fsdp", **few), tmp_path / "run")
    assert curve(tmp_path / "run") == pytest.approx([loss for _, loss in alone.losses], rel=1e-4), told
    close(alone.checkpoint, resolve(tmp_path / "run"))


@pytest.mark.parametrize(
    "objective",
    [
        "forward",
        "policy",
        *(pytest.param(one, marks=pytest.mark.slow) for one in ("passive", "inverse", "full")),
    ],
)
def test_the_loss_of_each_objective_falls(shards, tmp_path, objective):
    changes = {"objectives": {objective: 1}, "steps": 40, "lr": 1e-2, "schedule": "constant_with_warmup"}
    done = train(recipe(shards[:1], checkpoint_every=40, **changes), out=tmp_path / "run", show=False)
    losses = [loss for _, loss in done.losses]
    assert sum(losses[-8:]) < sum(losses[:8])
    model = HMA.from_pretrained(done.checkpoint).eval()
    assert "arm" in model.embodiments and weights(done.checkpoint)


# -- squares

TOKENS = TokenizerSpec("raw", 1, "discrete", 16, (8, 8), vocab_size=64, factored=(8, 8))
CUT = {**UNET, "video_loss": "diffusion", "told_noise": False, "latent_noise": 0.0, "crop": 6}


@pytest.fixture(scope="module")
def moving(tmp_path_factory) -> list[str]:
    folder, made = tmp_path_factory.mktemp("moving"), []
    for name, dims, length in (("arm", 2, 24), ("leg", 4, 3)):  # the second is padded
        made.append(str(make_shards(folder / name, name, dims, length=length, spec=TOKENS)))
    return made


def of_squares(data: list[str], **changes: object) -> Recipe:
    given = {"objectives": {"forward": 1}, "model": CUT, "short": "pad", "self_forward": 0.5, "batch_size": 2}
    return recipe(data, **given, accumulate=2, **changes)


@pytest.mark.slow
def test_a_run_on_squares_goes_on_with_the_same_bits_and_is_tuned_on_whole_frames(moving, tmp_path):
    whole = train(of_squares(moving), out=tmp_path / "whole", show=False)
    train_until(of_squares(moving), tmp_path / "cut", 3)
    assert same(train(of_squares(moving), out=tmp_path / "cut", show=False).checkpoint, whole.checkpoint)
    more = [*TUNE, "objectives={policy: 1}", "model.crop=0"]
    tuned = finetune(whole.out, moving[:1], out=tmp_path / "tuned", overrides=more, show=False)
    assert Checkpoint.open(tuned.checkpoint).config.crop == 0


def test_a_run_on_squares_ends_with_whole_frames(moving, tmp_path, monkeypatch) -> None:
    seen, plain = [], HMA.forward
    monkeypatch.setattr(
        HMA,
        "forward",
        lambda model, batch, *a, **k: seen.append(batch.places is None) or plain(model, batch, *a, **k),
    )
    train(of_squares(moving, steps=4, whole_from=0.5, eval_every=0), out=tmp_path / "run", show=False)
    trained = [whole for whole in seen if whole is not None][:8]
    assert trained == [False] * 4 + [True] * 4  # two passes a step


@pytest.mark.slow
def test_two_ranks_on_squares_give_the_curve_and_the_weights_of_one(moving, tmp_path):
    alone = train(of_squares(moving), out=tmp_path / "alone", show=False)
    told = spread(of_squares(moving), tmp_path / "run")
    assert curve(tmp_path / "run") == pytest.approx([loss for _, loss in alone.losses], rel=1e-4), told
    close(alone.checkpoint, resolve(tmp_path / "run"))


# -- another list of colours


OWN = np.array([[0, 0, 0], [250, 250, 250], [200, 30, 30], [30, 200, 30], [30, 30, 200]], np.uint8)


def spec(colors: Any) -> TokenizerSpec:
    return palette_spec("palette-64", 16, np.asarray(colors, np.uint8))


def model_of(spec: TokenizerSpec, **changes: Any) -> HMA:
    return unet(**{**COLORS, "factored": spec.factored, "tokenizer": spec.to_json(), **changes})


def carried_to(model: HMA, other: TokenizerSpec) -> HMA:
    config: HMAConfig = recolored(model.config, other)
    made = HMA(config)
    made.load_trunk(carried(model.trunk_state(), model.config, config))
    made.load_embodiment("arm", model.stem_state("arm"), model.head_state("arm"))
    return made.eval()


@pytest.mark.parametrize("changes", [{}, {"digit_order": "chain"}], ids=["together", "chain"])
@settings(max_examples=10, deadline=None)
@given(order=st.permutations(range(5)))
def test_the_same_colours_in_another_order_give_the_same_predictions(changes: dict[str, Any], order) -> None:
    model = model_of(spec(OWN), **changes)
    other = carried_to(model, spec(OWN[order]))
    tokens, actions = stored(model, 2, 4), torch.randn(2, 4, 6)
    place = torch.tensor([order.index(value) for value in range(5)])  # of each colour in the new list
    again = from_digits(place[to_digits(tokens, (5,) * 4)], (5,) * 4)
    expected = model.video_logits(tokens, actions, "arm", true=tokens)
    made = other.video_logits(again, actions, "arm", true=again)
    torch.testing.assert_close(made[..., place], expected, rtol=1e-4, atol=1e-5)


def test_a_new_colour_is_seen_as_the_nearest_one_and_shares_its_probability() -> None:
    model = model_of(spec(OWN))
    other = carried_to(model, spec([[10, 10, 10], [180, 60, 40], [210, 20, 20]]))
    tokens, actions = stored(other, 1, 4), torch.randn(1, 4, 6)
    same = from_digits(torch.tensor([0, 2, 2])[to_digits(tokens, (3,) * 4)], (5,) * 4)
    expected = model.video_logits(same, actions, "arm")[..., [0, 2, 2]]
    made = other.video_logits(tokens, actions, "arm")
    shared = torch.tensor([0.0, math.log(2), math.log(2)])
    # without a frame before, so that none is copied
    torch.testing.assert_close(made[:, 0], expected[:, 0] - shared, rtol=1e-4, atol=1e-5)


def test_a_trunk_is_tuned_on_other_colours_and_a_frozen_one_refuses_them(tmp_path) -> None:
    colors = {**UNET, "video_loss": "diffusion", "told_noise": False, "latent_noise": 0.0}
    arm = str(make_shards(tmp_path / "arm", "arm", spec=spec(OWN)))
    base = train(recipe([arm], model=colors, objectives={"forward": 1}), out=tmp_path / "base", show=False)
    leg = str(make_shards(tmp_path / "leg", "leg", dims=3, spec=spec(OWN[[3, 1, 4]])))
    with pytest.raises(CheckpointError, match="on other colours of 'palette-64' .* or tune the trunk"):
        finetune(base.out, [leg], out=tmp_path / "f", freeze_trunk=True, overrides=TUNE, show=False)
    other = str(make_shards(tmp_path / "other", "leg", dims=3))
    for freeze in (True, False):
        with pytest.raises(CheckpointError, match="tokenizer 'palette-64', the data is of 'raw'"):
            finetune(base.out, [other], out=tmp_path / "f", freeze_trunk=freeze, overrides=TUNE, show=False)
    made = finetune(base.out, [leg], out=tmp_path / "run", overrides=TUNE, show=False)
    config = Checkpoint.open(made.checkpoint).config
    assert config.factored == (3,) * 4 and config.tokenizer["colors"] == spec(OWN[[3, 1, 4]]).colors
