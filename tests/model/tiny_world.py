"""Fixtures: a tiny untrained model of a laboratory robot, and a world of it; modules may have their own."""

import pytest

from hma_data.tokenizers.base import get_tokenizer
from hma_model.network.model import HMA
from hma_model.simulate import World
from tests.model.true_world import tiny_model


@pytest.fixture(scope="module")
def model() -> HMA:
    return tiny_model("rails_03")


@pytest.fixture
def world(model: HMA) -> World:
    return World(model, get_tokenizer("fsq-8"))
