"""Measure the planning gap: the same planner in the true simulator and in the world model.

The goal is a picture: what the simulator shows after HORIZON frames of the recorder's own driver. The planner
searches so many chunks by the cross-entropy method, for the last picture that is nearest to the goal. It
differs in one thing alone: whether its candidates are run in the simulator or in the model. The actions that
it finds are then given in the simulator. The goal is reached if each readable part of the robot ends within
NEAR_PX of its place in that picture.

If planning in the model reaches fewer goals than planning in the truth, the model limits. If planning in the
truth fails too, the planner does.

N scenes, M candidates of each, H frames ahead, S pixels a side, A action dims.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.special import ndtri

from hma_data.arrays import Bools, Float32s, Floats, Images
from hma_data.lab import truth
from hma_model.evaluation.agreement import share_interval
from hma_model.evaluation.intervals import rounded
from hma_model.evaluation.probe import Probe
from hma_model.policies.arenas import Scenes
from hma_model.policies.planning import Cost, goal_distance
from hma_model.worlds.scenes import LabScene
from hma_model.worlds.world import World

HORIZON, CANDIDATES, ELITES, ROUNDS = 5, 16, 4, 3
MOST_SD = 3.0  # standard deviations from the mean action, up to which candidates go
NEAR_PX = 4.0
LEAST_SUCCESS = 0.5  # a planner that surely reaches fewer goals in the truth is what limits
WAYS = ("truth", "model", "random")


def plan(
    costs: Callable[[Floats], Floats], low: Floats, high: Floats, count: int, rng: np.random.Generator
) -> Floats:
    """Return the best actions (N, H, A) that the cross-entropy method finds.

    Args:
        costs: of candidates (N, M, H, A), (N, M).
        low, high: bounds (A,).
        count: N.
        rng: of the candidates.
    """
    mean = np.broadcast_to((low + high) / 2, (count, HORIZON, len(low)))
    spread = np.broadcast_to((high - low) / 2, mean.shape)
    for _ in range(ROUNDS):
        noise = rng.normal(size=(count, CANDIDATES, *mean.shape[1:]))
        noise[:, 0] = 0  # the mean itself is a candidate
        tried = np.clip(mean[:, None] + spread[:, None] * noise, low, high)
        order = costs(tried).argsort(axis=1, kind="stable")[:, :ELITES]
        best = np.take_along_axis(tried, order[:, :, None, None], axis=1)
        mean, spread = best.mean(axis=1), best.std(axis=1)
    return mean


def reached(world: World, scenes: Scenes, probe: Probe, way: str) -> Bools:
    """Return which goals (N,) are reached by planning in "truth" or in the "model", or at "random"."""
    cost = Cost(world, scenes.name)
    begun, driven = scenes.begin(), scenes.begin()
    for scene in driven:
        for _ in range(HORIZON):
            scene.advance(None)
    goals = np.stack([scene.simulator.picture() for scene in driven])

    def in_model(candidates: Floats) -> Floats:
        return goal_distance(cost.imagine(cost.sessions, candidates, ends=True)[:, :, 0], goals)

    def in_truth(candidates: Floats) -> Floats:
        actions = cost.actions(candidates).reshape(*candidates.shape[:2], -1, candidates.shape[-1])
        shown = [[_after(scene, one) for one in tried] for scene, tried in zip(begun, actions, strict=True)]
        return goal_distance(np.array(shown), goals)

    low, high = (np.clip(ends, -MOST_SD, MOST_SD, dtype=float) for ends in (cost.space.low, cost.space.high))
    rng = np.random.default_rng([scenes.seed, 54])
    count = len(begun)
    if way == "random":
        found = rng.uniform(low, high, (count, HORIZON, len(low)))
    elif way == "truth":
        found = plan(in_truth, low, high, count, rng)
    else:
        # the likeliest frames in one pass, as `plan:cem` does
        with world.drawing(unmask_steps=1, temperature=0.0):
            cost.open([scene.prompt for scene in begun])
            found = plan(in_model, low, high, count, rng)
        for session in cost.sessions:
            world.close(session)
    for scene, actions in zip(begun, cost.actions(found), strict=True):
        for action in actions.reshape(-1, actions.shape[-1]):
            scene.simulator.advance(action)
    ends, wanted = (_places(some, probe) for some in (begun, driven))
    return np.linalg.norm(ends - wanted, axis=-1).max(axis=-1) <= NEAR_PX


def _after(scene: LabScene, actions: Float32s) -> Images:
    """Return the picture after actions (steps, A), of a copy of a scene."""
    simulator = scene.simulator.copy()
    for action in actions:
        simulator.advance(action)
    return simulator.picture()


def _places(scenes: list[LabScene], probe: Probe) -> Floats:
    """Return the places (N, P, 2) of the robot's readable parts."""
    return np.stack([truth.parts_of(one.simulator.simulation)[1][probe.own] for one in scenes])


def difference(one: Bools, other: Bools) -> tuple[float, list[float]]:
    """Return the share of `one` minus that of `other` over the same scenes (N,), with its interval.

    The interval is that of Bonett and Price (2012) for paired shares, which is honest for few scenes. Like
    all intervals that are drawn towards 0, it is widened to hold the value.
    """
    count = len(one)
    more = (np.sum(one & ~other) + 1) / (count + 2)
    less = (np.sum(~one & other) + 1) / (count + 2)
    half = float(ndtri(0.975)) * float(np.sqrt((more + less - (more - less) ** 2) / (count + 2)))
    value = float(one.mean() - other.mean())
    middle = float(more - less)
    return value, [min(max(middle - half, -1.0), value), max(min(middle + half, 1.0), value)]


def planning_figures(found: dict[str, Bools]) -> dict[str, Any]:
    """Return successes, gap and verdict of the goals (N,) that were reached in each of WAYS."""
    figures = {"near_px": NEAR_PX}
    for way in WAYS:
        figures[way] = rounded(found[way].mean())
        figures[f"{way}_95"] = rounded(np.array(share_interval(int(found[way].sum()), len(found[way]))))
    for name, one, other in (("gap", "truth", "model"), ("over_random", "model", "random")):
        value, ends = difference(found[one], found[other])
        figures |= {name: rounded(value), f"{name}_95": rounded(np.array(ends))}
    return figures | {"verdict": verdict(figures)}


def verdict(figures: dict[str, Any]) -> str:
    """Return what keeps the planner from its goals: "model", "planner" or "undecided"."""
    if figures["gap_95"][0] > 0:
        return "model"
    if figures["truth_95"][1] < LEAST_SUCCESS:
        return "planner"
    return "undecided"
