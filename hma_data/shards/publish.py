"""Publish a shard set: its shards first, in commits of bounded size, and the manifest in the last commit.

A place without a manifest holds no shard set. Files that are already there with the same content are left
out, so the same call continues an upload that was interrupted.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Protocol

from hma_data.shards.manifest import EMBODIMENT, EPISODES, MANIFEST, QUARANTINE, SHARD_NAME, Manifest

FILES, BYTES = 50, 5 * 10**9  # largest numbers of files and bytes in a commit
SMALL = (EMBODIMENT, EPISODES, QUARANTINE)


class Place(Protocol):
    """A place to publish a shard set: a `Repository`, or the `FolderStore` of `hma_model`."""

    def files(self) -> dict[str, int]:
        """Return the sizes of the place's files, by name."""
        ...

    def has(self, name: str, content: Path | bytes, sha256: str | None = None) -> bool:
        """Check whether what `files` saw has this content under this name."""
        ...

    def publish(self, changes: Callable[[], Mapping[str, Path | bytes | None]], message: str) -> str:
        """Write files, delete those whose value is None, and return the place's address.

        If somebody else changed the place first, `changes` is called again.
        """
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
        place: where to publish; its `files` were already called.
        folder: folder of the set on this machine.
        require: calls the place's `files` and returns them; raises if they must not be changed.
        below: folder in the place; empty for its top.
        page: content of README.md, if there is to be one.

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
        stale = there and not place.has(begin + MANIFEST, folder / MANIFEST)  # it names other shards
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
    """Divide names into groups, one for each commit; there is at least one group, which may be empty."""
    groups: list[list[str]] = [[]]
    total = 0
    for name, size in sizes:
        if groups[-1] and (len(groups[-1]) >= FILES or total + size > BYTES):
            groups.append([])
            total = 0
        groups[-1].append(name)
        total += size
    return groups
