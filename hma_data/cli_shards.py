"""`hma shards`: look at shard sets, verify them, and make others of them.

Only what is light is imported here; each verb imports what it needs.
"""

from pathlib import Path
from typing import Annotated

import typer

from hma_data.console import human_bytes, print_json, print_table

shards_app = typer.Typer(no_args_is_help=True, help="Look at shard sets and verify them.")

Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]


@shards_app.command("info")
def shards_info(folder: Annotated[Path, typer.Argument(help="A shard set.")], json: Json = False) -> None:
    """Totals of a shard set.

    Example: hma shards info shards/my_arm
    """
    from hma_data.shards.reader import ShardSet

    manifest = ShardSet(folder).manifest
    values = manifest.to_json()
    if json:
        print_json({k: values[k] for k in ("plan", "source", "tokenizer", "splits", "totals", "stats")})
        return
    totals = values["totals"]
    rows = sum(split["rows"] for split in manifest.splits.values())
    print(f"{folder}: {manifest.embodiment.id} × {manifest.tokenizer.name}, from {manifest.source}")
    print(
        f"{totals['episodes']:,} episodes, {totals['frames']:,} frames, {human_bytes(totals['bytes'])} "
        f"({totals['bytes'] / max(rows, 1):.0f} bytes a row), {totals['quarantined']:,} in quarantine"
    )
    print_table(
        ["split", *next(iter(manifest.splits.values()))],
        [[n, *s.values()] for n, s in manifest.splits.items()],
    )
    stats = manifest.stats["action"]
    columns = ["mean", "std", "min", "max"]
    names = manifest.embodiment.action.names()
    print_table(
        ["action", *columns, "q01", "q99"],
        [
            [
                name,
                *(stats[c][i] for c in columns),
                stats["quantiles"]["q01"][i],
                stats["quantiles"]["q99"][i],
            ]
            for i, name in enumerate(names)
        ],
    )


@shards_app.command("verify")
def shards_verify(
    folders: Annotated[list[Path], typer.Argument(help="Shard sets.")], json: Json = False
) -> None:
    """Every hash, row count and invariant.

    Example: hma shards verify shards/my_arm
    """
    from hma_data.shards.verify import verify

    found = {str(folder): verify(folder) for folder in folders}
    if json:
        print_json(found)
    else:
        for folder, problems in found.items():
            for problem in problems:
                print(problem)
            print(f"{folder}: {f'{len(problems)} problems' if problems else 'sound'}")
    raise typer.Exit(1 if any(found.values()) else 0)


@shards_app.command("preview")
def shards_preview(
    folder: Annotated[Path, typer.Argument(help="A shard set.")],
    out: Annotated[Path | None, typer.Option("--out", help="Folder for sheet.png and preview.mp4.")] = None,
    episodes: Annotated[int, typer.Option("--episodes", min=1, help="How many to show.")] = 4,
    weights: Annotated[
        str | None, typer.Option("--weights", help="The tokenizer's weights, if not the usual.")
    ] = None,
) -> None:
    """Contact sheet and video decoded from the tokens, with the actions drawn.

    Example: hma shards preview shards/my_arm
    """
    from hma_data.shards.preview import preview

    shown = preview(folder, out or Path(f"{folder.name}-preview"), episodes=episodes, weights=weights)
    print(f"wrote {shown.sheet} and {shown.video} ({len(shown.episodes)} episodes)")
