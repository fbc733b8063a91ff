"""Record gymnasium's Pendulum-v1 to RLDS: a rod on an axle, driven by a torque at 20 Hz.

The physics and the frame are the environment's own. The camera is zoomed in on the rod, and an arrow round
the axle shows the last torque. The torque of a step is applied between its frame and the next. Episodes
begin at random angles and speeds and last 5 s; the driver changes from one to the next, in the order of
DRIVERS.

Angles are radians from upright, speeds rad/s, torques N·m. T frames.
"""

from collections.abc import Callable, Iterable
from itertools import count
from pathlib import Path

import numpy as np

from hma_data.arrays import Float32s, Floats, Images
from hma_data.lab import imported
from hma_data.lab.family.look import direction, wrapped
from hma_data.lab.writers import RldsEpisode, write_rlds

Manoeuvre = Callable[[float, float], float]  # (angle, speed) -> torque

STEPS, PERIOD_S = 100, 0.05
TORQUE = 2.0  # the environment's limit
ROD = 26.0  # px of the frame from the axle to the middle of the rod
SIZE, ZOOMED, DRAWN = 128, 256, 464  # pixels: the frame, the square that it shows, the whole drawing


def record(part: Path, robot: str, episodes: Iterable[int], seed: int) -> None:
    """Record the pendulum as a TFDS folder; see `hma_data.lab`."""
    write_rlds(part, robot, {"observation/image": (SIZE, SIZE)}, "png", (_episode(seed, i) for i in episodes))


class Pendulum:
    """The environment at a given start.

    Raises:
        MissingDependencyError: gymnasium or pygame is not installed.
    """

    def __init__(self, angle: float, speed: float) -> None:
        with imported("gymnasium's Pendulum-v1"):
            from gymnasium.envs.classic_control.pendulum import PendulumEnv
            from pygame import Surface
            from pygame.time import Clock
        self._env = PendulumEnv(render_mode="rgb_array")
        self._env.screen_dim = DRAWN
        self._env.screen, self._env.clock = Surface((DRAWN, DRAWN)), Clock()  # or it looks for a display
        self._env.reset(seed=0)
        self._env.state = np.array([angle, speed])

    @property
    def angle(self) -> float:
        """Return the angle from upright, within ±π."""
        return float(wrapped(self._env.state[0]))

    @property
    def speed(self) -> float:
        """Return the angular speed."""
        return float(self._env.state[1])

    @property
    def observed(self) -> Float32s:
        """Return (3,) cosine and sine of the angle, and the speed: the environment's observation."""
        return np.append(direction(self.angle), self.speed).astype(np.float32)

    @property
    def own(self) -> Floats:
        """Return the middle (1, 2) of the rod in the frame."""
        return SIZE / 2 - ROD * direction(self.angle)[None, ::-1]

    @property
    def loose(self) -> Floats:
        """Return no places (0, 2): nothing lies loose."""
        return np.empty((0, 2))

    def picture(self) -> Images:
        """Render the rod; (SIZE, SIZE, 3) RGB."""
        import cv2

        edge = (DRAWN - ZOOMED) // 2
        pixels = np.ascontiguousarray(self._env.render()[edge : edge + ZOOMED, edge : edge + ZOOMED])
        small: Images = cv2.resize(pixels, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
        return small

    def advance(self, action: Float32s) -> None:
        """Simulate one period under a torque (1,)."""
        self._env.step(action)


def begin(robot: str, seed: int, episode: int) -> tuple[Pendulum, Callable[[], Float32s]]:
    """Return the simulation of an episode at its start, and the recorder's driver of torques (1,)."""
    rng = np.random.default_rng((seed, 2, episode))
    world = Pendulum(rng.uniform(-np.pi, np.pi), rng.uniform(-4, 4))
    _, manoeuvre = DRIVERS[episode % len(DRIVERS)]
    drive = manoeuvre(rng)

    def act() -> Float32s:
        return np.array([np.clip(drive(world.angle, world.speed), -TORQUE, TORQUE)], dtype=np.float32)

    return world, act


def _episode(seed: int, episode: int) -> RldsEpisode:
    import cv2

    world, drive = begin("pendulum", seed, episode)
    instruction, _ = DRIVERS[episode % len(DRIVERS)]
    pictures, observations, actions = [], [], []
    for _ in range(STEPS):
        _, png = cv2.imencode(".png", world.picture()[..., ::-1])
        pictures.append(png.tobytes())
        observations.append(world.observed)
        actions.append(drive())
        world.advance(actions[-1])
    vectors = {"action": np.stack(actions), "observation/state": np.stack(observations)}
    return RldsEpisode({"observation/image": pictures}, vectors, instruction)


# -- drivers


def _upward(rng: np.random.Generator) -> Manoeuvre:
    """Return a driver that swings the rod up and balances it, disturbed by random knocks."""
    gain, noise, clumsy = rng.uniform(0.5, 2.0), rng.uniform(0.05, 0.4), rng.uniform(0.0, 0.04)
    knock = [0, 0.0]  # steps left, torque

    def drive(angle: float, speed: float) -> float:
        if knock[0] <= 0 and rng.random() < clumsy:
            knock[:] = [int(rng.integers(4, 9)), float(rng.choice((-TORQUE, TORQUE)))]
        if knock[0] > 0:
            knock[0] -= 1
            return knock[1]
        if abs(angle) < 0.35 and abs(speed) < 2.5:
            return -10 * angle - 2 * speed + rng.normal(0, noise)
        lacking = 5 * (1 - np.cos(angle)) - speed**2 / 6
        return float(gain * lacking * (1 if speed >= 0 else -1) + rng.normal(0, noise))

    return drive


def _smooth(rng: np.random.Generator) -> Manoeuvre:
    hz, phase = rng.uniform(0.1, 1.5, 3), rng.uniform(0, 2 * np.pi, 3)
    strength = rng.uniform(0.4, 1.6, 3)
    seconds = (step * PERIOD_S for step in count())
    return lambda angle, speed: float(strength @ np.sin(2 * np.pi * hz * next(seconds) + phase))


def _held(torque: Callable[[], float], shortest: int, longest: int, rng: np.random.Generator) -> Manoeuvre:
    values: list[float] = []

    def drive(angle: float, speed: float) -> float:
        if not values:
            values.extend([torque()] * int(rng.integers(shortest, longest + 1)))
        return values.pop()

    return drive


def _bang_bang(rng: np.random.Generator) -> Manoeuvre:
    return _held(lambda: float(rng.choice((-TORQUE, TORQUE))), 2, 12, rng)


def _steps(rng: np.random.Generator) -> Manoeuvre:
    def torque() -> float:
        return 0.0 if rng.random() < 0.15 else float(rng.uniform(-TORQUE, TORQUE))

    return _held(torque, 4, 20, rng)


DRIVERS: tuple[tuple[str, Callable[[np.random.Generator], Manoeuvre]], ...] = (
    ("swing the rod up and hold it there", _upward),
    ("turn the rod with smooth torques", _smooth),
    ("turn the rod with full torque either way", _bang_bang),
    ("turn the rod with held torques", _steps),
)
