"""Open hubs: folders of this machine, fsspec URIs, and repositories of the Hugging Face Hub.

A push to a folder writes its files under temporary names and renames them one by one: config and trunk
first, then the parts of each embodiment with its card last. An embodiment without a card counts as absent.
The same push again completes one that was killed. Pushes to a folder of this machine wait for one another. In
a store nothing is locked: the first config.json stays, and the digests in the cards reveal a mixture of two
pushes.
"""

import fcntl
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from hma_data.errors import HubError, MissingDependencyError, OutputError, StorageAwayError, StorageError
from hma_data.hub.repository import Repository
from hma_data.registry.embodiment import ID_PATTERN
from hma_data.storage.files import (
    MAX_JSON_BYTES,
    PART,
    atomic_path,
    file_sha256,
    json_object,
    part_of,
    remove_dead_parts,
    sync_folder,
    write_atomic,
)  # fmt: skip
from hma_data.storage.paths import StrPath, addressed, as_address, as_text, is_repository
from hma_data.storage.remote import WHOLE_PUTS, RemotePath, attempt, create_bytes, place
from hma_model.checkpoint.folder import CARD, CONFIG, README, TRUNK


class FolderStore:
    """A hub in a folder, with the methods of `hma_data.hub.repository.Repository`.

    Args:
        address: a path or an fsspec URI.
        write: make the folder if it does not exist.
    """

    repo: str | None = None
    from_cache = False

    def __init__(self, address: StrPath, write: bool = False) -> None:
        text = as_text(address)
        self._unfinished: set[str] | None = None  # what killed pushes have left, once it was listed
        self.name = text if "://" in text else str(Path(text).expanduser())
        with _explained(self.name, "used"):
            self._root = place(self.name)
            there = self._root.is_dir()
        if write and not there:
            with _explained(self.name, "made"):
                self._root.mkdir(parents=True, exist_ok=True)
        elif not there:
            raise HubError(text, "no such folder", "for a repository of the hub write ORGANISATION/NAME")

    def files(self) -> dict[str, int]:
        """Return the sizes of files by name, without unfinished files and training state."""
        return {
            name: size
            for name, size in self._sizes().items()
            if not name.endswith(PART) and not name.startswith("training/")
        }

    def warm(self, names: list[str]) -> None:
        """Do nothing: reading files one by one is fast here."""

    def read(self, name: str) -> bytes:
        """Return the content of a file of at most 16 MB."""
        with _explained(f"{self.name}/{name}", "read"):
            if (self._root / name).stat().st_size > MAX_JSON_BYTES:
                fault = f"is larger than {MAX_JSON_BYTES:,} bytes"
                raise HubError(f"{self.name}/{name}", fault, "the toolkit writes no such file")
            return (self._root / name).read_bytes()

    def holds(self, name: str) -> bool:
        """Check whether there is such a file."""
        with _explained(f"{self.name}/{name}", "read"):
            return (self._root / name).is_file()

    def has(self, name: str, content: Path | bytes, sha256: str | None = None) -> bool:
        """Check whether a file has this content already; return False in a store, where reading is slow."""
        if isinstance(self._root, RemotePath):
            return False
        path = self._root / name
        if isinstance(content, bytes):
            return path.is_file() and path.read_bytes() == content
        return path.is_file() and file_sha256(path) == (sha256 or file_sha256(content))

    # -- pulling

    def pull(self, names: list[str]) -> Path:
        """Return the hub's folder."""
        return self._root

    def download(self, names: list[str], out: Path) -> None:
        """Copy the files that `out` lacks or that differ there."""
        for folder in {(out / name).parent for name in names}:
            with _explained(folder, "pulled"):
                remove_dead_parts(folder)  # of a killed pull
        for name in names:
            target, ours = out / name, self._root / name
            with _explained(target, "pulled"):
                if target.is_file():
                    sizes = {path.stat().st_size for path in (ours, target)}
                    if len(sizes) == 1 and file_sha256(ours) == file_sha256(target):
                        continue
                    if name in (CONFIG, TRUNK) and any(out.glob("embodiments/*/card.json")):
                        fault = f"has another {name} with embodiments of its own"
                        raise HubError(out, fault, "pull to another folder")
                with atomic_path(target) as part:
                    _copy(ours, part)

    # -- pushing

    def publish(self, changes: Callable[[], Mapping[str, Path | bytes | None]], message: str) -> str:
        """Write all files under temporary names and rename them; make README.md last, from the new state."""
        staged: dict[str, Path] = {}
        with _explained(self.name, "written"), _locked(self._root):
            files = dict(changes())
            self._sweep({*files, README})
            page = files.pop(README, None)
            try:
                for name, content in files.items():
                    if content is not None:
                        staged[name] = self._stage(name, content)
                for name, content in files.items():
                    if content is None:
                        (self._root / name).unlink(missing_ok=True)
                    else:
                        self._settle(name, staged.pop(name))
            finally:
                for part in staged.values():
                    part.unlink(missing_ok=True)
            # The page lists all embodiments, also those that somebody pushed meanwhile.
            if page is not None and (now := changes().get(README)):
                write_atomic(self._root / README, now if isinstance(now, bytes) else now.read_bytes())
        return self.name

    def _stage(self, name: str, content: Path | bytes) -> Path:
        part = part_of(self._root / name)
        part.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(part, RemotePath) and isinstance(content, bytes):
            # not write_atomic: a kill would leave a temporary file of the temporary one, which no sweep knows
            attempt(part, "written", lambda: part.files.pipe_file(part.key, content))
        elif isinstance(content, bytes):
            write_atomic(part, content)
        elif isinstance(part, RemotePath):
            attempt(part, "written", lambda: part.files.put_file(str(content), part.key))
        else:
            _copy(content, part)
            sync_folder(part)
        return part

    def _settle(self, name: str, part: Path) -> None:
        final = self._root / name
        if name == CONFIG and isinstance(final, RemotePath):
            whole = final.scheme in WHOLE_PUTS
            # The first config.json decides whose trunk the hub has; a store has no locks.
            if not (create_bytes(part.read_bytes(), final) if whole else not final.exists()):
                raise HubError(self.name, "another push has just begun here", "push again")
        part.replace(final)

    def _sweep(self, files: set[str]) -> None:
        """Delete the temporary files of killed pushes; in a store only those of the files pushed now."""
        if self._unfinished is None:
            self._unfinished = {name for name in self._sizes() if name.endswith(PART)}
        for name in sorted(self._unfinished):
            folder, _, last = name.rpartition("/")
            final = f"{folder}/{last[1:]}".lstrip("/").removesuffix(PART).rpartition(".")[0]
            if final in files or not isinstance(self._root, RemotePath):
                (self._root / name).unlink(missing_ok=True)
                self._unfinished.discard(name)

    def _sizes(self) -> dict[str, int]:
        if isinstance(self._root, RemotePath):
            with _explained(self.name, "listed"):
                return self._root.listing()
        files = (path for path in self._root.rglob("*") if path.is_file())
        return {path.relative_to(self._root).as_posix(): path.stat().st_size for path in files}


Store = FolderStore | Repository  # a place where a checkpoint or a shard set is published


def open_store(
    address: StrPath,
    revision: str | None = None,
    write: bool = False,
    private: bool | None = None,
    kind: str = "model",
) -> Store:
    """Open the hub at an address.

    Args:
        address: str or path: `org/name`, a folder or a URI; `org/name@revision` too unless `write` is true.
        private: make a new repository a private one.
        kind: of a repository: model or dataset.
    """
    place = as_address(address)
    if not write:
        place, revision = addressed(place, revision)
    if is_repository(place):
        return Repository(str(place).removeprefix("hf://"), revision, write, kind, private)
    if revision is not None:
        raise HubError(place, f"is a folder, and has no revision {revision!r}", "leave the revision out")
    return FolderStore(place, write)


def open_published(source: StrPath, revision: str | None) -> tuple[Store, dict[str, int]]:
    """Return a hub and its files; the error for `org/name` says that no such folder is here either."""
    try:
        store = open_store(source, revision)
        return store, store.files()
    except HubError as fault:
        name = as_text(source)
        if not is_repository(source) or "://" in name:
            raise
        if revision:
            raise HubError(f"{name}@{revision}", fault.fault, fault.remedy) from fault
        both = f"is not a local folder; as a repository of the hub: {fault.fault}"
        remedy = f"give the path of a checkpoint or run, or: {fault.remedy}"
        raise HubError(name, both, remedy) from fault


def read_object(store: Store, name: str) -> dict[str, Any]:
    """Return the values of a JSON file of a hub; raise HubError if it holds no object."""
    return json_object(store.read(name), f"{store.name}/{name}", HubError)


def embodiment_ids(files: Iterable[str]) -> list[str]:
    """Return the ids that have a card, which is written last, in a listing of a checkpoint's files."""
    split = (path.split("/") for path in files)
    found = {parts[1] for parts in split if parts[:1] + parts[2:] == ["embodiments", CARD]}
    return sorted(name for name in found if ID_PATTERN.fullmatch(name) and ".." not in name)


@contextmanager
def _explained(where: object, doing: str) -> Iterator[None]:
    """Raise what a file system raises as a HubError."""
    remedy = "free space, check the address and your access, and try again"
    try:
        yield
    except (OSError, ValueError) as fault:  # ValueError: a name with a zero byte
        reason = "no such file, folder or bucket" if isinstance(fault, FileNotFoundError) else fault
        raise HubError(where, f"cannot be {doing}: {reason}", remedy) from fault
    except (MissingDependencyError, OutputError, StorageAwayError, StorageError) as fault:
        raise HubError(where, f"cannot be {doing}: {fault.fault}", fault.remedy) from fault


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Wait for other pushes to a folder, and hold a lock on the folder itself; a store has no locks."""
    if isinstance(folder, RemotePath):
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # some network file systems have no locks
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _copy(source: Path, to: Path) -> None:
    if isinstance(source, RemotePath):
        attempt(source, "read", lambda: source.files.get_file(source.key, str(to)))
    else:
        shutil.copyfile(source, to)
