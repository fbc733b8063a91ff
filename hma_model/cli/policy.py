"""Define the verb `hma policy-eval`."""

from pathlib import Path
from typing import Annotated

import typer

from hma_data.console import print_json, progress
from hma_model.cli.hub import Json


def policy_eval(
    embodiment: Annotated[str, typer.Argument(help="A robot of the laboratory that the checkpoint has.")],
    policies: Annotated[
        list[str],
        typer.Argument(
            metavar="POLICY…",
            help="scripted, scripted:noise=SHARE, random, still, MODULE:NAME of a Python function or class "
            "from a picture to a command, or lerobot:FOLDER_OR_REPO.",
        ),
    ],
    checkpoint: Annotated[
        str, typer.Option("--checkpoint", help="A checkpoint, a run's folder, or a hub repo.")
    ] = "embedded",
    episodes: Annotated[int, typer.Option("--episodes", min=1, help="Episodes of each policy.")] = 32,
    frames: Annotated[int, typer.Option("--frames", min=4, help="Frames of an episode.")] = 40,
    judge: Annotated[
        str, typer.Option("--judge", help="What success is: moved, reached, or with px: moved=8.")
    ] = "moved",
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of everything.")] = 0,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for the page and the figures.")] = None,
    json: Json = False,
) -> None:
    """Score policies in a robot's simulator and inside the world model, and compare the two.

    Example: hma policy-eval rails_03 scripted scripted:noise=0.5 random still --out policies
    """
    from hma_model.simulate.policy_eval import evaluate_policies
    from hma_model.simulate.policy_page import show, write_report

    with progress("policies", len(policies) * episodes * frames) as update:
        found = evaluate_policies(
            embodiment, policies, checkpoint=checkpoint, episodes=episodes, frames=frames, judge=judge,
            seed=seed, on_progress=update,
        )  # fmt: skip
    page = write_report(found, out) if out else None
    if json:
        print_json(found.to_json())
        return
    show(found)
    if page:
        print(f"open {page}")
