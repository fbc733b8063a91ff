"""Run `hma mixture`: show how often each embodiment is drawn, as a table and a plot."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from typer import Argument, Option

from hma_data.cli.options import Json, pairs
from hma_data.cli.shards import refuse_early
from hma_data.console import print_json, print_table, say
from hma_data.errors import UsageError

if TYPE_CHECKING:
    from hma_data.loading.mixture import Mixture
    from hma_data.shards.windows import WindowIndex

Pairs = list[str] | None
_share = partial(Option, rich_help_panel="Weights, groups and caps")


def mixture(
    folders: Annotated[list[str], Argument(help="Shard sets.")],
    temperature: Annotated[
        float | None, Option(help="τ: 1 is proportional to set size, larger is flatter; default 3 (val: 4).")
    ] = None,
    frames: Annotated[int, Option(min=1, help="Frames T per window.")] = 12,
    split: Annotated[Literal["train", "val"], Option(help="Split to draw from.")] = "train",
    short: Annotated[
        Literal["drop", "pad"], Option(help="Rule for episodes shorter than a window.")
    ] = "drop",
    weight: Annotated[
        Pairs,
        _share(
            metavar="NAME=FACTOR",
            help="Multiply the probability of an embodiment or group; repeatable.",
        ),
    ] = None,
    group: Annotated[
        Pairs, _share(metavar="ID=GROUP", help="Put an embodiment into a group; groups get equal shares.")
    ] = None,
    cap: Annotated[Pairs, _share(metavar="ID=SHARE", help="Maximum probability of an embodiment.")] = None,
    max_epochs: Annotated[float | None, _share(help="Maximum number of passes over one set.")] = None,
    samples: Annotated[
        int | None, Option(min=1, help="Windows to draw in total; default: as many as there are.")
    ] = None,
    plot: Annotated[Path | None, Option(help="Plot file: PNG, SVG or PDF.")] = None,
    json: Json = False,
) -> None:
    """Show how often each embodiment is drawn when a model trains on several shard sets.

    Example: hma mixture shards/a shards/b --temperature 3 --plot mixture.png
    """
    if plot and plot.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise UsageError("--plot", f"must end in .png, .svg or .pdf, is {plot}")
    refuse_early(folders)
    from hma_data.loading.dataset import open_sets
    from hma_data.loading.mixture import TEMPERATURES, Mixture, plot_mixture
    from hma_data.shards.windows import WindowIndex

    tau = TEMPERATURES[split] if temperature is None else temperature
    sets = open_sets(folders)
    indexes = {name: WindowIndex.of(shards, split, frames, short=short) for name, shards in sets.items()}
    counts = {name: index.count for name, index in indexes.items()}
    planned = samples or max(1, sum(counts.values()))
    mix = Mixture.of(
        counts,
        tau,
        weights=_numbers("--weight", weight),
        groups=pairs("--group", group or [], "NAME=VALUE"),
        caps=_numbers("--cap", cap),
        max_epochs=max_epochs,
        samples=planned,
    )
    totals = {name: shards.manifest.splits.get(split, {}) for name, shards in sets.items()}
    rows = _rows(mix, indexes, totals, planned)
    if plot:
        plot_mixture(mix, tau, plot)
    if json:
        facts = {"temperature": "inf" if tau == float("inf") else tau, "frames": frames, "split": split}
        print_json({**facts, "samples": planned, "embodiments": rows})
        return
    columns = ["windows", "episodes", "too short", "frames", "proportional", f"p at τ = {tau:g}"]
    print_table(["embodiment", *columns, "p uniform", "epochs"], [list(row.values()) for row in rows])
    say(f"epochs: passes over a set's windows if {planned:,} samples are drawn in total")


def _rows(
    mix: "Mixture", indexes: dict[str, "WindowIndex"], totals: dict[str, dict[str, int]], samples: int
) -> list[dict[str, Any]]:
    present = sum(count > 0 for count in mix.counts)
    return [
        {
            "embodiment": name,
            "windows": count,
            "episodes": totals[name].get("episodes", 0),
            "short_episodes": indexes[name].short_episodes,
            "frames": totals[name].get("frames", 0),
            "proportional": count / max(1, sum(mix.counts)),
            "probability": float(p),
            "uniform": 1 / present if count else 0.0,
            "epochs": float(p) * samples / count if count else 0.0,
        }
        for name, count, p in zip(mix.names, mix.counts, mix.p, strict=True)
    ]


def _numbers(option: str, words: Pairs) -> dict[str, float]:
    numbers = {}
    for name, text in pairs(option, words or [], "NAME=VALUE").items():
        try:
            numbers[name] = float(text)
        except ValueError as fault:
            raise UsageError(option, f"{name}={text}: {text!r} is not a number") from fault
    return numbers
