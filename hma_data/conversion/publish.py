"""Publish a shard set: its shards first, in commits of bounded size, and the manifest in the last commit.

A place without a manifest holds no shard set. Files that are already there with the same content are left
out, so the same call continues an upload that was interrupted.

`hma convert --out hf://datasets/org/name[@branch]/path` makes the set in a staging folder of this machine
($HMA_CACHE/staging), where it can be resumed like any other. Then it is published: a repository takes few
commits, not files one by one.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Protocol

from hma_data.errors import OutputError
from hma_data.hub.repository import Repository
from hma_data.shards.manifest import EMBODIMENT, EPISODES, MANIFEST, QUARANTINE, SHARD_NAME, Manifest
from hma_data.storage.files import cache_folder, short_sha256
from hma_data.storage.remote import RemotePath

FILES, BYTES = 50, 5 * 10**9  # largest numbers of files and bytes in a commit
SMALL = (EMBODIMENT, EPISODES, QUARANTINE)
_URI = re.compile(r"hf://datasets/([^/@]+/[^/@]+)(?:@([^/]+))?(?:/(.+))?")


class Place(Protocol):
    """A place to publish a shard set: a `Repository`, or the `FolderStore` of `hma_model`."""

    def files(self) -> dict[str, int]:
        """Return the sizes of the place's files, by name."""

    def holds(self, name: str) -> bool:
        """Check whether there is such a file now; a place whose files are many need not list them for it."""

    def has(self, name: str, content: Path | bytes, sha256: str | None = None) -> bool:
        """Check whether what `files` saw has this content under this name."""

    def publish(self, changes: Callable[[], Mapping[str, Path | bytes | None]], message: str) -> str:
        """Write files, delete those whose value is None, and return the place's address.

        If somebody else changed the place first, `changes` is called again.
        """


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
        there = place.holds(begin + MANIFEST) and begin + MANIFEST in require()
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


@dataclass(frozen=True)
class HubOutput:
    """The place of a conversion's shard set in a dataset repository.

    Attributes:
        uri: as the user gave it.
        repo: organisation/name of the dataset.
        branch: None for the main one.
        folder: in the repository; empty for its root.
    """

    uri: str
    repo: str
    branch: str | None
    folder: str

    @classmethod
    def of(cls, out: Path) -> "HubOutput | None":
        """Return the output of an `hf://` path; None for any other path."""
        if not isinstance(out, RemotePath) or out.scheme != "hf":
            return None
        found = _URI.fullmatch(str(out))
        if not found:
            raise OutputError(out, "names no dataset of the hub", "write hf://datasets/ORGANISATION/NAME")
        return cls(str(out), found[1], found[2], found[3] or "")

    @property
    def staging(self) -> Path:
        """Return the folder of this machine from which the set is uploaded."""
        mark = short_sha256(self.uri, 8)
        return cache_folder() / "staging" / f"{self.repo.replace('/', '--')}-{mark}"

    def prepare(self) -> bool:
        """Create the repository and the branch where they are missing; check whether a set is there."""
        manifest = f"{self.folder}/{MANIFEST}" if self.folder else MANIFEST
        self._repository.prepare(manifest)
        return manifest in self._repository.files()

    def upload(self) -> None:
        """Upload the staging folder's shard set."""
        self._repository.files()
        publish(self._repository, self.staging, self._repository.files, self.folder)

    @cached_property
    def _repository(self) -> Repository:
        return Repository(self.repo, self.branch, write=True, kind="dataset", name=self.uri)
