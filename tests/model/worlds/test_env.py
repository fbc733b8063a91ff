"""The world model as gymnasium environments: checked by gymnasium, and against the world itself."""

import re
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import av
import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import RecordVideo

from hma_data.errors import HMAError
from hma_data.tokenizers.base import reopened
from hma_model.generation.commands import OutsideRangeWarning
from hma_model.network.model import HMA
from hma_model.simulate import World, WorldModelEnv, WorldModelVectorEnv, starting_window

PUSH = "pusht_fast"


@pytest.fixture(scope="module")
def model() -> HMA:
    return HMA.from_pretrained("embedded", [PUSH])


@pytest.fixture(scope="module")
def window(model: HMA) -> tuple[Any, Any]:
    return starting_window(model, PUSH)


@pytest.fixture
def world(model: HMA) -> World:
    return World(model, reopened(model.config.tokenizer))


def prompt(window: tuple[Any, Any]) -> dict[str, Any]:
    return {"frames": window[0], "chunks": window[1]}


@pytest.fixture
def how(world: World, window: tuple[Any, Any]) -> dict[str, Any]:
    return {"embodiment": PUSH, "world": world, "prompt": prompt(window)}


def actions(count: int, *shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(60, 450, (count, *shape, 2)).astype(np.float32)


@pytest.mark.filterwarnings("ignore")  # of a space that is not from -1 to 1
@pytest.mark.parametrize("control", ["frame", "chunk"])
def test_gymnasium_finds_nothing_wrong(control: str, window: tuple[Any, Any]) -> None:
    env = gymnasium.make(
        "hma/WorldModel-v0", checkpoint="embedded", embodiment=PUSH, prompt=prompt(window), control=control,
        horizon=5, render_mode="rgb_array",
    )  # fmt: skip
    check_env(env.unwrapped, skip_close_check=True)
    assert env.metadata["render_fps"] == (10 if control == "frame" else 5)
    assert env.unwrapped.action_names == ("x", "y")  # type: ignore[attr-defined]
    low, high = env.action_space.low, env.action_space.high  # type: ignore[attr-defined]
    assert low.shape == ((2,) if control == "frame" else (2, 2)) and (low == 0).all() and (high == 512).all()
    env.close()


@pytest.mark.parametrize("control", ["frame", "chunk"])
def test_steps_show_what_the_world_shows(world, window, how, control: str) -> None:
    env = WorldModelEnv(**how, control=control, horizon=4, render_mode="rgb_array")
    first, _ = env.reset(seed=3)
    chunks = actions(2, 2)
    session = world.open(PUSH, *window, seed=world._sessions[env.session].seed)  # type: ignore[index]
    assert np.array_equal(first, world.image(session))
    made = [world.step({session: chunk})[session] for chunk in chunks]
    seen = [env.step(action) for action in (chunks if control == "chunk" else chunks.reshape(-1, 2))]
    images = [image for image, *_ in seen]
    if control == "frame":  # an image comes with every second action; the last one is shown between
        assert all(np.array_equal(image, first) for image in images[:1])
        assert all(np.array_equal(image, made[0]) for image in images[1:3])
        images = [images[1], images[3]]
        assert [truncated for *_, truncated, _ in seen] == [False] * 3 + [True]
    assert all(np.array_equal(a, b) for a, b in zip(images, made, strict=True))
    assert np.array_equal(env.render(), made[-1])  # type: ignore[arg-type]


def test_a_judge_sees_the_episode_and_ends_it(how: dict[str, Any]) -> None:
    shapes = []

    def judge(images: np.ndarray, actions: np.ndarray) -> tuple[float, bool]:
        shapes.append((images.shape, actions.shape))
        return float(actions[-1, 0, 0]), len(actions) == 2

    env = WorldModelEnv(**how, control="chunk", judge=judge)
    chunks = actions(2, 2)
    for _ in range(2):
        env.reset(seed=0)
        assert env.step(chunks[0])[1:4] == (chunks[0, 0, 0], False, False)
        assert env.step(chunks[1])[1:4] == (chunks[1, 0, 0], True, False)
    assert shapes == [((2, 64, 64, 3), (1, 2, 2)), ((3, 64, 64, 3), (2, 2, 2))] * 2


@pytest.mark.parametrize(
    "mode", [AutoresetMode.NEXT_STEP, pytest.param(AutoresetMode.SAME_STEP, marks=pytest.mark.slow)]
)
def test_a_vector_steps_as_gymnasium_steps_environments_one_by_one(model, window, mode) -> None:
    def judge(images: np.ndarray, actions: np.ndarray) -> tuple[float, bool]:
        return float(images[-1].mean()), bool(actions[-1, 0, 0] > 300)  # episodes end at different steps

    tokenizer = reopened(model.config.tokenizer)
    how: dict[str, Any] = {
        "embodiment": PUSH, "prompt": prompt(window), "control": "chunk", "horizon": 4, "judge": judge,
        "world": World(model, tokenizer, temperature=0.5),
    }  # fmt: skip
    ours = WorldModelVectorEnv(3, autoreset_mode=mode, **how)
    theirs = SyncVectorEnv([lambda: WorldModelEnv(**how)] * 3, autoreset_mode=mode)
    assert ours.observation_space == theirs.observation_space and ours.action_space == theirs.action_space
    found = [env.reset(seed=5) for env in (ours, theirs)]
    assert np.array_equal(found[0][0], found[1][0])
    ends = 0
    for action in actions(8, 3, 2):
        mine, other = (env.step(action) for env in (ours, theirs))
        assert all(np.array_equal(a, b) for a, b in zip(mine[:4], other[:4]))
        assert mine[4].keys() == other[4].keys()
        for i in np.flatnonzero(mine[4].get("_final_obs", np.zeros(3))):
            assert np.array_equal(mine[4]["final_obs"][i], other[4]["final_obs"][i])
        ends += int((mine[2] | mine[3]).sum())
    assert 3 < ends < 24


def test_a_vector_without_autoreset_starts_those_that_are_asked_for(how: dict[str, Any]) -> None:
    env = WorldModelVectorEnv(2, **how, control="chunk", horizon=2, autoreset_mode="Disabled")
    first, _ = env.reset(seed=0)
    chunks = actions(3, 2, 2)
    env.step(chunks[0])
    mask = np.array([True, False])
    again, _ = env.reset(seed=0, options={"reset_mask": mask})
    assert np.array_equal(again[0], first[0]) and not np.array_equal(again[1], first[1])
    assert env.step(chunks[1])[3].tolist() == [False, True]
    with pytest.raises(HMAError, match=r"the episodes of \[1\] have ended"):
        env.step(chunks[2])
    made = gymnasium.make_vec("hma/WorldModel-v0", 2, "vector_entry_point", **how)
    assert isinstance(made, WorldModelVectorEnv) and made.reset()[0].shape == (2, 64, 64, 3)


def test_a_policy_of_gym_pusht_runs_unchanged(world: World) -> None:
    import gym_pusht  # noqa: F401

    def policy(image: np.ndarray) -> np.ndarray:
        y, x = np.unravel_index(image.sum(axis=-1).argmin(), image.shape[:2])
        return (np.array([x, y]) * (512 / len(image))).astype(np.float32)

    def run(env: gymnasium.Env) -> list[np.ndarray]:
        image, _ = env.reset(seed=1)
        seen = [image]
        for _ in range(8):
            image, *_ = env.step(policy(image))
            seen.append(image)
        return seen

    real = gymnasium.make("gym_pusht/PushT-v0", obs_type="pixels", render_mode="rgb_array")
    dreamt = WorldModelEnv(embodiment=PUSH, world=world, prompt=real, size=96)
    assert dreamt.action_space == real.action_space and dreamt.observation_space == real.observation_space
    images = [run(env) for env in (real, dreamt)]
    assert all(seen[0].shape == (96, 96, 3) for seen in images)
    moved = [np.abs(seen[-1].astype(int) - seen[0]).mean() for seen in images]
    assert min(moved) > 0.1 and np.abs(images[0][0].astype(int) - images[1][0]).mean() < 12


def test_gymnasium_records_a_film_of_the_images(how, tmp_path) -> None:
    env: Any = WorldModelEnv(**how, control="chunk", horizon=2, render_mode="rgb_array")
    env = RecordVideo(env, str(tmp_path), episode_trigger=lambda number: True)
    env.reset(seed=0)
    images = [env.step(chunk)[0] for chunk in actions(2, 2)]
    env.close()
    with av.open(tmp_path / "rl-video-episode-0.mp4") as film:
        frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
        assert film.streams.video[0].average_rate == 5 and len(frames) == 3
    assert np.abs(np.stack(frames[1:]) - np.stack(images).astype(float)).mean() < 6


def test_actions_outside_the_training_range_warn_once_and_are_clipped_only_if_asked(world, how) -> None:
    wild, edge = np.full((2, 2), 700.0), np.tile(world.action_spec(PUSH).seen[1], (2, 1))  # type: ignore[index]
    how["control"] = "chunk"
    free, clipped, at_edge = (WorldModelEnv(**how, clip=clip) for clip in (False, True, False))
    for env in (free, clipped, at_edge):
        env.reset(seed=0)
    with pytest.warns(UserWarning, match=r"x 15 to 497, y 15 to 497"):
        free.step(wild)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        free.step(wild)
        images = [clipped.step(wild)[0], at_edge.step(edge)[0]]
    assert np.array_equal(*images)


def test_an_unknown_action_is_nan(world: World, window: tuple[Any, Any], how: dict[str, Any]) -> None:
    env = WorldModelEnv(**how)
    env.reset(seed=0)
    session = world.open(PUSH, *window, seed=world._sessions[env.session].seed)  # type: ignore[index]
    one = np.array([300.0, 200.0])
    for action in (one, np.full(2, np.nan)):
        image, *_ = env.step(action)
    assert np.array_equal(image, world.step({session: np.full(4, np.nan)})[session])


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(3), r"has the shape \(3,\) — give \(2,\): x, y"),
        (np.array([np.nan, 1.0]), "not finite"),
        (np.array([np.inf, 1.0]), "not finite"),
    ],
)
def test_bad_actions_are_refused_and_the_episode_goes_on(how, action, message) -> None:
    env = WorldModelEnv(**how)
    with pytest.raises(HMAError, match=re.escape("call reset() first")):
        env.step(np.zeros(2))
    env.reset()
    with pytest.raises(HMAError, match=message):
        env.step(action)
    env.step(np.array([100.0, 100.0]))


def test_an_action_that_is_refused_leaves_no_environment_of_a_vector_ahead(how: dict[str, Any]) -> None:
    envs = WorldModelVectorEnv(2, **how)
    envs.reset(seed=1)
    given = actions(4, 2)
    envs.step(given[0])
    bad = given[1].copy()
    bad[1] = np.inf
    with pytest.raises(HMAError, match="not finite"):
        envs.step(bad)
    for count in (1, 3):
        with pytest.raises(HMAError, match=f"has {count} actions — give 2, one per environment"):
            envs.step(np.resize(given[1], (count, *given[1].shape[1:])))
    frames = [envs.step(action)[4]["frames"].tolist() for action in given[1:]]
    assert frames == [[1, 1], [1, 1], [2, 2]]  # both get their image after two actions


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"embodiment": None}, "embodiment: is not given — give embodiment=ID; the model has: pusht_fast"),
        ({"embodiment": "ur5"}, "ur5: is not in the model"),
        ({"control": "second"}, "'second' is unknown — give frame or chunk"),
        ({"size": 0}, "size: is 0 — give a whole number of pixels"),
        ({"size": 64.5}, "size: is 64.5 — give a whole number of pixels"),
        ({"horizon": 0}, "horizon: is 0 — give a whole number of steps"),
        ({"horizon": "3"}, "horizon: is '3' — give a whole number of steps"),
    ],
)
def test_bad_settings_are_refused(world: World, change: dict[str, Any], message: str) -> None:
    with pytest.raises(HMAError, match=message):
        WorldModelEnv(**{"embodiment": PUSH, "world": world, **change})


@pytest.mark.parametrize("count", [0, 1.5])
def test_a_vector_of_no_whole_number_of_environments_is_refused(world: World, count: Any) -> None:
    with pytest.raises(HMAError, match=f"num_envs: is {count} — give a whole number of 1 or more"):
        WorldModelVectorEnv(count, embodiment=PUSH, world=world)


def test_an_option_of_a_reset_that_would_have_no_effect_is_refused(world: World) -> None:
    with pytest.raises(HMAError, match="reset: there is no option 'promt' — it takes prompt"):
        WorldModelEnv(embodiment=PUSH, world=world).reset(options={"promt": {}})


def test_the_examples_of_the_page_run_without_a_warning() -> None:
    page = (Path(__file__).parents[3] / "docs/environment.md").read_text()
    first, by_hand = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        exec(first, {})
        exec(by_hand, {})
    assert [str(one.message) for one in warned] == []
    with pytest.warns(OutsideRangeWarning, match="x 15 to 497, y 15 to 497"):
        exec(first.replace(", clip=True", "").replace("env.action_space.sample()", "[0, 512]"), {})


@pytest.mark.slow
def test_forked_environments_step_though_torch_has_threads() -> None:
    program = """
import gymnasium, torch, hma_model.simulate
torch.set_num_threads(2)
torch.ones(2000, 2000) @ torch.ones(2000, 2000)  # starts the pool, which no fork takes along
env = gymnasium.make_vec("hma/WorldModel-v0", 2, "async", embodiment="rails_03")
env.reset(seed=0)
print(env.step(env.action_space.sample())[0].shape)
env.close()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=280)
    assert done.stdout.strip() == "(2, 64, 64, 3)", done.stderr
