"""Train a small model on laboratory data and compare its quality with recorded bands (`hma bench quality`).

Speed has benchmarks of its own; this one judges a change of the model. Each case trains for a fixed number of
steps on one thread, so that the same code on the same machine gives the same figures:

    loss        nats a token (continuous: the diffusion loss) on held-out windows
    psnr_db     of rollouts, mean over the horizon
    gain_db     PSNR of the last frame with recorded minus shuffled actions: above 0 the model follows
    error_px    distance of the robot's parts at the last frame from where the simulator has them

The case `holds` trains nothing: it drives the bundled model and measures what is left of the robot and of
objects after 20 frames (`hma bench holds`), so that a bundled model that melts them is seen.

The bands (quality.json) are recorded with several seeds by `record=true`. A figure is inside its band if one
more run of unchanged code would be there in 95 % of cases (Student's t, from the spread over the seeds); with
`seeds=3` the mean of three runs is compared, and the bands are narrower. The data are recorded into the cache
with fixed seeds; `data` names a shard set of the same robot and tokenizer instead.
"""

import hashlib
import json
import math
import statistics
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from hma_data import lab
from hma_data.errors import OutputError, UsageError
from hma_data.lab import family
from hma_data.shards.manifest import MANIFEST
from hma_data.shards.reader import ShardSet
from hma_data.storage.files import cache_folder, read_json, to_json, write_atomic
from recipes.bench.harness import Bench

BANDS = Path(__file__).with_suffix(".json")
EPISODES, SEED, VAL_FRACTION = 60, 0, 0.1  # of the recording
MOST_SEEDS = 10
FRAMES, PROMPT, WINDOWS, DRAWS = 8, 2, 24, 3  # of the rollouts
FIGURES = {  # name -> the sign of what is better
    "loss": -1, "psnr_db": 1, "gain_db": 1, "error_px": -1, "limbs": 1, "left": 1, "shape": 1, "off": -1,
}  # fmt: skip
HOLDS = "holds"  # the case of the bundled model
HOLDS_ROBOT, HOLDS_FRAMES, HOLDS_ROLLOUTS = "pusht_fast", 20, 12
PLAIN = ["eval_every=0", "checkpoint_every=0", "pictures=0", "report=false", "device=cpu", "frames=8"]


@dataclass(frozen=True)
class Case:
    """What is trained.

    Attributes:
        robot: of the made-up family.
        steps: of the training.
        overrides: of the recipe.
    """

    robot: str
    tokenizer: str
    recipe: str
    steps: int
    overrides: tuple[str, ...] = ()


CASES = {
    "discrete": Case("rails_03", "fsq-lab", "discrete_tiny", 400),
    "continuous": Case("rails_03", "vae-8", "continuous_tiny", 400),
    "finetuned": Case("arm3_55", "fsq-lab", "demo", 300, ("start=embedded",)),
}


def run(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a row for each case and figure; with `record`, write the bands.

    Raises:
        UsageError: there is no such case, or its bands are missing or of another budget.
    """
    names = [name.strip() for name in settings["cases"].split(",")]
    for name in names:
        if name not in (*CASES, HOLDS):
            raise UsageError("bench quality", f"{name!r} is no case", f"cases: {', '.join((*CASES, HOLDS))}")
    if not 1 <= settings["seeds"] <= MOST_SEEDS:
        raise UsageError("bench quality", f"seeds={settings['seeds']} is not allowed", "give 1 to 10")
    path = Path(settings["bands"] or BANDS)
    kept = read_json(path, OutputError) if path.is_file() else {}
    if settings["record"]:
        if settings["seeds"] < 2:
            raise UsageError("bench quality", "bands need the spread over seeds", "add seeds=3")
    else:
        for name in names:
            _check(name, kept, settings, path)
    rows: list[dict[str, Any]] = []
    for name in names:
        budget = _budget(name, settings)
        if name == HOLDS:
            data, work = bundled_digest(), measure_holds
        else:
            folder = Path(settings["data"]) if settings["data"] else _cached(CASES[name])
            data, work = digest_of(folder), partial(measure, name, folder, budget)
        facts = {"budget": budget, "data": data, "torch": torch_version()}
        if settings["record"]:
            found = _record(name, work, facts, settings["seeds"], kept, path)
        else:
            found = [work(seed) for seed in range(settings["seeds"])]
        rows += judged(name, kept[name], found, facts)
    return rows


def fault(rows: Sequence[dict[str, Any]]) -> str:
    """Return which figures are outside their bands; empty if none is."""
    outside = [f"{row['case']}: {row['figure']}, {row['verdict']}" for row in rows if not row["inside"]]
    return f"outside the bands: {'; '.join(outside)}" if outside else ""


def _budget(name: str, settings: dict[str, Any]) -> dict[str, Any]:
    if name == HOLDS:
        return {"frames": HOLDS_FRAMES, "rollouts": HOLDS_ROLLOUTS}
    return {
        "steps": settings["steps"] or CASES[name].steps,
        "windows": settings["windows"],
        "episodes": settings["episodes"],
    }


def _check(name: str, kept: dict[str, Any], settings: dict[str, Any], path: Path) -> None:
    remedy = "record them: record=true seeds=3 bands=FILE"
    if len(kept.get(name, {}).get("seeds", [])) < 2:
        raise UsageError(path, f"has no bands of {name!r}", remedy)
    budget = _budget(name, settings)
    theirs = kept[name]["budget"]
    other = [f"{key}={theirs[key]}" for key in budget if theirs[key] != budget[key]]
    if other:
        raise UsageError("bench quality", f"the bands of {name!r} are of {', '.join(other)}", remedy)


# -- data


def recorded(robot: str, tokenizer: str, folder: Path, episodes: int = EPISODES) -> Path:
    """Return a shard set of a robot of the family; it is recorded and converted where it is not there."""
    from hma_data.conversion.job import convert
    from hma_data.conversion.plan import Settings

    if not (folder / MANIFEST).is_file():
        _tell(f"{robot}: {episodes} episodes are recorded into {folder}")
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as place:
            recording = lab.record(robot, place, episodes, SEED)
            settings = Settings(val_fraction=VAL_FRACTION, frames="strided")
            convert(family.embodiment(robot), recording, tokenizer, folder, settings=settings)
    return folder


def _cached(case: Case) -> Path:
    folder = cache_folder() / "bench" / f"{case.robot}-{case.tokenizer}"
    return recorded(case.robot, case.tokenizer, folder)


def digest_of(data: Path) -> str:
    """Return sixteen hex digits that stand for the shards of a set."""
    shards = [shard.sha256 for shard in ShardSet(data).manifest.shards]
    return hashlib.sha256(json.dumps(shards).encode()).hexdigest()[:16]


# -- measurement


def measure(name: str, data: Path, budget: dict[str, Any], seed: int) -> dict[str, float]:
    """Train a case and return its figures by name.

    Raises:
        UsageError: the training was stopped by a signal.
    """
    from hma_data.tokenizers.base import reopened
    from hma_data.tokenizers.network import one_thread
    from hma_model.evaluation import evaluate as evaluation
    from hma_model.evaluation.evaluate import EvaluationSettings
    from hma_model.evaluation.simulated import measure_state
    from hma_model.network.model import HMA
    from hma_model.training.loop import train

    case, shards = CASES[name], ShardSet(data)
    robot = shards.embodiment.id
    tokenizer = reopened(shards.spec.to_json())
    with one_thread(), tempfile.TemporaryDirectory() as folder:
        _tell(f"{name}, seed {seed}: {budget['steps']} steps")
        result = train(recipe_of(case, data, budget["steps"], seed), out=Path(folder) / "run", show=False)
        if result.interrupted:
            raise UsageError("bench quality", "was stopped by a signal", "run it again")
        model = HMA.from_pretrained(result.checkpoint).eval()
        settings = EvaluationSettings(windows=budget["windows"], frames=FRAMES, prompt=PROMPT, draws=DRAWS)
        found = evaluation.measure(model, tokenizer, shards, settings).found
        figures = {
            "loss": found["loss"],
            "psnr_db": found["true"]["psnr"],
            "gain_db": found["psnr_action_gain_last"],
        }
        if budget["episodes"]:
            state = measure_state(
                model, tokenizer, robot, frames=FRAMES, prompt=PROMPT, episodes=budget["episodes"]
            )
            figures["error_px"] = state["true"]["error_px_last"]
    return {key: round(value, 4) for key, value in figures.items()}


def bundled_digest() -> str:
    """Return sixteen hex digits that stand for the trunk that the bundled robot has."""
    from hma_model.checkpoint.folder import Checkpoint

    return Checkpoint.open("embedded", [HOLDS_ROBOT]).trunk_sha256[:16]


def measure_holds(seed: int) -> dict[str, float]:
    """Return what the bundled model keeps of a pushed T, and of its pusher if that is large enough."""
    from recipes.bench import holds

    _tell(f"{HOLDS}, seed {seed}: {HOLDS_ROBOT}, {HOLDS_FRAMES} frames")
    own = {"robots": HOLDS_ROBOT, "frames": HOLDS_FRAMES, "rollouts": HOLDS_ROLLOUTS, "seed": seed}
    last = holds.run(holds.BENCH.defaults | own)[-1]
    return {key: last[key] for key in ("limbs", "left", "shape", "off") if last[key] is not None}


def recipe_of(case: Case, data: Path, steps: int, seed: int) -> Any:
    """Return the recipe of a training of a case."""
    from hma_model.training.recipe import load_recipe

    own = [f"data=[{json.dumps(str(data))}]", f"steps={steps}", f"seed={seed}"]
    return load_recipe(case.recipe, [*PLAIN, *case.overrides, *own])


# -- bands


def _record(
    name: str,
    work: Callable[[int], dict[str, float]],
    facts: dict[str, Any],
    seeds: int,
    kept: dict[str, Any],
    path: Path,
) -> list[dict[str, float]]:
    """Measure the seeds of a case and write its bands; a recording that was stopped continues."""
    before = kept.get(name, {})
    if len(before.get("seeds", [])) >= seeds or {key: before.get(key) for key in facts} != facts:
        before = {**facts, "seeds": []}
    kept[name] = before
    for seed in range(len(before["seeds"]), seeds):
        before["seeds"].append(work(seed))
        write_atomic(path, to_json(kept))
    return list(before["seeds"])


def torch_version() -> str:
    """Return the version of torch, whose sums may differ from one version to another."""
    import torch

    return str(torch.__version__).partition("+")[0]


def judged(
    name: str, kept: dict[str, Any], found: Sequence[dict[str, float]], facts: dict[str, Any]
) -> list[dict[str, Any]]:
    """Return the rows of a case: each figure's mean over the seeds, and whether it is inside its band.

    Args:
        kept: of the bands' file; `seeds` holds the figures of each seed.
        found: the figures of each seed, now.
        facts: the data's digest and the version of torch, now.
    """
    from scipy import stats

    rows, count = [], len(kept["seeds"])
    other = [key for key in ("data", "torch") if facts[key] != kept[key]]
    for figure in kept["seeds"][0]:
        recorded = [one[figure] for one in kept["seeds"]]
        mean, middle = statistics.mean(one[figure] for one in found), statistics.mean(recorded)
        spread = statistics.stdev(recorded) * math.sqrt(1 / len(found) + 1 / count)
        width = float(stats.t.ppf(0.975, count - 1)) * spread
        away = mean - middle
        inside = abs(away) <= width
        rows.append(
            {
                "case": name,
                "figure": figure,
                "value": round(mean, 4),
                "low": round(middle - width, 4),
                "high": round(middle + width, 4),
                "inside": inside,
                "verdict": "inside" if inside else "better" if away * FIGURES[figure] > 0 else "worse",
                "other than the bands'": ", ".join(other) or None,
            }
        )
    return rows


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


BENCH = Bench(
    "quality of small models after a fixed number of steps, compared with recorded ranges",
    {
        "cases": "discrete",  # of discrete, continuous, finetuned, holds
        "steps": 0,  # of the training; 0: the case's own
        "seeds": 1,
        "windows": WINDOWS,  # held out, that are rolled out
        "episodes": 16,  # simulated, for the robot's place; 0: not measured
        "data": "",  # a shard set
        "record": False,  # write the bands
        "bands": "",  # their file; by default the package's
    },
    run,
    fault,
    zeros=("episodes",),
)
