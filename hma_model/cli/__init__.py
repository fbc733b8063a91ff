"""Define the `hma` command: its entry point, the model verbs, and the data verbs of hma_data.cli.

Every verb imports its modules when it runs, so that --help answers at once.
"""

import os
import re
import sys
import warnings
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Option
from typer.core import TyperGroup

from hma_data import __version__
from hma_data.cli import mount
from hma_data.console import fail, interruptible, say
from hma_data.cpu import bound_spinning, keep_freed_memory, take_ordinary_priority
from hma_data.errors import HMAError, UsageError, escaped
from hma_model.cli import train as cli_train
from hma_model.cli.benchmark import benchmark
from hma_model.cli.evaluate import evaluate
from hma_model.cli.export import export
from hma_model.cli.hub import hub_app
from hma_model.cli.options import (
    Cameras,
    Checkpoint,
    Compile,
    Data,
    Device,
    Precision,
    SampleSteps,
    Seed,
    Split,
    Temperature,
    UnmaskSteps,
    camera_names,
    device_name,
    kept,
    require_checkpoint,
)
from hma_model.cli.play import play
from hma_model.cli.policy import augment, label_actions, policy_eval
from hma_model.cli.train import MODELS, recipe_app
from hma_model.cli.trial import try_recording
from hma_model.cli.view import view


class _Verbs(TyperGroup):
    """The verbs; a Ctrl-C that no verb explains ends in one line, where typer would say nothing."""

    def invoke(self, ctx: Any) -> Any:
        with interruptible(lambda: "nothing more is written"):
            return super().invoke(ctx)


app = typer.Typer(
    name="hma",
    cls=_Verbs,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Convert robot recordings to shards, train a world model, publish it. Add --debug for tracebacks.",
)
_Wrong: type[typer.BadParameter] = typer.BadParameter.__mro__[2]  # ClickException of typer's click
TRAINING = ("train", "finetune", "demo")
_TAG = re.compile(r"\[(?=[a-z#/@][^\[]*\])")  # the beginning of what rich takes for markup


def _print_version(asked: bool) -> None:
    if asked:
        say(f"hma {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, Option("--version", help="Print the version.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    pass


def _show_brackets(command: Any) -> None:
    """Change the help of a command and of its commands so that rich prints brackets and what is in them."""
    for item in (command, *command.params):
        if getattr(item, "help", None):
            item.help = _TAG.sub(r"\[", item.help)
    for inner in getattr(command, "commands", {}).values():
        _show_brackets(inner)


@cache
def _command() -> Any:
    """Return the command of all verbs; making it takes 0.03 s, and a process may run several."""
    command = typer.main.get_command(app)
    _show_brackets(command)
    return command


def _one_line(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
) -> str:
    """Return a warning as users read it: without the place in the code that gave it."""
    return f"warning: {escaped(' '.join(str(message).split()))}\n"


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command, and report an error as one line on stderr.

    Args:
        argv: the words after `hma`; None takes the process's own.

    Returns:
        The exit code: 0 success, 1 failure or problems found, 2 wrong usage, 130 interrupted.
    """
    take_ordinary_priority()
    bound_spinning()
    words = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in words or bool(os.environ.get("HMA_DEBUG"))
    if not debug:
        warnings.formatwarning = _one_line
    try:
        plain = [word for word in words if word != "--debug"]
        if argv is None and plain and plain[0] in TRAINING:  # a program that calls this keeps its allocator
            keep_freed_memory()
        code = _command().main(plain, prog_name="hma", standalone_mode=False)
    except SystemExit as ended:  # a rank whose error another rank has reported
        return ended.code if isinstance(ended.code, int) else 1
    except HMAError as fault:
        if debug:
            raise
        return fail(str(fault), fault.exit_code)
    except _Wrong as fault:
        context = getattr(fault, "ctx", None)
        if not fault.format_message().strip() or type(fault).__name__ == "NoArgsIsHelpError":
            return 2  # the help has been shown
        hint = f" — see {context.command_path} --help" if context else ""
        if context and context.info_name in ("train", "finetune"):
            key = cli_train.unknown_option(getattr(fault, "option_name", "") or "")
            hint = f" — {key}" if key else hint
        said = fault.format_message().replace("Value error, ", "").replace("Input should be", "must be")
        return fail(said + hint, 2)
    except (KeyboardInterrupt, typer.Abort):
        return fail("interrupted", 130)
    except BrokenPipeError:
        sys.stderr.close()
        return 1
    except Exception as fault:
        if debug:
            raise
        text = f"{type(fault).__name__}: {fault}".splitlines()[0]
        return fail(f"{text} — unexpected error, please report it; --debug shows the traceback", 1)
    return code if isinstance(code, int) else 0


@app.command()
def demo(
    out: Annotated[Path, Option(help="Output folder.")] = Path("hma-demo"),
    episodes: Annotated[int, Option(min=4, help="Episodes of each of the two robots.")] = 32,
    steps: Annotated[int | None, Option(min=1, help="Maximum training steps.")] = None,
    seed: Annotated[int, Option(min=0, help="Random seed of recording and training.")] = 0,
) -> None:
    """Finetune the bundled world model on two new robots: record, convert, finetune, publish, report.

    It takes a few minutes and downloads nothing.

    Example: hma demo --out demo
    """
    from hma_model.demo.run import demo as run

    with interruptible(lambda: kept("steps", out)):
        report = run(out, episodes=episodes, steps=steps, seed=seed)
    say(f"open {report}")


app.command("try")(try_recording)
app.command()(play)
app.command()(view)
mount(app)
cli_train.mount(app)


app.command("evaluate", rich_help_panel=MODELS)(evaluate)
app.command(rich_help_panel=MODELS)(benchmark)


@app.command(rich_help_panel=MODELS)
def generate(
    checkpoint: Checkpoint,
    data: Data,
    out: Annotated[Path, Option(help="Output video: .mp4, .webp or .gif.")],
    split: Split = "val",
    window: Annotated[int, Option(min=0, help="Index of the window to start at.")] = 0,
    frames: Annotated[
        int | None, Option(min=1, help="Frames to predict; default: to the end of the window.")
    ] = None,
    prompt: Annotated[int, Option(min=1, help="Number of recorded frames to start from.")] = 2,
    unmask_steps: UnmaskSteps = 2,
    sample_steps: SampleSteps = None,
    temperature: Temperature = None,
    precision: Precision = "float32",
    compile: Compile = False,
    device: Device = "auto",
    seed: Seed = 0,
    cameras: Cameras = None,
) -> None:
    """Write a video of a recording next to the prediction from its first frames and actions.

    Example: hma generate runs/first shards/my_arm --out rollout.mp4
    """
    if out.suffix not in (".mp4", ".webp", ".gif"):
        raise UsageError("--out", f"{out} is none of .mp4, .webp and .gif")
    opened = _opened(checkpoint, data, device)
    from hma_model.evaluation.rollout_video import rollout_video, write_video
    from hma_model.generation.commands import Commands

    model, tokenizer, shards = opened
    film = rollout_video(
        model, tokenizer, shards, split=split, window=window, frames=frames, prompt=prompt, seed=seed,
        unmask_steps=unmask_steps, sample_steps=sample_steps, temperature=temperature,
        cameras=camera_names(cameras), precision=precision, compile=compile,
    )  # fmt: skip
    write_video(out, film)
    commands = Commands.of(model, shards.embodiment.id)
    if outside := commands.outside(film.actions.reshape(-1, len(commands.names))):
        say(outside, err=True)
    about = f"{len(film.frames)} frames at {film.fps:.3g} Hz, the first {film.prompt} are the prompt"
    say(f"wrote {out}: {about}")


def _opened(checkpoint: str, data: Path, device: str) -> tuple[Any, Any, Any]:
    """Return the model with the shard set's embodiment, its tokenizer, and the shard set."""
    from hma_data.shards.reader import ShardSet

    shards = ShardSet(data)  # it and the checkpoint are refused before torch is imported
    require_checkpoint(checkpoint)
    from hma_data.shards.preview import tokenizer_of
    from hma_model.generation.decode import model_for

    there = device_name(device)
    return model_for(checkpoint, [shards], there), tokenizer_of(shards, device=there), shards


app.command(rich_help_panel=MODELS)(export)
app.command("policy-eval", rich_help_panel=MODELS)(policy_eval)
app.command(rich_help_panel=MODELS)(augment)
app.command("label-actions", rich_help_panel=MODELS)(label_actions)
app.add_typer(recipe_app, name="recipe", rich_help_panel=MODELS)
app.add_typer(hub_app, name="hub", rich_help_panel=MODELS)
