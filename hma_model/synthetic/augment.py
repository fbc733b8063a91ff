"""Make synthetic episodes: the world model continues real frames under replayed, perturbed or other actions.

Of the episodes made, the share is kept of which the model was least unsure, and of these, if a judge is
given, the successes. `synthetic` writes them as a shard set of the model's own tokens.

Finished batches lie in a folder of the output until the shards are written, so the same call continues.

N episodes, P frames of a prompt, T generated frames, A action dims, K = stride · A.
"""

import warnings
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.arrays import Bools, Float32s, Floats
from hma_data.errors import HMAError, UsageError
from hma_data.lab.scripted import steerable
from hma_data.lab.simulator import embodiment, simulated
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.manifest import Manifest
from hma_data.shards.reader import ShardSet
from hma_data.storage.files import short_sha256
from hma_data.storage.kept import KeptParts, remove_kept
from hma_data.storage.locks import locked
from hma_data.storage.paths import StrPath, as_path
from hma_model.evaluation.calibration import Meter, accumulated
from hma_model.evaluation.probe import Probe, train_probe
from hma_model.evaluation.recorded_state import EPISODES_NEEDED, Reader, recorded_reader, simulated_reader
from hma_model.evaluation.state_reader import Tell
from hma_model.generation.decode import cameras_for
from hma_model.policies.arenas import Arena, Beginning, ModelArena, Scenes, TrueArena
from hma_model.policies.base import Policy
from hma_model.policies.catalog import read_policy
from hma_model.policies.fingerprints import device_facts, folder_facts, policy_facts, world_digests
from hma_model.policies.judge import StateJudge, task_of, train_judge
from hma_model.policies.planning import Planning
from hma_model.policies.rewards import RewardModel, labelled_shards, measured_judge, names_reward_model
from hma_model.policies.scores import Progress, choosing_meter, run
from hma_model.synthetic.recorder import (
    SyntheticEpisode,
    finished,
    holds_dataset,
    require_dataset,
    write_as_lerobot,
    write_shards,
)
from hma_model.worlds.images import Prompt
from hma_model.worlds.prompts import SeenShards, default_frames, long_pieces, require_fit
from hma_model.worlds.scenes import at_rest
from hma_model.worlds.world import World, load_world

WORK = ".augment"
BATCH_EPISODES = 16  # episodes that step in one pass
UNCERTAINTY_FLAGS = {
    "discrete": "millinats",
    "continuous": "millilatents",
}  # flags: thousandths of `uncertainty`
MAX_DRAWS = 100  # of a beginning, until one is found whose actions are all known


@dataclass(frozen=True)
class Augmentation:
    """The settings of synthetic episodes; all of them are in the plan of the shards.

    Attributes:
        embodiment: its id.
        source: name of the shard set of the first frames; empty for the laboratory's simulator.
        episodes: N that are made.
        frames: T.
        commands: `replay`, `perturb=SHARE`, or a policy as `read_policy` takes it.
        keep: share of the episodes that is kept, the surest ones.
        max_error: px; episodes whose state error is expected to end above it are left out. None leaves none.
        judge: the task, as `task_of` takes it, or the reward model whose successes are kept; empty for none.
        seed: of everything.
        unmask_steps, temperature, precision: as of `World`.
    """

    embodiment: str
    source: str = ""
    episodes: int = 64
    frames: int = 40
    commands: str = "replay"
    keep: float = 0.5
    max_error: float | None = None
    judge: str = ""
    seed: int = 0
    unmask_steps: int = 2
    temperature: float | None = None
    precision: str = "float32"

    def __post_init__(self) -> None:
        if not 0 < self.keep <= 1:
            raise UsageError("--keep", f"is {self.keep:g}", "give a share above 0, at most 1")
        if self.judge and not self.rewarded:
            task_of(self.embodiment, self.judge)

    @property
    def rewarded(self) -> bool:
        """Check whether a reward model judges the episodes."""
        return bool(self.judge) and names_reward_model(self.judge)

    @property
    def recorded(self) -> bool:
        """Check whether the actions are recorded ones, also with noise, rather than a policy's."""
        return self.commands.partition("=")[0] in ("replay", "perturb")

    @property
    def looked_at(self) -> bool:
        """Check whether a probe that was trained on the simulator's images looks at those of the model."""
        stateful = self.commands.startswith(("scripted", "reach", "lerobot:")) and simulated(self.embodiment)
        return bool(self.judge and not self.rewarded) or stateful


@dataclass(frozen=True)
class SyntheticBatch:
    """Episodes of one pass: stored frames (n, P + T, …), chunks (n, P + T - 1, K), and what to choose by.

    Of a policy's episodes P is one: the actions before it are none of its own.

    Attributes:
        uncertainty: (n,) how unsure the model was since the true frames, as a `Meter` takes it. NaN if it is
            not measured.
        success: (n,) as judged; all True without a judge.
        groups: (n,) ids of the real episodes that they begin with.
    """

    stored: NDArray[Any]
    chunks: Float32s
    uncertainty: Floats
    success: Bools
    groups: NDArray[np.str_]


class ReplayPolicy:
    """The recorded actions, to which noise is added.

    Args:
        share: of the actions' standard deviation; the noise is held for a chunk.
    """

    def __init__(self, share: float, std: Sequence[float]) -> None:
        self._std = share * np.asarray(std)

    def begin(self, arena: Arena) -> None:
        self._rng = arena.scenes.rng(4)
        self._low, self._high = arena.scenes.robot.seen

    def act(self, arena: Arena) -> Float32s:
        if arena.fresh:
            self._noise = np.stack([rng.normal(0, self._std) for rng in self._rng])
        actions = arena.recorded()
        if not self._std.any():
            return actions
        return np.clip(actions + self._noise, self._low, self._high).astype(np.float32)


def augment(
    out: StrPath,
    settings: Augmentation,
    *,
    checkpoint: StrPath = "embedded",
    shards: StrPath | None = None,
    lerobot: StrPath | None = None,
    world: World | None = None,
    on_progress: Progress = lambda done, words: None,
    **given: Any,
) -> Manifest:
    """Make synthetic episodes, and write those that are kept as a shard set.

    Args:
        out: its folder.
        settings: what to make.
        checkpoint: as `load_world` takes it.
        shards: shard set whose episodes give first frames and actions; by default the simulator does.
        lerobot: folder for the same episodes as a LeRobotDataset v3.0; one that is finished is kept. Its
            state is read off the images, if the shards or the simulator have one to learn it from.
        world: a world instead of a checkpoint.
        on_progress: called with the frames made, of `episodes` × `frames`, and what is done.
        given: of the world made from the checkpoint, as of `load_world`: device, compile.

    Raises:
        UsageError: `max_error` is given, and there is no calibrated uncertainty that is of use.
        HMAError: the robot, the shards or the policy do not fit, the folder holds something else, the judge
            is no better than chance, or no episode is left.
    """
    folder = as_path(out)
    dataset = None if lerobot is None else as_path(lerobot)
    if dataset is not None:
        require_dataset(dataset)
    world = world or load_world(
        checkpoint, [settings.embodiment], unmask_steps=settings.unmask_steps,
        temperature=settings.temperature, precision=settings.precision, **given,
    )  # fmt: skip
    meter = None if settings.max_error is None else choosing_meter(world, settings.embodiment)
    if settings.keep < 1 and meter is None:
        _warn_of_choice(world, settings)
    made_by = {"by": "hma augment", "synthetic": True, **asdict(settings)}
    made_by |= {"precision": world.precision} | world_digests(world, settings.embodiment)
    begins = None if shards is None else ShardSet(shards)
    if begins is not None:
        made_by["source_sha256"] = short_sha256(begins.manifest.to_text(), 64)
    with locked(folder):
        done = dataset is None or holds_dataset(dataset, made_by)  # before anything is made
        found = finished(folder, made_by)
        if found is None:
            maker = _Maker(world, settings, begins)
            facts = made_by | device_facts(world.model)
            facts["policy_files"] = policy_facts(settings.commands, settings.embodiment)  # may be edited
            if settings.rewarded:
                facts["judge_files"] = folder_facts(Path(str(settings.judge)))
            kept = KeptParts(folder / WORK, facts)
            batches = maker.run(kept, on_progress)
            spec = world.tokenizer.spec
            chosen = _chosen(batches, settings, UNCERTAINTY_FLAGS[spec.kind], meter)
            # What begins with held-out frames is held out: merged with the recordings, it would leak them.
            rows = [] if begins is None else begins.episodes.to_pylist()
            splits = {row["group"] or row["id"]: row["split"] for row in rows}
            found = write_shards(
                folder, chosen, spec, maker.robot, made_by, cameras=maker.cameras, splits=splits
            )
        remove_kept(folder / WORK)  # a job may have been killed here
        if dataset is not None and not done:
            made = settings.episodes * settings.frames
            total = sum(split["frames"] for split in found.splits.values()) * found.frame_stride

            def tell(at: int, words: str) -> None:
                on_progress(made, f"LeRobot: {at:,} of {total:,} frames, {words}")

            stated = _stated(world, settings, begins, found.cameras, partial(on_progress, made))
            write_as_lerobot(dataset, folder, world.tokenizer, stated, tell)
    return found


def _warn_of_choice(world: World, settings: Augmentation) -> None:
    """Warn if nobody knows that the surest episodes are better than others."""
    meter, reason = world.meter(settings.embodiment)
    if meter is not None and not meter.chooses:
        reason = "uncertainty may choose no better than chance on this robot"
    if reason and world.model.config.video_loss != "regression":  # of which the command says more
        warnings.warn(f"--keep {settings.keep:g}: {reason}", UserWarning, stacklevel=3)


def _stated(
    world: World,
    settings: Augmentation,
    shards: ShardSet | None,
    cameras: Sequence[str],
    tell: Tell,
) -> tuple[Embodiment, Reader] | None:
    """Return the real robot, and what reads its state off images; None if no state is known."""
    if shards is None:
        robot = embodiment(settings.embodiment)
        if robot.state is None:
            return None
        return robot, simulated_reader(robot.id, world.tokenizer, robot.stride, settings.seed, tell)
    if shards.embodiment.state is None or shards.manifest.splits["train"]["episodes"] < EPISODES_NEEDED:
        return None
    reader = recorded_reader(world.tokenizer, shards, tuple(cameras), settings.seed, tell)
    return None if reader is None else (shards.embodiment, reader)


class _Maker:
    def __init__(self, world: World, settings: Augmentation, shards: ShardSet | None) -> None:
        self.world = world
        self.settings = settings
        self.shards = shards
        name = settings.embodiment
        self.prompt_frames = default_frames(world.model)
        simulator = shards is None or settings.looked_at
        self.scenes = Scenes.of(world, name, settings.episodes, settings.seed, simulator=simulator)
        self.robot: Embodiment = self.scenes.robot.embodiment
        self.policy = self._policy(settings.commands)
        self.judge: StateJudge | RewardModel | None = None
        self.probe: Probe | None = None
        self.cameras = [self.robot.primary_camera.name]
        if shards is not None:
            require_fit(world.model, name, shards)
            self._long = self._long_enough(shards)
            self._seen = SeenShards(shards, cameras_for(world.model, shards))
            self.cameras = self._seen.cameras

    def _policy(self, commands: str) -> Policy:
        kind, _, number = commands.partition("=")
        if not self.settings.recorded:
            if self.shards is not None and commands.startswith("scripted") and not steerable(self.robot.id):
                fault = f"{commands!r} needs a policy that acts from images, and {self.robot.id} has none"
                raise UsageError("--commands", fault, "give replay, perturb=0.3, random or a policy of yours")
            policy = read_policy(commands, self.scenes, self.world)
            if isinstance(policy, Planning) and (not self.settings.judge or self.settings.rewarded):
                fault = f"{commands!r} plans for what a judge calls success"
                raise UsageError("--commands", fault, "add --judge moved, or another task")
            return policy
        share = 0.0 if commands == "replay" else np.nan
        if kind == "perturb":
            with suppress(ValueError):
                share = float(number)
        if not 0 <= share < np.inf:
            raise UsageError("--commands", f"{commands!r} is unknown", "give replay, or perturb=0.3")
        return ReplayPolicy(share, self.world.model.embodiments[self.robot.id].std)

    def _long_enough(self, shards: ShardSet) -> list[tuple[dict[str, Any], range]]:
        """Return the pieces of episodes that are long enough, as of `long_pieces`."""
        if shards.embodiment.id != self.settings.embodiment:
            fault = f"is of {shards.embodiment.id}, not of {self.settings.embodiment}"
            raise UsageError(shards.folder, fault, "name shards of the robot")
        found = long_pieces(shards, self.prompt_frames + self.settings.frames)
        if not found:
            fault = f"has no episode of {self.prompt_frames} + {self.settings.frames} frames without a pause"
            raise UsageError(shards.folder, fault, "give fewer --frames")
        return found

    def run(self, kept: KeptParts, on_progress: Progress) -> list[SyntheticBatch]:
        """Return all batches; those that are kept are not made again."""
        count = self.settings.episodes
        frames = self.settings.frames
        batches = []
        for begin in range(0, count, BATCH_EPISODES):
            numbers = range(begin, min(begin + BATCH_EPISODES, count))

            def make(numbers: range = numbers) -> dict[str, NDArray[Any]]:
                self._train(on_progress)
                before = numbers.start * frames
                on_progress(before, "")  # the clock of the time left starts here
                return vars(self._make(numbers, lambda done: on_progress(before + done, "")))

            batches.append(SyntheticBatch(**kept.part(f"batch-{begin:06d}", make)))
            on_progress(numbers.stop * frames, "")
        return batches

    def _train(self, on_progress: Progress) -> None:
        """Train the judge, or the probe alone, if they are asked for; measure a reward model."""
        settings = self.settings
        if settings.rewarded and self.judge is None:
            shards = self.shards or labelled_shards(self.world, settings.embodiment, None, settings.judge)
            tell = partial(on_progress, 0)
            found = measured_judge(settings.judge, self.world, settings.embodiment, shards, tell)
            warnings.warn(f"{found.source}: {found.sentence}", UserWarning, stacklevel=2)
            self.judge = found.model
        if self.probe is not None or not settings.looked_at:
            return
        name, seed, tell = settings.embodiment, settings.seed, partial(on_progress, 0)
        seen = name, self.world.tokenizer, self.scenes.stride
        self.probe = train_probe(*seen, seed, tell)
        if settings.judge and not settings.rewarded:
            task = task_of(name, settings.judge)
            judge = self.judge = train_judge(
                *seen, settings.frames + 1, task, seed=seed, probe=self.probe, tell=tell
            )  # fmt: skip
            if isinstance(self.policy, Planning):
                self.policy.cost.judge = judge

    def _make(self, numbers: range, tell: Callable[[float], None]) -> SyntheticBatch:
        begun = self._simulated(numbers) if self.shards is None else self._recorded(self.shards, numbers)
        arena = ModelArena(self.world, begun, self.probe)
        kept = []

        def look(done: float) -> None:
            kept.append(arena.stored())
            tell(done)

        commands, frames = self.settings.commands, self.settings.frames
        with closing(arena), self.world.drawing(measure=True):
            images, actions = run(commands, self.policy, arena, frames, look)
        success: Bools = np.ones(len(numbers), np.bool_)
        if self.judge is not None:
            success = self.judge.success(self.judge.score(np.stack(images, axis=1)))
        generated = np.stack(kept, axis=1)
        prompts = [self.world.encoded(self.robot.id, prompt.frames) for prompt in begun.prompts]
        first = np.stack(prompts).astype(generated.dtype)
        before = np.stack([prompt.chunks for prompt in begun.prompts])
        own = np.stack(actions, axis=1).reshape(len(numbers), -1, self.robot.chunk_dim)
        if not self.settings.recorded:  # the actions of the prompt are none of the policy's
            first = first[:, -1:]
            before = before[:, :0]
        return SyntheticBatch(
            np.concatenate([first, generated], axis=1),
            np.concatenate([before, own], axis=1),
            accumulated(np.stack(arena.unsure, axis=1))[:, -1],
            success,
            np.array(begun.groups),
        )

    def _simulated(self, numbers: range) -> Beginning:
        """Return beginnings from the simulator, with the actions of its driver."""
        scenes = self.scenes.take(numbers)
        true = TrueArena(scenes, self.world.image_shape[0], drawn=False)
        for _ in range(self.settings.frames * scenes.stride):
            true.step(true.recorded())
        groups = [f"{scenes.name}/{number}" for number in scenes.numbers]
        return Beginning(scenes, true.prompts, true.held, true.told, groups)

    def _recorded(self, shards: ShardSet, numbers: range) -> Beginning:
        """Return beginnings from episodes of shards, with their actions."""
        scenes = self.scenes.take(numbers)
        known = self.prompt_frames
        rows, windows = zip(*(self._window(shards, number) for number in numbers), strict=True)
        prompts = [Prompt(frames[:known], chunks[: known - 1]) for frames, chunks in windows]
        dims = len(scenes.dimensions)
        told = [np.nan_to_num(chunks[known - 1 :]).reshape(-1, dims) for _, chunks in windows]
        groups = [str(row["group"] or row["id"]) for row in rows]
        steps = list(np.stack(told, axis=1).astype(np.float32))
        return Beginning(scenes, prompts, at_rest(scenes.dimensions, steps[0]), steps, groups)

    def _window(self, shards: ShardSet, number: int) -> tuple[dict[str, Any], Prompt]:
        """Return a row of an episode, and a window of it: frames (P + T, …) and chunks (P + T - 1, K).

        The actions are known: those of the window, or for a policy's episodes those up to its first one.

        Raises:
            UsageError: there is hardly such a window.
        """
        rng = np.random.default_rng((self.settings.seed, 5, number))
        length = self.prompt_frames + self.settings.frames
        every, span = shards.manifest.frame_stride, (length - 1) * self.robot.stride
        needed = None if self.settings.recorded else self.prompt_frames
        for draw in range(MAX_DRAWS):
            row, part = self._long[(number + draw) % len(self._long)]
            start = part.start + int(rng.integers(len(part) * every - span)) // every
            at = start + shards.row_stride * np.arange(length)
            window = self._seen.window(row, at)
            if np.isfinite(window.chunks[:needed]).all():
                return row, window
        fault = f"has too few windows of {length} frames whose actions are all known"
        raise UsageError(shards.folder, fault, "give fewer --frames, or shards with more of the actions")


# -- what is kept


def _chosen(
    batches: Sequence[SyntheticBatch], settings: Augmentation, measure: str, meter: Meter | None
) -> list[SyntheticEpisode]:
    """Return the episodes of which the model was least unsure, without those that are judged failures.

    `measure` is the name of the flag that says how unsure it was. Where that is not measured, no episode is
    surer than another: all are kept, without the flag.
    """
    unsure = np.concatenate([batch.uncertainty for batch in batches])
    success = np.concatenate([batch.success for batch in batches])
    measured = bool(np.isfinite(unsure).all())
    chosen = np.full(len(unsure), not measured)
    chosen[np.argsort(unsure, kind="stable")[: max(1, round(settings.keep * len(unsure)))]] = True
    if meter is not None and settings.max_error is not None:
        chosen &= meter.expects_at_most(unsure, settings.max_error)
        if not chosen.any():
            least = meter.expected(unsure.min())
            why = f"the smallest expected error at the end is {least:.1f} px"
            if unsure.min() > meter.reach:
                why = "all end more uncertain than the rollouts that were calibrated"
            raise HMAError("--max-error", f"leaves no episode: {why}", "give more px, or fewer --frames")
    if not (chosen & success).any():
        fault = f"none of the {chosen.sum()} least uncertain of {len(unsure)} episodes is judged a success"
        raise HMAError("augment", fault, "make more episodes, keep more, or leave out the judge")
    chosen &= success
    made = chain.from_iterable(zip(one.stored, one.chunks, one.groups, strict=True) for one in batches)
    found = []
    for number, (stored, chunks, group) in enumerate(made):
        if not chosen[number]:
            continue
        counts = {
            "prompt_frames": len(stored) - settings.frames,
            "generated_frames": settings.frames - 1,  # the last one has no actions after it
        }
        if measured:
            counts[measure] = round(1000 * float(unsure[number]))
        name = f"synthetic_{number:06d}"
        found.append(SyntheticEpisode(name, stored, chunks, counts, str(group), bool(settings.judge) or None))
    return found
