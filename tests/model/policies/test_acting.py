"""A model acts in scenes: it gives what `predict_actions` says of all that it saw and did."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from hma_data.errors import HMAError, UsageError
from hma_data.tokenizers.base import get_tokenizer
from hma_model.cli import main
from hma_model.policies import acting, scores
from hma_model.policies.acting import Acting
from hma_model.policies.arenas import ModelArena, Scenes, TrueArena
from hma_model.policies.base import begin, checked
from hma_model.policies.catalog import read_policy
from hma_model.policies.fingerprints import object_sha256, policy_facts, world_facts
from hma_model.simulate import World
from hma_model.synthetic import augment, labels
from tests.model.robots import save
from tests.model.true_world import tiny_model

ROBOT = "rails_03"


def actor(*objectives: str) -> World:
    return World(tiny_model(ROBOT, *objectives), get_tokenizer("fsq-8"), temperature=0.0)


@pytest.mark.parametrize("memory", [None, 1, 3])
def test_it_does_what_the_history_of_images_and_actions_says_or_its_newest_part(memory: int | None) -> None:
    world = actor("policy")
    arena = TrueArena(Scenes.of(world, ROBOT, 2, 0), 128)
    own = {} if memory is None else {"memory": memory}
    policy, stride, spec = Acting(world, arena.scenes, **own), arena.scenes.stride, world.action_spec(ROBOT)
    frames = np.stack([prompt.frames for prompt in arena.prompts])
    chunks = np.stack([prompt.chunks for prompt in arena.prompts])
    begin("it", policy, arena)
    for _ in range(4):
        first = -(memory or 20)
        tokens = np.stack([world.tokenizer.encode(one[first:]) for one in frames]).astype(np.int64)
        told = np.concatenate([chunks, np.zeros_like(chunks[:, :1])], axis=1)[:, first:]
        known = torch.ones(told.shape[:2], dtype=torch.bool)
        wanted = world.model.predict_actions(torch.from_numpy(tokens), ROBOT, torch.from_numpy(told), known)
        given = []
        for _ in range(stride):
            given.append(checked("it", policy, arena))
            arena.step(given[-1])
        made = np.stack(given, axis=1)
        said = wanted[:, -1].numpy().reshape(made.shape)
        said = said if spec.seen is None else np.clip(said, spec.low, spec.high)
        np.testing.assert_allclose(made, said, atol=1e-3)
        frames = np.concatenate([frames, arena.images[:, None]], axis=1)
        chunks = np.concatenate([chunks, made.reshape(2, 1, -1)], axis=1)
    assert not np.allclose(given[0], given[0][:1])  # the scenes differ, and so do the actions


def test_what_it_imagines_ahead_is_forgotten() -> None:
    scenes = Scenes.of(actor("full"), ROBOT, 2, 0)
    runs = []
    for horizon in (1, 3):
        world, arena = actor("full"), TrueArena(scenes, 128)
        policy = Acting(world, scenes, horizon)
        begin("it", policy, arena)
        runs.append([])
        for _ in range(3 * scenes.stride):
            action = checked("it", policy, arena)
            runs[-1].append(action)
            arena.step(action * 0)
            policy.follower._taken[-1] = action * 0  # both do the same, whatever they say
    runs[0], runs[1] = ([np.stack(part) for part in np.array_split(one, 3)] for one in runs)
    np.testing.assert_allclose(runs[0][0], runs[1][0], atol=1e-3)
    assert not np.allclose(runs[0][1], runs[1][1], atol=1e-3)  # of an imagined image, not of the true one


def test_it_acts_in_a_world_model_too() -> None:
    world = actor("full")
    true = TrueArena(Scenes.of(world, ROBOT, 2, 0), 128)
    arena, policy = ModelArena(world, true, None), Acting(actor("full"), true.scenes)
    begin("it", policy, arena)
    for _ in range(2 * arena.scenes.stride):
        arena.step(checked("it", policy, arena))
    arena.close()


def test_models_that_cannot_act_and_unknown_options_are_refused() -> None:
    world, scenes = actor(), Scenes.of(actor(), ROBOT, 1, 0)
    with pytest.raises(HMAError, match="was not trained to act, but for forward — train one"):
        Acting(world, scenes)
    with pytest.raises(UsageError, match="predicts no video, so it cannot look ahead"):
        Acting(actor("policy"), scenes, horizon=2)
    with pytest.raises(UsageError, match="horizon=0 is not allowed — give 1 or more"):
        Acting(actor("full"), scenes, horizon=0)
    with pytest.raises(UsageError, match="'speed=2' is unknown — allowed: horizon="):
        read_policy("hma:runs/policy,speed=2", scenes)
    with pytest.raises(HMAError, match="no/such run"):
        read_policy("hma:no/such run", scenes)


def test_a_policys_module_may_extend_the_path_of_modules(tmp_path, monkeypatch):
    (tmp_path / "own_policy.py").write_text("import sys\nsys.path.insert(0, 'theirs')\nact = len\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    read_policy("own_policy:act", Scenes.of(actor("policy"), ROBOT, 1, 0))
    assert sys.path[0] == "theirs" and str(Path.cwd()) not in sys.path


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
    for words in ("lerobot:someone/somewhere", "scripted:noise=0.5", "random", "plan:cem,horizon=2"):
        assert policy_facts(words, "arm") == {}  # known by their words


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


# -- where a policy and its world compute


class Asked(Exception):
    """A world was asked for."""


@pytest.mark.parametrize(
    ("module", "words", "options"),
    [
        (scores, ["policy-eval", "rails_03", "random", "still"], ["--precision", "bf16", "--compile"]),
        (augment, ["augment", "rails_03", "made"], ["--precision", "bf16", "--compile"]),
        (labels, ["label-actions", "film", "--checkpoint", "run", "-e", "rails_03", "--out", "made"], []),
    ],
)
def test_device_and_precision_reach_the_world(module, words, options, monkeypatch, tmp_path) -> None:
    def load(checkpoint: str, robots: list[str], **given: Any) -> World:
        raise Asked(given["device"], given.get("precision"), given.get("compile"))

    monkeypatch.chdir(tmp_path)
    (tmp_path / "film").mkdir()
    (tmp_path / "film" / "a.mp4").touch()  # film is looked for before the world is loaded
    monkeypatch.setattr("hma_model.training.runtime.choose_device", lambda name: f"chosen {name}")
    monkeypatch.setattr(module, "load_world", load)
    with pytest.raises(Asked) as said:
        main(["--debug", *words, *options, "--device", "cuda:1"])
    assert said.value.args == ("chosen cuda:1", *(("bf16", True) if options else (None, None)))


def test_a_device_that_is_not_here_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["augment", "rails_03", str(tmp_path / "made"), "--device", "warp"]) == 2
    assert "--device" in capsys.readouterr().err and not (tmp_path / "made").exists()


def test_a_model_that_acts_is_on_the_device_of_its_world(world, monkeypatch) -> None:
    asked: list[str] = []

    def load(checkpoint: str, robots: list[str], **given: Any) -> World:
        asked.append(given["device"])
        return world

    monkeypatch.setattr(acting, "load_world", load)
    monkeypatch.setattr(acting, "Acting", lambda *given: given)
    read_policy("hma:run", Scenes.of(world, "rails_03", 1, 0), world)
    assert asked == [str(world.model.device)]
