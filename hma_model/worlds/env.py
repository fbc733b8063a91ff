"""Offer a world model as gymnasium environments: one session, or several that step in one pass.

    import gymnasium, hma_model.simulate
    env = gymnasium.make("hma/WorldModel-v0", embodiment="pusht_fast", clip=True)
    image, _ = env.reset(seed=0)
    image, reward, terminated, truncated, _ = env.step(env.action_space.sample())

S pixels a side, V views side by side, A action dims, T images of an episode, N environments.
"""

import copy
import os
import warnings
from functools import partial
from typing import Any, Protocol, runtime_checkable

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from numpy.typing import NDArray

from hma_data.arrays import Float32s, Images, Ints
from hma_data.episodes.images import resize
from hma_data.errors import HMAError, UsageError
from hma_data.storage.paths import StrPath
from hma_model.generation.commands import OutsideRangeWarning
from hma_model.worlds.images import Prompt
from hma_model.worlds.prompts import read_prompt
from hma_model.worlds.world import World, load_world

# An OpenMP pool does not survive a fork, as in gymnasium's "async" vectors; one thread needs none.
os.register_at_fork(after_in_child=lambda: torch.set_num_threads(1))
PROMPTS = 32  # simulated prompts among which a reset without a prompt draws
CONTROLS = ("frame", "chunk")


class Judge(Protocol):
    """A function that scores an episode after each new image."""

    def __call__(self, images: Images, actions: Float32s) -> tuple[float, bool]:
        """Return the reward of the newest image, and whether the episode ends there.

        Args:
            images: (T, S, V·S, 3) of the episode so far; the first is the last one of the prompt.
            actions: (T - 1, stride, A) raw actions between them.
        """
        ...


@runtime_checkable
class EpisodeJudge(Protocol):
    """A judge that remembers what it read of an episode's earlier images."""

    def begun(self) -> Judge:
        """Return the judge of one episode, which is about to begin."""
        ...


class WorldModelEnv(gymnasium.Env[Images, Float32s]):
    """One robot in a world model, as a gymnasium environment.

    An observation is the newest image (S, V·S, 3) uint8. Actions outside the range seen in training cause
    one warning. An action of NaN is an unknown action, which the model was trained to do without.

    Args:
        checkpoint: as `load_world` takes it.
        embodiment: an id of the checkpoint.
        prompt: what every episode starts from, as `read_prompt` takes it; `reset(options={"prompt": …})`
            takes another for one episode. By default one of those that come along is drawn.
        control: "frame": steps at the control rate; an action is an action (A,), and the image changes
            after every `stride` of them. "chunk": steps at the rate of the model's frames; an action is
            (stride, A).
        horizon: steps after which an episode is truncated; None for never.
        judge: gives the reward and ends episodes, see `Judge` and `EpisodeJudge`; by default the reward is 0.
        render_mode: "rgb_array" or None.
        clip: clip actions to the range seen in training.
        size: side in pixels of the observations; None for that of the model's images.
        world: a world to open the session in, instead of a checkpoint.
        device: of the network.
        settings: of `World`: unmask_steps, temperature, order, sample_steps, compile, precision.

    Raises:
        HMAError: the checkpoint lacks the embodiment, or an argument is wrong.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        checkpoint: StrPath = "embedded",
        embodiment: str | None = None,
        prompt: Any = None,
        control: str = "frame",
        horizon: int | None = 300,
        judge: Judge | EpisodeJudge | None = None,
        render_mode: str | None = None,
        *,
        clip: bool = False,
        size: int | None = None,
        world: World | None = None,
        device: str = "cpu",
        **settings: Any,
    ) -> None:
        if world is None:
            wanted = None if embodiment is None else [embodiment]
            world = load_world(checkpoint, wanted, device=device, **settings)
        elif settings:
            raise UsageError("world", f"is given with {', '.join(settings)}", "set them in the world")
        if embodiment is None:
            there = ", ".join(world.model.embodiments)
            raise UsageError("embodiment", "is not given", f"give embodiment=ID; the model has: {there}")
        if control not in CONTROLS:
            raise UsageError("control", f"{control!r} is unknown", f"give {' or '.join(CONTROLS)}")
        for name, value, unit in (("size", size, "of pixels"), ("horizon", horizon, "of steps")):
            if value is not None and (not isinstance(value, int | np.integer) or value < 1):
                raise UsageError(name, f"is {value!r}", f"give a whole number {unit}, 1 or more, or None")
        if size is not None and world.image_shape[0] != world.image_shape[1]:
            raise UsageError("size", "is for models of one view", "leave it out")
        self.world = world
        self.embodiment = embodiment
        self.prompt = prompt
        self.control = control
        self.horizon = horizon
        self.judge = judge
        self.render_mode = render_mode
        self.clip = clip
        self.size = size
        self.action_spec = spec = world.action_spec(embodiment)
        self.action_names = spec.names
        rate = spec.rate_hz or 10.0
        low = spec.low
        high = spec.high
        if control == "chunk":
            rate /= spec.stride
            low, high = (np.tile(bound, (spec.stride, 1)) for bound in (low, high))
        self.metadata = {**type(self).metadata, "render_fps": rate}
        shape = world.image_shape if size is None else (size, size, 3)
        self.action_space: gymnasium.Space[Any] = gymnasium.spaces.Box(low, high, dtype=np.float32)
        self.observation_space: gymnasium.Space[Any] = gymnasium.spaces.Box(0, 255, shape, np.uint8)
        self._read: dict[int | None, Prompt] = {}
        self._warned: set[str] = set()  # of what; a vector's environments share it, and the prompts
        self.session: int | None = None
        self.made: dict[int, Images] | None = None  # of the next step, if a vector's pass has made them
        self.image: Images = np.zeros(world.image_shape, np.uint8)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Images, dict[str, Any]]:
        """Start an episode; `options["prompt"]` is what it starts from, as `read_prompt` takes it."""
        given = options or {}
        if other := next((key for key in given if key != "prompt"), None):
            raise HMAError("reset", f"there is no option {other!r}", "it takes prompt")
        super().reset(seed=seed)
        start = self._start(given.get("prompt"))
        drawn = int(self.np_random.integers(2**31))
        if self.session is None:
            self.session = self.world.open(self.embodiment, *start, seed=drawn)
        else:
            self.world.reset(self.session, *start, seed=drawn)
        self.image = self.world.image(self.session)
        self._steps = 0
        self._frames = 0
        self._waiting: list[Float32s] = []  # actions since the newest image
        self._past = [self.image]  # kept for a judge only
        self._judge = self.judge.begun() if isinstance(self.judge, EpisodeJudge) else self.judge
        self._chunks: list[Float32s] = []
        return self._seen(self.image), {"frames": 0}

    def step(self, action: Any) -> tuple[Images, float, bool, bool, dict[str, Any]]:
        """Send an action, or a chunk; between chunks the last image is shown."""
        made, self.made = self.made, None
        if made is None:
            made = self.world.step(self.queue(self.checked(action)))
        self._steps += 1
        reward = 0.0
        terminated = False
        if self.session in made:
            self.image = made[self.session]
            self._frames += 1
            if self._judge is not None:
                self._past.append(self.image)
                reward, terminated = self._judge(np.stack(self._past), np.stack(self._chunks))
        truncated = self.horizon is not None and self._steps >= self.horizon
        facts = {"frames": self._frames}
        return self._seen(self.image), float(reward), bool(terminated), truncated, facts

    def queue(self, actions: Float32s) -> dict[int, Float32s]:
        """Take actions as `checked` returns them; return the session's chunk once it is whole."""
        assert self.session is not None
        self._waiting += list(actions)
        if len(self._waiting) < self.action_spec.stride:
            return {}
        chunk = np.stack(self._waiting)
        self._waiting = []
        if self._judge is not None:
            self._chunks.append(chunk)
        return {self.session: chunk}

    def render(self) -> Images | None:
        """Return the newest image (S, V·S, 3) as the model makes it."""
        return self.image if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """End the session."""
        if self.session is not None:
            self.world.close(self.session)
            self.session = None

    def _start(self, prompt: Any) -> Prompt:
        """Return the prompt of an episode: the reset's, else the environment's, else a drawn one."""
        if prompt is not None:
            return read_prompt(self.world.model, self.embodiment, prompt)
        seed = int(self.np_random.integers(PROMPTS)) if self.prompt is None else None
        if seed not in self._read:
            self._read[seed] = read_prompt(self.world.model, self.embodiment, self.prompt, seed=seed or 0)
        return self._read[seed]

    def checked(self, action: Any) -> Float32s:
        """Return an action as actions (n, A): checked, clipped if wanted; warn once of a strange range."""
        if self.session is None:
            raise HMAError("step", "there is no episode", "call reset() first")
        if self.control == "frame":
            values = self.action_spec.one(action)[None]
        else:
            values = np.asarray(action, np.float32)
            self.action_spec.read(values)
            values = values.reshape(self.action_spec.stride, -1)
        outside = self.action_spec.outside(values)
        if outside and self.clip:
            return self.action_spec.clip(values)
        if outside and not self._warned:
            self._warned.add("outside")
            said = f"{outside}, so predictions are unreliable; clip=True clips actions to it"
            warnings.warn(f"{said}. Shown only once", OutsideRangeWarning, stacklevel=4)
        return values

    def _seen(self, image: Images) -> Images:
        """Return an image as it is observed; a copy, which its receiver may change."""
        return image.copy() if self.size is None else resize(image[None], self.size)[0]


class WorldModelVectorEnv(SyncVectorEnv):
    """N robots in a world model, whose sessions step in one pass and begin and end independently.

    Args:
        num_envs: N.
        autoreset_mode: of gymnasium: the step after an episode's end, the same step, or disabled.
        others, settings: as of `WorldModelEnv`, in its order or by name.
    """

    envs: list[Any]  # of `WorldModelEnv`
    metadata: dict[str, Any]
    observation_space: Any
    single_observation_space: Any

    def __init__(
        self,
        num_envs: int = 1,
        *others: Any,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **settings: Any,
    ) -> None:
        if not isinstance(num_envs, int | np.integer) or num_envs < 1:
            raise UsageError("num_envs", f"is {num_envs}", "give a whole number of 1 or more")
        first = WorldModelEnv(*others, **settings)
        # copies made before any session is open: they share the world, its prompts and the warnings
        super().__init__([partial(copy.copy, first)] * num_envs, autoreset_mode=autoreset_mode)
        self.world = first.world
        self.embodiment = first.embodiment

    def step(self, actions: Any) -> tuple[Images, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Send an action, or a chunk, to each environment; those that get an image get it in one pass."""
        ended = self._autoreset_envs
        if self.autoreset_mode == AutoresetMode.DISABLED and ended.any():
            fault = f"the episodes of {np.flatnonzero(ended).tolist()} have ended"
            raise HMAError("step", fault, 'reset them: reset(options={"reset_mask": …})')
        begins = ended & (self.autoreset_mode == AutoresetMode.NEXT_STEP)
        self.dream(np.flatnonzero(~begins), actions)
        return super().step(actions)

    def dream(self, chosen: Ints, actions: Any) -> None:
        """Make the images of the next step of some environments in one pass, under actions (N, …)."""
        if len(actions) != self.num_envs:
            fault = f"has {len(actions)} actions"
            raise HMAError("step", fault, f"give {self.num_envs}, one per environment")
        checked = [self.envs[i].checked(actions[i]) for i in chosen]  # all, before any is queued
        chunks = [self.envs[i].queue(values) for i, values in zip(chosen, checked, strict=True)]
        made = self.world.step({session: chunk for part in chunks for session, chunk in part.items()})
        for i in chosen:
            self.envs[i].made = made
