"""Define the verbs of `hma recipe`: the recipes that come along, and the keys of one."""

from typing import Annotated

import typer
from typer import Argument

from hma_data.cli.options import Json, recipes
from hma_data.console import print_json, print_table

recipe_app = typer.Typer(no_args_is_help=True, help="List the recipes of training, and show one.")


@recipe_app.command("list")
def recipe_list(json: Json = False) -> None:
    """List the recipes that come with the toolkit.

    Example: hma recipe list
    """
    from hma_model.training.recipe import find_recipe, load_recipe

    found = []
    for name in recipes(""):
        comment = [line[2:] for line in find_recipe(name).read_text("utf-8").splitlines() if line[:2] == "# "]
        about = " ".join(comment).partition(". ")[0].removesuffix(".")
        values = load_recipe(name)
        found.append({"recipe": name, "steps": values.steps, "batch": values.batch_size, "about": about})
    if json:
        print_json(found)
    else:
        print_table(["recipe", "steps", "windows a step", "about"], [list(one.values()) for one in found])


@recipe_app.command("show")
def recipe_show(
    name: Annotated[str, Argument(help="A recipe: name or YAML file.", autocompletion=recipes)],
    json: Json = False,
) -> None:
    """Show every key of a recipe with its value, as `hma train` takes it.

    Example: hma recipe show discrete_tiny
    """
    from hma_data.storage.yaml_io import write_yaml
    from hma_model.training.recipe import load_recipe

    values = load_recipe(name).values()
    if json:
        print_json(values)
    else:
        print(write_yaml(values), end="")
        print(f"# change a key on the command line: hma train {name} DATA… steps=10 model.layers=4")
