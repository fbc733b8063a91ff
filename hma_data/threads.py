"""How the threads of a product wait for one another.

GCC's OpenMP, which torch brings, lets a thread that has done its share turn in a loop for a while before it
sleeps. Sleeping at once (OMP_WAIT_POLICY=PASSIVE) costs a wake-up a product, which doubles the time of small
ones; turning for ever (ACTIVE) takes the core from the thread that is waited for, where others work on the
machine too. So the loop is bounded: longer than the gap between two products, far shorter than a time slice.
`hma bench waiting` compares the choices.
"""

import os

SPINS = 10_000  # turns of the loop, some 0.1 to 0.4 ms


def bound_spinning() -> None:
    """Bound how long threads turn, unless the environment says; call before importing torch."""
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", str(SPINS))
