"""Measure whether objects stay what they are in a model that is driven in closed loop (`hma bench holds`).

The simulator makes true episodes; the model continues each from its first frames under the same actions.
Objects are told by their colours, in the truth and in the model alike. A row gives, at a number of frames:

    left        pixels of loose objects, as a share of the true ones; 1 keeps them, 0 has melted them
    limbs       the same of the robot's own parts
    …_whole     share of objects, or of the robot's parts, that have 0.8 to 1.2 of their true pixels
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
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hma_data.arrays import Floats
from hma_data.errors import UsageError
from hma_data.lab import truth
from hma_data.lab.simulator import embodiment
from hma_model.evaluation.wholeness import (
    FEWEST,
    WHOLE,
    Found,
    best_overlap,
    centre,
    continued,
    masks_of,
    overlap,
    palettes,
    shares,
)
from recipes.bench.drift import SHEET_ROLLOUTS, opened, write_sheet
from recipes.bench.harness import Bench
from recipes.lab.pushes import contact_episode

if TYPE_CHECKING:
    from hma_data.tokenizers.base import Tokenizer
    from hma_model.network.model import HMA

MARKS = (1, 6, 20, 60, 100, 300, 1000, 3000)  # frames at which figures are given, and the last
MOVED = 8.0  # px of 128 from which an object has moved
HELD_S = 1.2  # seconds that keys are held
CARD_MARKS = (20, 100)  # frames at which a model card says what is left
SHEET = (0, 1, 3, 6, 10, 20, 40, 60, 100, 200, 300)  # frames of a sheet; 0 is the prompt's last


def run(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a row for each robot and mark; raise UsageError for a robot without a simulator."""
    robots = [name.strip() for name in settings["robots"].split(",")]
    for robot in robots:
        embodiment(robot)
        if settings["driver"] == "contact" and robot != "pusht_fast":
            fault = f"driver=contact is of pusht_fast, not of {robot}"
            raise UsageError("bench holds", fault, "give robots=pusht_fast, or another driver")
    models = [opened(settings["checkpoint"], [robot], settings["device"]) for robot in robots]
    found = [measure(*model, robot, settings) for model, robot in zip(models, robots, strict=True)]
    if settings["sheet"]:
        draw(found, Path(settings["sheet"]))
    marks = sorted({mark for mark in (*MARKS, settings["frames"]) if mark <= settings["frames"]})
    rows = [_row(one, mark) for one in found for mark in marks]
    if settings["record"]:
        record(settings["checkpoint"], rows, settings["rollouts"])
    return rows


def measure(model: "HMA", tokenizer: "Tokenizer", robot: str, settings: dict[str, Any]) -> Found:
    """Simulate a robot's episodes, and continue them in the model."""
    begun, prompt, seed = time.monotonic(), settings["prompt"], settings["seed"]
    stride, length = model.embodiments[robot].stride, prompt + settings["frames"]
    if settings["driver"] == "contact":
        simulated = partial(contact_episode, length, stride, seed)
    elif settings["driver"] == "keys":
        simulated = partial(keys_episode, robot, length, stride, seed)
    else:
        simulated = partial(truth.episode, robot, length, stride, seed, wander=settings["driver"] == "wander")
    episodes = [simulated(number) for number in range(settings["rollouts"])]
    found = continued(model, tokenizer, robot, episodes, prompt, seed)
    print(f"{robot}: {time.monotonic() - begun:.0f} s", file=sys.stderr, flush=True)
    return found


def keys_episode(robot: str, length: int, stride: int, seed: int, number: int) -> truth.TrueEpisode:
    """Simulate an episode under actions that are held down, which unlike a driver's press on at limits."""
    actions = held_keys(robot, length * stride, seed, number)
    return truth.episode(robot, length, stride, seed, number, commands=actions)


def held_keys(robot: str, count: int, seed: int, number: int) -> Floats:
    """Return actions (count, A) as of a person: each value stays at an end or in the middle for HELD_S."""
    known, rate = embodiment(robot).action.components, embodiment(robot).rate_hz
    low, high = np.array([part.range or (-1.0, 1.0) for part in known for _ in range(part.dims)], float).T
    drawn = np.random.default_rng((seed, number)).integers(0, 3, (count, len(low)))
    actions = low + (high - low) * drawn / 2
    return np.repeat(actions, round(HELD_S * rate), axis=0)[:count]


def record(checkpoint: str, rows: list[dict[str, Any]], rollouts: int) -> None:
    """Write the figures into the cards of a checkpoint's folder, with a sentence for its model card."""
    from hma_model.checkpoint.folder import Checkpoint
    from hma_model.checkpoint.io import record_evaluation

    for robot in dict.fromkeys(row["robot"] for row in rows):
        marks = {
            str(row["frame"]): {key: value for key, value in row.items() if key not in ("robot", "frame")}
            for row in rows
            if row["robot"] == robot and row["frame"] in CARD_MARKS
        }
        if marks:
            facts = {"verdict": sentence(marks), "rollouts": rollouts, "frames": marks}
            record_evaluation(Checkpoint.open(checkpoint, [robot]), robot, facts, "holds")


def sentence(marks: dict[str, dict[str, Any]]) -> str:
    """Return what is left of a robot and of loose objects at each mark, in words."""
    said = []
    for mark, row in marks.items():
        parts = []
        if row["limbs"] is not None:
            parts.append(
                f"{row['limbs']:.0%} of the robot's pixels ({row['limbs_whole']:.0%} of its parts whole)"
            )
        if row["left"] is not None:
            whole = f"({row['left_whole']:.0%} of them whole)"
            parts.append(f"{row['left']:.0%} of the pixels of loose objects {whole}")
        if row["shape"] is not None:
            parts.append(f"their shapes overlap the true ones by {row['shape']:.0%}")
        said.append(f"after {mark} frames {', '.join(parts) or 'nothing was large enough to judge'}")
    return f"in closed loop keeps {'; '.join(said)}"


# -- figures


def _row(found: Found, mark: int) -> dict[str, Any]:
    own, loose = palettes(found)
    palette = np.concatenate([loose, own])
    first, true, made = (
        masks_of(x, palette) for x in (found.true[:, 0], found.true[:, mark], found.made[:, mark])
    )
    kept = shares(true, made)
    seen = np.isfinite(kept)
    # a mean share is 1 too where one rollout has lost what another has doubled
    whole = np.where(seen, (kept >= WHOLE[0]) & (kept <= WHOLE[1]), np.nan)
    moved, shapes, offs, overlaps, repeats = 0, [], [], [], []
    for color, rollout in zip(*np.nonzero(seen[: len(loose)]), strict=True):
        was, now, got = first[color, rollout], true[color, rollout], made[color, rollout]
        if was.sum() < FEWEST:
            continue
        shapes.append(best_overlap(now, got))
        way = np.linalg.norm(centre(now) - centre(was)) * truth.SIZE / len(now)
        if way < MOVED:
            continue
        moved += 1
        overlaps.append(overlap(now, got))
        repeats.append(overlap(now, was))
        if got.any():
            offs.append(float(np.linalg.norm(centre(got) - centre(now)) * truth.SIZE / len(now) / way))
    still = (found.true == found.true[:, :1]).all(axis=(1, -1))
    error = (found.made[:, mark].astype(np.float64) - found.true[:, 0])[still]
    noise = float(np.square(error).mean()) if error.size else np.nan
    return {
        "robot": found.robot,
        "frame": mark,
        "left": mean_of(kept[: len(loose)]),
        "left_whole": mean_of(whole[: len(loose)]),
        "limbs": mean_of(kept[len(loose) :]),
        "limbs_whole": mean_of(whole[len(loose) :]),
        "shape": mean_of(shapes),
        "off": mean_of(offs),
        "overlap": mean_of(overlaps),
        "repeat": mean_of(repeats),
        "moved": moved,
        "static_db": round(min(10 * np.log10(255**2 / max(noise, 1e-9)), 99.0), 1)
        if noise == noise
        else None,
    }


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


def mean_of(values: Any) -> float | None:
    """Return the mean of the finite values, None if there are none."""
    kept = np.asarray(values, dtype=np.float64)
    kept = kept[np.isfinite(kept)]
    return round(float(kept.mean()), 3) if kept.size else None


BENCH = Bench(
    "robots and objects in closed loop: the share of their pixels left, shape, position error",
    {
        "checkpoint": "embedded",
        "robots": "pusht_fast,arm2_07,mover_10",
        "frames": 60,
        "rollouts": 12,  # of each robot
        # keys: actions held down, also at limits. Of pushers: own pushes the T to its goal, wander moves at
        # random, contact as recipes/lab/pushes.py.
        "driver": "own",
        "prompt": 3,  # true frames
        "device": "auto",
        "seed": 4949,
        "sheet": "",  # a PNG to write
        "record": False,  # write the figures into the cards of the checkpoint's folder
    },
    run,
    choices={"driver": ("own", "keys", "wander", "contact")},
)
