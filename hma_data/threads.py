"""Bound the time that threads of a matrix product spin while they wait for one another.

torch brings GCC's OpenMP. There, a thread that has done its share spins in a loop for a while before it
sleeps. Sleeping at once (OMP_WAIT_POLICY=PASSIVE) costs one wake-up per product, which doubles the time of
small products. Spinning for ever (ACTIVE) takes the core from the thread that is waited for, where other
processes use the machine too. The loop is therefore bounded: longer than the gap between two products, far
shorter than a time slice. `hma bench waiting` compares the choices.
"""

import os

SPINS = 10_000  # turns of the loop, about 0.1 to 0.4 ms


def bound_spinning() -> None:
    """Bound how long threads spin, unless the environment does; call this before importing torch."""
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", str(SPINS))
