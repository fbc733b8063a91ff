"""Offer the data verbs of `hma`, one module a verb or a group of verbs.

Only light modules are imported here. Each verb imports what it needs when it runs.
"""

from typing import Annotated

import typer
from typer import Argument, Option

from hma_data.cli.convert import convert
from hma_data.cli.inspect import doctor, inspect
from hma_data.cli.mixture import mixture
from hma_data.cli.registry import registry_app
from hma_data.cli.shards import shards_app
from hma_data.cli.tokenizer import tokenizer_app
from hma_data.console import print_json, print_table

Json = Annotated[bool, Option("--json", help="Print JSON.")]


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


def bench(
    name: Annotated[str | None, Argument(help="Which one; all are listed without it.")] = None,
    settings: Annotated[list[str] | None, Argument(metavar="[KEY=VALUE]...", help="Its settings.")] = None,
    json: Json = False,
) -> None:
    """Run a benchmark on generated data; nothing is downloaded.

    Example: hma bench loader frames=1000000 --json
    """
    from hma_data.bench import BENCHES, load, report, settings_of

    if name is None:
        benches = {known: load(known) for known in sorted(BENCHES)}
        if json:
            print_json({known: {"about": b.about, "settings": b.defaults} for known, b in benches.items()})
            return
        rows = [
            [known, b.about, " ".join(f"{key}={value}" for key, value in b.defaults.items())]
            for known, b in benches.items()
        ]
        print_table(["bench", "about", "settings"], rows)
        return
    chosen = load(name)
    values = settings_of(chosen, name, settings or [])
    results = chosen.run(values)
    told = report(name, values, results)
    if json:
        print_json(told)
        return
    columns = list(dict.fromkeys(key for result in results for key in result))
    print_table(columns, [[result.get(key) for key in columns] for result in results], title=chosen.about)
    facts = told["machine"]
    print(f"{facts['processor']}, {facts['cores']} cores, load {facts['load_average']}, {facts['date']}")
