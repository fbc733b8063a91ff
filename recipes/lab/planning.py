"""Let stable-worldmodel plan towards goal pictures in a world model, and score it in the true simulator.

    python recipes/lab/planning.py rails_03 --episodes 16

An episode begins like one of `hma policy-eval`. Its goal is a picture: what the simulator shows after
`--ahead` frames of the recorder's own driver. It is reached when every part of the robot that moves is within
`--near` px of where it is in that picture. stable-worldmodel's `World` runs the episodes, its
`WorldModelPolicy` looks and acts, its solver plans, and `Cost` of hma_model is the model that it plans in.
Its `RandomPolicy` is what to compare with. The environment gives a picture history; commands are in standard
deviations from their mean.
"""

import argparse
import contextlib
import io
import warnings
from typing import Any

import gymnasium
import numpy as np

from hma_data.console import run_script
from hma_data.lab import truth
from hma_model.policies.arenas import Scenes
from hma_model.policies.planning import ELITES, SOLVERS, Cost, solver_of
from hma_model.worlds.world import load_world

with warnings.catch_warnings():
    warnings.filterwarnings("ignore", "ale-py not found")  # solvers need no Atari games
    from stable_worldmodel import World
    from stable_worldmodel.policy import PlanConfig, RandomPolicy, WorldModelPolicy


class GoalEnv(gymnasium.Env[Any, Any]):
    """A laboratory robot in its simulator, with a picture to bring about; a step is a frame of the model."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, cost: Cost, scenes: Scenes, ahead: int, near: float, render_mode: str = "rgb_array"):
        self.cost, self.scenes, self.ahead, self.near = cost, scenes, ahead, near
        self.render_mode = render_mode
        self.action_space = cost.space
        self.observation_space = gymnasium.spaces.Box(0, 255, (128, 128, 3), np.uint8)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Begin the scene of a seed, and look where its recorder would go."""
        super().reset(seed=seed)
        number = self.scenes.numbers[(seed or 0) % len(self.scenes.numbers)]
        other = self.scenes.robot.scene(number)
        for _ in range(self.ahead):
            other.advance(None)
        self._driven, places = truth.parts_of(other.simulator.simulation)
        self._wanted, self._goal = places[: self._driven], other.simulator.picture()
        self._scene = self.scenes.robot.scene(number)
        self._seen = list(self._scene.prompt.frames)
        return self.render(), {"goal": self._goal, "history": self._history}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Hold a command for a chunk."""
        self._scene.advance(self.cost.commands(np.asarray(action, np.float32)).reshape(-1))
        self._seen.append(self._scene.simulator.picture())
        far = self.distance
        return self.render(), -far, far <= self.near, False, {"goal": self._goal, "history": self._history}

    @property
    def distance(self) -> float:
        """Return how far the robot's part that is furthest from its goal is, in px of 128."""
        places = truth.parts_of(self._scene.simulator.simulation)[1][: self._driven]
        return float(np.linalg.norm(places - self._wanted, axis=-1).max())

    @property
    def _history(self) -> Any:
        return np.stack(self._seen[-4:])

    def render(self) -> Any:
        """Return the newest picture."""
        return self._seen[-1]


class HistoryCost(Cost):
    """A cost that begins from the environment's picture history."""

    def get_cost(self, info_dict: dict[str, Any], action_candidates: Any) -> Any:
        history = info_dict["history"][:, :, 0]  # (N, C, 1, T, …): swm's time comes before ours
        return super().get_cost(info_dict | {"pixels": history}, action_candidates)


def main() -> None:
    """Score the solver and random commands in the same episodes."""
    parser = argparse.ArgumentParser(description="stable-worldmodel plans in a world model of hma")
    parser.add_argument("robot")
    parser.add_argument("--checkpoint", default="embedded")
    parser.add_argument("--solver", choices=SOLVERS, default="cem")
    parser.add_argument("--episodes", type=int, default=16)
    parser.add_argument("--ahead", type=int, default=6, help="frames from the beginning to the goal")
    parser.add_argument("--budget", type=int, default=12, help="frames of an episode")
    parser.add_argument("--near", type=float, default=8.0, help="px")
    parser.add_argument("--horizon", type=int, default=5)
    parser.add_argument("--samples", type=int, default=32)
    parser.add_argument("--steps", type=int, default=3)
    parser.add_argument("--seed", type=int, default=7, help="of the episodes")
    given = parser.parse_args()
    world = load_world(given.checkpoint, [given.robot], unmask_steps=1, temperature=0.0)
    cost = HistoryCost(world, given.robot)
    scenes = Scenes.of(world, given.robot, given.episodes, given.seed)
    own = {"cost": cost, "scenes": scenes, "ahead": given.ahead, "near": given.near}
    gymnasium.register("hma/Goal-v0", entry_point=GoalEnv)
    made, _ = solver_of(given.solver)
    solver = made(
        cost, batch_size=max(1, 128 // given.samples), num_samples=given.samples, n_steps=given.steps,
        topk=max(2, given.samples // ELITES), seed=0,
    )  # fmt: skip
    plan = PlanConfig(horizon=given.horizon, receding_horizon=2)
    for name, policy in (("random", RandomPolicy(seed=0)), (given.solver, WorldModelPolicy(solver, plan))):
        arena = World("hma/Goal-v0", given.episodes, (128, 128), max_episode_steps=given.budget, **own)
        arena.set_policy(policy)
        with contextlib.redirect_stdout(io.StringIO()):  # solvers print their time
            found = arena.evaluate(episodes=given.episodes, seed=0, reset_mode="wait")
        print(f"{name}: {found['success_rate']:.0f} % of {given.episodes} reach the goal picture", flush=True)
        arena.close()


if __name__ == "__main__":
    run_script(main)
