"""Run `hma registry`: list and show embodiments, check their YAML, write a new robot's YAML, export it."""

import shlex
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer import Argument, Option

from hma_data.cli.options import Json, robots
from hma_data.console import human_count, print_json, print_table, say
from hma_data.registry import FORMATS

if TYPE_CHECKING:
    from hma_data.registry.catalog import RegistryEntry

registry_app = typer.Typer(no_args_is_help=True, help="List, check and write embodiment YAMLs.")
Id = Annotated[str, Argument(help="Registry id, or a YAML file.", autocompletion=robots)]
Out = Annotated[Path | None, Option(help="File to write; default: print.")]
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


@registry_app.command("list")
def registry_list(
    words: Annotated[
        list[str] | None, Argument(help="Only embodiments with all these words in id, robot or description.")
    ] = None,
    source: Annotated[
        str | None, Option(help=f"Only this format: {', '.join(FORMATS)}, or a plug-in's.")
    ] = None,
    json: Json = False,
) -> None:
    """List all embodiments of the registry.

    Example: hma registry list franka --source rlds
    """
    from hma_data.registry.catalog import entries

    found: dict[str, dict[str, Any]] = {}
    broken = []
    for entry in entries():
        if entry.facts is None:
            broken += [f"{entry.path}: {problem}" for problem in entry.problems]
        else:
            found.setdefault(entry.facts["id"], entry.facts)
    rows = []
    for _, row in sorted(found.items()):
        text = f"{row['id']} {row['robot']} {row['description']}".lower()
        mentioned = all(word.lower() in text for word in words or [])
        if mentioned and (source is None or row["format"] == source):
            rows.append(row)
    if json:
        print_json(rows)
    else:
        cells = []
        for row in rows:
            rate = row["frequency_hz"] if row["rate_hz"] is None else row["rate_hz"]  # "unknown", not a blank
            shown = {**row, "rate_hz": rate, "cameras": ", ".join(row["cameras"])}
            cells.append([shown[fact] for fact in LISTED.values()])
        print_table(list(LISTED), cells)
        print(human_count(len(rows), "embodiment"))
    for line in broken:
        say(f"not listed: {line}", err=True)
    raise typer.Exit(1 if broken else 0)


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
        list[Path] | None, Argument(help="Files or folders; default: the whole registry.")
    ] = None,
    json: Json = False,
) -> None:
    """Check YAMLs and list all problems.

    Example: hma registry validate my_robot.yaml
    """
    from hma_data.errors import RegistryError
    from hma_data.registry.catalog import entries
    from hma_data.registry.folders import registry_files

    files: list[Path] = []
    for path in paths or []:
        if not path.exists():
            raise RegistryError(path, "no such file or folder")
        files += registry_files([path]) if path.is_dir() else [path]
    if paths and not files:
        raise RegistryError(", ".join(map(str, paths)), "holds no .yaml or .yml file")
    judged = entries(files if paths else None)
    found = [(entry, problem) for entry in judged for problem in entry.problems]
    if json:
        listed = [{"file": str(entry.path), "problem": str(one), **asdict(one)} for entry, one in found]
        notes = [{"file": str(path), "note": note} for path, note in _notes(judged)]
        print_json({"files": len(judged), "problems": listed, "notes": notes})
    else:
        for entry, problem in found:
            say(f"{entry.path}: {problem}")
        for path, note in _notes(judged):
            say(f"{path}: note: {note}")
        say(f"{human_count(len(judged), 'file')}, {human_count(len(found), 'problem')}")
        if len(judged) == 1 and paths and (uri := (judged[0].facts or {}).get("uri")):
            say(f"then: hma inspect {shlex.quote(uri)} -e {shlex.quote(str(judged[0].path))}")
    raise typer.Exit(1 if found else 0)


def _notes(judged: "list[RegistryEntry]") -> Iterator[tuple[Path, str]]:
    """Yield path and note of the YAMLs that want more frames per second than were recorded."""
    for entry in judged:
        facts = entry.facts or {}
        target, rate, stride = (facts.get(name) for name in ("target_hz", "rate_hz", "stride"))
        if target and rate and target > rate and target != 2:  # 2 is the default, which nobody chose
            sees = f"the model sees {rate / (stride or 1):.4g} frames per second"
            given = f" with the stride {stride} that is given" if stride and stride > 1 else ""
            yield entry.path, f"target_hz {target:g} is above the recorded rate: {sees}{given}"


@registry_app.command("schema")
def registry_schema(out: Out = None) -> None:
    """Print or write the JSON Schema of a registry YAML, for editors.

    Example: hma registry schema --out registry/embodiment.schema.json
    """
    from hma_data.registry.embodiment import schema

    if out is None:
        print_json(schema())
        return
    _write_json(out, schema())
    say(f"wrote {out}; editors complete a YAML in the same folder if it starts with the line")
    say(f"# yaml-language-server: $schema={out.name}")


def _write_json(out: Path, values: Any, indent: int = 1) -> None:
    import json

    from hma_data.storage.files import write_atomic

    write_atomic(out, json.dumps(values, indent=indent) + "\n")


@registry_app.command("export")
def registry_export(
    id: Id,
    to: Annotated[Literal["modality.json", "lerobot-features"], Option(help="Format of the other project.")],
    out: Out = None,
) -> None:
    """Export an embodiment to another project's format: GR00T's modality.json, or LeRobotDataset features.

    Example: hma registry export so100 --to modality.json --out meta/modality.json
    """
    from hma_data.registry.embodiment import find
    from hma_data.registry.export import lerobot_features, modality

    embodiment = find(id)
    values = modality(embodiment) if to == "modality.json" else lerobot_features(embodiment)
    if out is None:
        print_json(values)
    else:
        _write_json(out, values, indent=4)
        say(f"wrote {out}")


@registry_app.command("infer")
def registry_infer(
    uri: Annotated[str, Argument(help="A recording of the robot.")],
    id: Annotated[str, Option(help="Id of the new embodiment.")],
    out: Out = None,
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
        raise OutputError(out, "exists already", "name another file with --out, or delete it first")
    text = infer(uri, id)
    if out is None:
        print(text, end="")
        return
    write_atomic(out, f"# yaml-language-server: $schema={_schema_for(out)}\n{text}")
    say(f"wrote {out}")
    values = parse_yaml(text, str(out))
    for line in text.splitlines()[1:2]:
        if line.startswith("# "):
            print(line[2:])
    asked = todos(values)
    for said in ("cameras", "sync", "segments"):
        measured = values.get("provenance", {}).get(said)
        if measured and f"provenance.{said}" not in dict(asked):
            print(measured)
    for path, question in asked:
        say(f"answer {path}: {question}")
    say(f"then: hma registry validate {shlex.quote(str(out))}")


def _schema_for(out: Path) -> str:
    """Return the path of a YAML's schema, relative to the YAML; write one beside it where there is none."""
    from hma_data.registry.embodiment import schema

    for up in range(3):
        place = Path(*[".."] * up, SCHEMA)
        if (out.parent / place).is_file():
            return str(place)
    _write_json(out.parent / SCHEMA, schema())
    return SCHEMA
