"""Real-time priority, which SVT-AV1 gives to a process of root that encodes, and what it starts inherits.

Threads that spin while they wait for one another then never let the others run: training of a second took
minutes or did not end.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager


def take_ordinary_priority() -> None:
    """Be scheduled as processes are by default, where this thread is not and may be."""
    if not hasattr(os, "sched_getscheduler") or os.sched_getscheduler(0) not in (os.SCHED_FIFO, os.SCHED_RR):
        return
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@contextmanager
def ordinary_priority() -> Iterator[None]:
    """For a block that may encode video: what comes after it has ordinary priority."""
    try:
        yield
    finally:
        take_ordinary_priority()
