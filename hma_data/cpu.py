"""Set how this process uses the cores: its priority, and how long its threads spin.

SVT-AV1 sets real-time priority for a process of root that encodes. Threads and processes that the process
starts inherit it. Threads that spin while they wait for one another then never let the others run: a training
that takes a second took minutes or did not end.

GCC's OpenMP, which torch brings, lets a thread that has done its share of a matrix product spin in a loop
before it sleeps. Sleeping at once (OMP_WAIT_POLICY=PASSIVE) costs one wake-up per product, which slows small
products. Spinning long takes the core from the thread that is waited for, where other processes use the
machine too. So the loop is short, and ten times as long where nothing else runs when the process starts.
`hma bench waiting` compares the choices; figures are in docs/results.md.
"""

import os
import time
from pathlib import Path

SPINS, QUIET_SPINS = 1_000, 10_000  # turns of the loop, beside other work and on a quiet machine
_QUIET, _LOOK = 0.25, 0.05  # cores that others may keep busy on a quiet machine; seconds for which we look


def take_ordinary_priority() -> None:
    """Set the default scheduling for this thread where it has real-time priority."""
    if hasattr(os, "sched_getscheduler") and os.sched_getscheduler(0) in (os.SCHED_FIFO, os.SCHED_RR):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def bound_spinning() -> None:
    """Bound how long threads spin, unless the environment does; call this before importing torch."""
    if not {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"} & os.environ.keys():
        os.environ["GOMP_SPINCOUNT"] = str(QUIET_SPINS if busy_cores(_LOOK) <= _QUIET else SPINS)


def busy_cores(seconds: float) -> float:
    """Return how many cores other processes keep busy, measured for so long while this one sleeps."""
    before, began = _busy_ticks(), time.monotonic()
    time.sleep(seconds)
    return (_busy_ticks() - before) / (os.sysconf("SC_CLK_TCK") * (time.monotonic() - began))


def _busy_ticks() -> float:
    """Return the clock ticks in which any core of the machine was busy; without Linux's /proc, the time."""
    try:
        line = Path("/proc/stat").read_text(encoding="ascii").partition("\n")[0]
    except OSError:
        return time.monotonic() * os.sysconf("SC_CLK_TCK")
    user, nice, system, _, _, irq, softirq, *_ = map(int, line.split()[1:])
    return user + nice + system + irq + softirq


def usable_cores() -> int:
    """Return how many cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
