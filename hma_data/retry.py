"""Faults of storage that may go away: told apart from faults of the data, and waited for."""

import errno
from collections.abc import Iterator

from hma_data.errors import StorageAwayError

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


def causes(fault: BaseException | None) -> Iterator[BaseException]:
    """A fault and what it was raised from, all the way."""
    seen: set[int] = set()
    while fault is not None and id(fault) not in seen:
        seen.add(id(fault))
        yield fault
        fault = fault.__cause__ or fault.__context__


def storage_is_away(fault: BaseException) -> bool:
    """Whether storage did not answer, which says nothing about the episode that was being read."""
    return any(
        isinstance(item, ConnectionError | TimeoutError | StorageAwayError)
        or (isinstance(item, OSError) and item.errno in _ANSWERS_LATER)
        for item in causes(fault)
    )


def worth_another_try(fault: BaseException) -> bool:
    """Whether reading the same again may succeed: storage did not answer, or the disk failed to read."""
    return storage_is_away(fault) or any(
        isinstance(item, OSError) and item.errno in _OF_THE_DISK for item in causes(fault)
    )


def disk_is_full(fault: BaseException) -> bool:
    """Whether it is for want of space, here rather than in the recording."""
    return any(isinstance(item, OSError) and item.errno in _FULL for item in causes(fault))
