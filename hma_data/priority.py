"""Take away real-time priority, which SVT-AV1 sets for a process of root that encodes.

Threads and processes that the process starts inherit this priority. Threads that spin while they wait for
one another then never let the others run: a training that takes a second took minutes or did not end.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager


def take_ordinary_priority() -> None:
    """Set the default scheduling for this thread where it has real-time priority."""
    if not hasattr(os, "sched_getscheduler") or os.sched_getscheduler(0) not in (os.SCHED_FIFO, os.SCHED_RR):
        return
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@contextmanager
def ordinary_priority() -> Iterator[None]:
    """Restore ordinary priority after a block that may encode video."""
    try:
        yield
    finally:
        take_ordinary_priority()
