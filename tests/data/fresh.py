"""Run a program in a process of its own, which has no threads yet: for tests that fork."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def run_fresh(program: str, *arguments: object) -> str:
    """Run Python code with `sys.argv[1:]` as given; return its stderr. It fails the test by an exception."""
    done = subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode == 0, done.stderr
    return done.stderr
