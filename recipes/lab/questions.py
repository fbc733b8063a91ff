"""Ask the questions of the paper's figures and tables at laboratory scale, with seeds and intervals.

    python recipes/lab/questions.py table34 build/questions
    python recipes/lab/questions.py fig6 build/questions --seeds 3 --cpu-seconds 120
    python recipes/lab/questions.py fig6 build/questions --table       # print the table of what is there

A question is a set of rows; all are trained for the same CPU seconds of one thread and measured on the same
held-out windows. Each run appends a line to OUT/<question>.csv; runs that are there are not repeated, so the
same command continues. OUT/<question>.md and .svg have the means over the seeds with 95 % intervals of
Student's t. The robots are recorded into OUT/data where --data names no folder of shard sets (DATA/<robot>).

What a row measures, besides the steps and the held-out loss (nats a token; not comparable between kinds):

    psnr_last, gain     dB of a rollout's last frame, six frames from two; that minus the PSNR with
                        shuffled actions
    seconds_a_frame     CPU seconds of a generated frame on one thread, batch 1, without decoding
    error_px, psnr_star, perplexity_star    table34: as `hma evaluate --state` has them
"""

import argparse
import csv
import statistics
import tempfile
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from hma_data.console import run_script
from hma_data.lab.family import TRUNK
from hma_data.shards.reader import ShardSet
from hma_data.storage.files import write_atomic
from hma_data.storage.paths import recipe_module

quality = recipe_module("quality")
FRAMES, PLAIN, PROMPT, recorded = quality.FRAMES, quality.PLAIN, quality.PROMPT, quality.recorded
WINDOWS, DRAWS, STATES = 16, 2, 16
NEW = "arm3_55"  # a robot that the embedded trunk has not seen
ROBOTS = ("rails_03", *(name for name in TRUNK if name not in ("rails_03", "arm3_04")))
NETWORK = ("steps=1000000", "lr_end=0.02")
FIGURES = {
    "steps": 0, "loss": 3, "psnr_last": 2, "gain": 2, "error_px": 1, "psnr_star": 2,
    "perplexity_star": 1, "seconds_a_frame": 4, "parameters": 0,
}  # fmt: skip


@dataclass(frozen=True)
class Row:
    """One answer to a question.

    Attributes:
        overrides: of the recipe.
        robot: it is trained and measured on.
        episodes: of that robot's recording.
        before: robots that the model is trained on before, for as long; the trunk is then tuned.
        kind: hma, or dit, the baseline.
        state: whether the robot's place is measured.
    """

    name: str
    overrides: tuple[str, ...] = NETWORK
    robot: str = "rails_03"
    tokenizer: str = "fsq-lab"
    recipe: str = "discrete_tiny"
    episodes: int = 60
    before: tuple[str, ...] = ()
    kind: str = "hma"
    state: bool = False


def _objectives(name: str, text: str) -> Row:
    return Row(name, (*NETWORK, f"objectives={text}"))


def _conditioning(*names: str) -> Row:
    return Row(" + ".join(names), (*NETWORK, f"model.conditioning=[{', '.join(names)}]"))


OURS = (
    Row("discrete tokens, HMA"),
    Row("soft tokens, HMA", tokenizer="vae-8", recipe="continuous_tiny"),
)
# what starts from the embedded trunk has its network; so has what is trained from scratch beside it
SAME = ("model.shared_modulation=true", "model.told_noise=true", "model.digit_order=chain")
QUESTIONS: dict[str, tuple[Row, ...]] = {
    "fig5a": (
        _objectives("dynamics (forward)", "{forward: 1}"),
        _objectives("full (video and actions)", "{full: 1}"),
        _objectives("dynamics and passive", "{forward: 1, passive: 1}"),
        _objectives("passive", "{passive: 1}"),
    ),
    "fig5b": (
        _conditioning("modulation"),
        _conditioning("concat"),
        _conditioning("add"),
        _conditioning("cross_attention"),
        _conditioning("concat", "modulation"),
    ),
    "fig6": (
        *(
            Row(f"{count} robot{'s' if count > 1 else ''} before", robot=NEW, before=ROBOTS[:count])
            for count in (1, 4, 16)
        ),
        *(Row(f"{count} episodes", episodes=count) for count in (15, 60, 240)),
        *(Row(f"width {width}", (*NETWORK, f"model.width={width}")) for width in (64, 128, 256)),
    ),
    "table1": (*OURS, Row("full-sequence diffusion transformer", tokenizer="vae-8", kind="dit")),
    "table2": OURS,
    "table34": (
        Row("from scratch", (*NETWORK, *SAME), robot=NEW, state=True),
        Row("pre-trained trunk", ("start=embedded", *NETWORK), robot=NEW, state=True),
        Row("pre-trained trunk, frozen", ("start=embedded", "freeze=trunk", *NETWORK), NEW, state=True),
    ),
}  # fmt: skip


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


class Shards:
    """The shard sets of a run of this script: those of --data, or recorded ones."""

    def __init__(self, out: Path, given: Path | None) -> None:
        self.out, self.given = out, given

    def of(self, robot: str, tokenizer: str, episodes: int = Row.episodes, own: bool = False) -> Path:
        """Return the folder of a robot's shards; with `own`, not one of --data."""
        given = None if own or self.given is None else self.given / robot
        if given and given.is_dir() and ShardSet(given).spec.name == tokenizer:
            return given
        return recorded(robot, tokenizer, self.out / "data" / f"{robot}-{tokenizer}-{episodes}", episodes)

    def pair(self, question: str, row: Row) -> tuple[Path, Path]:
        """Return the shards that a row is trained on, and those whose held-out windows it is measured on.

        Rows that differ in the number of episodes are measured on the largest recording. An episode is held
        out by the hash of its id, so it is also held out in the smaller recordings of the same settings.
        """
        same = (row.robot, row.tokenizer)
        sizes = {other.episodes for other in QUESTIONS[question] if (other.robot, other.tokenizer) == same}
        own = len(sizes) > 1
        return self.of(*same, row.episodes, own), self.of(*same, max(sizes), own)


def measure(question: str, row: Row, seed: int, cpu_seconds: float, shards: Shards) -> dict[str, Any]:
    """Train a row and return its line of the CSV."""
    data, measured = shards.pair(question, row)
    held_out = ShardSet(measured)
    with tempfile.TemporaryDirectory() as folder:
        if row.kind == "dit":
            model, steps = _baseline(ShardSet(data), cpu_seconds, seed)
        else:
            start: tuple[str, ...] = ()
            if row.before:
                first = [shards.of(robot, row.tokenizer) for robot in row.before]
                checkpoint, _ = _trained(row, first, cpu_seconds, seed, Path(folder) / "before")
                start = (f"start={checkpoint}",)
            checkpoint, steps = _trained(row, [data], cpu_seconds, seed, Path(folder) / "run", start)
            from hma_model.network.model import HMA

            model = HMA.from_pretrained(checkpoint).eval()
        found = _scores(model, held_out, row)
    return {"row": row.name, "seed": seed, "cpu_seconds": cpu_seconds, "steps": steps, **found}


def _trained(
    row: Row, data: list[Path], cpu_seconds: float, seed: int, out: Path, start: tuple[str, ...] = ()
) -> tuple[Path, int]:
    from hma_model.training.loop import train
    from hma_model.training.recipe import load_recipe

    names = ", ".join(str(folder.resolve()) for folder in data)
    own = [f"data=[{names}]", f"seed={seed}", f"cpu_seconds={cpu_seconds}"]
    overrides = [word for word in row.overrides if not (start and word.startswith("model."))]
    result = train(load_recipe(row.recipe, [*PLAIN, *overrides, *start, *own]), out=out, show=False)
    if result.interrupted:
        raise SystemExit(f"{row.name}, seed {seed}: stopped by a signal; the run does not count")
    return result.checkpoint, result.step


def _baseline(shards: ShardSet, cpu_seconds: float, seed: int) -> tuple[Any, int]:
    import torch
    from dit import DiT, train

    torch.manual_seed(seed)
    return train(DiT(shards, frames=FRAMES), shards, cpu_seconds, seed)


def _scores(model: Any, shards: ShardSet, row: Row) -> dict[str, Any]:
    """Return the figures of a trained model; None where one is not measured."""
    from hma_data.tokenizers.base import reopened
    from hma_model.evaluation.losses import validation_losses, windows
    from hma_model.evaluation.perceptual import FeatureCollector, Networks
    from hma_model.evaluation.rollouts import rollout
    from hma_model.evaluation.scores import Rolled, combined
    from hma_model.evaluation.simulated import measure_state

    tokenizer = reopened(shards.spec.to_json())
    batches = list(windows(shards, "val", FRAMES, WINDOWS))
    rolled = Rolled(PROMPT, FeatureCollector(Networks()))
    for number, batch in enumerate(batches):
        rolled.add(batch, partial(rollout, model, tokenizer, prompt=PROMPT, seed=number), DRAWS, seed=0)
    last = {kind: float(combined(parts)["psnr"][:, -1].mean()) for kind, parts in rolled.scores.items()}
    found: dict[str, Any] = {
        "loss": validation_losses(model, batches)[0].mean() if row.kind == "hma" else None,
        "psnr_last": last["true"],
        "gain": last["true"] - last["shuffled"],
        "copy": last["copy"],
        "seconds_a_frame": _seconds(model, batches[0]),
        "parameters": sum(weights.numel() for weights in model.parameters()),
    }
    state: dict[str, Any] = {}
    if row.state:
        state = measure_state(model, tokenizer, row.robot, frames=FRAMES, prompt=PROMPT, episodes=STATES)
    noisy = state.get("perturbed", {})
    return found | {
        "error_px": state["true"]["error_px_last"] if state else None,
        "psnr_star": noisy.get("psnr_star"),
        "perplexity_star": noisy.get("perplexity_star"),
    }


def _seconds(model: Any, batch: Any, repeats: int = 5) -> float:
    """Return the CPU seconds of a generated frame, batch 1: the least of some rollouts after a warm-up."""
    stored = batch.tokens if model.config.kind == "discrete" else batch.latents
    given, actions, took = stored[:1, :PROMPT], batch.actions[:1], []
    for _ in range(1 + repeats):
        begun = time.process_time()
        model.generate(given, actions, batch.embodiment[:1], FRAMES - PROMPT)
        took.append((time.process_time() - begun) / (FRAMES - PROMPT))
    return min(took[1:])


# -- table and plot


def interval(values: list[float]) -> tuple[float, float | None]:
    """Return the mean of values and half its 95 % interval; None for a single value."""
    if len(values) < 2:
        return values[0], None
    return statistics.mean(values), stats.t.ppf(0.975, len(values) - 1) * statistics.stdev(values) / len(
        values
    ) ** 0.5


def summary(lines: list[dict[str, Any]]) -> dict[str, dict[str, tuple[float, float | None]]]:
    """Return for each row the intervals of its figures; figures that were not measured are left out."""
    found = {}
    for row in dict.fromkeys(line["row"] for line in lines):
        own = [line for line in lines if line["row"] == row]
        given = {key: [float(line[key]) for line in own if line.get(key)] for key in FIGURES}
        found[row] = {key: interval(values) for key, values in given.items() if values}
    return found


def by_budget(lines: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the lines; where they are of several budgets, their rows say which, and are never averaged."""
    if len({line["cpu_seconds"] for line in lines}) < 2:
        return lines
    return [line | {"row": f"{line['row']}, {float(line['cpu_seconds']):g} CPU s"} for line in lines]


def _said(line: dict[str, Any]) -> str:
    """Return what a run found, in words."""
    found = [
        f"{key.replace('_', ' ')} {float(line[key]):,.{digits}f}"
        for key, digits in FIGURES.items()
        if line.get(key) not in (None, "")
    ]
    return f"{line['row']}, seed {line['seed']}, {line['cpu_seconds']:g} CPU s: {', '.join(found)}"


def table(lines: list[dict[str, Any]]) -> str:
    """Return a Markdown table: a row of the question a line, means over its seeds ± half the interval."""
    rows = summary(lines)
    present = [key for key in FIGURES if any(key in figures for figures in rows.values())]
    text = [
        f"| | seeds | {' | '.join(key.replace('_', ' ') for key in present)} |",
        "|" + "---|" * (2 + len(present)),
    ]
    for name, figures in rows.items():
        cells = [_cell(figures[key], FIGURES[key]) if key in figures else "" for key in present]
        seeds = sum(line["row"] == name for line in lines)
        text.append(f"| {name} | {seeds} | {' | '.join(cells)} |")
    return "\n".join(text)


def _cell(found: tuple[float, float | None], digits: int) -> str:
    mean, half = found
    return f"{mean:,.{digits}f}" + ("" if half is None else f" ± {half:,.{digits}f}")


def plot(question: str, lines: list[dict[str, Any]]) -> bytes:
    """Return an SVG of the gain and of the last frame's PSNR of each row, with intervals."""
    from matplotlib.figure import Figure

    from hma_model.evaluation.plots import label_axes, svg_bytes

    rows = summary(lines)
    figure = Figure(figsize=(7.2, 1.2 + 0.35 * len(rows)), layout="constrained")
    places = np.arange(len(rows))[::-1]
    titles = {
        "gain": "gain, recorded vs shuffled actions, dB",
        "psnr_last": "PSNR of the last frame, dB",
    }
    for axes, (key, title) in zip(figure.subplots(1, 2, sharey=True), titles.items(), strict=True):
        means, halves = zip(*(rows[name][key] for name in rows), strict=True)
        axes.errorbar(means, places, xerr=[half or 0 for half in halves], fmt="o", color="#0072b2", capsize=3)
        label_axes(axes, title)
        axes.set_yticks(places, list(rows))
    figure.suptitle(question)
    return svg_bytes(figure)


def main() -> None:
    """Train what is missing of a question, and write its table and its plot."""
    parser = argparse.ArgumentParser(description="Ask a question of the paper at laboratory scale")
    parser.add_argument("question", choices=list(QUESTIONS))
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--cpu-seconds", type=float, default=120, help="of a training, one thread")
    parser.add_argument("--data", type=Path, help="a folder of shard sets, DATA/<robot>")
    parser.add_argument("--rows", nargs="+", help="only these")
    parser.add_argument("--table", action="store_true", help="only write the table and plot of what is there")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / f"{given.question}.csv"
    if not given.table:
        import torch

        torch.set_num_threads(1)
        shards, budget = Shards(given.out, given.data), given.cpu_seconds
        done = [(line["row"], line["seed"], line["cpu_seconds"]) for line in read(path)]
        rows = [row for row in QUESTIONS[given.question] if not given.rows or row.name in given.rows]
        asked = [(seed, row) for seed in range(given.seeds) for row in rows]
        missing = [(seed, row) for seed, row in asked if (row.name, str(seed), str(budget)) not in done]
        begun = time.monotonic()
        for number, (seed, row) in enumerate(missing, 1):
            line = measure(given.question, row, seed, budget, shards)
            append(path, line)
            minutes = (time.monotonic() - begun) / number * (len(missing) - number) / 60
            print(f"{number}/{len(missing)}, {minutes:.0f} min left: {_said(line)}", flush=True)
    lines = by_budget(read(path))
    if not lines:
        raise SystemExit(f"{path}: has no line yet; run without --table")
    write_atomic(path.with_suffix(".md"), table(lines) + "\n")
    write_atomic(path.with_suffix(".svg"), plot(given.question, lines))
    print(table(lines))


if __name__ == "__main__":
    run_script(main)
