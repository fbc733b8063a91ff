"""Run `hma tokenizer`: list, train and measure tokenizers."""

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from hma_data.cli.options import Json, Weights, pairs, robot_option, tokenizers
from hma_data.console import human_bytes, interruptible, print_json, print_table, say
from hma_data.errors import MissingDependencyError, RecipeError

tokenizer_app = typer.Typer(no_args_is_help=True, help="List, train and measure tokenizers.")
Device = Annotated[str, Option(help="Device of the network: cpu, cuda, mps.")]
Data = Annotated[list[str], Argument(help="Images, videos, folders of them, recordings, shard sets.")]
Robot = Annotated[str | None, robot_option("Robot of the recordings: id or YAML file.")]
Frames = Annotated[int, Option(min=1, help="Frames of each video or episode, evenly spaced.")]


@tokenizer_app.command("list")
def tokenizer_list(json: Json = False) -> None:
    """List the names that --tokenizer takes, with availability, sizes and licences.

    Example: hma tokenizer list
    """
    from hma_data.tokenizers.catalog import all_entries

    found, broken = all_entries()
    if json:
        print_json([entry.to_json() for entry in found])
    else:
        _print_list(found)
    for fault in broken:
        say(f"not listed: {fault}", err=True)
    raise typer.Exit(1 if broken else 0)


def _print_list(entries: list[Any]) -> None:
    rows = [
        [
            entry.name,
            entry.kind,
            f"{entry.image_size}²",
            f"{entry.grid[0]}×{entry.grid[1]}",
            entry.state(),
            f"{entry.weights}, {human_bytes(entry.size())}" if entry.size() else entry.weights,
            entry.licence,
            entry.description,
        ]
        for entry in entries
    ]
    print_table(["name", "kind", "image", "grid", "here", "weights", "licence", "description"], rows)


@tokenizer_app.command("train")
def tokenizer_train(
    recipe: Annotated[Path, Argument(help="A YAML of recipes/tokenizer.")],
    overrides: Annotated[list[str] | None, Argument(metavar="KEY=VALUE", help="Keys of the recipe.")] = None,
    out: Annotated[Path, Option(help="Output weights.")] = Path("tokenizer.safetensors"),
    device: Device = "cpu",
    workers: Annotated[int, Option(min=0, help="Threads that prefetch crops.")] = 0,
) -> None:
    """Train a tokenizer; run it again to continue.

    Example: hma tokenizer train recipes/tokenizer/fsq.yaml --out fsq.safetensors
    """
    from hma_data.storage.yaml_io import parse_yaml, read_yaml

    given = pairs("KEY=VALUE", overrides or [], "training.steps=100")
    changes = {key: parse_yaml(value, key, RecipeError) for key, value in given.items()}

    def kept() -> str:
        state = out.with_name(out.name + ".state")
        if not state.is_file():
            return "nothing is saved before step 100"
        return f"{state} holds the run up to its last report; the same command continues from there"

    read_yaml(recipe, RecipeError)  # a missing recipe is refused before torch is imported
    with interruptible(kept):
        from hma_data.tokenizers.training.train import train

        facts = train(recipe, out, changes, device=device, workers=workers, report=partial(say, err=True))
    print(f"wrote {out}: " + ", ".join(f"{key} {value}" for key, value in facts.items()))


@tokenizer_app.command("eval")
def tokenizer_eval(
    tokenizer: Annotated[str, Argument(help="Name of the tokenizer.", autocompletion=tokenizers)],
    data: Data,
    embodiment: Robot = None,
    weights: Weights = None,
    frames: Frames = 64,
    lpips: Annotated[
        bool | None, Option(help="Measure LPIPS; default: only if it needs no download.")
    ] = None,
    worst: Annotated[int, Option(min=0, help="Number of worst frames to draw into --out.")] = 6,
    out: Annotated[Path | None, Option(help="Folder for eval.md, eval.json, worst.png.")] = None,
    device: Device = "cpu",
    json: Json = False,
) -> None:
    """Measure a tokenizer: PSNR, SSIM, LPIPS, codebook usage, bits, speed, and the worst frames.

    Example: hma tokenizer eval fsq-16 ./videos --out eval
    """
    from hma_data.registry.embodiment import find
    from hma_data.tokenizers.base import get_tokenizer

    robot = find(embodiment) if embodiment else None
    opened = get_tokenizer(tokenizer, weights=weights, device=device)
    from hma_data.tokenizers.training.eval import evaluate, to_markdown, without_frames, write_report
    from hma_data.tokenizers.training.frames import films_of

    perceptual, missing = _perceptual(lpips, device)
    found, skipped = {}, list[str]()
    for place in data:
        chosen = films_of(place, opened.spec, embodiment=robot, frames=frames, on_skip=skipped.append)
        found[place] = evaluate(opened, chosen, worst=worst if out else 0, perceptual=perceptual)
    notes = [missing] if missing else []
    if skipped:
        notes.append(f"{len(skipped)} files or episodes could not be read, the first: {skipped[0]}")
    plain = {name: without_frames(result) for name, result in found.items()}
    if json:
        print_json(plain)
    else:
        print(to_markdown(plain), end="")
    for note in notes:
        say(note, err=True)
    if out:
        title = f"{tokenizer}, weights {opened.spec.weights_digest or 'none'}"
        paths = write_report(out, title, found, notes)
        say(f"wrote {', '.join(map(str, paths))}", err=True)


@tokenizer_app.command("fit")
def tokenizer_fit(
    data: Data,
    embodiment: Robot = None,
    colors: Annotated[int, Option(min=2, max=255, help="Number of colours; fewer are learned faster.")] = 32,
    frames: Frames = 16,
    out: Annotated[Path, Option(help="Output weights.")] = Path("colors.safetensors"),
) -> None:
    """Choose colours for palette-64 that fit the images of a simulator; takes seconds.

    Example: hma tokenizer fit episodes.hdf5 -e my_arm.yaml --out colors.safetensors
    """
    from hma_data.registry.embodiment import find

    robot = find(embodiment) if embodiment else None
    from hma_data.tokenizers.palette import fit, write
    from hma_data.tokenizers.shapes import get_spec
    from hma_data.tokenizers.training.frames import films_of

    spec, skipped = get_spec("palette-64"), list[str]()
    given: Any = {"embodiment": robot, "frames": frames, "on_skip": skipped.append}
    chosen = fit((film for place in data for film in films_of(place, spec, **given)), colors)
    write(out, chosen)
    if skipped:
        say(f"{len(skipped)} files or episodes could not be read, the first: {skipped[0]}", err=True)
    print(f"wrote {out}: {len(chosen)} colours")


def _perceptual(wanted: bool | None, device: str) -> tuple[Any, str]:
    """Return what measures LPIPS, or None and the reason; raise if LPIPS is asked for and missing."""
    from hma_data.tokenizers.training.eval import open_lpips

    if wanted is False:
        return None, ""
    try:
        return open_lpips(download=wanted is True, device=device), ""
    except MissingDependencyError as fault:
        if wanted:
            raise
        return None, f"not measured: {fault}"
