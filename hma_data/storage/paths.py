"""Take paths as callers give them: text, a `Path` or any other path object; recognise a hub's repository.

A public function takes a `StrPath` and converts it once: with `as_text` where it may be a URI or a name,
with `as_path` for a file or folder of this machine, with `as_address` for a hub, and with
`hma_data.storage.remote.place` where it may be a path of a store.
"""

import os
import re
import sys
from importlib import import_module
from pathlib import Path, PurePath
from typing import Any

from hma_data.errors import HubError, UsageError

StrPath = str | os.PathLike[str]
REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]{0,95}/[\w.-]{1,96}")
_CUT = re.compile(r"([a-z][a-z0-9+.-]+):/+(?=.)")


def as_text(path: StrPath) -> str:
    """Return a path or URI as text.

    `Path("s3://bucket/set")` is `s3:/bucket/set`; a URI that lost slashes in a path object gets them back.

    Raises:
        UsageError: the path is bytes.
        TypeError: the value is no path.
    """
    if isinstance(path, str):
        return path
    text = str(path) if isinstance(path, PurePath) else os.fspath(path)  # a RemotePath has no os.fspath
    if isinstance(text, bytes):
        raise UsageError(repr(text), "is a path of bytes", "give text: os.fsdecode converts it")
    if found := _CUT.match(text):
        return f"{found[1]}://{'/' if found[1] in ('file', 'local') else ''}{text[found.end() :]}"
    return text


def as_path(path: StrPath) -> Path:
    """Return a file or folder of this machine as a `Path`; raise the errors of `as_text`."""
    return path if isinstance(path, Path) else Path(as_text(path))


def as_address(path: StrPath) -> str | Path:
    """Return the address of a hub: text and URIs as text, any other path object as a `Path`.

    Only text can name a repository: `org/name` may be one, `Path("org/name")` is always a folder.
    The errors are those of `as_text`.
    """
    text = as_text(path)
    return text if isinstance(path, str) or "://" in text else Path(text)


def is_repository(address: StrPath) -> bool:
    """Check whether an address is a repository: hf://org/name, or org/name unless it is a local folder."""
    place = as_address(address)
    if isinstance(place, Path):
        return False
    if place.startswith("hf://"):
        if not REPOSITORY.fullmatch(place.removeprefix("hf://")):
            raise HubError(place, "is not hf://ORGANISATION/NAME", "name a model repository")
        return True
    return REPOSITORY.fullmatch(place) is not None and not Path(place).is_dir()


def addressed[Address: str | Path](
    address: Address, revision: str | None = None
) -> tuple[Address | str, str | None]:
    """Split `org/name@revision` into repository and revision; return any other address unchanged."""
    repository, _, named = str(address).partition("@")
    if revision is None and named and not Path(address).exists() and is_repository(repository):
        return repository, named
    return address, revision


def shipped(name: str) -> Path:
    """Return the folder `registry` or `recipes` of this installation.

    In a checkout it lies at the top level; in a wheel it is inside `hma_data/shipped/`.
    """
    package = Path(__file__).resolve().parents[1]
    packed = package / "shipped" / name
    return packed if packed.is_dir() else package.parent / name


def recipe_module(name: str) -> Any:
    """Import a module of `recipes/bench`; raise UsageError where this installation has none."""
    folder = shipped("recipes")
    if not (folder / "bench" / f"{name}.py").is_file():
        remedy = "run it in a checkout of the project"
        raise UsageError(f"recipes/bench/{name}.py", "is not part of this installation", remedy)
    if str(folder.parent) not in sys.path:  # spawned processes take sys.path over, and find the module too
        sys.path.append(str(folder.parent))
    return import_module(f"recipes.bench.{name}")
