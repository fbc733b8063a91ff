"""Real-time priority that a parent had is not kept; threads spin longer where nothing else runs."""

import os
import subprocess
import sys

import pytest

from hma_data import cpu


@pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="no schedulers to choose from")
def test_a_command_begun_under_real_time_priority_takes_the_ordinary_one() -> None:
    script = (
        "import os\n"
        "from hma_data.cpu import take_ordinary_priority\n"
        "try:\n"
        "    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))\n"
        "except PermissionError:\n"
        "    print('not allowed')\n"
        "take_ordinary_priority()\n"
        "assert os.sched_getscheduler(0) == os.SCHED_OTHER\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(("busy", "spins"), [(0.0, cpu.QUIET_SPINS), (1.0, cpu.SPINS)])
def test_threads_spin_longer_where_nothing_else_runs(
    busy: float, spins: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(cpu, "busy_cores", lambda seconds: busy)
    cpu.bound_spinning()
    assert os.environ["GOMP_SPINCOUNT"] == str(spins)


@pytest.mark.parametrize(("name", "value"), [("OMP_WAIT_POLICY", "ACTIVE"), ("GOMP_SPINCOUNT", "7")])
def test_how_threads_wait_is_left_to_the_environment(
    name: str, value: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for other in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT"):
        monkeypatch.delenv(other, raising=False)
    monkeypatch.setenv(name, value)
    before = dict(os.environ)
    cpu.bound_spinning()
    assert dict(os.environ) == before


def test_cores_that_others_keep_busy_are_seen() -> None:
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as process:
        found = cpu.busy_cores(0.3)
        process.kill()
    assert found > 0.3
