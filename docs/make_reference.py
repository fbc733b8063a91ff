"""Write the generated pages of docs/reference: python docs/make_reference.py

cli.md comes from the typer application, yaml.md from the registry's JSON Schema, and recipe.md from the
recipe and the network's configuration. `tests/test_docs.py` checks that the committed pages are up to date.
"""

import dataclasses
import inspect
import json
import re
from collections import Counter
from collections.abc import Container, Iterator, Mapping
from pathlib import Path
from typing import Any

import typer
from pydantic_core import PydanticUndefined

from hma_data.registry import FORMATS
from hma_model.cli import app
from hma_model.config import _CHOICES, HMAConfig
from hma_model.training.recipe import _DERIVED, MixtureSettings, Recipe

FOLDER = Path(__file__).parent / "reference"
MADE = "<!-- Made by docs/make_reference.py; change what it reads, not this page. -->\n\n"
Schema = Mapping[str, Any]


def table(heads: list[str], rows: list[list[str]]) -> str:
    """Return a table in Markdown."""
    head, *body = [
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in (heads, *rows)
    ]
    return "\n".join([head, "|" + "---|" * len(heads), *body])


# -- the command line

OPTION = ["option", "meaning", "default or range"]
SHARED_BY = 4  # an option that is the same in this many commands is explained once


def cli_page() -> str:
    """Return the page of all commands, from the application itself."""
    parts = [
        f"{MADE}# Command line\n\nThe `--help` of every command. Each also takes `--help`, and "
        "`--debug` (also before the command), which shows tracebacks."
    ]
    commands = list(_commands(typer.main.get_command(app), "hma"))
    rows = Counter(row for name, command in commands for row in map(tuple, _rows(name, command)[1]))
    shared = [row for row, times in rows.items() if times >= SHARED_BY]
    for name, command in commands:
        parts += _command(name, command, shared)
    parts += ["## Shared options", table(OPTION, sorted(map(list, shared))), _EXIT_CODES]
    return "\n\n".join(parts) + "\n"


_EXIT_CODES = """## Exit codes

| code | when |
|---|---|
| 0 | done; for `hma inspect` and `hma doctor`: no error was found (warnings do not count) |
| 1 | failed, or problems found. `hma inspect` and `hma doctor` take `--fail-on warn` (or `info`, `never`) |
| 2 | wrong usage |
| 130 | interrupted; the same command continues |"""


def _commands(command: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Yield the verbs in the order of `hma --help`, each group before what is in it."""
    for word, inner in getattr(command, "commands", {}).items():
        yield f"{name} {word}", inner
        yield from _commands(inner, f"{name} {word}")


def _command(name: str, command: Any, shared: Container[tuple[str, ...]]) -> list[str]:
    """Return the section of one command."""
    about, _, example = inspect.cleandoc(command.help or "").partition("Example:")
    parts = ["#" * len(name.split()) + " " + name, _escaped(about.strip())]
    if example:
        parts.append(f"```bash\n{' '.join(example.split())}\n```")
    arguments, options = _rows(name, command)
    if arguments:
        parts.append(table(["argument", *OPTION[1:]], arguments))
    if own := [row for row in options if tuple(row) not in shared]:
        parts.append(table(OPTION, own))
    if others := [re.sub(" <.*>", "", row[0]) for row in options if tuple(row) in shared]:
        parts.append(f"[Shared options](#shared-options): {', '.join(others)}")
    return parts


def _rows(name: str, command: Any) -> tuple[list[list[str]], list[list[str]]]:
    """Return the table rows of a command's arguments and of its options."""
    context = typer.Context(command, info_name=name)
    arguments, options = [], []
    for param in command.params:
        record = param.get_help_record(context)
        if record is None or "--help" in record[0]:
            continue
        row = [f"`{_spelled(param, record[0])}`", *_said(record[1])]
        (options if param.param_type_name == "option" else arguments).append(row)
    return arguments, options


def _spelled(param: Any, names: str) -> str:
    """Return an option's names with its values in words: `--limit <int>`."""
    names = re.sub(r"<(int|float) range>", r"<\1>", names).replace("|", " or ")  # tables end a cell at a |
    return re.sub(r"<list\[(\w+)\]>", lambda kind: f"<{kind[1].lower()}>", names)


def _said(text: str) -> list[str]:
    """Return the help of a parameter, and what stands in brackets at its end."""
    found = re.fullmatch(r"(.*?)(?:\s*\[([^\[\]]*)\])?", text, re.DOTALL)
    assert found
    extra = "; ".join(part for part in (found[2] or "").split("; ") if part)
    return [_escaped(" ".join(found[1].split())), extra.replace("default: ", "")]


def _escaped(text: str) -> str:
    """Return text in which Markdown finds no tags."""
    return text.replace("<", "&lt;").replace("*", "\\*").replace("_", "\\_")


# -- the YAML of a robot


def yaml_page() -> str:
    """Return the page of all keys of a robot's YAML, from the JSON Schema of the registry."""
    schema = json.loads((FOLDER.parents[1] / "registry/embodiment.schema.json").read_text())
    parts = [
        f"{MADE}# Keys of a robot's YAML\n\nThis page is made from the JSON Schema that "
        "`hma registry schema` prints. [Adding a robot](../adding-a-robot.md) explains the keys in examples. "
        "Unknown keys are errors.",
        "## The file",
        _keys(schema),
    ]
    for name in (
        "Action",
        "Vector",
        "Component",
        "Camera",
        "Sync",
        "Quality",
        "SourceSpec",
        "Segments",
        "Marker",
    ):
        part = schema["$defs"][name]
        parts += [
            f"## {name}",
            part["description"].replace("\n\n", "\x00").replace("\n", " ").replace("\x00", "\n\n"),
        ]
        parts.append(_keys(part))
    parts.append(
        "## Layouts\n\n`source.layout` states where a recording has its data. Its keys depend on the format."
    )
    for name, layout in zip(FORMATS, schema["$defs"]["SourceSpec"]["allOf"], strict=False):
        chosen = layout["then"]["properties"]["layout"]["anyOf"][0]
        parts += [f"### {name}", _keys(chosen) if chosen["properties"] else "No keys."]
    return "\n\n".join(parts) + "\n"


def _keys(schema: Schema) -> str:
    required = schema.get("required", ())
    rows = []
    for key, value in schema["properties"].items():
        default = "required" if key in required else _plain(value.get("default"))
        rows.append([f"`{key}`", _kind(value), default, value.get("description", "").replace("<", "&lt;")])
    return table(["key", "values", "default", "meaning"], rows)


def _kind(value: Schema) -> str:
    """Return what a key takes, in words."""
    if "$ref" in value:
        name = value["$ref"].rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    if "anyOf" in value:
        return " or ".join(_kind(one) for one in value["anyOf"] if one.get("type") != "null")
    if "enum" in value:
        return ", ".join(f"`{one}`" for one in value["enum"])
    if "const" in value:
        return f"`{value['const']}`"
    kind = value.get("type", "mapping")
    if isinstance(kind, list):
        kind = kind[0]
    if kind == "array":
        items = value.get("items") or value.get("prefixItems", [{}])[0]
        return f"list of {_kind(items)}" if "items" in value else f"{value['minItems']} × {_kind(items)}"
    names = {"string": "text", "object": "mapping", "boolean": "true, false", "integer": "whole number"}
    low, high = value.get("minimum", value.get("ge")), value.get("maximum")
    limits = [f" {word} {limit:g}" for word, limit in (("from", low), ("to", high)) if limit is not None]
    return names.get(kind, kind) + "".join(limits)


def _plain(value: Any) -> str:
    if value is None or value == "" or value == []:
        return ""
    return "" if isinstance(value, dict) else f"`{json.dumps(value)}`"


# -- recipes


def recipe_page() -> str:
    """Return the page of all keys of a recipe, from `Recipe`, `MixtureSettings` and `HMAConfig`."""
    choices = [f"`{path.stem}`" for path in sorted((FOLDER.parents[1] / "recipes/train").glob("*.yaml"))]
    parts = [
        f"{MADE}# Keys of a recipe\n\nA recipe is a YAML file with these keys, for `hma train RECIPE "
        "[key=value …]` and `hma finetune`. `extends: NAME` starts from another recipe. On the "
        f"command line a dot addresses nested keys: `model.layers=4`. These recipes ship with the toolkit: "
        f"{', '.join(choices)}. Unknown keys are errors.",
        "## The run",
        _fields(Recipe),
        "## mixture\n\nHow often each robot is drawn: [the mixture](../mixture.md).",
        _fields(MixtureSettings),
        "## model\n\nThe network. The shards state the rest: kind, grid, digits, channels and scale.",
        table(["key", "default", "meaning"], list(_network())),
    ]
    return "\n\n".join(parts) + "\n"


def _fields(model: Any) -> str:
    described = model.model_json_schema()["properties"]
    rows = []
    for name, field in model.model_fields.items():
        default = field.default if field.default is not PydanticUndefined else None
        shown = (
            ""
            if default is None
            else f"`{json.dumps(default, default=lambda _: None)}`".replace("`null`", "")
        )
        known = ", ".join(f"`{one}`" for one in described[name].get("enum", ()))
        rows.append([f"`{name}`", shown, "; ".join(filter(None, (_meaning(name, field), known)))])
    return table(["key", "default", "meaning"], rows)


def _meaning(name: str, field: Any) -> str:
    """Return a field's description; the few without one are explained by this table."""
    return field.description or _OBVIOUS.get(name, "")


_OBVIOUS = {
    "mixture": "[below](#mixture)",
    "steps": "optimizer steps",
    "lr": "learning rate",
    "schedule": "learning rate after `warmup`",
    "betas": "of AdamW",
    "eps": "of AdamW",
    "weight_decay": "of AdamW",
    "seed": "random seed of data order, masks and new weights",
    "device": "`auto`, `cpu`, `mps`, `cuda` or `cuda:N`",
    "temperature": "τ of p ∝ n^(1/τ); 1 is proportional to size, larger is flatter",
    "draw": "sample the robot per window, or per batch",
}


def _network() -> Iterator[list[str]]:
    """Yield key, default and meaning of the network's fields; the meanings are the comments of its source."""
    meanings = _comments(inspect.getsource(HMAConfig))
    for field in dataclasses.fields(HMAConfig):
        if field.name in _DERIVED:
            continue
        default = list(field.default) if isinstance(field.default, tuple) else field.default
        choices = ", ".join(f"`{one}`" for one in _CHOICES.get(field.name, ()))
        meaning = "; ".join(filter(None, (meanings.get(field.name, ""), choices)))
        yield [f"`{field.name}`", f"`{json.dumps(default)}`", meaning.replace("<", "&lt;")]


def _comments(source: str) -> dict[str, str]:
    """Return each field's comment: the lines above it and the end of its own."""
    found: dict[str, str] = {}
    above: list[str] = []
    for line in source.splitlines():
        field = re.match(r"    (\w+): [^#]*?(?:#\s*(.*))?$", line)
        if line.startswith("    # "):
            above.append(line.strip("# "))
        elif field:
            found[field[1]] = " ".join([*above, field[2] or ""]).strip()
            above = []
        else:
            above = []
    return found


PAGES = {"cli.md": cli_page, "yaml.md": yaml_page, "recipe.md": recipe_page}


def main() -> None:
    """Write the pages."""
    FOLDER.mkdir(exist_ok=True)
    for name, page in PAGES.items():
        (FOLDER / name).write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
