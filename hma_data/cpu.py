"""Set how this process uses the cores: its priority, how long its threads spin, and whether it keeps memory.

SVT-AV1 sets real-time priority for a process of root that encodes. Threads and processes that the process
starts inherit it. Threads that spin while they wait for one another then never let the others run: a training
that takes a second took minutes or did not end.

GCC's OpenMP, which torch brings, lets a thread that has done its share of a matrix product spin in a loop
before it sleeps. Sleeping at once (OMP_WAIT_POLICY=PASSIVE) costs one wake-up per product, which slows small
products. Spinning long takes the core from the thread that is waited for, where other processes use the
machine too. So the loop is short. It is not made longer where the machine is quiet at the start: the gain is
small, and what comes later would find long loops. Generation uses one thread where a second brings next to
nothing (`hma_model.generation.engine`). `hma bench waiting` compares the choices.
"""

import ctypes
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice

SPINS = 1_000  # turns of the loop: on a quiet machine nearly as quick as more, on a busy one as PASSIVE
M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_MAX = -1, -2, -4  # of glibc's malloc.h


def take_ordinary_priority() -> None:
    """Set the default scheduling for this thread where it has real-time priority."""
    if hasattr(os, "sched_getscheduler") and os.sched_getscheduler(0) in (os.SCHED_FIFO, os.SCHED_RR):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def bound_spinning() -> None:
    """Bound how long threads spin, unless the environment does; call this before importing torch."""
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", str(SPINS))


def keep_freed_memory() -> None:
    """Let glibc keep what is freed for later allocations; where another C library is used, do nothing.

    glibc maps a large array anew and returns it when it is freed, so each training step has the kernel clear
    the same gigabyte of pages again: a fifth of a small step's time. The peak of memory rises by a twentieth.
    """
    chosen = [name for name in os.environ if name.startswith("MALLOC_")]
    if chosen or "glibc.malloc" in os.environ.get("GLIBC_TUNABLES", ""):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if os.name == "posix" else None
    if mallopt is not None:
        mallopt(M_MMAP_MAX, 0)  # no array is mapped by itself
        mallopt(M_TRIM_THRESHOLD, -1)  # nothing is returned
        mallopt(M_TOP_PAD, 2**26)


def in_order[T, R](act: Callable[[T], R], items: Iterable[T], threads: int) -> Iterator[tuple[T, R]]:
    """Yield each item with what `act` returns of it, in their order; threads work a few items ahead.

    The first error ends it: items that no thread has begun are left out.
    """
    left, pool = iter(items), ThreadPoolExecutor(threads)
    try:
        begun = deque((item, pool.submit(act, item)) for item in islice(left, 2 * threads))
        while begun:
            item, result = begun.popleft()
            yield item, result.result()
            begun.extend((item, pool.submit(act, item)) for item in islice(left, 1))
    finally:
        pool.shutdown(cancel_futures=True)


def usable_cores() -> int:
    """Return how many cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
