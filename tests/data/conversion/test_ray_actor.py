"""What an actor of the Ray engine does, without Ray."""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from hma_data.conversion.engines import FIRST_ATTEMPT, Attempt, Report, Step, Work
from hma_data.conversion.engines.ray import Worker
from hma_data.errors import TokenizerError
from tests.data.conversion.test_engines import PLAIN, MakeWork, Unit


@dataclass(frozen=True)
class Chatty:
    """A unit is a number of events, a millisecond apart."""

    def __call__(self, workers: int) -> Work:
        def work(unit: int, report: Report, attempt: Attempt) -> int:
            for number in range(unit):
                report(number)
                time.sleep(0.001)
            return unit

        return work


@dataclass(frozen=True)
class Slow:
    """The same work, with a pause at every step; for whoever wants to kill it on the way."""

    make_work: Callable[[int], Work]

    def __call__(self, workers: int) -> Work:
        work = self.make_work(workers)

        def slow(unit: Any, report: Report, attempt: Attempt) -> Any:
            def pause(event: Any) -> None:
                report(event)
                if isinstance(event, Step):
                    time.sleep(0.2)

            return work(unit, pause, attempt)

        return slow


def opened(make_work: Callable[[int], Work]) -> Worker:
    worker = Worker()
    assert worker.open(make_work, 1) == ("done", None)
    return worker


def test_a_units_events_and_result_are_told_in_order(tmp_path: Path) -> None:
    worker = opened(MakeWork(tmp_path))
    for number, unit in enumerate(PLAIN[:2]):
        end, events = worker.do(number, unit, FIRST_ATTEMPT)
        assert end == ("done", (unit.name, ["a", "b"]))
        said = [event for _, event in events if not isinstance(event, Step)]
        assert said == [f"{unit.name} a", f"{unit.name} b"] and {n for n, _ in events} == {number}


def test_an_actor_that_was_never_opened_says_so() -> None:
    assert Worker().do(0, PLAIN[0], FIRST_ATTEMPT) == (("closed", None), [])


def test_looks_and_the_end_give_every_event_once() -> None:
    worker, heard = opened(Chatty()), []
    with ThreadPoolExecutor(1) as other:
        task = other.submit(worker.do, 3, 300, FIRST_ATTEMPT)
        while not task.done():
            heard += worker.look(0.05)
    assert heard + task.result()[1] == [(3, number) for number in range(300)]


def test_in_a_later_attempt_a_step_begins_only_when_the_driver_has_heard_of_it(tmp_path: Path) -> None:
    """The unit would kill this process at b; it is stopped before, because the look that told is the last."""
    worker = opened(MakeWork(tmp_path))
    reached: list[str] = []
    with ThreadPoolExecutor(1) as other:
        task = other.submit(worker.do, 0, Unit("u", ("a", "b", "c")), Attempt(1))
        for step in "abc":
            told = [event for _, event in worker.look(60)]
            reached += [event.name for event in told if isinstance(event, Step)]
            assert reached[-1] == step and f"u {step}" not in told and not task.done()
        worker.look(0)
        assert task.result(60)[0] == ("done", ("u", ["a", "b", "c"]))


@pytest.mark.parametrize(("trouble", "kind"), [("memory", "short of memory"), ("error", "failed")])
def test_how_a_unit_ends_is_told_and_the_next_is_done(trouble: str, kind: str, tmp_path: Path) -> None:
    worker = opened(MakeWork(tmp_path))
    (end, value), _ = worker.do(0, Unit("bad", ("a", "b"), "b", trouble), FIRST_ATTEMPT)
    assert end == kind and (value is None or str(value) == str(TokenizerError("weights", "are wrong")))
    assert worker.do(1, PLAIN[0], FIRST_ATTEMPT)[0] == ("done", ("u0", ["a", "b"]))
