"""Run work units on this machine: in this process, or in workers that may die without ending the job.

Workers are spawned, not forked, so that torch, HDF5 and FFmpeg start clean in each. A worker ends
when its parent ends, for whatever reason.
"""

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Connection, wait
from typing import Any

from hma_data.conversion.engines import (
    FIRST_ATTEMPT,
    LIMITS,
    Attempt,
    Cause,
    Ledger,
    Limits,
    OnEvent,
    Step,
    Work,
    outcome,
)
from hma_data.cpu import take_ordinary_priority
from hma_data.errors import HMAError

CRASHES = {"SIGSEGV", "SIGABRT", "SIGBUS", "SIGILL", "SIGFPE", "SIGSYS"}  # signals of a process's own faults
TICK_S = 0.5  # longest wait for a message; hung processes are looked for after each
START_FAILURES = 10  # limit of processes in a row that end before they are ready
UNGUARDED = 86  # exit code of a worker that would start workers while it imports the script of its parent


def run(
    units: Sequence[Any],
    make_work: Callable[[int], Work],
    workers: int,
    on_event: OnEvent,
    limits: Limits = LIMITS,
) -> Iterator[Any]:
    """Run every unit and yield each result when it is ready.

    Args:
        on_event: called with (index of a unit, what it reported).
        workers: number of processes; 0 works in this one, which does not survive a crash or a hang.

    Raises:
        HMAError: a unit failed for a reason that is not its data, or its worker died too often.
    """
    end_worker_that_starts_workers(workers)
    if workers < 1:
        work = make_work(1)
        for number, unit in enumerate(units):
            yield work(unit, partial(_report, on_event, number), FIRST_ATTEMPT)
        return
    ledger = Ledger(units, limits, on_event)
    count = min(workers, len(ledger.units))
    pool = _Pool(make_work, count, ledger, on_event)
    try:
        while ledger.open:
            pool.fill()
            yield from pool.turn()
        if ledger.failures:
            raise ledger.failures[0]
    finally:
        pool.close()


def end_worker_that_starts_workers(workers: int) -> None:
    """End this process if it is a worker that still imports its parent's script, and that asks for workers.

    A spawned process imports the script that started it. Where the script converts outside of
    `if __name__ == "__main__":`, each worker would convert again. The exit code tells the parent.
    """
    if workers and getattr(multiprocessing.current_process(), "_inheriting", False):
        raise SystemExit(UNGUARDED)  # not an error, whose traceback every worker would print


def _report(on_event: OnEvent, number: int, event: Any) -> None:
    if not isinstance(event, Step):
        on_event(number, event)


class _WorkerProcess:
    """A spawned process that runs one unit after the other."""

    def __init__(self, make_work: Callable[[int], Work], workers: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        given = theirs, make_work, workers
        self.process = context.Process(target=serve, args=given, daemon=True, name="hma-worker")
        self.process.start()
        theirs.close()
        self.ready = False  # whether it can take a unit
        self.unit: int | None = None  # the number of the unit it is at
        self.step = ""  # the last one that the unit reported
        self._heard = time.monotonic()

    def start_unit(self, number: int, unit: Any, attempt: Attempt) -> None:
        self.unit, self.step = number, ""
        self._heard = time.monotonic()
        with suppress(OSError):  # it died just now; its end will be noticed
            self.pipe.send((unit, attempt))

    def messages(self) -> Iterator[tuple[str, Any]]:
        """Yield (kind, value) of what the process has sent, without steps; see `serve`."""
        try:
            while self.pipe.poll():
                kind, value = self.pipe.recv()
                self._heard = time.monotonic()
                if isinstance(value, Step):
                    self.step = value.name
                    continue
                self.ready = self.ready or kind == "ready"
                yield kind, value
        except (EOFError, OSError):
            return  # its end will be noticed

    def hangs(self, quiet_s: float | None) -> bool:
        """Check whether its unit has reported nothing for `quiet_s` seconds."""
        waited = time.monotonic() - self._heard
        return quiet_s is not None and self.unit is not None and self.ready and waited > quiet_s

    def end(self) -> tuple[Cause, str]:
        """End the process if it still runs; return the cause of its end, and how it ended in words."""
        self.pipe.close()
        self.process.kill()
        self.process.join()
        code = self.process.exitcode
        if code is None:  # the settings of a cluster may hide it
            return "killed", "ended by an unknown cause"
        name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        if name in CRASHES:
            return "crashed", f"ended the process by {name}"
        return "killed", f"ended by {name}"


class _Pool:
    """The `count` processes of one run."""

    def __init__(
        self, make_work: Callable[[int], Work], count: int, ledger: Ledger, on_event: OnEvent
    ) -> None:
        self._make_work, self._count = make_work, count
        self._ledger, self._on_event = ledger, on_event
        self._start_failures = 0
        self.processes: list[_WorkerProcess] = []

    def fill(self) -> None:
        while len(self.processes) < self._count:
            self.processes.append(_WorkerProcess(self._make_work, self._count))

    def turn(self) -> Iterator[Any]:
        """Hand out units, then handle the messages of the processes; yield results."""
        for process in self.processes:
            free = process.ready and process.unit is None and process.process.is_alive()
            if free and (taken := self._ledger.take()):
                process.start_unit(*taken)
        pipes = {process.pipe: process for process in self.processes}
        ends = {process.process.sentinel: process for process in self.processes}
        heard = wait([*pipes, *ends], timeout=TICK_S)
        for pipe in heard:
            if isinstance(pipe, Connection):
                yield from self._listen(pipes[pipe])
        for process in [ends[end] for end in heard if end in ends]:
            yield from self._listen(process)  # its messages from before it died
            self._bury(process)
        for process in list(self.processes):
            if process.hangs(self._ledger.limits.quiet_s):
                self._bury(process, hung=True)

    def _listen(self, process: _WorkerProcess) -> Iterator[Any]:
        for kind, value in process.messages():
            number = process.unit
            if kind == "failed":
                raise value
            if kind == "ready":
                self._start_failures = 0
            elif number is None:
                continue
            elif kind == "short of memory":
                process.unit = None
                self._ledger.lost(number, "killed", process.step, "ran out of memory")
            elif kind == "done":
                process.unit = None
                self._ledger.finished(number)
                yield value
            else:
                self._on_event(number, value)

    def _bury(self, process: _WorkerProcess, hung: bool = False) -> None:
        self.processes.remove(process)
        cause, how = process.end()
        if process.process.exitcode == UNGUARDED:
            script = getattr(sys.modules["__main__"], "__file__", None) or "this script"
            fault = "starts workers when it is imported, and each worker imports it"
            raise HMAError(script, fault, 'put the call under `if __name__ == "__main__":`')
        if hung:
            cause, how = "hung", f"made no progress for {self._ledger.limits.quiet_s:g} s"
        if not process.ready:
            self._start_failures += 1
            if self._start_failures >= START_FAILURES:
                remedy = "try fewer --workers; the machine may be short of memory"
                if "exit code" in how:
                    remedy = "the messages above say why"
                raise HMAError("a worker", f"cannot start; the last one {how}", remedy)
        if process.unit is not None:
            self._ledger.lost(process.unit, cause, process.step, how)

    def close(self) -> None:
        for process in self.processes:
            process.end()


# -- in the worker


def serve(pipe: Connection, make_work: Callable[[int], Work], workers: int) -> None:
    """Run units that come by the pipe and report on them until it closes; a worker's process calls this.

    The pipe receives (unit, attempt) and sends (kind, value), where kind is ready, event, done, failed or
    short of memory. `workers` is the number of workers of the whole run.
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

    kind, work = outcome(make_work, workers)
    if kind != "done":
        send("failed", work or HMAError("a worker", "has no memory to start", "try fewer --workers"))
        return
    send("ready")
    while kind != "failed":
        try:
            unit, attempt = pipe.recv()
        except EOFError:
            return
        kind, value = outcome(work, unit, partial(send, "event"), attempt)
        send(kind, value)


def _end_with_parent() -> None:
    """End this process when its parent ends; otherwise it would write beside the next job's workers."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
