"""Run `hma` in this process, as a user would type it; only what concerns the process itself starts one."""

import contextlib
import io
import os
import subprocess
import sys
from pathlib import Path

from hma_model.cli import main

ROOT = Path(__file__).resolve().parents[1]


def hma(*arguments: str | Path, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Run a command by `main(argv)`; returns its exit code and what it printed.

    Args:
        arguments: the words after `hma`.
        cwd: the folder to run it in.
    """
    words = [str(word) for word in arguments]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.chdir(cwd), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(words)
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


def hma_process(*arguments: str | Path, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Run a command in a process of its own: for tests of start-up, signals and tracebacks."""
    return subprocess.run(
        [sys.executable, "-m", "hma_model.cli", *map(str, arguments)],
        cwd=cwd,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )


def fails(done: subprocess.CompletedProcess[str], code: int, *words: str) -> None:
    """Check for one line on stderr that says all of `words`, no traceback, and the exit code."""
    assert done.returncode == code, done.stderr
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1, done.stderr
    assert "Traceback" not in done.stderr
    for word in words:
        assert word in errors[0]
