"""Recognise faults of storage that may pass, and try again; faults of the data are not tried again."""

import errno
import logging
import time
from collections.abc import Callable, Iterator, Sequence

from hma_data.errors import HMAError, StorageAwayError

ABSENT = (FileNotFoundError, NotADirectoryError, IsADirectoryError)
WAITS_S = (0.5, 3.0, 15.0)  # before the second, third and fourth try
_ANSWERS_LATER = {
    errno.EAGAIN,
    errno.EBUSY,
    errno.ECONNABORTED,
    errno.ECONNREFUSED,
    errno.ECONNRESET,
    errno.EHOSTUNREACH,
    errno.ENETDOWN,
    errno.ENETUNREACH,
    errno.ENOLINK,
    errno.EPIPE,
    errno.EREMOTEIO,
    errno.ESTALE,
    errno.ETIMEDOUT,
}
_OF_THE_DISK = {errno.EIO}
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_BUSY = {408, 425, 429, 500, 502, 503, 504}
_UNREACHABLE = {
    "ConnectionRefusedError",
    "ClientConnectorError",  # aiohttp
    "ConnectionTimeoutError",
    "EndpointConnectionError",  # botocore
    "ConnectTimeoutError",
}
_OF_THE_NETWORK = _UNREACHABLE | {
    "ClientConnectionError",  # aiohttp
    "ClientPayloadError",
    "HTTPClientError",  # botocore
    "ReadTimeoutError",
    "ResponseParserError",
    "IncompleteRead",
    "TransportError",  # google-auth, httpx
}

log = logging.getLogger(__name__)


def retried[T](action: Callable[[], T], where: object, waits_s: Sequence[float]) -> T:
    """Return what `action` returns; run it again where a file system failed in a way that may pass.

    Args:
        where: for the log.
        waits_s: seconds before the second and further tries.

    Raises:
        Exception: what the last try raised.
    """
    for wait_s in waits_s:
        try:
            return action()
        except HMAError:
            raise
        except Exception as fault:  # file systems raise exceptions of any kind
            if not may_pass(fault):
                raise
            log.info("%s: %s; trying again", where, said(fault))
            time.sleep(wait_s)
    return action()


def may_pass(fault: BaseException) -> bool:
    """Check whether what a remote file system raised may be gone on the next try."""
    if isinstance(fault, (*ABSENT, PermissionError, ImportError)):
        return False
    if status := _status(fault):
        return status in _BUSY
    if isinstance(fault, OSError) and worth_another_try(fault):
        return True
    return bool(_kinds(fault) & _OF_THE_NETWORK)


def address_hint(fault: BaseException) -> str:
    """Return the first part of a remedy where a server's address may be wrong; else an empty text."""
    if _kinds(fault) & _UNREACHABLE:
        return "check the network, and the address (AWS_ENDPOINT_URL for s3); "
    return ""


def said(fault: BaseException) -> str:
    """Return an exception as one line of text."""
    text = " ".join(str(fault).split())
    return f"{type(fault).__name__}: {text}" if text else type(fault).__name__


def _kinds(fault: BaseException) -> set[str]:
    return {kind.__name__ for kind in type(fault).__mro__}


def _status(fault: BaseException) -> int:
    for name in ("status", "code", "status_code"):
        value = getattr(fault, name, None) or getattr(getattr(fault, "response", None), name, None)
        if isinstance(value, int):
            return value
        if isinstance(value, str) and value.isdecimal():
            return int(value)
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
        isinstance(item, OSError) and item.errno in _OF_THE_DISK for item in causes(fault)
    )


def disk_is_full(fault: BaseException) -> bool:
    """Check whether a disk of this machine has no space; such a fault is not the recording's."""
    return any(isinstance(item, OSError) and item.errno in _FULL for item in causes(fault))
