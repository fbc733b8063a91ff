"""Fingerprints change with what a policy, a world or an object is made of, and with nothing else."""

from pathlib import Path

import numpy as np
import pytest
import torch

from hma_model.policies.fingerprints import object_sha256, policy_facts, world_facts
from hma_model.simulate import World
from tests.model.robots import save


def test_a_checkpoint_is_known_by_its_trunk_and_its_robots_parts(tmp_path: Path) -> None:
    save(tmp_path / "one", {"arm": 2, "other": 3})
    found = policy_facts(f"hma:{tmp_path / 'one'},memory=1", "arm")
    assert policy_facts(f"hma:{tmp_path / 'one'}", "other") != found
    save(tmp_path / "two", {"arm": 2, "other": 3}, seed=1)
    assert policy_facts(f"hma:{tmp_path / 'two'}", "arm")["trunk"] != found["trunk"]
    head = tmp_path / "one/embodiments/arm/head.safetensors"
    head.write_bytes(head.read_bytes() + b" ")
    assert policy_facts(f"hma:{tmp_path / 'one'},memory=1", "arm") != found
    assert policy_facts("hma:someone/somewhere", "arm") == {}  # a repository


def test_a_folder_of_lerobot_is_known_by_all_its_files(tmp_path: Path) -> None:
    (tmp_path / "model.safetensors").write_bytes(bytes(100))
    found = policy_facts(f"lerobot:{tmp_path}", "arm")
    assert list(found) == ["model.safetensors"] and policy_facts(f"lerobot:{tmp_path}", "other") == found
    (tmp_path / "model.safetensors").write_bytes(bytes(99) + b"1")  # of the same size
    assert policy_facts(f"lerobot:{tmp_path}", "arm") != found
    assert policy_facts("lerobot:someone/somewhere", "arm") == {}  # a repository


@pytest.mark.parametrize("words", ["scripted", "scripted:noise=0.5", "random", "plan:cem,horizon=2"])
def test_other_policies_are_known_by_their_words(words: str) -> None:
    assert policy_facts(words, "rails_03") == {}


def test_a_model_in_memory_is_known_by_its_weights(world: World) -> None:
    found = world_facts(world)
    assert world_facts(world) == found
    with torch.no_grad():
        next(world.model.parameters()).add_(1)
    assert world_facts(world) != found


def test_an_object_is_known_by_what_it_holds() -> None:
    made = {"a": "words", "b": np.arange(4.0)}
    found = object_sha256(made)
    assert object_sha256(made) == found
    made["b"] = np.array([1.0])
    assert object_sha256(made) != found
    assert object_sha256(lambda: 0) != object_sha256(lambda: 0)  # nobody can tell
