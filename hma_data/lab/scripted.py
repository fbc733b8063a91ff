"""Drive a laboratory robot by its recorder's manoeuvres, from its state in the simulator or off frames.

The driver of the family and of `planar_arm` needs a pose, and where the blocks lie. `SeenPose` finds both
from the places of the parts in a frame: it looks for the pose whose parts lie there, and between frames
lets the actions move it. What no place shows, such as a hoist or a magnet, only the actions move. The
pose of `pusht_fast` is the place of its pusher, and two points of the T are its blocks: `SeenPush`.

Q values of a pose, A of an action, P own parts, B blocks; places are px of an image of 128 by 128.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np

from hma_data.arrays import Float32s, Floats, Ints
from hma_data.lab import FAMILY, planar_arm, pusht
from hma_data.lab.family.bodies import Body
from hma_data.lab.family.driver import Driver, Reacher
from hma_data.lab.family.look import wrapped
from hma_data.lab.family.table import REACH, BlockTable
from hma_data.lab.simulator import Simulation

PUSHER = "pusht_fast"
STARTS, ROUNDS = 24, 20  # random poses that a first search begins from, and steps of a search


@dataclass(frozen=True)
class SceneState:
    """The scene as a driver sees it: a pose (Q,), blocks (B, 2), and whether one of them is carried."""

    pose: Floats
    blocks: Floats
    holding: bool


def steerable(robot: str) -> bool:
    """Check whether a robot can be driven from a state, rather than by its simulator alone."""
    return robot in ("planar_arm", PUSHER) or FAMILY.fullmatch(robot) is not None


def state_of(simulation: Simulation) -> SceneState:
    """Return the true state of a robot that is steerable."""
    if isinstance(simulation, BlockTable):
        return SceneState(simulation.pose, simulation.loose, simulation.held >= 0)
    if isinstance(simulation, pusht.FastPusher):
        return SceneState(simulation.arena.agent, simulation.loose, False)
    assert isinstance(simulation, planar_arm.PlanarArm)
    return SceneState(simulation.angles, simulation.loose, False)


def reacher(robot: str) -> Callable[[SceneState], Float32s]:
    """Return a driver of a robot of the family that goes to the block that lies nearest.

    Raises:
        UsageError: the robot is none of the family.
    """
    drive = Reacher(Body.of(robot))
    return lambda state: drive(state.pose, state.blocks, state.holding).astype(np.float32)


def driver(robot: str, pose: Floats, rng: np.random.Generator) -> Callable[[SceneState], Float32s]:
    """Return a driver that begins at a pose (Q,): from a state it tells the next action (A,)."""
    if FAMILY.fullmatch(robot):
        drive = Driver(Body.of(robot), pose, rng)
        return lambda state: drive(state.pose, state.blocks, state.holding).astype(np.float32)
    if robot == PUSHER:
        push = pusht.pusher_of(pose, rng)
        return lambda state: push(pusht.tee_pose(state.blocks), state.pose)
    arm = SimpleNamespace(angles=pose, blocks=np.zeros((1, 2)))
    next_command = planar_arm.driver(arm, rng)  # type: ignore[arg-type]

    def action(state: SceneState) -> Float32s:
        arm.angles, arm.blocks = state.pose, state.blocks / planar_arm.PX
        return next_command()

    return action


def seen_state(robot: str, own: Ints, places: Floats) -> "SeenPush | SeenPose":
    """Return the state of a steerable robot in a first frame.

    Args:
        robot: its name.
        own: numbers of the own parts whose places can be trusted.
        places: (P + B, 2), as a probe reads them off the frame.
    """
    return SeenPush(places) if robot == PUSHER else SeenPose(robot, own, places)


class SeenPush:
    """The state of pusht_fast: the pusher follows its target with the lag of its spring."""

    state: SceneState

    def __init__(self, places: Floats) -> None:
        self.see(places)

    def move(self, action: Float32s) -> None:
        """Take an action (A,) that was given, until the next frame."""
        agent = self.state.pose
        moved = agent + (action - agent) * (1 - np.exp(-pusht.FAST_PERIOD_S / pusht.LAG_S))
        self.state = replace(self.state, pose=moved)

    def see(self, places: Floats) -> None:
        """Take the places (P + B, 2) of a new frame."""
        self.state = SceneState(places[0] / pusht.PX, places[1:], False)


class SeenPose:
    """The state of a robot of the family or `planar_arm`; the arguments are those of `seen_state`."""

    def __init__(self, robot: str, own: Ints, places: Floats) -> None:
        self._own = own
        self._body = body = Body.of(robot) if FAMILY.fullmatch(robot) else None
        self._forward: Callable[[Floats], Floats] = body.own if body else planar_arm.link_middles
        self._bounded: Callable[[Floats], Floats] = body.bounded if body else wrapped
        low, high = body.limits if body else np.array([[-np.pi, -np.pi], [np.pi, np.pi]])
        self._width = high - low
        starts = np.random.default_rng(0).uniform(low, high, (STARTS, len(low)))
        found = [self._search(start, places) for start in starts]
        self.pose = min(found, key=lambda pose: float(np.square(self._miss(pose, places)).sum()))
        self._blocks = places[len(self._forward(self.pose)) :]

    @property
    def state(self) -> SceneState:
        """Return the state as it is now."""
        holding = False
        if self._body and self._body.holds(self.pose):
            tip, _ = self._body.mechanism.tip(self.pose)
            holding = bool((np.linalg.norm(self._blocks - tip, axis=1) < REACH).any())
        return SceneState(self.pose, self._blocks, holding)

    def move(self, action: Float32s) -> None:
        """See SeenPush."""
        if self._body:
            self.pose = self._body.moved(self.pose, action.astype(np.float64))
        else:
            self.pose = self.pose + action / planar_arm.HZ

    def see(self, places: Floats) -> None:
        """See SeenPush."""
        self.pose = self._search(self.pose, places)
        self._blocks = places[len(places) - len(self._blocks) :]

    def _miss(self, pose: Floats, places: Floats) -> Floats:
        return (self._forward(pose)[self._own] - places[self._own]).ravel()

    def _search(self, pose: Floats, places: Floats) -> Floats:
        """Return the pose near another whose parts lie at places."""
        from scipy.optimize import least_squares

        found = least_squares(self._miss, pose, x_scale=self._width, max_nfev=ROUNDS, args=(places,)).x
        return self._bounded(found)
