"""The data verbs of `hma`: mixture; the others in modules of their own.

Only what is light is imported here; each verb imports what it needs.
"""

from pathlib import Path
from typing import Annotated

import typer

from hma_data.cli_bench import bench
from hma_data.cli_convert import convert
from hma_data.cli_inspect import doctor, inspect
from hma_data.cli_registry import registry_app
from hma_data.cli_shards import shards_app
from hma_data.cli_tokenizer import tokenizer_app
from hma_data.console import print_json, print_table

Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]


def mount(app: typer.Typer) -> None:
    """Add every data verb to the command."""
    app.add_typer(registry_app, name="registry")
    app.command("inspect")(inspect)
    app.command("doctor")(doctor)
    app.command("convert")(convert)
    app.add_typer(shards_app, name="shards")
    app.command("mixture")(mixture)
    app.add_typer(tokenizer_app, name="tokenizer")
    app.command("bench")(bench)


# -- mixture


def mixture(
    folders: Annotated[list[Path], typer.Argument(help="Shard sets.")],
    temperature: Annotated[
        float, typer.Option("--temperature", help="τ: 1 proportional, large uniform.")
    ] = 3.0,
    frames: Annotated[int, typer.Option("--frames", min=2, help="T of a window.")] = 12,
    split: Annotated[str, typer.Option("--split", help="train or val.")] = "train",
    plot: Annotated[Path | None, typer.Option("--plot", help="PNG or SVG to draw.")] = None,
    json: Json = False,
) -> None:
    """How often each embodiment is drawn.

    Example: hma mixture shards/a shards/b --plot mixture.png
    """
    from hma_data.loader import open_sets
    from hma_data.mixture import Mixture
    from hma_data.windows import WindowIndex

    sets = open_sets(list(folders))
    indexes = {name: WindowIndex.of(shards, split, frames) for name, shards in sets.items()}
    mix = Mixture.of({name: index.count for name, index in indexes.items()}, temperature)
    total = sum(mix.counts)
    rows = [
        {
            "embodiment": name,
            "windows": count,
            "short_episodes": indexes[name].short_episodes,
            "proportional": count / total,
            "probability": float(p),
        }
        for name, count, p in zip(mix.names, mix.counts, mix.p)
    ]
    if plot:
        from hma_data.plots import plot_mixture

        plot_mixture(mix, temperature, plot)
    if json:
        print_json({"temperature": temperature, "frames": frames, "split": split, "embodiments": rows})
    else:
        print_table(
            ["embodiment", "windows", "episodes too short", "proportional", f"p at τ = {temperature:g}"],
            [list(r.values()) for r in rows],
        )
