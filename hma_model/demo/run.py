"""Run the whole pipeline on two new robots (`hma demo`), with the same functions as every other verb.

The demo records two laboratory robots in two formats, converts the recordings to tokenized shards and mixes
them. It finetunes the embedded trunk, which has seen neither robot, on both. It publishes the finetuned model
to a folder hub, pulls it back one robot at a time, rolls it out on episodes that it has not seen, and writes
a report of one page. It downloads nothing. A second run in the same folder continues an interrupted one.
"""

import json
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from hma_data import lab
from hma_data.console import human_bytes, progress
from hma_data.conversion.engines import Attempt, Report, Retry, Work
from hma_data.conversion.engines.local import run as run_local
from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.cpu import usable_cores
from hma_data.errors import OutputError, ShardError
from hma_data.lab import truth
from hma_data.lab.family import HELD_OUT
from hma_data.loading.dataset import open_sets
from hma_data.loading.mixture import Mixture
from hma_data.registry.embodiment import find
from hma_data.shards.manifest import MANIFEST
from hma_data.shards.preview import tokenizer_of
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.shards.windows import WindowIndex
from hma_data.storage.files import write_atomic
from hma_data.storage.paths import StrPath, as_path
from hma_data.tokenizers.network import single_threads
from hma_model.checkpoint.folder import Checkpoint
from hma_model.demo.report import write_report
from hma_model.demo.results import HELD, TIMINGS, DemoRun
from hma_model.evaluation.evaluate import EvaluationSettings, measure
from hma_model.evaluation.rollout_video import RolloutVideo, lively_windows, rollout_video
from hma_model.evaluation.verdict import verdict
from hma_model.evaluation.wholeness import Left, continued, left_at, left_words
from hma_model.generation.decode import default_prompt
from hma_model.network.model import HMA

START, ROBOTS = "embedded-lab", HELD_OUT  # the trunk, and robots that it has not seen
RECIPE = "demo"
TAU = 3.0  # temperature of the mixture
FILMED = 3  # windows of a robot's film
RESULTS, SETTINGS = "results.json", "settings.json"
OURS = {"recordings", "shards", "run", "hub", "pulled", "report.html", TIMINGS, RESULTS, SETTINGS}
WINDOWS = 24  # held-out windows of each robot; the figures are means over them
HELD_ROLLOUTS, HELD_SEED = 8, 55  # of other episodes than the recorded ones, driven for HELD frames
LONGEST = 10  # frames of a window of the film


def demo(out: StrPath, *, episodes: int = 32, steps: int | None = None, seed: int = 0) -> Path:
    """Run the demo, with its results in `out`.

    Args:
        out: str or path of a folder.
        episodes: the number recorded for each robot.
        steps: steps of each training at most; None takes those of the recipes.
        seed: the seed of recording and training.

    Returns:
        The path of the report, `out`/report.html.

    Raises:
        OutputError: the folder holds something else.
        CheckpointError: the embedded trunk is missing or damaged.
    """
    out = as_path(out)
    if out.exists() and not out.is_dir():
        raise OutputError(out, "is not a folder", "choose another --out")
    if foreign := sorted({item.name for item in out.glob("*")} - OURS):
        raise OutputError(out, f"holds {', '.join(foreign[:3])}", "choose an empty or new --out")
    _require_same(out, {"episodes": episodes, "steps": steps, "seed": seed})
    made = DemoRun(out, Checkpoint.open(START))
    with made.stage(1, "record and convert"):
        record_and_convert(made, episodes, seed)
    with made.stage(2, "mix"):
        mix(made)
    with made.stage(3, "train"):
        train(made, steps, seed)
    with made.stage(4, "publish and pull"):
        publish(made)
    with made.stage(5, "roll out"):
        roll_out(made)
    names = {"true": "psnr_last", "shuffled": "psnr_last_shuffled", "copy": "psnr_last_copy"}
    figures: dict[str, dict[str, Any]] = {
        robot: {name: found[key]["psnr_last"] for key, name in names.items()}
        for robot, found in made.figures.items()
    }
    for robot, left in made.left.items():
        figures[robot]["left"] = {name: asdict(one) for name, one in left.items()}
    results = {"seconds": sum(made.seconds.values()), "embodiments": figures}
    write_atomic(out / RESULTS, json.dumps(results, indent=1))
    return write_report(made)


def _require_same(out: Path, settings: dict[str, Any]) -> None:
    """Keep the settings in the folder; raise OutputError if it was begun with others."""
    path = out / SETTINGS
    kept = json.loads(path.read_bytes()) if path.is_file() else settings
    if other := [f"--{name} {kept[name]}" for name, value in settings.items() if kept.get(name) != value]:
        raise OutputError(out, f"was begun with {', '.join(other)}", "give the same, or choose a new --out")
    out.mkdir(parents=True, exist_ok=True)
    write_atomic(path, json.dumps(settings))


def _worker(out: Path, tokenizer: str, episodes: int, seed: int, workers: int) -> Work:
    """Return the function that records and converts a robot; it reports (stage, episodes so far).

    It returns the robot, its recording, and whether more episodes than allowed are in quarantine.
    """

    def work(robot: str, report: Report, attempt: Attempt) -> tuple[str, Path, bool]:
        folder = out / "recordings"
        recording = next(iter(sorted(folder.glob(f"{robot}*"))), None)
        if recording is None:
            recording = lab.record(
                robot, folder, episodes, seed, lambda done, total: report(("recorded", done))
            )
        report(("recorded", episodes))
        summary = convert(
            find(robot), str(recording), tokenizer, out / "shards" / robot,
            settings=Settings(frames="strided"),
            on_progress=lambda state: report(("converted", state.episodes)),
        )  # fmt: skip
        return robot, recording, summary.too_many

    return work


def record_and_convert(made: DemoRun, episodes: int, seed: int) -> None:
    """Record episodes of each robot, and convert them to verified shard sets (stage 1).

    Each robot has its own process, which ends when this process ends.
    """
    finished = all((made.out / "shards" / robot / MANIFEST).is_file() for robot in ROBOTS)
    workers = 0 if finished or usable_cores() == 1 else len(ROBOTS)
    counts: dict[tuple[int, str], int] = {}
    with progress("record and convert", 2 * len(ROBOTS) * episodes, "episodes") as update:

        def show(number: int, event: Any) -> None:
            if not isinstance(event, Retry):
                counts[number, event[0]] = event[1]
                update(sum(counts.values()))

        tokenizer = str(made.start.config.tokenizer["name"])
        work = partial(_worker, made.out, tokenizer, episodes, seed)
        results = list(run_local(ROBOTS, work, workers, show))
    for robot, recording, refused in sorted(results):
        folder = made.out / "shards" / robot
        problems = verify(folder)
        if problems or refused:
            raise ShardError(folder, "; ".join(problems) or "too many episodes are in quarantine")
        made.recordings[robot], made.sets[robot] = recording, ShardSet(folder)
        manifest = made.sets[robot].manifest
        size = manifest.to_json()["totals"]["bytes"]
        made.sizes.update({f"recording {robot}": _size(recording), f"shards {robot}": size})
        splits = ", ".join(f"{name} {split['episodes']}" for name, split in manifest.splits.items())
        print(f"  {robot}: {splits} episodes, {human_bytes(size)}, verified", flush=True)


def mix(made: DemoRun) -> None:
    """Compute how often each robot is drawn (stage 2)."""
    frames = made.start.config.frames
    sets = open_sets(list(made.sets.values()))
    counts = {name: WindowIndex.of(shards, "train", frames).count for name, shards in sets.items()}
    made.mixture = Mixture.of(counts, TAU)
    for (name, count), p in zip(counts.items(), made.mixture.p, strict=True):
        print(f"  {name}: {count:,} windows, drawn with p = {p:.3f}", flush=True)


def train(made: DemoRun, steps: int | None, seed: int) -> None:
    """Finetune the trunk on both robots (stage 3)."""
    from hma_model.training.loop import finetune
    from hma_model.training.recipe import load_recipe

    data = [str(shards.folder.absolute()) for shards in made.sets.values()]
    most = load_recipe(RECIPE).steps
    own = [f"seed={seed}", f"mixture.temperature={TAU}", f"steps={min(most, steps or most)}"]
    result = finetune(START, data, out=made.out / "run", recipe=RECIPE, overrides=own)
    if result.interrupted:
        raise KeyboardInterrupt  # the run has saved a checkpoint
    made.result = result
    print(f"  {result.step:,} steps in {result.seconds:.0f} s", flush=True)


def publish(made: DemoRun) -> None:
    """Push the checkpoint to a folder hub, and pull each robot back alone (stage 4)."""
    from hma_model.hub import publish as hub

    published = made.out / "hub" / "demo" / "lab"
    hub.push(made.run.checkpoint, str(published))
    for robot in ROBOTS:
        made.pulled[robot] = hub.pull(str(published), [robot], made.out / "pulled" / robot)
        made.sizes[f"checkpoint for {robot} alone"] = _size(made.pulled[robot])
    made.sizes["checkpoint of both"] = _size(published)


def roll_out(made: DemoRun) -> None:
    """Compute each robot's figures and film with the model pulled for it alone (stage 5).

    The robots run in parallel, each in one thread, because a second thread speeds up small products little.
    """

    def roll(robot: str) -> tuple[dict[str, Any], RolloutVideo, dict[str, Left]]:
        shards = made.sets[robot]
        model = HMA.from_pretrained(str(made.pulled[robot]), embodiments=[robot]).eval()
        tokenizer = tokenizer_of(shards)
        found = measure(model, tokenizer, shards, EvaluationSettings(windows=WINDOWS, batch_size=8)).found
        lengths = [row["length"] for row in shards.episodes.to_pylist() if row["split"] == "val"]
        prompt = max(2, default_prompt(model.config.frames))
        length = min(LONGEST, max(lengths) // shards.row_stride)
        window, other = lively_windows(shards, length, prompt, FILMED)
        film = rollout_video(
            model,
            tokenizer,
            shards,
            window=window,
            other=other,
            frames=length - prompt,
            prompt=prompt,
        )
        simulated = partial(truth.episode, robot, prompt + HELD, model.embodiments[robot].stride, HELD_SEED)
        episodes = [simulated(number) for number in range(HELD_ROLLOUTS)]
        left = left_at(continued(model, tokenizer, robot, episodes, prompt, HELD_SEED, decoded=True), HELD)
        return found, film, left

    with single_threads(len(made.sets)) as pool:
        results = list(pool.map(roll, made.sets))
    for robot, (found, film, left) in zip(made.sets, results, strict=True):
        made.figures[robot], made.films[robot], made.left[robot] = found, film, left
        print(f"  {robot}: the model {verdict(found)}", flush=True)
        print(f"  {robot}: after {HELD} frames in closed loop {left_words(left)}", flush=True)


def _size(path: Path) -> int:
    files = [path] if path.is_file() else [item for item in path.rglob("*") if item.is_file()]
    return sum(item.stat().st_size for item in files)
