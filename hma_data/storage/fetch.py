"""Read bytes of files wherever fsspec finds them: by ranges, again when the network fails.

File systems raise many kinds of exceptions; this module turns them into one SourceError that names the
file. Faults that may pass by themselves (a lost connection, a busy server) are tried again; others are not.
"""

from collections.abc import Callable
from typing import Any

import fsspec

from hma_data.errors import HMAError, MissingDependencyError, SourceError, StorageAwayError
from hma_data.storage.retry import ABSENT, address_hint, may_pass, retried, said

CONNECT_S = 3.0  # seconds to wait for a server to answer
WAITS_S = (0.2, 0.6, 1.8)  # before the second, third and fourth try
PACKAGES = {
    "gs": "gcsfs", "gcs": "gcsfs", "s3": "s3fs", "s3a": "s3fs", "http": "aiohttp", "https": "aiohttp",
    "hf": "huggingface_hub", "az": "adlfs", "abfs": "adlfs", "abfss": "adlfs",
}  # fmt: skip
MARKS = ("etag", "ETag", "md5Hash", "crc32c", "mtime", "updated", "LastModified", "Last-Modified", "oid")
NO_LISTING = ("http", "https")


def file_system(uri: str) -> tuple[Any, str]:
    """Return the fsspec file system of a URI, and the path on it.

    Its driver soon gives up on an address where nobody answers; `attempt` makes the further tries.

    Raises:
        MissingDependencyError: the file system's package is not installed.
        ValueError: no file system is known by that scheme.
    """
    scheme = uri.split("://", 1)[0]
    try:
        files, path = fsspec.core.url_to_fs(uri, **_client_options(scheme))
    except ImportError as fault:
        package = PACKAGES.get(scheme)
        remedy = f"pip install {package}" if package else said(fault)
        raise MissingDependencyError(uri, f"needs the package of {scheme}://", remedy) from fault
    return files, path


def _client_options(scheme: str) -> dict[str, Any]:
    if scheme in ("s3", "s3a"):
        ours = {"connect_timeout": CONNECT_S, "retries": {"total_max_attempts": 1}}
        return {"config_kwargs": ours | fsspec.config.conf.get("s3", {}).get("config_kwargs", {})}
    if scheme in NO_LISTING:
        import aiohttp

        return {"client_kwargs": {"timeout": aiohttp.ClientTimeout(total=300, sock_connect=CONNECT_S)}}
    return {}


def protocol(files: Any) -> str:
    """Return the first name of a file system: file, memory, s3, gs, https."""
    name: str = files.protocol if isinstance(files.protocol, str) else files.protocol[0]
    return name


def is_local(files: Any) -> bool:
    """Check whether a file system's paths are on this machine."""
    return "file" in files.protocol


def is_listless(files: Any) -> bool:
    """Check whether a file system's folders cannot be listed."""
    return protocol(files) in NO_LISTING


def attempt[T](files: Any, path: str, action: Callable[[], T]) -> T:
    """Return what `action` returns; try again when a remote file system fails in a way that may pass.

    Raises:
        SourceError: it fails for good.
        StorageAwayError: it fails in a way that may pass, at every try.
    """
    try:
        return retried(action, path, () if is_local(files) else WAITS_S)
    except HMAError:
        raise
    except Exception as fault:  # file systems raise exceptions of any kind
        text = f"cannot be read: {said(fault)}"
        if may_pass(fault):
            remedy = "the network failed again and again; run it again later, it continues where it was"
            raise StorageAwayError(path, text, address_hint(fault) + remedy) from fault
        raise SourceError(path, text, "check the path and your access to it") from fault


def info(files: Any, path: str) -> dict[str, Any]:
    """Return what the file system says of a file; at least `size`.

    Raises:
        SourceError: nothing is there, or its length is unknown.
    """
    found: dict[str, Any] = attempt(files, path, lambda: files.info(path))
    if found.get("size") is None:
        raise SourceError(
            path, "its length is not told by its server", "copy the files here, or name a server that does"
        )
    return found


def mark(found: dict[str, Any]) -> str:
    """Return a text that changes when the file does, made from what `info` found."""
    return " ".join(f"{key}={found[key]}" for key in ("size", *MARKS) if found.get(key) is not None)


def fetch(files: Any, path: str, start: int, end: int) -> bytes:
    """Return the bytes from `start` up to `end`; fewer where the file ends before.

    Raises:
        SourceError: they cannot be read, or the server answers with something else.
    """
    data: bytes = attempt(files, path, lambda: files.cat_file(path, start=start, end=end))
    if len(data) > end - start:
        raise SourceError(
            path,
            f"its server gives {len(data)} bytes where {end - start} were asked for",
            "it answers no range requests: copy the files here",
        )
    return data


def fetch_whole(files: Any, path: str, limit: int) -> bytes | None:
    """Return all bytes of a small file; None when there is no such file.

    Raises:
        SourceError: it cannot be read, or is longer than `limit` bytes.
    """

    def whole() -> bytes | None:
        try:
            data: bytes = files.cat_file(path)
        except ABSENT:
            return None
        return data

    if is_local(files):
        size = attempt(files, path, lambda: files.size(path) if files.isfile(path) else 0)
        if size > limit:
            raise SourceError(
                path, f"has {size:,} bytes, more than {limit:,}", "it is no description of TFDS"
            )
    return attempt(files, path, whole)
