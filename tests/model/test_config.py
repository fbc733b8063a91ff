"""The model's configuration and action spaces."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from hma_data.errors import RecipeError
from hma_model.config import ActionSpace, HMAConfig


def test_json_roundtrip_keeps_every_field() -> None:
    config = HMAConfig(
        kind="continuous",
        grid=(32, 32),
        conditioning=("concat", "modulation"),
        objectives={"forward": 2, "policy": 1},
        tokenizer={"name": "taef2", "grid": [32, 32]},
    )
    assert HMAConfig.from_json(json.dumps(config.to_json())) == config
    assert HMAConfig.from_json(config.to_json()) == config


def test_continuous_tokens_are_patches() -> None:
    config = HMAConfig(kind="continuous", grid=(32, 24), patch=2, channels=4)
    assert config.token_grid == (16, 12) and config.patch_dim == 16


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"kind": "pixels"}, "kind"),
        ({"width": 100}, "heads"),
        ({"factored": (512, 1)}, "factored"),
        ({"grid": (16,)}, "grid"),
        ({"kind": "continuous", "grid": (15, 16)}, "patch"),
        ({"conditioning": ("film",)}, "conditioning"),
        ({"objectives": {"forward": 0.0}}, "objectives"),
        ({"objectives": {"dream": 1.0}}, "objectives"),
        ({"label_smoothing": 1.5}, "label_smoothing"),
        ({"layout": "theirs"}, "layout"),
        ({"shared_modulation": True, "layout": "released"}, "layout"),
    ],
)
def test_bad_values_name_their_field(change: dict, name: str) -> None:
    with pytest.raises(RecipeError) as error:
        HMAConfig(**change)
    assert error.value.where == f"model.{name}"


def test_unknown_field_is_refused_by_name() -> None:
    with pytest.raises(RecipeError, match=r"model\.depth"):
        HMAConfig.from_json({"depth": 4})


def test_action_space_of_an_embodiment_and_its_stats() -> None:
    embodiment = SimpleNamespace(id="arm", action_dim=2, stride=3, normalize_mask=np.array([True, False]))
    stats = SimpleNamespace(mean=np.array([1.0, 2.0]), std=np.array([0.5, 0.0]))
    space = ActionSpace.of(embodiment, stats)
    assert space == ActionSpace("arm", 2, 3, (1.0, 2.0), (0.5, 0.0), (True, False))
    assert space.chunk_dim == 6
    assert ActionSpace.of(embodiment).std == (1.0, 1.0)


def test_action_space_refuses_statistics_of_another_width() -> None:
    with pytest.raises(RecipeError, match="mean has 1 values where the action has 2"):
        ActionSpace("arm", 2, 3, (0.0,), (1.0, 1.0), (True, True))
