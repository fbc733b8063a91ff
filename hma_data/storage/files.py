"""Write files so that they are whole or absent: write beside the final name, flush, rename.

Files of a store are written on this machine and then uploaded.
"""

import hashlib
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hma_data.errors import OutputError
from hma_data.storage.remote import RemotePath, put_bytes, put_file

PART = ".part"  # ends the name of every unfinished file


@contextmanager
def atomic_path(final: Path) -> Iterator[Path]:
    """Give a path beside `final` to write to; it becomes `final` when the block ends without an error.

    For a file of a store, the path is on this machine, and the file is uploaded when the block ends.

    Raises:
        OutputError: the folder cannot be written, or the disk is full.
        StorageError: the store refuses it; StorageAwayError: it does not answer.
    """
    if isinstance(final, RemotePath):
        with _uploaded(final) as part:
            yield part
        return
    part = final.with_name(f".{final.name}.{os.getpid()}{PART}")
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        yield part
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.replace(final)
        sync_folder(final.parent)
    except OSError as fault:
        raise OutputError(
            final, f"cannot be written: {fault.strerror or fault}", "free space or choose another --out"
        ) from fault
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def _uploaded(final: RemotePath) -> Iterator[Path]:
    part = upload_folder(final.parent) / f".{final.name}.{os.getpid()}{PART}"
    try:
        try:
            part.parent.mkdir(parents=True, exist_ok=True)
            yield part
        except OSError as fault:
            raise OutputError(
                part,
                f"cannot be written: {fault.strerror or fault}",
                "free space, or name a folder by $HMA_CACHE",
            ) from fault
        put_file(part, final)
    finally:
        part.unlink(missing_ok=True)


def upload_folder(folder: RemotePath) -> Path:
    """Return where this machine writes files that will go into a folder of a store."""
    name = f"{folder} {platform.node()}"  # a cache may be shared by machines
    return cache_folder() / "uploads" / hashlib.sha256(name.encode()).hexdigest()[:16]


def write_atomic(final: Path, content: str | bytes) -> None:
    """Write a small file, whole or not at all; see `atomic_path`."""
    if isinstance(final, RemotePath):
        put_bytes(content.encode() if isinstance(content, str) else content, final)
        return
    with atomic_path(final) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)


def sync_folder(folder: Path) -> None:
    """Make renames in a folder durable."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def cache_folder() -> Path:
    """Return the folder for files that can be made again: $HMA_CACHE, or `hma` in the user's cache folder."""
    stated = os.environ.get("HMA_CACHE")
    if stated:
        return Path(stated)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "hma"


def file_sha256(path: Path) -> str:
    """Return the SHA-256 hex digest of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def remove_parts(folder: Path) -> None:
    """Delete the unfinished files of a killed run in a folder and in the folders directly below it."""
    if isinstance(folder, RemotePath):
        for place in (folder, folder / "train", folder / "val"):
            for part in upload_folder(place).glob(f".*{PART}"):  # another job may be writing the same set
                if not is_running(int(part.name.removesuffix(PART).rpartition(".")[2])):
                    part.unlink(missing_ok=True)
    for part in [*folder.glob(f".*{PART}"), *folder.glob(f"*/.*{PART}")]:
        part.unlink(missing_ok=True)


def is_running(pid: int) -> bool:
    """Check whether this machine has a process with that number."""
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True
