"""Fixtures of these tests."""

from tests.model.tiny_world import model as model
from tests.model.tiny_world import world as world
