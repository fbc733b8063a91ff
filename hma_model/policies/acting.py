"""Let a trained world model act as a policy: image history in, actions out.

    policy = Acting(load_world("runs/policy"), scenes, horizon=1)     # hma:runs/policy on the command line

The model gives a chunk of actions from each frame on. With a horizon of several chunks it imagines the frame
that its chunk leads to, actions again, and so on; then all of them are carried out before it looks again.
What it imagined is forgotten, and the true images take its place.

N scenes, A action dims.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np

from hma_data.arrays import Float32s
from hma_data.errors import HMAError, UsageError
from hma_model.config import POLICY
from hma_model.policies.arenas import Arena, Scenes
from hma_model.policies.base import split_options
from hma_model.worlds.images import Prompt
from hma_model.worlds.world import World, load_world

HORIZON = 1  # chunks between two looks, by default
OPTIONS: dict[str, type] = {"horizon": int, "memory": int, "temperature": float, "unmask_steps": int}


class Follower:
    """The sessions of a world that follow an arena: they see its images and the actions between.

    Args:
        memory: images that they remember, the newest among them; None for as many as the model can.

    Attributes:
        world: of the sessions.
        spec: the actions of the robot.
        sessions: one a scene.

    Raises:
        HMAError: the world lacks the robot, or knows it with other actions.
    """

    def __init__(self, world: World, scenes: Scenes, where: str, memory: int | None = None) -> None:
        self.world = world
        self.spec = world.action_spec(scenes.name)
        self.sessions = list[int]()
        self._memory = memory
        self._where = where
        own = self.spec
        robot = scenes.robot.embodiment
        if (own.stride, len(own.names)) != (robot.stride, robot.action_dim):
            fault = f"takes {own.stride} actions of {len(own.names)} values of {scenes.name} in a chunk"
            raise HMAError(where, fault, f"the scenes take {robot.stride} of {robot.action_dim}")

    def begin(self, arena: Arena) -> None:
        """Begin with the arena's prompts; an HMAError says that it shows more or fewer cameras."""
        (high, wide) = self.world.image_shape[:2]
        (height, width) = arena.images.shape[1:3]
        if wide // high != max(1, width // height):
            fault = f"sees {wide // high} views, and the images show {width // height}"
            raise HMAError(self._where, fault, "give a policy that sees the same cameras")
        for session in self.sessions:
            self.world.close(session)
        name = arena.scenes.name
        seed = arena.scenes.seed
        self._prompts = [self._newest(prompt) for prompt in arena.prompts]
        self.sessions = [
            self.world.open(name, *prompt, seed=seed + row) for row, prompt in enumerate(self._prompts)
        ]
        self._taken: list[Float32s] = []  # actions (N, A) since the last image

    def look(self, arena: Arena) -> None:
        """See the arena's images if they are new."""
        if not arena.fresh or not self._taken:
            return
        chunks = np.stack(self._taken, axis=1)
        if self._memory is None:
            self.world.observe(self.by_session(arena.images), self.by_session(chunks))
        else:
            for row, session in enumerate(self.sessions):
                frames = np.concatenate([self._prompts[row].frames, arena.images[row][None]])
                known = np.concatenate([self._prompts[row].chunks, chunks[row].reshape(1, -1)])
                self._prompts[row] = prompt = self._newest(Prompt(frames, known))
                self.world.reset(session, *prompt)
        self._taken = []

    def take(self, actions: Float32s) -> Float32s:
        """Note actions (N, A) that are given, and return them."""
        self._taken.append(actions)
        return actions

    def _newest(self, prompt: Prompt) -> Prompt:
        first = max(0, len(prompt.frames) - (self._memory or len(prompt.frames)))
        return Prompt(prompt.frames[first:], prompt.chunks[first:])

    def by_session(self, values: Iterable[Any]) -> dict[int, Any]:
        """Return values of the scenes by their sessions."""
        return dict(zip(self.sessions, values, strict=True))


class Acting:
    """A model with the objective `policy` or `full` as a policy.

    Args:
        world: of the model that acts.
        scenes: whose robot it has.
        horizon: chunks between two looks; above 1 for models that also predict video.
        memory: images that it goes by. With 1 it sees neither the past nor its own actions: a policy that
            was cloned from few episodes else goes on with what it did last.
        where: its name, for errors.

    Raises:
        HMAError: the model was not trained to act, lacks the robot, or knows it with other actions.
    """

    def __init__(
        self,
        world: World,
        scenes: Scenes,
        horizon: int = HORIZON,
        where: str = "the model",
        memory: int | None = None,
    ) -> None:
        config = world.model.config
        world.model.require_readout(POLICY, where)
        if horizon > 1 and not config.predicts_video:
            raise UsageError(where, "predicts no video, so it cannot look ahead", "give horizon=1")
        for name, value in {"horizon": horizon, "memory": memory}.items():
            if value is not None and value < 1:
                raise UsageError(where, f"{name}={value} is not allowed", "give 1 or more")
        self.follower = Follower(world, scenes, where, memory)
        self._horizon = horizon

    def begin(self, arena: Arena) -> None:
        self.follower.begin(arena)
        self._ahead: list[Float32s] = []  # actions (N, A) that are still to be given

    def act(self, arena: Arena) -> Float32s:
        self.follower.look(arena)
        if not self._ahead:
            self._ahead = self._chosen()
        return self.follower.take(self._ahead.pop(0))

    def _chosen(self) -> list[Float32s]:
        """Return the actions (N, A) of the chunks up to the horizon."""
        world = self.follower.world
        sessions = self.follower.sessions
        made = list[Float32s]()
        kept = {session: world.snapshot(session) for session in sessions if self._horizon > 1}
        for chunk in range(self._horizon):
            given = {one: self.follower.spec.clip(said) for one, said in world.act(sessions).items()}
            made += list(np.stack([given[session] for session in sessions], axis=1))
            if chunk < self._horizon - 1:
                world.step(given)
        for session, snapshot in kept.items():
            world.restore(session, snapshot)
        return made


def read_acting(words: str, scenes: Scenes, device: str = "cpu") -> Acting:
    """Return the policy of `CHECKPOINT` or `CHECKPOINT,memory=1,horizon=2,temperature=0.5,unmask_steps=2`."""
    checkpoint, options = split_options("hma", words, OPTIONS)
    horizon = options.pop("horizon", HORIZON)
    memory = options.pop("memory", None)
    world = load_world(checkpoint, [scenes.name], device=device, **options)
    return Acting(world, scenes, horizon, f"policy hma:{checkpoint}", memory)
