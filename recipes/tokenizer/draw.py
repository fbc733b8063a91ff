"""Make the pictures of the tokenizers' corpus that no package has: gym-pusht, drawn scenes, the laboratory.

    python recipes/tokenizer/draw.py OUT [--pusht 200] [--drawn 300] [--lab 0] [--looks 0] [--seed 20]

They are written to OUT/pusht/00000.png … and OUT/drawn/00000.png …, where the recipes expect them. With
--lab, OUT/lab/ gets that many pictures of each laboratory robot of the embedded world model, each a
mosaic of four frames, so that a crop of half its side shows the robot as large as a recording does. With
--looks, OUT/looks/ gets eight such mosaics of each of that many further robots of the family.
"""

import argparse
import math
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hma_data.console import run_script

Picture = NDArray[np.uint8]
EACH = 8  # mosaics of a further look
LAB = ("pendulum", "planar_arm", "pusht_fast", "pusht_slow")  # beside the family's robots


def push_pictures(count: int, seed: int) -> Iterator[Picture]:
    """Yield frames of gym-pusht, 256×256; the agent moves towards random points."""
    import gym_pusht  # noqa: F401  registers the environment
    import gymnasium

    rng = np.random.default_rng([seed, 1])
    env = gymnasium.make(
        "gym_pusht/PushT-v0",
        obs_type="state",
        render_mode="rgb_array",
        max_episode_steps=40,
        observation_width=256,
        observation_height=256,
    )
    made = 0
    while made < count:
        env.reset(seed=int(rng.integers(2**31)))
        goal = rng.uniform(50, 460, 2)
        for step in range(24):
            if step % 6 == 0:
                goal = rng.uniform(50, 460, 2)
            env.step(goal.astype(np.float32))
            if step % 6 == 5 and made < count:
                whole = bool(rng.random() < 0.5)  # 680 pixels with the action's target drawn, or 256
                yield np.asarray(env.unwrapped._render(visualize=whole), np.uint8)
                made += 1
    env.close()


def draw_scene(rng: np.random.Generator, size: int = 384) -> Picture:
    """Draw a scene of smooth and sharp parts: gradients, noise of several scales, shapes, bars."""
    import cv2

    def colour() -> tuple[float, float, float]:
        grey = rng.uniform(0, 255)
        spread = rng.choice([8.0, 40.0, 120.0])
        r, g, b = np.clip(grey + rng.normal(0, spread, 3), 0, 255)
        return float(r), float(g), float(b)

    corners = np.array([[colour(), colour()], [colour(), colour()]], np.float32)
    canvas = cv2.resize(corners, (size, size), interpolation=cv2.INTER_LINEAR)
    for grain in (4, 16, 64, 192):
        if rng.random() < 0.35:
            noise = rng.normal(0, rng.uniform(2, 25), (grain, grain, 1)).astype(np.float32)
            canvas = canvas + cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC)[:, :, None]
    canvas = np.ascontiguousarray(np.clip(canvas, 0, 255).astype(np.uint8))
    for _ in range(int(rng.integers(3, 28))):
        _draw_shape(canvas, rng, colour())
    if rng.random() < 0.3:
        canvas = np.asarray(cv2.GaussianBlur(canvas, (0, 0), rng.uniform(0.5, 2.0)), np.uint8)
    return canvas


def _draw_shape(canvas: Picture, rng: np.random.Generator, colour: tuple[float, float, float]) -> None:
    import cv2

    size = canvas.shape[0]
    x, y = (int(v) for v in rng.integers(0, size, 2))
    reach = int(math.exp(rng.uniform(math.log(5), math.log(size / 2.5))))
    kind = rng.integers(0, 4)
    if kind == 0:
        points = rng.integers(-reach, reach, (int(rng.integers(3, 7)), 2)) + np.array([x, y])
        cv2.fillPoly(canvas, [np.asarray(points, np.int32)], colour, cv2.LINE_AA)
    elif kind == 1:
        axes = (max(2, reach // 2), max(2, int(reach * rng.uniform(0.15, 0.5))))
        cv2.ellipse(canvas, (x, y), axes, rng.uniform(0, 180), 0, 360, colour, -1, cv2.LINE_AA)
    elif kind == 2:
        other = rng.integers(-2 * reach, 2 * reach, 2) + np.array([x, y])
        thick = int(rng.integers(1, max(2, reach // 4) + 1))
        cv2.line(canvas, (x, y), (int(other[0]), int(other[1])), colour, min(thick, 60), cv2.LINE_AA)
    else:
        box = cv2.boxPoints(((x, y), (reach, reach * rng.uniform(0.2, 1.0)), rng.uniform(0, 90)))
        cv2.fillPoly(canvas, [np.asarray(box, np.int32)], colour, cv2.LINE_AA)


def lab_pictures(robots: Sequence[str], count: int, seed: int, episodes: int) -> Iterator[Picture]:
    """Yield `count` mosaics (256, 256, 3) of each robot, of frames of `episodes` episodes."""
    from hma_data import lab
    from hma_data.lab import family
    from hma_data.registry.embodiment import find
    from hma_data.tokenizers.base import get_tokenizer
    from hma_data.tokenizers.training.frames import recording_films

    spec = get_tokenizer("fsq-8").spec
    rng = np.random.default_rng([seed, 3])
    each = -(-4 * count // episodes)
    for robot in robots:
        if robot in LAB:
            with tempfile.TemporaryDirectory() as folder:
                recording = lab.record(robot, folder, episodes, seed)
                frames = np.concatenate(list(recording_films(find(robot), recording, spec, frames=each)))
        else:
            body = family.Body.of(robot)
            films = [family.episode(body, seed, n).observations["image"] for n in range(episodes)]
            frames = np.concatenate([film[:: max(1, len(film) // each)][:each] for film in films])
        for four in rng.permutation(len(frames))[: 4 * count].reshape(-1, 4):
            top, bottom = (np.hstack(list(frames[pair])) for pair in (four[:2], four[2:]))
            yield np.vstack([top, bottom])


def write_pictures(folder: Path, pictures: Iterator[Picture]) -> None:
    """Write folder/00000.png and the pictures that follow."""
    import cv2

    folder.mkdir(parents=True, exist_ok=True)
    for index, picture in enumerate(pictures):
        cv2.imwrite(str(folder / f"{index:05d}.png"), picture[:, :, ::-1])


def main() -> None:
    """Write both folders."""
    parser = argparse.ArgumentParser(description="Draw pictures for the tokenizers' training")
    parser.add_argument("out", type=Path)
    parser.add_argument("--pusht", type=int, default=200, help="pictures of gym-pusht")
    parser.add_argument("--drawn", type=int, default=300, help="drawn scenes")
    parser.add_argument("--lab", type=int, default=0, help="mosaics of each laboratory robot")
    parser.add_argument("--looks", type=int, default=0, help="further robots of the laboratory's family")
    parser.add_argument("--seed", type=int, default=20)
    arguments = parser.parse_args()
    write_pictures(arguments.out / "pusht", push_pictures(arguments.pusht, arguments.seed))
    rng = np.random.default_rng([arguments.seed, 2])
    write_pictures(arguments.out / "drawn", (draw_scene(rng) for _ in range(arguments.drawn)))
    from hma_data.lab import family
    from hma_data.tokenizers.training.frames import EPISODES

    seed = arguments.seed
    if arguments.lab:
        robots = (*family.TRUNK, *LAB)
        write_pictures(arguments.out / "lab", lab_pictures(robots, arguments.lab, seed, EPISODES))
    if arguments.looks:
        pictures = lab_pictures(family.further(arguments.looks), EACH, seed, 2)
        write_pictures(arguments.out / "looks", pictures)


if __name__ == "__main__":
    run_script(main)
