"""Real-time priority that a parent had is not kept; how threads wait is left to the environment."""

import os
import subprocess
import sys

import pytest

from hma_data.cpu import bound_spinning


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


@pytest.mark.parametrize(("name", "value"), [("OMP_WAIT_POLICY", "ACTIVE"), ("GOMP_SPINCOUNT", "7")])
def test_how_threads_wait_is_left_to_the_environment(name, value, monkeypatch) -> None:
    for other in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT"):
        monkeypatch.delenv(other, raising=False)
    monkeypatch.setenv(name, value)
    before = dict(os.environ)
    bound_spinning()
    assert dict(os.environ) == before
