"""Convert older format versions of a checkpoint to the newest when they are read; files do not change.

`STEPS` has a step for each version but the newest. A step converts the content of a file to the next version.
A release that raises the format version adds a step here and a test.
"""

from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

from hma_data.errors import CheckpointError

FORMAT_VERSION = 1
Values = dict[str, Any]


@dataclass(frozen=True)
class Step:
    """The conversion from one version to the next.

    Attributes:
        config: converts the values of config.json.
        card: converts the values of card.json.
        tensors: converts the tensors of a file by name, given its name without suffix (trunk, stem, head).
    """

    config: Callable[[Values], Values]
    card: Callable[[Values], Values]
    tensors: Callable[[str, Values], Values]


STEPS: dict[int, Step] = {}


def config(values: Mapping[str, Any], where: object) -> Values:
    """Return the values of config.json in the newest version.

    Raises:
        CheckpointError: the values are of a version that this release does not know.
    """
    new = deepcopy(dict(values))
    for version in _path(values.get("format_version"), where):
        new = STEPS[version].config(new) | {"format_version": version + 1}
    return new


def card(values: Mapping[str, Any], where: object) -> Values:
    """Return the values of card.json in the newest version; see `config`."""
    new = deepcopy(dict(values))
    for version in _path(values.get("format_version", FORMAT_VERSION), where):
        new = STEPS[version].card(new) | {"format_version": version + 1}
    return new


def tensors(part: str, values: Values, version: int, where: object) -> Values:
    """Return the tensors of a file with the names and shapes of the newest version; see `config`."""
    for step in _path(version, where):
        values = STEPS[step].tensors(part, values)
    return values


def _path(version: object, where: object) -> range:
    """Return the versions to convert from, one after the other."""
    oldest = min(STEPS, default=FORMAT_VERSION)
    if not isinstance(version, int) or not oldest <= version <= FORMAT_VERSION:
        read = str(FORMAT_VERSION) if oldest == FORMAT_VERSION else f"{oldest} to {FORMAT_VERSION}"
        fault = f"has format_version {version!r}, this release reads {read}"
        raise CheckpointError(where, fault, "update hma-toolkit, or save the checkpoint again")
    return range(version, FORMAT_VERSION)
