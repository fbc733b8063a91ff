"""Run units in an actor of a cluster: keep one worker process, hand it units, and pass on its messages.

The process is a worker process of the local engine. This has three effects. The threads and buffers of the
cluster's software are in another process than the tokenizer. The exit code of the process is known. Events
are collected before they are sent, so that the driver gets an answer about once a second, not at every step.
"""

import multiprocessing
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import wait
from types import ModuleType
from typing import Any

from hma_data.conversion.engines.base import Attempt, Cause, Step, Work
from hma_data.conversion.engines.local import CRASHES, KILLS_A_FAILURE, START_FAILURES, serve, signal_name
from hma_data.errors import HMAError

TICK_S = 0.5


@dataclass(frozen=True)
class Opened:
    """The process is ready for its first unit."""


@dataclass(frozen=True)
class Done:
    """A unit is done, with this result."""

    result: Any


@dataclass(frozen=True)
class Lost:
    """The unit's process is gone or ran out of memory; see engines.base.Ledger.lost."""

    cause: Cause
    step: str
    how: str


@dataclass(frozen=True)
class Failed:
    """An error that ends the job."""

    fault: HMAError


End = Opened | Done | Lost | Failed


@dataclass(frozen=True)
class Answer:
    """The events of a unit since the last answer, without its steps; and its end, if it is over."""

    events: tuple[Any, ...]
    end: End | None = None


class Worker:
    """An actor that keeps a worker process, hands it units and passes on its messages.

    The driver calls `open` or `do`, then `go_on` until an answer carries an end.

    Args:
        make_work: called in the process.
        workers: number of workers of the whole run.
        quiet_s: see engines.base.Limits.
        answer_s: seconds for which events are collected, unless the unit ends before.
    """

    def __init__(
        self, make_work: Callable[[int], Work], workers: int, quiet_s: float | None, answer_s: float
    ) -> None:
        self._make_work, self._workers, self._quiet_s, self._answer_s = make_work, workers, quiet_s, answer_s
        self._process: Any = None
        self._ready = False
        self._unit: tuple[Any, Attempt] | None = None
        self._step, self._heard = "", 0.0
        self._start_failures = 0

    def open(self) -> Answer:
        """Start the process; its last answer carries Opened."""
        self._start()
        return self.go_on()

    def do(self, unit: Any, attempt: Attempt) -> Answer:
        """Start a unit."""
        self._unit = unit, attempt
        if self._process is not None and not self._process.is_alive():
            self._end()
        if self._process is None:
            self._start()
        else:
            self._hand_over()
        return self.go_on()

    def go_on(self) -> Answer:
        """Listen for `answer_s` seconds, or until the end."""
        events: list[Any] = []
        until = time.monotonic() + self._answer_s
        while (left := until - time.monotonic()) > 0:
            end = self._listen(min(left, TICK_S), events)
            if end is not None:
                return Answer(tuple(events), end)
        return Answer(tuple(events))

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=serve, args=(theirs, self._make_work, self._workers), daemon=True, name="hma-worker"
        )
        self._ready = False
        with _no_script():
            self._process.start()
        theirs.close()

    def _hand_over(self) -> None:
        self._step, self._heard = "", time.monotonic()
        with suppress(OSError):  # it died just now; `_listen` notices its end
            self._pipe.send(self._unit)

    def _listen(self, seconds: float, events: list[Any]) -> End | None:
        gone = self._process.sentinel in wait([self._pipe, self._process.sentinel], timeout=seconds)
        try:
            while self._pipe.poll():
                kind, value = self._pipe.recv()
                end = self._take_in(kind, value, events)
                if end is not None:
                    return end
        except (EOFError, OSError):
            gone = True
        if gone:
            return self._ended()
        quiet = time.monotonic() - self._heard
        if self._ready and self._quiet_s and quiet > self._quiet_s:
            self._end()
            return self._lost("hung", f"made no progress for {self._quiet_s:g} s")
        return None

    def _take_in(self, kind: str, value: Any, events: list[Any]) -> End | None:
        self._heard = time.monotonic()
        if kind == "ready":
            self._ready, self._start_failures = True, 0
            if self._unit is None:
                return Opened()
            self._hand_over()
        elif kind == "failed":
            return Failed(value)
        elif kind == "short of memory":
            return self._lost("killed", "ran out of memory")
        elif kind == "done":
            self._unit = None
            return Done(value)
        elif isinstance(value, Step):
            self._step = value.name
        else:
            events.append(value)
        return None

    def _ended(self) -> End | None:
        """Return what the end of the process means for the unit; restart a process that was not ready yet."""
        code = self._end()
        name = _name_of_end(code)
        if self._ready:
            if name in CRASHES:
                return self._lost("crashed", f"ended the process by {name}")
            return self._lost("killed", f"ended by {name}")
        killed = code is None or (code < 0 and name not in CRASHES)
        self._start_failures += 1 if killed else KILLS_A_FAILURE
        if self._start_failures >= START_FAILURES:
            remedy = "see Ray's logs of its node; perhaps it is short of memory"
            return Failed(HMAError("a worker", f"ended at its start, by {name}", remedy))
        self._start()
        return None

    def _end(self) -> int | None:
        """End the process and return its exit code; None if the cluster's settings hide it."""
        self._pipe.close()
        process, self._process = self._process, None
        process.kill()  # has no effect if it is already gone
        process.join()
        code: int | None = process.exitcode
        return code

    def _lost(self, cause: Cause, how: str) -> Lost:
        self._unit = None
        return Lost(cause, self._step, how)


def _name_of_end(code: int | None) -> str:
    if code is None:
        return "an unknown cause"
    return signal_name(-code) if code < 0 else f"exit code {code}"


@contextmanager
def _no_script() -> Iterator[None]:
    """Replace the main module for a moment; a spawned process would run it, and here it is Ray's own."""
    script = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script
