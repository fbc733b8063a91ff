"""A model of colours begins a training on other colours with what it knows of the nearest ones."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hma_data.errors import CheckpointError
from hma_data.tokenizers.base import TokenizerSpec
from hma_data.tokenizers.shapes import palette_spec
from hma_model.checkpoint.folder import Checkpoint
from hma_model.config import HMAConfig
from hma_model.network.model import HMA
from hma_model.network.stem import from_digits, to_digits
from hma_model.training.colors import carried, recolored
from hma_model.training.loop import finetune, train
from tests.model.network.test_unet import COLORS, stored, unet
from tests.model.shards import make_shards
from tests.model.training.test_unet_training import TUNE, UNET, recipe

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
