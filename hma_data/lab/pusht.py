"""Record Push-T as two robots: one position-controlled to HDF5, one velocity-controlled to MCAP.

Both push a T toward its goal pose on the table of gym-pusht (`hma_data.lab.tee_table`):

    pusht_fast  10 Hz   action (x, y): target of the pusher in px, the environment's native action
    pusht_slow   5 Hz   action (vx, vy, lift): velocity in px/s; lift 1 raises the pusher over the T,
                        which it then no longer touches. Camera 12.5 Hz, joint states 20 Hz

Of five episodes, three are planned pushes from near the goal, one is planned from anywhere, and one moves
at random. Success is the environment's own: the T covers more than 95 % of the goal. An episode ends soon
after success, or else after a fixed time.
"""

from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hma_data.arrays import Float32s, Floats, Images
from hma_data.lab.pusher import Planned, Tee, Wandering, rotation
from hma_data.lab.tee_table import GOAL, SIDE, TICK_S, TeeTable
from hma_data.lab.writers import BagEpisode, Demo, write_hdf5, write_mcap

SUCCESS = 0.95  # share of the goal that the T covers
LAG_S = 0.2  # delay of the pusher's spring (k_v / k_p of the environment) behind a moving target
SPEED = 300.0  # px/s of planned motion
PLACED_PX = 4.0  # mean distance of the T's corners from the goal at which a driver that looks has done
STARTS = ("near", "random", "near", "far", "near")


class FrameLook(NamedTuple):
    """The side of a robot's square frames in px, and the names of their colours."""

    size: int
    block: str
    pusher: str
    raised: str


FAST_LOOK = FrameLook(128, "LightSlateGray", "RoyalBlue", "RoyalBlue")
SLOW_LOOK = FrameLook(96, "Peru", "Crimson", "DodgerBlue")
FAST_STEPS, SLOW_TICKS = 80, 720
CAMERA_TICKS, COMMAND_TICKS = 8, 20  # of pusht_slow: from one frame, and one action, to the next
FAST_PERIOD_S = 0.1
STEPS_HELD = 4  # control steps for which a random target is held
PX = 128 / SIDE  # px of a frame of 128 in one of the arena
STEM = np.array([0.0, 70.0])  # a point on the T's stem, px of the arena
SHORTEST_S = 4.0  # of an episode
REST_S = 0.6  # recorded after success


def record(part: Path, robot: str, episodes: Iterable[int], seed: int) -> None:
    """Record `pusht_fast` as a file of robomimic's layout, `pusht_slow` as a folder of MCAP files."""
    if robot == "pusht_fast":
        write_fast(part, (fast_demo(seed, episode) for episode in episodes))
    else:
        part.mkdir()
        for episode in episodes:
            _slow_bag(part / f"episode_{episode:04d}.mcap", seed, episode)


def write_fast(part: Path, demos: Iterable[Demo], look: FrameLook = FAST_LOOK) -> None:
    """Write episodes of `pusht_fast` as a file of robomimic's layout."""
    kwargs = {"observation_width": look.size, "observation_height": look.size}
    env_args = {"env_name": "gym_pusht/PushT-v0", "type": 2, "env_kwargs": kwargs}
    write_hdf5(part, demos, env_args)


class PushArena:
    """The table, with the parts of its state that the robots need; `start` is one of STARTS."""

    def __init__(self, look: FrameLook, start: str, rng: np.random.Generator) -> None:
        self._size = look.size
        dice = np.random.default_rng(int(rng.integers(2**31)))
        places = [dice.integers(low, high) for low, high in ((50, 450), (50, 450), (100, 400), (100, 400))]
        self._table = TeeTable(np.array([*places, dice.uniform(-np.pi, np.pi)]))
        bars = sorted(sorted(bar.get_vertices()) for bar in self._table.bars)
        boxes = [(np.min(corners, axis=0), np.max(corners, axis=0)) for corners in bars]
        body, (pusher,) = self._table.block, self._table.agent.shapes
        center = np.array(body.center_of_gravity)
        self.tee = Tee(np.array(boxes), center, body.mass, body.moment, pusher.radius)
        self.goal: Floats = np.array(GOAL)
        if start == "near":
            self._table.reset(self._near_goal(rng))
        self._table.paint(look.block)
        self._colors = {True: look.raised, False: look.pusher}
        self.raised = False
        self.lift(False)
        self.ticks, self.reward, self.success = 0, 0.0, False

    def _near_goal(self, rng: np.random.Generator) -> Floats:
        """Return a state (5,) with the T within about 50 px and 0.5 rad of its goal.

        The environment sets the angle after the position and rotates about the centre of mass, which moves
        the T. The position returned here compensates for that.
        """
        x, y, angle = self.goal + rng.normal(0, (35, 35, 0.5))
        place = np.array([x, y]) - self.tee.center + rotation(angle) @ self.tee.center
        return np.array([*rng.uniform(50, 450, 2), *place, angle])

    @property
    def pose(self) -> Floats:
        """Return (3,) x, y, angle of the T."""
        return np.array([*self._table.block.position, self._table.block.angle])

    @property
    def agent(self) -> Floats:
        """Return the (2,) centre of the pusher."""
        return np.array(self._table.agent.position)

    @property
    def velocity(self) -> Floats:
        """Return the (2,) velocity of the pusher in px/s."""
        return np.array(self._table.agent.velocity)

    @property
    def state(self) -> Floats:
        """Return (5,) pusher x, y, T x, y, angle: the environment's observation."""
        return np.append(np.concatenate([self.agent, self.pose[:2]]), self.pose[2] % (2 * np.pi))

    def picture(self) -> Images:
        """Render the arena; (size, size, 3) RGB."""
        return self._table.picture(self._size)

    def lift(self, up: bool) -> None:
        """Raise or lower the pusher; it cannot be lowered over the T."""
        local = (self.agent - self.pose[:2]) @ rotation(self.pose[2])
        over = float(self.tee.distance(local)) < self.tee.radius
        self.raised = up or (self.raised and over)
        self._table.raise_disc(self.raised, self._colors[self.raised])

    def advance(self, target: Floats, ticks: int) -> None:
        """Run the physics for `ticks` while a spring pulls the pusher to `target` (2,)."""
        self._table.advance(target, ticks)
        coverage = self._table.coverage()
        self.reward = round(min(coverage / SUCCESS, 1.0), 9)
        self.ticks += ticks
        self.success = self.success or coverage > SUCCESS


def _within(target: Floats) -> Floats:
    return np.clip(target, 15.0, 497.0)


class _Pusher:
    """What both robots have: an arena, which the camera shows whole, and the generator of their driver."""

    def __init__(self, look: FrameLook, seed: tuple[int, ...], start: str) -> None:
        self.rng, self.start = np.random.default_rng(seed), start
        self.arena = PushArena(look, start, self.rng)

    @property
    def own(self) -> Floats:
        """Return the middle (1, 2) of the pusher in a frame of 128 px."""
        return PX * self.arena.agent[None]

    @property
    def loose(self) -> Floats:
        """Return two places (2, 2) of the T in a frame of 128 px: its origin, and a point on its stem."""
        return tee_places(self.arena.pose)

    def picture(self) -> Images:
        """Render the arena; (size, size, 3) RGB."""
        return self.arena.picture()

    def _policy(self, fly: bool) -> Planned | Wandering:
        arena = self.arena
        if self.start == "random":
            return Wandering(arena.agent, fly, self.rng)
        return Planned(arena.tee, arena.goal, arena.agent, SPEED, fly, self.rng)


def begin(robot: str, seed: int, episode: int) -> "tuple[FastPusher | SlowPusher, Callable[[], Float32s]]":
    """Return the simulation of an episode at its start, and the recorder's driver."""
    pusher = FastPusher(seed, episode) if robot == "pusht_fast" else SlowPusher(seed, episode)
    return pusher, pusher.driver()


def tee_pose(places: Floats) -> Floats:
    """Return the pose (3,) x, y, angle of the T, in px of the arena, whose places (2, 2) these are."""
    along = places[1] - places[0]
    return np.append(places[0] / PX, np.arctan2(along[1], along[0]) - np.arctan2(STEM[1], STEM[0]))


def tee_places(pose: Floats) -> Floats:
    """Return two places (2, 2) of the T in a frame of 128 px, for its pose (3,) in px of the arena."""
    return PX * np.stack([pose[:2], pose[:2] + rotation(pose[2]) @ STEM])


# -- pusht_fast


class FastPusher(_Pusher):
    """pusht_fast: an arena whose actions are targets of the pusher, one each 0.1 s."""

    def __init__(
        self, seed: int, episode: int, look: FrameLook = FAST_LOOK, starts: tuple[str, ...] = STARTS
    ) -> None:
        super().__init__(look, (seed, 0, episode), starts[episode % len(starts)])

    @property
    def observed(self) -> Float32s:
        """Return the centre (2,) of the pusher, as recorded."""
        return self.arena.agent.astype(np.float32)

    def advance(self, action: Float32s) -> None:
        """Simulate 0.1 s with the target at (x, y)."""
        self.arena.advance(action.astype(np.float64), round(FAST_PERIOD_S / TICK_S))

    def driver(self) -> Callable[[], Float32s]:
        """Return the recorder's driver of the episode, which returns the next action (2,)."""
        arena = self.arena
        targets = Targets(self._policy(fly=False), arena.agent)
        return lambda: targets.held if arena.success else targets.next(arena.pose, arena.agent)


class Targets:
    """The actions of pusht_fast under which the pusher goes where a policy wants it.

    Args:
        policy: gives the setpoints.
        agent: (2,) where the pusher is.
    """

    def __init__(self, policy: Planned | Wandering, agent: Floats) -> None:
        self._policy, self._setpoint = policy, agent

    @property
    def held(self) -> Float32s:
        """Return the action (2,) that lets the pusher stay at the last setpoint."""
        return _within(self._setpoint).astype(np.float32)

    def next(self, pose: Floats, agent: Floats) -> Float32s:
        """Return the next action (2,), for a pose (3,) of the T and a place (2,) of the pusher."""
        ahead, _ = self._policy.act(pose, agent, FAST_PERIOD_S)
        lead = (LAG_S - FAST_PERIOD_S / 2) / FAST_PERIOD_S
        target = _within(ahead + (ahead - self._setpoint) * lead)
        self._setpoint = ahead
        return target.astype(np.float32)


def pusher_of(agent: Floats, rng: np.random.Generator) -> Callable[[Floats, Floats], Float32s]:
    """Return a driver of pusht_fast that looks: from the pose (3,) of the T and the place of the pusher.

    It plans as the recorder's does, and stays where it is once the T lies on its goal.
    """
    goal = np.array(GOAL)
    targets = Targets(Planned(tee(), goal, agent, SPEED, False, rng), agent)

    def drive(pose: Floats, agent: Floats) -> Float32s:
        off = np.linalg.norm(tee().placed(pose) - tee().placed(goal), axis=-1).mean()
        return targets.held if off < PLACED_PX else targets.next(pose, agent)

    return drive


@cache
def tee() -> Tee:
    """Return the T of both robots."""
    return PushArena(FAST_LOOK, "far", np.random.default_rng(0)).tee


def fast_demo(
    seed: int, episode: int, noise: float = 0.0, look: FrameLook = FAST_LOOK, starts: tuple[str, ...] = STARTS
) -> Demo:
    """Simulate an episode of `pusht_fast`; `noise` is the share of its targets that are random."""
    dice, target = np.random.default_rng((seed, 2, episode)), None
    robot = FastPusher(seed, episode, look, starts)
    arena, drive = robot.arena, robot.driver()
    period, stop = FAST_PERIOD_S, FAST_STEPS
    rows: list[tuple[Any, ...]] = []
    while len(rows) < stop:
        seen = arena.picture(), arena.agent, arena.state
        before, action = arena.success, drive()
        if len(rows) % STEPS_HELD == 0:
            target = dice.uniform(15, 497, 2).astype(np.float32) if dice.random() < noise else None
        action = action if target is None else target
        robot.advance(action)
        rows.append((*seen, action, arena.reward))
        if arena.success and not before:
            stop = min(stop, max(round(SHORTEST_S / period), len(rows) + round(REST_S / period)))
    images, positions, states, actions, rewards = map(np.stack, zip(*rows, strict=True))
    return Demo(
        actions=actions,
        observations={"image": images, "agent_pos": positions},
        states=states,
        rewards=rewards,
        success=arena.success,
        facts={"start": robot.start, "seed": seed, **({"noise": noise} if noise else {})},
    )


# -- pusht_slow


class SlowPusher(_Pusher):
    """pusht_slow: an arena whose actions are the velocity of the pusher's setpoint, and whether it is up."""

    def __init__(self, seed: int, episode: int) -> None:
        super().__init__(SLOW_LOOK, (seed, 1, episode), STARTS[episode % len(STARTS)])
        self.setpoint = self.arena.agent
        self.velocity: Floats = np.zeros(2)

    @property
    def observed(self) -> Float32s:
        """Return (3,) the centre of the pusher, and 1 if it is up, as recorded."""
        return np.append(self.arena.agent, self.arena.raised).astype(np.float32)

    def take(self, action: Floats | Float32s) -> None:
        """Set the velocity (vx, vy) in px/s, and raise or lower the pusher."""
        self.velocity = action[:2].astype(np.float64)
        self.arena.lift(bool(action[2] > 0.5))

    def run(self, ticks: int) -> None:
        """Run the physics for `ticks` under the action in force."""
        self.setpoint = _within(self.setpoint + self.velocity * ticks * TICK_S)
        self.arena.advance(_within(self.setpoint + self.velocity * (LAG_S - ticks * TICK_S / 2)), ticks)

    def advance(self, action: Floats | Float32s) -> None:
        """Simulate the time from one frame to the next under an action (3,)."""
        self.take(action)
        self.run(CAMERA_TICKS)

    def commander(self) -> Callable[[], Floats]:
        """Return the recorder's driver of the episode; it returns (3,) an action for COMMAND_TICKS."""
        arena, policy = self.arena, self._policy(fly=True)
        period = COMMAND_TICKS * TICK_S

        def action() -> Floats:
            ahead, up = policy.act(arena.pose, arena.agent, period)
            if arena.success:
                return np.zeros(3)
            return np.append((ahead - self.setpoint) / period, up)

        return action

    def driver(self) -> Callable[[], Float32s]:
        """Return a driver that returns (3,) the action in force at each frame, as it is recorded."""
        commander, due = self.commander(), self.arena.ticks
        held: Floats = np.zeros(3)

        def drive() -> Float32s:
            nonlocal due, held
            if self.arena.ticks >= due:
                held, due = commander(), due + COMMAND_TICKS
            return held.astype(np.float32)

        return drive


def _slow_schedule(rng: np.random.Generator) -> list[tuple[int, str]]:
    """Return (tick, event) in order; camera and actions jitter by a tick, and stamps give the true time."""
    events = [(tick, "joints") for tick in range(0, SLOW_TICKS, 5)]
    events += [(tick + int(rng.integers(-1, 2)), "command") for tick in range(2, SLOW_TICKS, COMMAND_TICKS)]
    events += [(tick + int(rng.integers(-1, 2)), "camera") for tick in range(3, SLOW_TICKS, CAMERA_TICKS)]
    return sorted(events)


def _slow_bag(path: Path, seed: int, episode: int) -> None:
    robot = SlowPusher(seed, episode)
    arena, rng, action, stop = robot.arena, robot.rng, robot.commander(), SLOW_TICKS
    bag = BagEpisode(episode, "arena", rng)
    for tick, event in _slow_schedule(rng):
        if tick >= stop:
            break
        if ticks := tick - arena.ticks:
            before = arena.success
            robot.run(ticks)
            if arena.success and not before:
                stop = min(stop, max(round(SHORTEST_S / TICK_S), tick + round(REST_S / TICK_S)))
        at = tick * round(TICK_S * 1e9)
        if event == "camera":
            bag.image(at, arena.picture())
        elif event == "joints":
            place, motion = np.append(arena.agent, arena.raised), np.append(arena.velocity, 0.0)
            bag.joints(at, ["x", "y", "lift"], place, motion)
        else:
            given = action()
            robot.take(given)
            bag.command(at, given)
    facts = {"success": str(arena.success).lower(), "start": robot.start, "seed": str(seed)}
    write_mcap(path, bag.messages, {"robot": "pusht_slow", **facts})
