"""Fixtures of the model's tests: shards, a recipe, a run and a checkpoint that are made once in a session.

What a session shares is read only. `folder` is a copy that a test may change.
"""

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch

from hma_data.tokenizers.base import get_tokenizer
from hma_model.network.model import HMA
from hma_model.simulate import World
from hma_model.training.loop import TrainResult, train
from hma_model.training.recipe import Recipe, make_recipe
from tests.hub_state import ROBOTS
from tests.model.robots import save
from tests.model.runs import TINY
from tests.model.shards import make_shards
from tests.model.true_world import tiny_model


@contextmanager
def with_one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    """Compute with one thread: on tensors this small, more threads only wait for one another."""
    with with_one_thread():
        yield


@pytest.fixture(scope="module")
def model() -> HMA:
    """A tiny untrained model of a laboratory robot; modules may have their own, and worlds of these."""
    return tiny_model("rails_03")


@pytest.fixture
def world(model: HMA) -> World:
    return World(model, get_tokenizer("fsq-8"))


@pytest.fixture(scope="session")
def arm_shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_shards(tmp_path_factory.mktemp("shards") / "arm", "arm")


@pytest.fixture(scope="session")
def hand_shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_shards(tmp_path_factory.mktemp("shards") / "hand", "hand", dims=3, seed=1)


@pytest.fixture(scope="session")
def data(arm_shards: Path, hand_shards: Path) -> list[str]:
    return [str(arm_shards), str(hand_shards)]


@pytest.fixture
def recipe(data: list[str]) -> Callable[..., Recipe]:
    def changed(**changes: object) -> Recipe:
        return make_recipe({**TINY, "data": data, **changes})

    return changed


@pytest.fixture(scope="session")
def tiny_run(data: list[str], tmp_path_factory: pytest.TempPathFactory) -> TrainResult:
    recipe = make_recipe({**TINY, "data": data, "model": {**TINY["model"], "mup": True, "base_width": 8}})
    with with_one_thread():  # a session's fixture begins before the module's; tests compare last bits
        return train(recipe, out=tmp_path_factory.mktemp("tiny") / "run", show=False)


@pytest.fixture(scope="session")
def finished(data: list[str], tmp_path_factory: pytest.TempPathFactory) -> TrainResult:
    recipe = make_recipe({**TINY, "data": data})
    with with_one_thread():  # a session's fixture begins before the module's; tests compare last bits
        return train(recipe, out=tmp_path_factory.mktemp("finished") / "run", show=False)


@pytest.fixture(scope="session")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("source") / "model"
    save(folder, ROBOTS)
    return folder


@pytest.fixture
def folder(source: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(source, tmp_path / "model"))
