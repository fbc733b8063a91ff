"""`hma registry`: look at embodiments, check their YAML, write the YAML of a new robot."""

from pathlib import Path
from typing import Annotated, Any

import typer

from hma_data.console import print_json, print_table

registry_app = typer.Typer(no_args_is_help=True, help="Look at embodiments, check and write their YAML.")
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]


@registry_app.command("list")
def registry_list(json: Json = False) -> None:
    """Every embodiment that an id finds.

    Example: hma registry list
    """
    from hma_data.embodiment import Embodiment, registry_files

    found: dict[str, Embodiment] = {}
    for path in registry_files():
        embodiment = Embodiment.load(path)
        found.setdefault(embodiment.id, embodiment)
    rows = [embodiment_facts(embodiment) for _, embodiment in sorted(found.items())]
    if json:
        print_json(rows)
    else:
        keys = [
            "id",
            "kind",
            "robot",
            "action_dim",
            "frequency_hz",
            "stride",
            "effective_hz",
            "format",
            "cameras",
        ]
        print_table(
            ["id", "kind", "robot", "dims", "Hz", "stride", "effective Hz", "source", "cameras"],
            [[", ".join(v) if isinstance(v := row[key], list) else v for key in keys] for row in rows],
        )


def embodiment_facts(embodiment: Any) -> dict[str, Any]:
    """What list and show say of an embodiment, derived values included; null where the rate is unknown."""
    from hma_data.errors import RegistryError

    facts = {
        "id": embodiment.id,
        "kind": embodiment.kind,
        "robot": embodiment.robot,
        "action_dim": embodiment.action_dim,
        "frequency_hz": embodiment.frequency_hz,
        "target_hz": embodiment.target_hz,
    }
    for name in ("stride", "effective_hz", "chunk_dim"):
        try:
            facts[name] = getattr(embodiment, name)
        except RegistryError:
            facts[name] = None
    return facts | {
        "format": embodiment.source.format,
        "uri": embodiment.source.uri,
        "cameras": [camera.name for camera in embodiment.cameras],
        "digest": embodiment.digest,
    }


@registry_app.command("show")
def registry_show(
    id: Annotated[str, typer.Argument(help="Registry id, or a YAML file.")], json: Json = False
) -> None:
    """One embodiment and what follows from it.

    Example: hma registry show pusht_fast
    """
    from hma_data.embodiment import find

    embodiment = find(id)
    facts = embodiment_facts(embodiment)
    if json:
        print_json({**embodiment.to_dict(), "derived": facts})
        return
    print(embodiment.to_yaml())
    derived = {k: facts[k] for k in ("action_dim", "stride", "effective_hz", "chunk_dim", "digest")}
    print("# derived: " + ", ".join(f"{name} {value}" for name, value in derived.items()))


@registry_app.command("validate")
def registry_validate(
    paths: Annotated[
        list[Path] | None, typer.Argument(help="Files or folders; the whole registry without any.")
    ] = None,
    json: Json = False,
) -> None:
    """Every problem of every YAML, listed at once.

    Example: hma registry validate my_robot.yaml
    """
    from hma_data.embodiment import ID_PATTERN, problems, registry_files
    from hma_data.errors import HMAError, RegistryError
    from hma_data.yaml_io import read_yaml

    files: list[Path] = []
    for path in paths or []:
        if not path.exists():
            raise RegistryError(path, "does not exist")
        files += registry_files([path]) if path.is_dir() else [path]
    files = files or list(registry_files())
    found: list[dict[str, str]] = []
    ids: dict[str, Path] = {}
    for file in files:
        try:
            values = read_yaml(file)
        except HMAError as fault:
            found.append({"file": str(file), "problem": fault.fault})
            continue
        found += [{"file": str(file), "problem": problem} for problem in problems(values)]
        name = values.get("id") if isinstance(values, dict) else None
        if isinstance(name, str) and ID_PATTERN.fullmatch(name):
            if name in ids:
                found.append({"file": str(file), "problem": f"id: {name!r} is also the id of {ids[name]}"})
            ids.setdefault(name, file)
    if json:
        print_json({"files": len(files), "problems": found})
    else:
        for item in found:
            print(f"{item['file']}: {item['problem']}")
        print(f"{len(files)} files, {len(found)} problems")
    raise typer.Exit(1 if found else 0)


@registry_app.command("schema")
def registry_schema() -> None:
    """The JSON Schema of a registry YAML.

    Example: hma registry schema > embodiment.schema.json
    """
    from hma_data.embodiment import schema

    print_json(schema())


@registry_app.command("infer")
def registry_infer(
    uri: Annotated[str, typer.Argument(help="A recording of the robot.")],
    id: Annotated[str, typer.Option("--id", help="Id of the new embodiment.")],
    out: Annotated[Path | None, typer.Option("--out", help="File to write; default: print.")] = None,
) -> None:
    """Write a robot's YAML from one of its recordings.

    Example: hma registry infer ./data --id my_arm --out my_arm.yaml
    """
    from hma_data.embodiment import todos
    from hma_data.errors import OutputError
    from hma_data.files import write_atomic
    from hma_data.infer import infer
    from hma_data.yaml_io import parse_yaml

    text = infer(uri, id)
    if out is None:
        print(text, end="")
        return
    if out.exists():
        raise OutputError(out, "exists already", "choose another --out, or delete it first")
    write_atomic(out, text)
    print(f"wrote {out}")
    for path, question in todos(parse_yaml(text, str(out))):
        print(f"answer {path}: {question}")
