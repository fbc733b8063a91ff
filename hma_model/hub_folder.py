"""A hub in a folder, on this machine or behind any fsspec URI.

Files are staged beside their names and renamed one by one: first config and trunk, then an embodiment's
parts with its card last. Who finds no card finds no embodiment, and a card names the digests of its parts.
"""

import hashlib
import os
import time
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from hma_data.errors import HubError
from hma_data.files import file_sha256
from hma_model.checkpoint import CONFIG, README, TRUNK, inside
from hma_model.files import MAX_JSON_BYTES

ATTEMPTS = 10


class FolderStore:
    """See `hma_model.hub.Store`.

    Args:
        address: a path or an fsspec URI.
        write: make it where it is not there.

    Raises:
        HubError: it is not there, or its file system is not known.
    """

    repo: str | None = None

    def __init__(self, address: str | Path, write: bool = False) -> None:
        import fsspec

        text = str(Path(address).expanduser()) if "://" not in str(address) else str(address)
        self.name = text
        try:
            self._fs, self._root = fsspec.core.url_to_fs(text)
            there = self._fs.isdir(self._root)
            if write and not there:
                self._fs.makedirs(self._root, exist_ok=True)
        except (ImportError, ValueError, OSError) as fault:
            raise HubError(text, f"cannot be used: {fault}", "check the address and your access") from fault
        protocol = self._fs.protocol
        self._local = "file" in ((protocol,) if isinstance(protocol, str) else protocol)
        if not write and not there:
            raise HubError(text, "no such folder", "for a repository of the hub write ORGANISATION/NAME")

    def files(self) -> dict[str, int]:
        """Sizes by name, without what is being written."""
        sizes = _local_sizes(Path(self._root)) if self._local else self._remote_sizes()
        return {
            name: size
            for name, size in sizes.items()
            if ".partial-" not in name and not name.startswith("training/")
        }

    def warm(self, names: list[str]) -> None:
        """Nothing: reading files one by one is quick here."""

    def read(self, name: str) -> bytes:
        """A file of at most 16 MB; links are refused."""
        if self._local:
            inside(Path(self._root), name)
        try:
            with self._fs.open(self._path(name), "rb") as file:
                content: bytes = file.read(MAX_JSON_BYTES + 1)
        except OSError as fault:
            raise HubError(f"{self.name}/{name}", f"cannot be read: {fault}") from fault
        if len(content) > MAX_JSON_BYTES:
            raise HubError(f"{self.name}/{name}", f"is larger than {MAX_JSON_BYTES:,} bytes")
        return content

    def publish(self, changes: Callable[[], Mapping[str, Path | bytes | None]], message: str) -> str:
        """Stage everything, then rename; README.md is renewed until it shows what is there."""
        for attempt in range(ATTEMPTS):
            if self._put(dict(changes())):
                break
            time.sleep(0.05 * (attempt + 1))
        else:
            raise HubError(self.name, "somebody else keeps writing here", "push again later")
        for _ in range(ATTEMPTS):
            page = changes().get(README)
            if not isinstance(page, bytes) or self.read(README) == page:
                break
            self._put({README: page})
        return self.name

    def digests(self) -> dict[str, str]:
        """SHA-256 of the parquet files, where reading them again is cheap."""
        names = [name for name in self.files() if name.endswith(".parquet")] if self._local else []
        return {name: file_sha256(inside(Path(self._root), name)) for name in names}

    def download(self, names: list[str], out: Path) -> None:
        """As `pull`."""
        self.pull(names, out)

    def pull(self, names: list[str], out: Path | None) -> Path:
        """Copy files that are not there with the same content; a folder of this machine may stay in place."""
        if out is None:
            return Path(self._root)
        for name in names:
            target = out / name
            self._refuse_links(out, target)
            if target.is_file() and self._same(name, target):
                continue
            if (
                name in (CONFIG, TRUNK)
                and target.is_file()
                and any((out / "embodiments").glob("*/card.json"))
            ):
                raise HubError(
                    out, f"has another {name} with embodiments of its own", "pull to another folder"
                )
            target.parent.mkdir(parents=True, exist_ok=True)
            beside = _beside(target)
            try:
                if self._local:
                    inside(Path(self._root), name)
                self._fs.get_file(self._path(name), str(beside))
                beside.replace(target)
            except OSError as fault:
                raise HubError(target, f"cannot be pulled: {fault}", "free space, or pull again") from fault
            finally:
                beside.unlink(missing_ok=True)
        return out

    def _remote_sizes(self) -> dict[str, int]:
        self._fs.invalidate_cache()
        found: dict[str, Any] = self._fs.find(self._root, detail=True)
        root = self._root.rstrip("/")
        return {
            path.removeprefix(root).lstrip("/"): int(facts.get("size") or 0) for path, facts in found.items()
        }

    def _put(self, files: Mapping[str, Path | bytes | None]) -> bool:
        """False where somebody else has put a config there first."""
        staged: dict[str, str] = {}
        try:
            for name, content in files.items():
                if content is not None:
                    staged[name] = self._stage(name, content)
            for name, content in files.items():
                if content is None:
                    self._fs.rm_file(self._path(name))
                elif name == CONFIG and not self._claim(staged[name], self._path(name)):
                    return False
                elif name != CONFIG:
                    self._rename(staged.pop(name), self._path(name))
        except OSError as fault:
            raise HubError(
                self.name, f"cannot be written: {fault}", "free space, check your access, and push again"
            ) from fault
        finally:
            for left in staged.values():
                if self._fs.exists(left):
                    self._fs.rm_file(left)
        return True

    def _stage(self, name: str, content: Path | bytes) -> str:
        beside = str(_beside(Path(self._path(name))))
        parent = beside.rsplit("/", 1)[0]
        if self._local:
            self._refuse_links(Path(self._root), Path(parent))
        self._fs.makedirs(parent, exist_ok=True)
        if isinstance(content, bytes):
            self._fs.pipe_file(beside, content)
        else:
            self._fs.put_file(str(content), beside)
        if self._local:
            with Path(beside).open("rb") as file:
                os.fsync(file.fileno())
        return beside

    def _claim(self, beside: str, final: str) -> bool:
        """Give a file its name unless it is taken; not in one step where the file system is not our own."""
        if self._local:
            try:
                os.link(beside, final)
            except FileExistsError:
                return False
            return True
        if self._fs.exists(final):
            return False
        self._fs.mv(beside, final)
        return True

    def _rename(self, beside: str, final: str) -> None:
        if self._local:
            Path(beside).replace(final)
        else:
            self._fs.mv(beside, final)

    def _same(self, name: str, target: Path) -> bool:
        if int(self._fs.size(self._path(name)) or -1) != target.stat().st_size:
            return False
        digest = hashlib.sha256()
        with self._fs.open(self._path(name), "rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
        return digest.hexdigest() == file_sha256(target)

    def _path(self, name: str) -> str:
        return f"{self._root.rstrip('/')}/{name}"

    def _refuse_links(self, root: Path, path: Path) -> None:
        for part in (path, *path.parents):
            if part == root or root not in part.parents:
                break
            if part.is_symlink():
                raise HubError(part, "is a link", "only files and folders themselves are written to")


def _local_sizes(root: Path) -> dict[str, int]:
    """Sizes by name; folders that are links are not entered, since they may lead in circles."""
    sizes = {}
    for folder, _, names in os.walk(root):
        for path in (Path(folder, name) for name in names):
            if path.is_file():
                sizes[path.relative_to(root).as_posix()] = path.stat().st_size
    return sizes


def _beside(path: Path) -> Path:
    return path.with_name(f".{path.name}.partial-{uuid.uuid4().hex[:12]}")
