"""Run the benchmark on a checkpoint; a stopped one continues with the part that was not finished.

    found = benchmark("runs/first", "card", FULL)
    found["robots"]["mover_04"]["decision"]

The protocol has a name and a version. A change of what is measured makes another version, so results of one
version may be compared.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np

from hma_data.arrays import Bools
from hma_data.errors import HMAError, OutputError, UsageError
from hma_data.lab import FAMILY
from hma_data.storage.files import remove_dead_parts, write_atomic
from hma_data.storage.kept import KeptParts, remove_kept
from hma_data.storage.locks import locked
from hma_data.storage.paths import StrPath, as_path
from hma_model.benchmark.measures import (
    Arrays,
    choice_figures,
    choose,
    frame_errors,
    no_inverse,
    speed,
    turn_back,
)
from hma_model.benchmark.planning import WAYS, planning_figures, reached
from hma_model.benchmark.report import NAME, RESULTS, digest, read_results
from hma_model.checkpoint.io import record_locally
from hma_model.evaluation.calibration import calibration
from hma_model.evaluation.intervals import NATURAL, rounded, summary
from hma_model.evaluation.metrics import PSNR_RANGE
from hma_model.evaluation.probe import Probe, train_probe
from hma_model.policies.arenas import Scenes
from hma_model.policies.fingerprints import device_facts, world_digests, world_facts
from hma_model.policies.judge import task_of, train_judge
from hma_model.policies.scores import evaluate_policies
from hma_model.policies.scripted import Scripted
from hma_model.worlds.world import World, load_world

VERSION = 2
WORK = ".benchmark"
NOISE = 0.5  # share of random chunks in the action sequences of a choice
PARTS = 5  # of a robot
Progress = Callable[[int, str, int], None]


@dataclass(frozen=True)
class Protocol:
    """What is measured.

    Attributes:
        mode: its name.
        robots: laboratory robots; those that the checkpoint lacks are left out.
        scenes, frames: of decision fidelity and of inverse-action stability, a robot.
        noises: shares of random actions of the scripted policies, to which random and still are added.
        episodes, policy_frames: of each policy.
    """

    mode: str
    robots: tuple[str, ...]
    scenes: int
    frames: int
    noises: tuple[float, ...]
    episodes: int
    policy_frames: int


FULL = Protocol(
    "full", ("mover_04", "pusht_fast", "rails_03", "planar_arm"), 64, 20, (0.0, 0.2, 0.4, 0.6, 0.8), 100, 20
)
QUICK = Protocol("quick", ("mover_04",), 16, 12, (0.0, 0.4, 0.8), 16, 12)


def benchmark(
    checkpoint: StrPath,
    out: StrPath,
    protocol: Protocol = FULL,
    *,
    seed: int = 0,
    world: World | None = None,
    on_progress: Progress = lambda done, words, total: None,
    **settings: Any,
) -> dict[str, Any]:
    """Measure a checkpoint, write benchmark.json to a folder, and return what it holds.

    Args:
        checkpoint: as `load_world` takes it.
        out: folder; it keeps finished parts, and the same call continues. Finished results are read.
        protocol: FULL or QUICK.
        seed: of scenes, goals, policies and probes; 0 is the protocol's own.
        world: a world instead of a checkpoint.
        on_progress: called with the parts done, what is done, and the number of parts.
        settings: of the world made from the checkpoint, as of `load_world`.

    Raises:
        UsageError: the checkpoint has none of the robots.
        OutputError: the folder was begun with other settings, or its results are damaged.
    """
    folder = as_path(out)
    with locked(folder):
        remove_dead_parts(folder)
        world = world or load_world(checkpoint, **settings)
        robots = [robot for robot in protocol.robots if robot in world.model.embodiments]
        if not robots:
            fault = f"has none of the benchmark's robots: {', '.join(protocol.robots)}"
            raise UsageError(
                str(checkpoint), fault, "use hma evaluate and hma policy-eval for its own robots"
            )
        facts = {"benchmark": NAME, "version": VERSION, "seed": seed} | asdict(protocol) | {"robots": robots}
        facts |= {"unmask_steps": world.decoding.unmask_steps, "temperature": world.decoding.temperature}
        facts |= world_facts(world) | device_facts(world.model)
        facts |= {"digests": {robot: world_digests(world, robot) for robot in robots}}
        facts = json.loads(json.dumps(facts))
        if (folder / RESULTS).exists():
            found = read_results(folder / RESULTS)
            if any(found.get(key) != value for key, value in facts.items()):
                raise OutputError(folder, "holds the results of other settings", "give another folder")
        else:
            kept = KeptParts(folder / WORK, facts)
            tables = "measures", "by_scene", "by_frame", "by_choice"
            made: dict[str, dict[str, Any]] = {name: {} for name in tables}
            for number, robot in enumerate(robots):

                def on_part(done: int, words: str, begun: int = PARTS * number, robot: str = robot) -> None:
                    on_progress(begun + done, f"{robot}, {words}", PARTS * len(robots))

                one = _Robot(world, robot, protocol, seed, kept, on_part)
                for name, figures in zip(tables, one.measured(), strict=True):
                    made[name][robot] = figures
            found = facts | {"checkpoint": str(checkpoint)} | made
            write_atomic(folder / RESULTS, json.dumps(found | {"sha256": digest(found)}, indent=1))
        remove_kept(folder / WORK)  # of a job killed here, too
        for robot, measured in found["measures"].items():
            if meter := measured["calibration"].get("meter"):  # for other commands
                record_locally(checkpoint, world.model.source, robot, meter, "meter")
    return found


@dataclass
class _Robot:
    """The benchmark of one robot; its probe is trained when a part needs it, and comes out the same again."""

    world: World
    robot: str
    protocol: Protocol
    seed: int
    kept: KeptParts
    on_part: Callable[[int, str], None]
    done: int = 0  # parts

    def tell(self, words: str) -> None:
        self.on_part(self.done, words)

    @cached_property
    def scenes(self) -> Scenes:
        return Scenes.of(self.world, self.robot, self.protocol.scenes, self.seed)

    @cached_property
    def probe(self) -> Probe:
        return train_probe(self.robot, self.world.tokenizer, self.scenes.stride, self.seed, self.tell)

    def measured(self) -> tuple[dict[str, Any], ...]:
        """Return the figures, and those by scene, by frame of the action sequences and by choice."""
        frames = self.protocol.frames
        arrays = self._part(
            "choices",
            lambda: choose(self.world, self.scenes, self.probe, Scripted(NOISE), frames, tell=self.tell),
        )
        found, by_scene, by_choice = choice_figures(arrays, self.seed)
        by_frame = frame_errors(arrays)
        way = self.world.decoding
        found["calibration"] = calibration(
            by_frame["uncertainty"], by_frame["error_px"], by_frame["pixel_rmse"],
            unmask_steps=way.unmask_steps, temperature=way.temperature, seed=self.seed,
        )  # fmt: skip
        self.tell("actions and their inverses")
        if missing := no_inverse(self.scenes.dimensions):
            found["inverse"] = {"missing": missing}
        else:
            turned = self._part("inverse", lambda: turn_back(self.world, self.scenes, self.probe, frames))
            found["inverse"] = {}
            for name, values in turned.items():
                within = PSNR_RANGE if name.endswith("psnr") else NATURAL
                found["inverse"] |= summary(name, values, self.seed, within=within)
                by_scene[f"inverse.{name}"] = rounded(values)
        if len(self.probe.own):
            goals = self._part("planning", self._planned)
            found["planning"] = planning_figures(goals)
            by_scene |= {f"planning.{way}": rounded(goals[way].astype(float)) for way in WAYS}
        else:
            found["planning"] = {"missing": "no part of the robot is read, so no goal can be reached"}
        text = self._part("policies", lambda: {"json": np.array(self._policies())})["json"]
        found["policies"] = json.loads(str(text))
        self.tell("speed")
        timed = self._part("speed", lambda: speed(self.world, self.scenes))
        found |= {name: rounded(value, 2) for name, value in timed.items()}
        raw = ({name: rounded(values) for name, values in one.items()} for one in (by_frame, by_choice))
        return found, by_scene, *raw

    def _part(self, name: str, make: Callable[[], Arrays]) -> Arrays:
        made = self.kept.part(f"{name}-{self.robot}", make)
        self.done += 1
        return made

    def _planned(self) -> dict[str, Bools]:
        """Return which goals are reached in each of WAYS."""
        found = {}
        for way in WAYS:
            self.tell(f"planning, {way}")
            found[way] = reached(self.world, self.scenes, self.probe, way)
        return found

    def _policies(self) -> str:
        """Return what `hma policy-eval` finds, as JSON; or why there is no judge."""
        family = FAMILY.fullmatch(self.robot) is not None
        kind = "reach" if family else "scripted"
        task = task_of(
            self.robot, "reached" if family else "placed" if self.robot == "pusht_fast" else "moved"
        )
        names = [f"{kind}:noise={noise:g}" if noise else kind for noise in self.protocol.noises]
        frames = self.protocol.policy_frames
        try:
            judge = train_judge(
                self.robot, self.world.tokenizer, self.scenes.stride, frames + 1, task,
                seed=self.seed, probe=self.probe, tell=self.tell,
            )  # fmt: skip
        except HMAError as fault:
            return json.dumps({"missing": str(fault)})
        found = evaluate_policies(
            self.robot, [*names, "random", "still"], episodes=self.protocol.episodes, frames=frames,
            judge=judge, seed=self.seed, world=self.world, out=self.kept.folder / f"policies-{self.robot}",
            on_progress=lambda done, words: self.tell(f"policies, {words}"),
        )  # fmt: skip
        return json.dumps(found.to_json())
