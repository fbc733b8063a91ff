"""Real-time priority of a parent is not kept, freed memory is; the environment may decide otherwise."""

import os
import platform
import resource
import subprocess
import sys

import pytest

from hma_data.cpu import bound_spinning
from tests.data.fresh import run_fresh


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
    run_fresh(script)


@pytest.mark.parametrize(("name", "value"), [("OMP_WAIT_POLICY", "ACTIVE"), ("GOMP_SPINCOUNT", "7")])
def test_how_threads_wait_is_left_to_the_environment(name, value, monkeypatch) -> None:
    for other in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT"):
        monkeypatch.delenv(other, raising=False)
    monkeypatch.setenv(name, value)
    before = dict(os.environ)
    bound_spinning()
    assert dict(os.environ) == before


TUNED = {"GLIBC_TUNABLES": "glibc.malloc.trim_threshold=1:glibc.malloc.mmap_threshold=65536"}


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
@pytest.mark.parametrize("environment", [{}, {"MALLOC_ARENA_MAX": "4"}, TUNED])
def test_freed_memory_is_kept_unless_the_environment_says_how_it_is_allocated(environment) -> None:
    script = (
        "import resource\n"
        "from hma_data.cpu import keep_freed_memory\n"
        "keep_freed_memory()\n"
        "for turn in range(4):\n"
        "    b'x' * 2**26\n"
        "    if turn == 0:\n"
        "        first = resource.getrusage(resource.RUSAGE_SELF).ru_minflt\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - first)\n"
    )
    own = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=60, env=own | environment
    )
    assert done.returncode == 0, done.stderr
    pages = 3 * 2**26 // resource.getpagesize()
    assert (int(done.stdout) < pages // 100) == (not environment)
