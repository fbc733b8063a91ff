"""Older format versions of a checkpoint, brought to the newest as they are read; files stay as they are.

`STEPS` has a step for each version that is followed by another: it takes what a file of that version holds to
what one of the next holds. A release that raises the format version adds a step here and a test.
"""

from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

from hma_data.errors import CheckpointError

FORMAT_VERSION = 1
Values = dict[str, Any]


def _same(values: Values) -> Values:
    return values


def _same_tensors(part: str, tensors: Values) -> Values:
    return tensors


@dataclass(frozen=True)
class Step:
    """From one version to the next.

    Attributes:
        config: config.json's values.
        card: card.json's values.
        tensors: the file's name without its suffix (trunk, stem, head), and its tensors by name.
    """

    config: Callable[[Values], Values] = _same
    card: Callable[[Values], Values] = _same
    tensors: Callable[[str, Values], Values] = _same_tensors


STEPS: dict[int, Step] = {}


def config(values: Mapping[str, Any], where: object) -> Values:
    """config.json's values in the newest version.

    Raises:
        CheckpointError: of a version that this release does not know.
    """
    new = deepcopy(dict(values))
    for version in _path(values.get("format_version"), where):
        new = STEPS[version].config(new) | {"format_version": version + 1}
    return new


def card(values: Mapping[str, Any], where: object) -> Values:
    """card.json's values in the newest version; see `config`."""
    new = deepcopy(dict(values))
    for version in _path(values.get("format_version", FORMAT_VERSION), where):
        new = STEPS[version].card(new) | {"format_version": version + 1}
    return new


def tensors(part: str, values: Values, version: int, where: object) -> Values:
    """The tensors of a file of some version under the newest one's names and shapes; see `config`."""
    for step in _path(version, where):
        values = STEPS[step].tensors(part, values)
    return values


def _path(version: object, where: object) -> range:
    """The versions to step through."""
    oldest = min(STEPS, default=FORMAT_VERSION)
    if not isinstance(version, int) or isinstance(version, bool) or not oldest <= version <= FORMAT_VERSION:
        newer = isinstance(version, int) and version > FORMAT_VERSION
        read = str(FORMAT_VERSION) if oldest == FORMAT_VERSION else f"{oldest} to {FORMAT_VERSION}"
        raise CheckpointError(
            where,
            f"has format_version {version!r}, this release reads {read}",
            "update hma-toolkit" if newer else "save the checkpoint again",
        )
    return range(version, FORMAT_VERSION)
