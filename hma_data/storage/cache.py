"""Keep whole shards of remote sets on this machine, by their sha256, so that later epochs read them locally.

They are files of `$HMA_CACHE/shards` and take at most `$HMA_CACHE_GB` gigabytes (default 20; 0 keeps none).
The shards unused for longest are deleted to make room, but none that was used in the last hour.
"""

import fcntl
import os
import shutil
import time
from contextlib import suppress
from pathlib import Path

from hma_data.errors import ShardError, UsageError
from hma_data.storage.files import cache_folder, file_sha256, part_of
from hma_data.storage.remote import AHEAD, RangeFile, RemotePath

LIMIT, DEFAULT_GB = "HMA_CACHE_GB", 20.0
IN_USE_S = 3600.0
SPARE, SPARE_BYTES = 0.1, 5 * 10**9  # free space to leave: a tenth of the disk, but at most 5 GB


def limit_bytes() -> int:
    """Return how many bytes of shards may be kept.

    Raises:
        UsageError: $HMA_CACHE_GB is not a number of gigabytes.
    """
    stated = os.environ.get(LIMIT) or DEFAULT_GB
    try:
        return int(float(stated) * 1e9)
    except (ValueError, OverflowError) as fault:
        text = f"{stated!r} is no number of gigabytes"
        raise UsageError(f"${LIMIT}", text, "give for example 20, or 0 for no cache") from fault


def kept_shard(path: RemotePath, sha256: str, size: int) -> Path | None:
    """Return a shard's copy on this machine; download it if there is none.

    The result is None where the copy does not fit or the cache cannot be written: read it by ranges.

    Args:
        sha256, size: as its manifest states.

    Raises:
        ShardError: its bytes are not those of the manifest.
        StorageError: it cannot be read; StorageAwayError: the store does not answer.
    """
    folder = cache_folder() / "shards"
    final = folder / f"{sha256}.parquet"
    try:
        if _is_there(final, size):
            return final
        folder.mkdir(parents=True, exist_ok=True)
        with (lock := folder / f".{sha256}.lock").open("w") as handle:
            fcntl.flock(handle, fcntl.LOCK_EX)  # only one of the processes that want it downloads it
            try:
                if _is_there(final, size):
                    return final
                return _download(path, sha256, size, final) if _make_room(folder, size) else None
            finally:
                lock.unlink(missing_ok=True)
    except OSError:  # the cache cannot be written
        return None


def _is_there(final: Path, size: int) -> bool:
    """Check whether a shard is kept; if so, mark it as used now."""
    with suppress(OSError):
        if final.stat().st_size == size:
            os.utime(final)
            return True
    return False


def _download(path: RemotePath, sha256: str, size: int, final: Path) -> Path:
    part = part_of(final)
    try:
        with part.open("wb") as out:
            shutil.copyfileobj(RangeFile(path, size), out, AHEAD)
        if file_sha256(part) != sha256:
            fault = "its bytes are not those of the manifest (sha256 differs)"
            raise ShardError(path, fault, "run hma shards verify to see what is damaged")
        part.replace(final)
    finally:
        part.unlink(missing_ok=True)
    return final


def _make_room(folder: Path, size: int) -> bool:
    """Delete the shards unused for longest until `size` more bytes fit; return False if they cannot."""
    found = []
    for path in folder.iterdir():
        with suppress(OSError):
            facts = path.stat()
            found.append((facts.st_mtime, facts.st_size, path))
    limit, disk = limit_bytes(), shutil.disk_usage(folder)
    usable = disk.free - min(int(SPARE * disk.total), SPARE_BYTES)
    over = max(sum(item[1] for item in found) + size - limit, size - usable)
    old = [item for item in sorted(found) if item[0] < time.time() - IN_USE_S]
    if size > limit or over > sum(item[1] for item in old):
        return False
    for _, length, path in old:
        if over <= 0:
            break
        path.unlink(missing_ok=True)
        over -= length
    return True
