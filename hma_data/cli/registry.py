"""Run `hma registry`: list and show embodiments, check their YAML, write a new robot's YAML, export it."""

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from hma_data.console import print_json, print_table
from hma_data.registry import FORMATS

registry_app = typer.Typer(no_args_is_help=True, help="Look at embodiments, check and write their YAML.")
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Id = Annotated[str, typer.Argument(help="Registry id, or a YAML file.")]
SCHEMA = "embodiment.schema.json"  # the first line of a YAML names it for editors
LISTED = {  # column -> fact
    "id": "id",
    "kind": "kind",
    "robot": "robot",
    "dims": "action_dim",
    "Hz": "rate_hz",
    "stride": "stride",
    "effective Hz": "effective_hz",
    "source": "format",
    "cameras": "cameras",
}


class Kind(StrEnum):
    real = "real"
    simulation = "simulation"
    human = "human"


class Convention(StrEnum):
    modality = "modality.json"
    lerobot = "lerobot-features"


@registry_app.command("list")
def registry_list(
    words: Annotated[
        list[str] | None, typer.Argument(help="Only those with all these words in id, robot or description.")
    ] = None,
    kind: Annotated[Kind | None, typer.Option("--kind", help="Only this kind.")] = None,
    source: Annotated[
        str | None, typer.Option("--source", help=f"Only this format: {', '.join(FORMATS)}, or a package's.")
    ] = None,
    space: Annotated[str | None, typer.Option("--space", help="Only this action space.")] = None,
    dims: Annotated[int | None, typer.Option("--dims", help="Only this many action dims.")] = None,
    hz: Annotated[str | None, typer.Option("--hz", help="Only this rate, or: unknown.")] = None,
    json: Json = False,
) -> None:
    """List every embodiment that can be found by its id.

    Example: hma registry list franka --source rlds
    """
    from hma_data.registry.catalog import entries

    found: dict[str, dict[str, Any]] = {}
    broken = []
    for entry in entries():
        if entry.facts is None:
            broken += [f"{entry.path}: {_line(problem)}" for problem in entry.problems]
        else:
            found.setdefault(entry.facts["id"], entry.facts)
    exact = {"kind": kind, "format": source, "space": space, "action_dim": dims}
    rows = [
        row
        for _, row in sorted(found.items())
        if all(wanted is None or row[key] == wanted for key, wanted in exact.items())
        and (hz is None or _rate_is(row["frequency_hz"], hz))
        and _mentions(row, words or [])
    ]
    if json:
        print_json(rows)
    else:
        _print_list(rows)
    for line in broken:
        print(f"not listed: {line}", file=sys.stderr)
    raise typer.Exit(1 if broken else 0)


def _mentions(row: dict[str, Any], words: list[str]) -> bool:
    text = f"{row['id']} {row['robot']} {row['description']}".lower()
    return all(word.lower() in text for word in words)


def _rate_is(rate: float | str | None, wanted: str) -> bool:
    if rate is None or isinstance(rate, str):
        return wanted == (rate or "null")
    try:
        return rate == float(wanted)
    except ValueError:
        return False


def _print_list(rows: list[dict[str, Any]]) -> None:
    cells = [[row[fact] for fact in LISTED.values()] for row in rows]
    for row, shown in zip(rows, cells, strict=True):
        if row["rate_hz"] is None:  # a word such as "unknown" says more than a blank
            shown[list(LISTED).index("Hz")] = row["frequency_hz"]
    print_table(list(LISTED), [[", ".join(v) if isinstance(v, list) else v for v in row] for row in cells])
    print(f"{len(rows):,} embodiment{'s' if len(rows) != 1 else ''}")


@registry_app.command("show")
def registry_show(id: Id, json: Json = False) -> None:
    """Show one embodiment and the values derived from it.

    Example: hma registry show pusht_fast
    """
    from hma_data.registry.catalog import facts
    from hma_data.registry.embodiment import find

    embodiment = find(id)
    said = facts(embodiment)
    if json:
        print_json({**embodiment.to_dict(), "derived": said})
        return
    print(embodiment.to_yaml())
    derived = {k: said[k] for k in ("action_dim", "stride", "effective_hz", "chunk_dim", "digest")}
    print("# derived: " + ", ".join(f"{name} {_known(value)}" for name, value in derived.items()))


def _known(value: Any) -> str:
    if value is None:
        return "unknown"
    return f"{value:g}" if isinstance(value, float) else str(value)


@registry_app.command("validate")
def registry_validate(
    paths: Annotated[
        list[Path] | None, typer.Argument(help="Files or folders; the whole registry without any.")
    ] = None,
    json: Json = False,
) -> None:
    """List every problem of every YAML.

    Example: hma registry validate my_robot.yaml
    """
    from hma_data.errors import RegistryError
    from hma_data.registry.catalog import entries, registry_files

    files: list[Path] = []
    for path in paths or []:
        if not path.exists():
            raise RegistryError(path, "does not exist")
        files += registry_files([path]) if path.is_dir() else [path]
    if paths and not files:
        raise RegistryError(", ".join(map(str, paths)), "has no .yaml or .yml file")
    judged = entries(files if paths else None)
    found = [(entry, problem) for entry in judged for problem in entry.problems]
    if json:
        listed = [{"file": str(entry.path), "problem": _line(problem), **problem} for entry, problem in found]
        print_json({"files": len(judged), "problems": listed})
    else:
        for entry, problem in found:
            print(f"{entry.path}: {_line(problem)}")
        print(f"{len(judged)} files, {len(found)} problems")
    raise typer.Exit(1 if found else 0)


def _line(problem: dict[str, str | None]) -> str:
    """Return a problem as text, as `Problem` of the registry does, without importing it."""
    text = f"{problem['path']}: {problem['fault']}" if problem["path"] else str(problem["fault"])
    if problem["value"] is not None:
        text += f" (is {problem['value']})"
    return text + (f"; allowed: {problem['allowed']}" if problem["allowed"] else "")


@registry_app.command("schema")
def registry_schema(
    out: Annotated[Path | None, typer.Option("--out", help="File to write; default: print.")] = None,
) -> None:
    """Print or write the JSON Schema of a registry YAML, for editors.

    Example: hma registry schema --out registry/embodiment.schema.json
    """
    if out is None:
        from hma_data.registry.embodiment import schema

        print_json(schema())
        return
    _write_schema(out)
    print(f"wrote {out}; a YAML beside it is completed by editors with the line")
    print(f"# yaml-language-server: $schema={out.name}")


def _write_schema(out: Path) -> None:
    import json

    from hma_data.registry.embodiment import schema
    from hma_data.storage.files import write_atomic

    write_atomic(out, json.dumps(schema(), indent=1) + "\n")


@registry_app.command("export")
def registry_export(
    id: Id,
    to: Annotated[Convention, typer.Option("--to", help="Whose convention.")],
    out: Annotated[Path | None, typer.Option("--out", help="File to write; default: print.")] = None,
) -> None:
    """Export an embodiment to another project's format: GR00T's modality.json, or LeRobotDataset features.

    Example: hma registry export so100 --to modality.json --out meta/modality.json
    """
    import json

    from hma_data.registry.embodiment import find
    from hma_data.registry.export import lerobot_features, modality
    from hma_data.storage.files import write_atomic

    embodiment = find(id)
    values = modality(embodiment) if to is Convention.modality else lerobot_features(embodiment)
    if out is None:
        print_json(values)
        return
    write_atomic(out, json.dumps(values, indent=4) + "\n")
    print(f"wrote {out}")


@registry_app.command("infer")
def registry_infer(
    uri: Annotated[str, typer.Argument(help="A recording of the robot.")],
    id: Annotated[str, typer.Option("--id", help="Id of the new embodiment.")],
    out: Annotated[Path | None, typer.Option("--out", help="File to write; default: print.")] = None,
) -> None:
    """Write a robot's YAML from one of its recordings.

    Example: hma registry infer ./data --id my_arm --out registry/my_arm.yaml
    """
    from hma_data.errors import OutputError
    from hma_data.inspection.infer import infer
    from hma_data.registry.embodiment import todos
    from hma_data.storage.files import write_atomic
    from hma_data.storage.yaml_io import parse_yaml

    if out is not None and out.exists():
        raise OutputError(out, "exists already", "choose another --out, or delete it first")
    text = infer(uri, id)
    if out is None:
        print(text, end="")
        return
    write_atomic(out, f"# yaml-language-server: $schema={_schema_for(out)}\n{text}")
    print(f"wrote {out}")
    for path, question in todos(parse_yaml(text, str(out))):
        print(f"answer {path}: {question}")


def _schema_for(out: Path) -> str:
    """Return the path of a YAML's schema, relative to the YAML; write one beside it where there is none."""
    for up in range(3):
        place = Path(*[".."] * up, SCHEMA)
        if (out.parent / place).is_file():
            return str(place)
    _write_schema(out.parent / SCHEMA)
    return SCHEMA
