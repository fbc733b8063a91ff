"""Drive a robot of the laboratory step by step, as its recorder does.

    simulator = LabSimulator("mover_04", seed=0)
    frame = simulator.reset(seed=7)              # the beginning of a scene
    frame = simulator.step(action)               # one control step
    frame = simulator.step(simulator.recorded()) # the same under the recorder's own driver

The recorders use the same stepping, so that recorded actions give the recorded frames. One robot differs:
the recorder of `pusht_slow` lets frames and actions jitter by 10 ms, which does not happen here.

A values of an action, S values of a state.
"""

from collections.abc import Callable
from importlib import import_module
from typing import Protocol

import numpy as np

from hma_data.arrays import Float32s, Floats, Images
from hma_data.episodes.images import prepare
from hma_data.errors import UsageError
from hma_data.lab import FAMILY, RECORDERS, family
from hma_data.registry.embodiment import Embodiment, find

SIZE = 128  # pixels: the side of the frames
Driver = Callable[[], Float32s]


class Simulation(Protocol):
    """A robot and what is around it."""

    @property
    def observed(self) -> Float32s:
        """Return the state (S,) that is recorded with a frame."""

    @property
    def own(self) -> Floats:
        """Return the places (P, 2) of the robot's own parts, in px of a frame of 128 by 128."""

    @property
    def loose(self) -> Floats:
        """Return the places (L, 2) of what lies loose."""

    def picture(self) -> Images:
        """Draw the scene, as the camera records it."""

    def advance(self, action: Float32s, /) -> None:
        """Simulate one control step under an action (A,)."""


class LabSimulator:
    """A robot of the laboratory in one scene, with frames of the size that conversion gives.

    Attributes:
        embodiment: the robot.
        simulation: the robot and what is around it, of a class of the robot's own.

    Raises:
        UsageError: there is no such robot.
        MissingDependencyError: the simulator is not installed.
    """

    def __init__(self, robot: str, seed: int = 0) -> None:
        self.embodiment = embodiment(robot)
        self.reset(seed)

    def reset(self, seed: int, episode: int = 0) -> Images:
        """Begin the scene of an episode that `hma_data.lab.record` numbers so; return its first frame."""
        robot = self.embodiment.id
        module, _ = RECORDERS.get(robot, ("hma_data.lab.family", ""))
        begun: tuple[Simulation, Driver] = import_module(module).begin(robot, seed, episode)
        self.seed, self.episode = seed, episode
        self.simulation, self._driver = begun
        self._commands: list[Float32s] = []
        return self.picture()

    @property
    def state(self) -> Float32s:
        """Return the state (S,) that is recorded with the frame."""
        return self.simulation.observed

    def picture(self) -> Images:
        """Return the scene as the camera sees it; (SIZE, SIZE, 3) RGB."""
        return prepare(self.simulation.picture()[None], self.embodiment.cameras[0], SIZE)[0]

    def step(self, action: Float32s) -> Images:
        """Simulate one control step under an action (A,), and return the frame after it."""
        self.advance(action)
        return self.picture()

    def advance(self, action: Float32s) -> None:
        """Simulate one control step under an action (A,), without a frame."""
        self._commands.append(np.array(action, np.float32))
        self.simulation.advance(self._commands[-1])

    def recorded(self) -> Float32s:
        """Return the action (A,) that the recorder's driver gives here; call it once a step.

        From the beginning of a scene on, these are the actions of the recorded episode.
        """
        return self._driver()

    def copy(self) -> "LabSimulator":
        """Return another simulator in the same state, with a driver that begins anew.

        The physics engines cannot copy their contacts, so the copy repeats all actions since the reset.
        """
        other = LabSimulator(self.embodiment.id, self.seed)
        other.reset(self.seed, self.episode)
        for action in self._commands:
            other.advance(action)
        return other


def simulated(robot: str) -> bool:
    """Check whether the laboratory has a simulator of a robot."""
    return robot in RECORDERS or FAMILY.fullmatch(robot) is not None


def embodiment(robot: str) -> Embodiment:
    """Return the embodiment of a laboratory robot.

    Raises:
        UsageError: there is no such robot.
    """
    if FAMILY.fullmatch(robot):
        return family.embodiment(robot)
    if robot in RECORDERS:
        return find(robot)
    known = f"{', '.join(RECORDERS)}, and the family, such as {family.TRUNK[0]}"
    raise UsageError(robot, "has no simulator in the toolkit", f"known: {known}")
