"""Run work units on a Ray cluster: an actor a worker, which keeps its tokenizer, on the GPU where it has one.

The same units, the same bytes as the local engine; only where they are made differs. The output folder
must be one that every node sees. A node that is lost takes its actors along: their units are done again
elsewhere. `RAY_ADDRESS` names the cluster; without one, Ray starts on this machine.
"""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from hma_data.engines.base import LIMITS, Attempt, Cause, Ledger, Limits, OnEvent, Step, Work
from hma_data.errors import HMAError, MissingDependencyError

TICK_S = 0.5
NO_ROOM_S = 900.0  # without any actor that could be placed


def run(
    units: Sequence[Any],
    make_work: Callable[[int], Work],
    workers: int,
    on_event: OnEvent,
    limits: Limits = LIMITS,
    gpus: float = 0.0,
) -> Iterator[Any]:
    """Do every unit and yield each result as it is ready; see engines.base.Engine.

    Args:
        workers: actors.
        gpus: of each.

    Raises:
        HMAError: a unit failed for a reason that is not its data, its actor was lost too often, or the
            cluster has no room for any.
        MissingDependencyError: Ray is not installed.
    """
    ray = _ray()
    ours = not ray.is_initialized()
    if ours:
        ray.init(log_to_driver=False, logging_level="warning")
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


class Notes:
    """What each worker is at; an actor beside the driver, so that it outlives the workers."""

    def __init__(self) -> None:
        self._steps: dict[int, str] = {}

    def set(self, worker: int, step: str) -> None:
        """The worker begins a step."""
        self._steps[worker] = step

    def get(self, worker: int) -> str:
        """The last step it began; empty for none."""
        return self._steps.get(worker, "")


class Worker:
    """What an actor is: the work, and a list of what it reported that the driver has not fetched yet."""

    def __init__(self, make_work: Callable[[int], Work], workers: int, name: int, notes: Any) -> None:
        self._name, self._notes = name, notes
        self._reported: list[Any] = []
        self._lock = threading.Lock()
        self._fault: HMAError | None = None
        try:
            self._work = make_work(workers)
        except Exception as fault:
            self._fault = _as_ours(fault)

    def ready(self) -> HMAError | None:
        """Answers when the tokenizer is open; why it is not, if so."""
        return self._fault

    def do(self, unit: Any, attempt: Attempt) -> tuple[str, Any]:
        """A unit: `done` and its result, `failed` and the error, or `short of memory`."""
        try:
            return "done", self._work(unit, self._report, attempt)
        except MemoryError:
            return "short of memory", None
        except Exception as fault:
            return "failed", _as_ours(fault)

    def reported(self) -> list[Any]:
        """What was reported since the last call."""
        with self._lock:
            reported, self._reported = self._reported, []
        return reported

    def _report(self, event: Any) -> None:
        if isinstance(event, Step):  # before it is begun: a process that dies says nothing more
            import ray

            ray.get(self._notes.set.remote(self._name, event.name))
        with self._lock:
            self._reported.append(event)


def _as_ours(fault: Exception) -> HMAError:
    if isinstance(fault, HMAError):
        return fault
    return HMAError("a worker", f"{type(fault).__name__}: {fault}", "this should have been a clearer error")


@dataclass
class _Slot:
    """An actor, and what it is at; references are answers that have not come yet."""

    name: int
    actor: Any
    readying: Any
    ready: bool = False
    unit: int | None = None
    doing: Any = None
    reporting: Any = None
    heard: float = field(default_factory=time.monotonic)


class _Actors:
    """The actors of one run. At most one unit is with each, so a slow one holds up nothing."""

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
        self._make_work = ray.put(make_work)
        self._class = ray.remote(num_cpus=1, num_gpus=gpus, max_concurrency=2, max_restarts=0)(Worker)
        self._gone = (
            ray.exceptions.RayActorError,
            ray.exceptions.WorkerCrashedError,
            ray.exceptions.OutOfMemoryError,
            ray.exceptions.ObjectLostError,
            ray.exceptions.NodeDiedError,
        )
        beside = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(
            ray.get_runtime_context().get_node_id(), soft=True
        )
        self._notes = ray.remote(num_cpus=0, scheduling_strategy=beside)(Notes).remote()
        self._started = 0
        self._slots: list[_Slot] = []
        self._last_steps: dict[int, str] = {}
        self._placed = time.monotonic()

    def turn(self) -> Iterator[Any]:
        """Hand out units, then take in whatever the actors say; yields results."""
        while len(self._slots) < self._count:
            self._started += 1
            actor = self._class.remote(self._make_work, self._count, self._started, self._notes)
            self._slots.append(_Slot(self._started, actor, actor.ready.remote()))
        for slot in self._slots:
            self._hand_out(slot)
        waiting = [
            ref
            for slot in self._slots
            for ref in (slot.readying, slot.doing, slot.reporting)
            if ref is not None
        ]
        heard, _ = self._ray.wait(waiting, num_returns=1, timeout=TICK_S)
        heard += self._ray.wait([ref for ref in waiting if ref not in heard], timeout=0)[0] if heard else []
        for slot in list(self._slots):
            try:
                yield from self._listen(slot, heard)
            except self._gone as fault:
                self._bury(slot, "was lost: " + str(fault).strip().splitlines()[0][:200])
        self._stop_the_hung()
        self._check_room()

    def _hand_out(self, slot: _Slot) -> None:
        if not slot.ready:
            return
        if slot.unit is None:
            taken = self._ledger.take()
            if taken is None:
                return
            slot.unit, unit, attempt = taken
            slot.heard = time.monotonic()
            slot.doing = slot.actor.do.remote(unit, attempt)
        if slot.reporting is None:
            slot.reporting = slot.actor.reported.remote()

    def _listen(self, slot: _Slot, heard: list[Any]) -> Iterator[Any]:
        if slot.readying is not None and slot.readying in heard:
            fault = self._ray.get(slot.readying)
            if fault is not None:
                raise fault
            slot.readying, slot.ready, self._placed = None, True, time.monotonic()
        if slot.doing is not None and slot.doing in heard:
            kind, value = self._ray.get(slot.doing)
            for said in (slot.reporting, slot.actor.reported.remote()):  # what it said last
                self._take_in(slot, self._ray.get(said) if said is not None else [])
            slot.reporting = None
            number, slot.unit, slot.doing = slot.unit, None, None
            assert number is not None
            if kind == "failed":
                raise value
            if kind == "short of memory":
                self._lost(number, self._step(slot), "killed", "ran out of memory")
            else:
                self._ledger.finished(number)
                yield value
        if slot.reporting is not None and slot.reporting in heard:
            self._take_in(slot, self._ray.get(slot.reporting))
            slot.reporting = None

    def _take_in(self, slot: _Slot, events: list[Any]) -> None:
        for event in events:
            slot.heard = time.monotonic()
            if slot.unit is not None and not isinstance(event, Step):
                self._on_event(slot.unit, event)

    def _bury(self, slot: _Slot, how: str, cause: Cause = "killed") -> None:
        self._slots.remove(slot)
        number = slot.unit
        if number is None:
            return
        step = self._step(slot)
        if cause == "killed" and step and self._last_steps.get(number) == step:
            cause = "crashed"  # Ray does not tell how a process ended; twice at one step is no chance
        self._last_steps[number] = step
        self._lost(number, step, cause, how)

    def _step(self, slot: _Slot) -> str:
        return str(self._ray.get(self._notes.get.remote(slot.name)))

    def _lost(self, number: int, step: str, cause: Cause, how: str) -> None:
        retry = self._ledger.lost(number, cause, step, how)
        if retry:
            self._on_event(number, retry)

    def _stop_the_hung(self) -> None:
        quiet = self._ledger.limits.quiet_s
        for slot in list(self._slots):
            if quiet and slot.unit is not None and time.monotonic() - slot.heard > quiet:
                self._ray.kill(slot.actor)
                self._bury(slot, f"made no progress for {quiet:g} s", "hung")

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
        """End every actor."""
        for actor in (*(slot.actor for slot in self._slots), self._notes):
            self._ray.kill(actor)
