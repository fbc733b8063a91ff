"""Define the arguments and options that several verbs share.

The Tab key completes robots, tokenizers and recipes by the functions here; paths are the shell's own work.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields, is_dataclass
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated, Any, Literal, get_origin

from typer import Argument, Option
from typer.models import OptionInfo

from hma_data.errors import UsageError


def robots(incomplete: str) -> list[str]:
    """Return the ids of the registry that begin so."""
    from hma_data.registry.folders import file_id, registry_files

    return _begun(map(file_id, registry_files()), incomplete)


def tokenizers(incomplete: str) -> list[str]:
    """Return the names of tokenizers, those of installed packages too, that begin so."""
    from hma_data.plugins import TOKENIZER_GROUP, installed
    from hma_data.tokenizers.catalog import CATALOG

    return _begun([*CATALOG, *installed(TOKENIZER_GROUP)], incomplete)


def recipes(incomplete: str) -> list[str]:
    """Return the names of shipped recipes of training that begin so."""
    from hma_data.storage.paths import shipped

    return _begun((path.stem for path in (shipped("recipes") / "train").glob("*.yaml")), incomplete)


def _begun(names: Iterable[str], incomplete: str) -> list[str]:
    return sorted({name for name in names if name.startswith(incomplete)})


def robot_option(text: str) -> Any:
    """Return the option --embodiment, -e with its help."""
    return Option("--embodiment", "-e", help=text, autocompletion=robots)


def choice_option(text: str, **options: Any) -> Any:
    """Return an option that chooses episodes, with its help."""
    return Option(help=f"{text}: id, glob, or @FILE with one per line; repeatable.", **options)


def pairs(option: str, words: Iterable[str], example: str) -> dict[str, str]:
    """Return the values of words such as NAME=VALUE by name; an error states `option` and `example`."""
    found = {}
    for word in words:
        name, _, value = word.partition("=")
        if not name or not value:
            raise UsageError(option, f"must be like {example}, is {word!r}")
        found[name] = value
    return found


def with_settings(verb: Callable[..., None]) -> Callable[..., None]:
    """Give a verb the fields of dataclasses as options, in place of its parameters of these types."""
    own = signature(verb, eval_str=True).parameters
    classes: dict[str, Any] = {
        name: own[name].annotation for name in own if is_dataclass(own[name].annotation)
    }
    options: list[Parameter] = []
    for name, one in own.items():
        options += _options(one.annotation) if name in classes else [one]

    @wraps(verb)
    def run(**given: Any) -> None:
        for name, settings in classes.items():
            given[name] = settings(**{one.name: given.pop(one.name) for one in fields(settings)})
        verb(**given)

    run.__annotations__ = {one.name: one.annotation for one in options}
    run.__signature__ = Signature(options)  # type: ignore[attr-defined]
    return run


def _options(settings: Any) -> Iterator[Parameter]:
    """Yield the options of a dataclass; the metadata of its fields are those of `OptionInfo`."""
    for one in fields(settings):
        kind: Any = list[str] if get_origin(one.type) is tuple else one.type
        words = {"param_decls": [f"--{one.name.replace('_', '-')}"], **one.metadata}
        option = Annotated[kind, OptionInfo(default=..., **words)]
        yield Parameter(one.name, Parameter.KEYWORD_ONLY, default=one.default, annotation=option)


Json = Annotated[bool, Option("--json", help="Print JSON.")]
Folder = Annotated[Path, Argument(help="A shard set.")]
Weights = Annotated[str | None, Option(help="Tokenizer weights other than the default.")]
Episodes = Annotated[int, Option(min=1, help="Number of episodes to read.")]
FailOn = Annotated[
    Literal["info", "warn", "error", "never"],
    Option(help="Exit with 1 if there is a finding of this severity or worse."),
]
