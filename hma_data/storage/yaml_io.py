"""Read and write YAML of plain values only.

Tags, anchors, aliases, merges, duplicate keys, tabs and files of more than 1 MB are refused. A refusal names
the file and, for a fault in the text, the line. libyaml scans the text where PyYAML was built with it (seven
times as fast); the rules for what is accepted are the same either way.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from hma_data.errors import HMAError, RegistryError
from hma_data.storage.kinds import misplaced

if TYPE_CHECKING:
    from pydantic import ValidationError

try:
    from yaml._yaml import CParser as _Events  # only its events: its own composer would build aliases
except ImportError:  # a PyYAML without libyaml
    from yaml.loader import SafeLoader as _Events  # type: ignore[assignment]

MAX_BYTES = 1_000_000
MAX_DEPTH = 32
HINTS = {  # words of the parser's faults -> what to do
    "mapping values are not allowed": "put a text with a colon in quotes",
    "did not find expected": "check the indentation and the brackets above",
    "could not find expected ':'": "write key: value, with a space after the colon",
}
_PLAIN = {  # pydantic's error types, or their first words, in plain English
    "int": "must be a whole number (an integer)",
    "float": "must be a number",
    "bool": "must be true or false (a boolean)",
    "string_type": "must be a text (a string), in quotes where YAML reads it as something else",
    "tuple_type": "must be a list, as in [a, b]",
    "dict": "must be a mapping of keys to values (a dictionary)",
    "model": "must be a mapping of keys to values (a dictionary)",
    "invalid_key": "keys must be words",
}


class _PlainLoader(yaml.composer.Composer, _Events, yaml.constructor.SafeConstructor, yaml.resolver.Resolver):
    """A loader that builds plain values and refuses aliases, tags, duplicate keys and deep nesting."""

    depth = 0

    def __init__(self, text: str) -> None:
        _Events.__init__(self, text)
        yaml.composer.Composer.__init__(self)
        yaml.constructor.SafeConstructor.__init__(self)
        yaml.resolver.Resolver.__init__(self)

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event: Any = self.peek_event()
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
            raise _refused("anchors and aliases are not accepted: write the value out", event)
        if getattr(event, "tag", None):
            raise _refused(f"tags are not accepted, here {event.tag}: write the plain value", event)
        if self.depth >= MAX_DEPTH:
            raise _refused(f"nested deeper than {MAX_DEPTH}", event)
        self.depth += 1
        try:
            return super().compose_node(parent, index)
        finally:
            self.depth -= 1

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key_node, _ in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                raise _refused("a key must be a word", key_node)
            if key_node.tag == "tag:yaml.org,2002:merge":
                raise _refused("merge keys << are not accepted: write the values out", key_node)
            if key_node.value in seen:
                raise _refused(f"key {key_node.value!r} is given twice", key_node)
            seen.add(key_node.value)
        return super().construct_mapping(node, deep)


def _refused(fault: str, at: Any) -> yaml.MarkedYAMLError:
    return yaml.constructor.ConstructorError(None, None, fault, at.start_mark)


def parse_yaml(text: str, where: str, error: type[HMAError] = RegistryError) -> Any:
    """Return the plain values of a YAML text.

    Raises:
        error: the text is not YAML that this module accepts; the message states line and column.
    """
    try:
        loader = _PlainLoader(text)
        try:
            return loader.get_single_data()
        finally:
            loader.dispose()
    except (yaml.YAMLError, ValueError, RecursionError) as fault:
        mark = getattr(fault, "problem_mark", None)
        place = f" at line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = getattr(fault, "problem", None) or str(fault).splitlines()[0]
        if mark and "\t" in "".join(text.split("\n")[mark.line : mark.line + 1])[: mark.column + 1]:
            problem += " (a tab: indent with spaces)"
        elif hint := next((hint for words, hint in HINTS.items() if words in problem), ""):
            problem += f" ({hint})"
        raise error(where, f"not valid YAML{place}: {problem}") from fault


def read_yaml(path: Path, error: type[HMAError] = RegistryError) -> Any:
    """Return the plain values of a YAML file; see `parse_yaml`."""
    return parse_yaml(decode_yaml(read_bytes(path, error), path, error), str(path), error)


def read_bytes(path: Path, error: type[HMAError] = RegistryError) -> bytes:
    """Return the bytes of a YAML file."""
    try:
        if not path.is_file():
            found = misplaced(path, "a YAML file")
            raise error(
                path, *(found or ("is not a file" if path.exists() else "no such file", "check the path"))
            )
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as fault:
        raise error(path, f"cannot be read: {fault.strerror or fault}") from fault
    if len(content) > MAX_BYTES:
        raise error(path, f"is larger than {MAX_BYTES:,} bytes", "the toolkit's YAMLs have a few kilobytes")
    return content


def decode_yaml(content: bytes, path: Path, error: type[HMAError] = RegistryError) -> str:
    """Return the text of a YAML file; raise `error` if it is not UTF-8."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as fault:
        found = misplaced(path, "a YAML file")
        raise error(path, *(found or (f"is not UTF-8 text: {fault}",))) from fault


@dataclass(frozen=True)
class Problem:
    """One problem of a YAML: its path in the YAML, the fault, the value found, and what is allowed there."""

    path: str
    fault: str
    value: str | None = None
    allowed: str | None = None

    def __str__(self) -> str:
        text = f"{self.path}: {self.fault}" if self.path else self.fault
        if self.value is not None:
            text += f" (is {self.value})"
        return text + (f"; allowed: {self.allowed}" if self.allowed else "")


def plain_fault(item: Mapping[str, Any]) -> str:
    """Return the fault that one of pydantic's `errors()` describes, in plain words and without the value."""
    kind, said = str(item["type"]), str(item["msg"]).removeprefix("Value error, ")
    text = _PLAIN.get(kind) or _PLAIN.get(kind.partition("_")[0]) or said
    return text.replace("Input should be", "must be")


def first_fault(fault: "ValidationError") -> str:
    """Return the first of pydantic's errors: the key, its value, and what is wrong with it."""
    first = fault.errors()[0]
    key = ".".join(map(str, first["loc"]))
    if first["type"] == "missing":  # the input would be all values
        return f"lacks {key}"
    return f"{key} is {first['input']!r:.60}: {plain_fault(first)}" if key else plain_fault(first)


def write_yaml(values: Any) -> str:
    """Return plain values as YAML in the order given."""
    return yaml.safe_dump(values, sort_keys=False, allow_unicode=True, width=100)
