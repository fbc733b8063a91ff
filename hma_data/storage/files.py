"""Write files and folders so that they are whole or absent: write beside the final name, flush, rename.

Files of a store are written on this machine and then uploaded. JSON is read and written here as well.
"""

import glob
import hashlib
import json
import math
import os
import platform
import shutil
import threading
import uuid
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from hma_data.errors import CheckpointError, HMAError, OutputError
from hma_data.storage.kinds import one_line, unreadable
from hma_data.storage.remote import RemotePath, put_bytes, put_file

PART = ".part"  # ends the name of every unfinished file
PARTIAL = ".partial-"  # is in the name of every unfinished folder
MAX_JSON_BYTES = 16_000_000
_AGAIN = "save or push it again"


# -- files


@contextmanager
def atomic_path(final: Path) -> Iterator[Path]:
    """Give a path beside `final` to write to; it becomes `final` when the block ends without an error.

    A folder may be made there too, where `final` is none yet; see also `new_folder`. For a file of a store,
    the path is on this machine, and the file is uploaded when the block ends.

    Raises:
        OutputError: the folder cannot be written, or the disk is full.
        StorageError: the store refuses it; StorageAwayError: it does not answer.
    """
    where, remedy = final, "free space or choose another --out"
    part = part_of(final)
    if isinstance(final, RemotePath):
        where = part = upload_folder(final.parent) / part.name
        remedy = "free space, or name a folder by $HMA_CACHE"
    try:
        part.parent.mkdir(parents=True, exist_ok=True)
        yield part
        if isinstance(final, RemotePath):
            put_file(part, final)
        else:
            sync_folder(part)
            part.replace(final)
            sync_folder(final.parent)
    except OSError as fault:
        below_file = isinstance(fault, FileExistsError | NotADirectoryError)
        reason = "its folder is a file" if below_file else fault.strerror or fault
        raise OutputError(where, f"cannot be written: {reason}", remedy) from fault
    finally:
        shutil.rmtree(part, ignore_errors=True)
        with suppress(OSError):  # the folder is a file, or may only be read
            part.unlink(missing_ok=True)


def write_atomic(final: Path, content: str | bytes) -> None:
    """Write a small file, whole or not at all; see `atomic_path`."""
    data = content.encode() if isinstance(content, str) else content
    if isinstance(final, RemotePath):
        put_bytes(data, final)
    else:
        with atomic_path(final) as part:
            part.write_bytes(data)


def part_of(final: Path) -> Path:
    """Return the path beside a file where this thread of this process writes it until it is complete."""
    main = threading.current_thread() is threading.main_thread()
    writer = f"{os.getpid()}" if main else f"{os.getpid()}-{threading.get_ident()}"
    return final.with_name(f".{final.name}.{writer}{PART}")


def upload_folder(folder: RemotePath) -> Path:
    """Return where this machine writes files that will go into a folder of a store."""
    name = f"{folder} {platform.node()}"  # a cache may be shared by machines
    return cache_folder() / "uploads" / short_sha256(name)


def remove_parts(folder: Path) -> None:
    """Delete the unfinished files of a killed run in a folder and in the folders directly below it."""
    if isinstance(folder, RemotePath):
        for place in (folder, folder / "train", folder / "val"):
            remove_dead_parts(upload_folder(place))  # another job may be writing the same set
    for part in [*folder.glob(f".*{PART}"), *folder.glob(f"*/.*{PART}")]:
        part.unlink(missing_ok=True)


def remove_dead_parts(folder: Path) -> None:
    """Delete what ended processes of this machine left unfinished in a folder and in those directly below."""
    for part in [*folder.glob(f".*{PART}"), *folder.glob(f"*/.*{PART}")]:
        pid = part.name.removesuffix(PART).rpartition(".")[2].partition("-")[0]
        if pid.isdecimal() and not _is_running(int(pid)):
            part.unlink(missing_ok=True)


def _is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except OSError as fault:
        return isinstance(fault, PermissionError)  # a process of another user
    return True


def sync_folder(path: Path) -> None:
    """Make the renames in a folder durable; also the content of a file."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def short_sha256(content: str | bytes, digits: int = 16) -> str:
    """Return the first hex digits of the SHA-256 of a text or of bytes."""
    data = content.encode() if isinstance(content, str) else content
    return hashlib.sha256(data).hexdigest()[:digits]


def file_sha256(path: Path) -> str:
    """Return the SHA-256 hex digest of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def cache_folder() -> Path:
    """Return the folder for files that can be made again: $HMA_CACHE, or `hma` in the user's cache folder."""
    if stated := os.environ.get("HMA_CACHE"):
        return Path(stated)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hma"


# -- folders


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Yield an empty folder to fill; it gets the given name when the block ends without an error.

    It replaces an older folder of that name, or that it links to. On an error the new one is deleted and the
    older one stays as it was. What a killed writer of that name left on this machine is deleted too.
    """
    folder = folder.resolve()
    folder.parent.mkdir(parents=True, exist_ok=True)
    # Another machine that shares the disk may be writing it too, and its processes are not seen here.
    own = f"{PARTIAL}{short_sha256(platform.node(), 8)}."
    for left in folder.parent.glob(f".{glob.escape(folder.name)}{own}*"):
        pid = left.name.rpartition(own)[2].partition(".")[0]
        needed = left.name.endswith("-old") and not folder.exists()  # killed between the two renames
        if pid.isdecimal() and not needed and not _is_running(int(pid)):
            shutil.rmtree(left, ignore_errors=True)
    mark = f"{own}{os.getpid()}.{uuid.uuid4().hex[:12]}"
    new, old = folder.with_name(f".{folder.name}{mark}"), folder.with_name(f".{folder.name}{mark}-old")
    new.mkdir()
    try:
        yield new
        for path in (*new.rglob("*"), new):
            sync_folder(path)
        if folder.exists():
            folder.rename(old)
        new.rename(folder)
    finally:
        shutil.rmtree(new, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)
    sync_folder(folder.parent)


def remove_partial(folder: Path) -> None:
    """Delete the unfinished folders that killed writers left in a folder."""
    for path in folder.glob(f".*{PARTIAL}*"):
        shutil.rmtree(path, ignore_errors=True)


# -- JSON


def parse_json(content: bytes | str) -> Any:
    """Return the plain values of a JSON text; refuse a key given twice, of which readers take either value.

    Raises:
        ValueError: it is not JSON, or an object gives a key twice.
        RecursionError: it is nested too deeply.
    """
    return json.loads(content, object_pairs_hook=_unambiguous)


def _unambiguous(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) != len(pairs):
        (twice, _), *_ = Counter(key for key, _ in pairs).most_common(1)
        raise ValueError(f"key {twice[:60]!r} is given twice")
    return values


def json_object(content: bytes, where: object, error: type[HMAError] = CheckpointError) -> dict[str, Any]:
    """Return the object in a JSON text; see `parse_json`.

    Raises:
        error: it is not JSON, gives a key twice, or is no object.
    """
    try:
        values = parse_json(content)
    except (ValueError, RecursionError) as fault:
        raise error(where, f"is not valid JSON: {fault}", _AGAIN) from fault
    if not isinstance(values, dict):
        raise error(where, f"must hold a JSON object, holds {type(values).__name__}", _AGAIN)
    return values


def read_json(path: Path, error: type[HMAError] = CheckpointError) -> dict[str, Any]:
    """Read the object in a JSON file.

    Raises:
        error: the file is missing, unreadable, larger than 16 MB, or holds no JSON object.
    """
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            raise error(path, f"is larger than {MAX_JSON_BYTES:,} bytes", "the toolkit writes no such file")
        content = path.read_bytes()
    except OSError as fault:
        raise error(path, f"cannot be read: {fault.strerror}") from fault
    return json_object(content, path, error)


@contextmanager
def opened_weights(
    path: Path, error: type[HMAError] = CheckpointError, framework: str = "np"
) -> Iterator[Any]:
    """Open a safetensors file; raise `error` where it cannot be read to its end."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework) as file:
            yield file
    except (SafetensorError, OSError) as fault:
        text = f"is not a complete safetensors file: {one_line(fault)}"
        raise error(path, *unreadable(path, text, "name another file, or download it again")) from fault


def to_json(values: Any) -> bytes:
    """Return indented JSON that ends with a newline; numbers that are not finite become null."""
    return (json.dumps(finite(values), indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode()


def finite(values: Any) -> Any:
    """Return the same plain values, with None for numbers that JSON cannot hold."""
    if isinstance(values, Mapping):
        return {str(key): finite(value) for key, value in values.items()}
    if isinstance(values, list | tuple):
        return [finite(value) for value in values]
    return None if isinstance(values, float) and not math.isfinite(values) else values
