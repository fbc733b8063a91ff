"""Run work units on this machine: in this process, or in several.

A unit is any picklable value; `work(unit, report)` does it. Workers are spawned, not forked, so
that torch, HDF5 and FFmpeg start clean in each.
"""

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from queue import Empty
from typing import Any

from hma_data.errors import HMAError

Report = Callable[[Any], None]
Work = Callable[[Any, Report], Any]

_work: Work | None = None
_events: Any = None


def run(
    units: Iterable[Any], make_work: Callable[[int], Work], workers: int, on_event: Report
) -> Iterator[Any]:
    """Do every unit and yield each result as it is ready.

    Args:
        units: what to do.
        make_work: called once in each worker with their number; returns the function that does a unit.
        workers: processes; 1 works in this one.
        on_event: called here with whatever a unit reports.

    Raises:
        HMAError: a unit failed, or a worker died.
    """
    if workers <= 1:
        work = make_work(1)
        for unit in units:
            yield work(unit, on_event)
        return
    context = multiprocessing.get_context("spawn")
    events = context.Queue()
    pool = ProcessPoolExecutor(workers, context, _start, (make_work, workers, events))
    try:
        waiting = {pool.submit(_do, unit) for unit in units}
        while waiting:
            try:
                done = next(iter(as_completed(waiting, timeout=0.1)))
            except TimeoutError:
                done = None
            _drain(events, on_event)
            if done:
                waiting.discard(done)
                yield done.result()
        _drain(events, on_event)
    except BrokenProcessPool as fault:
        raise HMAError(
            "a worker",
            "died, perhaps for want of memory",
            "run the same command again, with fewer --workers if it repeats",
        ) from fault
    finally:
        processes = list((pool._processes or {}).values())
        pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            if process.is_alive():
                process.terminate()
        for process in processes:
            process.join(timeout=5)


def _start(make_work: Callable[[int], Work], workers: int, events: Any) -> None:
    global _work, _events
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    _work, _events = make_work(workers), events


def _do(unit: Any) -> Any:
    assert _work is not None
    return _work(unit, _events.put)


def _drain(events: Any, on_event: Report) -> None:
    while True:
        try:
            on_event(events.get_nowait())
        except Empty:
            return


def usable_cores() -> int:
    """Cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
