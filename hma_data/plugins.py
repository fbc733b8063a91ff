"""Find what other installed packages add: sources and tokenizers, each by an entry point.

docs/extending.md shows a package that adds one of each.

A built-in name never comes here. Names are read from the packages' metadata; a package's code is imported
only by `Plugin.load`.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from hma_data.errors import HMAError, PluginError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

SOURCE_GROUP = "hma_data.sources"
TOKENIZER_GROUP = "hma_data.tokenizers"


@dataclass(frozen=True)
class Plugin:
    """A name that an installed package adds.

    Attributes:
        name: of the format or tokenizer.
        packages: the distributions that add it, by name and version; more than one is an error on use.
        entry_point: where its object is.
    """

    name: str
    packages: tuple[str, ...]
    entry_point: "EntryPoint"

    def load(self) -> Any:
        """Import the object of the entry point.

        Raises:
            PluginError: it cannot be imported, or two packages add the name.
        """
        if len(self.packages) > 1:
            raise self.broken("two packages add this name", "uninstall one of them")
        return self.call(f"importing {self.entry_point.value}", self.entry_point.load)

    def call(self, doing: str, function: Callable[..., Any], *args: Any, **keywords: Any) -> Any:
        """Return what a function of the package returns."""
        try:
            return function(*args, **keywords)
        except HMAError:
            raise
        except Exception as fault:
            raise self.broken(f"{doing} failed: {type(fault).__name__}: {fault}") from fault

    def broken(self, fault: str, remedy: str = "") -> PluginError:
        """Return the error that names the package at fault."""
        packages = " and ".join(self.packages)
        where = f"{packages}, entry point {self.name!r} of {self.entry_point.group}"
        remedy = remedy or f"repair or uninstall {packages}; docs/extending.md shows one that works"
        return PluginError(where, fault, remedy)


def installed(group: str) -> dict[str, Plugin]:
    """Return what packages add to a group, by name."""
    return _installed(group, tuple(sys.path))


@cache
def _installed(group: str, path: tuple[str, ...]) -> dict[str, Plugin]:
    from importlib.metadata import entry_points

    found: dict[str, Plugin] = {}
    for entry in entry_points(group=group):
        package = f"{entry.dist.name} {entry.dist.version}" if entry.dist else "a package"
        others = found[entry.name].packages if entry.name in found else ()
        found[entry.name] = Plugin(entry.name, (*others, package), entry)
    return dict(sorted(found.items()))
