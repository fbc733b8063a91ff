"""Bytes of files wherever fsspec finds them: a range at a time, tried again when the network stumbles.

A file system raises what it likes; here that becomes one SourceError that names the file. What may
pass by itself (a lost connection, a server that is busy) is tried again, what will not is not.
"""

import errno
import logging
import time
from collections.abc import Callable
from typing import Any

from hma_data.errors import HMAError, SourceError, StorageAwayError
from hma_data.reach import reach

TRIES, FIRST_PAUSE_S = 4, 0.2  # each pause is three times the one before
BUSY = {408, 425, 429, 500, 502, 503, 504}
ABSENT = (FileNotFoundError, NotADirectoryError, IsADirectoryError)
BROKEN = {errno.ECONNRESET, errno.EPIPE, errno.ETIMEDOUT, errno.ENETUNREACH, errno.EHOSTUNREACH}
MARKS = ("etag", "ETag", "md5Hash", "crc32c", "mtime", "updated", "LastModified", "Last-Modified", "oid")
NO_LISTING = ("http", "https")

log = logging.getLogger(__name__)


def protocol(files: Any) -> str:
    """The first name of a file system: file, memory, s3, gs, https."""
    name: str = files.protocol if isinstance(files.protocol, str) else files.protocol[0]
    return name


def is_local(files: Any) -> bool:
    """Whether its paths are this machine's."""
    return "file" in files.protocol


def is_listless(files: Any) -> bool:
    """Whether its folders cannot be listed."""
    return protocol(files) in NO_LISTING


def attempt[T](files: Any, path: str, action: Callable[[], T]) -> T:
    """What `action` returns, tried again when a remote file system fails in a way that may pass.

    Raises:
        SourceError: it fails for good.
    """
    tries = 1 if is_local(files) else TRIES
    for turn in range(tries):
        try:
            if tries > 1:
                reach(files, path)
            return action()
        except HMAError:
            raise
        except Exception as fault:  # file systems raise what they like
            if turn == tries - 1 or not may_pass(fault):
                kind = StorageAwayError if may_pass(fault) else SourceError
                raise kind(path, f"cannot be read: {said(fault)}", _remedy(fault)) from fault
            log.info("%s: %s; trying again", path, said(fault))
            time.sleep(FIRST_PAUSE_S * 3**turn)
    raise AssertionError("a try returns or raises")


def info(files: Any, path: str) -> dict[str, Any]:
    """What the file system says of a file; at least `size`.

    Raises:
        SourceError: nothing is there, or it cannot be told how long it is.
    """
    found: dict[str, Any] = attempt(files, path, lambda: files.info(path))
    if found.get("size") is None:
        raise SourceError(
            path, "its length is not told by its server", "copy the files here, or name a server that does"
        )
    return found


def mark(found: dict[str, Any]) -> str:
    """Changes when a file does, by what `info` found."""
    return " ".join(f"{key}={found[key]}" for key in ("size", *MARKS) if found.get(key) is not None)


def fetch(files: Any, path: str, start: int, end: int) -> bytes:
    """The bytes from `start` up to `end`; fewer where the file ends before.

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
    """All bytes of a small file; None when there is none.

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


def _status(fault: BaseException) -> int:
    for name in ("status", "code", "status_code"):
        value = getattr(fault, name, None) or getattr(getattr(fault, "response", None), name, None)
        if isinstance(value, int):
            return value
        if isinstance(value, str) and value.isdecimal():
            return int(value)
    return 0


def may_pass(fault: BaseException) -> bool:
    """Whether what a remote file system raised may be gone on the next try."""
    if isinstance(fault, (*ABSENT, PermissionError, ImportError)):
        return False
    if status := _status(fault):
        return status in BUSY
    if isinstance(fault, ConnectionError | TimeoutError) or getattr(fault, "errno", None) in BROKEN:
        return True
    names = {kind.__name__ for kind in type(fault).__mro__}
    return bool(
        names
        & {
            "ClientConnectionError",  # aiohttp
            "ClientPayloadError",
            "ConnectTimeoutError",  # botocore
            "EndpointConnectionError",
            "HTTPClientError",
            "ReadTimeoutError",
            "ResponseParserError",
            "IncompleteRead",
            "TransportError",  # google-auth, httpx
        }
    )


def said(fault: BaseException) -> str:
    """An exception in one line."""
    text = " ".join(str(fault).split())
    return f"{type(fault).__name__}: {text}" if text else type(fault).__name__


def _remedy(fault: BaseException) -> str:
    if may_pass(fault):
        return "the network failed again and again; run it again later, it continues where it was"
    return "check the path and your access to it"
