"""`hma demo`: the whole road, small, over the same public functions as every other verb.

Two laboratory robots are recorded in two formats, converted to tokenized shards, mixed, trained
on together, published to a folder hub, pulled back one robot at a time, rolled out on episodes the
model has not seen, and reported on one page. Nothing is downloaded. Run again in the same folder it
goes on where it was cut.
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
from hma_data.convert import convert
from hma_data.embodiment import find
from hma_data.engines.base import Attempt, Retry
from hma_data.engines.local import run as run_local
from hma_data.engines.local import usable_cores
from hma_data.errors import OutputError, ShardError
from hma_data.files import write_atomic
from hma_data.loader import open_sets
from hma_data.mixture import Mixture
from hma_data.paths import StrPath, as_path
from hma_data.plan import Settings
from hma_data.shards.manifest import MANIFEST
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.windows import WindowIndex

if TYPE_CHECKING:
    from hma_model.film import Film

ROBOTS = ("pusht_fast", "pusht_slow")
TOKENIZER = "fsq-8"
TAU = 3.0
TIMINGS, RESULTS = "timings.json", "results.json"
WINDOWS = 24  # held-out windows of each robot that figures are means of
LONGEST = 24  # frames of the film


@dataclass
class Demo:
    """What the demo has made so far; the report is written from it.

    Attributes:
        out: its folder.
        recordings: robot -> URI.
        sets: robot -> shard set.
        mixture: over the train windows.
        training: result of the run.
        published, pulled: folders of the hub and of what was pulled back.
        figures: robot -> what `evaluate` found on its held-out windows.
        films: robot -> a held-out rollout.
        seconds: stage -> wall time.
        sizes: what -> bytes.
    """

    out: Path
    recordings: dict[str, Path] = field(default_factory=dict)
    sets: dict[str, ShardSet] = field(default_factory=dict)
    mixture: Mixture | None = None
    training: Any = None
    published: Path | None = None
    pulled: dict[str, Path] = field(default_factory=dict)
    figures: dict[str, dict[str, Any]] = field(default_factory=dict)
    films: dict[str, "Film"] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    sizes: dict[str, int] = field(default_factory=dict)

    @contextmanager
    def stage(self, number: int, name: str) -> Iterator[None]:
        """Time a stage and say so."""
        print(f"[{number}/5] {name}", file=sys.stderr, flush=True)
        begun = time.monotonic()
        yield
        self.took(name, time.monotonic() - begun)

    def took(self, name: str, seconds: float) -> None:
        """Note a stage's time; a run that goes on keeps what an earlier one needed for it."""
        path = self.out / TIMINGS
        known = json.loads(path.read_text()) if path.is_file() else {}
        known[name] = max(seconds, known.get(name, 0.0))
        self.seconds[name] = known[name]
        write_atomic(path, json.dumps(known))


def demo(out: StrPath, *, episodes: int = 24, steps: int | None = None, seed: int = 0) -> Path:
    """Run the main job into `out`.

    Args:
        out: str or path of a folder.
        episodes: recorded for each robot.
        steps: of training; None takes the recipe's.
        seed: of recording and training.

    Returns:
        The report, `out`/report.html.

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
    from hma_model.demo_report import write_report

    return write_report(made)


@dataclass(frozen=True)
class Recorded:
    """What the first stage makes of one robot.

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
    """Makes a worker's function, from a robot's name to its recording and shard set; picklable."""

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
    """Stage 1: a few dozen episodes of each robot from gym-pusht, to verified shard sets.

    Each robot has a process of its own, which ends when this one does.
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
    """Verify a robot's shard set and note it."""
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
    """Stage 2: how often each robot is drawn."""
    from hma_model.recipe import load_recipe

    frames = load_recipe("demo").frames
    sets = open_sets(list(made.sets.values()))
    counts = {name: WindowIndex.of(shards, "train", frames).count for name, shards in sets.items()}
    made.mixture = Mixture.of(counts, TAU)
    for name, count, p in zip(made.mixture.names, counts.values(), made.mixture.p, strict=True):
        print(f"  {name}: {count:,} windows, drawn with p = {p:.3f}", flush=True)


def train_both(made: Demo, steps: int | None, seed: int) -> None:
    """Stage 3: one small model on both robots."""
    from hma_model.recipe import load_recipe
    from hma_model.train import train

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
    """Stage 4: push the checkpoint to a folder hub, pull each robot back alone."""
    from hma_model import hub

    made.published = made.out / "hub" / "demo" / "pusht"
    hub.push(made.training.checkpoint, str(made.published))
    for robot in ROBOTS:
        made.pulled[robot] = hub.pull(str(made.published), [robot], made.out / "pulled" / robot)
        made.sizes[f"checkpoint for {robot} alone"] = _size(made.pulled[robot])
    made.sizes["checkpoint of both"] = _size(made.published)


def roll_out(made: Demo) -> None:
    """Stage 5: each robot's figures and film, by the model that was pulled for it alone.

    The robots are worked on side by side, each by one thread: so many small products gain little from two.
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
    """Write results.json: the seconds in all, and what the actions are worth in each robot's last frames."""
    names = {"true": "psnr_last", "shuffled": "psnr_last_shuffled", "copy": "psnr_last_copy"}
    figures = {
        robot: {name: found[key]["psnr_last"] for key, name in names.items()}
        for robot, found in made.figures.items()
    }
    results = {"seconds": sum(made.seconds.values()), "embodiments": figures}
    write_atomic(made.out / RESULTS, json.dumps(results, indent=1))


def _rolled_out(made: Demo, robot: str) -> tuple[dict[str, Any], "Film"]:
    from hma_data.shards.preview import tokenizer_of
    from hma_model.evaluate import default_prompt, evaluate
    from hma_model.film import rollout_film
    from hma_model.model import HMA

    shards = made.sets[robot]
    model = HMA.from_pretrained(str(made.pulled[robot]), embodiments=[robot]).eval()
    tokenizer = tokenizer_of(shards)
    found = evaluate(model, tokenizer, shards, count=WINDOWS, batch_size=8)
    lengths = [row["length"] for row in shards.episodes.to_pylist() if row["split"] == "val"]
    prompt = max(2, default_prompt(model.config.frames))
    frames = min(LONGEST, max(lengths) // shards.row_stride) - prompt
    return found, rollout_film(model, tokenizer, shards, frames=frames, prompt=prompt)


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
    """What this ran on, in a line."""
    import torch

    versions = f"Python {platform.python_version()}, torch {torch.__version__}"
    return f"{usable_cores()} cores, {platform.machine()}, {versions}"


def save_page(made: Demo, html: str) -> Path:
    """Write the report; returns its path."""
    path = made.out / "report.html"
    write_atomic(path, html)
    total = human_seconds(sum(made.seconds.values()))
    print(f"  {path} ({human_bytes(len(html))}), {total} in all", flush=True)
    return path
