"""Compare the speed of threads by the way they wait for one another (`hma bench waiting`).

See `hma_data.cpu`. The bench measures training steps and generated frames of a model as large as that of
`hma demo`, for each way of waiting, alone on the machine and beside processes that keep every core busy. The
cases are interleaved and measured several times. The median counts, because other work on the machine
disturbs single figures. The CPU seconds show the cost of spinning.
"""

import multiprocessing
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from statistics import median
from typing import Any

from hma_data.cpu import usable_cores
from hma_model.bench import check, in_fresh_process, make_model
from hma_model.bench import generate as bench_generate
from hma_model.bench import train as bench_train

ABOUT = "training steps and frames a second by how threads wait for one another"
DEFAULTS: dict[str, Any] = {
    **bench_generate.DEFAULTS,
    **bench_train.DEFAULTS,
    "rounds": 3,  # of all cases
    "steps": 6,  # of training, in each round
    "frames": 10,  # generated, in each round
    "beside": "both",  # nothing | busy (processes on every core) | both
    "layers": 4,
    "width": 128,
    "heads": 4,
    "window": 8,
}
WAITS: dict[str, dict[str, str]] = {
    "PASSIVE": {"OMP_WAIT_POLICY": "PASSIVE"},
    "ACTIVE": {"OMP_WAIT_POLICY": "ACTIVE"},
    **{f"{count:,} spins": {"GOMP_SPINCOUNT": str(count)} for count in (1_000, 10_000, 50_000, 200_000)},
    "one thread": {"OMP_NUM_THREADS": "1"},
}
_OURS = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "OMP_NUM_THREADS")


def run(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Measure each way of waiting, alone and beside busy processes.

    Raises:
        UsageError: a setting has a value that is not allowed.
    """
    check("waiting", settings, kind=("discrete",), beside=("nothing", "busy", "both"))
    beside = {"busy": (True,), "nothing": (False,), "both": (False, True)}[settings["beside"]]
    cases = [(wait, busy) for busy in beside for wait in WAITS]
    rounds: dict[tuple[str, bool], list[dict[str, float]]] = {case: [] for case in cases}
    for _ in range(settings["rounds"]):
        for wait, busy in cases:
            with _environment(WAITS[wait]), _busy_cores(usable_cores() if busy else 0):
                found = in_fresh_process(measure, settings)
            rounds[wait, busy].append(found)
            rate = f"{found['steps_per_second']:.2f} steps/s"
            print(f"{wait}, {'busy cores' if busy else 'alone'}: {rate}", file=sys.stderr, flush=True)
    return [
        {"wait": wait, "beside": "busy cores" if busy else "nothing", **_medians(found)}
        for (wait, busy), found in rounds.items()
    ]


def measure(settings: dict[str, Any]) -> dict[str, float]:
    """Return the speed of training and generation, and the CPU seconds that each took on all cores."""
    begun = time.process_time()
    train = median(bench_train._step_seconds(make_model(settings).train(), settings))
    trained = time.process_time()
    frame = median(bench_generate._step_seconds(make_model(settings).eval(), settings, True))
    return {
        "seconds_per_step": train,
        "steps_per_second": 1 / train,
        "training_cpu_seconds": trained - begun,
        "frames_per_second": settings["batch"] / frame,
        "generation_cpu_seconds": time.process_time() - trained,
    }


def _medians(rounds: list[dict[str, float]]) -> dict[str, float]:
    return {key: round(median(found[key] for found in rounds), 4) for key in rounds[0]}


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Set exactly these variables of OpenMP for processes that start in the block."""
    before = dict(os.environ)
    for key in _OURS:
        os.environ.pop(key, None)
    os.environ.update(values)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


@contextmanager
def _busy_cores(count: int) -> Iterator[None]:
    """Keep `count` cores busy in the block."""
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
