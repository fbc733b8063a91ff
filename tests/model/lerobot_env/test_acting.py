"""A model that was trained to act is a policy of lerobot's evaluation, and acts as in `hma policy-eval`."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors

from hma_data.errors import HMAError, UsageError
from hma_data.lab import family
from hma_data.tokenizers.base import get_tokenizer
from hma_model.checkpoint.io import save
from hma_model.lerobot_env import HMAEnvConfig
from hma_model.lerobot_env.acting import WorldModelConfig, WorldModelPolicy
from hma_model.policies.acting import Acting
from hma_model.policies.arenas import Scenes, TrueArena
from hma_model.policies.base import begin, checked
from hma_model.simulate import World
from tests.model.true_world import tiny_model

pytestmark = pytest.mark.slow  # of the import of lerobot
ROBOT = "rails_03"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return saved(tmp_path / "run", "policy")


def saved(folder: Path, *objectives: str) -> Path:
    robot = family.embodiment(ROBOT)
    stats = {"action": {"mean": [0.0] * robot.action_dim, "std": [30.0] * robot.action_dim}}
    save(
        tiny_model(ROBOT, *objectives), folder,
        embodiment_yaml={ROBOT: robot.to_yaml()}, stats={ROBOT: stats}, cards={},
    )  # fmt: skip
    return folder


def batch(images: np.ndarray, key: str = "observation.image") -> dict[str, torch.Tensor]:
    return {key: torch.from_numpy(images).permute(0, 3, 1, 2) / 255}


def test_it_gives_the_actions_of_the_same_model_in_policy_eval(run: Path) -> None:
    world = World(tiny_model(ROBOT, "policy"), get_tokenizer("fsq-8"))
    arena = TrueArena(Scenes.of(world, ROBOT, 2, 0), 128)
    arena.prompts = [type(one)(one.frames[-1:], one.chunks[:0]) for one in arena.prompts]
    own = Acting(world, arena.scenes)
    begin("it", own, arena)
    policy = WorldModelPolicy(WorldModelConfig(checkpoint=str(run), device="cpu"))
    for _ in range(3 * arena.scenes.stride):
        given = policy.select_action(batch(arena.images)).numpy()
        np.testing.assert_allclose(given, checked("it", own, arena), atol=1e-4)
        arena.step(given)
    policy.reset()
    assert not policy._sessions and not policy._taken


def test_chunks_asked_for_at_once_are_the_actions_given_one_by_one(run: Path) -> None:
    one, whole = (WorldModelPolicy(WorldModelConfig(checkpoint=str(run), device="cpu")) for _ in range(2))
    rng = np.random.default_rng(0)
    for seen in rng.integers(0, 256, (3, 2, 128, 128, 3), np.uint8):
        given = whole.predict_action_chunk(batch(seen))
        wanted = [one.select_action(batch(seen)) for _ in range(given.shape[1])]
        assert torch.equal(given, torch.stack(wanted, dim=1))
    one.select_action(batch(seen))
    whole.predict_action_chunk(batch(seen))
    last = [policy.predict_action_chunk(batch(seen)) for policy in (one, whole)]
    assert torch.equal(*last)  # what was left of a chunk counts as carried out


def test_lerobot_finds_it_and_its_processors_by_its_name(run: Path) -> None:
    assert get_policy_class("hma") is WorldModelPolicy
    config = PreTrainedConfig.get_choice_class("hma")(checkpoint=str(run), device="cpu")
    before, after = make_pre_post_processors(config)
    action = torch.tensor([[0.5, -2.0]])
    assert torch.equal(after(action), action)
    seen = before(batch(np.full((1, 8, 8, 3), 51, np.uint8)))
    assert float(seen["observation.image"].max()) == pytest.approx(0.2)


def test_what_does_not_fit_is_one_line(run: Path, tmp_path: Path) -> None:
    policy = WorldModelPolicy(WorldModelConfig(checkpoint=str(run), device="cpu"))
    with pytest.raises(UsageError, match=r"needs observation.image; .*observation.images.hand .*rename_map"):
        policy.select_action(batch(np.zeros((1, 8, 8, 3), np.uint8), "observation.images.hand"))
    with pytest.raises(UsageError, match="not by lerobot"):
        policy.forward({})
    three = {"action": PolicyFeature(FeatureType.ACTION, (3,))}
    with pytest.raises(UsageError, match="gives 2 values of action, the environment takes 3"):
        WorldModelPolicy(WorldModelConfig(checkpoint=str(run), device="cpu", output_features=three))
    saved(tmp_path / "dreams")
    with pytest.raises(HMAError, match="was not trained to act"):
        WorldModelPolicy(WorldModelConfig(checkpoint=str(tmp_path / "dreams"), device="cpu"))


def test_its_folder_as_the_path_of_a_policy_is_told_the_way_that_works(run, monkeypatch) -> None:
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", f"--policy.path={run}"])
    told = f"error: --policy.path: is a checkpoint .* give --policy.type=hma --policy.checkpoint={run}"
    with pytest.raises(SystemExit, match=told):
        HMAEnvConfig(embodiment=ROBOT)


def test_lerobot_eval_runs_it(run: Path, tmp_path: Path) -> None:
    found = subprocess.run(
        [
            sys.executable, "-m", "lerobot.scripts.lerobot_eval", "--policy.type=hma",
            f"--policy.checkpoint={run}", "--policy.device=cpu", "--env.type=hma",
            f"--env.embodiment={ROBOT}",
            "--env.discover_packages_path=hma_model.lerobot_env", "--env.horizon=10", "--env.state=false",
            "--eval.n_episodes=2", "--eval.batch_size=2", f"--output_dir={tmp_path / 'out'}",
        ],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert found.returncode == 0, found.stderr[-3000:]
    assert json.loads((tmp_path / "out" / "eval_info.json").read_text())["overall"]["n_episodes"] == 2
