"""Define the commands `hma train` and `hma finetune`, and those of `hma recipe`."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from hma_data.cli.options import Json, recipes
from hma_data.cli.shards import refuse_early
from hma_data.console import human_seconds, interruptible, print_json, print_table, say
from hma_data.errors import UsageError

if TYPE_CHECKING:
    from hma_model.training.loop import TrainResult

Words = Annotated[
    list[str] | None,
    Argument(metavar="DATA|KEY=VALUE", help="Shard sets, and recipe keys such as model.layers=4."),
]
Out = Annotated[Path | None, Option(help="The run's folder; required, here or as out=DIR.")]
Force = Annotated[bool, Option("--force", help="Resume even if the recipe or the shards changed.")]
MODELS = "Models"  # the panel of `hma --help`
STOPPED = "the run's checkpoints are kept; the same command continues from the newest"
recipe_app = typer.Typer(no_args_is_help=True, help="List and show training recipes.")


def mount(app: typer.Typer) -> None:
    """Add the verbs to the command."""
    app.command("train", rich_help_panel=MODELS)(train)
    app.command("finetune", rich_help_panel=MODELS)(finetune)


def train(
    recipe: Annotated[str, Argument(help="A recipe: name or YAML file.", autocompletion=recipes)],
    words: Words = None,
    out: Out = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Train a model on shard sets; run it again to resume.

    On several GPUs: torchrun --nproc-per-node N --no-python hma train …

    Example: hma train discrete_tiny shards/my_arm steps=500 --out runs/first
    """
    folders, overrides = _parted(words)
    if folders:
        overrides.insert(0, _data(folders))
    _refuse_early(recipe, overrides)
    with interruptible(lambda: STOPPED):
        from hma_model.training.loop import train as run
        from hma_model.training.parallel import report_once
        from hma_model.training.recipe import load_recipe

        with report_once():
            result = run(load_recipe(recipe, overrides), out=out, force=force)
    _tell(result, json)


def _parted(words: list[str] | None) -> tuple[list[str], list[str]]:
    """Divide words into shard sets and KEY=VALUE; a folder here may have an equals sign in its name."""
    folders = [word for word in words or () if "=" not in word or Path(word).expanduser().is_dir()]
    return folders, [word for word in words or () if word not in folders]


def _data(folders: list[str]) -> str:
    return f"data={folders}"  # as YAML has a list of texts


def unknown_option(option: str) -> str:
    """Return how to write an option that is a key of recipes; empty if it is none."""
    from hma_model.training.recipe import Recipe

    key = option.lstrip("-").partition("=")[0].replace("-", "_")
    return f"write {key}=VALUE" if key.partition(".")[0] in Recipe.model_fields else ""


def _refuse_early(recipe: str, overrides: list[str]) -> None:
    """Refuse a wrong recipe, or a folder without shards, before torch is imported.

    Under torchrun nothing is refused here: of all ranks, `report_once` lets only one report.
    """
    if "RANK" in os.environ:
        return
    from hma_model.training.recipe import load_recipe

    refuse_early(load_recipe(recipe, overrides).data)


def finetune(
    source: Annotated[
        str, Option("--from", help="A checkpoint, a run's folder, a URI, or ORG/NAME[@REVISION].")
    ],
    words: Words = None,
    data: Annotated[list[str] | None, Option(help="One shard set, as in DATA; repeatable.")] = None,
    freeze_trunk: Annotated[
        bool, Option("--freeze-trunk", help="Train only stems and heads; keep the trunk as it is.")
    ] = False,
    recipe: Annotated[
        str | None,
        Option(help="Recipe name or YAML file; default: finetune, or that of a bundled model."),
    ] = None,
    out: Out = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Finetune a checkpoint on new robots: their stems and heads, and the trunk; run it again to resume.

    Example: hma finetune shards/my_arm --from team/model --freeze-trunk --out runs/my_arm
    """
    named, overrides = _parted(words)
    folders = [*(data or ()), *named]
    if not folders:
        raise UsageError("hma finetune", "names no shard set", "write hma finetune DATA… --from CHECKPOINT")
    options: dict[str, Any] = {"out": out, "freeze_trunk": freeze_trunk, "recipe": recipe, "force": force}
    from hma_model.training.recipe import recipe_for

    _refuse_early(recipe or recipe_for(source, folders[0]), [_data(folders), *overrides])
    with interruptible(lambda: STOPPED):
        from hma_model.training.loop import finetune as run
        from hma_model.training.parallel import report_once

        with report_once():
            result = run(source, folders, overrides=overrides, **options)
    _tell(result, json)


def _tell(result: "TrainResult", json: bool) -> None:
    """Print the result on rank 0, and exit."""
    facts = {
        "out": str(result.out),
        "checkpoint": str(result.checkpoint),
        "step": result.step,
        "held_out_loss": result.masked_val_loss,
        "baseline": result.baseline,
        "seconds": result.seconds,
        "skipped_steps": result.skipped,
        "interrupted": result.interrupted,
    }
    if os.environ.get("RANK", "0") == "0":
        if json:
            print_json(facts)
        else:
            _print(result)
    raise typer.Exit(130 if result.interrupted else 0)


def _print(result: "TrainResult") -> None:
    done = f"step {result.step:,}, {human_seconds(result.seconds)}"
    say(f"{result.out}: {done}, checkpoint {result.checkpoint}")
    found, base = result.masked_val_loss, result.baseline
    if found is not None and base is not None:
        from hma_model.checkpoint.folder import Checkpoint
        from hma_model.config import token_words

        unit = token_words(Checkpoint.open(result.checkpoint).config.merge)
        say(f"held-out loss {found:.4f} nats per {unit}; baseline (token frequencies) {base:.4f}")
    if result.skipped:
        say(f"{result.skipped} steps were skipped; see skipped in {result.out}/metrics.jsonl")
    if (result.out / "report.html").is_file():
        say(f"open {result.out}/report.html")


# -- hma recipe


@recipe_app.command("list")
def recipe_list(json: Json = False) -> None:
    """List the bundled recipes.

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
        print_table(["recipe", "steps", "windows per step", "about"], [list(one.values()) for one in found])


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
        say(f"# change a key on the command line: hma train {name} DATA… steps=10 model.layers=4")
