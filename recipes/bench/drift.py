"""Measure whether robots still follow their commands late in long rollouts (`hma bench drift`).

The simulator makes true episodes with states. The model continues each from a prompt of a window under its
commands, and a probe reads where the robot's parts are in its pictures (`hma_model.evaluation.probe`). For
comparison the same is read off rollouts under another episode's commands ("shuffled") and off the prompt's
last frame, repeated ("copy"). A figure at a frame is the mean over the five frames up to it:

    error_px     distance of the robot's parts from the truth, mean over rollouts; a picture has 128 px
    median_px    the median over rollouts; low_px and high_px: 95 % interval of the mean, by bootstrap
    share        error_px as a share of the spread; what knows nothing of the commands has 1 to 1.4 late
    motion       correlation of the parts' motion from frame to frame with the true one: 1 obeys, 0 does not
    whole        how much of the robot the picture shows, by the colours of its parts; the copy shows it all
    loose_px     as error_px, of what lies about
    probe_px     the probe's own error on held-out true pictures

The verdict compares the last frame with frame 10. `sampling` gives options of `HMA.generate`, such as
`unmask_steps=8,order=confidence`; several, with / between them, are compared, and only the first is shuffled.

B rollouts, T frames, W frames that are looked at, S pixels a side, K = stride * action dim, P parts.
"""

import inspect
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hma_data.errors import UsageError
from hma_data.lab import simulator, truth
from hma_data.storage.yaml_io import parse_yaml
from recipes.bench.harness import Bench

if TYPE_CHECKING:
    from hma_data.tokenizers.base import Tokenizer
    from hma_model.evaluation.probe import Probe
    from hma_model.network.model import HMA

Images = NDArray[np.uint8]
MARKS = (5, 10, 25, 50, 100, 300, 1000, 3000)  # frames at which figures are given, and the last
EARLY = 10  # the mark that the end is compared with
SPAN = 5  # frames up to a mark over which a figure is the mean
SHEET = (1, 10, 25, 50, 100, 200, 300, 1000, 3000)  # frames of a sheet
SHEET_ROLLOUTS = 2  # of a robot on it
LIMIT = 2.0  # of the error at the end over that at EARLY
LOST_SHARE = 0.5  # share of the spread from which a robot is somewhere else
LEAST_PIXELS = 3  # of a part that is seen
WHOLE = 0.8  # of the wholeness at the end over the copy's
OTHER_ARGUMENTS = (
    "model",
    "decoding",  # its settings are named one by one
    "embodiment",
    "batch",
    "generator",
    "self",
)  # arguments of a rollout that are no options


@dataclass(frozen=True)
class Case:
    """Rollouts of one kind: `pictures` (B, W, S, S, 3); `judged` tells the model with the true commands."""

    name: str
    pictures: Images
    judged: bool = False


@dataclass(frozen=True)
class Found:
    """The measurements on a robot.

    Attributes:
        frames: the W numbers of the predicted frames that were looked at, from 1.
        truth: (B, W, S, S, 3), the true pictures as the tokenizer shows them.
        parts: (B, W, P, 2) true places.
        cases: the rollouts.
    """

    robot: str
    probe: "Probe"
    frames: tuple[int, ...]
    truth: Images
    parts: NDArray[np.float64]
    cases: tuple[Case, ...]


def run(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a row for each robot, kind of rollout and mark; raise UsageError for a wrong setting."""
    samplings = _samplings(settings["sampling"])
    robots = [name.strip() for name in settings["robots"].split(",")]
    for robot in robots:
        simulator.embodiment(robot)
    for key, least in (("frames", EARLY), ("rollouts", 2)):
        if settings[key] < least:
            raise UsageError("bench drift", f"{key}={settings[key]} is not allowed", f"give at least {least}")
    from hma_data.tokenizers.network import single_threads

    models = [opened(settings["checkpoint"], [robot], settings["device"]) for robot in robots]
    work = partial(measure, samplings=samplings, settings=settings)
    with single_threads(len(robots)) as pool:
        found = list(pool.map(work, *zip(*models), robots))
    if settings["sheet"]:
        draw(found, Path(settings["sheet"]))
    return [row for one in found for row in rows(one, settings["seed"])]


def opened(checkpoint: str, robots: list[str], device: str) -> "tuple[HMA, Tokenizer]":
    """Return the model of a checkpoint with some robots, and its tokenizer."""
    from hma_data.tokenizers.base import reopened
    from hma_model.checkpoint.folder import require_tokenizer
    from hma_model.network.model import HMA
    from hma_model.training.runtime import choose_device

    place = str(choose_device(device))
    model = HMA.from_pretrained(checkpoint, embodiments=robots, device=place).eval()
    tokenizer = reopened(model.config.tokenizer, place)
    require_tokenizer(model.config, tokenizer.spec, checkpoint)
    return model, tokenizer


def _samplings(text: str) -> dict[str, dict[str, Any]]:
    """Return the options of each way of sampling, by those of its words that not all have, or by all."""
    from hma_model.generation.rollout import Rollout
    from hma_model.generation.unmask import Decoding

    own = [name for name in inspect.signature(Rollout).parameters if name not in OTHER_ARGUMENTS]
    known = [*own, *(setting.name for setting in fields(Decoding))]
    ways: dict[str, dict[str, Any]] = {}
    worded = [[word.strip() for word in way.split(",")] for way in text.split("/")]
    for words in worded:
        own = [word for word in words if not all(word in others for others in worded)]
        ways[",".join(own or words)] = options = {}
        for word in words:
            key, given, value = word.partition("=")
            if key not in known or not given:
                fault = f"{word!r} is no option of a rollout"
                raise UsageError("bench drift", fault, f"write key=value; keys: {', '.join(known)}")
            options[key] = parse_yaml(value, f"bench drift: {key}", UsageError)
    return ways


def looked_at(frames: int, sheet: bool) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the marks of rollouts of so many frames, and all frames that are looked at."""
    marks = sorted({mark for mark in (*MARKS, frames) if mark <= frames})
    near = {frame for mark in marks for frame in range(mark - SPAN + 1, mark + 1)}
    shown = {frame for frame in SHEET if frame <= frames} if sheet else set()
    return tuple(marks), tuple(sorted(near | shown))


def measure(
    model: "HMA",
    tokenizer: "Tokenizer",
    robot: str,
    *,
    samplings: dict[str, dict[str, Any]],
    settings: dict[str, Any],
) -> Found:
    """Roll out a robot in every way of sampling."""
    from hma_model.evaluation.probe import as_seen, as_shown, train_probe

    begun = time.monotonic()
    batch, seed, prompt = settings["rollouts"], settings["seed"], settings["prompt"] or model.config.frames
    stride = model.embodiments[robot].stride
    probe = train_probe(robot, tokenizer, stride, seed)
    _, frames = looked_at(settings["frames"], bool(settings["sheet"]))
    indices = [prompt - 1 + frame for frame in frames]
    drawn, length = {*range(prompt), *indices}, prompt + settings["frames"]
    episodes = [truth.episode(robot, length, stride, seed, number, drawn) for number in range(batch)]
    shown = [as_seen(robot, tokenizer, one.pictures) for one in episodes]
    given = np.stack([tokenizer.encode(pictures[:prompt]) for pictures in shown])
    true = np.stack([as_shown(tokenizer, pictures[prompt:]) for pictures in shown])
    chunks = np.stack([one.chunks for one in episodes])
    roll = partial(rolled, model, tokenizer, robot, frames=frames, seed=seed)
    cases: list[Case] = []
    for name, options in samplings.items():
        if cases:
            cases.append(Case(name, roll(given, chunks, options=options), judged=True))
            continue
        other = np.roll(chunks, 1, axis=0)
        other[:, : prompt - 1] = chunks[:, : prompt - 1]
        both = roll(np.concatenate([given, given]), np.concatenate([chunks, other]), options=options)
        cases = [Case(name, both[:batch], judged=True), Case(f"{name}, shuffled", both[batch:])]
    last = tokenizer.decode(given[:, -1])
    cases.append(Case("copy", np.repeat(last[:, None], len(frames), axis=1)))
    print(f"{robot}: {time.monotonic() - begun:.0f} s", file=sys.stderr, flush=True)
    parts = np.stack([one.parts[indices] for one in episodes])
    return Found(robot, probe, frames, true, parts, tuple(cases))


def rolled(
    model: "HMA",
    tokenizer: "Tokenizer",
    robot: str,
    stored: NDArray[Any],
    chunks: NDArray[np.float32],
    *,
    options: dict[str, Any],
    frames: Sequence[int],
    seed: int,
) -> Images:
    """Continue prompts (B, P, …) under chunks (B, T, K); return the images (B, W, S, S, 3) of W frames."""
    import torch

    from hma_model.generation.decode import decode
    from hma_model.generation.rollout import Rollout

    discrete, begin = model.config.kind == "discrete", stored.shape[1] - 1
    known = torch.from_numpy(stored.astype(np.int64 if discrete else np.float32)).to(model.device)
    commands = torch.from_numpy(chunks).to(model.device)
    generator = torch.Generator().manual_seed(seed)
    rollout = Rollout(model, robot, len(known), generator=generator, **options)
    rollout.prompt(known, commands)
    kept = []
    for frame in range(1, frames[-1] + 1):
        made = rollout.step(commands[:, begin + frame - 1])
        if frame in frames:
            kept.append(made.cpu())
    return decode(tokenizer, torch.stack(kept, dim=1))


# -- figures


def rows(found: Found, seed: int) -> list[dict[str, Any]]:
    """Return the figures of each kind of rollout at each mark."""
    marks, _ = looked_at(found.frames[-1], False)
    table = [_row(found, case, mark, seed) for case in found.cases for mark in marks]
    copy = table[-1]
    for i, case in enumerate(found.cases):
        if case.judged:
            own = table[i * len(marks) : (i + 1) * len(marks)]
            own[-1]["verdict"] = verdict(own[marks.index(EARLY)], own[-1], copy)
    return table


def _row(found: Found, case: Case, mark: int, seed: int) -> dict[str, Any]:
    from hma_model.evaluation.intervals import interval
    from hma_model.evaluation.metrics import PSNR_LIMIT, psnr

    window = [found.frames.index(frame) for frame in range(mark - SPAN + 1, mark + 1)]
    made, true, parts = case.pictures[:, window], found.truth[:, window], found.parts[:, window]
    probe = found.probe
    own, loose = probe.own, probe.loose
    row: dict[str, Any] = {"robot": found.robot, "rollout": case.name, "frame": mark}
    read = probe.read(made)
    far = np.linalg.norm(read - parts, axis=-1)
    if len(own):
        errors = far[..., own].mean(axis=(1, 2))
        low, high = interval(errors, seed)
        motion = _correlation(np.diff(read[:, :, own], axis=1), np.diff(parts[:, :, own], axis=1))
        row |= {
            "error_px": round(float(errors.mean()), 2),
            "median_px": round(float(np.median(errors)), 2),
            "low_px": round(float(low), 2),
            "high_px": round(float(high), 2),
            "share": round(float(errors.mean() / probe.spread[own].mean()), 3),
            "motion": None if motion is None else round(motion, 2),
        }
    signal = psnr(true, made, limit=PSNR_LIMIT)
    return row | {
        "whole": round(float(wholeness(probe, made, true).mean()), 3),
        "loose_px": round(float(far[..., loose].mean()), 2) if len(loose) else None,
        "psnr_db": round(float(signal.mean()), 2),
        "probe_px": round(float(probe.error[own].mean()), 2) if len(own) else None,
    }


def _correlation(one: NDArray[np.float64], other: NDArray[np.float64]) -> float | None:
    """Return the correlation of two motions; None if one of them stands still."""
    if min(one.std(), other.std()) < 1e-3:
        return None
    return float(np.corrcoef(one.ravel(), other.ravel())[0, 1])


def verdict(first: dict[str, Any], last: dict[str, Any], copy: dict[str, Any]) -> str:
    """Return a sentence on the end of a rollout: whether it follows its commands, and whether it is whole."""
    if "error_px" not in last:
        return "none: no part of the robot can be read"
    times, whole = last["error_px"] / max(first["error_px"], 1e-9), last["whole"] / max(copy["whole"], 1e-9)
    if first["share"] > LOST_SHARE:
        follows = f"lost by frame {EARLY}"
    else:
        follows = "holds" if times <= LIMIT and last["share"] <= LOST_SHARE else "drifts"
    return f"{follows}, error ×{times:.1f}; {'whole' if whole >= WHOLE else 'dissolved'}, ×{whole:.2f}"


# -- sheet


def draw(found: Sequence[Found], path: Path) -> None:
    """Write a PNG: for two rollouts a robot the truth, and below it the model, at the frames of SHEET."""
    rows = []
    for one in found:
        columns = [one.frames.index(frame) for frame in SHEET if frame in one.frames]
        told = ", ".join(str(one.frames[column]) for column in columns)
        for number in range(min(SHEET_ROLLOUTS, len(one.truth))):
            rows.append((one.truth[number, columns], f"{one.robot}, truth at frames {told}"))
            rows += [
                (case.pictures[number, columns], f"{one.robot}, {case.name}")
                for case in one.cases
                if case.judged
            ]
    write_sheet(path, rows)


def write_sheet(path: Path, rows: Sequence[tuple[Images, str]]) -> None:
    """Write a PNG of labelled rows of images."""
    from hma_data.episodes.sheets import grid, write_png

    write_png(path, grid([list(images) for images, _ in rows], [label for _, label in rows]))


def wholeness(probe: "Probe", pictures: Any, true: Any) -> Any:
    """Return how much of the robot of true pictures (…, S, S, 3) others show; 1 is all of it.

    It is the mean over the robot's readable parts that the true picture shows. What counts are the pixels of
    each part's colour, wherever they are; a true picture of another time has some 0.9.
    """
    wanted, given = (probe.areas(some)[..., probe.own] for some in (true, pictures))
    seen = wanted >= LEAST_PIXELS
    kept = np.where(seen, np.minimum(given / np.maximum(wanted, 1), 1), 0).sum(axis=-1)
    return kept / np.maximum(seen.sum(axis=-1), 1)


BENCH = Bench(
    "long rollouts: position error of the robot in the predicted images",
    {
        "checkpoint": "embedded",
        "robots": "arm2_07,mover_10,pusht_fast",
        "frames": 300,
        "rollouts": 8,  # of each robot
        "sampling": "unmask_steps=2",
        "prompt": 0,  # true frames; 0: the model's window
        "device": "auto",
        "seed": 1818,
        "sheet": "",  # a PNG to write
    },
    run,
)
