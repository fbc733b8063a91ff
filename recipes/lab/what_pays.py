"""Train a small model with one change at a time, each for the same CPU seconds, and print what pays.

    python recipes/world/record.py build/lab --robots mover_10 --episodes 60
    python recipes/lab/what_pays.py build/lab/shards/mover_10 build/pays.csv --seeds 3
    python recipes/lab/what_pays.py build/lab/shards/mover_10 build/pays.csv --rows "told noise"
    python recipes/lab/what_pays.py --table build/pays.csv

A row is a set of overrides of recipes/lab/what_pays.yaml, or on shards of latents (`--tokenizer vae-8` of
record.py) of recipes/lab/what_pays_latents.yaml. Every run appends a line to the CSV; runs that are there are
not repeated. For each seed the base is trained first, then the other rows, so that a busy machine slows all
of them alike. Times are CPU seconds of one thread.

The loss is nats a square of 2×2 stored tokens, so that rows with other tokens of the trunk can be compared;
of latents it is the diffusion head's, and that with shuffled commands is not measured.
"""

import argparse
import csv
import math
import statistics
import tempfile
from pathlib import Path
from typing import Any

from hma_data.console import run_script
from hma_data.shards.reader import ShardSet
from hma_data.tokenizers.base import get_tokenizer

RECIPES = {
    "discrete": Path(__file__).with_suffix(".yaml"),
    "continuous": Path(__file__).with_name("what_pays_latents.yaml"),
}
FRAMES, PROMPT, WINDOWS, DRAWS = 8, 2, 24, 2  # of the rollouts; the same for every row

BASE = "base"
TOKENS: dict[str, list[str]] = {
    BASE: [],
    "the paper's form: masked windows": ["model.training_pass=window"],
    "a masked token begins as a learned vector": ["model.masked_input=learned"],
    "places begin at random": ["model.position_init=random"],
    "AdamW alone": ["optimizer=adamw"],
    "windows of 6": ["frames=6"],
    "windows of 12": ["frames=12"],
    "batch of 2": ["batch_size=2"],
    "batch of 8": ["batch_size=8"],
    "rates × 0.5": ["lr=7.5e-4", "muon_lr=0.01"],
    "rates × 2": ["lr=3e-3", "muon_lr=0.04"],
    "average 0.99": ["ema=0.99"],
    "average 0.995": ["ema=0.995"],
    "a quarter of the copies whole": ["model.whole_share=0.25"],
    "three quarters of the copies whole": ["model.whole_share=0.75"],
    "clean past": ["model.corrupt_max=0"],
    "past corrupted up to 0.2": ["model.corrupt_max=0.2"],
    "told noise": ["model.told_noise=true"],
    "told the first frame": ["model.told_first=true"],
    "digits of 512 and 64": ["digits=512"],
    "digit after digit": ["model.digit_order=chain"],
    "copies the frame before": ["model.copy_previous=true"],
    "copies the frame before, digit after digit": ["model.copy_previous=true", "model.digit_order=chain"],
    "waves, copies the frame before": ["model.action_waves=5", "model.copy_previous=true"],
    "waves, copies, batch of 2": ["model.action_waves=5", "model.copy_previous=true", "batch_size=2"],
    "waves of the commands": ["model.action_waves=5"],
    "waves of the commands, batch of 2": ["model.action_waves=5", "batch_size=2"],
    "16×16 tokens": ["model.merge=1"],
    "a tenth of the windows without commands": ["model.drop_commands=0.1"],
}
LATENTS: dict[str, list[str]] = {
    BASE: [],
    "the paper's form: masked windows": ["model.training_pass=window"],
    "a masked patch begins as a learned vector": ["model.masked_input=learned"],
    "places begin at random": ["model.position_init=random"],
    "AdamW alone": ["optimizer=adamw"],
    "without waves of the commands": ["model.action_waves=0"],
    "clean past": ["model.latent_noise=0"],
    "past with half the noise": ["model.latent_noise=0.25"],
    "batch of 8": ["batch_size=8"],
    "rates × 2": ["lr=3e-3", "muon_lr=0.04"],
    "patches of 2×2": ["model.patch=2"],
    "four noise levels a patch": ["model.diffusion_repeats=4"],
    "the noise as the target": ["model.diffusion_target=noise"],
    "all as the paper": [
        *("model.training_pass=window", "model.masked_input=learned", "model.position_init=random"),
        *("model.action_waves=0", "optimizer=adamw", "lr=1e-3", "batch_size=8"),
    ],
}
ROWS = {"discrete": TOKENS, "continuous": LATENTS}
# Rollouts of the same trained model by other means: a row, and the options of the rollouts.
ROLLOUTS: dict[str, dict[str, dict[str, Any]]] = {
    "told noise": {"told noise, and of its own frames 0.1": {"noise_level": 0.1}},
    "a tenth of the windows without commands": {
        "the same, guidance 1.5": {"guidance": 1.5},
        "the same, guidance 2.5": {"guidance": 2.5},
    },
}
FIGURES = ("loss", "shuffled_loss", "psnr_last", "copy", "shuffled")


def measure(data: Path, row: str, changes: list[str], seed: int) -> list[dict[str, Any]]:
    """Train one row on the shard set, and return its line of the CSV and those of its other rollouts."""
    from hma_model.evaluation.evaluate import evaluate
    from hma_model.network.model import HMA
    from hma_model.training.loop import train
    from hma_model.training.recipe import load_recipe

    shards = ShardSet(data)
    own = [f"data=[{data}]", f"seed={seed}", "device=cpu"]
    recipe = load_recipe(RECIPES[shards.spec.kind], [*changes, *own])
    tokenizer = get_tokenizer(shards.spec.name)
    given: dict[str, Any] = {"count": WINDOWS, "frames": FRAMES, "prompt": PROMPT, "draws": DRAWS}
    ways: dict[str, dict[str, Any]] = {row: {}, **ROLLOUTS.get(row, {})}
    with tempfile.TemporaryDirectory() as folder:
        result = train(recipe, out=Path(folder) / "run", show=False)
        if result.interrupted:
            raise SystemExit(f"{row}, seed {seed}: stopped by a signal; the run does not count")
        model = HMA.from_pretrained(result.checkpoint)
        found = {way: evaluate(model, tokenizer, shards, **given, **how) for way, how in ways.items()}
    square = (2 / model.config.merge) ** 2 if model.config.kind == "discrete" else 1.0
    return [
        {
            "row": way,
            "seed": seed,
            "steps": result.step,
            "loss": figures["loss"] * square,
            "shuffled_loss": figures.get("shuffled_loss", math.nan) * square,
            "psnr_last": figures["true"]["psnr_last"],
            "copy": figures["copy"]["psnr_last"],
            "shuffled": figures["shuffled"]["psnr_last"],
            "cpu_seconds": recipe.cpu_seconds,
        }
        for way, figures in found.items()
    ]


def append(path: Path, line: dict[str, Any]) -> None:
    """Add a line to the CSV; a new file gets a header."""
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, list(line))
        if new:
            writer.writeheader()
        writer.writerow(line)


def read(path: Path) -> list[dict[str, Any]]:
    """Return the lines of the CSV; none if there is no file."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def table(lines: list[dict[str, Any]]) -> str:
    """Return a Markdown table of the rows: means over the seeds ± their standard deviation."""
    head = "trained by | seeds | steps | loss | more with shuffled commands | PSNR, last frame | less copy"
    rows = [f"| {head} | true less shuffled |", "|" + "---|" * 8]
    for row in dict.fromkeys(line["row"] for line in lines):
        own = [{key: float(line[key]) for key in FIGURES} for line in lines if line["row"] == row]
        steps = statistics.mean(int(line["steps"]) for line in lines if line["row"] == row)
        cells = [
            spread([line["loss"] for line in own], 3),
            spread([line["shuffled_loss"] - line["loss"] for line in own], 3),
            spread([line["psnr_last"] for line in own], 2),
            spread([line["psnr_last"] - line["copy"] for line in own], 2),
            spread([line["psnr_last"] - line["shuffled"] for line in own], 2),
        ]
        rows.append(f"| {row} | {len(own)} | {steps:,.0f} | {' | '.join(cells)} |")
    return "\n".join(rows)


def spread(values: list[float], digits: int) -> str:
    """Return the mean of values ± their standard deviation; nothing of what was not measured."""
    if any(math.isnan(value) for value in values):
        return ""
    deviation = f" ± {statistics.stdev(values):.{digits}f}" if len(values) > 1 else ""
    return f"{statistics.mean(values):.{digits}f}{deviation}"


def main() -> None:
    """Train the rows asked for, and print the table."""
    parser = argparse.ArgumentParser(description="Measure what pays in training, in equal CPU seconds")
    parser.add_argument("data", type=Path, nargs="?", help="a shard set")
    parser.add_argument("csv", type=Path)
    parser.add_argument("--rows", nargs="+", help="names, by default all; the base is always there")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--set", nargs="+", default=[], help="key=value overrides of every row")
    parser.add_argument("--table", action="store_true", help="only print the table of the CSV")
    given = parser.parse_args()
    if not given.table:
        import torch

        torch.set_num_threads(1)
        rows = ROWS[ShardSet(given.data).spec.kind]
        names = dict.fromkeys([BASE, *(given.rows or rows)])
        for seed in range(given.seeds):
            for row in names:
                if not any(line["row"] == row and int(line["seed"]) == seed for line in read(given.csv)):
                    for line in measure(given.data, row, [*rows[row], *given.set], seed):
                        append(given.csv, line)
                        print(line, flush=True)
    print(table(read(given.csv)))


if __name__ == "__main__":
    run_script(main)
