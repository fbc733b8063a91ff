"""Let policies act in N scenes of a laboratory robot at once: in its simulator, or in the world model.

Both begin with the same frames and are driven alike: an action each control step, and a new image after
every `stride` of them, as the environments of the world model show it. They are paired: until the model makes
its first image, a policy sees in it exactly what it saw in the simulator.

N scenes, S pixels a side, A action dims, K = stride · A, P parts, T chunks of an episode.
"""

import copy
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.arrays import Float32s, Floats, Images
from hma_data.episodes.images import resize
from hma_data.errors import HMAError, UsageError
from hma_data.lab import FAMILY, truth
from hma_data.lab.scripted import PUSHER, SceneState, SeenPose, SeenPush, seen_state, state_of, steerable
from hma_data.lab.simulator import LabSimulator, simulated
from hma_model.evaluation.probe import Probe
from hma_model.generation.commands import OutsideRangeWarning, described
from hma_model.worlds.env import WorldModelVectorEnv
from hma_model.worlds.images import Prompt
from hma_model.worlds.scenes import Dimension, LabRobot, LabScene
from hma_model.worlds.world import World

SCENES_PER_SEED = 100_000  # scenes of a seed; those of the next seed are others


@dataclass(frozen=True)
class Scenes:
    """N scenes of a laboratory robot, and what its actions are.

    Attributes:
        robot: with its simulator.
        numbers: of the scenes.
        seed: of the policies' random numbers.
    """

    robot: LabRobot
    numbers: tuple[int, ...]
    seed: int

    @classmethod
    def of(cls, world: World, embodiment: str, count: int, seed: int, *, simulator: bool = True) -> "Scenes":
        """Return the first scenes of a seed.

        Args:
            simulator: whether the robot must have a simulator; `begin` needs it.

        Raises:
            HMAError: the model lacks the robot, or it is none of the laboratory.
        """
        found = described(world.model, embodiment)
        spec = world.action_spec(embodiment)
        if simulator and (views := world.model.config.views) > 1:
            fault = f"the simulator shows one camera, and the model sees {views}"
            remedy = "give a model of one camera, or a reward model as --judge with --from SHARDS"
            raise UsageError(embodiment, fault, remedy)
        if simulator and not simulated(embodiment):
            remedy = "choose one of the toolkit's robots, or judge by a reward model: --judge FOLDER_OR_REPO"
            raise HMAError(embodiment, "has no simulator to compare with", remedy)
        space = world.model.embodiments[embodiment]
        action = {"mean": space.mean, "std": space.std}
        if spec.seen is not None:
            action |= {"min": spec.seen[0], "max": spec.seen[1]}
        numbers = tuple(range(seed * SCENES_PER_SEED, seed * SCENES_PER_SEED + count))
        robot = found or (LabSimulator(embodiment).embodiment if simulated(embodiment) else None)
        if robot is None:
            raise HMAError(embodiment, "has no YAML, which describes its actions", "load a checkpoint")
        return cls(LabRobot(robot, {"action": action}, world.image_shape[0]), numbers, seed)

    @property
    def name(self) -> str:
        """Return the id of the robot."""
        return self.robot.embodiment.id

    @property
    def stride(self) -> int:
        """Return the control steps of a chunk."""
        return self.robot.embodiment.stride

    @property
    def dimensions(self) -> tuple[Dimension, ...]:
        """Return the values of an action."""
        return self.robot.dimensions

    def take(self, chosen: range) -> "Scenes":
        """Return some of the scenes."""
        return replace(self, numbers=tuple(self.numbers[i] for i in chosen))

    def begin(self) -> list[LabScene]:
        """Return the scenes after their prompts; each call gives new ones in the same state."""
        return [self.robot.scene(number) for number in self.numbers]

    def rng(self, what: int) -> list[np.random.Generator]:
        """Return a generator for each scene, always the same for `what`."""
        return [np.random.default_rng((self.seed, what, number)) for number in self.numbers]


def shows_state(robot: str) -> bool:
    """Check whether the state that a robot's recordings hold can be read off an image: no velocities."""
    return robot == PUSHER or FAMILY.fullmatch(robot) is not None


class TrueArena:
    """The simulators.

    Args:
        scenes: to begin.
        size: S of the images.
        drawn: whether there are images; else they are those of the prompts.

    Attributes:
        prompts: of the scenes, at the rate of the model's frames.
        images: (N, S, S, 3), the newest ones.
        held: (N, A), the actions that leave the robot as it is after the prompt.
        parts: the true places (N, P, 2) of the parts at each image.
        told: what `recorded` returned so far.
        first_images: (N, S, S, 3) of the start.
        first_states: of each step of the first chunk, what `states` and `observed` returned.
    """

    def __init__(self, scenes: Scenes, size: int, drawn: bool = True) -> None:
        self.scenes = scenes
        self._size = size
        self._drawn = drawn
        self._steps = 0
        self._begun = scenes.begin()
        self.prompts: Sequence[Prompt] = [scene.prompt for scene in self._begun]
        self.held = np.stack([scene.action for scene in self._begun])
        self.parts: list[Floats] = []
        self.told: list[Float32s] = []
        self._look()
        self.first_images = self.images
        self.first_states: list[tuple[list[SceneState], Float32s | None]] = []
        self._keep_first()

    @property
    def fresh(self) -> bool:
        """Return whether the images came with the last step."""
        return self._steps % self.scenes.stride == 0

    def states(self) -> list[SceneState]:
        """Return the state of each scene; for robots that are steerable."""
        return [state_of(scene.simulator.simulation) for scene in self._begun]

    def observed(self) -> Float32s | None:
        """Return the robots' measurements of themselves (N, S'), as recorded; None if images tell none."""
        if not shows_state(self.scenes.name):
            return None
        return np.stack([scene.simulator.state for scene in self._begun])

    def recorded(self) -> Float32s:
        """Return the next actions (N, A) of the recorder's own driver; call it once a step."""
        self.told.append(np.stack([scene.simulator.recorded() for scene in self._begun]))
        return self.told[-1]

    def step(self, actions: Float32s) -> None:
        """Take an action (N, A)."""
        for scene, action in zip(self._begun, actions, strict=True):
            scene.simulator.advance(action)
        self._steps += 1
        if self.fresh:
            self._look()
        self._keep_first()

    def _keep_first(self) -> None:
        if self._steps < self.scenes.stride:
            states = copy.deepcopy(self.states()) if steerable(self.scenes.name) else []
            self.first_states.append((states, self.observed()))

    def _look(self) -> None:
        if self._drawn or not self.parts:
            shown = np.stack([scene.simulator.picture() for scene in self._begun])
            self.images: Images = shown if shown.shape[1] == self._size else resize(shown, self._size)
        self.parts.append(np.stack([truth.parts_of(s.simulator.simulation)[1] for s in self._begun]))


@dataclass(frozen=True)
class Beginning:
    """The first frames of real episodes, and the actions that followed.

    Attributes:
        scenes: N of them.
        prompts: of each.
        held: (N, A) the actions that leave the robots as they are.
        told: (N, A) the actions of each step by the recorder's driver; none if no policy asks for them.
        groups: (N,) ids of the real episodes; none if nobody asks for them.
    """

    scenes: Scenes
    prompts: Sequence[Prompt]
    held: Float32s
    told: Sequence[Float32s] = ()
    groups: Sequence[str] = ()


class ModelArena:
    """The world model: a session for each scene.

    Args:
        world: with the robot.
        true: the simulators that acted in the same scenes, or other real episodes.
        probe: reads places for policies that ask for a state.

    Attributes:
        world: the model's.
        images: what policies see; with simulators, their images until the model makes its first one.
        made: the newest images of the model; at the start, the last one of the prompt as it decodes it.
        unsure: how unsure the model was of each of its frames (N,); NaN where that is not measured.
    """

    def __init__(self, world: World, true: Beginning | TrueArena, probe: Probe | None) -> None:
        self.scenes = true.scenes
        self.held = true.held
        self.world = world
        self._told = true.told
        self._probe = probe
        self.prompts: Sequence[Prompt] = [Prompt(world.shown(one.frames), one.chunks) for one in true.prompts]
        self._envs = WorldModelVectorEnv(
            len(true.prompts), embodiment=self.scenes.name, horizon=None, world=world
        )
        for env, number, prompt in zip(self._envs.envs, self.scenes.numbers, true.prompts, strict=True):
            env.reset(seed=self.scenes.seed + number, options={"prompt": prompt._asdict()})
        self.made: Images = np.stack([env.image for env in self._envs.envs])
        self.images = self.made
        self._first_states: list[tuple[list[SceneState], Float32s | None]] = []
        if isinstance(true, TrueArena):
            self.images = true.first_images
            self._first_states = true.first_states
        self.unsure: list[Floats] = []
        self._steps = 0
        self._seen: list[SeenPush | SeenPose] | None = None

    def outside(self, actions: Float32s) -> str:
        """Say which of the actions (N, A) leave the range seen in training; "" for none."""
        return self.world.action_spec(self.scenes.name).outside(actions)

    @property
    def fresh(self) -> bool:
        return self._steps % self.scenes.stride == 0

    def states(self) -> list[SceneState]:
        """Return what the probe reads off the images, moved by the actions since the last one.

        With simulators, the states of the first chunk are theirs.

        Raises:
            HMAError: there is no probe.
        """
        if self._probe is None:
            raise HMAError(self.scenes.name, "has no state to estimate from images", "give another policy")
        if self._seen is None:
            places = self._probe.read(self.made)
            self._seen = [seen_state(self.scenes.name, self._probe.own, one) for one in places]
        if self._steps < len(self._first_states):
            return self._first_states[self._steps][0]
        return [seen.state for seen in self._seen]

    def observed(self) -> Float32s | None:
        if self._probe is None or not shows_state(self.scenes.name):
            return None
        states = self.states()
        if self._steps < len(self._first_states):
            return self._first_states[self._steps][1]
        return np.stack([state.pose for state in states]).astype(np.float32)

    def recorded(self) -> Float32s:
        """Return the actions of the simulator's driver in the true episode."""
        return self._told[self._steps]

    def step(self, actions: Float32s) -> None:
        self._steps += 1
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", OutsideRangeWarning)  # `run` says which policy leaves the range
            self.made, *_ = self._envs.step(actions)
        if self.fresh:
            self.unsure.append(np.array([self.world.uncertainty.get(one, np.nan) for one in self._sessions]))
        if self._steps >= self.scenes.stride:
            self.images = self.made
        if self._seen is None or self._probe is None:
            return
        places = self._probe.read(self.made) if self.fresh else None
        for row, seen in enumerate(self._seen):
            seen.move(actions[row])
            if places is not None:
                seen.see(places[row])

    def stored(self) -> NDArray[Any]:
        """Return the newest frames (N, …) as shards store them."""
        return np.stack([self.world.stored(session) for session in self._sessions])

    @property
    def _sessions(self) -> list[int]:
        return [env.session for env in self._envs.envs if env.session is not None]

    def close(self) -> None:
        """End the sessions."""
        self._envs.close()


Arena = TrueArena | ModelArena  # a place where a policy acts
