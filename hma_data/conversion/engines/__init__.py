"""Run work units: in this process, in several, or on a Ray cluster. Units and outputs are the same.

A unit is any picklable value. `make_work(workers)` is called once in each process and returns the function
that runs a unit. This function reports its steps, so that the last step of a process that dies or hangs is
known. The Ledger decides when a unit is tried again; its rules are the same for every engine.
"""

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from hma_data.errors import HMAError

Report = Callable[[Any], None]
Cause = Literal["crashed", "hung", "killed"]


@dataclass(frozen=True)
class Step:
    """A sign of life: the step that a unit is at. The work reports it, the engine keeps it."""

    name: str


@dataclass(frozen=True)
class Retry:
    """An event of the engine: a unit starts again from its beginning."""

    reason: str


@dataclass(frozen=True)
class Notice:
    """An event of the engine: a line for the user, about no unit."""

    text: str


@dataclass(frozen=True)
class Attempt:
    """The attempt at a unit: 0 is the first, later ones take one step at a time to find the failing step."""

    number: int = 0
    refused: Mapping[str, str] = field(default_factory=dict)  # step to skip -> how it ended the process


FIRST_ATTEMPT = Attempt()
Work = Callable[[Any, Report, Attempt], Any]
OnEvent = Callable[[int, Any], None]


@dataclass(frozen=True)
class Limits:
    """The limits after which an engine gives up."""

    quiet_s: float | None = 300.0  # without a sign of life a unit counts as hung; None waits forever
    kills: int = 5  # of a unit's process from outside, mostly for lack of memory


LIMITS = Limits()


# how work ended: "done" with its result, "short of memory", or "failed" with the error that ends the job
End = tuple[str, Any]


def outcome(task: Callable[..., Any], *arguments: Any) -> End:
    """Return in a worker how a task ended."""
    try:
        return "done", task(*arguments)
    except MemoryError:
        return "short of memory", None
    except HMAError as fault:
        return "failed", fault
    except Exception as fault:
        text = f"stopped with {type(fault).__name__}: {fault}"
        return "failed", HMAError("a worker", text, "report this as a bug; --debug --workers 0 shows where")


class Ledger:
    """The units that wait, run, or have failed, and the rules for trying again.

    A step that crashes its process (a fault in a decoder) or hangs is tried twice and then refused; the
    unit is done without it. A unit whose process was killed from outside is tried again, up to
    `limits.kills` kills; after the second kill it waits until no other unit is running.
    """

    def __init__(self, units: Iterable[Any], limits: Limits, on_event: OnEvent) -> None:
        self.units = list(units)
        self.limits = limits
        self._on_event = on_event
        self.running: set[int] = set()
        self.failures: list[HMAError] = []
        self._waiting = deque(range(len(self.units)))
        self._alone: deque[int] = deque()
        self._attempts = [0] * len(self.units)
        self._kills = [0] * len(self.units)
        self._refused: dict[int, dict[str, str]] = {}

    @property
    def open(self) -> bool:
        """Check whether any unit is waiting or running."""
        return bool(self._waiting or self._alone or self.running)

    def take(self) -> tuple[int, Any, Attempt] | None:
        """Return the next unit to start; None if none may start now."""
        if self._waiting:
            number = self._waiting.popleft()
        elif self._alone and not self.running:
            number = self._alone.popleft()
        else:
            return None
        self.running.add(number)
        attempt = Attempt(self._attempts[number], dict(self._refused.get(number, {})))
        return number, self.units[number], attempt

    def finished(self, number: int) -> None:
        """Record that the unit is done."""
        self.running.discard(number)

    def lost(self, number: int, cause: Cause, step: str, how: str) -> None:
        """Record that a unit lost its process; schedule it again and report a Retry, or give it up.

        Args:
            step: the last step it reported; empty if it reported none.
            how: how the process ended, in words, e.g. "ended by SIGSEGV".
        """
        self.running.discard(number)
        self._attempts[number] += 1
        if cause == "killed":
            self._kills[number] += 1
            if self._kills[number] >= self.limits.kills:
                at = f", at {step}" if step else ""
                self._give_up(number, f"its worker was lost {self._kills[number]} times, last {how}{at}")
                return
        elif self._attempts[number] > 1:
            if not step:
                self._give_up(number, f"its worker {how} before any step")
                return
            self._refused.setdefault(number, {})[step] = how
        (self._alone if self._kills[number] >= 2 else self._waiting).append(number)
        self._on_event(number, Retry(f"{how} at {step}" if step else how))

    def _give_up(self, number: int, what: str) -> None:
        where = getattr(self.units[number], "name", f"unit {number}")
        remedy = "everything finished is kept: run the same command again, with fewer --workers"
        self.failures.append(HMAError(where, f"{what}; the machine may be short of memory", remedy))
