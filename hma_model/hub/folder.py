"""Publish to and pull from a folder, on this machine or at any fsspec URI.

A push first writes its files under temporary names. Then, while no other push does so, it renames them one by
one: config and trunk first, then the parts of each embodiment with its card last. An embodiment without a
card counts as absent, and a card holds the digests of its parts. The next push deletes the temporary files of
killed pushes.
"""

import hashlib
import os
import random
import stat
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from hma_data.errors import HMAError, HubError, OutputError, StorageAwayError, StorageError
from hma_data.hub.partial import (
    beside,
    is_abandoned,
    is_partial,
    remove_abandoned,
    remove_abandoned_folders,
)
from hma_data.storage.files import file_sha256
from hma_data.storage.folders import MAX_JSON_BYTES
from hma_data.storage.paths import StrPath, as_text
from hma_data.storage.remote import WHOLE_PUTS, RemotePath, attempt
from hma_data.storage.remote_lock import PROBE, RemoteLock, living_holder
from hma_model.checkpoint.io import CARD, CONFIG, README, TRUNK, inside
from hma_model.hub.swap import swap_in

ATTEMPTS = 10
PATIENCE = 240.0  # seconds to wait for another push; the lock of a killed remote one expires after 180
LOCK = ".hma-push.lock"


class FolderStore:
    """A hub in a folder; see `hma_model.hub.publish.Store`.

    Args:
        address: a path or an fsspec URI.
        write: make the folder if it does not exist.

    Raises:
        HubError: the folder does not exist, or its file system is not known.
    """

    repo: str | None = None
    from_cache = False

    def __init__(self, address: StrPath, write: bool = False) -> None:
        import fsspec

        text = as_text(address)
        text = text if "://" in text else str(Path(text).expanduser())
        self.name = text
        try:
            self._fs, self._root = fsspec.core.url_to_fs(text)
        except (ImportError, ValueError, OSError) as fault:
            raise HubError(text, f"cannot be used: {fault}", "check the address and your access") from fault
        protocols = (self._fs.protocol,) if isinstance(self._fs.protocol, str) else self._fs.protocol
        self._local = "file" in protocols
        if not self._local and not self._root.strip("/") and "memory" not in protocols:
            raise HubError(text, "names no folder", "write the bucket and a folder in it")
        there = self._ask("used", lambda: self._fs.isdir(self._root))
        self._flat = bool(WHOLE_PUTS & set(protocols))  # a folder exists only if it holds a file
        if write and not there and not self._flat:
            self._ask("made", lambda: self._fs.makedirs(self._root, exist_ok=True))
        if not write and not there:
            raise HubError(text, "no such folder", "for a repository of the hub write ORGANISATION/NAME")

    def files(self) -> dict[str, int]:
        """Return the sizes of files by name, without partial files, locks and training state."""
        return {
            name: size
            for name, size in self._sizes().items()
            if not is_partial(name) and not name.startswith(("training/", LOCK, f".{LOCK}.", PROBE))
        }

    def warm(self, names: list[str]) -> None:
        """Do nothing: reading files one by one is fast here."""

    def read(self, name: str) -> bytes:
        """Read a file of at most 16 MB; links are refused."""
        if self._local:
            inside(Path(self._root), name)

        def whole() -> bytes:
            with self._fs.open(self._path(name), "rb") as file:
                return bytes(file.read(MAX_JSON_BYTES + 1))

        content = self._ask("read", whole, f"{self.name}/{name}")
        if len(content) > MAX_JSON_BYTES:
            raise HubError(f"{self.name}/{name}", f"is larger than {MAX_JSON_BYTES:,} bytes")
        return content

    def publish(self, changes: Callable[[], Mapping[str, Path | bytes | None]], message: str) -> str:
        """Write all files under temporary names and rename them; make README.md last, from the new state."""
        self._sweep()
        for pause in range(ATTEMPTS):
            if self._put(dict(changes()), lambda: changes().get(README)):
                return self.name
            time.sleep((0.05 if self._local else 0.5) * (pause + random.random()))
        raise HubError(self.name, "somebody else keeps writing here", "push again later")

    def check_card(self, page: bytes) -> None:
        """Do nothing: a folder accepts any card."""

    def has(self, name: str, content: Path | bytes, sha256: str | None = None) -> bool:
        """Check whether a file has this content already; return False if reading it is expensive."""
        if not self._local or not isinstance(content, Path) or not (Path(self._root) / name).is_file():
            return False
        return file_sha256(inside(Path(self._root), name)) == (sha256 or file_sha256(content))

    def download(self, names: list[str], out: Path) -> None:
        """Fetch files as `pull` does."""
        self.pull(names, out)

    def pull(self, names: list[str], out: Path | None) -> Path:
        """Copy the files that `out` lacks or that differ there; without `out`, return the hub's folder."""
        if out is None:
            return Path(self._root)
        for name in names:
            target = out / name
            self._refuse_links(out, target)
            if target.is_file() and self._same(name, target):
                continue
            others = (out / "embodiments").glob("*/card.json")
            if name in (CONFIG, TRUNK) and target.is_file() and any(others):
                fault = f"has another {name} with embodiments of its own"
                raise HubError(out, fault, "pull to another folder")
            self._bring(name, target)
        return out

    def _bring(self, name: str, target: Path) -> None:
        new = beside(target)
        if self._local:
            inside(Path(self._root), name)
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            remove_abandoned(target)
            self._ask("pulled", lambda: self._fs.get_file(self._path(name), str(new)), target)
            new.replace(target)
        except (OSError, ValueError) as fault:
            raise HubError(target, f"cannot be pulled: {fault}", "free space, or pull again") from fault
        finally:
            with suppress(OSError, ValueError):  # if the parent is not a folder, nothing was written
                new.unlink(missing_ok=True)

    def _ask[T](self, doing: str, call: Callable[[], T], where: object = None) -> T:
        """Return the result of a call of the file system; repeat a remote call if that may help."""
        where = self.name if where is None else where
        remedy = "free space, check the address and your access, and do it again"
        try:
            return call() if self._local else attempt(where, doing, call)
        except FileNotFoundError as fault:
            raise HubError(where, f"cannot be {doing}: no such file, folder or bucket", remedy) from fault
        except (OSError, ValueError) as fault:  # such as a name with a zero byte
            raise HubError(where, f"cannot be {doing}: {fault}", remedy) from fault
        except HubError:
            raise
        except HMAError as fault:
            raise HubError(where, fault.fault, fault.remedy) from fault

    def _sizes(self) -> dict[str, int]:
        if self._local:
            return _local_sizes(Path(self._root))

        def ask() -> dict[str, Any]:
            self._fs.invalidate_cache()
            return dict(self._fs.find(self._root, detail=True))

        try:
            found = attempt(self.name, "listed", ask)
        except FileNotFoundError:
            return {}
        except HMAError as fault:
            raise HubError(self.name, fault.fault, fault.remedy) from fault
        root = self._root.rstrip("/")
        return {
            path.removeprefix(root).lstrip("/"): int(facts.get("size") or 0) for path, facts in found.items()
        }

    def _sweep(self) -> None:
        """Delete the temporary files of pushes that have ended."""
        if self._local:
            remove_abandoned_folders(Path(self._root))
        for name in filter(is_partial, self._sizes()):
            path = self._path(name)
            if is_abandoned(name, self._modified(path)):
                self._ask("deleted", lambda: self._fs.rm_file(path) if self._fs.exists(path) else None)  # noqa: B023

    def _modified(self, path: str) -> float | None:
        try:
            return float(self._fs.modified(path).timestamp())
        except (NotImplementedError, OSError, KeyError, AttributeError, TypeError):
            return None

    def _put(self, files: dict[str, Path | bytes | None], page: Callable[[], Path | bytes | None]) -> bool:
        """Write the files of a push; return False if another push was faster."""
        staged: dict[str, str] = {}
        readme = files.pop(README, None)
        try:
            for name, content in files.items():
                if content is not None:
                    staged[name] = self._stage(name, content)
            with self._alone():
                self._replace_whole(files, staged)
                for name, content in files.items():
                    if content is None:
                        self._remove(self._path(name))
                    elif name == CONFIG and not self._claim(staged[name], self._path(name)):
                        return False
                    elif name in staged and name != CONFIG:
                        self._rename(staged.pop(name), self._path(name))
                if readme is not None and (now := page()) is not None:
                    staged[README] = self._stage(README, now)
                    self._rename(staged.pop(README), self._path(README))
        except OSError as fault:
            remedy = "free space, check your access, and push again"
            raise HubError(self.name, f"cannot be written: {fault}", remedy) from fault
        except OutputError:  # another push has taken the lock
            return False
        except (StorageError, StorageAwayError) as fault:
            raise HubError(self.name, fault.fault, fault.remedy) from fault
        finally:
            for left in staged.values():
                if self._ask("used", lambda: self._fs.exists(left)):  # noqa: B023
                    self._remove(left)
        return True

    def _replace_whole(self, files: Mapping[str, Path | bytes | None], staged: dict[str, str]) -> None:
        """Replace embodiments that the folder already has, each in one step."""
        homes = (
            {name.rpartition("/")[0] for name in files if name.endswith(f"/{CARD}")} if self._local else set()
        )
        for home in sorted(homes):
            if (Path(self._root) / home / CARD).is_file() and CONFIG not in files:
                names = [name for name in staged if name.rpartition("/")[0] == home]
                parts = {name.rpartition("/")[2]: Path(staged.pop(name)) for name in names}
                swap_in(Path(self._root), Path(self._root) / home, parts)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Hold the lock for renaming; a local file system without locks gives no such guarantee."""
        with _folder_lock(Path(self._root)) if self._local else self._remote_lock():
            yield

    def _remote_lock(self) -> RemoteLock:
        """Return the lock of the folder once no living push holds it; `with` takes and releases it."""
        end = time.monotonic() + PATIENCE
        place = RemotePath(self.name) / LOCK
        try:
            while living_holder(place) and time.monotonic() < end:
                time.sleep(1.0)
        except HMAError as fault:
            raise HubError(self.name, fault.fault, fault.remedy) from fault
        return RemoteLock(place, "this hub")

    def _stage(self, name: str, content: Path | bytes) -> str:
        """Write a temporary file; a local one lies in the top folder, as folders below may be swapped."""
        final = Path(self._path(name))
        if self._local:
            self._refuse_links(Path(self._root), final.parent)
            new = str(beside(Path(self._root) / name.replace("/", "--")))
        else:
            new = str(beside(final))
            if not self._flat:
                self._ask("made", lambda: self._fs.makedirs(str(final.parent), exist_ok=True))
        if isinstance(content, bytes):
            self._ask("written", lambda: self._fs.pipe_file(new, content))
        else:
            self._ask("written", lambda: self._fs.put_file(str(content), new))
        if self._local:
            with Path(new).open("rb") as file:
                os.fsync(file.fileno())
        return new

    def _claim(self, new: str, final: str) -> bool:
        """Rename a file unless the name is taken; return whether it was renamed."""
        if self._local:
            try:
                os.link(new, final)
            except FileExistsError:
                return False
            return True
        if self._ask("used", lambda: self._fs.exists(final)):
            return False
        self._settle(new, final)
        return True

    def _rename(self, new: str, final: str) -> None:
        if self._local:
            Path(final).parent.mkdir(parents=True, exist_ok=True)
            Path(new).replace(final)
            return
        self._settle(new, final)

    def _settle(self, new: str, final: str) -> None:
        """Rename a remote file: copy it in a store where files appear only when complete, else move it."""

        def move() -> None:
            try:
                self._fs.mv(new, final)
            except FileNotFoundError:  # an earlier try may have moved it, with a lost answer
                if self._fs.exists(new) or not self._fs.exists(final):
                    raise

        if self._flat:
            self._ask("written", lambda: self._fs.cp_file(new, final))
            self._remove(new)
        else:
            self._ask("written", move)

    def _remove(self, path: str) -> None:
        try:
            attempt(self.name, "deleted", lambda: self._fs.rm_file(path))
        except FileNotFoundError:
            return
        except HMAError as fault:
            raise HubError(self.name, fault.fault, fault.remedy) from fault

    def _same(self, name: str, target: Path) -> bool:
        def digest() -> str:
            made = hashlib.sha256()
            with self._fs.open(self._path(name), "rb") as file:
                while block := file.read(1 << 20):
                    made.update(block)
            return made.hexdigest()

        size = self._ask("read", lambda: self._fs.size(self._path(name)))
        if size is None or int(size) != target.stat().st_size:
            return False
        return self._ask("read", digest) == file_sha256(target)

    def _path(self, name: str) -> str:
        return f"{self._root.rstrip('/')}/{name}"

    def _refuse_links(self, root: Path, path: Path) -> None:
        for part in (path, *path.parents):
            if part == root or root not in part.parents:
                break
            if part.is_symlink():
                raise HubError(part, "is a link", "only files and folders themselves are written to")


@contextmanager
def _folder_lock(folder: Path) -> Iterator[None]:
    """Hold a lock on the folder itself, which leaves no file behind."""
    import fcntl

    end = time.monotonic() + PATIENCE
    handle = os.open(folder, os.O_RDONLY)
    try:
        while True:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError as fault:
                if time.monotonic() > end:
                    raise HubError(folder, "somebody else keeps writing here", "push again later") from fault
                time.sleep(0.02)
            except OSError:
                break  # the file system has no locks
        yield
    finally:
        os.close(handle)


def _local_sizes(root: Path) -> dict[str, int]:
    """Return the sizes of files by name; do not follow links to folders, which may form a cycle."""
    sizes = {}
    for folder, _, names in os.walk(root):
        for path in (Path(folder, name) for name in names):
            with suppress(FileNotFoundError):  # another push has renamed it since the folder was listed
                found = path.stat()
                if stat.S_ISREG(found.st_mode):
                    sizes[path.relative_to(root).as_posix()] = found.st_size
    return sizes
