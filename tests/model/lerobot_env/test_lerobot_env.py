"""A world model is an environment of lerobot's evaluation; what does not fit ends in one line."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.scripts.lerobot_eval import eval_main

from hma_data.errors import HMAError, UsageError
from hma_data.lab import family
from hma_data.shards.reader import ShardSet
from hma_data.sources.lerobot.writer import origin_of
from hma_data.tokenizers.base import get_tokenizer
from hma_model import lerobot_env
from hma_model.checkpoint.folder import Checkpoint
from hma_model.checkpoint.io import save
from hma_model.hub import push
from hma_model.lerobot_env import HMAEnvConfig, vector
from hma_model.lerobot_env.acting import WorldModelConfig, WorldModelPolicy
from hma_model.policies.acting import Acting
from hma_model.policies.arenas import Scenes, TrueArena
from hma_model.policies.base import begin, checked
from hma_model.worlds.world import World
from tests.data import cameras as three
from tests.hub_server import Hub
from tests.hub_state import REPO
from tests.model.policies.test_lerobot_policy import CAMERA, saved
from tests.model.shards import make_shards
from tests.model.true_world import tiny_model, trained_on

pytestmark = pytest.mark.slow  # of the import of lerobot
pytest_plugins = ["tests.hub_fixtures"]
ROBOT = "rails_03"
RENAME = "--rename_map=" + json.dumps({"observation.image": CAMERA})
IMAGE = np.full((64, 64, 3), 90, np.uint8)


class Certain:
    held_out, readable, std, error = (), np.arange(2), np.ones(2), np.full(2, 0.5)

    def read(self, pictures: np.ndarray) -> np.ndarray:
        return pictures.reshape(len(pictures), -1)[:, :2].astype(float)

    def success(self, score: float) -> bool:
        return score >= 2

    def __call__(self, images: np.ndarray, actions: np.ndarray) -> tuple[float, bool]:
        return float(len(images) * (actions[0, 0, 0] > 0)), False


@pytest.fixture
def env(monkeypatch: pytest.MonkeyPatch, world: World) -> vector.LeRobotVectorEnv:
    monkeypatch.setattr(vector, "state_source", lambda *_: lambda world, tell: Certain())
    monkeypatch.setattr(vector.LeRobotVectorEnv, "reader", Certain())
    monkeypatch.setattr(vector.LeRobotVectorEnv, "judge", Certain())
    return vector.LeRobotVectorEnv(
        Checkpoint.open("embedded"),
        ROBOT,
        2,
        world,
        judge="reached",
        horizon=10,
        task="reach it",
        prompt=IMAGE,
    )


def test_observations_are_what_lerobot_reads(env: vector.LeRobotVectorEnv) -> None:
    from lerobot.envs.utils import preprocess_observation

    seen, _ = env.reset(seed=[3, 4], options={"lerobot_new_rollout": True})
    assert env.observation_space.contains(seen) and seen["pixels"].dtype == np.uint8
    assert set(preprocess_observation(seen)) == {
        "observation.image", "observation.state", "observation.synthetic"
    }  # fmt: skip
    assert env.call("_max_episode_steps") == (10, 10) and env.call("task_description") == ("reach it",) * 2
    assert [one.shape for one in env.call("render")] == [env.world.image_shape] * 2
    assert isinstance(env.unwrapped.metadata["render_fps"], int)
    np.testing.assert_array_equal(env.reset(seed=[3, 4])[0]["pixels"], seen["pixels"])


def test_an_episode_that_has_ended_stays_as_it_is(env, monkeypatch) -> None:
    env.reset(seed=[0, 1])
    dreamed: list[int] = []
    step = env.world.step
    monkeypatch.setattr(env.world, "step", lambda given: dreamed.append(len(given)) or step(given))
    actions = np.array([[1, 0], [-1, 0]], np.float32)
    stride = env.envs[0].action_spec.stride
    for _ in range(stride):
        seen, rewards, terminated, truncated, info = env.step(actions)
    assert info["is_success"].tolist() == terminated.tolist() == [True, False] and rewards.tolist() == [2, 0]
    for _ in range(10 - stride):
        later, rewards, terminated, truncated, info = env.step(actions)
    np.testing.assert_array_equal(later["pixels"][0], seen["pixels"][0])
    assert max(dreamed[stride:]) == 1 and rewards[0] == 0
    assert truncated.tolist() == [False, True] and info["is_success"].tolist() == [True, False]
    env.reset(options={"reset_mask": np.array([False, True])})
    _, _, _, truncated, info = env.step(actions)
    assert info["is_success"].tolist() == [True, False] and not truncated.any() and info["frames"][0] == 1
    assert not env.reset()[1].get("is_success") and not env.ended.any()


def test_the_reward_before_the_first_frame_is_the_score_of_the_start(env, monkeypatch) -> None:
    class Distance(Certain):
        def score(self, images: np.ndarray) -> np.ndarray:
            assert images.shape == (2, 1, *env.world.image_shape)
            return np.array([-7.0, -5.0])

    monkeypatch.setattr(vector.LeRobotVectorEnv, "judge", Distance())
    monkeypatch.setattr(vector, "StateJudge", Distance)
    env.reset(seed=[0, 1])
    assert env.step(np.zeros((2, 2), np.float32))[1].tolist() == [-7, -5]


def test_features_are_read_from_the_checkpoint() -> None:
    config = HMAEnvConfig(embodiment=ROBOT)
    assert config.features["action"].shape == (2,) and config.features["agent_pos"].shape == (2,)
    assert config.features_map["pixels"] == "observation.image" and config.task == ROBOT
    assert "agent_pos" not in HMAEnvConfig(embodiment=ROBOT, state=False).features


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({}, "embodiment: is not given — give --env.embodiment=ID; the model has: arm1_02"),
        ({"embodiment": "nobody"}, "embedded-fsq: has no embodiment 'nobody'"),
        ({"embodiment": ROBOT, "judge": "liked"}, "judge: 'liked' is not a task"),
        ({"embodiment": ROBOT, "horizon": 4}, "horizon: is 4 — give 5 or more, the actions of one frame"),
    ],
)
def test_settings_that_are_wrong(given: dict[str, Any], said: str) -> None:
    with pytest.raises(HMAError) as fault:
        HMAEnvConfig(**given)
    assert str(fault.value).startswith(said) and "\n" not in str(fault.value)


def test_a_robot_without_a_start_is_refused_before_anything_is_trained(tmp_path, monkeypatch) -> None:
    shards = ShardSet(make_shards(tmp_path / "shards", "twist_arm", spec=get_tokenizer("fsq-8").spec))
    trained_on("first", shards, tmp_path / "model")
    config = HMAEnvConfig(checkpoint=str(tmp_path / "model"), embodiment="twist_arm")
    monkeypatch.setattr(lerobot_env, "made", lambda *given: pytest.fail("environments were made"))
    with pytest.raises(HMAError, match="prompt of twist_arm: none is included"):
        config.create_envs(1)


@pytest.mark.parametrize(
    ("inputs", "rename", "state", "said"),
    [
        ({}, "", True, rf"takes {CAMERA} \(.*\), and {ROBOT} gives action \(2,\), observation.image \("),
        ({"state": 2}, RENAME, False, r"takes observation.state \(2,\), and .* --env.state=true"),
        ({"actions": 3}, RENAME, True, rf"takes action \(3,\), and {ROBOT} gives action \(2,\)"),
    ],
)  # fmt: skip
def test_a_policy_that_does_not_fit(inputs, rename, state, said, tmp_path, monkeypatch) -> None:
    saved(tmp_path, **inputs)
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", f"--policy.path={tmp_path}", rename])
    with pytest.raises(SystemExit, match=f"error: policy .*{said}") as fault:
        HMAEnvConfig(embodiment=ROBOT, state=state).create_envs(1)
    assert "\n" not in str(fault.value)


def test_a_published_checkpoint_makes_environments(server: Hub) -> None:
    from lerobot.envs.factory import make_env

    push("embedded", REPO, [ROBOT])
    envs = make_env(REPO, n_envs=2, use_async_envs=True, trust_remote_code=True)
    assert list(envs) == [ROBOT] and envs[ROBOT][0].num_envs == 2


def test_a_published_checkpoint_draws_frames_as_its_configuration_says() -> None:
    file = Checkpoint.open("embedded", [ROBOT]).folder / "env.py"
    given = SimpleNamespace(embodiment=ROBOT, unmask_steps=1, temperature=0.5)
    drawn = lerobot_env.published_envs(str(file), None, 1, given)[ROBOT][0].world.decoding
    assert (drawn.unmask_steps, drawn.temperature) == (1, 0.5)


def test_a_repository_is_loaded_in_the_revision_of_its_file(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def located(source: str, names: Any) -> Any:
        asked.append(source)
        raise HMAError(source, "seen")

    monkeypatch.setattr(lerobot_env, "located", located)
    with pytest.raises(HMAError):
        lerobot_env.published_envs("/cache/models--org--m/snapshots/abc/env.py", "org/m", 1)
    assert asked == ["org/m@abc"]


def test_how_far_a_training_is_is_logged_from_time_to_time(monkeypatch, caplog) -> None:
    clock = iter([0.0, 5.0, 25.0, 25.0, 30.0])
    monkeypatch.setattr(vector.time, "monotonic", lambda: next(clock))
    tell = vector.progress_log(ROBOT)
    for step in range(3):
        tell(f"step {step + 1} of 3")
    assert caplog.messages == [f"{ROBOT}: step 2 of 3"]


@pytest.fixture
def evaluates(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Run lerobot-eval with two episodes in a model of a robot whose state is read at once."""
    monkeypatch.setattr(vector, "state_source", lambda *_: lambda world, tell: Certain())

    def run(*words: str) -> dict[str, Any]:
        own = [
            "--env.type=hma", f"--env.embodiment={ROBOT}", "--env.horizon=10", "--policy.device=cpu",
            "--env.discover_packages_path=hma_model.lerobot_env", "--eval.n_episodes=2",
            "--eval.batch_size=2", f"--output_dir={tmp_path / 'out'}",
        ]  # fmt: skip
        monkeypatch.setattr(sys, "argv", ["lerobot-eval", *own, *words])
        eval_main()
        return json.loads((tmp_path / "out" / "eval_info.json").read_text())

    return run


def test_lerobot_eval_and_its_recording(tmp_path: Path, evaluates: Any, caplog) -> None:
    saved(tmp_path / "policy", state=2)
    info = evaluates(f"--policy.path={tmp_path / 'policy'}", "--eval.recording=true", RENAME)
    assert "agent_pos is estimated from the images: 2 of 2 values, mean error on other" in caplog.text
    assert info["overall"]["n_episodes"] == 2 and info["overall"]["pc_success"] == 0
    recorded = tmp_path / "out" / "recordings" / "hma_0" / "env_0"
    facts = json.loads((recorded / "meta" / "info.json").read_text())
    assert facts["total_frames"] == 10 and facts["fps"] == HMAEnvConfig(embodiment=ROBOT).fps
    assert {"pixels", "agent_pos", "action", "synthetic", "next.success"} <= facts["features"].keys()
    assert origin_of(recorded.joinpath) == {"by": "lerobot-eval", "synthetic": True}
    assert "no judge is given, so pc_success will be 0" in caplog.text


# -- policies


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return acting_saved(tmp_path / "run", "policy")


def acting_saved(folder: Path, *objectives: str) -> Path:
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


def test_chunks_asked_for_at_once_are_the_actions_given_one_by_one(run: Path) -> None:
    one, whole = (WorldModelPolicy(WorldModelConfig(checkpoint=str(run), device="cpu")) for _ in range(2))
    rng = np.random.default_rng(0)
    for seen in rng.integers(0, 256, (3, 2, 128, 128, 3), np.uint8):
        given = whole.predict_action_chunk(batch(seen))
        wanted = [one.select_action(batch(seen)) for _ in range(given.shape[1])]
        assert torch.equal(given, torch.stack(wanted, dim=1))


def test_it_sees_each_of_its_cameras_as_in_a_conversion(tmp_path: Path) -> None:
    shards: Any = SimpleNamespace(spec=get_tokenizer("fsq-8").spec, embodiment=three.arm())
    trained_on(["side", "wrist"], shards, tmp_path / "model", "policy")
    policy = WorldModelPolicy(WorldModelConfig(checkpoint=str(tmp_path / "model"), device="cpu"))
    side, wrist = np.full((1, 64, 96, 3), 50, np.uint8), np.full((1, 32, 32, 3), 90, np.uint8)
    seen = batch(side, "observation.images.side") | batch(wrist, "observation.images.wrist")
    shown = policy._images(seen)[0]
    assert shown.shape[1] == 2 * shown.shape[0]
    assert (shown[:, : len(shown)] == 50).all() and (shown[:, len(shown) :] == 90).all()
    assert policy.select_action(seen).shape == (1, 2)


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
    acting_saved(tmp_path / "dreams")
    with pytest.raises(HMAError, match="was not trained to act"):
        WorldModelPolicy(WorldModelConfig(checkpoint=str(tmp_path / "dreams"), device="cpu"))


def test_its_folder_as_the_path_of_a_policy_is_told_the_way_that_works(run, monkeypatch) -> None:
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", f"--policy.path={run}"])
    told = f"error: --policy.path: is a checkpoint .* give --policy.type=hma --policy.checkpoint={run}"
    with pytest.raises(SystemExit, match=told):
        HMAEnvConfig(embodiment=ROBOT)


def test_lerobot_eval_runs_it(run: Path, evaluates: Any) -> None:
    info = evaluates("--policy.type=hma", f"--policy.checkpoint={run}", "--env.state=false")
    assert info["overall"]["n_episodes"] == 2
