"""The page that ends `hma demo`."""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from hma_data.align import to_clip
from hma_data.console import human_bytes, human_seconds
from hma_data.embodiment import find
from hma_data.mixture import plot_mixture
from hma_data.shards.preview import tokenizer_of
from hma_data.shards.reader import ShardSet
from hma_data.sheets import grid, png_bytes, webp_bytes
from hma_data.sources.base import open_source
from hma_data.video import prepare
from hma_model.page import Page
from hma_model.plots import loss_curve, psnr_over_horizon

if TYPE_CHECKING:
    from hma_model.demo import Demo

OWN_DATA = """
hma inspect DATA                                          # what is in the recording
hma registry infer DATA --id my_arm --out my_arm.yaml     # its YAML; answer the TODOs in it
hma registry validate my_arm.yaml
hma convert -e my_arm.yaml --source DATA --out shards/my_arm
hma shards verify shards/my_arm
hma shards preview shards/my_arm                          # sheet.png and preview.mp4 from the tokens
hma train discrete_tiny data=[shards/my_arm] --out runs/my_arm
hma evaluate runs/my_arm shards/my_arm
hma generate runs/my_arm shards/my_arm --out rollout.mp4
hma hub push runs/my_arm ./my-hub/team/model --embodiment my_arm
"""


def write_report(made: "Demo") -> Path:
    """Write `out`/report.html from what the demo has made."""
    from hma_model.demo import machine, save_page

    page = Page(
        "HMA Toolkit: two robots, one world model",
        f"Recorded, tokenized, trained, published and rolled out by hma demo on {machine()}.",
    )
    _headline(page, made)
    _robots(page, made)
    _reconstructions(page, made)
    _mixture(page, made)
    _training(page, made)
    _rollouts(page, made)
    _accounts(page, made)
    page.section(
        "The same on your own data", "Every step above is one command; DATA is a file, folder or URI."
    )
    page.commands(OWN_DATA)
    page.section("This report")
    page.commands(" ".join(["hma", *sys.argv[1:]]))
    return save_page(made, page.html())


def _headline(page: Page, made: "Demo") -> None:
    result = made.training
    frames = sum(
        split["frames"] for shards in made.sets.values() for split in shards.manifest.splits.values()
    )
    means = {
        key: np.mean([found[key] for found in made.figures.values()]) for key in ("loss", "shuffled_loss")
    }
    tiles = [(f"{frames:,}", "frames recorded and tokenized")]
    if result.masked_val_loss is not None:
        tiles += [
            (f"{result.masked_val_loss:.2f}", "held-out loss, nats a token"),
            (f"{result.baseline:.2f}", "the same, looking at nothing"),
        ]
    tiles += [
        (f"{means['shuffled_loss'] / means['loss'] - 1:+.0%}", "loss when given another window's actions"),
        (f"{result.step:,}", "training steps"),
        (human_seconds(sum(made.seconds.values())), "from recording to rollout"),
    ]
    page.figures(tiles)


def _robots(page: Page, made: "Demo") -> None:
    page.section("The robots", "Two recordings of a real physics environment, each described by one YAML.")
    rows = []
    for robot, shards in made.sets.items():
        e, splits = shards.embodiment, shards.manifest.splits
        wins = [row for row in shards.episodes.to_pylist() if row["success"]]
        success = f"{len(wins)} of {len(shards.episodes)}" if wins else "not recorded"
        rows.append(
            [
                robot,
                f"{made.recordings[robot].name} ({e.source.format})",
                ", ".join(e.action.names()),
                e.action_dim,
                e.rate_hz,
                e.stride,
                e.effective_hz,
                splits["train"]["episodes"],
                splits["val"]["episodes"],
                success,
            ]
        )
    names = ["id", "recording", "actions", "dims", "Hz", "stride", "effective Hz", "train", "val", "success"]
    page.table(names, rows)


def _reconstructions(page: Page, made: "Demo") -> None:
    page.section(
        "What the tokens keep",
        "Recorded frames, and the same decoded from their tokens. All that follows is predicted in tokens.",
    )
    for robot, shards in made.sets.items():
        rows, labels = [], []
        for row in _held_out(shards, 2):
            picks = np.linspace(0, row["length"] - 1, 7).astype(int)
            rows += [
                list(real_frames(made, shards, row["id"], picks)),
                list(decoded(shards, row["episode_index"], picks)),
            ]
            labels += [f"{robot} {row['id']}: recorded", "from its tokens"]
        page.picture(
            png_bytes(grid(rows, labels)), "png", f"{robot}: recorded frames above, reconstructions below"
        )


def _held_out(shards: ShardSet, count: int) -> list[dict[str, Any]]:
    return [row for row in shards.episodes.to_pylist() if row["split"] == "val"][:count]


def real_frames(made: "Demo", shards: ShardSet, episode: str, picks: Any) -> Any:
    """The recording's own frames (n, S, S, 3), as the tokenizer saw them."""
    robot = find(shards.embodiment.id)
    source = open_source(robot.source.format)
    clip = to_clip(source.read(str(made.recordings[robot.id]), episode, robot), robot)
    camera = robot.primary_camera
    return prepare(
        clip.frames_at(camera.name, picks), camera, shards.spec.image_size, shards.spec.resize_filter
    )


def decoded(shards: ShardSet, episode_index: int, picks: Any) -> Any:
    """Frames (n, S, S, 3) decoded from an episode's tokens."""
    tokens = shards.tokens(shards.episode_rows(episode_index, ["tokens"])["tokens"])
    return tokenizer_of(shards).decode(tokens[picks])


def _mixture(page: Page, made: "Demo") -> None:
    assert made.mixture is not None
    page.section("The mixture", "Probability of a training sample, p ∝ windows^(1/τ) with τ = 3.")
    with TemporaryDirectory() as folder:
        path = Path(folder) / "mixture.svg"
        plot_mixture(made.mixture, 3.0, path)
        page.picture(path.read_bytes(), "svg+xml", "How often each robot is drawn", plot=True)


def _training(page: Page, made: "Demo") -> None:
    result = made.training
    page.section("Training")
    validation = [(line["step"], line["loss"]) for line in result.evaluations if "loss" in line]
    if result.masked_val_loss is not None:
        page.table(
            ["held-out loss", "nats a token"],
            [
                ["this model, whole frames masked", result.masked_val_loss],
                ["token frequencies alone", result.baseline],
            ],
        )
    caption = "Loss over training; the dotted line is what a model reaches that looks at nothing"
    page.picture(loss_curve(result.losses, validation, result.baseline), "svg+xml", caption, plot=True)


def _rollouts(page: Page, made: "Demo") -> None:
    page.section(
        "Rollouts on held-out episodes",
        "The model, pulled from the hub for one robot alone, sees the first frames and the actions, and goes "
        "on from its own predictions. With another window's actions it should do worse: the loss "
        "shows it, PSNR after so short a training hardly, because the disc covers few pixels.",
    )
    for robot, shards in made.sets.items():
        film = made.films[robot]
        caption = f"{robot}: truth, prediction with the true actions, with another window's; actions as bars"
        page.picture(webp_bytes(film.frames, film.fps), "webp", caption)
        found = made.figures[robot]
        curves = {
            "true actions": found["true"]["psnr_by_frame"],
            "shuffled actions": found["shuffled"]["psnr_by_frame"],
            "last seen frame repeated": found["copy"]["psnr_by_frame"],
        }
        about = f"mean of {found['windows']} held-out windows, against {found['against']}"
        caption = f"{robot}: PSNR over the horizon, {about}"
        plot = psnr_over_horizon(curves, 1 / shards.embodiment.effective_hz)
        page.picture(plot, "svg+xml", caption, plot=True)
    names = [
        "robot",
        "loss",
        "with other actions",
        "baseline",
        "perplexity",
        "PSNR dB",
        "PSNR last",
        "shuffled last",
        "copy last",
        "SSIM",
    ]
    rows = [
        [
            robot,
            *(found[key] for key in ("loss", "shuffled_loss", "baseline_loss", "perplexity")),
            found["true"]["psnr"],
            *(found[key]["psnr_last"] for key in ("true", "shuffled", "copy")),
            found["true"]["ssim"],
        ]
        for robot, found in made.figures.items()
    ]
    page.table(names, rows)


def _accounts(page: Page, made: "Demo") -> None:
    page.section("Sizes and timings")
    page.table(["what", "size"], [[name, human_bytes(size)] for name, size in made.sizes.items()])
    page.table(["stage", "wall time"], [[name, human_seconds(s)] for name, s in made.seconds.items()])
