"""Read the state of a laboratory robot off pictures, and how much of each part they show.

A probe is a small network (`hma_model.evaluation.state_reader`). It learns from episodes that nothing is
measured on; its own error is that on other episodes. The T of a pusher is found by its shape instead: a
network reads the place of a disc to a pixel and that of a T to five, because it does not see how the T lies.

N pictures of S pixels a side, P parts. Places are px of a picture of 128 by 128.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from torch import nn

from hma_data.arrays import Bools, Floats, Images, Ints
from hma_data.episodes.images import prepare
from hma_data.lab import pusht, simulator, truth
from hma_data.lab.pusher import Tee, rotation
from hma_data.tokenizers.base import Tokenizer
from hma_model.evaluation.kept import kept_reader
from hma_model.evaluation.state_reader import (
    INPUT_SIDE,
    UNREADABLE_SHARE,
    PlaceNetwork,
    Tell,
    outputs,
    resized,
    trained,
)

TRAINING_STEPS, LEARNING_RATE = 400, 1e-2
EPISODES, HELD_OUT_SHARE = 40, 0.2  # simulated, and the share that the probe's error is measured on
EPISODE_FRAMES, FRAME_STRIDE = 60, 2  # of an episode; one in so many is kept
FIRST_EPISODE = 1_000_000  # the number of a probe's first episode; those that are measured count from 0
LEAST_SPREAD_PX = 1.0  # a part that moves less is no part of the state
COLOUR_DISTANCE = 45.0  # of RGB, up to which two colours are one
ANGLES = 48  # of a T that are tried
FARTHEST_PX = 20.0  # px of the arena; a pixel farther out of the T counts as that far
FIRST_STEP, LAST_STEP = 8.0, 0.4  # px of the arena, of the search
TURN_RADIUS = 50.0  # px of the arena by which an angle is as long as a step
PROBE_VALUES = ("driven", "error", "spread", "background", "colors")  # of a probe, beside its network
LEAST_AREA = 0.3  # share of the T's area; of fewer pixels no pose is found


@dataclass(frozen=True)
class TeeFinder:
    """Find the T of a pusher by its colour: the pose that holds the pixels of that colour.

    The best of all angles around their middle is improved in ever smaller steps. A pose is (3,) x, y, angle.

    Attributes:
        shape: of the T.
    """

    shape: Tee

    @classmethod
    def of(cls, robot: str) -> "TeeFinder | None":
        """Return the finder of a robot's T; None for a robot without one."""
        return cls(pusht.tee()) if robot in truth.PUSHERS else None

    def within(self, parts: Floats) -> Floats:
        """Return parts (N, P, 2) with the middles of the T's bars instead of the last two, its places."""
        found = parts.copy()
        for row, places in enumerate(parts[:, -2:]):
            pose = pusht.tee_pose(places)
            middles = self.shape.boxes.mean(axis=1) @ rotation(pose[2]).T + pose[:2]
            found[row, -2:] = pusht.PX * middles
        return found

    def find(self, pixels: Bools) -> Floats | None:
        """Return the places (2, 2) of the T that has the pixels (S, S); None if they are too few."""
        size = truth.SIZE / pusht.PX / len(pixels)  # px of the arena
        y, x = np.nonzero(pixels)
        boxes = self.shape.boxes
        areas = (boxes[:, 1] - boxes[:, 0]).prod(axis=1)
        if len(x) * size**2 < LEAST_AREA * areas.sum():
            return None
        points = (np.stack([x, y], axis=1).astype(np.float64) + 0.5) * size
        middle = (boxes.mean(axis=1) * areas[:, None]).sum(axis=0) / areas.sum()
        angles = np.arange(ANGLES) * (2 * np.pi / ANGLES)
        starts = np.array([[*(points.mean(axis=0) - rotation(a) @ middle), a] for a in angles])
        pose = starts[self._outside(points, starts).argmin()]
        return pusht.tee_places(self._nearer(points, pose))

    def _nearer(self, points: Floats, pose: Floats) -> Floats:
        step, best = FIRST_STEP, float(self._outside(points, pose[None])[0])
        ways = np.concatenate([np.eye(3), -np.eye(3)]) * (1, 1, 1 / TURN_RADIUS)
        while step > LAST_STEP:
            tried = pose + step * ways
            found = self._outside(points, tried)
            if found.min() < best:
                pose, best = tried[found.argmin()], float(found.min())
            else:
                step /= 2
        return pose

    def _outside(self, points: Floats, poses: Floats) -> Floats:
        """Return (M,), how far points (n, 2) lie outside the T at each of M poses, in the mean."""
        cos, sin = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
        x, y = points[:, 0] - poses[:, :1], points[:, 1] - poses[:, 1:2]
        local = np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)
        return np.clip(self.shape.distance(local), 0, FARTHEST_PX).mean(axis=1)


@dataclass(frozen=True)
class Probe:
    """A probe of one robot's pictures.

    Attributes:
        network: a trained `PlaceNetwork`; places are -1 to 1.
        driven: how many of the parts are the robot's own.
        error: (P,) mean distance in px from the true places on held-out true pictures.
        spread: (P,) mean distance in px of the true places from their median.
        background: (INPUT_SIDE, INPUT_SIDE, 3), the median of the true pictures.
        colors: (P, 3), of the parts.
        tee: finds the T whose places are the last two; None for a robot without one.
    """

    network: nn.Module
    driven: int
    error: Floats
    spread: Floats
    background: Floats
    colors: Floats
    tee: TeeFinder | None = None

    @property
    def readable(self) -> Bools:
        """Return (P,) whether a part moves and the probe reads its place."""
        return (self.spread > LEAST_SPREAD_PX) & (self.error <= UNREADABLE_SHARE * self.spread)

    @property
    def own(self) -> Ints:
        """Return the numbers of the readable parts that are the robot's own."""
        return np.flatnonzero(self.readable[: self.driven])

    @property
    def loose(self) -> Ints:
        """Return the numbers of the readable parts that lie loose."""
        return self.driven + np.flatnonzero(self.readable[self.driven :])

    def read(self, pictures: Images) -> Floats:
        """Return the places (…, P, 2) of the parts in pictures (…, S, S, 3)."""
        flat = resized(pictures)
        places = (outputs(self.network, flat).reshape(len(flat), -1, 2) + 1) * (truth.SIZE / 2)
        if self.tee is not None:
            for row, mask in enumerate(self._colored(flat)[..., -1]):
                seen = self.tee.find(mask)
                places[row, -2:] = places[row, -2:] if seen is None else seen
        return places.reshape(*pictures.shape[:-3], *places.shape[1:])

    def areas(self, pictures: Images) -> Floats:
        """Return (…, P), how many pixels of (…, S, S, 3) have a part's colour and not the background's."""
        flat = resized(pictures)
        stands = np.linalg.norm(flat - self.background, axis=-1) > COLOUR_DISTANCE
        counts = (stands[..., None] & self._colored(flat)).sum(axis=(1, 2), dtype=np.float64)
        return counts.reshape(*pictures.shape[:-3], len(self.colors))

    def _colored(self, small: Images) -> Bools:
        """Return (N, 64, 64, P), which pixels have a part's colour."""
        values = small.astype(np.float32)
        near = [np.linalg.norm(values - color, axis=-1) <= COLOUR_DISTANCE for color in self.colors]
        return np.stack(near, axis=-1)


def state_errors(probe: Probe, pictures: Images, parts: Floats) -> Floats:
    """Return how far each part is from its true place, as a probe reads it off pictures.

    Args:
        probe: of the robot and the tokenizer of the pictures.
        pictures: (…, S, S, 3) uint8.
        parts: (…, P, 2) true places in px of 128.

    Returns:
        (…, P) in px of 128.
    """
    return np.linalg.norm(probe.read(pictures) - parts, axis=-1)


def as_seen(robot: str, tokenizer: Tokenizer, pictures: Images) -> Images:
    """Return a recorder's pictures (N, …) as the tokenizer takes them (N, S, S, 3)."""
    spec, (camera, *_) = tokenizer.spec, simulator.embodiment(robot).cameras
    return prepare(pictures, camera, spec.image_size, spec.resize_filter)


def as_shown(tokenizer: Tokenizer, pictures: Images) -> Images:
    """Return pictures (N, S, S, 3) as the tokenizer reconstructs them."""
    return tokenizer.decode(tokenizer.encode(pictures))


def train_probe(
    robot: str,
    tokenizer: Tokenizer,
    stride: int,
    seed: int = 0,
    tell: Tell = lambda words: None,
) -> Probe:
    """Train a probe on simulated episodes of a laboratory robot; it takes some 15 CPU seconds, once.

    It is kept on disk for later calls (`hma_model.evaluation.kept`).

    Args:
        robot: a laboratory robot.
        tokenizer: whose pictures the probe is to read.
        stride: control steps a frame.
        seed: of the episodes and the training; the same seed gives the same probe.
        tell: called with how far it is.
    """
    tee = TeeFinder.of(robot)

    def make() -> Probe:
        pictures, made = shown_episodes(robot, tokenizer, stride, seed, tell)
        places, driven = np.concatenate([one.parts for one in made]), made[0].driven
        return fit(pictures, places, driven, seed, tee, tell)

    facts = {"robot": robot, "stride": stride, "seed": seed}
    found = kept_reader("probe", tokenizer, facts, make, PROBE_VALUES, PlaceNetwork)
    return Probe(**found | {"driven": int(found["driven"]), "tee": tee})


def shown_episodes(
    robot: str, tokenizer: Tokenizer, stride: int, seed: int, tell: Tell
) -> tuple[Images, list[truth.TrueEpisode]]:
    """Return simulated episodes, and their pictures (N, S, S, 3) as the tokenizer shows them.

    The episodes have one frame of every FRAME_STRIDE. Arguments are those of `train_probe`.
    """
    shown, kept = [], []
    for count in range(EPISODES):
        made = truth.episode(
            robot, EPISODE_FRAMES, stride, seed, FIRST_EPISODE + count, range(0, EPISODE_FRAMES, FRAME_STRIDE)
        )
        shown.append(as_shown(tokenizer, as_seen(robot, tokenizer, made.pictures)))
        kept.append(replace(made, parts=made.parts[::FRAME_STRIDE], states=made.states[::FRAME_STRIDE]))
        tell(f"simulating episode {count + 1} of {EPISODES}")
    return np.concatenate(shown), kept


def fit(
    pictures: Images,
    parts: Floats,
    driven: int,
    seed: int = 0,
    tee: TeeFinder | None = None,
    tell: Tell = lambda words: None,
) -> Probe:
    """Train a probe on pictures whose state is known; the last ones only measure its error.

    Args:
        pictures: (N, S, S, 3), by episode.
        parts: (N, P, 2) true places in px of 128.
        driven: how many of the parts are the robot's own.
        seed: of the training.
        tee: of a pusher.
        tell: called with how far it is.
    """
    used = round(len(pictures) * (1 - HELD_OUT_SHARE))
    small = resized(pictures)
    targets = (parts[:used] / (truth.SIZE / 2) - 1).reshape(used, -1)
    network = trained(
        partial(PlaceNetwork, parts.shape[1]),
        small[:used],
        targets,
        seed,
        TRAINING_STEPS,
        LEARNING_RATE,
        0.02,
        tell,
    )
    spread = np.linalg.norm(parts - np.median(parts, axis=0), axis=-1).mean(axis=0)
    background = np.median(small[:used], axis=0).astype(np.float32)
    within = parts if tee is None else tee.within(parts)
    colors = _colors(small[:used], within[:used])
    untested = Probe(network, driven, spread, spread, background, colors, tee)
    error = state_errors(untested, pictures[used:], parts[used:]).mean(axis=0)
    return replace(untested, error=error)


def _colors(small: Images, parts: Floats) -> Floats:
    """Return the (P, 3) median colours of pictures at places within the parts."""
    x, y = np.clip(parts * (INPUT_SIDE / truth.SIZE), 0, INPUT_SIDE - 1).astype(int).transpose(2, 0, 1)
    return np.median(small[np.arange(len(small))[:, None], y, x], axis=0).astype(np.float32)
