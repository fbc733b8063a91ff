"""Score policies inside the world model alone, for robots without a simulator.

    found = evaluate_recorded("my_arm", ["lerobot:act"], checkpoint="runs/my_arm", judge="reward_classifier")

Episodes begin with the first frames of held-out recorded episodes, and a reward model judges what the world
model shows. There is no truth to compare with, so the result states how often the judge is right on recorded
episodes. How it does on generated frames stays unknown.

N episodes, T frames after the prompt, A action dims.
"""

from collections.abc import Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.arrays import Bools, Floats, Images
from hma_data.console import human_count, print_table
from hma_data.episodes.sheets import grid, png_bytes
from hma_data.errors import UsageError
from hma_data.shards.reader import ShardSet
from hma_data.storage.files import short_sha256
from hma_data.storage.locks import locked
from hma_data.storage.paths import StrPath, as_path
from hma_model.arrays import evenly
from hma_model.evaluation.agreement import alike_pairs, share_interval
from hma_model.evaluation.pages import Page, as_sentence
from hma_model.generation.decode import cameras_for
from hma_model.policies.arenas import Beginning, ModelArena, Scenes
from hma_model.policies.base import Policy, begin, checked
from hma_model.policies.catalog import read_policy
from hma_model.policies.fingerprints import folder_facts
from hma_model.policies.planning import Planning
from hma_model.policies.report import rate
from hma_model.policies.rewards import RewardJudge, labelled_shards, measured_judge
from hma_model.policies.scores import (
    EPISODES,
    FRAMES,
    SHOWN_FRAMES,
    Progress,
    kept_policies,
    names_of,
    part_keys,
    play_all,
    run,
    sampling_of,
)
from hma_model.worlds.prompts import SeenShards, default_frames, long_pieces
from hma_model.worlds.scenes import at_rest
from hma_model.worlds.world import World, load_world

COLUMNS = ("policy", "success in the model", "mean reward")
SHOWN_EPISODES = 2  # of each policy and outcome on the page
UNKNOWN = "the judge's accuracy on generated frames is unknown: compare policies, not rates"


@dataclass(frozen=True)
class Played:
    """The results of one policy.

    Attributes:
        scores, success: (N,) of its episodes, as judged.
        images: (N, SHOWN_FRAMES, S, V·S, 3).
    """

    policy: str
    scores: Floats
    success: Bools
    images: Images


@dataclass(frozen=True)
class ModelEvaluation:
    """Policies scored in the model alone.

    Attributes:
        beginnings: recordings whose frames the N episodes begin with; the first ones of as many differ.
    """

    embodiment: str
    checkpoint: str
    sampling: str
    seed: int
    frames: int
    beginnings: int
    judge: RewardJudge
    policies: tuple[Played, ...]

    def rows(self) -> list[dict[str, Any]]:
        """Return the figures of each policy; intervals count each beginning once."""
        count = self.beginnings
        return [
            {
                "policy": one.policy,
                "model_success": float(one.success.mean()),
                "model_success_interval": share_interval(one.success.mean() * count, count),
                "model_score": float(one.scores.mean()),
            }
            for one in self.policies
        ]

    def to_json(self) -> dict[str, Any]:
        """Return all figures, and the outcome of each episode, as plain values."""
        own = ("embodiment", "checkpoint", "sampling", "seed", "frames", "beginnings")
        return {key: getattr(self, key) for key in own} | {
            "episodes": self.policies[0].success.size,
            "judge": self.judge.to_json(),
            "policies": self.rows(),
            "outcomes": {
                one.policy: {"scores": one.scores.round(3).tolist(), "success": one.success.tolist()}
                for one in self.policies
            },
        }

    def sentences(self) -> list[str]:
        """Return in words what the table means."""
        pairs = alike_pairs(np.stack([one.success[: self.beginnings] for one in self.policies]))
        names = [f"{self.policies[one].policy} and {self.policies[other].policy}" for one, other in pairs]
        alike = [f"not distinguishable by success: {'; '.join(names)}"] if names else []
        success = "success: the judge scores some frame above 0.5; 95 % intervals over recordings"
        return [success, self.judge.sentence, UNKNOWN, *alike]

    def table(self) -> list[list[Any]]:
        """Return a row of COLUMNS for each policy."""
        return [
            [row["policy"], rate(row, "model_success"), round(row["model_score"], 2)] for row in self.rows()
        ]


def evaluate_recorded(
    embodiment: str,
    policies: Sequence[str | tuple[str, Policy]],
    *,
    judge: str,
    shards: StrPath | None = None,
    checkpoint: StrPath = "embedded",
    episodes: int = EPISODES,
    frames: int = FRAMES,
    seed: int = 0,
    out: StrPath | None = None,
    world: World | None = None,
    on_progress: Progress = lambda done, words: None,
    **settings: Any,
) -> ModelEvaluation:
    """Score policies inside a world model, judged by a reward model of lerobot.

    Args:
        embodiment: a robot of the checkpoint.
        policies: words as `read_policy` takes them, or a name and a policy; none that needs a simulator.
        judge: folder or hub repository of the reward model.
        shards: set whose held-out episodes have success labels; by default that of the training run.
        others: as of `evaluate_policies`.

    Raises:
        HMAError: a policy fails, or the judge cannot be loaded, measured, or trusted.
        OutputError: the folder cannot be written, or was begun with other settings.
    """
    names = names_of(policies)
    for name in names:
        if name.partition(":")[0] in ("scripted", "reach"):
            raise UsageError(f"policy {name}", "reads the state of a simulator", "give another policy")
    folder = None if out is None else as_path(out)
    with locked(folder) if folder else nullcontext():
        world = world or load_world(checkpoint, [embodiment], **settings)
        scenes = Scenes.of(world, embodiment, episodes, seed, simulator=False)
        made = [read_policy(one, scenes, world) for one in policies]
        if planner := next((name for name, one in zip(names, made) if isinstance(one, Planning)), None):
            raise UsageError(f"policy {planner}", "needs a simulated robot's task", "give another policy")
        labelled = labelled_shards(world, embodiment, shards, judge)
        measured = measured_judge(judge, world, embodiment, labelled, partial(on_progress, 0))
        begun, beginnings = recorded_beginnings(world, scenes, labelled)
        for name, policy in zip(names, made, strict=True):
            _try(name, policy, world, begun)
        digest = short_sha256(labelled.manifest.to_text(), 64)
        files = folder_facts(Path(judge))
        judged_by = {"shards_sha256": digest, "judge": judge, "judge_sha256": files}
        kept = kept_policies(folder, world, scenes, frames, judged_by)
        keys = part_keys(policies, world, embodiment, judge) if folder else names
        play = partial(_play, world=world, begun=begun, judge=measured, frames=frames)
        each = play_all(names, made, keys, kept, frames * episodes, on_progress, play)
        played = [Played(name, **arrays) for name, arrays in zip(names, each, strict=True)]
    return ModelEvaluation(
        embodiment, str(checkpoint), sampling_of(world), seed, frames, beginnings, measured, tuple(played)
    )


def recorded_beginnings(world: World, scenes: Scenes, shards: ShardSet) -> tuple[Beginning, int]:
    """Return the first frames of held-out episodes in turn, one for each scene, and of how many recordings.

    The first episodes are of different recordings.

    Raises:
        UsageError: no held-out episode is long enough.
    """
    count = default_frames(world.model)
    pieces = long_pieces(shards, count)
    rows = [row for row, part in pieces if row["split"] == "val" and part.start == 0]
    if not rows:
        fault = f"has no held-out episode of {count} frames without a pause"
        raise UsageError(shards.folder, fault, "give other shards")
    recordings = shards.recordings(row["episode_index"] for row in rows)
    first = np.unique(recordings, return_index=True)[1]
    others = np.setdiff1d(np.arange(len(rows)), first)
    rows = [rows[number] for number in (*np.sort(first), *others)]
    seen = SeenShards(shards, cameras_for(world.model, shards))
    at = np.arange(count) * shards.row_stride
    kept = [seen.window(row, at) for row in rows[: len(scenes.numbers)]]
    prompts = [kept[number % len(kept)] for number in range(len(scenes.numbers))]
    dims = len(scenes.dimensions)
    # the action in force at the last frame of the prompt; without one, a target is zero
    last = [prompt.chunks[-1, -dims:] if len(prompt.chunks) else np.zeros(dims) for prompt in prompts]
    held = at_rest(scenes.dimensions, np.nan_to_num(np.stack(last)))
    return Beginning(scenes, prompts, held), min(len(first), len(kept))


def _try(name: str, policy: Policy, world: World, begun: Beginning) -> None:
    """Refuse what a policy returns before minutes of work."""
    one = Beginning(begun.scenes.take(range(1)), begun.prompts[:1], begun.held[:1])
    with closing(ModelArena(world, one, None)) as arena:
        begin(name, policy, arena)
        checked(name, policy, arena)


def _play(
    name: str, policy: Policy, tell: Any, world: World, begun: Beginning, judge: RewardJudge, frames: int
) -> dict[str, NDArray[Any]]:
    """Return what comes of one policy in the model: the arrays of `Played`."""
    with closing(ModelArena(world, begun, None)) as arena:
        images, _ = run(name, policy, arena, frames, tell)
    shown = evenly(frames + 1, SHOWN_FRAMES)
    # the frames of an episode are scored together, so that memory does not grow with N
    scores = np.concatenate([judge.model.score(np.stack(one)[None]) for one in zip(*images, strict=True)])
    return {
        "scores": scores,
        "success": judge.model.success(scores),
        "images": np.stack([images[frame] for frame in shown], axis=1),
    }


def show(found: ModelEvaluation) -> None:
    """Print the table and what it means."""
    print_table(list(COLUMNS), found.table())
    for sentence in found.sentences():
        print(sentence)


def html(found: ModelEvaluation) -> str:
    """Return the page."""
    lead = (
        f"{found.embodiment} in {found.checkpoint} ({found.sampling}): {found.policies[0].success.size} "
        f"episodes of {found.frames} frames per policy, from the first frames of held-out episodes of "
        f"{human_count(found.beginnings, 'recording')}"
    )
    page = Page("Policies inside the world model", lead)
    page.table(COLUMNS, found.table())
    for sentence in found.sentences():
        page.text(as_sentence(sentence))
    for one in found.policies:
        page.section(one.policy)
        for outcome, word in ((True, "success"), (False, "failure")):
            for number in np.flatnonzero(one.success == outcome)[:SHOWN_EPISODES]:
                caption = f"episode {number}, judged a {word}: highest reward {one.scores[number]:.2f}"
                page.picture(png_bytes(grid([list(one.images[number])])), "png", caption)
    return page.html()
