"""Judge from images alone whether an episode of a laboratory robot is a success.

A task is a score of the places of the parts over an episode, and the least score of a success. The simulator
knows the places; a judge reads them off images with a probe. A probe finds a place even for what is gone,
so a loose part of which less than half the pixels are left counts as where it was last seen. Reading blurs
the score, so the judge's own limit is set on recorded episodes whose outcome is known. Its accuracy is that
on others.

N episodes, T frames, S pixels a side, P parts. Places are px of an image of 128 by 128.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hma_data.arrays import Bools, Floats, Images
from hma_data.errors import HMAError, UsageError
from hma_data.lab import truth
from hma_data.tokenizers.base import Tokenizer
from hma_model.evaluation.agreement import Accuracy, accuracy
from hma_model.evaluation.kept import Arrays, kept, weights_sha256
from hma_model.evaluation.probe import EPISODES, FIRST_EPISODE, Probe, as_seen, as_shown, train_probe
from hma_model.evaluation.state_reader import Tell
from hma_model.worlds.env import Judge

Score = Callable[[Floats, int], Floats]

END_FRAMES = 3  # last frames over which a place is the median
EXAMPLES = 96  # recorded episodes, of which half set the judge's limit and half test it
MOVED_LIMITS = {"pusht_fast": 10.0, "pusht_slow": 10.0}  # px; the T wanders further than a small block
BLOCK_MOVED, NEAR_LIMIT, GOAL_LIMIT = 5.0, 12.0, 5.0  # px
VISIBLE_SHARE = 0.5  # share of a loose part's first pixels up to which it is there


def moved(parts: Floats, driven: int) -> Floats:
    """Return how far the loose part that moved furthest ends from its first place.

    Args:
        parts: (N, T, P, 2).
        driven: how many of the parts, the first ones, are the robot's own.

    Returns:
        (N,) px.
    """
    ends = np.median(parts[:, -END_FRAMES:, driven:], axis=1)
    return np.linalg.norm(ends - parts[:, 0, driven:], axis=-1).max(axis=-1)


def reached(parts: Floats, driven: int) -> Floats:
    """Return how near an own part comes to the first place of a loose part, negative; (N,) px."""
    later = parts[:, 1:] if parts.shape[1] > 1 else parts  # of one frame, nobody has moved yet
    gap = later[..., :driven, None, :] - parts[:, :1, None, driven:]
    return -np.linalg.norm(gap, axis=-1).min(axis=(1, 2, 3))


def placed(parts: Floats, driven: int) -> Floats:
    """Return how far the T of a pusher ends from its goal (the further of its two places), negative; (N,)."""
    ends = np.median(parts[:, -END_FRAMES:, driven:], axis=1)
    return -np.linalg.norm(ends - truth.goal_of(truth.PUSHERS[0]), axis=-1).max(axis=-1)


@dataclass(frozen=True)
class Task:
    """A task of a robot.

    Attributes:
        name: a key of TASKS.
        limit: the least score of a success; of `reached` and `placed` negative.
    """

    name: str
    limit: float

    @property
    def text(self) -> str:
        """Return the task in words."""
        return TASKS[self.name][1].format(abs(self.limit))

    def score(self, parts: Floats, driven: int) -> Floats:
        """Return the scores (N,) of the places (N, T, P, 2) of an episode's parts."""
        return TASKS[self.name][0](parts, driven)


TASKS: dict[str, tuple[Score, str]] = {
    "moved": (moved, "a loose part ends {:g} px or more from its start"),
    "reached": (reached, "a moving part of the robot comes within {:g} px of a loose part's start"),
    "placed": (placed, "the T ends within {:g} px of its goal"),
}


def task_of(robot: str, words: str = "moved") -> Task:
    """Return the task of a robot from words: moved, moved=8, reached or reached=15; of pushers, placed too.

    Raises:
        UsageError: the words name no task.
    """
    name, given, number = words.partition("=")
    try:
        if name not in TASKS:
            raise ValueError
        usual = {"moved": MOVED_LIMITS.get(robot, BLOCK_MOVED), "reached": NEAR_LIMIT, "placed": GOAL_LIMIT}
        limit = float(number) if given else usual[name]
        if not 0 < limit < truth.SIZE:
            raise ValueError
    except ValueError:
        remedy = f"give {' or '.join(TASKS)}, if wanted with px: moved={BLOCK_MOVED:g}"
        raise UsageError("judge", f"{words!r} is not a task", remedy) from None
    if name == "placed" and truth.goal_of(robot) is None:
        known = ", ".join(truth.PUSHERS)
        raise UsageError("judge", f"{robot} has no goal to place a part at", f"robots with one: {known}")
    return Task(name, limit if name == "moved" else -limit)


@dataclass(frozen=True)
class StateJudge:
    """A judge of one robot and one task, for images as its tokenizer shows them.

    It is also an `EpisodeJudge` of `WorldModelEnv`: the reward is the score so far; it never ends an episode.

    Attributes:
        probe: reads the places.
        limit: the least score, as read, of a success.
        held_out: its accuracy on true episodes that neither the probe nor the limit has seen.
    """

    task: Task
    probe: Probe
    limit: float
    held_out: Accuracy

    def score(self, images: Images) -> Floats:
        """Return the scores (N,) of episodes (N, T, S, S, 3)."""
        return self.read_score(self.probe.read(images), self.probe.areas(images))

    def read_score(self, places: Floats, areas: Floats) -> Floats:
        """Return the scores (N,) of the places (N, T, P, 2) and areas (N, T, P) that the probe reads."""
        loose = last_seen(places[..., self.probe.loose, :], areas[..., self.probe.loose])
        own = places[..., self.probe.own, :]
        return self.task.score(np.concatenate([own, loose], axis=-2), len(self.probe.own))

    def true_score(self, parts: Floats) -> Floats:
        """Return the scores (N,) of true places (N, T, P, 2), by readable own parts and loose ones."""
        kept = np.concatenate([self.probe.own, np.arange(self.probe.driven, parts.shape[-2])])
        return self.task.score(parts[..., kept, :], len(self.probe.own))

    def success(self, scores: Floats) -> Bools:
        """Return which scores are judged a success."""
        return scores >= self.limit

    def begun(self) -> Judge:
        """Return the judge of one episode, which reads each of its images once."""
        places: list[Floats] = []
        areas: list[Floats] = []

        def judge(images: Images, actions: Any) -> tuple[float, bool]:
            if len(new := images[len(places) :]):
                places.extend(self.probe.read(new))
                areas.extend(self.probe.areas(new))
            return float(self.read_score(np.stack(places)[None], np.stack(areas)[None])[0]), False

        return judge


def train_judge(
    robot: str,
    tokenizer: Tokenizer,
    stride: int,
    frames: int,
    task: Task | None = None,
    *,
    seed: int = 0,
    probe: Probe | None = None,
    tell: Tell = lambda words: None,
) -> StateJudge:
    """Train a judge on recorded episodes of a laboratory robot.

    Args:
        robot: a laboratory robot.
        tokenizer: whose images it is to judge.
        stride: control steps a frame.
        frames: T of the episodes to judge.
        task: by default `moved`.
        seed: of the probe, the episodes and the intervals.
        probe: one that is trained already.
        tell: called with how far it is.

    Raises:
        HMAError: the robot has no loose parts that can be read, or the judge is no better than chance.
    """
    task = task or task_of(robot)
    probe = probe or train_probe(robot, tokenizer, stride, seed, tell)
    unread = {"reached": not len(probe.own), "placed": len(probe.loose) < 2}
    if not len(probe.loose) or unread.get(task.name):
        fault = f"cannot judge whether {task.text}: the probe does not locate these parts"
        raise HMAError(f"judge of {robot}", fault, "judge another task or robot")
    looked = (
        set(range(frames)) if task.name == "reached" else {0, *range(max(frames - END_FRAMES, 1), frames)}
    )
    judge = StateJudge(task, probe, task.limit, accuracy(np.ones(1, bool), np.ones(1, bool)))

    def make() -> Arrays:
        scores = np.empty((2, EXAMPLES))
        for row in range(EXAMPLES):
            number, wander = FIRST_EPISODE + EPISODES + row, task.name != "placed"
            made = truth.episode(robot, frames, stride, seed, number, looked, wander=wander)
            shown = as_shown(tokenizer, as_seen(robot, tokenizer, made.pictures))
            scores[:, row] = judge.true_score(made.parts[None])[0], judge.score(shown[None])[0]
            tell(f"training the judge: episode {row + 1} of {EXAMPLES}")
        return {"scores": scores}

    facts = {"robot": robot, "task": task.name, "stride": stride, "frames": frames, "seed": seed}
    facts |= {"examples": EXAMPLES, "probe": weights_sha256(probe.network)}
    true, read = kept("judge", tokenizer, facts, make)["scores"]
    half = EXAMPLES // 2
    success = true >= task.limit
    limit = best_limit(read[:half], success[:half], task.limit)
    found = accuracy(success[half:], read[half:] >= limit)
    if not found.better_than_chance:
        # successes of `moved` get rarer with a higher limit, those of the others more frequent
        rare = found.too_few
        factor = 0.5 if rare and (task.name == "moved") == (rare == "successes") else 2
        remedy = f"try another task or limit, such as --judge {task.name}={factor * abs(task.limit):g}"
        raise HMAError(f"judge of {robot}", f"may be no better than chance: {found}", remedy)
    return replace(judge, limit=limit, held_out=found)


def best_limit(read: Floats, success: Bools, limit: float) -> float:
    """Return the limit of scores (N,) that tells successes, as near to the true one as the examples allow.

    Of all limits whose balanced accuracy is within one standard error of the highest, it is the nearest:
    where few examples lie between failure and success, many limits tell them about as well. If all episodes
    end alike, the true limit stays.
    """
    if success.all() or not success.any():
        return limit
    ordered = np.unique(read)
    tried = np.concatenate([[limit], (ordered[1:] + ordered[:-1]) / 2])
    said = read >= tried[:, None]
    rates = np.stack([said[:, success].mean(axis=1), (~said[:, ~success]).mean(axis=1)])
    balanced = rates.mean(axis=0)
    counts = np.array([success.sum(), (~success).sum()])
    top = rates[:, balanced.argmax()]
    error = np.sqrt((top * (1 - top) / counts).sum()) / 2
    good = tried[balanced >= balanced.max() - error - 1e-12]
    return float(good[np.abs(good - limit).argmin()])


def last_seen(places: Floats, areas: Floats) -> Floats:
    """Return places (N, T, P, 2), where a part stays as long as its area (N, T, P) is small."""
    seen = areas >= VISIBLE_SHARE * areas[:, :1]
    seen[:, 0] = True
    times = np.where(seen, np.arange(seen.shape[1])[:, None], 0)
    return np.take_along_axis(places, np.maximum.accumulate(times, axis=1)[..., None], axis=1)
