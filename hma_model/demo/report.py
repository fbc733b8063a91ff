"""Write the report of the demo: one page that opens with the rollouts of both robots."""

import platform
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from hma_data.console import human_bytes, human_seconds
from hma_data.cpu import usable_cores
from hma_data.episodes.align import to_clip
from hma_data.episodes.images import prepare
from hma_data.episodes.sheets import grid, png_bytes, webp_bytes
from hma_data.loading.mixture import plot_mixture
from hma_data.registry.embodiment import find
from hma_data.shards.preview import tokenizer_of
from hma_data.sources.base import open_source
from hma_data.storage.files import write_atomic
from hma_model.config import token_words
from hma_model.demo.results import Demo
from hma_model.evaluation.pages import Page
from hma_model.evaluation.plots import held_out_losses, psnr_over_horizon
from hma_model.training.logging import read_metrics

if TYPE_CHECKING:
    from hma_model.training.loop import TrainResult

TAU = 3.0
SHOWN = 3  # windows of a robot's film
FINETUNED, SCRATCH = "embedded trunk, finetuned", "from scratch"
BARS = {"shuffled": 2.0, "copy": 1.5}  # dB of the last frame by which a model that follows is above
NAMES = {"true": "true actions", "shuffled": "shuffled actions", "copy": "the prompt's last frame repeated"}

OWN_DATA = """
hma inspect DATA                                          # what is in the recording
hma registry infer DATA --id my_arm --out my_arm.yaml     # its YAML; answer the TODOs in it
hma registry validate my_arm.yaml
hma convert -e my_arm.yaml --source DATA --tokenizer {tokenizer} --out shards/my_arm
hma shards verify shards/my_arm
hma shards preview shards/my_arm                          # sheet.png and preview.mp4 from the tokens
hma finetune --from embedded --data shards/my_arm --out runs/my_arm
hma evaluate runs/my_arm shards/my_arm
hma generate runs/my_arm shards/my_arm --out rollout.mp4
hma hub push runs/my_arm ./my-hub/team/model --embodiment my_arm
"""


def write_report(made: Demo) -> Path:
    """Write `out`/report.html from the results of the demo, and return its path."""
    import torch

    versions = f"Python {platform.python_version()}, torch {torch.__version__}"
    machine = f"{usable_cores()} cores, {platform.machine()}, {versions}"
    lead = f"Recorded, tokenized, finetuned, published and rolled out by hma demo on {machine}."
    page = Page("HMA Toolkit: a world model learns two new robots", lead)
    for section in (_films, _headline, _robots, _reconstructions, _mixture, _training, _rollouts):
        section(page, made)
    page.section("Sizes and timings")
    page.table(["what", "size"], [[name, human_bytes(size)] for name, size in made.sizes.items()])
    page.table(["stage", "wall time"], [[name, human_seconds(s)] for name, s in made.seconds.items()])
    about = "Every step above is one command; DATA is a file, folder or URI."
    page.section("The same on your own data", about)
    page.commands(OWN_DATA.format(tokenizer=made.tokenizer))
    page.section("This report")
    page.commands(shlex.join(["hma", *sys.argv[1:]]))
    path, html = made.out / "report.html", page.html()
    write_atomic(path, html)
    total = human_seconds(sum(made.seconds.values()))
    print(f"  {path} ({human_bytes(len(html))}), {total} in all", flush=True)
    return path


def _films(page: Page, made: Demo) -> None:
    prompt = next(iter(made.films.values())).prompt
    page.text(
        "Left: what happened. Middle: the model with the same actions. Right: the model with the actions of "
        f"another window. Grey border: the true frames, of which the model gets {prompt}. Green border: "
        "predicted. The bars are the actions. All pictures are decoded from tokens. Shown are the held-out "
        "windows with the most motion, and the other actions that differ most from their own."
    )
    for robot, film in made.films.items():
        page.section(f"{robot}: {find(robot).robot}")
        caption = f"{robot}: {SHOWN} held-out windows in turn, at the model's {film.fps:g} Hz"
        page.picture(webp_bytes(film.frames, film.fps), "webp", caption)
        page.text(verdict(made.figures[robot]))


def verdict(found: Mapping[str, Any]) -> str:
    """Return a line on a result of `evaluate`: the last frame's PSNR, and whether the model follows."""
    last = {name: found[name]["psnr_last"] for name in NAMES}
    figures = ", ".join(f"{last[name]:.1f} dB with {text}" for name, text in NAMES.items())
    gains = {name: last["true"] - last[name] for name in BARS}
    reached = all(gain >= BARS[name] for name, gain in gains.items())
    above = " and ".join(f"{gain:+.1f} dB over {name} (bar: {BARS[name]:g})" for name, gain in gains.items())
    said = "The model follows its actions" if reached else "The bar is not reached"
    return (
        f"{said}: {above}. PSNR of the last frame: {figures}; means of {found['windows']} held-out windows"
        f" and {found['draws']} draws of shuffled actions."
    )


def _headline(page: Page, made: Demo) -> None:
    result, scratch = made.runs[FINETUNED], made.runs[SCRATCH]
    splits = [split for shards in made.sets.values() for split in shards.manifest.splits.values()]
    own, other = (sum(found[key] for found in made.figures.values()) for key in ("loss", "shuffled_loss"))
    page.figures(
        [
            (f"{sum(split['frames'] for split in splits):,}", "frames of the new robots"),
            (f"{result.masked_val_loss:.2f}", f"held-out loss, nats a {_unit(made)}"),
            (f"{scratch.masked_val_loss:.2f}", "held-out loss from scratch"),
            (f"{result.baseline:.2f}", "held-out loss of the token frequencies"),
            (f"{other / own - 1:+.0%}", "loss when given shuffled actions"),
            (human_seconds(sum(made.seconds.values())), "from recording to rollout"),
        ]
    )


def _robots(page: Page, made: Demo) -> None:
    about = "Two robots that the embedded trunk has not seen, in two formats, each described by one YAML."
    page.section("The robots", about)
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
            seen = clip.frames_at(camera.name, picks * shards.manifest.frame_stride)
            # as the tokenizer saw them, and decoded from their tokens
            rows.append(list(prepare(seen, camera, spec.image_size, spec.resize_filter)))
            rows.append(list(tokenizer_of(shards).decode(tokens[picks])))
            labels += [f"{robot} {row['id']}: recorded", "from its tokens"]
        caption = f"{robot}: recorded frames above, reconstructions below"
        page.picture(png_bytes(grid(rows, labels)), "png", caption)


def _mixture(page: Page, made: Demo) -> None:
    assert made.mixture is not None
    page.section("The mixture", "Probability of a training sample, p ∝ windows^(1/τ) with τ = 3.")
    with TemporaryDirectory() as folder:
        path = Path(folder) / "mixture.svg"
        plot_mixture(made.mixture, TAU, path)
        page.picture(path.read_bytes(), "svg+xml", "How often each robot is drawn")


def _unit(made: Demo) -> str:
    return token_words(made.start.config.merge)


def _training(page: Page, made: Demo) -> None:
    unit = _unit(made)
    said = (
        f"{name}: {result.step:,} steps, {result.seconds:.0f} s, {result.masked_val_loss:.2f} nats a {unit}"
        for name, result in made.runs.items()
    )
    page.section("Training", f"The same recipe and network, trained on both robots. {'; '.join(said)}.")
    curves = {name: _course(result) for name, result in made.runs.items()}
    baseline = made.runs[FINETUNED].baseline
    assert baseline is not None
    caption = "Held-out loss (whole frames masked) over the time spent in training steps"
    page.picture(held_out_losses(curves, baseline, unit), "svg+xml", caption)


def _course(result: "TrainResult") -> list[tuple[float, float]]:
    """Return (seconds of training, held-out loss) of each evaluation of a run."""
    spent, points = 0.0, []
    for line in read_metrics(result.out):
        spent += line.get("step_seconds", 0.0)
        if line["kind"] == "eval":
            points.append((spent, line["loss"]))
    return points


def _rollouts(page: Page, made: Demo) -> None:
    page.section(
        "Rollouts on held-out episodes",
        "The model, pulled from the hub for one robot alone, sees the first frames and the actions. It "
        "continues from its own predictions. With shuffled actions it should do worse. Copy is the baseline "
        "that repeats the last frame of the prompt.",
    )
    rows = []
    for robot, shards in made.sets.items():
        found = made.figures[robot]
        curves = {name: found[key]["psnr_by_frame"] for key, name in NAMES.items()}
        about = f"mean of {found['windows']} held-out windows, against {found['against']}"
        plot = psnr_over_horizon(curves, 1 / shards.embodiment.effective_hz)
        page.picture(plot, "svg+xml", f"{robot}: PSNR over the horizon, {about}")
        losses = (found[key] for key in ("loss", "shuffled_loss", "baseline_loss", "perplexity"))
        last = (found[key]["psnr_last"] for key in NAMES)
        rows.append([robot, *losses, found["true"]["psnr"], *last, found["true"]["ssim"]])
    columns = [
        "robot", "loss", "with shuffled actions", "baseline", "perplexity", "PSNR dB", "PSNR last",
        "shuffled last", "copy last", "SSIM",
    ]  # fmt: skip
    page.table(columns, rows)
