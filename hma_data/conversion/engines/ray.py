"""Run work units on a Ray cluster, one actor a worker, with the tokenizer on the actor's GPU if it has one.

The output folder must be one that every node sees. When a node is lost, its actors are lost too, and their
units are done again elsewhere. `RAY_ADDRESS` names the cluster; without it, Ray starts on this machine.

An actor keeps one worker process of the local engine. So the threads and buffers of Ray are in another
process than the tokenizer, and the exit code of the process is known. The actor collects events, so that the
driver gets an answer about once a second, not at every step.
"""

import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import Any

from hma_data.conversion.engines import LIMITS, Attempt, Cause, Ledger, Limits, OnEvent, Work
from hma_data.conversion.engines.local import Pool, WorkerProcess
from hma_data.errors import HMAError, MissingDependencyError, install_command

TICK_S = 0.5
ANSWER_S = 1.0  # seconds for which an actor collects events before it answers
ANSWERS_A_S = 100.0  # largest number of answers a second that the driver processes
NO_ROOM_S = 900.0  # seconds without any actor that could be placed
LOST_STARTS = 4  # limit of actors in a row, for each worker and one more, that end before they are ready
INSTALLED = "install hma-toolkit and what it needs on every node; see Ray's logs"


def run(
    units: Sequence[Any],
    make_work: Callable[[int], Work],
    workers: int,
    on_event: OnEvent,
    limits: Limits = LIMITS,
    gpus: float = 0.0,
) -> Iterator[Any]:
    """Run every unit and yield each result when it is ready; see engines.local.run.

    Args:
        workers: number of actors, each with `gpus` GPUs.

    Raises:
        HMAError: a unit failed for a reason that is not its data, its worker was lost too often, or the
            cluster has no room for any worker or cannot start one.
        MissingDependencyError: Ray is not installed.
    """
    ray = _ray()
    ours = not ray.is_initialized()
    if ours:
        _join(ray)
    ledger = Ledger(units, limits, on_event)
    actors = _Actors(ray, make_work, min(max(workers, 1), max(len(ledger.units), 1)), gpus, ledger, on_event)
    try:
        while ledger.open:
            yield from actors.turn()
        if ledger.failures:
            raise ledger.failures[0]
    finally:
        actors.close()
        if ours:
            ray.shutdown()


def _ray() -> Any:
    try:
        import ray
    except ImportError as fault:
        raise MissingDependencyError(
            "--engine ray", "Ray is not installed", install_command("ray")
        ) from fault
    return ray


def _join(ray: Any) -> None:
    try:
        ray.init(log_to_driver=False, logging_level="warning", include_dashboard=False)
    except Exception as fault:  # Ray raises some errors of this class here
        ray.shutdown()
        address = os.environ.get("RAY_ADDRESS")
        where = f"the Ray cluster at {address}" if address else "Ray on this machine"
        what = f"cannot be {'joined' if address else 'started'}: {_first_line(fault)}"
        raise HMAError(where, what, "see `ray status`, or leave out --engine ray") from fault


# -- in an actor


# How an actor's task ends: ("ready", None) for its first unit, ("done", result), ("failed", the error that
# ends the job), or ("lost", (cause, step, how)), see Ledger.lost.
End = tuple[str, Any]
Answer = tuple[list[Any], End | None]  # a unit's events since the last answer; and its end, if it is over


class Worker:
    """An actor that keeps a worker process, hands it units and passes on its messages.

    The driver calls `open` or `do`, then `go_on` until an answer carries an end. To the pool of its one
    process the actor is what the Ledger is to a local pool.

    Args:
        make_work, workers: see `local.serve`.
        quiet_s: see Limits.
        answer_s: seconds for which events are collected, unless the unit ends before.
    """

    def __init__(
        self, make_work: Callable[[int], Work], workers: int, quiet_s: float | None, answer_s: float
    ) -> None:
        self.limits = Limits(quiet_s)
        start = partial(WorkerProcess, make_work, workers)
        self.pool = Pool(start, 1, self, lambda _, event: self._events.append(event))
        self._answer_s = answer_s
        self._unit: tuple[int, Any, Attempt] | None = None
        self._opening = False
        self._events: list[Any] = []
        self._end: End | None = None

    def open(self) -> Answer:
        """Start the process; its last answer ends with "ready"."""
        self._opening = True
        return self.go_on()

    def do(self, unit: Any, attempt: Attempt) -> Answer:
        """Start a unit."""
        self._unit = 0, unit, attempt
        return self.go_on()

    def go_on(self) -> Answer:
        """Listen for `answer_s` seconds, or until the end."""
        until = time.monotonic() + self._answer_s
        while self._end is None and time.monotonic() < until:
            with _no_script():
                self.pool.fill()
            try:
                for result in self.pool.turn():
                    self._end = "done", result
            except HMAError as fault:
                self._end = "failed", fault
            if self._opening and any(process.ready for process in self.pool.processes):
                self._opening, self._end = False, ("ready", None)
        answer = self._events, self._end
        self._events, self._end = [], None
        return answer

    def take(self) -> tuple[int, Any, Attempt] | None:
        """Return the unit if it has not been started."""
        unit, self._unit = self._unit, None
        return unit

    def finished(self, number: int) -> None:
        """Do nothing; the pool yields the result."""

    def lost(self, number: int, cause: Cause, step: str, how: str) -> None:
        """Tell the driver that the unit lost its process."""
        self._end = "lost", (cause, step, how)


@contextmanager
def _no_script() -> Iterator[None]:
    """Replace the main module for a moment; a spawned process would run it, and here it is Ray's own."""
    script = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script


# -- in the driver


@dataclass
class _Slot:
    """An actor and the unit it is at; `answer` is a reference to an answer that has not come yet."""

    actor: Any
    answer: Any
    ready: bool = False
    unit: int | None = None


class _Actors:
    """The actors of one run. Each has at most one unit, so that a slow one delays no other unit."""

    def __init__(
        self, ray: Any, make_work: Callable[[int], Work], count: int, gpus: float,
        ledger: Ledger, on_event: OnEvent,
    ) -> None:  # fmt: skip
        self._ray, self._ledger, self._on_event, self._count = ray, ledger, on_event, count
        answer_s = max(ANSWER_S, count / ANSWERS_A_S)
        self._arguments = ray.put(make_work), count, ledger.limits.quiet_s, answer_s
        # no task events: for its dashboard, Ray keeps a record of each call in three processes
        self._class = ray.remote(num_cpus=1, num_gpus=gpus, max_restarts=0, enable_task_events=False)(Worker)
        self._slots: list[_Slot] = []
        self._lost_starts = 0
        self._placed = time.monotonic()  # when an actor was last ready

    def turn(self) -> Iterator[Any]:
        while len(self._slots) < self._count:
            actor = self._class.remote(*self._arguments)
            self._slots.append(_Slot(actor, actor.open.remote()))
        for slot in self._slots:
            if slot.ready and slot.unit is None and (taken := self._ledger.take()):
                slot.unit, unit, attempt = taken
                slot.answer = slot.actor.do.remote(unit, attempt)
        waiting = {slot.answer: slot for slot in self._slots if slot.answer is not None}
        refs = list(waiting)
        self._ray.wait(refs, num_returns=1, timeout=TICK_S)
        heard, _ = self._ray.wait(refs, num_returns=len(refs), timeout=0)
        for ref in heard:
            yield from self._listen(waiting[ref])
        if any(slot.ready for slot in self._slots):
            self._placed = time.monotonic()
        elif time.monotonic() - self._placed > NO_ROOM_S:
            remedy = "see `ray status`; every worker needs a CPU, and a GPU with --device cuda"
            raise HMAError("the Ray cluster", f"has had no room for a worker for {NO_ROOM_S:g} s", remedy)

    def _listen(self, slot: _Slot) -> Iterator[Any]:
        try:
            events, end = self._ray.get(slot.answer)
        except self._ray.exceptions.RayTaskError as fault:
            raise HMAError("the Ray cluster", f"cannot work: {_first_line(fault)}", INSTALLED) from fault
        except self._ray.exceptions.RayError as fault:
            self._bury(slot, "was lost: " + _first_line(fault))
            return
        for event in events:
            assert slot.unit is not None
            self._on_event(slot.unit, event)
        if end is None:
            slot.answer = slot.actor.go_on.remote()
            return
        slot.answer, (kind, value) = None, end
        if kind == "failed":
            raise value
        if kind == "ready":
            slot.ready, self._lost_starts = True, 0
            return
        number, slot.unit = slot.unit, None
        assert number is not None
        if kind == "lost":
            self._ledger.lost(number, *value)
        else:
            self._ledger.finished(number)
            yield value

    def _bury(self, slot: _Slot, how: str) -> None:
        self._slots.remove(slot)
        self._ray.kill(slot.actor)  # an actor that is only out of reach would go on
        if slot.unit is not None:
            self._ledger.lost(slot.unit, "killed", "", how)
        elif not slot.ready:
            self._lost_starts += 1
            if self._lost_starts >= LOST_STARTS * (self._count + 1):
                fault = f"lost {self._lost_starts} workers in a row at their start; the last {how}"
                raise HMAError("the Ray cluster", fault, INSTALLED)

    def close(self) -> None:
        for slot in self._slots:
            self._ray.kill(slot.actor)


def _first_line(fault: Exception) -> str:
    return (str(fault).strip().splitlines() or [type(fault).__name__])[0][:200]
