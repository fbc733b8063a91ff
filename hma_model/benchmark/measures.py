"""Measure rollouts of a laboratory robot: pictures, state, decision fidelity and inverse-action stability.

Decision fidelity is a multiple choice. In each scene the simulator runs several action sequences, and the
goal is where one of them ends. The model rolls all of them out from the same frames with the same random
numbers, and chooses the one whose last image is nearest to the goal. It is right if that one truly ends
there.

Inverse-action stability plays actions and then their inverses in reverse order, after which the robot must be
where it began. It needs no true outcome; the simulator's own return is the reference.

N scenes, C sequences of each, T frames after the prompt, S pixels a side, P parts that a probe reads. Places
are px of an image of 128 by 128.
"""

import time
from collections import defaultdict
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.arrays import Float32s, Floats, Images
from hma_model.evaluation.agreement import share_interval
from hma_model.evaluation.intervals import NATURAL, horizon_summary, rounded, summary
from hma_model.evaluation.metrics import PSNR_LIMIT, PSNR_RANGE, psnr
from hma_model.evaluation.probe import Probe
from hma_model.evaluation.state_reader import Tell
from hma_model.policies.arenas import ModelArena, Scenes, TrueArena
from hma_model.policies.base import Policy
from hma_model.policies.scores import run
from hma_model.worlds.scenes import Dimension
from hma_model.worlds.world import World

Arrays = dict[str, NDArray[Any]]
CHOICES = 5
REACHED_PX = 1.0  # mean distance of the parts from the goal up to which a sequence truly ends there
INVERSE_SHARE = 0.5  # of the range of training, up to which actions are drawn
WARM_FRAMES, TIMED_FRAMES = 3, 20


def played(world: World, true: TrueArena, actions: Sequence[Float32s]) -> tuple[Images, Floats]:
    """Return the model's images (N, T + 1, S, S, 3) under given actions, from the beginning of `true`.

    With them comes how unsure the model was of the generated ones, (N, T) as of `Rollout`.
    """
    model = ModelArena(world, true, None)
    images = [model.made]
    with closing(model), world.drawing(measure=True):
        for action in actions:
            model.step(action)
            if model.fresh:
                images.append(model.made)
    return np.stack(images, axis=1), np.stack(model.unsure, axis=1)


def choose(
    world: World, scenes: Scenes, probe: Probe, policy: Policy, frames: int, choices: int = CHOICES,
    tell: Tell = lambda words: None,
) -> Arrays:  # fmt: skip
    """Return what comes of C action sequences of each scene in the simulator and in the model.

    Args:
        tell: called before each, with words on it.

    Returns:
        `psnr`, `copy_psnr` (of the first frame repeated), `uncertainty` (N, C, T); `true`, `made`
        (N, C, T, P, 2) places.
    """
    kept = np.concatenate([probe.own, probe.loose])  # the parts whose places the probe reads
    found = defaultdict[str, list[NDArray[Any]]](list)
    for choice in range(choices):
        tell(f"action sequence {choice + 1} of {choices}")
        true = TrueArena(replace(scenes, seed=scenes.seed + 1000 * choice), world.image_shape[0])
        pictures, actions = run("benchmark", policy, true, frames)
        true.scenes = scenes  # the model's random numbers are the same for all sequences of a scene
        shown = np.stack(pictures, axis=1)
        made, unsure = played(world, true, actions)
        found["uncertainty"].append(unsure)
        found["psnr"].append(psnr(shown[:, 1:], made[:, 1:], limit=PSNR_LIMIT))
        still = np.broadcast_to(made[:, :1], made[:, 1:].shape)
        found["copy_psnr"].append(psnr(shown[:, 1:], still, limit=PSNR_LIMIT))
        found["true"].append(np.stack(true.parts, axis=1)[:, 1:, kept])
        found["made"].append(probe.read(made[:, 1:])[..., kept, :])
    return {name: np.stack(parts, axis=1) for name, parts in found.items()}


def decisions(true: NDArray[Any], made: NDArray[Any], seed: int) -> Arrays:
    """Return the goals of a choice among sequences, and how far each sequence ends from them.

    Args:
        true, made: (N, C, P, 2) last places of the sequences, in the simulator and as read off the model.
        seed: of the goals.

    Returns:
        `goal` (N,), the sequence whose true end is the goal; `true_px` and `made_px` (N, C), rounded as they
        are written to the results; `right` (N,), whether the one of least `made_px` truly reaches the goal.
    """
    rows = np.arange(len(true))
    goal = np.random.default_rng([seed, 53]).integers(true.shape[1], size=len(true))
    wanted = true[rows, goal][:, None]
    far, seen = (distance(ends, wanted).round(3) for ends in (true, made))
    right = far[rows, seen.argmin(axis=1)] <= REACHED_PX
    return {"goal": goal, "true_px": far, "made_px": seen, "right": right}


def distance(one: NDArray[Any], other: NDArray[Any]) -> Floats:
    """Return the mean distance (…) of places (…, P, 2); NaN where no part is read."""
    far = np.linalg.norm(one - other, axis=-1)
    return far.mean(axis=-1) if far.shape[-1] else np.full(far.shape[:-1], np.nan)


def choice_figures(arrays: Arrays, seed: int) -> tuple[dict[str, Any], dict[str, Any], Arrays]:
    """Return the figures of `choose`, those of each scene, and what the decisions go by."""
    signal, copied = arrays["psnr"].mean(axis=1), arrays["copy_psnr"].mean(axis=1)  # (N, T)
    errors = distance(arrays["made"], arrays["true"]).mean(axis=1)
    choices = decisions(arrays["true"][:, :, -1], arrays["made"][:, :, -1], seed)
    right = choices.pop("right").astype(float)
    found = horizon_summary("psnr", signal, seed, within=PSNR_RANGE)
    found |= summary("copy_psnr", copied.mean(axis=1), seed, within=PSNR_RANGE)
    found |= summary("copy_psnr_last", copied[:, -1], seed, within=PSNR_RANGE)
    found |= horizon_summary("error_px", errors, seed, within=NATURAL)
    found |= {"decision": None, "decision_95": None, "chance": None}
    if np.isfinite(errors).all():
        ends = np.array(share_interval(int(right.sum()), len(right)))
        found |= {"decision": rounded(right.mean()), "decision_95": rounded(ends)}
        found["chance"] = rounded((choices["true_px"] <= REACHED_PX).mean())
    else:  # nothing tells which sequence is nearest
        right[:] = np.nan
    by_scene = {
        "psnr": signal.mean(axis=1),
        "psnr_last": signal[:, -1],
        "error_px": errors.mean(axis=1),
        "error_px_last": errors[:, -1],
        "decision": right,
    }
    return found, {name: rounded(values) for name, values in by_scene.items()}, choices


def frame_errors(arrays: Arrays) -> Arrays:
    """Return what came of each frame (N, C, T) of `choose`, rounded as it is written to the results."""
    return {
        "uncertainty": arrays["uncertainty"].round(4),
        "error_px": distance(arrays["made"], arrays["true"]).round(3),
        "pixel_rmse": (255 * 10 ** (-arrays["psnr"] / 20)).round(3),
    }


def no_inverse(dims: Sequence[Dimension]) -> str:
    """Say why actions have no inverse: a value is no velocity or delta, or goes one way; "" if they have."""
    if others := [dim.name for dim in dims if dim.kind != "rate"]:
        return f"the actions have no inverse: {', '.join(others)} are positions or switches, not velocities"
    if others := [dim.name for dim in dims if not dim.low < 0 < dim.high]:
        return f"the actions have no inverse: {', '.join(others)} only ever went one way in training"
    return ""


def turn_back(world: World, scenes: Scenes, probe: Probe, frames: int) -> Arrays:
    """Play random actions for half of the frames and then their inverses, last one first.

    Returns:
        Of each scene (N,): `return_psnr` and `turn_psnr` of the last and the middle image against the first;
        `return_px` and `turn_px`, the same of the robot's own parts (NaN if none is read); both `true_…_px`.
    """
    limit = INVERSE_SHARE * np.array([min(-dim.low, dim.high) for dim in scenes.dimensions])
    there = frames // 2
    drawn = [rng.uniform(-limit, limit, (there, len(limit))) for rng in scenes.rng(6)]
    out = np.stack(drawn, axis=1).astype(np.float32).repeat(scenes.stride, axis=0)  # (steps, N, A)
    actions = [*out, *-out[::-1]]
    true = TrueArena(scenes, world.image_shape[0], drawn=False)
    made, _ = played(world, true, actions)
    for action in actions:
        true.step(action)

    def far(places: NDArray[Any]) -> NDArray[Any]:
        return distance(*places[:, :, probe.own].swapaxes(0, 1))

    ends, turn = made[:, [0, -1]], made[:, [0, there]]
    return {
        "return_psnr": psnr(ends[:, 0], ends[:, 1], limit=PSNR_LIMIT),
        "turn_psnr": psnr(turn[:, 0], turn[:, 1], limit=PSNR_LIMIT),
        "return_px": far(probe.read(ends)),
        "turn_px": far(probe.read(turn)),
        "true_return_px": far(np.stack([true.parts[0], true.parts[-1]], axis=1)),
        "true_turn_px": far(np.stack([true.parts[0], true.parts[there]], axis=1)),
    }


def speed(world: World, scenes: Scenes) -> Arrays:
    """Return the frames of one rollout a second, and a CPU second, which other work slows less."""
    (prompt,) = TrueArena(scenes.take(range(1)), world.image_shape[0]).prompts
    session = world.open(scenes.name, *prompt)
    chunk = prompt.chunks[-1]
    begun = spent = 0.0
    for frame in range(WARM_FRAMES + TIMED_FRAMES):
        if frame == WARM_FRAMES:
            begun, spent = time.perf_counter(), time.process_time()
        world.step({session: chunk})
    seconds, cpu_seconds = time.perf_counter() - begun, time.process_time() - spent
    world.close(session)
    return {
        "frames_per_second": np.array(TIMED_FRAMES / seconds),
        "frames_per_cpu_second": np.array(TIMED_FRAMES / cpu_seconds),
    }
