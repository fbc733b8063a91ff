"""Measure how threads should wait for one another (`hma bench waiting`).

The work is that of the embedded model: frames from the model to pictures, and training steps. It is measured
for each way of waiting (see `hma_data.cpu`), number of threads, and number of processes beside it that keep a
core busy. The cases are interleaved and measured several times; the median counts. The CPU seconds show the
cost of spinning.
"""

import multiprocessing
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from statistics import median
from typing import Any

from recipes.bench.harness import Bench, in_fresh_process
from recipes.bench.speed import check_settings, numbers_of, step_seconds

WAITS: dict[str, dict[str, str]] = {
    "PASSIVE": {"OMP_WAIT_POLICY": "PASSIVE"},
    **{f"{count:,} spins": {"GOMP_SPINCOUNT": str(count)} for count in (1_000, 10_000, 30_000, 100_000)},
    "ACTIVE": {"OMP_WAIT_POLICY": "ACTIVE"},
}
OPENMP = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "OMP_NUM_THREADS")


def waiting(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one result for each case; raise UsageError for a wrong setting."""
    check_settings("waiting", {**settings, "beside": None})
    cases = [
        (beside, threads, wait)
        for beside in numbers_of("waiting", "beside", settings, [0, 1, 2])
        for threads in numbers_of("waiting", "threads", settings, [1, 2])
        for wait in (WAITS if threads > 1 else ["PASSIVE"])  # one thread waits for nobody
    ]
    rounds: dict[tuple[int, int, str], list[dict[str, float]]] = {case: [] for case in cases}
    for _ in range(settings["rounds"]):
        for beside, threads, wait in cases:
            environment = WAITS[wait] | {"OMP_NUM_THREADS": str(threads)}
            with _environment(environment), _busy(beside):
                found = in_fresh_process(measure_both, settings)
            rounds[beside, threads, wait].append(found)
            rates = ", ".join(f"{found[key]:.2f} {key}" for key in found if key.endswith("per_second"))
            print(f"{beside} beside, {threads} threads, {wait}: {rates}", file=sys.stderr, flush=True)
    return [
        {
            "busy_beside": beside,
            "threads": threads,
            "wait": wait if threads > 1 else "",
            **{key: round(median(one[key] for one in found), 4) for key in found[0]},
        }
        for (beside, threads, wait), found in rounds.items()
    ]


def measure_both(settings: dict[str, Any]) -> dict[str, float]:
    """Return the speed of generation and training, and the CPU seconds that each took on all cores."""
    from recipes.bench.generation import Frames, embedded

    way: dict[str, Any] = {"cache": True, "decode": True, "compile": False, "unmask_steps": 2}
    way |= {"ddim_steps": None, "seconds": float("inf"), **settings}
    model = embedded(way | {"threads": 0})
    begun = time.process_time()
    frame = median(Frames(model.eval(), way | {"batch": 1}).seconds())
    made = time.process_time()
    step = median(step_seconds(model.train(), way))
    return {
        "frames_per_second": 1 / frame,
        "steps_per_second": 1 / step,
        "generation_cpu_seconds": made - begun,
        "training_cpu_seconds": time.process_time() - made,
    }


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Set exactly these variables of OpenMP for processes that start in the block."""
    before = dict(os.environ)
    for key in OPENMP:
        os.environ.pop(key, None)
    os.environ.update(values)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


@contextmanager
def _busy(count: int) -> Iterator[None]:
    """Run so many processes in the block that each keep a core busy."""
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=_spin, daemon=True) for _ in range(count)]
    for process in processes:
        process.start()
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.join()


def _spin() -> None:
    parent = os.getppid()
    while os.getppid() == parent:
        sum(range(100_000))


WAITING = Bench(
    "rate of the bundled model's frames and training steps, by how threads wait for each other",
    {
        "beside": None,  # processes that keep a core busy; None: 0,1,2
        "threads": None,  # None: 1,2
        "rounds": 1,  # of all cases
        "frames": 30,  # generated, in each round
        "steps": 3,  # of training, in each round
        "batch": 8,  # of training
        "precision": "fp32",
        "optimizer": True,
        "device": "cpu",
    },
    waiting,
)
