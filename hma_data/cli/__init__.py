"""Offer the data verbs of `hma`, one module a verb or a group of verbs.

Only light modules are imported here. Each verb imports what it needs when it runs.
"""

from typing import Annotated

import typer
from typer import Argument, Exit

from hma_data.cli.convert import convert
from hma_data.cli.inspect import doctor, inspect
from hma_data.cli.mixture import mixture
from hma_data.cli.options import Json
from hma_data.cli.registry import registry_app
from hma_data.cli.shards import shards_app
from hma_data.cli.tokenizer import tokenizer_app
from hma_data.console import human_count, print_json, print_table, say
from hma_data.storage.paths import recipe_module

DATA = "Recordings and shards"  # the panel of `hma --help`


def mount(app: typer.Typer) -> None:
    """Add every data verb to the command."""
    for verb in (inspect, doctor, convert, mixture):
        app.command(rich_help_panel=DATA)(verb)
    app.add_typer(registry_app, name="registry", rich_help_panel=DATA)
    app.add_typer(shards_app, name="shards", rich_help_panel=DATA)
    app.add_typer(tokenizer_app, name="tokenizer", rich_help_panel=DATA)
    app.command()(bench)


def bench(
    name: Annotated[str | None, Argument(help="Benchmark; default: list all.")] = None,
    settings: Annotated[list[str] | None, Argument(metavar="KEY=VALUE", help="Benchmark settings.")] = None,
    json: Json = False,
) -> None:
    """Measure the speed and quality of the toolkit on generated data.

    Example: hma bench loader frames=1000000 --json
    """
    harness = recipe_module("harness")
    if name is None:
        benches = {known: harness.load(known) for known in sorted(harness.BENCHES)}
        if json:
            print_json({known: {"about": b.about, "settings": b.defaults} for known, b in benches.items()})
            return
        rows = [
            [known, b.about, " ".join(f"{key}={value}" for key, value in b.defaults.items())]
            for known, b in benches.items()
        ]
        print_table(["bench", "about", "settings"], rows)
        return
    chosen = harness.load(name)
    values = harness.settings_of(chosen, name, settings or [])
    results = chosen.run(values)
    told = harness.report(name, values, results)
    if json:
        print_json(told)
    else:
        columns = list(dict.fromkeys(key for result in results for key in result))
        print_table(columns, [[result.get(key) for key in columns] for result in results], title=chosen.about)
        facts = told["machine"]
        cores = human_count(facts["cores"], "core")
        say(f"{facts['processor']}, {cores}, load {facts['load_average']}, {facts['date']}")
    if fault := chosen.fault(results):
        say(fault, err=True)
        raise Exit(1)
