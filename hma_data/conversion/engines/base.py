"""What an engine is: it does units of work in processes that may die, and says what became of each.

A unit is any picklable value. `make_work(workers)` is called once in each process and returns the
function that does a unit; the function reports its steps, so that a process that dies or hangs tells
which step it was at. The rules for trying again are the Ledger's, the same for every engine.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from hma_data.errors import HMAError

Report = Callable[[Any], None]
Cause = Literal["crashed", "hung", "killed"]


@dataclass(frozen=True)
class Step:
    """A sign of life: what a unit is at. Reported by the work, kept by the engine."""

    name: str


@dataclass(frozen=True)
class Retry:
    """An event of the engine: a unit is done again from its beginning."""

    reason: str


@dataclass(frozen=True)
class Attempt:
    """Which try of a unit this is.

    Attributes:
        number: 0 for the first. Later ones should do one step at a time, so that the blame is exact.
        refused: step -> reason, for steps that ended or stopped the process before: not to be tried again.
    """

    number: int = 0
    refused: Mapping[str, str] = field(default_factory=dict)


FIRST = Attempt()
Work = Callable[[Any, Report, Attempt], Any]
OnEvent = Callable[[int, Any], None]


@dataclass(frozen=True)
class Limits:
    """When an engine gives up.

    Attributes:
        quiet_s: seconds without a sign of life after which a unit hangs; None waits forever.
        kills: how often a unit may lose its process to a kill from outside (a lack of memory, mostly).
    """

    quiet_s: float | None = 300.0
    kills: int = 5


LIMITS = Limits()


class Engine(Protocol):
    """Runs units somewhere."""

    def __call__(
        self,
        units: Sequence[Any],
        make_work: Callable[[int], Work],
        workers: int,
        on_event: OnEvent,
        limits: Limits,
    ) -> Iterator[Any]:
        """Yield each unit's result as it is ready; on_event(index of the unit, what it reported)."""
        ...


class Ledger:
    """What is waiting, what was tried, what is given up.

    A step that crashes its process (a fault in a decoder) or hangs is tried twice and then refused; the
    unit is done without it. A process killed from outside costs nothing but time, up to `limits.kills`;
    after the second kill the unit waits until it has the machine to itself.
    """

    def __init__(self, units: Iterable[Any], limits: Limits) -> None:
        self.units = list(units)
        self.limits = limits
        self.running: set[int] = set()
        self.failures: list[HMAError] = []
        self._waiting = deque(range(len(self.units)))
        self._alone: deque[int] = deque()
        self._attempts = [0] * len(self.units)
        self._kills = [0] * len(self.units)
        self._refused: dict[int, dict[str, str]] = {}

    @property
    def open(self) -> bool:
        """Whether anything is left to do or being done."""
        return bool(self._waiting or self._alone or self.running)

    def take(self) -> tuple[int, Any, Attempt] | None:
        """The next unit to start; None when nothing may start now."""
        if self._waiting:
            number = self._waiting.popleft()
        elif self._alone and not self.running:
            number = self._alone.popleft()
        else:
            return None
        self.running.add(number)
        return (
            number,
            self.units[number],
            Attempt(self._attempts[number], dict(self._refused.get(number, {}))),
        )

    def finished(self, number: int) -> None:
        """The unit is done."""
        self.running.discard(number)

    def lost(self, number: int, cause: Cause, step: str, how: str) -> Retry | None:
        """A unit's process is gone: what follows; None when the unit is given up.

        Args:
            step: the last it reported; empty when none.
            how: in words, e.g. "ended by SIGSEGV".
        """
        self.running.discard(number)
        self._attempts[number] += 1
        if cause == "killed":
            self._kills[number] += 1
            if self._kills[number] >= self.limits.kills:
                self._give_up(number, f"its worker was lost {self._kills[number]} times, last {how}", step)
                return None
        elif self._attempts[number] > 1:
            if not step:
                self._give_up(number, f"its worker {how} before any step", step)
                return None
            self._refused.setdefault(number, {})[step] = how
        (self._alone if self._kills[number] >= 2 else self._waiting).append(number)
        return Retry(f"{how} at {step}" if step else how)

    def _give_up(self, number: int, what: str, step: str) -> None:
        at = f", at {step}" if step else ""
        self.failures.append(
            HMAError(
                getattr(self.units[number], "name", f"unit {number}"),
                f"{what}{at}; perhaps the machine is short of memory",
                "everything finished is kept: run the same command again, with fewer --workers",
            )
        )

    def raise_failures(self) -> None:
        """The first unit that was given up, as an error; the rest is done by now."""
        if self.failures:
            raise self.failures[0]
