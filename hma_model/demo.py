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
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hma_data import lab
from hma_data.console import human_bytes, human_seconds, progress
from hma_data.convert import Progress, convert
from hma_data.embodiment import Embodiment, find
from hma_data.engines.local import usable_cores
from hma_data.errors import OutputError, ShardError
from hma_data.files import write_atomic
from hma_data.loader import open_sets
from hma_data.mixture import Mixture
from hma_data.paths import StrPath, as_path
from hma_data.plan import Settings
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.windows import WindowIndex

ROBOTS = ("pusht_fast", "pusht_slow")
TOKENIZER = "fsq-8"
TAU = 3.0
TIMINGS = "timings.json"


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
    seconds: dict[str, float] = field(default_factory=dict)
    sizes: dict[str, int] = field(default_factory=dict)

    @contextmanager
    def stage(self, number: int, name: str) -> Iterator[None]:
        """Time a stage and say so."""
        print(f"[{number}/6] {name}", file=sys.stderr, flush=True)
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
    with made.stage(1, "record"):
        record(made, episodes, seed)
    with made.stage(2, "convert"):
        for robot in ROBOTS:
            convert_one(made, find_robot(robot))
    with made.stage(3, "mix"):
        mix(made)
    with made.stage(4, "train"):
        train_both(made, steps, seed)
    with made.stage(5, "publish and pull"):
        publish(made)
    with made.stage(6, "roll out"):
        evaluate_pulled(made)
    from hma_model.demo_report import write_report

    return write_report(made)


def find_robot(robot: str) -> Embodiment:
    """The laboratory robot's embodiment from the registry."""
    return find(robot)


def record(made: Demo, episodes: int, seed: int) -> None:
    """Stage 1: a few dozen episodes of each robot from gym-pusht, each in its own format."""
    folder = made.out / "recordings"
    with progress("record", 2 * episodes, "episodes") as update:
        for i, robot in enumerate(ROBOTS):
            found = sorted(folder.glob(f"{robot}*"))
            if found:
                made.recordings[robot] = found[0]
            else:
                count = lambda done, total, first=i * episodes: update(first + done)  # noqa: E731
                made.recordings[robot] = lab.record(robot, folder, episodes, seed, count)
            made.sizes[f"recording {robot}"] = _size(made.recordings[robot])


def convert_one(made: Demo, robot: Embodiment) -> None:
    """Stage 2: a recording to a verified shard set."""
    folder = made.out / "shards" / robot.id
    with progress(f"convert {robot.id}") as update:

        def show(state: Progress) -> None:
            update(state.frames, f"{state.episodes}/{state.total_episodes} episodes", state.total_frames)

        settings = Settings(val_fraction=0.15)
        summary = convert(
            robot, str(made.recordings[robot.id]), TOKENIZER, folder, settings=settings, on_progress=show
        )
    problems = verify(folder)
    if problems or summary.too_many:
        raise ShardError(folder, "; ".join(problems) or "too many episodes are in quarantine")
    made.sets[robot.id] = ShardSet(folder)
    made.sizes[f"shards {robot.id}"] = summary.manifest.to_json()["totals"]["bytes"]
    splits = ", ".join(f"{name} {split['episodes']}" for name, split in summary.manifest.splits.items())
    print(
        f"  {robot.id}: {splits} episodes, {human_bytes(made.sizes[f'shards {robot.id}'])}, verified",
        flush=True,
    )


def mix(made: Demo) -> None:
    """Stage 3: how often each robot is drawn."""
    from hma_model.recipe import load_recipe

    frames = load_recipe("demo").frames
    sets = open_sets(list(made.sets.values()))
    counts = {name: WindowIndex.of(shards, "train", frames).count for name, shards in sets.items()}
    made.mixture = Mixture.of(counts, TAU)
    for name, count, p in zip(made.mixture.names, counts.values(), made.mixture.p, strict=True):
        print(f"  {name}: {count:,} windows, drawn with p = {p:.3f}", flush=True)


def train_both(made: Demo, steps: int | None, seed: int) -> None:
    """Stage 4: one small model on both robots."""
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
    """Stage 5: push the checkpoint to a folder hub, pull each robot back alone."""
    from hma_model import hub

    made.published = made.out / "hub" / "demo" / "pusht"
    hub.push(made.training.checkpoint, str(made.published))
    for robot in ROBOTS:
        made.pulled[robot] = hub.pull(str(made.published), [robot], made.out / "pulled" / robot)
        made.sizes[f"checkpoint for {robot} alone"] = _size(made.pulled[robot])
    made.sizes["checkpoint of both"] = _size(made.published)


def evaluate_pulled(made: Demo) -> None:
    """Stage 6: each robot's figures, by the model that was pulled for it alone."""
    from hma_data.shards.preview import tokenizer_of
    from hma_model.evaluate import evaluate
    from hma_model.model import HMA

    for robot, shards in made.sets.items():
        model = HMA.from_pretrained(str(made.pulled[robot]), embodiments=[robot]).eval()
        found = evaluate(model, tokenizer_of(shards), shards, count=24, batch_size=8)
        made.figures[robot] = found
        print(
            f"  {robot}: last frame PSNR {found['true']['psnr_last']:.1f} dB with its actions, "
            f"{found['shuffled']['psnr_last']:.1f} dB with another window's",
            flush=True,
        )


def _refuse_foreign(out: Path) -> None:
    ours = {"recordings", "shards", "run", "hub", "pulled", "report.html", TIMINGS}
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
