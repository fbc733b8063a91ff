"""List every embodiment of the registry, fast enough for ten thousand of them.

Each file is read and hashed. A cache keeps the facts and problems found in a file of those bytes, so each
YAML is parsed and validated only once. The key of an entry is a hash of the bytes and of the code that
judged them, never a time stamp; an entry cannot be out of date.
"""

import hashlib
import json
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from hma_data.errors import HMAError, RegistryError
from hma_data.registry import FORMATS
from hma_data.registry.folders import file_id, registry_files, registry_folders
from hma_data.storage.files import cache_folder, write_atomic
from hma_data.storage.paths import StrPath, as_path
from hma_data.storage.yaml_io import Problem, decode_yaml, parse_yaml, read_bytes


@dataclass(frozen=True)
class RegistryEntry:
    """One YAML of the registry.

    Attributes:
        path: of the file.
        facts: what `hma registry list` shows of it; None where it has problems.
        problems: everything that is wrong with it.
        name: the id that the file states, also where it has problems; None where it states none.
    """

    path: Path
    facts: dict[str, Any] | None
    problems: tuple[Problem, ...]
    name: str | None


def entries(files: Iterable[StrPath] | None = None) -> list[RegistryEntry]:
    """Return an Entry per YAML of the registry (or of those files, each a str or path), in search order.

    Problems between files are added: two files of one folder tree with the same id, and, in a registry
    folder, a file whose name is not its id.
    """
    cache = _Cache()
    if files is not None:
        found = _doubles([_entry(as_path(path), cache) for path in files])
    else:
        found = []
        for folder in registry_folders():
            for entry in _doubles([_entry(path, cache) for path in registry_files([folder])]):
                named = entry.facts is None or file_id(entry.path) == entry.name
                said = f"does not find its file {entry.path.name}: file name and id must be the same"
                found.append(entry if named else _with(entry, said))
    cache.save()
    return found


def _entry(path: Path, cache: "_Cache") -> RegistryEntry:
    try:
        found = cache.judgement(read_bytes(path), path)
    except HMAError as fault:
        found = _unreadable(fault)
    problems = tuple(Problem(**problem) for problem in found["problems"])
    return RegistryEntry(path, found["facts"], problems, found["name"])


def _judge(content: bytes, path: Path) -> dict[str, Any]:
    from hma_data.registry.embodiment import judged

    try:
        values = parse_yaml(decode_yaml(content, path), path.name)
    except HMAError as fault:
        return _unreadable(fault)
    robot, faults = judged(values)
    name = values.get("id") if isinstance(values, dict) else None
    return {
        "facts": None if robot is None else facts(robot),
        "problems": [asdict(fault) for fault in faults],
        "name": name if isinstance(name, str) else None,
    }


def facts(embodiment: Any) -> dict[str, Any]:
    """Return what list and show say of an embodiment, with derived values; None where the rate is unknown."""
    found = {
        "id": embodiment.id,
        "kind": embodiment.kind,
        "robot": embodiment.robot,
        "description": embodiment.description,
        "space": embodiment.action.space,
        "action_dim": embodiment.action_dim,
        "state_dim": embodiment.state.dims if embodiment.state else None,
        "frequency_hz": embodiment.frequency_hz,
        "target_hz": embodiment.target_hz,
    }
    for name in ("rate_hz", "stride", "effective_hz", "chunk_dim"):
        try:
            found[name] = getattr(embodiment, name)
        except RegistryError:
            found[name] = None
    return found | {
        "format": embodiment.source.format,
        "uri": embodiment.source.uri,
        "episodes": embodiment.source.episodes,
        "cameras": [camera.name for camera in embodiment.cameras],
        "license": embodiment.license,
        "digest": embodiment.digest,
    }


def _unreadable(fault: HMAError) -> dict[str, Any]:
    return {"facts": None, "problems": [asdict(Problem("", fault.fault))], "name": None}


def _with(entry: RegistryEntry, fault: str) -> RegistryEntry:
    problems = (*entry.problems, Problem("id", fault, repr(entry.name)))
    return replace(entry, facts=None, problems=problems)


def _doubles(found: list[RegistryEntry]) -> list[RegistryEntry]:
    """Add a problem to every file whose id an earlier file has."""
    owners: dict[str, Path] = {}
    for i, entry in enumerate(found):
        owner = entry.path if entry.name is None else owners.setdefault(entry.name, entry.path)
        if owner != entry.path:
            found[i] = _with(entry, f"is also the id of {owner}")
    return found


class _Cache:
    """The judgements of YAML files by the hash of their bytes, in one JSON file per version of the code."""

    def __init__(self) -> None:
        code = hashlib.blake2b(f"{version('pydantic')} {version('pyyaml')}".encode(), digest_size=12)
        for module in ("__init__", "catalog", "components", "embodiment", "folders", "../storage/yaml_io"):
            code.update((Path(__file__).parent / f"{module}.py").read_bytes())
        self._path = cache_folder() / f"registry-{code.hexdigest()}.json"
        self._kept: dict[str, dict[str, Any]] = {}
        self._new = False
        with suppress(OSError, ValueError):
            self._kept = json.loads(self._path.read_bytes())

    def judgement(self, content: bytes, path: Path) -> dict[str, Any]:
        """Return the facts, problems and name of a YAML with that content."""
        key = hashlib.sha256(content).hexdigest()
        if key not in self._kept:
            found = _judge(content, path)
            foreign = any(problem["path"] == "source.format" for problem in found["problems"])
            if foreign or (found["facts"] and found["facts"]["format"] not in FORMATS):
                return found  # installing a package changes what is said of a format that is not built in
            self._kept[key], self._new = found, True
        return self._kept[key]

    def save(self) -> None:
        """Write new entries; where the cache cannot be written, later runs are only slower."""
        if self._new:
            with suppress(HMAError, OSError):
                write_atomic(self._path, json.dumps(self._kept))
