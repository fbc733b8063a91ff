"""List every embodiment of the registry, fast enough for ten thousand of them.

Each file is read and hashed. A cache keeps the facts and problems found in a file of those bytes, so each
YAML is parsed and validated only once. The key of an entry is a hash of the bytes and of the code that
judged them, never a time stamp; an entry cannot be out of date.
"""

import hashlib
import json
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from hma_data.errors import HMAError, RegistryError
from hma_data.registry.formats import FORMATS
from hma_data.storage.files import cache_folder, write_atomic
from hma_data.storage.paths import StrPath, as_path, shipped
from hma_data.storage.yaml_io import decode_yaml, parse_yaml, read_bytes

MAX_KEPT = 100_000  # judgements kept in the cache
_JUDGES = (
    "registry/embodiment.py", "registry/components.py", "registry/formats.py", "registry/catalog.py",
    "storage/yaml_io.py",
)  # fmt: skip


def registry_folders(beside: StrPath | None = None) -> list[Path]:
    """Return the folders searched for an id, in order: ./registry, $HMA_REGISTRY, a checkpoint's, shipped.

    Args:
        beside: str or path of the checkpoint.
    """
    folders = [Path("registry")]
    folders += [Path(entry) for entry in os.environ.get("HMA_REGISTRY", "").split(os.pathsep) if entry]
    if beside:
        folders.append(as_path(beside) / "embodiments")
    folders.append(shipped("registry"))
    return list(dict.fromkeys(folder.resolve() for folder in folders if folder.is_dir()))


def registry_files(folders: Iterable[StrPath] | None = None) -> Iterator[Path]:
    """Yield every YAML of the registry (or of those folders, each a str or path), in search order."""
    for folder in registry_folders() if folders is None else map(as_path, folders):
        found = [
            f"{root}/{name}"
            for root, _, names in os.walk(folder)
            for name in names
            if name.endswith((".yaml", ".yml"))
        ]
        yield from map(Path, sorted(found))


def file_id(path: Path) -> str:
    """Return the id by which a registry file is found.

    It is the file's name, or for `embodiment.yaml`, as in a checkpoint, the name of its folder.
    """
    return path.parent.name if path.stem == "embodiment" else path.stem


@dataclass(frozen=True)
class Entry:
    """One YAML of the registry.

    Attributes:
        path: of the file.
        facts: what `hma registry list` shows of it; None where it has problems.
        problems: the fields of `hma_data.registry.embodiment.Problem`: path, fault, value, allowed.
        name: the id that the file states, also where it has problems; None where it states none.
    """

    path: Path
    facts: dict[str, Any] | None
    problems: tuple[dict[str, str | None], ...]
    name: str | None


def entries(files: Iterable[StrPath] | None = None) -> list[Entry]:
    """Return an Entry per YAML of the registry (or of those files, each a str or path), in search order.

    Problems between files are added: two files of one folder tree with the same id, and, in a registry
    folder, a file whose name is not its id.
    """
    judged = _Cache()
    if files is not None:
        found = [_entry(as_path(path), judged) for path in files]
        judged.save()
        return _doubles(found)
    found = []
    for folder in registry_folders():
        judged_here = [_entry(path, judged) for path in registry_files([folder])]
        found += [_misnamed(entry) for entry in _doubles(judged_here)]
    judged.save()
    return found


def _entry(path: Path, judged: "_Cache") -> Entry:
    try:
        content = read_bytes(path)
        said = judged.get(content) or judged.put(content, _judge(content, path))
    except HMAError as fault:
        return Entry(path, None, (_plain("", fault.fault),), None)
    return Entry(path, said["facts"], tuple(said["problems"]), said["name"])


def _judge(content: bytes, path: Path) -> dict[str, Any]:
    from dataclasses import asdict

    from hma_data.registry.embodiment import Embodiment, find_problems

    try:
        values = parse_yaml(decode_yaml(content, path), path.name)
    except HMAError as fault:
        return {"facts": None, "problems": [_plain("", fault.fault)], "name": None}
    faults = find_problems(values)
    name = values.get("id") if isinstance(values, dict) else None
    return {
        "facts": None if faults else facts(Embodiment.model_validate(values)),
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


def _plain(path: str, fault: str, value: str | None = None) -> dict[str, str | None]:
    return {"path": path, "fault": fault, "value": value, "allowed": None}


def _with(entry: Entry, problem: dict[str, str | None]) -> Entry:
    return Entry(entry.path, None, (*entry.problems, problem), entry.name)


def _doubles(found: list[Entry]) -> list[Entry]:
    """Add a problem to every file whose id an earlier file has."""
    first: dict[str, Path] = {}
    result = []
    for entry in found:
        owner = first.setdefault(entry.name, entry.path) if entry.name is not None else entry.path
        if owner != entry.path:
            entry = _with(entry, _plain("id", f"is also the id of {owner}", repr(entry.name)))
        result.append(entry)
    return result


def _misnamed(entry: Entry) -> Entry:
    """Add a problem to a file of a registry folder whose name is not its id."""
    if entry.facts is None or file_id(entry.path) == entry.name:
        return entry
    fault = f"does not find its file {entry.path.name}: file name and id must be the same"
    return _with(entry, _plain("id", fault, repr(entry.name)))


def _asked_packages(said: dict[str, Any]) -> bool:
    """Check whether a judgement was of a format that is not built in: installing a package changes it."""
    if said["facts"]:
        return said["facts"]["format"] not in FORMATS
    return any(problem["path"] == "source.format" for problem in said["problems"])


class _Cache:
    """Facts and problems by the hash of a YAML's bytes, in one JSON file per version of the judging code."""

    def __init__(self) -> None:
        package = Path(__file__).parents[1]
        code = hashlib.blake2b(digest_size=12)
        for name in _JUDGES:
            code.update((package / name).read_bytes())
        code.update(f"{version('pydantic')} {version('pyyaml')}".encode())
        self._path = cache_folder() / f"registry-{code.hexdigest()}.json"
        self._kept = self._load()
        self._used: dict[str, Any] = {}
        self._new = False

    def _load(self) -> dict[str, Any]:
        try:
            kept = json.loads(self._path.read_bytes())
        except (OSError, ValueError):
            return {}
        return kept if isinstance(kept, dict) else {}

    def get(self, content: bytes) -> dict[str, Any] | None:
        name = hashlib.sha256(content).hexdigest()
        said = self._kept.get(name)
        if not isinstance(said, dict) or said.keys() != {"facts", "problems", "name"}:
            return None
        self._used[name] = said
        return said

    def put(self, content: bytes, said: dict[str, Any]) -> dict[str, Any]:
        if not _asked_packages(said):
            self._used[hashlib.sha256(content).hexdigest()] = said
            self._new = True
        return said

    def save(self) -> None:
        """Write the new entries; where the cache cannot be written, later runs are only slower."""
        if not self._new:
            return
        room = MAX_KEPT - len(self._used)
        older = [name for name in self._kept if name not in self._used][: max(room, 0)]
        try:
            write_atomic(self._path, json.dumps({name: self._kept[name] for name in older} | self._used))
            for old in self._path.parent.glob("registry-*.json"):
                if old != self._path and old.stat().st_mtime < self._path.stat().st_mtime - 30 * 86_400:
                    old.unlink()
        except (HMAError, OSError):
            return
