"""The data verbs of `hma`, each in a module of its own.

Only what is light is imported here; each verb imports what it needs.
"""

from typing import Annotated

import typer

from hma_data.cli_bench import bench
from hma_data.cli_convert import convert
from hma_data.cli_inspect import doctor, inspect
from hma_data.cli_mixture import mixture
from hma_data.cli_registry import registry_app
from hma_data.cli_shards import shards_app
from hma_data.cli_tokenizer import tokenizer_app

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
