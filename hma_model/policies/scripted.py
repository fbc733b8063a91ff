"""Policies without a network: scripted, random, still, and those of a Python function.

N scenes, S pixels a side, A action dims.
"""

import copy
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from hma_data.arrays import Float32s
from hma_data.errors import UsageError
from hma_data.lab.scripted import driver, reacher, steerable
from hma_model.policies.arenas import Arena


class Still:
    """The actions that leave the robot as it is: no velocity, or the last target."""

    def begin(self, arena: Arena) -> None:
        pass

    def act(self, arena: Arena) -> Float32s:
        return arena.held


class Random:
    """A uniform action in the range seen in training, another one for each chunk."""

    def begin(self, arena: Arena) -> None:
        self._rng = arena.scenes.rng(1)
        # A person drives a rate both ways; a rate that was only ever positive in training stays so here.
        self._low, self._high = arena.scenes.robot.seen

    def act(self, arena: Arena) -> Float32s:
        if arena.fresh:
            drawn = [rng.uniform(self._low, self._high) for rng in self._rng]
            self._action = np.stack(drawn).astype(np.float32)
        return self._action


class Scripted:
    """The manoeuvres of the recorder, or a reach for the nearest block; a share of the chunks is random.

    They go by the robot's state: in the simulator by the true one, in the model by what a probe reads off its
    images. Robots of which no state can be read so are driven by the simulator's own driver, and in the
    model its actions are replayed.

    Args:
        noise: the share of chunks with random actions.
        reach: go to the nearest block, rather than by random manoeuvres.
    """

    def __init__(self, noise: float = 0.0, reach: bool = False) -> None:
        self.noise = noise
        self.reach = reach
        self._random = Random()

    def begin(self, arena: Arena) -> None:
        self._random.begin(arena)
        self._coins = arena.scenes.rng(2)
        self._drivers: list[Callable[..., Float32s]] = []
        if self.reach:
            self._drivers = [reacher(arena.scenes.name) for _ in arena.images]
        elif steerable(arena.scenes.name):
            begun = zip(arena.states(), arena.scenes.rng(3), strict=True)
            self._drivers = [driver(arena.scenes.name, state.pose, rng) for state, rng in begun]

    def act(self, arena: Arena) -> Float32s:
        noisy = self._random.act(arena)
        if arena.fresh:
            self._thrown = np.array([coin.random() < self.noise for coin in self._coins])[:, None]
        if self._drivers:
            pairs = zip(self._drivers, arena.states(), strict=True)
            actions = np.stack([drive(state) for drive, state in pairs])
        else:
            actions = arena.recorded()
        return np.where(self._thrown, noisy, actions).astype(np.float32)


class Called:
    """A Python function from an image (S, S, 3) to an action (A,), or a class or object of such.

    Each scene has its own: an instance of a class, or a copy of an object, so that what it remembers belongs
    to one episode. Its `reset()`, if there is one, is called when an episode begins.
    """

    def __init__(self, given: Any, where: str = "policy") -> None:
        if not callable(given):
            raise UsageError(where, f"is {given!r}, which cannot be called", "name a function or class")
        self._given = given

    def begin(self, arena: Arena) -> None:
        make = self._given if isinstance(self._given, type) else partial(copy.deepcopy, self._given)
        self._functions = [make() for _ in arena.images]
        for function in self._functions:
            if hasattr(function, "reset"):
                function.reset()

    def act(self, arena: Arena) -> Float32s:
        pairs = zip(self._functions, arena.images, strict=True)
        actions = [np.asarray(function(image.copy())) for function, image in pairs]
        shapes = {action.shape for action in actions}
        if len(shapes) > 1:
            raise ValueError(f"it returned actions of the shapes {shapes}")
        return np.stack(actions)
