"""Show robots in a world model as lerobot's evaluation wants an environment to be.

N environments, S pixels a side, S' values of a state, A action dims.
"""

import logging
import time
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from hma_data.arrays import Bools, Float32s, Ints
from hma_data.errors import UsageError
from hma_data.lab.simulator import simulated
from hma_data.sources.lerobot.writer import SYNTHETIC
from hma_model.checkpoint.folder import Checkpoint
from hma_model.evaluation.recorded_state import (
    EPISODES_NEEDED,
    Reader,
    Tell,
    recorded_reader,
    simulated_reader,
)
from hma_model.policies.judge import StateJudge, Task, task_of, train_judge
from hma_model.policies.rewards import RewardModel, labelled_shards, measured_judge, names_reward_model
from hma_model.worlds.env import WorldModelVectorEnv
from hma_model.worlds.images import recorded_cameras, seen_cameras
from hma_model.worlds.world import World

Observations = dict[str, Any]
TOLD_EVERY_S = 20.0  # while a reader or a judge is trained
log = logging.getLogger(__name__)


def camera_names(checkpoint: Checkpoint, embodiment: str) -> list[str]:
    """Return the names of the cameras that a model's image shows side by side."""
    stored = recorded_cameras(checkpoint.embodiment(embodiment))
    return seen_cameras(checkpoint.cameras(embodiment), stored)


def state_source(checkpoint: Checkpoint, embodiment: str) -> Callable[[World, Tell], Reader | None] | None:
    """Return what trains a reader of a robot's state; None if it has no state, or no episodes tell it."""
    robot = checkpoint.embodiment(embodiment)
    if robot.state is None:
        return None
    if simulated(embodiment):
        return lambda world, tell: simulated_reader(embodiment, world.tokenizer, robot.stride, 0, tell)
    for shards in checkpoint.shards():
        known = shards.embodiment.id == embodiment and shards.embodiment.state is not None
        if known and shards.manifest.splits["train"]["episodes"] >= EPISODES_NEEDED:
            cameras = tuple(camera_names(checkpoint, embodiment))
            return lambda world, tell: recorded_reader(world.tokenizer, shards, cameras, 0, tell)
    return None


def progress_log(embodiment: str) -> Tell:
    """Return a function that logs how far a training is, but not more often than TOLD_EVERY_S."""
    told = time.monotonic()

    def tell(words: str) -> None:
        nonlocal told
        if time.monotonic() - told >= TOLD_EVERY_S:
            told = time.monotonic()
            log.warning("%s: %s", embodiment, words)

    return tell


class LeRobotVectorEnv(WorldModelVectorEnv):
    """N robots in a world model, in the form of lerobot 0.6: `lerobot.scripts.lerobot_eval.rollout`.

    Observations are `pixels`, by camera if there are several, and `agent_pos`, the state read off the
    images. An environment whose episode has ended stays as it is until the next reset, and costs nothing.
    The reward is the judge's score so far. Success is judged at the end; of `reached` and of a reward model,
    which nothing can undo, as soon as it is seen, and that ends the episode. Reader and judge are trained, or
    the reward model is measured, at the first reset.

    Args:
        checkpoint: of the world.
        embodiment: an id of it.
        num_envs: N.
        world: of the checkpoint.
        state: whether to read the state, where one is known.
        judge: a task in words, as `task_of` takes it, or a reward model; None: nothing is a success.
        judge_from: shards whose held-out episodes measure a reward model; by default those of the training.
        task: what policies are told; by default the robot's id.
        horizon: steps of an episode.
        settings: of `WorldModelEnv`: prompt, clip, size.

    Raises:
        HMAError: an argument is wrong, or the robot cannot be judged.
    """

    def __init__(
        self,
        checkpoint: Checkpoint,
        embodiment: str,
        num_envs: int,
        world: World,
        *,
        state: bool = True,
        judge: str | None = None,
        judge_from: str | None = None,
        task: str | None = None,
        horizon: int = 300,
        **settings: Any,
    ) -> None:
        super().__init__(
            num_envs, embodiment=embodiment, world=world, horizon=horizon, render_mode="rgb_array", **settings
        )
        self.metadata = self.metadata | {"render_fps": max(1, round(self.metadata["render_fps"]))}
        told = {"task": task or embodiment, "task_description": task or embodiment}
        for name, value in (told | {"_max_episode_steps": horizon}).items():
            self.set_attr(name, value)  # lerobot asks each environment
        self._judged_by, self._judge_from = judge, judge_from
        self._task = None if judge is None else judged_task(embodiment, judge)
        self._cameras = camera_names(checkpoint, embodiment)
        self._train_reader = state_source(checkpoint, embodiment) if state else None
        self.observations = np.zeros(self.observation_space.shape, np.uint8)
        self.ended: Bools = np.zeros(num_envs, np.bool_)
        image = self.single_observation_space
        side = image.shape[0]
        pixels: Any = image
        if len(self._cameras) > 1:
            pixels = spaces.Dict(dict.fromkeys(self._cameras, spaces.Box(0, 255, (side, side, 3), np.uint8)))
        shown = {"pixels": pixels, SYNTHETIC: spaces.Box(1, 1, (1,), np.float32)}
        robot = checkpoint.embodiment(embodiment)
        self._states = np.zeros((num_envs, 0), np.float32)
        if self._train_reader is not None and robot.state is not None:
            self._states = np.zeros((num_envs, len(robot.state.names())), np.float32)
            shown["agent_pos"] = spaces.Box(-np.inf, np.inf, self._states.shape[1:], np.float32)
        self.single_observation_space = spaces.Dict(shown)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._frames = np.zeros(num_envs, np.int64)
        self._scores = np.zeros(num_envs)
        self._success = np.zeros(num_envs, np.bool_)
        self._truncated = np.zeros(num_envs, np.bool_)

    @cached_property
    def reader(self) -> Reader | None:
        """Train the reader of the state, and say what its error is."""
        if self._train_reader is None:
            return None
        log.warning("%s: a reader of the state is trained once, in minutes, and kept", self.embodiment)
        reader = self._train_reader(self.world, progress_log(self.embodiment))
        if reader is None:
            raise UsageError(self.embodiment, "has no episode whose states are all known", "give state=false")
        own = reader.readable
        error = f"{reader.error[own].mean():.2g} standard deviations" if len(own) else "unknown"
        said = "%s: agent_pos is estimated from the images: %d of %d values, mean error on other episodes %s"
        log.warning(said, self.embodiment, len(own), len(reader.std), error)
        return reader

    @cached_property
    def judge(self) -> StateJudge | RewardModel | None:
        """Train the judge or measure the reward model, and say how often it is right."""
        if self._judged_by is None:
            return None
        if self._task is None:
            shards = labelled_shards(self.world, self.embodiment, self._judge_from, self._judged_by)
            tell = progress_log(self.embodiment)
            found = measured_judge(self._judged_by, self.world, self.embodiment, shards, tell)
            log.warning("%s: success is what %s says; %s", self.embodiment, found.source, found.sentence)
            return found.model
        log.warning("%s: the judge is trained once, in minutes, and kept", self.embodiment)
        spec = self.envs[0].action_spec
        frames = self.envs[0].horizon // spec.stride + 1
        judge = train_judge(
            self.embodiment, self.world.tokenizer, spec.stride, frames, self._task,
            tell=progress_log(self.embodiment),
        )  # fmt: skip
        log.warning("%s: success is that %s; the judge: %s", self.embodiment, self._task.text, judge.held_out)
        return judge

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start episodes, as `WorldModelVectorEnv.reset` does; lerobot's own options do nothing."""
        for env in self.envs:
            env.judge = self.judge
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
        options = options or {}
        begun = np.flatnonzero(options.get("reset_mask", np.ones(self.num_envs)))
        start = {"prompt": options.get("prompt")}
        for i in begun:
            own = None if seeds is None else seeds[i]
            self.observations[i], _ = self.envs[i].reset(seed=own, options=start)
        self.ended[begun] = False
        for facts in (self._frames, self._scores, self._success, self._truncated):
            facts[begun] = 0
        if isinstance(self.judge, StateJudge):  # of scores below 0, which distances are, 0 would be the best
            self._scores[begun] = self.judge.score(np.stack([self.envs[i].image for i in begun])[:, None])
        self._read(begun)
        return self._seen(), {}

    def step(  # type: ignore[override]
        self, actions: Float32s
    ) -> tuple[Observations, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Send an action to each environment that goes on; those that get an image get it in one pass."""
        new = []
        rewards = np.zeros(self.num_envs)
        going = np.flatnonzero(~self.ended)
        self.dream(going, actions)
        for i in going:
            self.observations[i], score, _, truncated, facts = self.envs[i].step(actions[i])
            if facts["frames"] > self._frames[i]:
                self._frames[i] = facts["frames"]
                self._scores[i] = score
                new.append(i)
            rewards[i] = self._scores[i]
            self._truncated[i] = truncated
            lasting = self._task is None or self._task.name == "reached"
            if self.judge is not None and self._frames[i] and (truncated or lasting):
                self._success[i] = self.judge.success(self._scores[i])
        self.ended = self._success | self._truncated
        self._read(np.array(new, np.int64))
        infos = {"frames": self._frames.copy(), "is_success": self._success.copy()}
        return self._seen(), rewards, self._success.copy(), self._truncated.copy(), infos

    def _read(self, rows: Ints) -> None:
        """Read the states of environments off their newest images."""
        if self.reader is not None and len(rows):
            self._states[rows] = self.reader.read(np.stack([self.envs[i].image for i in rows]))

    def _seen(self) -> Observations:
        pixels: Any = self.observations.copy()
        if len(self._cameras) > 1:
            views = np.split(pixels, len(self._cameras), axis=2)
            pixels = {name: np.ascontiguousarray(view) for name, view in zip(self._cameras, views)}
        seen = {"pixels": pixels, SYNTHETIC: np.ones((self.num_envs, 1), np.float32)}
        return seen | ({} if self.reader is None else {"agent_pos": self._states.copy()})


def judged_task(embodiment: str, words: str) -> Task | None:
    """Return the task that a robot is judged by; None if the words name a reward model."""
    if names_reward_model(words):
        return None
    if not simulated(embodiment):
        remedy = "give a reward model, or leave the judge out; nothing then counts as a success"
        raise UsageError("judge", f"there is none of {embodiment}, which has no simulator", remedy)
    return task_of(embodiment, words)
