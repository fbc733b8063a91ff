"""Measure whether objects stay what they are in a model that is driven in closed loop (`hma bench holds`).

The simulator makes true episodes; the model continues each from its first frames under the same actions.
Objects are told by their colours, in the truth and in the model alike. A row gives, at a number of frames:

    left        pixels of loose objects, as a share of the true ones; 1 keeps them, 0 has melted them
    limbs       the same of the robot's own parts
    shape       overlap (intersection over union) with the true object after the best shift and turn
    off         distance of a pushed object's centre from the true one, as a share of how far that moved
    overlap     overlap as it lies, of objects that moved; `repeat`, that of the first frame repeated
    static_db   PSNR of the pixels that never change in the truth

Figures are means over rollouts; those of moved objects over the objects that moved at least 8 of 128 px, of
which `moved` says the number. `repeat`, `shape` and the like are blank where nothing moved.

B rollouts, T frames, S pixels a side, P parts.
"""

import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hma_data.errors import UsageError
from hma_data.lab import truth
from hma_data.lab.simulator import embodiment
from recipes.bench.drift import SHEET_ROLLOUTS, opened, rolled, write_sheet
from recipes.bench.harness import Bench
from recipes.lab.pushes import contact_episode

if TYPE_CHECKING:
    from hma_data.tokenizers.base import Tokenizer
    from hma_model.network.model import HMA

Images = NDArray[np.uint8]
Masks = NDArray[np.bool_]

MARKS = (1, 6, 20, 60, 100, 300, 1000, 3000)  # frames at which figures are given, and the last
NEAR = 60.0  # distance of RGB within which a pixel has an object's colour
MOVED = 8.0  # px of 128 from which an object has moved
FEWEST = 12  # pixels of an object below which it is hidden, and not judged
TURNS = 36  # angles of the search for the best overlap
CARD_MARKS = (20, 100)  # frames at which a model card says what is left
SHEET = (0, 1, 3, 6, 10, 20, 40, 60, 100, 200, 300)  # frames of a sheet; 0 is the prompt's last


@dataclass(frozen=True)
class Found:
    """The rollouts of a robot.

    Attributes:
        true, made: (B, T, S, S, 3) from the prompt's last frame on.
        parts: (B, T, P, 2) true places in px of 128.
        driven: how many of the parts, the first ones, are the robot's own.
    """

    robot: str
    true: Images
    made: Images
    parts: NDArray[np.float64]
    driven: int


def run(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a row for each robot and mark; raise UsageError for a robot without a simulator."""
    robots = [name.strip() for name in settings["robots"].split(",")]
    for robot in robots:
        embodiment(robot)
        if settings["driver"] == "contact" and robot != "pusht_fast":
            fault = f"driver=contact is of pusht_fast, not of {robot}"
            raise UsageError("bench holds", fault, "give robots=pusht_fast, or another driver")
    model, tokenizer = opened(settings["checkpoint"], robots, settings["device"])
    found = [measure(model, tokenizer, robot, settings) for robot in robots]
    if settings["sheet"]:
        draw(found, Path(settings["sheet"]))
    marks = sorted({mark for mark in (*MARKS, settings["frames"]) if mark <= settings["frames"]})
    rows = [_row(one, mark) for one in found for mark in marks]
    if settings["record"]:
        record(settings["checkpoint"], rows, settings["rollouts"])
    return rows


def measure(model: "HMA", tokenizer: "Tokenizer", robot: str, settings: dict[str, Any]) -> Found:
    """Simulate a robot's episodes, and continue them in the model."""
    from hma_data.episodes.images import prepare

    begun, prompt, seed = time.monotonic(), settings["prompt"], settings["seed"]
    stride, length = model.embodiments[robot].stride, prompt + settings["frames"]
    if settings["driver"] == "contact":
        simulated = partial(contact_episode, length, stride, seed)
    else:
        simulated = partial(truth.episode, robot, length, stride, seed, wander=settings["driver"] == "wander")
    episodes = [simulated(number) for number in range(settings["rollouts"])]
    size, (camera, *_) = tokenizer.spec.image_size, embodiment(robot).cameras
    seen = np.stack([prepare(one.pictures, camera, size, tokenizer.spec.resize_filter) for one in episodes])
    given = np.stack([tokenizer.encode(images[:prompt]) for images in seen])
    chunks, frames = np.stack([one.chunks for one in episodes]), range(1, settings["frames"] + 1)
    made = rolled(model, tokenizer, robot, given, chunks, options={}, frames=frames, seed=seed)
    begin = tokenizer.decode(given[:, -1])[:, None]
    print(f"{robot}: {time.monotonic() - begun:.0f} s", file=sys.stderr, flush=True)
    parts = np.stack([one.parts for one in episodes])[:, prompt - 1 :]
    images = np.concatenate([begin, made], axis=1)
    return Found(robot, seen[:, prompt - 1 :], images, parts, episodes[0].driven)


def record(checkpoint: str, rows: list[dict[str, Any]], rollouts: int) -> None:
    """Write the figures into the cards of a checkpoint's folder, with a sentence for its model card."""
    from hma_model.checkpoint.folder import Checkpoint
    from hma_model.checkpoint.io import record_evaluation

    folder = Checkpoint.open(checkpoint)
    for robot in dict.fromkeys(row["robot"] for row in rows):
        marks = {
            str(row["frame"]): {key: value for key, value in row.items() if key not in ("robot", "frame")}
            for row in rows
            if row["robot"] == robot and row["frame"] in CARD_MARKS
        }
        if marks:
            facts = {"verdict": sentence(marks), "rollouts": rollouts, "frames": marks}
            record_evaluation(folder, robot, facts, "holds")


def sentence(marks: dict[str, dict[str, Any]]) -> str:
    """Return what is left of a robot and of loose objects at each mark, in words."""
    said = []
    for mark, row in marks.items():
        parts = []
        if row["limbs"] is not None:
            parts.append(f"{row['limbs']:.0%} of the robot's pixels")
        if row["left"] is not None:
            parts.append(f"{row['left']:.0%} of the pixels of loose objects")
        if row["shape"] is not None:
            parts.append(f"their shapes overlap the true ones by {row['shape']:.0%}")
        said.append(f"after {mark} frames {', '.join(parts) or 'nothing was large enough to judge'}")
    return f"in closed loop keeps {'; '.join(said)}"


# -- figures


def colors_of(found: Found) -> NDArray[np.float64]:
    """Return the colour (P, 3) of each part: the commonest at its place in the true frames."""
    side, count = found.true.shape[2], found.parts.shape[2]
    places = np.clip((found.parts * side / truth.SIZE).astype(int), 0, side - 1)
    b, t = np.ogrid[: found.true.shape[0], : found.true.shape[1]]
    taken = [found.true[b, t, places[:, :, p, 1], places[:, :, p, 0]].reshape(-1, 3) for p in range(count)]
    return np.stack([np.median(pixels, axis=0) for pixels in taken])


def distinct(colors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the colours (C, 3) without those near an earlier one: places of one object differ a little."""
    kept: list[NDArray[np.float64]] = []
    for color in colors:
        if all(np.linalg.norm(color - other) >= NEAR for other in kept):
            kept.append(color)
    return np.reshape(kept, (-1, 3))


def masks_of(images: Images, colors: NDArray[np.float64]) -> Masks:
    """Return the pixels (C, …, S, S) that have each of the colours (C, 3) and no other one rather."""
    far = np.stack([np.linalg.norm(images.astype(np.float32) - color, axis=-1) for color in colors])
    return (far < NEAR) & (far == far.min(axis=0))


def _row(found: Found, mark: int) -> dict[str, Any]:
    colors = colors_of(found)
    own, loose = distinct(colors[: found.driven]), distinct(colors[found.driven :])
    palette = np.concatenate([loose, own])
    first, true, made = (
        masks_of(x, palette) for x in (found.true[:, 0], found.true[:, mark], found.made[:, mark])
    )
    areas, kept = true.sum((-1, -2)), made.sum((-1, -2))
    seen = areas >= FEWEST
    shares = np.where(seen, kept / np.maximum(areas, 1), np.nan)
    moved, shapes, offs, overlaps, repeats = 0, [], [], [], []
    for color, rollout in zip(*np.nonzero(seen[: len(loose)]), strict=True):
        was, now, got = first[color, rollout], true[color, rollout], made[color, rollout]
        if was.sum() < FEWEST:
            continue
        shapes.append(best_overlap(now, got))
        way = np.linalg.norm(_centre(now) - _centre(was)) * truth.SIZE / len(now)
        if way < MOVED:
            continue
        moved += 1
        overlaps.append(overlap(now, got))
        repeats.append(overlap(now, was))
        if got.any():
            offs.append(float(np.linalg.norm(_centre(got) - _centre(now)) * truth.SIZE / len(now) / way))
    still = (found.true == found.true[:, :1]).all(axis=(1, -1))
    error = (found.made[:, mark].astype(np.float64) - found.true[:, 0])[still]
    noise = float(np.square(error).mean()) if error.size else np.nan
    return {
        "robot": found.robot,
        "frame": mark,
        "left": _mean(shares[: len(loose)]),
        "limbs": _mean(shares[len(loose) :]),
        "shape": _mean(shapes),
        "off": _mean(offs),
        "overlap": _mean(overlaps),
        "repeat": _mean(repeats),
        "moved": moved,
        "static_db": round(min(10 * np.log10(255**2 / max(noise, 1e-9)), 99.0), 1)
        if noise == noise
        else None,
    }


def best_overlap(true: Masks, made: Masks) -> float:
    """Return the overlap of an object with the true one (S, S) after the best shift and turn."""
    if not made.any():
        return 0.0
    middle, shift = _centre(made), _centre(true) - _centre(made)
    best = 0.0
    for turn in range(TURNS):
        matrix = cv2.getRotationMatrix2D((float(middle[0]), float(middle[1])), turn * 360 / TURNS, 1.0)
        matrix[:, 2] += shift
        turned = cv2.warpAffine(made.astype(np.float32), matrix, made.shape[::-1]) > 0.5
        best = max(best, overlap(true, turned))
    return best


def overlap(one: Masks, other: Masks) -> float:
    """Return the pixels that two objects share, of those that either has."""
    return float((one & other).sum() / max((one | other).sum(), 1))


def _centre(mask: Masks) -> NDArray[np.float64]:
    return np.array([axis.mean() for axis in np.nonzero(mask)[::-1]])


def _mean(values: Any) -> float | None:
    kept = np.asarray(values, dtype=np.float64)
    kept = kept[np.isfinite(kept)]
    return round(float(kept.mean()), 3) if kept.size else None


def draw(found: list[Found], path: Path) -> None:
    """Write a PNG: for two rollouts a robot the truth, and below it the model, at the frames of SHEET."""
    rows = []
    for one in found:
        columns = [frame for frame in SHEET if frame < one.true.shape[1]]
        told = ", ".join(map(str, columns))
        for number in range(min(SHEET_ROLLOUTS, len(one.true))):
            rows.append((one.true[number, columns], f"{one.robot}, truth at frames {told}"))
            rows.append((one.made[number, columns], f"{one.robot}, model"))
    write_sheet(path, rows)


BENCH = Bench(
    "objects in closed loop: what is left of them, whether they keep their shape, how far they are off",
    {
        "checkpoint": "embedded",
        "robots": "pusht_fast,arm2_07,mover_10",
        "frames": 60,
        "rollouts": 12,  # of each robot
        # Of pushers: own pushes the T to its goal, wander moves at random, contact as recipes/lab/pushes.py.
        "driver": "own",
        "prompt": 3,  # true frames
        "device": "auto",
        "seed": 4949,
        "sheet": "",  # a PNG to write
        "record": False,  # write the figures into the cards of the checkpoint's folder
    },
    run,
    choices={"driver": ("own", "wander", "contact")},
)
