"""Write the report of the demo: one page that opens with the rollouts of both robots."""

import platform
import shlex
import sys
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.console import human_bytes, human_seconds
from hma_data.cpu import usable_cores
from hma_data.episodes.sheets import webp_bytes
from hma_data.registry.embodiment import find
from hma_data.shards.preview import tokenizer_of
from hma_data.shards.recorded import Recorded
from hma_data.storage.files import write_atomic
from hma_model.demo.results import HELD, DemoRun
from hma_model.evaluation.pages import Page
from hma_model.evaluation.plots import over_horizon
from hma_model.evaluation.report import strip
from hma_model.evaluation.tables import ROLLOUTS
from hma_model.evaluation.verdict import horizon, verdict
from hma_model.evaluation.wholeness import left_words

KEPT_FRAMES = 7  # of an episode, that show what the tokens keep
OWN_DATA = """
hma inspect DATA                                          # what is in the recording
hma registry infer DATA --id my_arm --out my_arm.yaml     # its YAML; answer the TODOs in it
hma registry validate my_arm.yaml
hma convert DATA -e my_arm.yaml --tokenizer palette-64 --out shards/my_arm
hma shards verify shards/my_arm
hma shards preview shards/my_arm                          # sheet.png and preview.mp4 from the tokens
hma finetune shards/my_arm --from embedded --out runs/my_arm
hma evaluate runs/my_arm shards/my_arm
hma generate runs/my_arm shards/my_arm --out rollout.mp4
hma hub push runs/my_arm ./my-hub/team/model --embodiment my_arm
"""


def write_report(made: DemoRun) -> Path:
    """Write `out`/report.html from the results of the demo, and return its path."""
    import torch

    versions = f"Python {platform.python_version()}, torch {torch.__version__}"
    machine = f"{usable_cores()} cores, {platform.machine()}, {versions}"
    lead = f"Recorded, tokenized, finetuned, published and rolled out by hma demo on {machine}."
    page = Page("HMA Toolkit: a world model learns two new robots", lead)
    for section in (_films, _headline, _robots, _kept_by_tokens, _rollouts):
        section(page, made)
    page.section("Sizes and timings")
    page.table(["what", "size"], [[name, human_bytes(size)] for name, size in made.sizes.items()])
    page.table(["stage", "wall time"], [[name, human_seconds(s)] for name, s in made.seconds.items()])
    about = (
        "Every step above is one command; DATA is a file, folder or URI. With palette-64, for drawn images, "
        "the model begins as the demo's does; for photographs, fsq-lab and a transformer are better."
    )
    page.section("The same on your own data", about)
    page.commands(OWN_DATA)
    page.section("This report")
    page.commands(shlex.join(["hma", *sys.argv[1:]]))
    path, html = made.out / "report.html", page.html()
    write_atomic(path, html)
    total = human_seconds(sum(made.seconds.values()))
    print(f"  {path} ({human_bytes(len(html))}), {total} in all", flush=True)
    return path


def _headline(page: Page, made: DemoRun) -> None:
    tiles = []
    for robot, found in made.figures.items():
        gain, seconds = found["psnr_action_gain_last"], horizon(found)
        if gain is not None:
            about = f"{robot}: last-frame PSNR gain, recorded vs shuffled actions, after {seconds:.1f} s"
            torn = [name for name, one in made.left[robot].items() if not one.intact]
            tiles.append(
                (
                    f"{gain:+.1f} dB",
                    about + f"; damaged after {HELD} frames: {' and '.join(torn)}" * bool(torn),
                )
            )
    tiles.append((human_seconds(made.run.seconds), f"of finetuning, {made.run.step:,} steps"))
    tiles.append((human_seconds(sum(made.seconds.values())), "from recording to rollout"))
    page.figures(tiles)


def _films(page: Page, made: DemoRun) -> None:
    prompt = next(iter(made.films.values())).prompt
    page.text(
        f"Left: the recording. Middle: the model, from {prompt} frames and the same actions. Right: "
        "the model with other actions."
    )
    for robot, film in made.films.items():
        page.section(f"{robot}: {find(robot).robot}")
        caption = f"{robot}: held-out windows in turn, at the model's {film.fps:g} Hz"
        light, dark = (webp_bytes(frames, film.fps) for frames in (film.frames, film.dark()))
        page.picture(light, "webp", caption, dark)
        page.text(f"The model {verdict(made.figures[robot])}.")
        seconds = HELD / film.fps
        left = left_words(made.left[robot])
        page.text(f"In closed loop in new episodes, after {HELD} frames ({seconds:.1f} s): {left}.")
    page.text(
        "Grey border: recorded frames. Green border: predicted frames. The bars are the actions. All images "
        "are decoded from tokens. Shown are the held-out windows with the most motion, and the other actions "
        "that differ most from their own."
    )


def _robots(page: Page, made: DemoRun) -> None:
    about = (
        "Two robots that the bundled model has not seen, in two formats, each described by one YAML. A "
        "training sample is drawn with the probability p ∝ windows^(1/τ), τ = 3."
    )
    page.section("The robots", about)
    assert made.mixture is not None
    drawn = dict(zip(made.mixture.names, made.mixture.p, strict=True))
    rows = []
    for robot, shards in made.sets.items():
        e, splits = shards.embodiment, shards.manifest.splits
        wins = sum(bool(row["success"]) for row in shards.episodes.to_pylist())
        recorded = f"{made.recordings[robot].name} ({e.source.format})"
        rates = [e.rate_hz, e.stride, e.effective_hz]
        episodes = [splits[split]["episodes"] for split in ("train", "val")]
        success = f"{wins} of {len(shards.episodes)}" if wins else "not recorded"
        actions = ", ".join(e.action.names())
        rows.append([robot, recorded, actions, *rates, *episodes, float(drawn[robot]), success])
    heads = ["id", "recording", "actions", "Hz", "stride", "effective Hz"]
    page.table([*heads, "train", "held out", "drawn", "success"], rows)


def _kept_by_tokens(page: Page, made: DemoRun) -> None:
    about = "Recorded frames, and the same frames decoded from their tokens. The model sees only tokens."
    page.section("Recorded vs decoded frames", about)
    for robot, shards in made.sets.items():
        row = next(row for row in shards.episodes.to_pylist() if row["split"] == "val")
        picks = np.linspace(0, row["length"] - 1, KEPT_FRAMES).astype(int)
        tokens = shards.tokens(shards.episode_rows(row["episode_index"], ["tokens"])["tokens"])
        recorded = Recorded(shards, row).frames(shards.manifest.cameras[0], picks)
        decoded = tokenizer_of(shards).decode(tokens[picks])
        numbers = np.arange(len(picks))
        strips = [
            (name, strip(frames, numbers, len(picks)))
            for name, frames in (("recorded", recorded), ("from its tokens", decoded))
        ]
        page.strips(robot, f"held-out episode {row['id']}", strips)


def _rollouts(page: Page, made: DemoRun) -> None:
    page.section(
        "Rollouts on held-out episodes",
        "The model, pulled from the hub for one robot alone, gets the first frames and the actions, and "
        "continues from its own predictions. With shuffled actions it should do worse. Bands are 95 % "
        "intervals of the mean.",
    )
    rows = []
    for robot, shards in made.sets.items():
        found = made.figures[robot]
        kinds = {kind: found[kind] for kind in ("true", "shuffled", "copy")}
        curves: dict[str, tuple[Any, Any]] = {
            ROLLOUTS[kind]: (figures["psnr_by_frame"], figures["psnr_by_frame_95"])
            for kind, figures in kinds.items()
            if None not in figures["psnr_by_frame"]
        }
        plot = over_horizon(curves, 1 / shards.embodiment.effective_hz, "PSNR, dB")
        about = f"mean of {found['windows']} held-out windows, vs {found['against']}"
        page.picture(plot, "svg+xml", f"{robot}: PSNR over the horizon, {about}")
        last = [figures["psnr_last"] for figures in kinds.values()]
        rows.append([robot, horizon(found), *last, found["true"]["ssim"]])
    heads = ["PSNR last frame, recorded actions", "shuffled actions", "copy", "SSIM"]
    page.table(["robot", "seconds", *heads], rows)
