"""The `hma` command: its entry point, the model verbs, and the data verbs of hma_data.cli.

Every verb imports what it needs when it runs, so that --help answers at once.
"""

import os
import sys

import typer

from hma_data.cli import mount
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


mount(app)
app.add_typer(hub_app, name="hub")
