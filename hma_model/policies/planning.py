"""Plan in a world model: actions are tried in it before the best are given (model-predictive control).

    cost = Cost(load_world("embedded"), "rails_03", judge)
    solver = CEMSolver(cost, num_samples=64)          # of stable-worldmodel; plan:cem on the command line

`Cost` is what the solvers of stable-worldmodel call `Costable`: it imagines what candidates lead to, all side
by side, and costs what the images show. That is how far a judge finds them from success, or how far the
last one is from an image of the goal.

N scenes, C candidates of each, H frames ahead, S pixels a side, A action dims, K = stride · A.
"""

import contextlib
import io
import warnings
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray

from hma_data.arrays import Float32s, Floats, Images
from hma_data.episodes.images import resize
from hma_data.errors import HMAError, MissingDependencyError, UsageError, install_command
from hma_model.policies.acting import Follower
from hma_model.policies.arenas import Arena, Scenes
from hma_model.policies.base import split_options
from hma_model.policies.judge import StateJudge
from hma_model.worlds.world import World

SOLVERS = {"cem": "CEMSolver", "icem": "ICEMSolver", "mppi": "MPPISolver"}
OPTIONS: dict[str, type] = {
    **dict.fromkeys(("horizon", "samples", "steps", "receding", "unmask_steps"), int), "temperature": float,
}  # fmt: skip
MAX_ROWS = 128  # that step in one pass; more cost memory and gain nothing
COARSE_SIZE = 32  # pixels a side at which images are compared with a goal
ELITES = 8  # one candidate in so many is kept by CEM


class Cost:
    """The cost of actions in a world model.

    Args:
        world: in which candidates are tried.
        embodiment: the robot.
        judge: its score, negative, is the cost; without one, the distance from `info["goal"]`.

    Raises:
        HMAError: the model lacks the robot.
    """

    def __init__(self, world: World, embodiment: str, judge: StateJudge | None = None) -> None:
        self.world = world
        self.embodiment = embodiment
        self.judge = judge
        own = world.action_spec(embodiment)
        space = world.model.embodiments[embodiment]
        self._own = own
        self._mean = np.array(space.mean, np.float32)
        self._std = np.array(space.std, np.float32)
        self.sessions: list[int] = []
        self.first: Images | None = None  # (N, S, S, 3) in which the judged episodes began

    @property
    def space(self) -> gymnasium.spaces.Box:
        """Return the space of a candidate's action (A,), in standard deviations from the mean."""
        scale = np.maximum(self._std, 1e-6)
        low = (self._own.low - self._mean) / scale
        high = (self._own.high - self._mean) / scale
        return gymnasium.spaces.Box(low, high, dtype=np.float32)

    def actions(self, candidates: NDArray[Any]) -> Float32s:
        """Return candidates (…, A), held for a chunk, or (…, K), as actions (…, stride, A)."""
        width = len(self._own.names)
        stride = self._own.stride
        held = candidates.shape[-1] == width
        rows = candidates[..., None, :] if held else candidates.reshape(*candidates.shape[:-1], stride, width)
        actions = self._own.clip(self._mean + self._std * rows).astype(np.float32)
        return actions.repeat(stride, axis=-2) if held and stride > 1 else actions

    def imagine(self, sessions: Sequence[int], candidates: NDArray[Any], *, ends: bool = False) -> Images:
        """Return the images (N, C, H, S, S, 3) that candidates (N, C, H, A or K) lead to from sessions.

        With `ends` it is the last one alone, (N, C, 1, S, S, 3), which saves decoding the others.
        """
        count, tried, horizon = candidates.shape[:3]
        actions = self.actions(candidates).reshape(count * tried, horizon, self._own.stride, -1)
        world = self.world.fork(sessions, tried)
        last = horizon - 1
        made = [
            world.step(dict(enumerate(actions[:, ahead])), decoded=ahead == last or not ends)
            for ahead in range(horizon)
        ]
        made = made[last:] if ends else made
        images = np.stack([[one[row] for row in range(count * tried)] for one in made], axis=1)
        return images.reshape(count, tried, *images.shape[1:])

    @torch.no_grad()
    def get_cost(self, info_dict: dict[str, Any], action_candidates: torch.Tensor) -> torch.Tensor:
        """Return the costs (N, C) of candidates (N, C, H, A or K), in standard deviations from the mean.

        Args:
            info_dict: "scene" (N, C): numbers of `sessions`; or "pixels" (N, C, T, S', S', 3) uint8: images
                to begin from, at the model's rate. Without a judge also "goal", one such image.
            action_candidates: of the actions.
        """
        if "scene" in info_dict:
            scenes = info_dict["scene"][:, 0].tolist()
        else:
            shown = np.asarray(info_dict["pixels"][:, 0])
            self.open([(one, None) for one in shown])
            scenes = list(range(len(shown)))
        sessions = [self.sessions[scene] for scene in scenes]
        images = self.imagine(sessions, action_candidates.cpu().numpy(), ends=self.judge is None)
        if self.judge is None:
            costs = goal_distance(images[:, :, -1], np.asarray(info_dict["goal"][:, 0]))
        else:
            assert self.first is not None
            # How far the judge finds imagined episodes from a success; negative beyond.
            count, tried = images.shape[:2]
            first = self.first[scenes][:, None, None]
            begun = np.broadcast_to(first, (count, tried, 1, *first.shape[3:]))
            episodes = np.concatenate([begun, images], axis=2).reshape(count * tried, -1, *first.shape[3:])
            costs = -self.judge.score(episodes).reshape(count, tried)
        return torch.from_numpy(costs).to(action_candidates)

    criterion = get_cost

    def open(self, prompts: Sequence[tuple[Any, Any]]) -> None:
        """Begin sessions with frames and chunks; those before end."""
        for session in self.sessions:
            self.world.close(session)
        made = [self.world.open(self.embodiment, *prompt, seed=row) for row, prompt in enumerate(prompts)]
        self.sessions = made
        self.first = np.stack([self.world.image(session) for session in made])


def goal_distance(images: Images, goals: Images) -> Floats:
    """Return the mean squared distances (N, C) of images (N, C, S, S, 3) from goals (N, …, S', S', 3)."""
    shape = images.shape[:2]
    coarse = resize(images.reshape(-1, *images.shape[2:]), COARSE_SIZE).astype(np.float64)
    wanted = resize(goals.reshape(len(goals), -1, *goals.shape[-3:])[:, -1], COARSE_SIZE).astype(np.float64)
    squares = np.square(coarse.reshape(*shape, *coarse.shape[1:]) - wanted[:, None])
    return np.asarray(squares.mean(axis=(2, 3, 4)))


class Planning:
    """Model-predictive control: plan, give the first chunks, look, and plan again.

    What is planned for is the success of the judge that `cost` gets before the policy begins.

    Args:
        world: whose model it plans in; the sessions are in a world of its own.
        scenes: whose robot it has.
        solver: a key of SOLVERS.
        horizon: H.
        samples: candidates of a round.
        steps: rounds of a plan.
        receding: frames until it plans again.
        unmask_steps, temperature: of imagined frames.
    """

    def __init__(
        self,
        world: World,
        scenes: Scenes,
        solver: str = "cem",
        *,
        horizon: int = 6,
        samples: int = 32,
        steps: int = 3,
        receding: int = 2,
        unmask_steps: int = 1,
        temperature: float = 0.0,
    ) -> None:
        if min(horizon, samples, steps, receding) < 1 or receding > horizon:
            fault = "has a number below 1, or receding above horizon"
            remedy = "give numbers of at least 1, and receding up to horizon"
            raise UsageError(f"policy plan:{solver}", fault, remedy)
        own = World(world.model, world.tokenizer, unmask_steps=unmask_steps, temperature=temperature)
        self._follower = Follower(own, scenes, "policy plan")
        self.cost = Cost(own, scenes.name)
        self._kind = solver
        self._seed = scenes.seed
        self._sizes = horizon, samples, steps, receding

    def begin(self, arena: Arena) -> None:
        self._follower.begin(arena)
        self.cost.sessions = self._follower.sessions
        self.cost.first = arena.images
        made, configured = solver_of(self._kind)
        count = len(arena.images)
        one = self.cost.space
        horizon, samples, steps, receding = self._sizes
        self._solver = made(
            self.cost, batch_size=max(1, MAX_ROWS // samples), num_samples=samples, n_steps=steps,
            seed=self._seed, topk=max(2, samples // ELITES),
        )  # fmt: skip
        box = gymnasium.spaces.Box(np.tile(one.low, (count, 1)), np.tile(one.high, (count, 1)))
        self._solver.configure(action_space=box, n_envs=count, config=configured(horizon, receding))
        self._ahead: list[Float32s] = []
        self._rest: torch.Tensor | None = None

    def act(self, arena: Arena) -> Float32s:
        self._follower.look(arena)
        if not self._ahead:
            scenes = torch.arange(len(arena.images))
            with contextlib.redirect_stdout(io.StringIO()):  # solvers print their time
                planned = self._solver({"scene": scenes}, init_action=self._rest)["actions"]
            receding = self._sizes[3]
            self._rest = planned[:, receding:]
            actions = self.cost.actions(planned[:, :receding].numpy())  # (N, receding, stride, A)
            self._ahead = list(actions.reshape(len(actions), -1, actions.shape[-1]).swapaxes(0, 1))
        return self._follower.take(self._ahead.pop(0))


def solver_of(kind: str) -> tuple[Any, Any]:
    """Return a solver's class of stable-worldmodel, and the class of its settings.

    Raises:
        HMAError: there is no such solver, or stable-worldmodel is not installed.
    """
    if kind not in SOLVERS:
        raise UsageError(f"policy plan:{kind}", "is no solver", f"choose from {', '.join(SOLVERS)}")
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "ale-py not found")  # solvers need no Atari games
            from stable_worldmodel import policy, solver
    except ImportError as fault:
        said = f"stable-worldmodel cannot be imported ({fault})"
        raise MissingDependencyError("policy plan", said, install_command("planning")) from fault
    return getattr(solver, SOLVERS[kind]), policy.PlanConfig


def read_planning(words: str, scenes: Scenes, world: World | None) -> Planning:
    """Return the policy of words such as `cem,horizon=6,samples=32,steps=3,receding=2`."""
    kind, options = split_options("plan", words, OPTIONS)
    solver_of(kind)
    if world is None:
        raise HMAError(
            f"policy plan:{words}", "has no world model to plan in", "give it to hma policy-eval or augment"
        )
    return Planning(world, scenes, kind, **options)
