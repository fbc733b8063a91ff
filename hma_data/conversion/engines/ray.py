"""Run work units on a Ray cluster: each worker is an actor that holds the tokenizer.

The output folder must be one that every node sees. Ray places the actors and restarts them, elsewhere if a
node is lost. `RAY_ADDRESS` names the cluster; without it, Ray starts on this machine.

The driver hands an actor one unit at a time, and always has one call waiting that asks for its events. Ray
does not tell whether a process crashed or was killed. A loss therefore counts as a kill, until as many as
LOSSES_AT_A_STEP attempts that go step by step have ended at one step; then that step counts as the cause.
"""

import os
import re
import socket
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from threading import Condition
from typing import Any

from hma_data.conversion.engines import (
    LIMITS,
    Attempt,
    Cause,
    End,
    Ledger,
    Limits,
    Notice,
    OnEvent,
    Step,
    Work,
    outcome,
)
from hma_data.cpu import take_ordinary_priority
from hma_data.errors import HMAError, MissingDependencyError, install_command

TICK_S = 0.5
ANSWER_S = 1.0  # seconds for which an actor collects events before it answers
ANSWERS_A_S = 100.0  # largest number of answers a second that the driver processes
CONNECT_S = 10.0  # for the answer of a cluster's address
NO_ROOM_S = 900.0  # seconds without any actor that could be placed
SLOW_START_S = 60.0  # seconds after which the user hears that no actor is ready
LOST_STARTS = 4  # limit of losses in a row, for each worker and one more, before any actor is ready
LOSSES_AT_A_STEP = 3
UV_ENVIRONMENT = "RAY_ENABLE_UV_RUN_RUNTIME_ENV"
INSTALLED = "install hma-toolkit and what it needs on every node; see Ray's logs"
SMALLER = "change --worker-cpus, --worker-gpus or --device"


def run(
    units: Sequence[Any],
    make_work: Callable[[int], Work],
    workers: int,
    on_event: OnEvent,
    limits: Limits = LIMITS,
    cpus: float = 1.0,
    gpus: float = 0.0,
) -> Iterator[Any]:
    """Run every unit and yield each result when it is ready; see engines.local.run.

    Args:
        workers: number of actors.
        cpus, gpus: of an actor; fractions share a CPU or GPU among actors.

    Raises:
        HMAError: a unit failed for a reason that is not its data, its worker was lost too often, or the
            cluster has no room for any worker or cannot start one.
        MissingDependencyError: Ray is not installed.
    """
    ray = import_ray()
    ours = not ray.is_initialized()
    if ours:
        _join(ray)
    if lack := _lack_of_room(ray, {"CPU": cpus, "GPU": gpus}):
        if not os.environ.get("RAY_ADDRESS"):  # a cluster of this machine does not grow
            if ours:
                ray.shutdown()
            raise HMAError("Ray on this machine", lack, f"set RAY_ADDRESS to a larger cluster, or {SMALLER}")
        text = f"the Ray cluster {lack}; waiting for a node, {NO_ROOM_S / 60:g} minutes at most"
        on_event(0, Notice(f"{text}: Ctrl-C and {SMALLER} if the cluster does not grow"))
    ledger = Ledger(units, limits, on_event)
    count = min(max(workers, 1), max(len(ledger.units), 1))
    # no task events: for its dashboard, Ray keeps a record of each call in three processes
    options = {"num_cpus": cpus, "num_gpus": gpus, "max_restarts": -1, "enable_task_events": False}
    actor = ray.remote(concurrency_groups={"look": 1}, **options)(Worker)
    actors = _Actors(ray, [actor.remote() for _ in range(count)], make_work, ledger, on_event)
    try:
        while ledger.open:
            yield from actors.turn()
        if ledger.failures:
            raise ledger.failures[0]
    finally:
        actors.close()
        if ours:
            ray.shutdown()


def import_ray() -> Any:
    """Import Ray for processes that take the environment of their node.

    Under `uv run` Ray would pack the working folder, data in it too, and install everything anew for each
    actor: 48 s instead of one.
    """
    os.environ.setdefault(UV_ENVIRONMENT, "0")  # Ray reads it once, when it is imported
    try:
        import ray
    except ImportError as fault:
        raise MissingDependencyError(
            "--engine ray", "Ray is not installed", install_command("ray")
        ) from fault
    return ray


def _join(ray: Any) -> None:
    address = os.environ.get("RAY_ADDRESS")
    try:
        if address and (found := re.fullmatch(r"(?:ray://)?\[?([^/]+?)]?:(\d+)", address)):
            # Ray itself asks a wrong address again and again for many minutes
            socket.create_connection((found[1], int(found[2])), CONNECT_S).close()
        ray.init(log_to_driver=False, logging_level="warning", include_dashboard=False)
    except Exception as fault:  # Ray raises some errors of this class here
        ray.shutdown()
        where = f"the Ray cluster at {address}" if address else "Ray on this machine"
        what = f"cannot be {'joined' if address else 'started'}: {_first_line(fault)}"
        remedy = "check the address with `ray status`" if address else "leave out --engine ray"
        raise HMAError(where, what, remedy) from fault


def _lack_of_room(ray: Any, wanted: dict[str, float]) -> str:
    """Return in words that no node has what a worker reserves; empty if one has, busy or not."""
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if any(all(node.get(kind, 0) >= count for kind, count in wanted.items()) for node in nodes):
        return ""
    best = {kind: max((node.get(kind, 0) for node in nodes), default=0) for kind in wanted}
    text = " and ".join(f"{count:g} {kind} (of {best[kind]:g})" for kind, count in wanted.items() if count)
    return f"has no room for a worker, which reserves {text}"


# -- in an actor


class Worker:
    """An actor that makes units. It collects their events until the driver looks."""

    def __init__(self) -> None:
        self._news = Condition()
        self._events: list[tuple[int, Any]] = []
        self._given: list[tuple[int, Any]] = []  # by the last look; the driver has them once it looks again
        self._urgent = False
        self._work: Any = None

    def open(self, make_work: Callable[[int], Work], workers: int) -> End:
        """Load the tokenizer."""
        take_ordinary_priority()
        end, self._work = outcome(make_work, workers)
        return ("done", None) if end == "done" else ("failed", self._work or MemoryError("no room to start"))

    def do(self, number: int, unit: Any, attempt: Attempt) -> tuple[End, list[tuple[int, Any]]]:
        """Make a unit; return how it ended, and its events that no look has returned."""
        if self._work is None:  # the actor that was opened is lost, and Ray gave its task to this one
            return ("closed", None), []
        end = outcome(self._work, unit, partial(self._report, number, attempt), attempt)
        with self._news:
            events, self._events = self._events, []
        return end, events

    def look(self, wait_s: float) -> list[tuple[int, Any]]:
        """Wait `wait_s` seconds, or until a step waits; return the events since the last look, with units."""
        with self._news:
            self._given = []
            self._news.notify_all()
            self._news.wait_for(lambda: self._urgent, wait_s)
            self._given, self._events, self._urgent = self._events, [], False
            return self._given

    def _report(self, number: int, attempt: Attempt, event: Any) -> None:
        with self._news:
            self._events.append((number, event))
            if attempt.number and isinstance(
                event, Step
            ):  # it may end this process, and the driver must know
                self._urgent = True
                self._news.notify_all()
                self._news.wait_for(lambda: not self._events and not self._given)


# -- in the driver


@dataclass
class _Slot:
    """An actor, references to what it is asked, and its unit; while it has a task but no unit, it opens."""

    actor: Any
    task: Any = None
    look: Any = None
    unit: int | None = None
    attempt: int = 0
    step: str = ""
    hung: bool = False
    heard: float = field(default_factory=time.monotonic)


class _Actors:
    """The actors of one run. Each has at most one unit, so that a slow one delays no other unit."""

    def __init__(
        self, ray: Any, actors: list[Any], make_work: Callable[[int], Work], ledger: Ledger, on_event: OnEvent
    ) -> None:
        self._ray, self._ledger, self._on_event = ray, ledger, on_event
        self._answer_s = max(ANSWER_S, len(actors) / ANSWERS_A_S)
        self._make_work = ray.put(make_work), len(actors)
        self._slots = [_Slot(actor) for actor in actors]
        self._losses: Counter[tuple[int, str]] = Counter()  # of attempts that went step by step
        self._lost_starts = 0
        self._placed = time.monotonic()  # when an actor was last ready
        self._told = False  # that none is
        for slot in self._slots:
            self._open(slot)

    def _open(self, slot: _Slot) -> None:
        slot.unit, slot.look = None, None
        slot.task = slot.actor.open.remote(*self._make_work)

    def turn(self) -> Iterator[Any]:
        """Hand out units, then handle what has come from the actors; yield results."""
        for slot in self._slots:
            if slot.task is None and (taken := self._ledger.take()):
                slot.unit, unit, attempt = taken
                slot.attempt, slot.step, slot.hung, slot.heard = attempt.number, "", False, time.monotonic()
                slot.task = slot.actor.do.remote(slot.unit, unit, attempt)
            if slot.unit is not None and slot.look is None:
                look = slot.actor.look.options(concurrency_group="look")
                slot.look = look.remote(self._answer_s)
        refs = [ref for slot in self._slots for ref in (slot.look, slot.task) if ref is not None]
        self._ray.wait(refs, num_returns=1, timeout=TICK_S)
        heard = set(self._ray.wait(refs, num_returns=len(refs), timeout=0)[0])
        for slot in self._slots:
            if slot.look in heard:
                self._hear(slot)
            if slot.task in heard:
                yield from self._end(slot)
            quiet_s, waited = self._ledger.limits.quiet_s, time.monotonic() - slot.heard
            if slot.unit is not None and not slot.hung and quiet_s is not None and waited > quiet_s:
                slot.hung = True
                self._ray.kill(slot.actor, no_restart=False)
        self._watch_start()

    def _watch_start(self) -> None:
        """Tell the user once that no actor is ready; raise HMAError after NO_ROOM_S."""
        if any(slot.task is None or slot.unit is not None for slot in self._slots):
            self._placed = time.monotonic()
        waited = time.monotonic() - self._placed
        if waited > NO_ROOM_S:
            remedy = "see `ray status`; every worker needs a CPU, and a GPU with --device cuda"
            raise HMAError("the Ray cluster", f"has had no room for a worker for {NO_ROOM_S:g} s", remedy)
        if waited > SLOW_START_S and not self._told:
            self._told = True
            text = f"no worker is ready after {waited:.0f} s: they wait for room, or load the tokenizer"
            self._on_event(0, Notice(f"{text}; `ray status` shows what is reserved"))

    def _hear(self, slot: _Slot) -> None:
        look, slot.look = slot.look, None
        with suppress(self._ray.exceptions.RayError):  # the actor was lost; so is its task, which comes next
            self._pass_on(slot, self._ray.get(look))

    def _pass_on(self, slot: _Slot, events: list[tuple[int, Any]]) -> None:
        for number, event in events:
            slot.heard = time.monotonic()
            if isinstance(event, Step):
                slot.step = event.name
            else:
                self._on_event(number, event)

    def _end(self, slot: _Slot) -> Iterator[Any]:
        number, task, events = slot.unit, slot.task, []
        try:
            end = self._ray.get(task)
        except self._ray.exceptions.RayTaskError as fault:
            raise HMAError("the Ray cluster", f"cannot work: {_first_line(fault)}", INSTALLED) from fault
        except self._ray.exceptions.RayError as fault:
            self._lost(slot, "was lost: " + _first_line(fault).split(": ")[0].split(". ")[0].rstrip("."))
            return
        if number is not None:
            end, events = end
        kind, value = end
        if kind == "closed":
            self._lost(slot, "was lost between two units")
            return
        slot.task, slot.unit = None, None
        self._pass_on(slot, events)
        if kind == "failed":
            raise value
        if number is None:
            self._lost_starts = 0
        elif kind == "short of memory":
            self._ledger.lost(number, "killed", slot.step, "ran out of memory")
        else:
            self._ledger.finished(number)
            yield value

    def _lost(self, slot: _Slot, how: str) -> None:
        """Note that an actor was lost; Ray restarts it."""
        number, step = slot.unit, slot.step
        self._open(slot)
        if number is None:
            self._lost_starts += 1
            if self._lost_starts >= LOST_STARTS * (len(self._slots) + 1):
                fault = f"lost {self._lost_starts} workers in a row at their start; the last {how}"
                raise HMAError("the Ray cluster", fault, INSTALLED)
            return
        self._losses[number, step] += bool(slot.attempt)
        cause: Cause = "killed"
        if slot.hung:
            cause, how = "hung", f"made no progress for {self._ledger.limits.quiet_s:g} s"
        elif step and self._losses[number, step] >= LOSSES_AT_A_STEP:
            cause, how = "crashed", f"ended the process {LOSSES_AT_A_STEP} times"
        self._ledger.lost(number, cause, step, how)

    def close(self) -> None:
        for slot in self._slots:
            self._ray.kill(slot.actor)


def _first_line(fault: Exception) -> str:
    return (str(fault).strip().splitlines() or [type(fault).__name__])[0][:200]
