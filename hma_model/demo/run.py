"""Run the whole pipeline on two small robots (`hma demo`), with the same functions as every other verb.

The demo records two laboratory robots in two formats, converts the recordings to tokenized shards, mixes them
and trains one model on both. It publishes the model to a folder hub, pulls it back one robot at a time, rolls
it out on episodes that it has not seen, and writes a report of one page. It downloads nothing. A second run
in the same folder continues an interrupted one.
"""

import json
import platform
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hma_data import lab
from hma_data.console import human_bytes, human_seconds, progress
from hma_data.conversion.engines.base import Attempt, Retry
from hma_data.conversion.engines.local import run as run_local
from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.cpu import usable_cores
from hma_data.errors import OutputError, ShardError
from hma_data.loading.dataset import open_sets
from hma_data.loading.mixture import Mixture
from hma_data.registry.embodiment import find
from hma_data.shards.manifest import MANIFEST
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.shards.windows import WindowIndex
from hma_data.storage.files import write_atomic
from hma_data.storage.paths import StrPath, as_path

if TYPE_CHECKING:
    from hma_model.evaluation.rollout_video import RolloutVideo

ROBOTS = ("pusht_fast", "pusht_slow")
TOKENIZER = "fsq-8"
TAU = 3.0
TIMINGS, RESULTS = "timings.json", "results.json"
WINDOWS = 24  # held-out windows of each robot; the figures are means over them
LONGEST = 24  # frames of the film


@dataclass
class Demo:
    """The results of the demo so far; the report is written from them.

    Attributes:
        out: the folder of the demo.
        recordings: robot -> URI.
        sets: robot -> shard set.
        mixture: over the train windows.
        training: result of the run.
        published, pulled: folders of the hub, and of each robot's pulled checkpoint.
        figures: robot -> the result of `evaluate` on its held-out windows.
        films: robot -> a held-out rollout.
        seconds: stage -> wall time.
        sizes: name of a file or folder -> bytes.
    """

    out: Path
    recordings: dict[str, Path] = field(default_factory=dict)
    sets: dict[str, ShardSet] = field(default_factory=dict)
    mixture: Mixture | None = None
    training: Any = None
    published: Path | None = None
    pulled: dict[str, Path] = field(default_factory=dict)
    figures: dict[str, dict[str, Any]] = field(default_factory=dict)
    films: dict[str, "RolloutVideo"] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    sizes: dict[str, int] = field(default_factory=dict)

    @contextmanager
    def stage(self, number: int, name: str) -> Iterator[None]:
        """Print the name of a stage, and measure its time."""
        print(f"[{number}/5] {name}", file=sys.stderr, flush=True)
        begun = time.monotonic()
        yield
        self.took(name, time.monotonic() - begun)

    def took(self, name: str, seconds: float) -> None:
        """Record the time of a stage; a continued run keeps the larger of the times of its runs."""
        path = self.out / TIMINGS
        known = json.loads(path.read_text()) if path.is_file() else {}
        known[name] = max(seconds, known.get(name, 0.0))
        self.seconds[name] = known[name]
        write_atomic(path, json.dumps(known))


def demo(out: StrPath, *, episodes: int = 24, steps: int | None = None, seed: int = 0) -> Path:
    """Run the demo, with its results in `out`.

    Args:
        out: str or path of a folder.
        episodes: the number recorded for each robot.
        steps: training steps; None takes the recipe's.
        seed: the seed of recording and training.

    Returns:
        The path of the report, `out`/report.html.

    Raises:
        OutputError: the folder holds something else.
        MissingDependencyError: gym-pusht is not installed.
    """
    out = as_path(out)
    _refuse_foreign(out)
    made = Demo(out)
    with made.stage(1, "record and convert"):
        record_and_convert(made, episodes, seed)
    with made.stage(2, "mix"):
        mix(made)
    with made.stage(3, "train"):
        train_both(made, steps, seed)
    with made.stage(4, "publish and pull"):
        publish(made)
    with made.stage(5, "roll out"):
        roll_out(made)
    write_results(made)
    from hma_model.demo.report import write_report

    return write_report(made)


@dataclass(frozen=True)
class Recorded:
    """The result of the first stage for one robot.

    Attributes:
        refused: more episodes than allowed are in quarantine.
    """

    robot: str
    recording: Path
    splits: dict[str, int]
    shard_bytes: int
    refused: bool


@dataclass(frozen=True)
class Recording:
    """A picklable factory of the function by which a worker records and converts a robot."""

    out: Path
    episodes: int
    seed: int

    def __call__(self, workers: int) -> Callable[[str, Callable[[Any], None], Attempt], Recorded]:
        """Return the function; it reports ("recorded" or "converted", episodes so far)."""

        def work(robot: str, report: Callable[[Any], None], attempt: Attempt) -> Recorded:
            folder = self.out / "recordings"
            there = sorted(folder.glob(f"{robot}*"))
            recording = (
                there[0]
                if there
                else lab.record(
                    robot, folder, self.episodes, self.seed, lambda done, total: report(("recorded", done))
                )
            )
            report(("recorded", self.episodes))
            summary = convert(
                find(robot), str(recording), TOKENIZER, self.out / "shards" / robot,
                settings=Settings(val_fraction=0.15),
                on_progress=lambda state: report(("converted", state.episodes)),
            )  # fmt: skip
            splits = {name: split["episodes"] for name, split in summary.manifest.splits.items()}
            size = summary.manifest.to_json()["totals"]["bytes"]
            return Recorded(robot, recording, splits, size, summary.too_many)

        return work


def record_and_convert(made: Demo, episodes: int, seed: int) -> None:
    """Record episodes of each robot in gym-pusht, and convert them to verified shard sets (stage 1).

    Each robot has its own process, which ends when this process ends.
    """
    finished = all((made.out / "shards" / robot / MANIFEST).is_file() for robot in ROBOTS)
    workers = 0 if finished or usable_cores() == 1 else len(ROBOTS)
    counts: dict[tuple[int, str], int] = {}
    done: dict[str, Recorded] = {}
    with progress("record and convert", 2 * len(ROBOTS) * episodes, "episodes") as update:

        def show(number: int, event: Any) -> None:
            if not isinstance(event, Retry):
                counts[number, event[0]] = event[1]
                update(sum(counts.values()))

        for one in run_local(ROBOTS, Recording(made.out, episodes, seed), workers, show):
            done[one.robot] = one
    for robot in ROBOTS:
        _take_shards(made, done[robot])


def _take_shards(made: Demo, one: Recorded) -> None:
    """Verify a robot's shard set, and add it to the results."""
    robot, folder = one.robot, made.out / "shards" / one.robot
    problems = verify(folder)
    if problems or one.refused:
        raise ShardError(folder, "; ".join(problems) or "too many episodes are in quarantine")
    made.recordings[robot], made.sets[robot] = one.recording, ShardSet(folder)
    made.sizes[f"recording {robot}"] = _size(one.recording)
    made.sizes[f"shards {robot}"] = one.shard_bytes
    splits = ", ".join(f"{name} {count}" for name, count in one.splits.items())
    print(f"  {robot}: {splits} episodes, {human_bytes(one.shard_bytes)}, verified", flush=True)


def mix(made: Demo) -> None:
    """Compute how often each robot is drawn (stage 2)."""
    from hma_model.training.recipe import load_recipe

    frames = load_recipe("demo").frames
    sets = open_sets(list(made.sets.values()))
    counts = {name: WindowIndex.of(shards, "train", frames).count for name, shards in sets.items()}
    made.mixture = Mixture.of(counts, TAU)
    for name, count, p in zip(made.mixture.names, counts.values(), made.mixture.p, strict=True):
        print(f"  {name}: {count:,} windows, drawn with p = {p:.3f}", flush=True)


def train_both(made: Demo, steps: int | None, seed: int) -> None:
    """Train one small model on both robots (stage 3)."""
    from hma_model.training.loop import train
    from hma_model.training.recipe import load_recipe

    folders = ", ".join(str(shards.folder.absolute()) for shards in made.sets.values())
    changes = [f"data=[{folders}]", f"seed={seed}", f"mixture.temperature={TAU}"]
    recipe = load_recipe("demo", changes + ([f"steps={steps}"] if steps else []))
    made.training = train(recipe, out=made.out / "run")
    result = made.training
    if result.masked_val_loss is not None and result.baseline is not None:
        print(
            f"  held-out loss {result.masked_val_loss:.3f} nats a token, "
            f"looking at nothing {result.baseline:.3f}",
            flush=True,
        )


def publish(made: Demo) -> None:
    """Push the checkpoint to a folder hub, and pull each robot back alone (stage 4)."""
    from hma_model.hub import publish as hub

    made.published = made.out / "hub" / "demo" / "pusht"
    hub.push(made.training.checkpoint, str(made.published))
    for robot in ROBOTS:
        made.pulled[robot] = hub.pull(str(made.published), [robot], made.out / "pulled" / robot)
        made.sizes[f"checkpoint for {robot} alone"] = _size(made.pulled[robot])
    made.sizes["checkpoint of both"] = _size(made.published)


def roll_out(made: Demo) -> None:
    """Compute each robot's figures and film with the model pulled for it alone (stage 5).

    The robots run in parallel, each in one thread, because a second thread speeds up small products little.
    """
    from hma_data.tokenizers.network import single_threads

    with single_threads(len(made.sets)) as pool:
        results = list(pool.map(lambda robot: _rolled_out(made, robot), made.sets))
    for robot, (found, film) in zip(made.sets, results, strict=True):
        made.figures[robot], made.films[robot] = found, film
        print(
            f"  {robot}: last frame PSNR {found['true']['psnr_last']:.1f} dB with its actions, "
            f"{found['shuffled']['psnr_last']:.1f} dB with another window's",
            flush=True,
        )


def write_results(made: Demo) -> None:
    """Write results.json: the total seconds, and the PSNR of each robot's last frames."""
    names = {"true": "psnr_last", "shuffled": "psnr_last_shuffled", "copy": "psnr_last_copy"}
    figures = {
        robot: {name: found[key]["psnr_last"] for key, name in names.items()}
        for robot, found in made.figures.items()
    }
    results = {"seconds": sum(made.seconds.values()), "embodiments": figures}
    write_atomic(made.out / RESULTS, json.dumps(results, indent=1))


def _rolled_out(made: Demo, robot: str) -> tuple[dict[str, Any], "RolloutVideo"]:
    from hma_data.shards.preview import tokenizer_of
    from hma_model.evaluation.evaluate import default_prompt, evaluate
    from hma_model.evaluation.rollout_video import rollout_video
    from hma_model.network.model import HMA

    shards = made.sets[robot]
    model = HMA.from_pretrained(str(made.pulled[robot]), embodiments=[robot]).eval()
    tokenizer = tokenizer_of(shards)
    found = evaluate(model, tokenizer, shards, count=WINDOWS, batch_size=8)
    lengths = [row["length"] for row in shards.episodes.to_pylist() if row["split"] == "val"]
    prompt = max(2, default_prompt(model.config.frames))
    frames = min(LONGEST, max(lengths) // shards.row_stride) - prompt
    return found, rollout_video(model, tokenizer, shards, frames=frames, prompt=prompt)


def _refuse_foreign(out: Path) -> None:
    ours = {"recordings", "shards", "run", "hub", "pulled", "report.html", TIMINGS, RESULTS}
    if out.is_dir():
        foreign = sorted(item.name for item in out.iterdir() if item.name not in ours)
        if foreign:
            raise OutputError(out, f"holds {', '.join(foreign[:3])}", "choose an empty or new --out")
    elif out.exists():
        raise OutputError(out, "is not a folder", "choose another --out")


def _size(path: Path) -> int:
    files = [path] if path.is_file() else [item for item in path.rglob("*") if item.is_file()]
    return sum(item.stat().st_size for item in files)


def machine() -> str:
    """Return one line that describes the machine and the versions."""
    import torch

    versions = f"Python {platform.python_version()}, torch {torch.__version__}"
    return f"{usable_cores()} cores, {platform.machine()}, {versions}"


def save_page(made: Demo, html: str) -> Path:
    """Write the report, and return its path."""
    path = made.out / "report.html"
    write_atomic(path, html)
    total = human_seconds(sum(made.seconds.values()))
    print(f"  {path} ({human_bytes(len(html))}), {total} in all", flush=True)
    return path
