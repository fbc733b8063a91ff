"""The text of an inferred YAML: fields a line each, components and cameras in braces, questions unbroken."""

import re
from typing import Any

import yaml

LINE = 110
_HALVES = re.compile(r"[\ud800-\udfff]")
_BREAKS = re.compile(r"[\n\r\x85\u2028\u2029]")


class _Dumper(yaml.SafeDumper):
    def ignore_aliases(self, data: Any) -> bool:
        """The parser accepts none."""
        return True


def _text(dumper: _Dumper, value: str) -> yaml.Node:
    """On one line, whatever it holds."""
    value = _HALVES.sub("?", value)  # of surrogate pairs: no text
    style = '"' if _BREAKS.search(value) else None
    return dumper.represent_scalar("tag:yaml.org,2002:str", value, style=style)


_Dumper.add_representer(str, _text)


def yaml_text(values: dict[str, Any]) -> str:
    """Plain values as YAML, in the order given; it parses back to the same."""
    return "".join(_entry(name, value, "") for name, value in values.items())


def _entry(name: str, value: Any, indent: str) -> str:
    if isinstance(value, dict):
        braced = f"{indent}{_dump({name: value}, True)[1:-1]}"
        if len(braced) <= LINE and all(not isinstance(item, dict | list) for item in value.values()):
            return braced + "\n"
        inner = "".join(_entry(key, item, indent + "  ") for key, item in value.items())
        return f"{indent}{name}:\n{inner}"
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return f"{indent}{name}:\n" + "".join(_item(item, indent + "  ") for item in value)
    if isinstance(value, list):
        return _names(name, value, indent)
    return _indented(_dump({name: value}, False), indent)


def _item(value: dict[str, Any], indent: str) -> str:
    braced = f"{indent}- {_dump(value, True)}"
    if len(braced) <= LINE:
        return braced + "\n"
    block = "".join(_entry(key, item, indent + "  ") for key, item in value.items())
    return f"{indent}- {block[len(indent) + 2 :]}"


def _names(name: str, value: list[Any], indent: str) -> str:
    """A list in brackets, broken where it is long."""
    whole = f"{indent}{_dump({name: value}, True)[1:-1]}"
    if len(whole) <= LINE:
        return whole + "\n"
    lines, line = [], f"{indent}  "
    for item in [_dump([item], True)[1:-1] for item in value]:
        if len(line) + len(item) + 2 > LINE and line.strip():
            lines.append(line.rstrip())
            line = f"{indent}  "
        line += f"{item}, "
    return "\n".join([f"{indent}{name}: [", *lines, line.rstrip()[:-1] + "]"]) + "\n"


def _dump(value: Any, flow: bool) -> str:
    return yaml.dump(
        value,
        Dumper=_Dumper,
        default_flow_style=flow,
        allow_unicode=True,
        width=float("inf"),
        sort_keys=False,
    ).rstrip("\n")


def _indented(text: str, indent: str) -> str:
    return "".join(f"{indent}{line}\n" if line else "\n" for line in text.split("\n"))
