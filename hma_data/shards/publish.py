"""Publish a shard set: its shards first, in commits of bounded size, and the manifest in the last.

Who finds no manifest finds no shard set. What is there already with the same content is left out, so the same
call goes on with an upload that was cut off.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Protocol

from hma_data.shards.manifest import EMBODIMENT, EPISODES, MANIFEST, QUARANTINE, SHARD_NAME, Manifest

FILES, BYTES = 50, 5 * 10**9  # of a commit
SMALL = (EMBODIMENT, EPISODES, QUARANTINE)


class Place(Protocol):
    """Where a shard set is published: a `Repository`, or the `FolderStore` of `hma_model`."""

    def files(self) -> dict[str, int]:
        """Return sizes by name of what is there."""
        ...

    def has(self, name: str, content: Path | bytes, sha256: str | None = None) -> bool:
        """Check whether what `files` saw has this content under this name."""
        ...

    def publish(self, changes: Callable[[], Mapping[str, Path | bytes | None]], message: str) -> str:
        """Put files in place, delete where None, and return the address; `changes` is asked again where
        somebody else was faster."""
        ...


def publish(
    place: Place,
    folder: Path,
    require: Callable[[], Mapping[str, int]],
    below: str = "",
    page: bytes | None = None,
) -> str:
    """Put a shard set into a repository or folder.

    Args:
        place: where; its `files` were asked for.
        folder: of the set on this machine.
        require: asks for the place's `files` and returns them; raises where they must not be changed.
        below: folder in the place; empty for its top.
        page: README.md, where there shall be one.

    Returns:
        The place's address.
    """
    manifest = Manifest.load(folder)
    name, begin = manifest.embodiment.id, f"{below}/" if below else ""
    shards = {shard.path: shard for shard in manifest.shards}
    missing = [path for path in shards if not place.has(begin + path, folder / path, shards[path].sha256)]
    *batches, final = _batches([(path, shards[path].bytes) for path in missing])

    def part(batch: Sequence[str]) -> dict[str, Path | bytes | None]:
        there = begin + MANIFEST in require()
        stale = there and not place.has(begin + MANIFEST, folder / MANIFEST)  # it would name other shards
        files: dict[str, Path | bytes | None] = {begin + path: folder / path for path in batch}
        return files | ({begin + MANIFEST: None} if stale else {})

    def last() -> dict[str, Path | bytes | None]:
        left = [path.removeprefix(begin) for path in require() if path.startswith(begin)]
        gone = [path for path in left if SHARD_NAME.fullmatch(path) and path not in shards]
        small = [path for path in SMALL if (folder / path).is_file()]
        files: dict[str, Path | bytes | None] = {begin + path: None for path in gone}
        files |= {begin + path: folder / path for path in (*final, *small)}
        return files | ({begin + "README.md": page} if page else {}) | {begin + MANIFEST: folder / MANIFEST}

    for number, batch in enumerate(batches, 1):
        place.publish(partial(part, batch), f"Add shards of {name}, {number} of {len(batches) + 1}")
    return place.publish(last, f"Add {name}")


def _batches(sizes: Sequence[tuple[str, int]]) -> list[list[str]]:
    """Return names in groups of a commit; at least one group, which may be empty."""
    groups: list[list[str]] = [[]]
    total = 0
    for name, size in sizes:
        if groups[-1] and (len(groups[-1]) >= FILES or total + size > BYTES):
            groups.append([])
            total = 0
        groups[-1].append(name)
        total += size
    return groups
