"""Training, generation and evaluation on three cameras, stacked or drawn."""

from pathlib import Path

import numpy as np
import pytest
import torch

from hma_data.errors import RecipeError, UsageError
from hma_data.shards.reader import ShardSet
from hma_model.config import HMAConfig
from hma_model.evaluation import evaluate
from hma_model.evaluation.rollout_video import rollout_video
from hma_model.generation.decode import cameras_for, decode
from hma_model.network.model import HMA
from hma_model.training.loop import train
from hma_model.training.recipe import make_recipe
from tests.conftest import BlockTokenizer
from tests.data.cameras import SIZES, arm, three_shards
from tests.model.runs import TINY

NAMES = list(SIZES)
SHORT = TINY | {"steps": 2, "frames": 3, "batch_size": 2, "eval_windows": 2, "checkpoint_every": 0}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return three_shards(tmp_path_factory.mktemp("views"), val_fraction=0.3)


@pytest.fixture(scope="module")
def run(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run")
    train(make_recipe(SHORT | {"data": [str(made)], "cameras": NAMES}), out=out)
    return out


def test_three_views_are_trained_generated_and_evaluated(made: Path, run: Path) -> None:
    shards, tokenizer = ShardSet(made), BlockTokenizer()
    model = HMA.from_pretrained(run)
    assert model.config.views == 3
    assert model.config.token_grid == (24, 8)
    assert model.trunk.position.shape[1] == 24 * 8
    assert cameras_for(model, shards) == NAMES  # those of its training
    film = rollout_video(model, tokenizer, shards, prompt=1)
    assert film.frames.shape[2] > 3 * 3 * 64  # three panels of three views
    found = evaluate.measure(model, tokenizer, shards, evaluate.EvaluationSettings(windows=2)).found
    assert found["cameras"] == "top, wrist, side"
    assert np.isfinite(found["loss"])
    with pytest.raises(UsageError, match="the model takes 3"):
        rollout_video(model, tokenizer, shards, cameras="top")


def test_views_are_decoded_side_by_side(made: Path) -> None:
    from hma_data.loading.dataset import WindowDataset

    one, other = (WindowDataset(made, "train", 3, cameras=name)[0].tokens for name in ("side", "top"))
    both = WindowDataset(made, "train", 3, cameras=["side", "top"])[0].tokens
    alone = [decode(BlockTokenizer(), tokens) for tokens in (one, other)]
    np.testing.assert_array_equal(decode(BlockTokenizer(), both), np.concatenate(alone, axis=3))


def test_a_run_on_drawn_or_named_cameras_takes_one_view(made: Path, tmp_path: Path) -> None:
    for cameras in ("drawn", "wrist"):
        train(make_recipe(SHORT | {"data": [str(made)], "cameras": cameras}), out=tmp_path / cameras)
        model = HMA.from_pretrained(tmp_path / cameras)
        assert model.config.views == 1
        assert cameras_for(model, ShardSet(made)) == cameras


def test_another_number_of_views_cannot_start_from_it(made: Path, run: Path, tmp_path: Path) -> None:
    recipe = make_recipe(SHORT | {"data": [str(made)], "start": str(run)})
    with pytest.raises(RecipeError, match="are 1 in a frame, the checkpoint .* has 3"):
        train(recipe, out=tmp_path / "run")
    with pytest.raises(RecipeError, match="recipe: cameras: three_hdf5 has the cameras .* not nose"):
        train(make_recipe(SHORT | {"data": [str(made)], "cameras": ["nose", "top"]}), out=tmp_path / "run")
    with pytest.raises(RecipeError, match="cameras: must be first, drawn"):
        make_recipe({"cameras": []})


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_one_view_is_the_network_as_it_was(kind: str) -> None:
    config = HMAConfig(kind=kind, layers=1, width=16, heads=2, grid=(4, 4))
    assert "views" not in config.to_json()
    two = config.replace(views=2)
    assert HMAConfig.from_json(two.to_json()) == two
    assert two.tokens_per_frame == 2 * config.tokens_per_frame
    shape = two.frame_shape
    model = HMA(two)
    model.add_embodiment(arm())
    stored = torch.randint(0, 8, (1, 3, *shape)) if kind == "discrete" else torch.randn(1, 3, *shape)
    assert model.eval().generate(stored, None, arm().id, 1).shape == (1, 1, *shape)
