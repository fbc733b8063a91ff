"""Plans: what candidates lead to is what a session sees, and solvers move a dot to its goal."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from hma_data.errors import UsageError
from hma_data.tokenizers.base import get_tokenizer
from hma_model.policies.arenas import Scenes, TrueArena
from hma_model.policies.base import begin, checked
from hma_model.policies.catalog import read_policy
from hma_model.policies.planning import Cost, Planning, goal_distance
from hma_model.simulate import World
from tests.model.true_world import tiny_model

ROBOT, SIDE = "rails_03", 64


def test_imagined_images_are_those_of_sessions_that_take_the_actions() -> None:
    world = World(tiny_model(ROBOT), get_tokenizer("fsq-8"), unmask_steps=1, temperature=0.0)
    arena = TrueArena(Scenes.of(world, ROBOT, 2, 0), 128)
    cost = Cost(world, ROBOT)
    cost.open([(prompt.frames, prompt.chunks) for prompt in arena.prompts])
    candidates = np.random.default_rng(0).normal(size=(2, 3, 2, 2)).astype(np.float32)
    images = cost.imagine(cost.sessions, candidates)
    assert images.shape == (2, 3, 2, 128, 128, 3)
    actions = cost.actions(candidates)
    for scene, session in enumerate(cost.sessions):
        kept = world.snapshot(session)
        for candidate in range(3):
            world.restore(session, kept)
            for ahead in range(2):
                made = world.step({session: actions[scene, candidate, ahead]})[session]
                np.testing.assert_array_equal(images[scene, candidate, ahead], made)


class DotWorld:
    """A world whose image shows a dot, which actions move."""

    def __init__(self) -> None:
        space = SimpleNamespace(mean=(0.0, 0.0), std=(4.0, 4.0))
        self.model: Any = SimpleNamespace(embodiments={"dot": space})
        self.at: dict[int, np.ndarray] = {}

    def action_spec(self, embodiment: str) -> Any:
        low, high = np.full(2, -8.0, np.float32), np.full(2, 8.0, np.float32)
        return SimpleNamespace(
            names=("x", "y"), stride=1, low=low, high=high, clip=lambda x: x.clip(low, high)
        )

    def open(self, embodiment: str, frames: Any, chunks: Any, seed: int) -> int:
        self.at[len(self.at)] = np.argwhere(np.asarray(frames)[-1, ..., 0])[:, ::-1].mean(axis=0)
        return len(self.at) - 1

    def close(self, session: int) -> None:
        del self.at[session]

    def fork(self, sessions: Any, n: int) -> "DotWorld":
        other = DotWorld()
        other.at = dict(enumerate(self.at[session] for session in sessions for _ in range(n)))
        return other

    def step(self, actions: Any, *, decoded: bool = True) -> dict[int, np.ndarray]:
        for session, chunk in actions.items():
            self.at[session] = (self.at[session] + chunk[0]).clip(6, SIDE - 6)
        return {session: self.image(session) for session in actions}

    def image(self, session: int) -> np.ndarray:
        x, y = self.at[session].round().astype(int)
        made = np.zeros((SIDE, SIDE, 3), np.uint8)
        made[y - 5 : y + 6, x - 5 : x + 6] = 255
        return made


def dots(*places: tuple[int, int]) -> torch.Tensor:
    world = DotWorld()
    world.at = {number: np.array(place) for number, place in enumerate(places)}
    return torch.from_numpy(np.stack([world.image(number)[None] for number in world.at]))


def test_the_distance_from_a_goal_is_least_at_the_goal() -> None:
    shown = dots((20, 20), (28, 20), (40, 40)).numpy()[:, 0]
    far = goal_distance(shown[None], shown[:1])[0]
    assert far[0] == 0 < far[1] < far[2]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["cem", "mppi"])
def test_a_solver_of_stable_worldmodel_finds_the_way(kind: str) -> None:
    pytest.importorskip("stable_worldmodel")
    from gymnasium.spaces import Box

    from hma_model.policies.planning import solver_of

    made, config = solver_of(kind)
    cost = Cost(DotWorld(), "dot")  # type: ignore[arg-type]
    solver = made(cost, num_samples=64, n_steps=4, topk=8, seed=0)
    box = Box(np.tile(cost.space.low, (2, 1)), np.tile(cost.space.high, (2, 1)))
    solver.configure(action_space=box, n_envs=2, config=config(3, 1))
    info = {"pixels": dots((20, 20), (40, 30)), "goal": dots((32, 24), (30, 40))}
    actions = solver(info)["actions"]
    ends = np.array([[20, 20], [40, 30]]) + cost.actions(actions.numpy())[:, :, 0].sum(axis=1)
    assert np.abs(ends - [[32, 24], [30, 40]]).max() < 4


@pytest.mark.slow
def test_a_plan_asks_the_judge_about_each_candidate() -> None:
    pytest.importorskip("stable_worldmodel")
    world = World(tiny_model(ROBOT), get_tokenizer("fsq-8"))
    arena = TrueArena(Scenes.of(world, ROBOT, 2, 0), 128)
    policy = read_policy("plan:cem,horizon=2,samples=8,steps=2,receding=1", arena.scenes, world)
    assert isinstance(policy, Planning)
    asked: list[tuple[int, ...]] = []

    class Judge:
        def score(self, images: np.ndarray) -> np.ndarray:
            asked.append(images.shape)
            return -images[:, -1].mean(axis=(1, 2, 3))

    policy.cost.judge = Judge()  # type: ignore[assignment]
    begin("plan", policy, arena)
    for _ in range(2 * arena.scenes.stride):
        arena.step(checked("plan", policy, arena))
    assert asked == [(16, 3, 128, 128, 3)] * 4


@pytest.mark.slow  # stable-worldmodel's import takes seconds
def test_words_that_are_no_plan_are_refused() -> None:
    pytest.importorskip("stable_worldmodel")
    world = World(tiny_model(ROBOT), get_tokenizer("fsq-8"))
    scenes = Scenes.of(world, ROBOT, 1, 0)
    with pytest.raises(UsageError, match="plan:fly: is no solver — choose from cem, icem, mppi"):
        read_policy("plan:fly", scenes, world)
    with pytest.raises(UsageError, match="'samples=many' is unknown"):
        read_policy("plan:cem,samples=many", scenes, world)
    with pytest.raises(UsageError, match="receding up to horizon"):
        Planning(world, scenes, horizon=2, receding=3)
