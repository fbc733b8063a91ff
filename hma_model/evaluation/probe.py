"""Read the state of a laboratory robot off pictures, and measure how whole they are.

A probe has about 3,600 weights: convolutions make one map a part, the softmax of a map is a distribution over
the picture, and its mean is the part's place (Sun et al. 2018, integral regression). A linear layer, at first
the identity, corrects the places from one another. It learns from true pictures as the tokenizer shows them,
with slight noise, and from episodes that nothing is measured on. Its own error is that on other episodes.
The T of a pusher is found by its shape (`hma_model.evaluation.tee`).

A picture may lose a limb and still have small errors of its pixels. `wholeness` therefore counts the pixels
of each part's colour, wherever they are. A true picture of another time has some 0.9.

N pictures of S pixels a side, P parts. Places are px of a picture of 128 by 128.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hma_data.episodes.images import opencv, prepare
from hma_data.lab import simulator, truth
from hma_model.evaluation.tee import TeeFinder

if TYPE_CHECKING:
    from hma_data.tokenizers.base import Tokenizer

Floats = NDArray[np.float64]
Images = NDArray[np.uint8]

INPUT_SIDE, MAP_SIDE = 64, 32  # pixels of the images that a probe sees, and cells of its maps
CHANNELS, SHARPNESS = 16, 4.0
TRAINING_STEPS, BATCH_SIZE, LEARNING_RATE = 400, 32, 1e-2
NOISE = 0.03  # in images of -1 to 1
EPISODES, HELD_OUT_EPISODES = 40, 8  # simulated, and of them those that the probe's error is measured on
EPISODE_FRAMES, FRAME_STRIDE = 60, 2  # of an episode; one in so many is kept
FIRST_EPISODE = 1_000_000  # the number of a probe's first episode; those that are measured count from 0
LEAST_SPREAD_PX = 1.0  # a part that moves less is no part of the state
UNREADABLE_SHARE = 0.5  # of a part's spread; a probe with a larger error does not read it
COLOUR_DISTANCE = 45.0  # of RGB, up to which two colours are one
LEAST_PIXELS = 3  # of a part that is seen


def feature_maps(count: int, kernel: int) -> nn.Sequential:
    """Return layers from pictures (N, 3, 64, 64) to maps (N, count, MAP_SIDE, MAP_SIDE)."""
    return nn.Sequential(
        nn.Conv2d(3, CHANNELS, 5, stride=2, padding=2),
        nn.GELU(),
        nn.Conv2d(CHANNELS, CHANNELS, 3, padding=2, dilation=2),
        nn.GELU(),
        nn.Conv2d(CHANNELS, count, kernel, padding=kernel // 2),
    )


def map_grid() -> Tensor:
    """Return the places (MAPS², 2) of a map's cells, x and y from -1 to 1."""
    line = (torch.arange(MAP_SIDE) + 0.5) * (2 / MAP_SIDE) - 1
    return torch.stack(torch.meshgrid(line, line, indexing="xy"), -1).view(-1, 2)


class PlaceNetwork(nn.Module):
    """A network that finds parts in pictures (N, 3, 64, 64); pixels and places (N, P, 2) are -1 to 1."""

    def __init__(self, parts: int) -> None:
        super().__init__()
        self.maps = feature_maps(parts, kernel=1)
        self.correct = nn.Linear(2 * parts, 2 * parts)
        # at first the places stay as they are read; training learns only what to correct
        nn.init.eye_(self.correct.weight)
        nn.init.zeros_(self.correct.bias)
        self.register_buffer("grid", map_grid())

    def forward(self, pictures: Tensor) -> Tensor:
        chance = (self.maps(pictures).flatten(2) * SHARPNESS).softmax(-1)
        places = chance @ self.grid
        return self.correct(places.flatten(1)).view_as(places)


@dataclass(frozen=True)
class Probe:
    """A probe of one robot's pictures.

    Attributes:
        network: a trained `PlaceNetwork`.
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
    def readable(self) -> NDArray[np.bool_]:
        """Return (P,) whether a part moves and the probe reads its place."""
        return (self.spread > LEAST_SPREAD_PX) & (self.error <= UNREADABLE_SHARE * self.spread)

    @property
    def own(self) -> NDArray[np.int64]:
        """Return the numbers of the readable parts that are the robot's own."""
        return np.flatnonzero(self.readable[: self.driven])

    @property
    def loose(self) -> NDArray[np.int64]:
        """Return the numbers of the readable parts that lie loose."""
        return self.driven + np.flatnonzero(self.readable[self.driven :])

    @torch.no_grad()
    def read(self, pictures: Images) -> Floats:
        """Return the places (…, P, 2) of the parts in pictures (…, S, S, 3)."""
        flat = resized(pictures.reshape(-1, *pictures.shape[-3:]))
        found = torch.cat([self.network(pixels(part)) for part in np.array_split(flat, len(flat) // 64 + 1)])
        places: Floats = (found.double().numpy() + 1) * (truth.SIZE / 2)
        if self.tee is not None:
            for row, mask in enumerate(self._colored(flat)[..., -1]):
                seen = self.tee.find(mask)
                places[row, -2:] = places[row, -2:] if seen is None else seen
        return places.reshape(*pictures.shape[:-3], *places.shape[1:])

    def areas(self, pictures: Images) -> Floats:
        """Return (…, P), how many pixels of (…, S, S, 3) have a part's colour and not the background's."""
        flat = resized(pictures.reshape(-1, *pictures.shape[-3:]))
        stands = np.linalg.norm(flat - self.background, axis=-1) > COLOUR_DISTANCE
        counts: Floats = (stands[..., None] & self._colored(flat)).sum(axis=(1, 2), dtype=np.float64)
        return counts.reshape(*pictures.shape[:-3], len(self.colors))

    def _colored(self, small: Images) -> NDArray[np.bool_]:
        """Return (N, 64, 64, P), which pixels have a part's colour."""
        values = small.astype(np.float32)
        near = [np.linalg.norm(values - color, axis=-1) <= COLOUR_DISTANCE for color in self.colors]
        return np.stack(near, axis=-1)

    def wholeness(self, pictures: Images, true: Images) -> Floats:
        """Return how much of the robot of true pictures (…, S, S, 3) others show; 1 is all of it.

        It is the mean over the robot's readable parts that the true picture shows.
        """
        wanted, given = (self.areas(some)[..., self.own] for some in (true, pictures))
        seen = wanted >= LEAST_PIXELS
        kept: Floats = np.where(seen, np.minimum(given / np.maximum(wanted, 1), 1), 0).sum(axis=-1)
        return kept / np.maximum(seen.sum(axis=-1), 1)


def state_errors(probe: Probe, pictures: Images, parts: Floats) -> Floats:
    """Return how far each part is from its true place, as a probe reads it off pictures.

    Args:
        probe: of the robot and the tokenizer of the pictures.
        pictures: (…, S, S, 3) uint8.
        parts: (…, P, 2) true places in px of 128.

    Returns:
        (…, P) in px of 128.
    """
    errors: Floats = np.linalg.norm(probe.read(pictures) - parts, axis=-1)
    return errors


def as_seen(robot: str, tokenizer: "Tokenizer", pictures: Images) -> Images:
    """Return a recorder's pictures (N, …) as the tokenizer takes them (N, S, S, 3)."""
    spec, (camera, *_) = tokenizer.spec, simulator.embodiment(robot).cameras
    return prepare(pictures, camera, spec.image_size, spec.resize_filter)


def as_shown(tokenizer: "Tokenizer", pictures: Images) -> Images:
    """Return pictures (N, S, S, 3) as the tokenizer reconstructs them."""
    return tokenizer.decode(tokenizer.encode(pictures))


def train_probe(
    robot: str,
    tokenizer: "Tokenizer",
    stride: int,
    seed: int = 0,
    tell: Callable[[str], None] = lambda words: None,
) -> Probe:
    """Train a probe on simulated episodes of a laboratory robot; it takes some 15 CPU seconds.

    Args:
        robot: a laboratory robot.
        tokenizer: whose pictures the probe is to read.
        stride: control steps a frame.
        seed: of the episodes and the training; the same seed gives the same probe.
        tell: called with how far it is.
    """
    pictures, made = shown_episodes(robot, tokenizer, stride, seed, tell)
    places, driven = np.concatenate([one.parts for one in made]), made[0].driven
    return fit(
        pictures, places, driven, HELD_OUT_EPISODES / EPISODES, seed, tee=TeeFinder.of(robot), tell=tell
    )


def shown_episodes(
    robot: str, tokenizer: "Tokenizer", stride: int, seed: int, tell: Callable[[str], None]
) -> tuple[Images, list[truth.Episode]]:
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
    held_out: float = 0.2,
    seed: int = 0,
    steps: int = TRAINING_STEPS,
    tee: TeeFinder | None = None,
    tell: Callable[[str], None] = lambda words: None,
) -> Probe:
    """Train a probe on pictures whose state is known.

    Args:
        pictures: (N, S, S, 3), by episode.
        parts: (N, P, 2) true places in px of 128.
        driven: how many of the parts are the robot's own.
        held_out: share of the pictures, the last ones, on which the error is measured.
        seed: of the training.
        steps: of the training.
        tee: of a pusher.
        tell: called with how far it is.
    """
    used = round(len(pictures) * (1 - held_out))
    small = resized(pictures)
    network = _trained(small[:used], parts[:used], seed, steps, tell)
    spread = np.linalg.norm(parts - np.median(parts, axis=0), axis=-1).mean(axis=0)
    background = np.median(small[:used], axis=0).astype(np.float32)
    within = parts if tee is None else tee.within(parts)
    colors = _colors(small[:used], within[:used])
    untested = Probe(network, driven, spread, spread, background, colors, tee)
    error = state_errors(untested, pictures[used:], parts[used:]).mean(axis=0)
    return replace(untested, error=error)


def _trained(small: Images, parts: Floats, seed: int, steps: int, tell: Callable[[str], None]) -> nn.Module:
    with torch.random.fork_rng(devices=[]):  # the caller's random numbers go on as if nothing was drawn
        torch.manual_seed(seed)
        network = PlaceNetwork(parts.shape[1])
    targets = torch.tensor(parts / (truth.SIZE / 2) - 1, dtype=torch.float32)

    def tell_step(step: int) -> None:
        tell(f"training the probe: step {step} of {steps}")

    train(network, pixels(small), targets, seed, steps, LEARNING_RATE, 0.02, tell_step)
    return network.eval()


def train(
    network: nn.Module, inputs: Tensor, targets: Tensor, seed: int, steps: int, rate: float, beta: float,
    tell: Callable[[int], None] = lambda step: None,
) -> None:  # fmt: skip
    """Train a network from noisy pictures (N, 3, 64, 64) to targets (N, …), by a loss of that beta."""
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.AdamW(network.parameters(), lr=rate, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=steps)
    for step in range(steps):
        chosen = torch.randint(0, len(inputs), (BATCH_SIZE,), generator=generator)
        noisy = inputs[chosen] + NOISE * torch.randn(
            BATCH_SIZE, 3, INPUT_SIDE, INPUT_SIDE, generator=generator
        )
        loss = nn.functional.smooth_l1_loss(network(noisy), targets[chosen], beta=beta)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        tell(step + 1)


def _colors(small: Images, parts: Floats) -> Floats:
    """Return the (P, 3) median colours of pictures at places within the parts."""
    x, y = np.clip(parts * (INPUT_SIDE / truth.SIZE), 0, INPUT_SIDE - 1).astype(int).transpose(2, 0, 1)
    found: Floats = np.median(small[np.arange(len(small))[:, None], y, x], axis=0).astype(np.float32)
    return found


def resized(pictures: Images) -> Images:
    """Return pictures (N, 64, 64, 3)."""
    cv2 = opencv()
    return np.stack(
        [cv2.resize(one, (INPUT_SIDE, INPUT_SIDE), interpolation=cv2.INTER_AREA) for one in pictures]
    )


def pixels(small: Images) -> Tensor:
    return torch.from_numpy(small).permute(0, 3, 1, 2).float() / 127.5 - 1
