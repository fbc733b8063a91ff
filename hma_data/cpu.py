"""Set how this process uses the cores: its priority, and how long its threads spin.

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

import os

SPINS = 1_000  # turns of the loop: on a quiet machine nearly as quick as more, on a busy one as PASSIVE


def take_ordinary_priority() -> None:
    """Set the default scheduling for this thread where it has real-time priority."""
    if hasattr(os, "sched_getscheduler") and os.sched_getscheduler(0) in (os.SCHED_FIFO, os.SCHED_RR):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def bound_spinning() -> None:
    """Bound how long threads spin, unless the environment does; call this before importing torch."""
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", str(SPINS))


def usable_cores() -> int:
    """Return how many cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
