"""The Ray engine on a cluster of two nodes: the same bytes, whether nodes and actors are lost or not."""

import os
import threading
import time
from pathlib import Path

import pytest

from hma_data.engines.base import Limits, Retry
from hma_data.errors import MissingDependencyError, TokenizerError
from tests.data.test_engines import PLAIN, MakeWork, Unit

try:
    import ray
    from ray.cluster_utils import Cluster
except ImportError:
    ray = None

needs_ray = pytest.mark.skipif(ray is None, reason="Ray is not installed: pip install 'hma-toolkit[ray]'")
LIMITS = Limits(quiet_s=5, kills=4)


@pytest.fixture(scope="module")
def cluster():
    """Two nodes; the second may be killed, and comes back."""
    root = str(Path(__file__).parents[2])
    os.environ["PYTHONPATH"] = f"{root}:{os.environ.get('PYTHONPATH', '')}"
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    made.add_node(num_cpus=2)
    ray.init(address=made.address, log_to_driver=False, logging_level="error")
    yield made
    ray.shutdown()
    made.shutdown()


def do(units: list[Unit], notes: Path, workers: int = 2):
    from hma_data.engines.ray import run

    events: list = []
    results = dict(run(units, MakeWork(notes), workers, lambda n, event: events.append((n, event)), LIMITS))
    return results, events


@needs_ray
def test_every_unit_is_done_once_and_its_events_arrive(cluster, tmp_path: Path) -> None:
    results, events = do(PLAIN, tmp_path)
    assert results == {unit.name: ["a", "b"] for unit in PLAIN}
    assert sorted(events) == sorted((i, f"u{i} {step}") for i in range(5) for step in "ab")


@needs_ray
def test_an_actor_that_is_killed_costs_nothing(cluster, tmp_path: Path) -> None:
    results, events = do([Unit("bad", ("a", "b", "c"), "b", "SIGKILL", times=1), *PLAIN], tmp_path)
    assert results["bad"] == ["a", "b", "c"]
    assert sum(isinstance(event, Retry) for _, event in events) == 1


@needs_ray
@pytest.mark.parametrize("kind", ["SIGSEGV", "hang"])
def test_a_step_that_ends_or_stops_its_actor_is_refused(kind: str, cluster, tmp_path: Path) -> None:
    results, _ = do([Unit("bad", ("a", "b", "c"), "b", kind), PLAIN[0]], tmp_path)
    assert results == {"bad": ["a", "c"], "u0": ["a", "b"]}


@needs_ray
def test_an_error_that_is_not_the_datas_ends_the_run_as_it_is(cluster, tmp_path: Path) -> None:
    with pytest.raises(TokenizerError, match="weights: are wrong"):
        do([Unit("bad", ("a",), "a", "error"), *PLAIN], tmp_path)


@needs_ray
def test_a_node_that_is_lost_takes_no_unit_along(cluster, tmp_path: Path) -> None:
    extra = cluster.add_node(num_cpus=2)
    units = [Unit(f"long{i}", ("a",), "a", "nap", times=1) for i in range(8)]

    def lose() -> None:
        while len(list(tmp_path.glob("long*"))) < 3:
            time.sleep(0.1)
        cluster.remove_node(extra, allow_graceful=False)

    thread = threading.Thread(target=lose)
    thread.start()
    results, _ = do(units, tmp_path, workers=4)
    thread.join()
    assert results == {unit.name: ["a"] for unit in units}


@needs_ray
def test_the_bytes_are_those_of_the_local_engine(cluster, toy_arm, toy_recording, tmp_path: Path) -> None:
    from hma_data.convert import convert
    from hma_data.plan import Settings

    settings = Settings(val_fraction=0.2, shard_frames=60)
    for name, engine in (("a", "local"), ("b", "ray")):
        convert(
            toy_arm, str(toy_recording), "raw", tmp_path / name, settings=settings, workers=2, engine=engine
        )
    one, other = (
        {p.relative_to(tmp_path / n): p.read_bytes() for p in (tmp_path / n).rglob("*") if p.is_file()}
        for n in "ab"
    )
    assert one == other


@pytest.mark.skipif(ray is not None, reason="Ray is installed")
def test_without_ray_the_error_says_how_to_install_it(tmp_path: Path) -> None:
    with pytest.raises(MissingDependencyError, match=r"pip install 'hma-toolkit\[ray\]'"):
        do(PLAIN, tmp_path)
