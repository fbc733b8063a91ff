"""Bound the time that threads of a matrix product spin while they wait for one another.

GCC's OpenMP, which torch brings, lets a thread that has done its share spin in a loop before it sleeps.
Sleeping at once (OMP_WAIT_POLICY=PASSIVE) costs one wake-up per product, which slows small products.
Spinning long takes the core from the thread that is waited for, where other processes use the machine too. So
the loop is short. `hma bench waiting` compares the choices; figures are in docs/results.md.
"""

import os

SPINS = 1_000  # turns of the loop: on a quiet machine nearly as quick as more, on a busy one as PASSIVE


def bound_spinning() -> None:
    """Bound how long threads spin, unless the environment does; call this before importing torch."""
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", str(SPINS))


def usable_cores() -> int:
    """Return how many cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
