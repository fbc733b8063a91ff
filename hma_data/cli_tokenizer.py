"""`hma tokenizer`: list, train and measure tokenizers."""

from pathlib import Path
from typing import Annotated

import typer

from hma_data.console import print_json, print_table

tokenizer_app = typer.Typer(no_args_is_help=True, help="List, train and measure tokenizers.")
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]


@tokenizer_app.command("list")
def tokenizer_list(json: Json = False) -> None:
    """Names that --tokenizer takes.

    Example: hma tokenizer list
    """
    from hma_data.tokenizers.base import TOKENIZERS, get_tokenizer

    rows = [get_tokenizer(name).spec for name in TOKENIZERS]
    if json:
        print_json([spec.to_json() for spec in rows])
    else:
        print_table(
            ["name", "kind", "picture", "grid", "vocabulary", "weights"],
            [
                [
                    s.name,
                    s.kind,
                    f"{s.image_size}²",
                    f"{s.grid[0]}×{s.grid[1]}",
                    s.vocab_size,
                    s.weights_sha256[:12] or None,
                ]
                for s in rows
            ],
        )


@tokenizer_app.command("train")
def tokenizer_train(
    recipe: Annotated[Path, typer.Argument(help="A YAML of recipes/tokenizer.")],
    overrides: Annotated[
        list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="Dotted overrides.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", help="The weights' file.")] = Path("tokenizer.safetensors"),
) -> None:
    """Train a tokenizer; run it again to go on.

    Example: hma tokenizer train recipes/tokenizer/fsq.yaml --out fsq.safetensors
    """
    from hma_data.errors import RecipeError, UsageError
    from hma_data.tokenizers.train import train
    from hma_data.yaml_io import parse_yaml

    changes = {}
    for text in overrides or []:
        key, equals, value = text.partition("=")
        if not key or not equals:
            raise UsageError(text, "is not key=value")
        changes[key] = parse_yaml(value, text, RecipeError)
    facts = train(recipe, out, changes, report=lambda line: typer.echo(line, err=True))
    print(f"wrote {out}: " + ", ".join(f"{key} {value}" for key, value in facts.items()))


@tokenizer_app.command("eval")
def tokenizer_eval(
    tokenizer: Annotated[str, typer.Argument(help="Name of the tokenizer.")],
    data: Annotated[list[Path], typer.Argument(help="Pictures, videos, or folders of them.")],
    weights: Annotated[str | None, typer.Option("--weights", help="Its weights, if not the usual.")] = None,
    frames: Annotated[int, typer.Option("--frames", min=1, help="Taken from each video, evenly.")] = 64,
    device: Annotated[str, typer.Option("--device", help="cpu, cuda, mps.")] = "cpu",
    json: Json = False,
) -> None:
    """PSNR, SSIM, use of the vocabulary, bits and speed.

    Example: hma tokenizer eval fsq-16 ./videos
    """
    from hma_data.tokenizers.base import get_tokenizer
    from hma_data.tokenizers.eval import evaluate, read_frames, to_markdown

    opened = get_tokenizer(tokenizer, weights=weights, device=device)
    size, resize_filter = opened.spec.image_size, opened.spec.resize_filter
    found = {
        str(path): evaluate(opened, read_frames(path, size, frames=frames, resize_filter=resize_filter))
        for path in data
    }
    if json:
        print_json(found)
    else:
        print(to_markdown(found), end="")
