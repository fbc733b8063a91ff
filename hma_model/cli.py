"""The `hma` command: its entry point, the model verbs, and the data verbs of hma_data.cli.

Every verb imports what it needs when it runs, so that --help answers at once.
"""

import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from hma_data.bench import BENCHES
from hma_data.cli import Json, mount
from hma_data.console import human_seconds, print_json, print_table
from hma_data.errors import HMAError

app = typer.Typer(
    name="hma",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Robot recordings to tokenized shards, to a world model, to the hub. Add --debug for tracebacks.",
)
_Wrong: type[typer.BadParameter] = typer.BadParameter.__mro__[
    2
]  # ClickException, wherever typer keeps its click
hub_app = typer.Typer(no_args_is_help=True, help="Publish and pull checkpoints, one robot at a time.")


def main() -> None:
    """Run a command; errors become one line on stderr and an exit code."""
    # Threads that spin at a barrier starve each other on a busy machine: steps took ten times as long.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read when torch is first imported
    debug = "--debug" in sys.argv or bool(os.environ.get("HMA_DEBUG"))
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    try:
        code = app(arguments, standalone_mode=False)
    except HMAError as fault:
        if debug:
            raise
        sys.exit(_fail(str(fault), fault.exit_code))
    except _Wrong as fault:
        context = getattr(fault, "ctx", None)
        if not fault.format_message().strip() or type(fault).__name__ == "NoArgsIsHelpError":
            sys.exit(2)  # the help has been shown
        hint = f" — see {context.command_path} --help" if context else ""
        sys.exit(_fail(fault.format_message() + hint, 2))
    except (KeyboardInterrupt, typer.Abort):
        sys.exit(_fail("interrupted; run the same command again to continue", 130))
    except BrokenPipeError:
        sys.stderr.close()
        sys.exit(1)
    except Exception as fault:
        if debug:
            raise
        text = f"{type(fault).__name__}: {fault}".splitlines()[0]
        sys.exit(_fail(f"{text} — this should have been a clearer error; --debug shows where it happened", 1))
    sys.exit(code if isinstance(code, int) else 0)


def _fail(text: str, code: int) -> int:
    print(f"error: {' '.join(text.split())}", file=sys.stderr)
    return code


Checkpoint = Annotated[str, typer.Argument(help="A checkpoint, a run's folder, or a hub repo.")]
Data = Annotated[Path, typer.Argument(help="A shard set.")]
Embodiments = Annotated[
    list[str] | None, typer.Option("--embodiment", "-e", help="Only this robot; repeat for more.")
]


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder for everything the demo makes.")] = Path(
        "hma-demo"
    ),
    episodes: Annotated[
        int, typer.Option("--episodes", min=4, help="Recorded for each of the two robots.")
    ] = 24,
    steps: Annotated[int | None, typer.Option("--steps", min=1, help="Of training.")] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of recording and training.")] = 0,
) -> None:
    """The main job, small: record, convert, mix, train, publish, roll out, report.

    Example: hma demo --out demo
    """
    from hma_model.demo import demo as run

    report = run(out, episodes=episodes, steps=steps, seed=seed)
    print(f"open {report}")


@app.command()
def train(
    recipe: Annotated[str, typer.Argument(help="A recipe: name or YAML file.")],
    overrides: Annotated[
        list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="Dotted overrides.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="The run's folder.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Go on although recipe or shards changed.")] = False,
    json: Json = False,
) -> None:
    """Train; run it again to resume.

    Example: hma train discrete_tiny data=[shards/my_arm] --out runs/first
    """
    from hma_model.recipe import load_recipe
    from hma_model.train import train as run

    result = run(load_recipe(recipe, overrides or []), out=out, force=force)
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
    if json:
        print_json(facts)
    else:
        done = f"step {result.step:,}, {human_seconds(result.seconds)}"
        print(f"{result.out}: {done}, checkpoint {result.checkpoint}")
        found, base = result.masked_val_loss, result.baseline
        if found is not None and base is not None:
            print(f"held-out loss {found:.4f} nats a token; looking at nothing {base:.4f}")
    raise typer.Exit(130 if result.interrupted else 0)


@app.command()
def evaluate(
    checkpoint: Checkpoint,
    data: Data,
    split: Annotated[str, typer.Option("--split", help="train or val.")] = "val",
    windows: Annotated[int, typer.Option("--windows", min=1, help="How many, evenly spaced.")] = 64,
    frames: Annotated[
        int | None, typer.Option("--frames", min=2, help="Of a window; default the model's.")
    ] = None,
    prompt: Annotated[int | None, typer.Option("--prompt", min=1, help="True frames to start from.")] = None,
    unmask_steps: Annotated[int, typer.Option("--unmask-steps", min=1, help="Decoding steps a frame.")] = 2,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the rollouts.")] = 0,
    json: Json = False,
) -> None:
    """Loss beside its baseline, and rollouts with true and shuffled actions.

    Example: hma evaluate runs/first shards/my_arm
    """
    from hma_data.shards.preview import tokenizer_of
    from hma_data.shards.reader import ShardSet
    from hma_model.evaluate import evaluate as run

    shards = ShardSet(data)
    found = run(
        _model(checkpoint, shards.embodiment.id),
        tokenizer_of(shards),
        shards,
        split=split,
        count=windows,
        frames=frames,
        prompt=prompt,
        unmask_steps=unmask_steps,
        seed=seed,
    )
    if json:
        print_json(found)
        return
    plain = {key: value for key, value in found.items() if not isinstance(value, dict)}
    print_table(["figure", "value"], list(plain.items()))
    columns = ["psnr", "psnr_last", "ssim"]
    rows = [[name, *(found[name][column] for column in columns)] for name in ("true", "shuffled", "copy")]
    print_table(["rollout", "PSNR dB", "last frame dB", "SSIM"], rows)


@app.command()
def generate(
    checkpoint: Checkpoint,
    data: Data,
    out: Annotated[Path, typer.Option("--out", help="The video: .mp4 or .webp.")],
    split: Annotated[str, typer.Option("--split", help="train or val.")] = "val",
    window: Annotated[int, typer.Option("--window", min=0, help="Number of the window to start at.")] = 0,
    frames: Annotated[
        int | None, typer.Option("--frames", min=1, help="To predict; default to the window's end.")
    ] = None,
    prompt: Annotated[int, typer.Option("--prompt", min=1, help="True frames to start from.")] = 2,
    unmask_steps: Annotated[int, typer.Option("--unmask-steps", min=1, help="Decoding steps a frame.")] = 2,
    temperature: Annotated[
        float, typer.Option("--temperature", min=0, help="0 takes the likeliest token.")
    ] = 0.0,
    seed: Annotated[int, typer.Option("--seed", min=0)] = 0,
) -> None:
    """A rollout beside the truth, as a video.

    Example: hma generate runs/first shards/my_arm --out rollout.mp4
    """
    from hma_data.shards.preview import tokenizer_of
    from hma_data.shards.reader import ShardSet
    from hma_model.film import rollout_film, write_film

    shards = ShardSet(data)
    film = rollout_film(
        _model(checkpoint, shards.embodiment.id),
        tokenizer_of(shards),
        shards,
        split=split,
        window=window,
        frames=frames,
        prompt=prompt,
        unmask_steps=unmask_steps,
        temperature=temperature,
        seed=seed,
    )
    write_film(out, film)
    print(
        f"wrote {out}: {len(film.frames)} frames at {film.fps:.3g} Hz, the first {film.prompt} are the prompt"
    )


def _model(checkpoint: str, embodiment: str) -> Any:
    from hma_model.model import HMA

    return HMA.from_pretrained(checkpoint, embodiments=[embodiment]).eval()


@hub_app.command("push")
def hub_push(
    checkpoint: Annotated[Path, typer.Argument(help="A checkpoint, or a run's folder.")],
    target: Annotated[str, typer.Argument(help="A folder, or org/name on the hub.")],
    embodiment: Embodiments = None,
) -> None:
    """Publish a checkpoint, whole or robot by robot.

    Example: hma hub push runs/first ./my-hub/team/model -e my_arm
    """
    from hma_model import hub

    print(f"published to {hub.push(checkpoint, target, embodiment)}")


@hub_app.command("pull")
def hub_pull(
    source: Annotated[str, typer.Argument(help="A folder, or org/name on the hub.")],
    embodiment: Embodiments = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder; default the local cache.")] = None,
    revision: Annotated[str | None, typer.Option("--revision", help="Branch, tag or commit.")] = None,
) -> None:
    """Fetch the trunk and the robots asked for, nothing else.

    Example: hma hub pull team/model -e my_arm --out model
    """
    from hma_model import hub

    print(f"pulled to {hub.pull(source, embodiment, out, revision)}")


@hub_app.command("list")
def hub_list(
    source: Annotated[str, typer.Argument(help="A folder, or org/name on the hub.")], json: Json = False
) -> None:
    """The robots of a repo.

    Example: hma hub list ./my-hub/team/model
    """
    from hma_model import hub

    rows = hub.list_embodiments(source)
    if json:
        print_json(rows)
    else:
        print_table(list(rows[0]) if rows else ["embodiment"], [list(row.values()) for row in rows])


@hub_app.command("import")
def hub_import(
    source: Annotated[str, typer.Argument(help="A released checkpoint: a folder, or org/name on the hub.")],
    out: Annotated[Path, typer.Option("--out", help="Folder of the new checkpoint.")],
    embodiment: Embodiments = None,
    grid: Annotated[tuple[int, int] | None, typer.Option("--grid", help="h w, if not square.")] = None,
    tokenizer: Annotated[str | None, typer.Option("--tokenizer", help="Default the paper's.")] = None,
    revision: Annotated[str | None, typer.Option("--revision", help="Branch, tag or commit.")] = None,
    json: Json = False,
) -> None:
    """Bring a checkpoint of the paper's release into our layout.

    Example: hma hub import liruiw/hma-base-disc --out hma-base-disc
    """
    from hma_model import hub

    made = hub.import_released(
        source, out, embodiments=embodiment, grid=grid, tokenizer=tokenizer, revision=revision
    )
    if json:
        print_json({"out": str(made.folder), "embodiments": list(made.embodiments)})
    else:
        print(f"imported to {made.folder}: {len(made.embodiments)} embodiments")


@hub_app.command("export")
def hub_export(
    checkpoint: Annotated[Path, typer.Argument(help="A checkpoint, or a run's folder.")],
    out: Annotated[Path, typer.Option("--out", help="A new folder: config.json, model.safetensors.")],
    embodiment: Embodiments = None,
) -> None:
    """Write a checkpoint in the layout of the paper's release, for its code to read.

    Example: hma hub export runs/first --out released
    """
    from hma_model import hub

    print(f"exported to {hub.export_released(checkpoint, out, embodiments=embodiment)}")


mount(app)
BENCHES.setdefault("mup", "hma_model.bench_mup")
app.add_typer(hub_app, name="hub")


if __name__ == "__main__":
    main()
