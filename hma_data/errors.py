"""Define the errors: each names where the fault is, what is wrong, and what to do about it.

The command line prints an error as one line and exits with `exit_code`; programs read the attributes.
"""

import re
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path

_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")  # lone surrogates: bytes not UTF-8
_CHECKOUT = Path(__file__).parents[1] / "pyproject.toml"


class HMAError(Exception):
    """The base class of all errors here.

    Attributes:
        where: the file, folder, URI or YAML path at fault.
        fault: what is wrong, with the value found.
        remedy: what to do; may be empty where the fault makes it clear.
        exit_code: of the command line: 1 failed, 2 wrong usage.
    """

    exit_code = 1

    def __init__(self, where: object, fault: str, remedy: str = "") -> None:
        self.where, self.fault, self.remedy = str(where), fault, remedy
        super().__init__(where, fault, remedy)

    def __str__(self) -> str:
        text = f"{escaped(self.where)}: {self.fault}" if self.where else self.fault
        return f"{text} — {self.remedy}" if self.remedy else text

    def __reduce__(self) -> tuple[type, tuple[str, str, str]]:
        return type(self), (self.where, self.fault, self.remedy)  # workers send errors to the parent


class UsageError(HMAError):
    """The command was called wrongly."""

    exit_code = 2


class Interrupted(HMAError):
    """The user stopped the command with Ctrl-C; the text says what is kept and how to go on."""

    exit_code = 130


class RegistryError(HMAError):
    """An embodiment's YAML cannot be used as it stands."""


class SourceError(HMAError):
    """A recording cannot be read at all."""


class PluginError(HMAError):
    """A package that adds a source or a tokenizer is broken; `where` names the package."""


class StorageAwayError(SourceError):
    """Storage did not answer after several tries; this is no fault of the recording."""


class StorageError(HMAError):
    """A store refuses a request: no access, no such bucket, or no space."""


class EpisodeError(HMAError):
    """One episode of a readable recording cannot be used: it goes to quarantine, and the job goes on."""


class AlignmentError(EpisodeError):
    """An episode's streams cannot be put on one clock."""


class TokenizerError(HMAError):
    """A tokenizer or its weights cannot be used, or frames or tokens do not fit it."""


class ShardError(HMAError):
    """A shard or its manifest is damaged, or does not fit the request."""


class OutputError(HMAError):
    """An output folder cannot be used: it holds something else than this job would write, for example."""


class OtherPlanError(OutputError):
    """An output folder holds what another conversion makes."""


class RecipeError(HMAError):
    """A recipe or an override of it is not valid."""


class TrainingError(HMAError):
    """Training cannot go on."""


class CheckpointError(HMAError):
    """A checkpoint is damaged, or does not fit the request."""


class HubError(HMAError):
    """Publishing to a hub, or pulling from it, failed."""


class MissingDependencyError(HMAError):
    """An optional package is not installed; the remedy is the command that installs it."""


def escaped(text: str) -> str:
    """Return a text of one line: control characters, as in a folder's name, become \\n, \\x1b …"""
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def meant(word: str, known: Iterable[str], most: int = 3, cutoff: float = 0.6) -> str:
    """Return a question that names the known words like the given one; nothing where none is like it."""
    near = get_close_matches(word, list(known), most, cutoff)
    return f"did you mean {', '.join(map(repr, near))}?" if near else ""


def install_command(extra: str = "") -> str:
    """Return the command that installs what the toolkit or an extra of it needs: uv in a checkout, or pip."""
    if _CHECKOUT.is_file():
        return f"uv sync --inexact --extra {extra}" if extra else "uv sync --inexact"
    return f"pip install 'hma-toolkit[{extra}]'" if extra else "pip install hma-toolkit"
