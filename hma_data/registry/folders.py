"""Find the YAML files of the registry: where they are searched, and by which id each is found."""

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from hma_data.storage.paths import StrPath, as_path, shipped


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
