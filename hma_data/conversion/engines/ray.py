"""Run work units on a Ray cluster, one actor a worker, with the tokenizer on the actor's GPU if it has one.

Units and output bytes are the same as with the local engine; only the machine differs. ray_actor.py defines
the actor. The output folder must be one that every node sees. When a node is lost, its actors are lost too,
and their units are done again elsewhere. `RAY_ADDRESS` names the cluster; without it, Ray starts on this
machine.
"""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from hma_data.conversion.engines.base import LIMITS, Cause, Ledger, Limits, OnEvent, Work
from hma_data.conversion.engines.ray_actor import Answer, End, Failed, Lost, Opened, Worker
from hma_data.errors import HMAError, MissingDependencyError

TICK_S = 0.5
ANSWER_S = 1.0  # seconds for which an actor collects events before it answers
ANSWERS_A_S = 100.0  # largest number of answers a second that the driver processes
SILENT_S = 60.0  # beyond a unit's quiet time; an actor always answers, whatever its unit does
NO_ROOM_S = 900.0  # seconds without any actor that could be placed
LOST_STARTS = 5, 3  # limit of actors in a row that end before they are ready: 5, and 3 for each worker
INSTALLED = "hma-toolkit and what it needs must be installed on every node; see Ray's logs"


def run(
    units: Sequence[Any],
    make_work: Callable[[int], Work],
    workers: int,
    on_event: OnEvent,
    limits: Limits = LIMITS,
    gpus: float = 0.0,
) -> Iterator[Any]:
    """Run every unit and yield each result when it is ready; see engines.base.Engine.

    Args:
        workers: number of actors.
        gpus: GPUs of each actor.

    Raises:
        HMAError: a unit failed for a reason that is not its data, its worker was lost too often, or the
            cluster has no room for any worker or cannot start one.
        MissingDependencyError: Ray is not installed.
    """
    ray = _ray()
    ours = not ray.is_initialized()
    if ours:
        _join(ray)
    ledger = Ledger(units, limits)
    actors = _Actors(ray, make_work, min(max(workers, 1), max(len(ledger.units), 1)), gpus, ledger, on_event)
    try:
        while ledger.open:
            yield from actors.turn()
        ledger.raise_failures()
    finally:
        actors.close()
        if ours:
            ray.shutdown()


def _ray() -> Any:
    try:
        import ray
    except ImportError as fault:
        raise MissingDependencyError(
            "--engine ray", "Ray is not installed", "pip install 'hma-toolkit[ray]'"
        ) from fault
    return ray


def _join(ray: Any) -> None:
    try:
        ray.init(log_to_driver=False, logging_level="warning", include_dashboard=False)
    except Exception as fault:  # Ray raises some errors of this class here
        ray.shutdown()
        address = os.environ.get("RAY_ADDRESS")
        raise HMAError(
            f"the Ray cluster at {address}" if address else "Ray on this machine",
            f"cannot be {'joined' if address else 'started'}: {_first_line(fault)}",
            "see `ray status` there" if address else "see its logs in /tmp/ray, or leave out --engine ray",
        ) from fault


@dataclass
class _Slot:
    """An actor and the unit it is at; `answer` is a reference to an answer that has not come yet."""

    actor: Any
    answer: Any
    ready: bool = False
    unit: int | None = None
    heard: float = field(default_factory=time.monotonic)


class _Actors:
    """The actors of one run. Each has at most one unit, so that a slow one delays no other unit."""

    def __init__(
        self,
        ray: Any,
        make_work: Callable[[int], Work],
        count: int,
        gpus: float,
        ledger: Ledger,
        on_event: OnEvent,
    ) -> None:
        self._ray, self._ledger, self._on_event, self._count = ray, ledger, on_event, count
        self._arguments = (
            ray.put(make_work),
            count,
            ledger.limits.quiet_s,
            max(ANSWER_S, count / ANSWERS_A_S),
        )
        # no task events: for its dashboard, Ray keeps a record of each call in three processes
        self._class = ray.remote(num_cpus=1, num_gpus=gpus, max_restarts=0, enable_task_events=False)(Worker)
        self._gone = (
            ray.exceptions.RayActorError,
            ray.exceptions.WorkerCrashedError,
            ray.exceptions.OutOfMemoryError,
            ray.exceptions.ObjectLostError,
            ray.exceptions.NodeDiedError,
        )
        self._slots: list[_Slot] = []
        self._lost_starts = 0
        self._placed = time.monotonic()

    def turn(self) -> Iterator[Any]:
        """Hand out units, then process the answers of the actors; yield results."""
        while len(self._slots) < self._count:
            actor = self._class.remote(*self._arguments)
            self._slots.append(_Slot(actor, actor.open.remote()))
        for slot in self._slots:
            self._hand_out(slot)
        waiting = {slot.answer: slot for slot in self._slots if slot.answer is not None}
        refs = list(waiting)
        self._ray.wait(refs, num_returns=1, timeout=TICK_S)
        heard, _ = self._ray.wait(refs, num_returns=len(refs), timeout=0)
        for ref in heard:
            yield from self._listen(waiting[ref])
        self._end_the_silent()
        self._check_room()

    def _hand_out(self, slot: _Slot) -> None:
        if not slot.ready or slot.unit is not None:
            return
        taken = self._ledger.take()
        if taken is not None:
            slot.unit, unit, attempt = taken
            slot.heard = time.monotonic()
            slot.answer = slot.actor.do.remote(unit, attempt)

    def _listen(self, slot: _Slot) -> Iterator[Any]:
        try:
            answer: Answer = self._ray.get(slot.answer)
        except self._gone as fault:
            self._bury(slot, "was lost: " + _first_line(fault))
            return
        except self._ray.exceptions.RayError as fault:
            raise HMAError("the Ray cluster", f"cannot work: {_first_line(fault)}", INSTALLED) from fault
        slot.heard = time.monotonic()
        for event in answer.events:
            assert slot.unit is not None
            self._on_event(slot.unit, event)
        yield from self._take_in(slot, answer.end)

    def _take_in(self, slot: _Slot, end: End | None) -> Iterator[Any]:
        if end is None:
            slot.answer = slot.actor.go_on.remote()
            return
        slot.answer = None
        if isinstance(end, Failed):
            raise end.fault
        if isinstance(end, Opened):
            slot.ready, self._lost_starts, self._placed = True, 0, time.monotonic()
            return
        number, slot.unit = slot.unit, None
        assert number is not None
        if isinstance(end, Lost):
            self._lost(number, end.step, end.cause, end.how)
        else:
            self._ledger.finished(number)
            yield end.result

    def _bury(self, slot: _Slot, how: str) -> None:
        self._slots.remove(slot)
        self._ray.kill(slot.actor)  # an actor that is only out of reach would go on
        if slot.unit is not None:
            self._lost(slot.unit, "", "killed", how)
        elif not slot.ready:
            self._lost_starts += 1
            if self._lost_starts >= LOST_STARTS[0] + LOST_STARTS[1] * self._count:
                fault = f"lost {self._lost_starts} workers in a row at their start; the last {how}"
                raise HMAError("the Ray cluster", fault, INSTALLED)

    def _lost(self, number: int, step: str, cause: Cause, how: str) -> None:
        retry = self._ledger.lost(number, cause, step, how)
        if retry:
            self._on_event(number, retry)

    def _end_the_silent(self) -> None:
        """End actors that do not answer; an actor itself ends a unit that is quiet."""
        quiet = self._ledger.limits.quiet_s
        for slot in list(self._slots):
            if quiet and slot.unit is not None and time.monotonic() - slot.heard > quiet + SILENT_S:
                self._bury(slot, f"was lost: no answer for {quiet + SILENT_S:g} s")

    def _check_room(self) -> None:
        if any(slot.ready for slot in self._slots):
            self._placed = time.monotonic()
        elif time.monotonic() - self._placed > NO_ROOM_S:
            raise HMAError(
                "the Ray cluster",
                f"has had no room for a worker for {NO_ROOM_S:g} s",
                "see `ray status`; every worker needs a CPU, and a GPU with --device cuda",
            )

    def close(self) -> None:
        """End every actor; its process ends with it."""
        for slot in self._slots:
            self._ray.kill(slot.actor)


def _first_line(fault: Exception) -> str:
    return (str(fault).strip().splitlines() or [type(fault).__name__])[0][:200]
