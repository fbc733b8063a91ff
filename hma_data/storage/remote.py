"""Use folders and files of object stores like paths: `s3://bucket/set`, `gs://`, `hf://`, `memory://`.

`place` makes a path of what a user wrote. A `RemotePath` can be joined, listed, read by ranges and deleted;
`put_file` and `put_bytes` upload whole files.

A store that refuses a request raises StorageError; one that does not answer, StorageAwayError.
"""

import errno
import io
import os
import re
import stat
import threading
from collections.abc import Callable, Generator
from contextlib import suppress
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path, PosixPath, PurePosixPath
from typing import TYPE_CHECKING, Any, BinaryIO, cast

from hma_data.errors import HMAError, StorageAwayError, StorageError
from hma_data.storage.fetch import ABSENT, NO_LISTING, file_system, retried, said, without_secrets
from hma_data.storage.paths import StrPath, as_text

if TYPE_CHECKING:  # blocks need numpy, which verbs that read no store answer without
    from hma_data.storage.blocks import BlockFile, Blocks

WAITS_S = (0.3, 1.5, 6.0)  # before the second, third and fourth try
WHOLE_PUTS = {"s3", "s3a", "gs", "gcs", "az", "abfs", "memory"}  # an object appears whole or not at all
_SCHEME = re.compile(r"([a-z][a-z0-9+.-]+):/+(.*)", re.DOTALL)


def place(where: StrPath) -> Path:
    """Return the path a user named: a RemotePath where it begins with a store's scheme, else a local path.

    Args:
        where: str or path; also `s3:/bucket/set`, which is what `Path("s3://bucket/set")` makes of a URI.

    Raises:
        StorageError: no store is known by that scheme, or the URI names no bucket or repository.
        MissingDependencyError: the package of the store is not installed.
    """
    if isinstance(where, RemotePath):
        return where
    text = as_text(where)
    found, bare = _SCHEME.fullmatch(text), text.rstrip("/")
    if bare.endswith(":") and bare[:-1] in WHOLE_PUTS | {"hf"}:
        remedy = f"write it as in {bare}//bucket/folder"
        raise StorageError(f"{bare}//", "names no bucket or repository", remedy)
    if not found:
        return Path(text)
    if found[1] in ("file", "local"):
        return Path("/" + found[2])
    path = RemotePath(text)
    _ = path.files  # raises where there is no driver
    RemotePath._named += 1
    return path


def is_remote(path: Path) -> bool:
    """Check whether a path is in a store rather than on this machine."""
    return isinstance(path, RemotePath)


def attempt[T](where: object, doing: str, action: Callable[[], T]) -> T:
    """Return what `action` returns; try again where the store fails in a way that may pass.

    Args:
        doing: for the error, such as "written".

    Raises:
        FileNotFoundError: there is no such file.
        StorageError: it fails for good; StorageAwayError: as `retried` does.
    """

    def once() -> T:
        try:
            return action()
        except Exception as fault:
            if isinstance(where, RemotePath) and not isinstance(fault, ABSENT):
                where.files.invalidate_cache()  # it may hold the part of a listing that had arrived
            raise

    try:
        return retried(once, where, doing, WAITS_S)
    except HMAError:
        raise
    except ABSENT as fault:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(where)) from fault
    except Exception as fault:  # stores raise exceptions of any kind
        remedy = "check the URI and your access to it"
        if "credential" in said(fault).lower():
            remedy = "give credentials, in the way its driver reads them (environment or configuration file)"
        elif isinstance(fault, PermissionError) or "401" in said(fault) or "403" in said(fault):
            remedy = "check the credentials, and what they allow"
        raise StorageError(where, f"cannot be {doing}: {said(fault)}", remedy) from without_secrets(fault)


class RemotePath(PosixPath):
    """A file or folder of a store; operations that only a path of this machine supports raise an error."""

    _named = 0  # how many places a user has named

    def with_segments(self, *segments: Any) -> Any:
        """Return a RemotePath, or a PurePosixPath where the result is relative to a remote path."""
        pure = PurePosixPath(*segments)
        return RemotePath(pure) if pure.parts and pure.parts[0] == self.parts[0] else pure

    def __str__(self) -> str:
        scheme, _, rest = PurePosixPath(*self.parts).as_posix().partition(":")
        return f"{scheme}://{rest.lstrip('/')}"

    __repr__ = __str__

    def __fspath__(self) -> str:
        raise TypeError(f"{self} is not a local file")

    def __reduce__(self) -> Any:
        return RemotePath, (str(self),)

    @property
    def scheme(self) -> str:
        """Return the scheme: s3, gs, hf, memory, …"""
        return self.parts[0].removesuffix(":")

    @property
    def lists(self) -> bool:
        """Check whether the store can list its folders."""
        return self.scheme not in NO_LISTING

    @property
    def files(self) -> Any:
        """Return the store's file system; fsspec keeps one a process, the hub's client one a thread."""
        try:
            files = file_system(str(self))[0]
        except ValueError as fault:
            text = f"is in no known store: {said(fault)}"
            raise StorageError(str(self), text, "use s3://, gs:// or hf://") from fault
        if self.scheme == "hf" and getattr(files, "named", None) != self._named:
            files.invalidate_cache()  # of this thread: no other thread is reading it
            files.named = self._named
        return files

    @property
    def key(self) -> str:
        """Return the path as the store's file system names it."""
        return str(self.files._strip_protocol(str(self)))

    # -- what is there

    def _forget(self) -> None:
        """Drop what the driver knows, because others write here too.

        The hub's driver lists a whole folder to tell of one file. So what it has listed is kept until a user
        names a place again (`place`): the toolkit writes there by commits only, not by paths, so that only
        commits of others in the meantime go unseen.
        """
        if self.scheme != "hf":
            self.files.invalidate_cache()

    def info(self) -> dict[str, Any]:
        """Return what the store says of a file or folder: type, size and more."""

        def ask() -> dict[str, Any]:
            self._forget()
            return dict(self.files.info(self.key))

        return attempt(self, "read", ask)

    def listing(self) -> dict[str, int]:
        """Return name below this folder -> bytes of every file, sorted by name; empty where there is none."""

        def ask() -> dict[str, Any]:
            self._forget()
            return dict(self.files.find(self.key, detail=True))  # with maxdepth it would leave out what fails

        try:
            found = attempt(self, "listed", ask)
        except FileNotFoundError:
            return {}
        begin = f"{self.key}/"
        below = (name for name in sorted(found) if name.startswith(begin))
        return {name.removeprefix(begin): int(found[name]["size"] or 0) for name in below}

    def _kind(self) -> str:
        try:
            return str(self.info()["type"])
        except FileNotFoundError:
            return ""

    def exists(self, **_: Any) -> bool:
        return bool(self._kind())

    def is_file(self, **_: Any) -> bool:
        return self._kind() == "file"

    def is_dir(self, **_: Any) -> bool:
        return self._kind() == "directory"

    def stat(self, **_: Any) -> os.stat_result:
        """Return size and kind; stores have no more facts in common."""
        found = self.info()
        mode = stat.S_IFREG if found["type"] == "file" else stat.S_IFDIR
        return os.stat_result((mode | 0o644, 0, 0, 0, 0, 0, int(found["size"] or 0), 0, 0, 0))

    def _entries(self) -> list[tuple[str, bool]]:
        """Return the names directly below, sorted, and whether each is a folder; empty where nothing is."""

        def ask() -> list[tuple[str, bool]]:
            self._forget()
            found = self.files.ls(self.key, detail=True)
            return [(str(item["name"]).rstrip("/"), item["type"] == "directory") for item in found]

        try:
            entries = attempt(self, "listed", ask)
        except FileNotFoundError:
            return []
        return [(name.rsplit("/", 1)[-1], folder) for name, folder in sorted(entries) if name != self.key]

    def iterdir(self) -> Generator["RemotePath"]:
        """Yield the files and folders directly below.

        A folder that does not exist yields nothing, because stores keep no empty folders.
        """
        for name, _ in self._entries():
            yield self / name

    def glob(self, pattern: str, **_: Any) -> Generator["RemotePath"]:
        """Yield the files below whose path matches the pattern, part by part; folders are not yielded.

        Only folders that match are listed, each by a request: fsspec's own walk leaves out what fails.
        """
        first, *rest = pattern.split("/", 1)
        for name, folder in self._entries():
            if fnmatchcase(name, first) and folder == bool(rest):
                yield from (self / name).glob(*rest) if rest else [self / name]

    def rglob(self, pattern: str, **_: Any) -> Generator["RemotePath"]:
        """Yield the files at any depth below whose name matches."""
        for name in self.listing():
            if fnmatchcase(name.rsplit("/", 1)[-1], pattern):
                yield self / name

    def resolve(self, strict: bool = False) -> "RemotePath":
        return self

    absolute = resolve

    # -- reading and deleting

    def open(self, mode: str = "r", *_: Any, **options: Any) -> Any:
        """Open the file to read it; any other mode raises StorageError."""
        if mode not in ("r", "rb", "rt"):
            remedy = "a file of a store is written as a whole"
            raise StorageError(self, f"cannot be opened for {mode!r}", remedy)
        data = io.BufferedReader(remote_file(self), 1 << 20)
        if "b" in mode:
            return data
        return io.TextIOWrapper(data, encoding=options.get("encoding"), newline=options.get("newline"))

    def read_bytes(self) -> bytes:
        try:
            return attempt(self, "read", lambda: bytes(self.files.cat_file(self.key)))
        except (FileNotFoundError, StorageError):
            with suppress(FileNotFoundError, StorageError):
                found = self.info()
                if (found["type"], found["size"]) == ("file", 0):  # some hubs do not send empty files
                    return b""
            raise

    def read_text(self, encoding: str | None = None, errors: str | None = None, **_: Any) -> str:
        return self.read_bytes().decode(encoding or "utf-8", errors or "strict")

    def unlink(self, missing_ok: bool = False) -> None:
        try:
            attempt(self, "deleted", lambda: self.files.rm_file(self.key))
        except FileNotFoundError:
            if not missing_ok:
                raise

    def replace(self, target: Any) -> "RemotePath":
        """Rename the file; where a store has no renames, copy it and delete it."""

        def rename() -> None:
            if self.scheme in WHOLE_PUTS:
                self.files.cp_file(self.key, target.key)
                self.files.rm_file(self.key)
            else:
                self.files.mv(self.key, target.key)

        attempt(target, "written", rename)
        return RemotePath(target)

    def mkdir(self, *_: Any, **__: Any) -> None:
        """Make the folder; do nothing in a store where a folder exists when a file is in it."""
        if self.scheme not in WHOLE_PUTS:
            attempt(self, "made", lambda: self.files.makedirs(self.key, exist_ok=True))


# -- writing


def put_file(local: Path, to: RemotePath) -> None:
    """Upload a file; it appears under its name only when it is whole."""
    _put(to, lambda key: to.files.put_file(str(local), key))


def put_bytes(content: bytes, to: RemotePath) -> None:
    """Upload a small file; see `put_file`."""
    _put(to, lambda key: to.files.pipe_file(key, content))


def create_bytes(content: bytes, to: RemotePath) -> bool:
    """Upload a small file unless there is one of that name, in one step; return False where there is one.

    A store that does not support this condition is written as by `put_bytes`.
    """

    def once() -> bool:
        try:
            to.files.pipe_file(to.key, content, mode="create")
        except Exception:  # each driver has its own error for an existing file
            to.files.invalidate_cache()
            if to.files.exists(to.key):
                return False
            raise
        return True

    try:
        return attempt(to, "written", once)
    except StorageAwayError:
        raise
    except (FileNotFoundError, StorageError):  # the store refused the condition, or refuses any write
        put_bytes(content, to)
        return True


def _put(to: RemotePath, upload: Callable[[str], Any]) -> None:
    whole = to.scheme in WHOLE_PUTS
    beside = to if whole else to.with_name(f".{to.name}.{os.getpid()}-{threading.get_ident()}.part")
    try:
        attempt(to, "written", lambda: upload(beside.key))
        if not whole:
            beside.replace(to)
    except FileNotFoundError as fault:
        raise StorageError(to, "cannot be written: there is no such bucket", "create it first") from fault


# -- reading by ranges


def fetch_range(path: RemotePath, start: int, stop: int) -> bytes:
    """Return the bytes of a remote file from `start` up to `stop`, which lies inside it."""
    # The hub's driver reads 5 MiB more than is wanted, where the file does not end before.
    known = {"size": stop} if path.scheme == "hf" else {}

    def ask() -> bytes:
        data = bytes(path.files.cat_file(path.key, start=start, end=stop, **known))
        if len(data) > stop - start:
            fault = f"its server sent {len(data)} bytes, {stop - start} were requested"
            raise StorageError(path, fault, "the server ignores range requests: copy the files here")
        if len(data) < stop - start:
            raise ConnectionError(f"{len(data)} bytes arrived, {stop - start} were requested")
        return data

    return attempt(path, "read", ask)


def remote_file(path: RemotePath, size: int | None = None) -> "BlockFile":
    """Open a file of a store, which can be read at any position; its size is asked for unless it is given."""
    from hma_data.storage.blocks import BlockFile, Blocks

    size = path.info().get("size") if size is None else size
    if size is None:
        raise StorageError(path, "its server does not state its length", "copy the file here")
    return BlockFile(Blocks(partial(fetch_range, path), int(size)))


class LargeFile:
    """A file that is opened again and again: a local one as it is, a remote one by blocks.

    The size of a remote file is asked for once, so it must not change meanwhile.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._blocks: Blocks | None = None

    def open(self) -> BinaryIO:
        """Open the file for reading."""
        if not isinstance(self._path, RemotePath):
            return self._path.open("rb")
        if self._blocks is None:
            self._blocks = remote_file(self._path).blocks
        from hma_data.storage.blocks import BlockFile

        return cast(BinaryIO, BlockFile(self._blocks))


def parquet_input(path: Path) -> Any:
    """Return what pyarrow can read a parquet file from: the local path, or an open file of a store."""
    return remote_file(path) if isinstance(path, RemotePath) else path


def parquet_file(path: Path, **options: Any) -> Any:
    """Open a local or remote pyarrow ParquetFile; a remote row group is read in few requests."""
    import pyarrow.parquet as pq

    return pq.ParquetFile(parquet_input(path), pre_buffer=is_remote(path), **options)
