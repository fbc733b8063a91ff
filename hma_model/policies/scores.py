"""Score policies in the true simulator and inside the world model, and compare the two.

    found = evaluate_policies("rails_03", ["scripted", "scripted:noise=0.5", "random", "still"])
    found.success["spearman"]         # of the policies' success rates

Every policy acts in the same scenes of a laboratory robot: once in its simulator, which knows the outcome,
and once in the world model from the same frames, where a judge reads the outcome off the images. Both
branches are paired: they share the start, the state in it and all random numbers of every control step. A
policy is refused if it acts otherwise in the first chunk all the same, and a function also if it does when it
is shown the simulator's images again. The actions that a policy gave in the model are also played to the
simulator. So the judge's word on generated frames is compared with what truly comes of the same actions.

With an output folder, what came of each policy lies in a folder of it until the page is written, so the same
call continues. A policy that was changed in between is scored again.

M policies, N episodes, T frames after the prompt, S pixels a side.
"""

import json
import warnings
from collections.abc import Callable, Sequence
from contextlib import closing, nullcontext
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.arrays import Bools, Float32s, Floats, Images, Ints
from hma_data.errors import HMAError, UsageError
from hma_data.storage.files import short_sha256
from hma_data.storage.kept import KeptParts
from hma_data.storage.locks import locked
from hma_data.storage.paths import StrPath, as_path
from hma_model.arrays import evenly
from hma_model.evaluation.agreement import (
    NEEDED,
    Accuracy,
    Estimate,
    accuracy,
    alike_pairs,
    auroc,
    correlations,
    episode_correlation,
    mmrv,
    precision_recall,
    share_interval,
)
from hma_model.evaluation.calibration import Meter, accumulated
from hma_model.evaluation.intervals import rounded
from hma_model.generation.commands import OutsideRangeWarning
from hma_model.policies.arenas import Arena, ModelArena, Scenes, TrueArena
from hma_model.policies.base import Policy, begin, checked, kept_randomness, seed_samplers
from hma_model.policies.catalog import identity, read_policy
from hma_model.policies.fingerprints import (
    device_facts,
    object_sha256,
    policy_facts,
    world_digests,
    world_facts,
)
from hma_model.policies.judge import StateJudge, task_of, train_judge
from hma_model.policies.planning import Planning
from hma_model.policies.scripted import Called
from hma_model.worlds.world import World, load_world

Progress = Callable[[float, str], None]
EPISODES, FRAMES = 32, 40
WORK = ".policies"  # folder of finished policies in an output
OUTCOMES = ("true", "model", "replayed")
TRUE, MODEL, REPLAYED = range(3)
SHOWN_FRAMES = 8  # images that are kept of an episode
SHARED = "start frames and state, and the random numbers of every control step"  # by both branches
GOOD_ACCURACY = 0.75  # balanced; an interval that holds chance and this says nothing


@dataclass(frozen=True)
class Scored:
    """The results of one policy.

    Attributes:
        scores, success: (3, N) of its episodes: in the simulator, in the world model as judged, and in the
            simulator under the actions that the policy gave in the model.
        shown: frames of which images are kept.
        true_images, model_images: (N, len(shown), S, S, 3).
        stated: (N,) how unsure the model was, as a `Meter` takes it; NaN if it is not measured.
    """

    policy: str
    scores: Floats
    success: Bools
    shown: Ints
    true_images: Images
    model_images: Images
    stated: Floats


@dataclass(frozen=True)
class Abstention:
    """What the model says of the episodes in which it does not expect a large error of its own.

    Attributes:
        max_error_px: the largest state error to expect at the end of an episode that is judged.
        judged, count: episodes that are judged, and all.
        generated, precision, recall: of those that are judged, as of `PolicyEvaluation`.
    """

    max_error_px: float
    judged: int
    count: int
    generated: Accuracy | None
    precision: Estimate
    recall: Estimate

    @classmethod
    def of(cls, meter: Meter, max_error_px: float, scored: Sequence[Scored]) -> "Abstention":
        """Return what is left of policies' episodes."""
        kept = meter.expects_at_most(np.stack([one.stated for one in scored]), max_error_px)
        success = np.stack([one.success for one in scored], axis=1)
        outcomes = success[REPLAYED], success[MODEL]
        agreed = accuracy(*outcomes, kept) if kept.any() else None
        return cls(max_error_px, int(kept.sum()), kept.size, agreed, *precision_recall(*outcomes, kept))


@dataclass(frozen=True)
class PolicyEvaluation:
    """Policies scored twice.

    Attributes:
        sampling: how the world drew its frames.
        success, score: agreement over policies of the success rates, and of the mean scores, by name: the
            correlations "pearson" and "spearman", and "mmrv", the mean maximum rank violation.
        generated: accuracy of the judge on generated frames, against the simulator under the same actions.
        precision: share of the successes that it sees on generated frames which the simulator confirms.
        recall: share of the simulator's successes under these actions that it sees.
        followed: how the ranks of the scores of single episodes, as judged on generated frames, correlate
            with those of the true ones under the same actions.
        auroc: how well these scores tell the simulator's successes under these actions from its failures.
        paired: "precision", "recall" and "auroc" of the episodes in the model, against the episodes of the
            same start in the simulator, where the policy acted by itself.
        abstention: of the episodes in which the model expects a small error of its own, if that is asked for.
    """

    embodiment: str
    checkpoint: str
    sampling: str
    seed: int
    frames: int
    judge: StateJudge
    policies: tuple[Scored, ...]
    success: dict[str, Estimate]
    score: dict[str, Estimate]
    generated: Accuracy
    precision: Estimate
    recall: Estimate
    followed: Estimate
    auroc: Estimate
    paired: dict[str, Estimate]
    abstention: Abstention | None = None

    @property
    def refusal(self) -> str:
        """Return why nothing follows from what policies do in the model; "" if something does.

        What a judge says of single generated episodes must be better than chance, by outcome and by score:
        policies can differ in the model and in the simulator for other reasons than what they did.
        """
        judged = self.generated
        if few := judged.too_few:
            said = f"there are too few scenes with {few} to tell whether the judge is better than chance"
            return f"{said} (about {NEEDED} with successes and {NEEDED} with failures are needed)"
        if not judged.better_than_chance:
            if judged.high is not None and judged.high >= GOOD_ACCURACY:
                return "the judge may be no better than chance; more episodes would tell"
            return "the judge is no better than chance"
        if self.followed.low is not None and self.followed.low <= 0:
            return "the per-episode scores may agree with the simulator's no better than chance"
        return ""

    def alike(self, where: int) -> list[tuple[str, str]]:
        """Return the pairs of policies that cannot be told apart by their outcomes, TRUE or MODEL."""
        pairs = alike_pairs(np.stack([one.success[where] for one in self.policies]))
        return [(self.policies[one].policy, self.policies[other].policy) for one, other in pairs]

    def rows(self) -> list[dict[str, Any]]:
        """Return the figures of each policy."""
        rows = []
        for one in self.policies:
            row: dict[str, Any] = {"policy": one.policy}
            for name, scores, success in zip(OUTCOMES, one.scores, one.success, strict=True):
                row[f"{name}_success"] = float(success.mean())
                row[f"{name}_success_interval"] = share_interval(int(success.sum()), len(success))
                row[f"{name}_score"] = float(scores.mean())
            alike = one.success[TRUE] == one.success[MODEL]
            row["episodes_alike"] = float(alike.mean())
            row["episodes_alike_interval"] = share_interval(int(alike.sum()), len(alike))
            rows.append(row)
        return rows

    def to_json(self) -> dict[str, Any]:
        """Return all figures, and the outcome of each episode, as plain values."""
        outcomes: dict[str, dict[str, Any]] = {}
        for one in self.policies:
            each = zip(OUTCOMES, one.scores.round(3).tolist(), one.success.tolist(), strict=True)
            outcomes[one.policy] = {
                name: {"scores": scores, "success": success} for name, scores, success in each
            }
            outcomes[one.policy]["stated_uncertainty"] = rounded(one.stated)
        own = ("embodiment", "checkpoint", "sampling", "seed", "frames")
        return {key: getattr(self, key) for key in own} | {
            "episodes": self.policies[0].scores.shape[1],
            "judge": {
                "task": self.judge.task.name,
                "success": self.judge.task.text,
                "limit": self.judge.limit,
                "held_out": asdict(self.judge.held_out),
                "generated": asdict(self.generated),
                "precision": asdict(self.precision),
                "recall": asdict(self.recall),
                "score_rank_correlation": asdict(self.followed),
                "auroc": asdict(self.auroc),
                "generated_better_than_chance": self.generated.better_than_chance,
            },
            "refused": self.refusal,
            "abstention": None if self.abstention is None else asdict(self.abstention),
            "paired": {"shared": SHARED, "first_chunks_equal": True}  # else `score_policy` raises
            | {name: asdict(one) for name, one in self.paired.items()},
            "policies": self.rows(),
            "alike": {"simulator": self.alike(TRUE), "model": self.alike(MODEL)},
            "correlation": {
                what: {name: asdict(one) for name, one in found.items()}
                for what, found in (("success", self.success), ("score", self.score))
            },
            "outcomes": outcomes,
        }


def evaluate_policies(
    embodiment: str,
    policies: Sequence[str | tuple[str, Policy]],
    *,
    checkpoint: StrPath = "embedded",
    episodes: int = EPISODES,
    frames: int = FRAMES,
    judge: str | StateJudge = "moved",
    seed: int = 0,
    max_error: float | None = None,
    out: StrPath | None = None,
    world: World | None = None,
    on_progress: Progress = lambda done, words: None,
    **settings: Any,
) -> PolicyEvaluation:
    """Score policies in the simulator of a laboratory robot and inside a world model.

    Args:
        embodiment: a robot of the laboratory that the checkpoint has.
        policies: words as `read_policy` takes them, or a name and a policy.
        checkpoint: as `load_world` takes it.
        episodes: N.
        frames: T.
        judge: words as `task_of` takes them, or a trained judge.
        seed: of scenes, policies, judge and intervals; on one device, the same seed gives the same figures.
        max_error: px of 128; of episodes whose state error is expected to end above it, the model's judgement
            is left out of `abstention`.
        out: folder that keeps finished policies until `write_report` has written there; None keeps nothing.
        world: a world instead of a checkpoint.
        on_progress: called with the frames done, and what is done.
        settings: of the world made from the checkpoint, as of `load_world`.

    Raises:
        HMAError: a policy fails, the robot has no simulator, or the judge is no better than chance.
        UsageError: `max_error` is given, and there is no calibrated uncertainty that is of use.
        OutputError: the folder cannot be written, or was begun with other settings.
    """
    names = names_of(policies)
    folder = None if out is None else as_path(out)
    with locked(folder) if folder else nullcontext():
        world = world or load_world(checkpoint, [embodiment], **settings)
        sampling = sampling_of(world)
        scenes = Scenes.of(world, embodiment, episodes, seed)
        meter = None if max_error is None else choosing_meter(world, embodiment)
        made = [read_policy(one, scenes, world) for one in policies]
        keys = part_keys(policies, world, embodiment, judge) if folder else names
        for name, policy in zip(names, made, strict=True):
            if not isinstance(policy, Planning):
                # What it returns is refused here, before minutes of work.
                arena = TrueArena(scenes.take(range(1)), world.image_shape[0])
                begin(name, policy, arena)
                checked(name, policy, arena)
        if not isinstance(judge, StateJudge):
            task = task_of(embodiment, judge)
            told = partial(on_progress, 0)
            judge = train_judge(
                embodiment, world.tokenizer, scenes.stride, frames + 1, task, seed=seed, tell=told
            )  # fmt: skip
        for policy in made:
            if isinstance(policy, Planning):
                policy.cost.judge = judge
        kept = kept_policies(folder, world, scenes, frames, {"judge": asdict(judge.task)})
        score = partial(score_policy, world=world, scenes=scenes, judge=judge, frames=frames)
        each = play_all(names, made, keys, kept, frames * episodes, on_progress, score)
        scored = [Scored(name, **arrays) for name, arrays in zip(names, each, strict=True)]
    success = np.stack([one.success for one in scored], axis=1)  # (3, M, N)
    scores = np.stack([one.scores for one in scored], axis=1)
    by_success, by_score = (
        correlations(one[TRUE], one[MODEL], seed) | {"mmrv": mmrv(one[TRUE], one[MODEL], seed)}
        for one in (success.astype(float), scores)
    )
    judged, replayed = success[MODEL], success[REPLAYED]
    precision, recall = precision_recall(success[TRUE], judged)
    return PolicyEvaluation(
        embodiment,
        str(checkpoint),
        sampling,
        seed,
        frames,
        judge,
        tuple(scored),
        by_success,
        by_score,
        accuracy(replayed, judged),
        *precision_recall(replayed, judged),
        episode_correlation(scores[MODEL], scores[REPLAYED], seed),
        auroc(replayed, scores[MODEL], seed),
        {"precision": precision, "recall": recall, "auroc": auroc(success[TRUE], scores[MODEL], seed)},
        None if meter is None or max_error is None else Abstention.of(meter, max_error, scored),
    )


def choosing_meter(world: World, embodiment: str) -> Meter:
    """Return the meter by which rollouts of a robot can be left out.

    Raises:
        UsageError: there is none, or it chooses no better than chance.
    """
    meter, reason = world.meter(embodiment)
    if meter is not None and not meter.chooses:
        reason = f"the least uncertain half of {embodiment}'s rollouts may err no less than all of them"
    if meter is None or reason:
        raise UsageError("--max-error", reason, "leave it out")
    return meter


def names_of(policies: Sequence[str | tuple[str, Policy]]) -> list[str]:
    """Return the names of policies; raise UsageError if there is none, or one is given twice.

    A policy that counts twice would make correlations look better founded than they are.
    """
    if not policies:
        raise UsageError("policies", "none is given", "give at least one; a correlation takes three")
    names = [one if isinstance(one, str) else one[0] for one in policies]
    seen: dict[Any, str] = {}
    for name, one in zip(names, policies, strict=True):
        known = (name, identity(name)) if isinstance(one, str) else (name,)
        if first := next((seen[key] for key in known if key in seen), ""):
            fault = "is given twice" if first == name else f"is the same policy as {first}"
            raise UsageError(f"policy {name}", fault, "give each once")
        seen |= dict.fromkeys(known, name)
    return names


def sampling_of(world: World) -> str:
    """Return in words how a world draws its frames."""
    sampling = f"unmask_steps={world.decoding.unmask_steps},temperature={world.decoding.temperature:g}"
    return sampling if world.precision == "float32" else f"{sampling},precision={world.precision}"


def part_keys(
    policies: Sequence[str | tuple[str, Policy]], world: World, embodiment: str, judge: str | StateJudge
) -> list[str]:
    """Return the name under which each policy's results are kept: another one for all that changes them.

    The rest is in the settings of the folder of work, with which a judge of words always comes out the same.
    """
    shared = ["stated", world_facts(world), None if isinstance(judge, str) else object_sha256(judge)]
    own = [
        (one, policy_facts(one, embodiment)) if isinstance(one, str) else (one[0], object_sha256(one[1]))
        for one in policies
    ]
    return [short_sha256(json.dumps([one, shared]), 32) for one in own]


def kept_policies(
    folder: Path | None, world: World, scenes: Scenes, frames: int, judge: dict[str, Any]
) -> KeptParts | None:
    """Return where finished policies are kept in an output; None without one."""
    if folder is None:
        return None
    facts = {"embodiment": scenes.name, "episodes": len(scenes.numbers), "frames": frames}
    facts |= judge | {"seed": scenes.seed, "sampling": sampling_of(world)}
    return KeptParts(folder / WORK, facts | world_digests(world, scenes.name) | device_facts(world.model))


def play_all(
    names: Sequence[str],
    policies: Sequence[Policy],
    keys: Sequence[str],
    kept: KeptParts | None,
    frames: int,
    on_progress: Progress,
    play: Callable[..., dict[str, NDArray[Any]]],
) -> list[dict[str, NDArray[Any]]]:
    """Return what `play` makes of each policy, called with its name, itself and what tells how far it is.

    Args:
        names, keys: of the policies, and those under which their results are kept.
        kept: where finished policies are; None keeps nothing.
        frames: of all episodes of a policy.
    """
    on_progress(0, "episodes")  # the clock of the time left starts here
    found = []
    for number, (name, policy, key) in enumerate(zip(names, policies, keys, strict=True)):

        def tell(done: float, where: str = "", number: int = number, name: str = name) -> None:
            on_progress(number * frames + done, f"{name}, {where}" if where else name)

        make = partial(play, name, policy=policy, tell=tell)
        found.append(make() if kept is None else kept.part(key, make))
    return found


def score_policy(
    name: str,
    policy: Policy,
    world: World,
    scenes: Scenes,
    judge: StateJudge,
    frames: int,
    tell: Progress = lambda done, where: None,
) -> dict[str, NDArray[Any]]:
    """Return what comes of one policy in the simulator and in the model: the arrays of `Scored`.

    Raises:
        HMAError: the policy fails, or acts otherwise though it is given the same again.
    """
    size = world.image_shape[0]
    limit = judge.task.limit
    shown = evenly(frames + 1, SHOWN_FRAMES)
    true = TrueArena(scenes, size)
    true_images, acted = run(name, policy, true, frames, lambda done: tell(0, "in the simulator"))
    if isinstance(policy, Called):  # others draw from seeded generators alone
        shown_again: Any = _Shown(scenes, true_images)
        _, repeated = run(name, policy, shown_again, frames)
        _require_equal(name, acted, repeated, "shown the same images again, its actions differ")
    model = ModelArena(world, true, judge.probe)
    with closing(model), world.drawing(measure=True):
        model_images, actions = run(name, policy, model, frames, lambda done: tell(done, "in the model"))
    fault = "from the same image, its first actions differ between model and simulator"
    _require_equal(name, acted[: scenes.stride], actions[: scenes.stride], fault)
    again = TrueArena(scenes, size, drawn=False)
    for action in actions:
        again.step(action)
    there, replayed = (judge.true_score(np.stack(arena.parts, axis=1)) for arena in (true, again))
    read = judge.score(np.stack(model_images, axis=1))
    return {
        "scores": np.stack([there, read, replayed]),
        "success": np.stack([there >= limit, judge.success(read), replayed >= limit]),
        "shown": shown,
        "stated": accumulated(np.stack(model.unsure, axis=1))[:, -1],
        "true_images": np.stack([true_images[frame] for frame in shown], axis=1),
        "model_images": np.stack([model_images[frame] for frame in shown], axis=1),
    }


@dataclass
class _Shown:
    """An arena that shows images (T + 1 of (N, S, S, 3)) once more, whatever the actions are."""

    scenes: Scenes
    shown: list[Images]
    steps: int = 0

    @property
    def images(self) -> Images:
        return self.shown[self.steps // self.scenes.stride]

    @property
    def fresh(self) -> bool:
        return self.steps % self.scenes.stride == 0

    def step(self, actions: Float32s) -> None:
        self.steps += 1


def _require_equal(name: str, one: list[Float32s], other: list[Float32s], fault: str) -> None:
    """Check that two series of a policy's actions (N, A) are equal, but for rounding."""
    scale = np.abs(one).max(axis=(0, 1)) + 1e-6
    if not (np.abs(np.subtract(one, other)) <= 1e-5 * scale).all():
        remedy = (
            "draw from random, numpy.random or torch, which are seeded, or seed your generator in reset()"
        )
        raise HMAError(f"policy {name}", f"is not deterministic: {fault}", remedy)


def run(
    name: str, policy: Policy, arena: Arena, frames: int, tell: Callable[[float], None] = lambda done: None
) -> tuple[list[Images], list[Float32s]]:
    """Let a policy act for so many frames, with global random numbers that are seeded at each step.

    Returns:
        The T + 1 images (N, S, S, 3), the last one of the prompt first; and all actions (N, A).

    Raises:
        HMAError: the policy fails.
    """
    images = [arena.made if isinstance(arena, ModelArena) else arena.images]
    actions = list[Float32s]()
    said = ""
    with kept_randomness():
        key = (arena.scenes.seed, 5, arena.scenes.numbers[0])
        seed_samplers(*key)
        begin(name, policy, arena)
        for step in range(frames * arena.scenes.stride):
            seed_samplers(*key, step)
            actions.append(checked(name, policy, arena))
            if not said and isinstance(arena, ModelArena) and (said := arena.outside(actions[-1])):
                guess = "predictions under such actions are unreliable"
                warnings.warn(f"policy {name}: {said}; {guess}", OutsideRangeWarning, stacklevel=2)
            arena.step(actions[-1])
            if arena.fresh:
                images.append(arena.images)
                tell((len(images) - 1) * len(arena.images))
    return images, actions
