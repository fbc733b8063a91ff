"""Offer a world model as gymnasium environments: one session, or several that step in one pass.

    import gymnasium, hma_model.simulate
    env = gymnasium.make("hma/WorldModel-v0", embodiment="pusht_fast", clip=True)
    image, _ = env.reset(seed=0)
    image, reward, terminated, truncated, _ = env.step(env.action_space.sample())

S pixels a side, V views side by side, A action dims, T images of an episode, N environments.
"""

import os
import warnings
from collections.abc import Sequence
from typing import Any, Protocol

import gymnasium
import numpy as np
import torch
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from hma_data.episodes.images import resize
from hma_data.errors import HMAError, UsageError
from hma_data.storage.paths import StrPath
from hma_model.generation.commands import Floats, OutsideRangeWarning
from hma_model.worlds.images import Prompt
from hma_model.worlds.prompts import read_prompt
from hma_model.worlds.world import Image, World, load_world

# An OpenMP pool does not survive a fork, as in gymnasium's "async" vectors; one thread needs none.
os.register_at_fork(after_in_child=lambda: torch.set_num_threads(1))
PROMPTS = 32  # simulated prompts among which a reset without a prompt draws
CONTROLS = ("frame", "chunk")


class Judge(Protocol):
    """A function that scores an episode after each new image."""

    def __call__(self, images: Image, actions: Floats) -> tuple[float, bool]:
        """Return the reward of the newest image, and whether the episode ends there.

        Args:
            images: (T, S, V·S, 3) of the episode so far; the first is the last one of the prompt.
            actions: (T - 1, stride, A) raw actions between them.
        """
        ...


class EpisodeSession:
    """One session as episodes: actions gather to chunks, images become observations and rewards."""

    def __init__(self, env: "_Environment") -> None:
        self.env = env
        self.world = env.world
        self.session: int | None = None
        self.image: Image = np.zeros(self.world.image_shape, np.uint8)

    def begin(self, rng: np.random.Generator, prompt: Any = None) -> Image:
        """Start an episode, and return its first observation."""
        start = self.env.start(rng, prompt)
        seed = int(rng.integers(2**31))
        if self.session is None:
            self.session = self.world.open(self.env.embodiment, *start, seed=seed)
        else:
            self.world.reset(self.session, *start, seed=seed)
        self.image = self.world.image(self.session)
        self.steps = 0
        self.frames = 0
        self.waiting: list[Floats] = []
        self.past = [self.image]  # kept for a judge only
        self.chunks: list[Floats] = []
        return self.env.seen(self.image)

    def take(self, action: Any) -> dict[int, Floats]:
        """Take an action; return the session's chunk once it is whole."""
        if self.session is None:
            raise HMAError("step", "there is no episode", "call reset() first")
        self.waiting += list(self.env.checked(action))
        if len(self.waiting) < self.env.action_spec.stride:
            return {}
        chunk = np.stack(self.waiting)
        self.waiting = []
        if self.env.judge is not None:
            self.chunks.append(chunk)
        return {self.session: chunk}

    def finish(self, made: dict[int, Image]) -> tuple[Image, float, bool, bool, dict[str, Any]]:
        """End a step: return observation, reward, whether it is terminated or truncated, and facts."""
        assert self.session is not None
        self.steps += 1
        reward = 0.0
        terminated = False
        if self.session in made:
            self.image = made[self.session]
            self.frames += 1
            if self.env.judge is not None:
                self.past.append(self.image)
                reward, terminated = self.env.judge(np.stack(self.past), np.stack(self.chunks))
        truncated = self.env.horizon is not None and self.steps >= self.env.horizon
        facts = {"frames": self.frames}
        return self.env.seen(self.image), float(reward), bool(terminated), truncated, facts

    def close(self) -> None:
        """End the session."""
        if self.session is not None:
            self.world.close(self.session)
            self.session = None


class _Environment:
    """The common base of `WorldModelEnv` and `WorldModelVectorEnv`; its arguments are described there."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        checkpoint: StrPath = "embedded",
        embodiment: str | None = None,
        prompt: Any = None,
        control: str = "frame",
        horizon: int | None = 300,
        judge: Judge | None = None,
        render_mode: str | None = None,
        *,
        clip: bool = False,
        size: int | None = None,
        world: World | None = None,
        device: str = "cpu",
        **settings: Any,
    ) -> None:
        if world is None:
            world = load_world(checkpoint, device=device, **settings)
        elif settings:
            raise UsageError("world", f"is given with {', '.join(settings)}", "set them in the world")
        if embodiment is None:
            there = ", ".join(world.model.embodiments)
            raise UsageError("embodiment", "is not given", f"give embodiment=ID; the model has: {there}")
        if control not in CONTROLS:
            raise UsageError("control", f"{control!r} is unknown", f"give {' or '.join(CONTROLS)}")
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
        self._warned = False  # that actions are outside the range of training
        self.drive = EpisodeSession(self)

    def start(self, rng: np.random.Generator, prompt: Any = None) -> Prompt:
        """Return the prompt of an episode: the reset's, else the environment's, else a drawn one."""
        if prompt is not None:
            return read_prompt(self.world.model, self.embodiment, prompt)
        seed = int(rng.integers(PROMPTS)) if self.prompt is None else None
        if seed not in self._read:
            self._read[seed] = read_prompt(self.world.model, self.embodiment, self.prompt, seed=seed or 0)
        return self._read[seed]

    def checked(self, action: Any) -> Floats:
        """Return an action as actions (n, A): checked, clipped if wanted; warn once of a strange range."""
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
            self._warned = True
            said = f"{outside}, so what the model shows is a guess; clip=True clips actions to it"
            warnings.warn(f"{said}. This is said once", OutsideRangeWarning, stacklevel=4)
        return values

    def seen(self, image: Image) -> Image:
        """Return an image as it is observed; a copy, which its receiver may change."""
        return image.copy() if self.size is None else resize(image[None], self.size)[0]


def _known(options: dict[str, Any] | None, *keys: str) -> dict[str, Any]:
    """Return the options of a reset; raise HMAError for one that would have no effect."""
    options = options or {}
    if other := next((key for key in options if key not in keys), None):
        raise HMAError("reset", f"there is no option {other!r}", f"it takes {' and '.join(keys)}")
    return options


class WorldModelEnv(_Environment, gymnasium.Env[Image, Floats]):
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
        judge: gives the reward and ends episodes, see `Judge`; without one the reward is 0.
        render_mode: "rgb_array" or None.
        clip: clip actions to the range seen in training.
        size: side in pixels of the observations; None for that of the model's images.
        world: a world to open the session in, instead of a checkpoint.
        device: of the network.
        settings: of `World`: unmask_steps, temperature, order, sample_steps, compile, precision.

    Raises:
        HMAError: the checkpoint lacks the embodiment, or an argument is wrong.
    """

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Image, dict[str, Any]]:
        """Start an episode; `options["prompt"]` is what it starts from, as `read_prompt` takes it."""
        given = _known(options, "prompt")
        super().reset(seed=seed)
        return self.drive.begin(self.np_random, given.get("prompt")), {"frames": 0}

    def step(self, action: Floats) -> tuple[Image, float, bool, bool, dict[str, Any]]:
        """Send an action, or a chunk; between chunks the last image is shown."""
        return self.drive.finish(self.world.step(self.drive.take(action)))

    def render(self) -> Image | None:
        """Return the newest image (S, V·S, 3) as the model makes it."""
        return self.drive.image if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """End the session."""
        self.drive.close()


class WorldModelVectorEnv(_Environment, VectorEnv[Image, Floats, NDArray[Any]]):
    """N robots in a world model, whose sessions step in one pass and begin and end independently.

    Args:
        num_envs: N.
        autoreset_mode: of gymnasium: the step after an episode's end, the same step, or disabled.
        others, settings: as of `WorldModelEnv`, in its order or by name.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *others: Any,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **settings: Any,
    ) -> None:
        super().__init__(*others, **settings)
        self.num_envs = num_envs
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata["autoreset_mode"] = self.autoreset_mode
        self.single_action_space = self.action_space
        self.single_observation_space = self.observation_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.drives = [self.drive, *(EpisodeSession(self) for _ in range(num_envs - 1))]
        self.random = [seeding.np_random()[0] for _ in range(num_envs)]
        self.observations = np.zeros(self.observation_space.shape or (), np.uint8)
        self.ended: NDArray[np.bool_] = np.zeros(num_envs, np.bool_)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Image, dict[str, Any]]:
        """Start episodes.

        Args:
            seed: one for each; a number is that of the first, and the others follow it.
            options: "prompt": what all start from; "reset_mask": (N,) bool, those to start.
        """
        options = _known(options, "prompt", "reset_mask")
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
        chosen = np.asarray(options.get("reset_mask", np.ones(self.num_envs)), np.bool_)
        infos: dict[str, Any] = {}
        for i in np.flatnonzero(chosen):
            if seeds is not None and seeds[i] is not None:
                self.random[i] = seeding.np_random(seeds[i])[0]
            infos = self._begin(i, infos, options.get("prompt"))
        self.ended[chosen] = False
        return self.observations.copy(), infos

    def step(self, actions: Floats) -> tuple[Image, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Send an action, or a chunk, to each environment; those that get an image get it in one pass."""
        again = self.ended & (self.autoreset_mode == AutoresetMode.NEXT_STEP)
        if self.autoreset_mode == AutoresetMode.DISABLED and self.ended.any():
            fault = f"the episodes of {np.flatnonzero(self.ended).tolist()} have ended"
            raise HMAError("step", fault, 'reset them: reset(options={"reset_mask": …})')
        rewards = np.zeros(self.num_envs)
        terminated, truncated = (np.zeros(self.num_envs, np.bool_) for _ in range(2))
        infos: dict[str, Any] = {}
        going = np.flatnonzero(~again)
        chunks = [self.drives[i].take(actions[i]) for i in going]
        made = self.world.step({session: chunk for part in chunks for session, chunk in part.items()})
        for i in np.flatnonzero(again):
            infos = self._begin(i, infos)
        for i in going:
            seen, rewards[i], terminated[i], truncated[i], facts = self.drives[i].finish(made)
            self.observations[i] = seen
            if self.autoreset_mode == AutoresetMode.SAME_STEP and (terminated[i] or truncated[i]):
                infos = self._add_info(infos, {"final_obs": seen, "final_info": facts}, i)
                infos = self._begin(i, infos)
            else:
                infos = self._add_info(infos, facts, i)
        self.ended = np.logical_or(terminated, truncated)
        return self.observations.copy(), rewards, terminated, truncated, infos

    def render(self) -> tuple[Image, ...] | None:
        """Return the newest image of each environment."""
        return tuple(drive.image for drive in self.drives) if self.render_mode == "rgb_array" else None

    def close_extras(self, **kwargs: Any) -> None:
        """End the sessions."""
        for drive in self.drives:
            drive.close()

    def _begin(self, i: int, infos: dict[str, Any], prompt: Any = None) -> dict[str, Any]:
        self.observations[i] = self.drives[i].begin(self.random[i], prompt)
        return self._add_info(infos, {"frames": 0}, i)
