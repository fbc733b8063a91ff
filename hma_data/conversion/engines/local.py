"""Run work units on this machine: in this process, or in workers that may die without ending the job.

Workers are spawned, not forked, so that torch, HDF5 and FFmpeg start clean in each. A worker ends
when its parent ends, for whatever reason.
"""

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

from hma_data.conversion.engines.base import FIRST, LIMITS, Cause, Ledger, Limits, OnEvent, Step, Work
from hma_data.cpu import take_ordinary_priority
from hma_data.errors import HMAError

CRASHES = {"SIGSEGV", "SIGABRT", "SIGBUS", "SIGILL", "SIGFPE", "SIGSYS"}  # signals of a process's own faults
TICK_S = 0.5
# Limit of failed starts in a row. A kill from outside counts 1, any other failure counts 10.
START_FAILURES, KILLS_A_FAILURE = 30, 10


def run(
    units: Sequence[Any],
    make_work: Callable[[int], Work],
    workers: int,
    on_event: OnEvent,
    limits: Limits = LIMITS,
) -> Iterator[Any]:
    """Run every unit and yield each result when it is ready; see engines.base.Engine.

    Args:
        workers: number of processes; 0 works in this one, which does not survive a crash or a hang.

    Raises:
        HMAError: a unit failed for a reason that is not its data, or its worker died too often.
    """
    if workers < 1:
        work = make_work(1)
        for number, unit in enumerate(units):
            yield work(unit, _reporter(on_event, number), FIRST)
        return
    ledger = Ledger(units, limits)
    pool = _Pool(make_work, min(workers, len(ledger.units)), ledger, on_event)
    try:
        while ledger.open:
            yield from pool.turn()
        ledger.raise_failures()
    finally:
        pool.close()


def _reporter(on_event: OnEvent, number: int) -> Callable[[Any], None]:
    def report(event: Any) -> None:
        if not isinstance(event, Step):
            on_event(number, event)

    return report


@dataclass
class _Worker:
    """A process, and the unit and step it is at."""

    process: Any
    pipe: Connection
    ready: bool = False
    unit: int | None = None
    step: str = ""
    heard: float = 0.0
    hung: bool = False


class _Pool:
    """The processes of one run."""

    def __init__(
        self, make_work: Callable[[int], Work], count: int, ledger: Ledger, on_event: OnEvent
    ) -> None:
        self._make_work, self._count, self._ledger, self._on_event = make_work, count, ledger, on_event
        self._context = multiprocessing.get_context("spawn")
        self._start_failures = 0
        self._workers: list[_Worker] = []

    def turn(self) -> Iterator[Any]:
        """Hand out units, then process the messages of the workers; yield results."""
        while len(self._workers) < self._count:
            self._workers.append(self._start())
        for worker in self._workers:
            self._hand_out(worker)
        pipes = {worker.pipe: worker for worker in self._workers}
        ends = {worker.process.sentinel: worker for worker in self._workers}
        heard = wait([*pipes, *ends], timeout=TICK_S)
        for pipe in heard:
            if isinstance(pipe, Connection):
                yield from self._listen(pipes[pipe])
        for worker in [ends[end] for end in heard if end in ends]:
            yield from self._listen(worker)  # its messages from before it died
            self._bury(worker)
        self._stop_the_hung()

    def _start(self) -> _Worker:
        ours, theirs = self._context.Pipe()
        process = self._context.Process(
            target=serve, args=(theirs, self._make_work, self._count), daemon=True, name="hma-worker"
        )
        process.start()
        theirs.close()
        return _Worker(process, ours, heard=time.monotonic())

    def _hand_out(self, worker: _Worker) -> None:
        if not worker.ready or worker.unit is not None or worker.process.exitcode is not None:
            return
        taken = self._ledger.take()
        if taken is None:
            return
        number, unit, attempt = taken
        worker.unit, worker.step, worker.heard = number, "", time.monotonic()
        with suppress(OSError):  # it died just now; `turn` removes it and the unit is retried
            worker.pipe.send((unit, attempt))

    def _listen(self, worker: _Worker) -> Iterator[Any]:
        try:
            while worker.pipe.poll():
                kind, value = worker.pipe.recv()
                worker.heard = time.monotonic()
                if kind == "ready":
                    worker.ready, self._start_failures = True, 0
                elif kind == "failed":
                    raise value
                elif kind == "short of memory":
                    self._lost(worker, "killed", "ran out of memory")
                elif kind == "done":
                    assert worker.unit is not None
                    self._ledger.finished(worker.unit)
                    worker.unit = None
                    yield value
                elif isinstance(value, Step):
                    worker.step = value.name
                elif worker.unit is not None:
                    self._on_event(worker.unit, value)
        except (EOFError, OSError):
            return  # `turn` notices its end

    def _bury(self, worker: _Worker) -> None:
        worker.process.join()
        self._workers.remove(worker)
        worker.pipe.close()
        code = worker.process.exitcode or 0
        name = signal_name(-code) if code < 0 else f"exit code {code}"
        if not worker.ready:
            self._start_failures += 1 if code < 0 and name not in CRASHES else KILLS_A_FAILURE
            if self._start_failures >= START_FAILURES:
                raise HMAError(
                    "a worker", f"ended at its start, by {name}", "try --workers 1, or more memory"
                )
        if worker.unit is None:
            return
        if worker.hung:
            self._lost(worker, "hung", f"made no progress for {self._ledger.limits.quiet_s:g} s")
        elif name in CRASHES:
            self._lost(worker, "crashed", f"ended the process by {name}")
        else:
            self._lost(worker, "killed", f"ended by {name}")

    def _lost(self, worker: _Worker, cause: Cause, how: str) -> None:
        number, worker.unit = worker.unit, None
        assert number is not None
        retry = self._ledger.lost(number, cause, worker.step, how)
        if retry:
            self._on_event(number, retry)

    def _stop_the_hung(self) -> None:
        quiet = self._ledger.limits.quiet_s
        for worker in self._workers:
            if quiet and worker.unit is not None and time.monotonic() - worker.heard > quiet:
                worker.hung = True
                worker.process.kill()

    def close(self) -> None:
        """End every process."""
        for worker in self._workers:
            worker.process.terminate()
        for worker in self._workers:
            worker.process.join(timeout=5)
            if worker.process.exitcode is None:
                worker.process.kill()
                worker.process.join()
            worker.pipe.close()


def signal_name(number: int) -> str:
    """Return the name of a signal: SIGKILL for 9."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


# -- in the worker


def serve(pipe: Connection, make_work: Callable[[int], Work], workers: int) -> None:
    """Run units that come by the pipe and report on them until it closes; a worker's process calls this.

    Args:
        pipe: receives (unit, attempt); sends (kind, value), where kind is ready, event, done, failed or
            short of memory.
        make_work: called once.
        workers: number of workers of the whole run.
    """
    take_ordinary_priority()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    threading.Thread(target=_end_with_parent, daemon=True).start()
    sending = threading.Lock()  # a unit reports from more than one thread

    def send(kind: str, value: Any = None) -> None:
        with sending:
            try:
                pipe.send((kind, value))
            except (BrokenPipeError, ConnectionResetError):
                os._exit(1)  # the job is over; no unit is at fault

    try:
        work = make_work(workers)
    except Exception as fault:
        send("failed", _as_ours(fault))
        return
    send("ready")
    while True:
        try:
            unit, attempt = pipe.recv()
        except EOFError:
            return
        try:
            send("done", work(unit, lambda event: send("event", event), attempt))
        except MemoryError:
            send("short of memory")
        except Exception as fault:
            send("failed", _as_ours(fault))


def _as_ours(fault: Exception) -> HMAError:
    if isinstance(fault, HMAError):
        return fault
    return HMAError("a worker", f"{type(fault).__name__}: {fault}", "this should have been a clearer error")


def _end_with_parent() -> None:
    """End this process when its parent ends; otherwise it would write beside the next job's workers."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
