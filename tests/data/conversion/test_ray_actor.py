"""What an actor of the Ray engine does, without Ray: how its process ends is told, events come gathered."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from hma_data.conversion.engines import FIRST, Attempt, Report, Step, Work
from hma_data.conversion.engines.ray import Answer, End, Worker
from hma_data.errors import TokenizerError
from tests.data.conversion.test_engines import PLAIN, MakeWork, Unit

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[3]


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
class BadStart:
    """Ends the process by a signal, the first `times` times that it is started; or raises an error."""

    notes: Path
    kind: str
    times: int = 10**6

    def __call__(self, workers: int) -> Work:
        before = len(list(self.notes.iterdir()))
        (self.notes / str(before)).touch()
        if before < self.times:
            if self.kind == "error":
                raise TokenizerError("weights", "are wrong")
            os.kill(os.getpid(), getattr(signal, self.kind))
        return Chatty()(workers)


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


@pytest.fixture
def opened(tmp_path: Path, request: pytest.FixtureRequest) -> Worker:
    worker = made(request, MakeWork(tmp_path))
    assert heard(worker, worker.open())[1] == ("ready", None)
    return worker


def made(request: pytest.FixtureRequest, make_work: Callable[[int], Work], answer_s: float = 0.2) -> Worker:
    worker = Worker(make_work, 1, 6, answer_s)
    request.addfinalizer(worker.pool.close)
    return worker


def heard(worker: Worker, answer: Answer) -> tuple[list[Any], End, int]:
    """All events until the end, the end, and how many answers that took."""
    (events, end), answers = answer, 1
    until = time.monotonic() + 60
    while end is None:
        assert time.monotonic() < until
        (more, end), answers = worker.go_on(), answers + 1
        events = events + more
    return events, end, answers


def do(worker: Worker, unit: Any) -> tuple[list[Any], End, int]:
    return heard(worker, worker.do(unit, FIRST))


def test_a_units_events_and_result_are_told_in_order(opened: Worker) -> None:
    assert do(opened, PLAIN[0])[:2] == (["u0 a", "u0 b"], ("done", ("u0", ["a", "b"])))
    assert do(opened, PLAIN[1])[:2] == (["u1 a", "u1 b"], ("done", ("u1", ["a", "b"])))


@pytest.mark.parametrize(
    ("kind", "cause", "how"),
    [
        ("SIGSEGV", "crashed", "ended the process by SIGSEGV"),
        ("SIGKILL", "killed", "ended by SIGKILL"),
        ("memory", "killed", "ran out of memory"),
        pytest.param("hang", "hung", "made no progress for 6 s", marks=pytest.mark.slow),
    ],
)
def test_how_a_process_was_lost_is_told_with_its_step_and_the_next_unit_is_done(
    kind: str, cause: str, how: str, opened: Worker
) -> None:
    events, end, _ = do(opened, Unit("bad", ("a", "b", "c"), "b", kind))
    assert (events, end) == (["bad a"], ("lost", (cause, "b", how)))
    assert do(opened, PLAIN[0])[1] == ("done", ("u0", ["a", "b"]))


def test_a_process_that_is_killed_between_units_costs_nothing(opened: Worker) -> None:
    do(opened, PLAIN[0])
    (process,) = opened.pool.processes
    os.kill(process.process.pid or 0, signal.SIGKILL)
    process.process.join()
    assert do(opened, PLAIN[1])[1] == ("done", ("u1", ["a", "b"]))


def test_a_process_whose_end_the_cluster_keeps_to_itself_counts_as_killed(opened: Worker) -> None:
    before = signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # as Ray does where it reaps every process
    try:
        end = do(opened, Unit("bad", ("a", "b"), "b", "SIGKILL"))[1]
        assert end == ("lost", ("killed", "b", "ended by an unknown cause"))
        assert do(opened, PLAIN[0])[1] == ("done", ("u0", ["a", "b"]))
    finally:
        signal.signal(signal.SIGCHLD, before)


def test_an_error_that_is_not_the_datas_is_handed_over_as_it_is(opened: Worker) -> None:
    end = do(opened, Unit("bad", ("a",), "a", "error"))[1]
    assert end[0] == "failed" and str(end[1]) == str(TokenizerError("weights", "are wrong"))


def test_events_are_gathered_however_many_there_are(request: pytest.FixtureRequest) -> None:
    worker = made(request, Chatty(), answer_s=0.2)
    heard(worker, worker.open())
    began = time.monotonic()
    events, end, answers = do(worker, 1_000)
    assert (events, end) == (list(range(1_000)), ("done", 1_000))
    assert answers <= (time.monotonic() - began) / 0.2 + 1


def test_a_process_that_is_killed_at_its_start_is_started_again(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    worker = made(request, BadStart(tmp_path, "SIGKILL", times=2))
    assert heard(worker, worker.open())[1] == ("ready", None)
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.parametrize(
    ("kind", "said"),
    [("SIGSEGV", "cannot start; the last one ended the process by SIGSEGV"), ("error", "weights: are wrong")],
)
def test_work_that_cannot_start_is_one_error(
    kind: str, said: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    worker = made(request, BadStart(tmp_path, kind))
    end = heard(worker, worker.open())[1]
    assert end[0] == "failed" and said in str(end[1])


PARENT = """
from pathlib import Path
Path({started!r}).open("a").write("started\\n")
from hma_data.conversion.engines import FIRST
from hma_data.conversion.engines.ray import Worker
from tests.data.conversion.test_engines import MakeWork, Unit
worker = Worker(MakeWork(Path({notes!r})), 1, None, 0.2)
worker.open()
worker.do(Unit("bad", ("a",), "a", "hang"), FIRST)
while True:
    worker.go_on()
"""


def test_the_process_ends_with_its_actor_whose_script_it_does_not_run(tmp_path: Path) -> None:
    notes, started, script = tmp_path / "notes", tmp_path / "started", tmp_path / "actor.py"
    notes.mkdir()
    script.write_text(PARENT.format(notes=str(notes), started=str(started)))
    actor = subprocess.Popen(
        [sys.executable, str(script)], env={**os.environ, "PYTHONPATH": str(ROOT)}, cwd=ROOT
    )
    until = time.monotonic() + 60
    while not (notes / "bad-0").exists():
        assert actor.poll() is None and time.monotonic() < until
        time.sleep(0.05)
    children = Path(f"/proc/{actor.pid}/task/{actor.pid}/children").read_text().split()
    actor.kill()
    actor.wait()
    while any(_runs(int(child)) for child in children):
        assert time.monotonic() < until
        time.sleep(0.05)
    assert started.read_text() == "started\n"


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
