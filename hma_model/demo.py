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
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from hma_data import lab
from hma_data.console import human_bytes, human_seconds, progress
from hma_data.conversion.engines import Attempt, Report, Retry, Work
from hma_data.conversion.engines.local import run as run_local
from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.cpu import usable_cores
from hma_data.episodes.align import to_clip
from hma_data.episodes.images import prepare
from hma_data.episodes.sheets import grid, png_bytes, webp_bytes
from hma_data.errors import OutputError, ShardError
from hma_data.loading.dataset import open_sets
from hma_data.loading.mixture import Mixture, plot_mixture
from hma_data.registry.embodiment import find
from hma_data.shards.manifest import MANIFEST
from hma_data.shards.preview import tokenizer_of
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.shards.windows import WindowIndex
from hma_data.sources.base import open_source
from hma_data.storage.files import write_atomic
from hma_data.storage.paths import StrPath, as_path
from hma_model.evaluation.pages import Page, loss_curves, psnr_over_horizon

if TYPE_CHECKING:
    from hma_model.evaluation.rollout_video import RolloutVideo

ROBOTS = ("pusht_fast", "pusht_slow")
TOKENIZER = "fsq-8"
TAU = 3.0
TIMINGS, RESULTS = "timings.json", "results.json"
OURS = {"recordings", "shards", "run", "hub", "pulled", "report.html", TIMINGS, RESULTS}
WINDOWS = 24  # held-out windows of each robot; the figures are means over them
LONGEST = 24  # frames of the film

OWN_DATA = """
hma inspect DATA                                          # what is in the recording
hma registry infer DATA --id my_arm --out my_arm.yaml     # its YAML; answer the TODOs in it
hma registry validate my_arm.yaml
hma convert -e my_arm.yaml --source DATA --out shards/my_arm
hma shards verify shards/my_arm
hma shards preview shards/my_arm                          # sheet.png and preview.mp4 from the tokens
hma train discrete_tiny "data=[shards/my_arm]" --out runs/my_arm
hma evaluate runs/my_arm shards/my_arm
hma generate runs/my_arm shards/my_arm --out rollout.mp4
hma hub push runs/my_arm ./my-hub/team/model --embodiment my_arm
"""


@dataclass
class Demo:
    """The results of the demo so far; the report is written from them."""

    out: Path  # the folder of the demo
    recordings: dict[str, Path] = field(default_factory=dict)  # by robot, as all that follow
    sets: dict[str, ShardSet] = field(default_factory=dict)
    mixture: Mixture | None = None  # over the train windows
    training: Any = None  # the result of the run
    pulled: dict[str, Path] = field(default_factory=dict)  # checkpoints with one robot
    figures: dict[str, dict[str, Any]] = field(default_factory=dict)  # of `evaluate` on held-out windows
    films: dict[str, "RolloutVideo"] = field(default_factory=dict)  # a held-out rollout
    seconds: dict[str, float] = field(default_factory=dict)  # stage -> wall time
    sizes: dict[str, int] = field(default_factory=dict)  # name of a file or folder -> bytes

    @contextmanager
    def stage(self, number: int, name: str) -> Iterator[None]:
        """Print the name of a stage, and measure its time."""
        print(f"[{number}/5] {name}", file=sys.stderr, flush=True)
        begun = time.monotonic()
        yield
        path = self.out / TIMINGS  # a continued run keeps the larger of the times of its sessions
        known = json.loads(path.read_text()) if path.is_file() else {}
        self.seconds[name] = known[name] = max(time.monotonic() - begun, known.get(name, 0.0))
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
    if out.exists() and not out.is_dir():
        raise OutputError(out, "is not a folder", "choose another --out")
    if foreign := sorted({item.name for item in out.glob("*")} - OURS):
        raise OutputError(out, f"holds {', '.join(foreign[:3])}", "choose an empty or new --out")
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
    names = {"true": "psnr_last", "shuffled": "psnr_last_shuffled", "copy": "psnr_last_copy"}
    figures = {
        robot: {name: found[key]["psnr_last"] for key, name in names.items()}
        for robot, found in made.figures.items()
    }
    results = {"seconds": sum(made.seconds.values()), "embodiments": figures}
    write_atomic(out / RESULTS, json.dumps(results, indent=1))
    return write_report(made)


def _worker(out: Path, episodes: int, seed: int, workers: int) -> Work:
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
            find(robot), str(recording), TOKENIZER, out / "shards" / robot,
            settings=Settings(val_fraction=0.15),
            on_progress=lambda state: report(("converted", state.episodes)),
        )  # fmt: skip
        return robot, recording, summary.too_many

    return work


def record_and_convert(made: Demo, episodes: int, seed: int) -> None:
    """Record episodes of each robot in gym-pusht, and convert them to verified shard sets (stage 1).

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

        results = list(run_local(ROBOTS, partial(_worker, made.out, episodes, seed), workers, show))
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
    loss, baseline = made.training.masked_val_loss, made.training.baseline
    print(f"  held-out loss {loss:.3f} nats a token, token frequencies alone {baseline:.3f}", flush=True)


def publish(made: Demo) -> None:
    """Push the checkpoint to a folder hub, and pull each robot back alone (stage 4)."""
    from hma_model.hub import publish as hub

    published = made.out / "hub" / "demo" / "pusht"
    hub.push(made.training.checkpoint, str(published))
    for robot in ROBOTS:
        made.pulled[robot] = hub.pull(str(published), [robot], made.out / "pulled" / robot)
        made.sizes[f"checkpoint for {robot} alone"] = _size(made.pulled[robot])
    made.sizes["checkpoint of both"] = _size(published)


def roll_out(made: Demo) -> None:
    """Compute each robot's figures and film with the model pulled for it alone (stage 5).

    The robots run in parallel, each in one thread, because a second thread speeds up small products little.
    """
    from hma_data.tokenizers.network import single_threads
    from hma_model.evaluation.evaluate import default_prompt, evaluate
    from hma_model.evaluation.rollout_video import rollout_video
    from hma_model.network.model import HMA

    def roll(robot: str) -> tuple[dict[str, Any], "RolloutVideo"]:
        shards = made.sets[robot]
        model = HMA.from_pretrained(str(made.pulled[robot]), embodiments=[robot]).eval()
        tokenizer = tokenizer_of(shards)
        found = evaluate(model, tokenizer, shards, count=WINDOWS, batch_size=8)
        lengths = [row["length"] for row in shards.episodes.to_pylist() if row["split"] == "val"]
        prompt = max(2, default_prompt(model.config.frames))
        frames = min(LONGEST, max(lengths) // shards.row_stride) - prompt
        return found, rollout_video(model, tokenizer, shards, frames=frames, prompt=prompt)

    with single_threads(len(made.sets)) as pool:
        results = list(pool.map(roll, made.sets))
    for robot, (found, film) in zip(made.sets, results, strict=True):
        made.figures[robot], made.films[robot] = found, film
        own, other = (f"{found[key]['psnr_last']:.1f} dB" for key in ("true", "shuffled"))
        print(f"  {robot}: last frame PSNR {own} with its actions, {other} with another window's", flush=True)


def _size(path: Path) -> int:
    files = [path] if path.is_file() else [item for item in path.rglob("*") if item.is_file()]
    return sum(item.stat().st_size for item in files)


# -- the report


def write_report(made: Demo) -> Path:
    """Write `out`/report.html from the results of the demo, and return its path."""
    import torch

    versions = f"Python {platform.python_version()}, torch {torch.__version__}"
    machine = f"{usable_cores()} cores, {platform.machine()}, {versions}"
    lead = f"Recorded, tokenized, trained, published and rolled out by hma demo on {machine}."
    page = Page("HMA Toolkit: two robots, one world model", lead)
    for section in (_headline, _robots, _reconstructions, _mixture_and_training, _rollouts):
        section(page, made)
    page.section("Sizes and timings")
    page.table(["what", "size"], [[name, human_bytes(size)] for name, size in made.sizes.items()])
    page.table(["stage", "wall time"], [[name, human_seconds(s)] for name, s in made.seconds.items()])
    about = "Every step above is one command; DATA is a file, folder or URI."
    page.section("The same on your own data", about)
    page.commands(OWN_DATA)
    page.section("This report")
    page.commands(" ".join(["hma", *sys.argv[1:]]))
    path, html = made.out / "report.html", page.html()
    write_atomic(path, html)
    total = human_seconds(sum(made.seconds.values()))
    print(f"  {path} ({human_bytes(len(html))}), {total} in all", flush=True)
    return path


def _headline(page: Page, made: Demo) -> None:
    result = made.training
    splits = [split for shards in made.sets.values() for split in shards.manifest.splits.values()]
    own, other = (sum(found[key] for found in made.figures.values()) for key in ("loss", "shuffled_loss"))
    page.figures(
        [
            (f"{sum(split['frames'] for split in splits):,}", "frames recorded and tokenized"),
            (f"{result.masked_val_loss:.2f}", "held-out loss, nats a token"),
            (f"{result.baseline:.2f}", "held-out loss of the token frequencies"),
            (f"{other / own - 1:+.0%}", "loss when given another window's actions"),
            (f"{result.step:,}", "training steps"),
            (human_seconds(sum(made.seconds.values())), "from recording to rollout"),
        ]
    )


def _robots(page: Page, made: Demo) -> None:
    page.section("The robots", "Two recordings of a real physics environment, each described by one YAML.")
    rows = []
    for robot, shards in made.sets.items():
        e = shards.embodiment
        wins = sum(bool(row["success"]) for row in shards.episodes.to_pylist())
        rows.append(
            [
                robot, f"{made.recordings[robot].name} ({e.source.format})", ", ".join(e.action.names()),
                e.action_dim, e.rate_hz, e.stride, e.effective_hz,
                *(shards.manifest.splits[split]["episodes"] for split in ("train", "val")),
                f"{wins} of {len(shards.episodes)}" if wins else "not recorded",
            ]
        )  # fmt: skip
    names = ["id", "recording", "actions", "dims", "Hz", "stride", "effective Hz", "train", "val", "success"]
    page.table(names, rows)


def _reconstructions(page: Page, made: Demo) -> None:
    about = "Recorded frames, and the same decoded from their tokens. The model predicts tokens only."
    page.section("What the tokens keep", about)
    for robot, shards in made.sets.items():
        own, spec, rows, labels = find(robot), shards.spec, [], []
        source, camera = open_source(own.source.format), own.primary_camera
        for row in [row for row in shards.episodes.to_pylist() if row["split"] == "val"][:2]:
            picks = np.linspace(0, row["length"] - 1, 7).astype(int)
            tokens = shards.tokens(shards.episode_rows(row["episode_index"], ["tokens"])["tokens"])
            clip = to_clip(source.read(str(made.recordings[robot]), row["id"], own), own)
            seen = clip.frames_at(camera.name, picks)  # then as the tokenizer saw them
            rows.append(list(prepare(seen, camera, spec.image_size, spec.resize_filter)))
            rows.append(list(tokenizer_of(shards).decode(tokens[picks])))
            labels += [f"{robot} {row['id']}: recorded", "from its tokens"]
        caption = f"{robot}: recorded frames above, reconstructions below"
        page.picture(png_bytes(grid(rows, labels)), "png", caption)


def _mixture_and_training(page: Page, made: Demo) -> None:
    assert made.mixture is not None
    page.section("The mixture", "Probability of a training sample, p ∝ windows^(1/τ) with τ = 3.")
    with TemporaryDirectory() as folder:
        path = Path(folder) / "mixture.svg"
        plot_mixture(made.mixture, TAU, path)
        page.picture(path.read_bytes(), "svg+xml", "How often each robot is drawn")
    page.section("Training")
    result, name = made.training, "both robots"
    validation = [(line["step"], line["loss"]) for line in result.evaluations]
    plot = loss_curves({name: result.losses}, {name: validation}, "loss, nats a token", result.baseline)
    caption = "Loss over training (line: masked tokens; markers: held-out windows, whole frames masked)"
    page.picture(plot, "svg+xml", caption)


def _rollouts(page: Page, made: Demo) -> None:
    page.section(
        "Rollouts on held-out episodes",
        "The model, pulled from the hub for one robot alone, sees the first frames and the actions. It "
        "continues from its own predictions. With another window's actions it should do worse. The loss "
        "shows this; PSNR hardly shows it after so short a training, because the disc covers few pixels. "
        "Copy is the baseline that repeats the last frame of the prompt.",
    )
    rows = []
    for robot, shards in made.sets.items():
        film, found = made.films[robot], made.figures[robot]
        caption = f"{robot}: truth, prediction with the true actions, with another window's; actions as bars"
        page.picture(webp_bytes(film.frames, film.fps), "webp", caption)
        names = {"true": "true actions", "shuffled": "shuffled actions", "copy": "copy"}
        curves = {name: found[key]["psnr_by_frame"] for key, name in names.items()}
        about = f"mean of {found['windows']} held-out windows, against {found['against']}"
        plot = psnr_over_horizon(curves, 1 / shards.embodiment.effective_hz)
        page.picture(plot, "svg+xml", f"{robot}: PSNR over the horizon, {about}")
        losses = (found[key] for key in ("loss", "shuffled_loss", "baseline_loss", "perplexity"))
        last = (found[key]["psnr_last"] for key in names)
        rows.append([robot, *losses, found["true"]["psnr"], *last, found["true"]["ssim"]])
    columns = [
        "robot", "loss", "with other actions", "baseline", "perplexity", "PSNR dB", "PSNR last",
        "shuffled last", "copy last", "SSIM",
    ]  # fmt: skip
    page.table(columns, rows)
