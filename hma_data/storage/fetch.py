"""Find the file system of a URI, and tell faults that pass from those that stay.

File systems raise many kinds of exceptions. Faults that may pass by themselves (a lost connection, a busy
server) are tried again; faults of the data are not.
"""

import errno
import logging
import re
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from hma_data.errors import HMAError, MissingDependencyError, StorageAwayError, install_command

CONNECT_S = 3.0  # seconds to wait for a server to answer
EPISODE_WAITS_S = (0.5, 3.0, 15.0)  # before the second, third and fourth try of an episode
ABSENT = (FileNotFoundError, NotADirectoryError, IsADirectoryError)
PACKAGES = {
    "gs": "gcsfs", "gcs": "gcsfs", "s3": "s3fs", "s3a": "s3fs", "http": "aiohttp", "https": "aiohttp",
    "hf": "huggingface_hub", "az": "adlfs", "abfs": "adlfs", "abfss": "adlfs",
}  # fmt: skip
OF_EXTRA = ("gcsfs", "s3fs", "aiohttp")  # packages of the extra `remote`
MARKS = ("etag", "ETag", "md5Hash", "crc32c", "mtime", "updated", "LastModified", "Last-Modified", "oid")
NO_LISTING = ("http", "https")
_ANSWERS_LATER = {
    errno.EAGAIN, errno.EBUSY, errno.ECONNABORTED, errno.ECONNREFUSED, errno.ECONNRESET, errno.EHOSTUNREACH,
    errno.ENETDOWN, errno.ENETUNREACH, errno.ENOLINK, errno.EPIPE, errno.EREMOTEIO, errno.ESTALE,
    errno.ETIMEDOUT,
}  # fmt: skip
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
BUSY = {408, 425, 429, 500, 502, 503, 504}
_UNREACHABLE = {
    "ConnectionRefusedError", "ClientConnectorError", "ConnectionTimeoutError",  # aiohttp
    "EndpointConnectionError", "ConnectTimeoutError",  # botocore
}  # fmt: skip
_OF_THE_NETWORK = _UNREACHABLE | {
    "ClientConnectionError", "ClientPayloadError",  # aiohttp
    "HTTPClientError", "ReadTimeoutError", "ResponseParserError", "IncompleteRead",  # botocore
    "TransportError",  # google-auth, httpx
}  # fmt: skip

SECRET = re.compile(r"(?i)\b(hf_|bearer )\w+")  # a token of the hub, or of a request

log = logging.getLogger(__name__)


# -- faults


def retried[T](action: Callable[[], T], where: object, doing: str, waits_s: Sequence[float]) -> T:
    """Return what `action` returns; run it again where a file system failed in a way that may pass.

    Args:
        where, doing: for the error, such as a path and "read".
        waits_s: seconds before the second and further tries.

    Raises:
        StorageAwayError: it failed in such a way at every try.
    """
    try:
        return action()
    except Exception as fault:  # file systems raise exceptions of any kind
        if isinstance(fault, HMAError) or not may_pass(fault):
            raise
        text = f"cannot be {doing}: {said(fault)}"
        if not waits_s:
            remedy = "the network failed repeatedly: run the same command again to continue"
            if _kinds(fault) & _UNREACHABLE:
                remedy = "check the network, and the address (AWS_ENDPOINT_URL for s3); " + remedy
            raise StorageAwayError(where, text, remedy) from fault
        log.info("%s %s; trying again", where, text)
    time.sleep(waits_s[0])
    return retried(action, where, doing, waits_s[1:])


def may_pass(fault: BaseException) -> bool:
    """Check whether what a remote file system raised may be gone on the next try."""
    if isinstance(fault, (*ABSENT, PermissionError, ImportError)):
        return False
    if status := _status(fault):
        return status in BUSY
    if isinstance(fault, OSError) and worth_another_try(fault):
        return True
    return bool(_kinds(fault) & _OF_THE_NETWORK)


def said(fault: BaseException) -> str:
    """Return an exception as one line of text, without a token that a server repeats."""
    text = hidden(" ".join(str(fault).split()))
    return f"{type(fault).__name__}: {text}" if text else type(fault).__name__


def hidden(text: str) -> str:
    """Return a text without the tokens in it."""
    return SECRET.sub(r"\1…", text)


def without_secrets(fault: BaseException, hide: Callable[[str], str] = hidden) -> BaseException:
    """Return the error after removing tokens from its text and from the texts of its causes."""
    for link in causes(fault):
        link.args = tuple(hide(part) if isinstance(part, str) else part for part in link.args)
    return fault


def _kinds(fault: BaseException) -> set[str]:
    return {kind.__name__ for kind in type(fault).__mro__}


def _status(fault: BaseException) -> int:
    """Return the HTTP status that an exception carries; 0 where it carries none."""
    for name in ("status", "code", "status_code"):
        value = getattr(fault, name, None) or getattr(getattr(fault, "response", None), name, None)
        if str(value).isdecimal():
            return int(str(value))
    return 0


def causes(fault: BaseException | None) -> Iterator[BaseException]:
    """Yield a fault, the fault it was raised from, and so on to the first."""
    seen: set[int] = set()
    while fault is not None and id(fault) not in seen:
        seen.add(id(fault))
        yield fault
        fault = fault.__cause__ or fault.__context__


def storage_is_away(fault: BaseException) -> bool:
    """Check whether storage did not answer; such a fault is not the episode's."""
    return any(
        isinstance(item, ConnectionError | TimeoutError | StorageAwayError)
        or (isinstance(item, OSError) and item.errno in _ANSWERS_LATER)
        for item in causes(fault)
    )


def worth_another_try(fault: BaseException) -> bool:
    """Check whether reading again may succeed: storage did not answer, or the disk failed to read."""
    return storage_is_away(fault) or any(
        isinstance(item, OSError) and item.errno == errno.EIO for item in causes(fault)
    )


def disk_is_full(fault: BaseException) -> bool:
    """Check whether a disk of this machine has no space; such a fault is not the recording's."""
    return any(isinstance(item, OSError) and item.errno in _FULL for item in causes(fault))


# -- file systems


def file_system(uri: str) -> tuple[Any, str]:
    """Return the fsspec file system of a URI, and the path on it.

    Its driver soon gives up on an address where nobody answers; `retried` makes the further tries.

    Raises:
        MissingDependencyError: the file system's package is not installed.
        ValueError: no file system is known by that scheme.
    """
    import fsspec  # here: commands that read no URI start without it

    scheme = uri.split("://", 1)[0]
    options: dict[str, Any] = {}
    try:
        if scheme in ("s3", "s3a"):
            ours = {"connect_timeout": CONNECT_S, "retries": {"total_max_attempts": 1}}
            options["config_kwargs"] = ours | fsspec.config.conf.get("s3", {}).get("config_kwargs", {})
        elif scheme in NO_LISTING:
            import aiohttp

            options["client_kwargs"] = {"timeout": aiohttp.ClientTimeout(total=300, sock_connect=CONNECT_S)}
        files, path = fsspec.core.url_to_fs(uri, **options)
    except ImportError as fault:
        package = PACKAGES.get(scheme)
        remedy = f"pip install {package}" if package else said(fault)
        remedy = install_command("remote") if package in OF_EXTRA else remedy
        raise MissingDependencyError(uri, f"needs the package of {scheme}://", remedy) from fault
    return files, path


def mark(found: dict[str, Any]) -> str:
    """Return a text that changes when the file does, made from what its file system says of it."""
    return " ".join(f"{key}={found[key]}" for key in ("size", *MARKS) if found.get(key) is not None)
