"""The public names with their signatures, and every verb, option and default of the command line.

Others rely on both, so a change of them must be seen: the files of `tests/surface` hold them as text. After a
change that is meant, `HMA_REWRITE=1 pytest tests/test_surface.py` writes the files anew; commit them with it.
"""

import ast
import inspect
import os
import textwrap
from collections.abc import Iterator
from dataclasses import is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import pytest
import typer

from hma_model.cli import app

FOLDER = Path(__file__).parent / "surface"
MODULES = (
    "hma_data", "hma_data.errors", "hma_data.episodes.episode", "hma_data.lab", "hma_data.loader",
    "hma_data.shards.reader", "hma_data.sources.base", "hma_data.sources.common.inspection",
    "hma_data.sources.detect", "hma_data.tokenizers", "hma_data.tokenizers.catalog",
    "hma_model", "hma_model.network.network", "hma_model.hub.datasets", "hma_model.hub.publish",
    "hma_model.simulate",
    "hma_model.policies.scores",
)  # fmt: skip


def names(module: Any) -> list[str]:
    """Return the public names: those of __all__, or else what the module itself defines."""
    if hasattr(module, "__all__"):
        return sorted(module.__all__)
    public = {name: value for name, value in vars(module).items() if not name.startswith("_")}
    return sorted(name for name in public if getattr(public[name], "__module__", "") == module.__name__)


def signed(value: Any) -> str:
    """Return the signature of a function or class as its source has it; empty for a plain value."""
    if not (inspect.isfunction(value) or inspect.isclass(value)):
        return ""
    node: Any = ast.parse(textwrap.dedent(inspect.getsource(value))).body[0]
    if is_dataclass(value):
        fields = (ast.unparse(part) for part in node.body if isinstance(part, ast.AnnAssign))
        return f"({', '.join(fields)})"
    if inspect.isclass(value):
        own = inspect.isfunction(value.__init__) and not getattr(value, "_is_protocol", False)
        return signed(value.__init__).removesuffix(" -> None") if own else ""
    returned = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    return f"({ast.unparse(node.args)}){returned}"


def described(name: str, value: Any) -> Iterator[str]:
    """Yield a line for a public name; for a class also one for each public method and property."""
    yield name + signed(value)
    if not inspect.isclass(value):
        return
    for inner, member in sorted(vars(value).items()):
        plain = member.__func__ if isinstance(member, classmethod | staticmethod) else member
        method = inspect.isfunction(plain) and plain.__name__ == inner  # not the default of a field
        if not inner.startswith("_") and (method or isinstance(member, property)):
            yield f"    {inner}{signed(plain)}"


def python() -> Iterator[str]:
    for module in map(import_module, MODULES):
        yield f"# {module.__name__}"
        for name in names(module):
            yield from described(name, getattr(module, name))


def command_line() -> Iterator[str]:
    def walk(path: str, command: Any) -> Iterator[str]:
        if inner := getattr(command, "commands", None):
            for name in sorted(inner):
                yield from walk(f"{path} {name}", inner[name])
            return
        yield path
        kinds = inspect.signature(command.callback).parameters
        for item in command.params:
            if item.name not in kinds:  # --help, and those of the shell
                continue
            kind = inspect.formatannotation(get_args(kinds[item.name].annotation)[0])
            default = item.default() if callable(item.default) else item.default
            words = " ".join([*item.opts, *item.secondary_opts])
            yield f"    {words}: {kind.replace('pathlib._local.', 'pathlib.')}" + (
                "" if item.required else f" = {default}"
            )

    yield from walk("hma", typer.main.get_command(app))


@pytest.mark.parametrize("what", [python, command_line], ids=["python", "command_line"])
def test_the_surface_is_the_committed_one(what: Any) -> None:
    path, now = FOLDER / f"{what.__name__}.txt", "".join(f"{line}\n" for line in what())
    if os.environ.get("HMA_REWRITE"):
        path.parent.mkdir(exist_ok=True)
        path.write_text(now)
    assert path.read_text().splitlines() == now.splitlines(), "if it is meant: HMA_REWRITE=1"


def test_public_names_are_imported_on_use() -> None:
    for name in ("hma_data", "hma_model", "hma_model.simulate"):
        module = import_module(name)
        assert all(getattr(module, public) is not None for public in module.__all__)
