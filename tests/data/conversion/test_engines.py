"""Engines: every unit is done once, whatever happens to the processes that do them."""

import ctypes
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import Pipe, get_context
from pathlib import Path
from typing import Any

import pytest

from hma_data.conversion.engines import Attempt, Limits, Report, Retry, Step
from hma_data.conversion.engines.local import run, serve
from hma_data.errors import HMAError, TokenizerError

FAST = Limits(quiet_s=6, kills=3)  # no innocent step takes that long, however busy the machine


@dataclass(frozen=True)
class Unit:
    """Steps to do; `trouble` happens at one of them, the first `times` times it is reached."""

    name: str
    steps: tuple[str, ...]
    at: str = ""
    trouble: str = ""
    times: int = 10**6


class Telling:
    """Makes work that tells of itself until nobody listens, and takes a fault of the pipe for a file's."""

    def __call__(self, workers: int) -> Callable[[Any, Report, Attempt], None]:
        def work(unit: Any, report: Report, attempt: Attempt) -> None:
            try:
                while True:
                    report("here")
                    time.sleep(0.01)
            except OSError as fault:
                raise HMAError("a shard", f"cannot be written: {fault}") from fault

        return work


@contextmanager
def quiet() -> Iterator[list[str]]:
    """Return what processes started within write to stderr, at the end."""
    said: list[str] = []
    kept = os.dup(2)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield said
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        file.seek(0)
        said.append(file.read().decode())


@dataclass(frozen=True)
class MakeWork:
    """Each time a step is reached a file with the process's number is made, so that other processes know."""

    notes: Path

    def __call__(self, workers: int) -> Callable[[Unit, Report, Attempt], tuple[str, list[str]]]:
        def work(unit: Unit, report: Report, attempt: Attempt) -> tuple[str, list[str]]:
            done = []
            for step in unit.steps:
                if step in attempt.refused:
                    continue
                report(Step(step))
                if step == unit.at and self._reached(unit) < unit.times:
                    trouble(unit.trouble)
                report(f"{unit.name} {step}")
                done.append(step)
            return unit.name, done

        return work

    def _reached(self, unit: Unit) -> int:
        before = len(list(self.notes.glob(f"{unit.name}-*")))
        (self.notes / f"{unit.name}-{before}").write_text(str(os.getpid()))
        return before


def trouble(kind: str) -> None:
    if kind == "hang":
        time.sleep(600)
    elif kind == "nap":
        time.sleep(3)
    elif kind == "memory":
        raise MemoryError
    elif kind == "error":
        raise TokenizerError("weights", "are wrong")
    elif kind == "SIGSEGV":
        ctypes.string_at(0)  # here and now, in this thread
    else:
        os.kill(os.getpid(), getattr(signal, kind))


def do(units: list[Unit], notes: Path, workers: int = 2) -> tuple[dict[str, list[str]], list[Any]]:
    events: list[Any] = []
    results = dict(run(units, MakeWork(notes), workers, lambda n, event: events.append((n, event)), FAST))
    return results, events


PLAIN = [Unit(f"u{i}", ("a", "b")) for i in range(5)]


@pytest.mark.parametrize("workers", [0, 2])
def test_every_unit_is_done_once_and_its_events_arrive(workers: int, tmp_path: Path) -> None:
    results, events = do(PLAIN, tmp_path, workers)
    assert results == {unit.name: ["a", "b"] for unit in PLAIN}
    assert sorted(events) == sorted((i, f"u{i} {step}") for i in range(5) for step in "ab")


@pytest.mark.parametrize("kind", ["SIGKILL", "memory"])
def test_a_worker_lost_twice_costs_nothing(kind: str, tmp_path: Path) -> None:
    units = [Unit("bad", ("a", "b", "c"), "b", kind, times=2), *PLAIN]
    results, events = do(units, tmp_path)
    assert results == {"bad": ["a", "b", "c"], **{unit.name: ["a", "b"] for unit in PLAIN}}
    assert sum(isinstance(event, Retry) for _, event in events) == 2


def test_a_unit_that_always_loses_its_worker_is_one_clear_error_after_the_rest(tmp_path: Path) -> None:
    results = []
    with pytest.raises(HMAError, match=r"bad: its worker was lost 3 times, last ended by SIGKILL, at b"):
        for result in run(
            [Unit("bad", ("a", "b"), "b", "SIGKILL"), *PLAIN], MakeWork(tmp_path), 2, print_nothing, FAST
        ):
            results.append(result)
    assert len(results) == len(PLAIN)


def print_nothing(number: int, event: Any) -> None:
    pass


@pytest.mark.parametrize("kind", ["SIGSEGV", pytest.param("hang", marks=pytest.mark.slow)])
def test_a_step_that_crashes_or_hangs_is_refused_and_the_others_kept(kind: str, tmp_path: Path) -> None:
    results, events = do([Unit("bad", ("a", "b", "c"), "b", kind), PLAIN[0]], tmp_path)
    assert results == {"bad": ["a", "c"], "u0": ["a", "b"]}
    reasons = [event.reason for _, event in events if isinstance(event, Retry)]
    assert len(reasons) == 2
    assert all(("no progress for 6 s" if kind == "hang" else kind) in reason for reason in reasons)


def test_an_error_that_is_not_the_datas_ends_the_run_as_it_is(tmp_path: Path) -> None:
    with pytest.raises(TokenizerError, match="weights: are wrong"):
        do([Unit("bad", ("a",), "a", "error"), *PLAIN], tmp_path)


def test_a_worker_ends_when_its_parent_is_killed(tmp_path: Path) -> None:
    program = (
        "import sys; from pathlib import Path\n"
        "from tests.data.conversion.test_engines import *\n"
        "if __name__ == '__main__':\n"
        "    bad = Unit('bad', ('a',), 'a', 'hang')\n"
        f"    list(run([bad], MakeWork(Path({str(tmp_path)!r})), 1, print_nothing))\n"
    )
    script = tmp_path / "parent.py"
    script.write_text(program)
    root = Path(__file__).parents[3]
    parent = subprocess.Popen([sys.executable, script], env={**os.environ, "PYTHONPATH": str(root)}, cwd=root)
    while not (tmp_path / "bad-0").exists():
        assert parent.poll() is None
        time.sleep(0.05)
    children = Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().split()
    parent.kill()
    parent.wait()
    for _ in range(600):
        alive = [child for child in children if _runs(int(child))]
        if not alive:
            break
        time.sleep(0.1)
    assert alive == []


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_a_worker_that_nobody_hears_any_more_ends_without_a_word() -> None:
    here, there = Pipe()
    process = get_context("spawn").Process(target=serve, args=(there, Telling(), 1))
    with quiet() as said:
        process.start()
        there.close()
        assert here.poll(60) and here.recv() == ("ready", None)
        here.send(("unit", Attempt()))
        assert here.poll(60) and here.recv()[0] == "event"
        here.close()
        process.join(60)
        process.kill()  # where it did not end
    assert process.exitcode == 1 and said == [""]
