"""The Ray engine on a cluster of two nodes, and its actors without Ray: the same bytes."""

import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from hma_data.conversion.engines import FIRST_ATTEMPT, Attempt, Limits, Report, Retry, Step, Work
from hma_data.conversion.engines.ray import UV_ENVIRONMENT, Worker, import_ray
from hma_data.conversion.job import convert
from hma_data.errors import HMAError, MissingDependencyError, TokenizerError
from tests.conftest import SMALL as SETTINGS
from tests.conftest import contents
from tests.data.conversion.test_engines import PLAIN, MakeWork, Unit
from tests.data.fresh import ROOT

on_a_cluster = pytest.mark.slow
LIMITS = Limits(quiet_s=5, kills=4)


@pytest.fixture(scope="module")
def cluster():
    """Two nodes; the second may be killed, and comes back."""
    ray = import_ray()
    from ray.cluster_utils import Cluster

    os.environ["PYTHONPATH"] = f"{ROOT}:{os.environ.get('PYTHONPATH', '')}"
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    made.add_node(num_cpus=2)
    ray.init(address=made.address, log_to_driver=False, logging_level="error")
    yield made
    ray.shutdown()
    made.shutdown()


def do(units: list[Unit], notes: Path, workers: int = 2, limits: Limits = LIMITS):
    from hma_data.conversion.engines.ray import run

    events: list = []
    results = dict(run(units, MakeWork(notes), workers, lambda n, event: events.append((n, event)), limits))
    return results, events


@on_a_cluster
def test_every_unit_is_done_once_and_its_events_arrive(cluster, tmp_path: Path) -> None:
    results, events = do(PLAIN, tmp_path)
    assert results == {unit.name: ["a", "b"] for unit in PLAIN}
    assert sorted(events) == sorted((i, f"u{i} {step}") for i in range(5) for step in "ab")


@on_a_cluster
def test_a_process_that_is_killed_costs_nothing(cluster, tmp_path: Path) -> None:
    results, events = do([Unit("bad", ("a", "b", "c"), "b", "SIGKILL", times=1), *PLAIN], tmp_path)
    assert results["bad"] == ["a", "b", "c"]
    (retry,) = [event for _, event in events if isinstance(event, Retry)]
    assert retry.reason.startswith("was lost: ")
    assert "rpc" not in retry.reason.lower()  # what Ray says of its connections


@on_a_cluster
def test_an_actor_that_is_killed_between_two_units_costs_nothing(cluster, tmp_path: Path) -> None:
    from hma_data.conversion.engines.ray import run

    units = [Unit(f"u{i}", ("a",), "a", times=0) for i in range(3)]  # each notes its process
    results = run(units, MakeWork(tmp_path), 1, lambda number, event: None, LIMITS)
    first = next(results)
    lost = int((tmp_path / "u0-0").read_text())
    os.kill(lost, signal.SIGKILL)
    while not {pid for pid in actors_of(os.getpid()) if pid != lost}:  # until Ray has started it again
        time.sleep(0.1)
    time.sleep(1)
    assert dict([first, *results]) == {unit.name: ["a"] for unit in units}


@on_a_cluster
def test_a_worker_that_no_node_of_this_machine_can_hold_is_one_error(cluster, monkeypatch) -> None:
    from hma_data.conversion.engines import ray as engine

    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    with pytest.raises(HMAError, match=r"has no room for a worker.*500 CPU \(of 2\) and 1 GPU \(of 0\)"):
        list(engine.run(PLAIN, Unreadable(), 1, lambda number, event: None, LIMITS, cpus=500, gpus=1))


@on_a_cluster
def test_a_cluster_that_was_named_is_waited_for_and_the_user_hears_of_it(cluster, monkeypatch) -> None:
    from hma_data.conversion.engines import ray as engine

    said: list[str] = []
    monkeypatch.setenv("RAY_ADDRESS", cluster.address)
    monkeypatch.setattr(engine, "SLOW_START_S", 0.5)
    monkeypatch.setattr(engine, "NO_ROOM_S", 3)
    with pytest.raises(HMAError, match="has had no room for a worker for 3 s"):
        heard = lambda number, event: said.append(event.text)  # noqa: E731
        list(engine.run(PLAIN, Unreadable(), 1, heard, LIMITS, gpus=1))
    assert len(said) == 2
    assert "1 GPU (of 0); waiting for a node" in said[0]
    assert "no worker is ready" in said[1]


@on_a_cluster
def test_workers_that_cannot_be_made_are_one_error(cluster, tmp_path, monkeypatch) -> None:
    from hma_data.conversion.engines import ray as engine

    monkeypatch.setattr(engine, "LOST_STARTS", 1)
    with pytest.raises(HMAError, match=r"the Ray cluster: .*on every node"):
        list(engine.run(PLAIN, Unreadable(), 1, lambda number, event: None, LIMITS))


class Unreadable:
    def __reduce__(self):
        return _not_there, ()


def _not_there() -> None:
    raise ModuleNotFoundError("No module named 'hma_data'")


@on_a_cluster
@pytest.mark.parametrize("kind", ["SIGSEGV", "hang"])
def test_a_step_that_ends_or_stops_its_actor_is_refused(kind: str, cluster, tmp_path: Path) -> None:
    results, _ = do([Unit("bad", ("a", "b", "c"), "b", kind), PLAIN[0]], tmp_path)
    assert results == {"bad": ["a", "c"], "u0": ["a", "b"]}


@on_a_cluster
def test_a_node_that_is_lost_takes_no_unit_along(cluster, tmp_path: Path) -> None:
    extra = cluster.add_node(num_cpus=2)
    units = [Unit(f"long{i}", ("a",), "a", "nap", times=1) for i in range(6)]

    def lose() -> None:
        while len(list(tmp_path.glob("long*"))) < 3:
            time.sleep(0.1)
        cluster.remove_node(extra, allow_graceful=False)

    thread = threading.Thread(target=lose)
    thread.start()
    results, _ = do(units, tmp_path, workers=4)
    thread.join()
    assert results == {unit.name: ["a"] for unit in units}


@pytest.fixture
def whole(toy_arm, toy_recording, tmp_path: Path) -> dict[str, bytes]:
    convert(toy_arm, str(toy_recording), "raw", tmp_path / "whole", settings=SETTINGS)
    return contents(tmp_path / "whole")


DRIVER = """
import sys
from pathlib import Path
import ray
import hma_data.conversion.job as conversion
from hma_data.registry.embodiment import Embodiment
from hma_data.conversion.engines import Limits
from tests.conftest import ARM_YAML, SMALL as SETTINGS
from tests.data.conversion.test_engine_ray import Slow

make_work = conversion.MakeWork
conversion.MakeWork = lambda *args: Slow(make_work(*args))
ray.init(address=sys.argv[1], log_to_driver=False, logging_level="error")
conversion.convert(
    Embodiment.from_yaml(ARM_YAML), sys.argv[2], "raw", Path(sys.argv[3]), settings=SETTINGS, workers=3,
    engine="ray", limits=Limits(quiet_s=60, kills=50),
)
"""


@on_a_cluster
def test_a_storm_of_kills_ends_with_the_same_bytes(cluster, toy_recording, tmp_path, whole, request) -> None:
    """Of actors, of the processes that work for them, and twice of the driver, which is run again."""
    draws = random.Random(0)
    script, out, killed = tmp_path / "driver.py", tmp_path / "out", 0
    script.write_text(DRIVER)
    for kills, shards in ((2, 1), (2, 3), (2, 1_000)):  # the driver is killed once there are so many shards
        driver = subprocess.Popen(
            [sys.executable, str(script), cluster.address, str(toy_recording), str(out)],
            cwd=ROOT,
            stderr=subprocess.PIPE,
            text=True,
        )
        request.addfinalizer(driver.kill)
        until = time.monotonic() + 200
        while driver.poll() is None and len(list(out.rglob("*.parquet"))) < shards:
            assert time.monotonic() < until
            time.sleep(draws.uniform(0.1, 0.6))
            victims = actors_of(os.getpid())
            if kills and victims and draws.random() < 0.5:
                with suppress(ProcessLookupError):
                    os.kill(draws.choice(victims), signal.SIGKILL)
                    kills, killed = kills - 1, killed + 1
        if shards < 1_000:
            driver.kill()
        _, errors = driver.communicate(timeout=100)
    assert driver.returncode == 0, errors
    assert killed
    assert contents(out) == whole


def actors_of(pid: int) -> list[int]:
    parents, names = {}, {}
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            names[int(entry.name)] = (entry / "cmdline").read_bytes()
    ours, found = {pid}, []
    for _ in range(6):  # generations
        ours |= {child for child, parent in parents.items() if parent in ours}
    for child in ours & names.keys():
        name = names[child]
        if name.startswith(b"ray::Worker") or names.get(parents[child], b"").startswith(b"ray::Worker"):
            found.append(child)
    return sorted(found)


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("", "Ray on this machine: cannot be started: timed out"),
        ("auto", "the Ray cluster at auto: cannot be joined: timed out"),
        ("127.0.0.1:1", "the Ray cluster at 127.0.0.1:1: cannot be joined: [Errno 111] Connection refused"),
    ],
)
def test_a_cluster_that_does_not_answer_is_one_error(address, said, monkeypatch, tmp_path) -> None:
    from hma_data.conversion.engines import ray as engine

    class NoRay:
        is_initialized = staticmethod(lambda: False)
        shutdown = staticmethod(lambda: None)

        @staticmethod
        def init(**settings: object) -> None:
            raise Exception("timed out\nof many lines")

    monkeypatch.setattr(engine, "import_ray", NoRay)
    monkeypatch.setenv("RAY_ADDRESS", address)
    with pytest.raises(HMAError) as caught:
        do(PLAIN, tmp_path)
    assert str(caught.value).startswith(said)


@pytest.mark.slow
def test_actors_take_the_environment_of_their_node(monkeypatch) -> None:
    monkeypatch.delenv(UV_ENVIRONMENT, raising=False)
    program = "from hma_data.conversion.engines.ray import *; ray = import_ray()\n"
    program += f"print(ray._private.ray_constants.{UV_ENVIRONMENT})"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.strip() == "False", done.stderr


def test_without_ray_the_error_says_how_to_install_it(tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingDependencyError, match="uv sync --inexact --extra ray"):
        do(PLAIN, tmp_path)


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
