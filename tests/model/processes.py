"""Processes of their own for tests: ranks of a run, and runs that are killed.

They are forked from a server that has imported torch once and has a single thread. A process that does not
end fails the test with its stacks.
"""

import faulthandler
import multiprocessing
import multiprocessing.forkserver
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from multiprocessing.process import BaseProcess
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import torch
from torch.distributed import TCPStore

from hma_data.errors import HMAError
from hma_model.cli import main
from hma_model.training.parallel import report_once

ROOT = Path(__file__).resolve().parents[2]
SAFETY = 120.0  # seconds after which a process counts as hung
PRELOAD = [
    "torch._dynamo",
    "torch.distributed.nn.functional",
    "hma_model.training.loop",
    "hma_model.cli",
    "pytest",
]
ALONE = {  # no library of the server starts a thread
    "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "JE_ARROW_MALLOC_CONF": "background_thread:false",
    "PYTHONPATH": str(ROOT),
}  # fmt: skip


def start(work: Callable[[], Any], said: Path) -> BaseProcess:
    serve()
    process = multiprocessing.get_context("forkserver").Process(target=_run, args=(work, said))
    process.start()
    return process


def serve() -> None:
    multiprocessing.get_context("forkserver").set_forkserver_preload([*PRELOAD, __name__])
    before = dict(os.environ)
    os.environ.update(ALONE)
    try:
        multiprocessing.forkserver.ensure_running()
    finally:
        os.environ.clear()
        os.environ.update(before)


def _run(work: Callable[[], Any], said: Path) -> None:
    file = os.open(said, os.O_CREAT | os.O_WRONLY | os.O_APPEND)
    os.dup2(file, 1)
    os.dup2(file, 2)
    sys.stdout, sys.stderr = os.fdopen(1, "w", buffering=1), os.fdopen(2, "w", buffering=1)
    faulthandler.register(signal.SIGUSR1, chain=True)
    torch.set_num_threads(1)
    work()


def end(processes: Sequence[BaseProcess], said: Path) -> list[int]:
    """Wait for processes; returns their exit codes.

    Raises:
        AssertionError: one hangs; the text has its stacks.
    """
    last = time.monotonic() + SAFETY
    for process in processes:
        process.join(max(last - time.monotonic(), 0))
    hung = [process for process in processes if process.exitcode is None]
    for process in hung:
        assert process.pid
        os.kill(process.pid, signal.SIGUSR1)  # writes its stacks and ends it
        process.join(10)
        process.kill()
    assert not hung, f"{len(hung)} of {len(processes)} processes hang\n{said.read_text()}"
    return [process.exitcode or 0 for process in processes]


def run(work: Callable[[], Any], said: Path, code: int = 0) -> str:
    found, text = end([start(work, said)], said), said.read_text()
    assert found == [code], text
    return text


def run_command(folder: Path, *words: str, env: dict[str, str] | None = None) -> CompletedProcess[str]:
    """Run `hma` with these words; what it says is kept in the folder."""
    out, said = folder / "stdout.txt", folder / "stderr.txt"
    (code,) = end([start(partial(command, *words, out=out, env=env), said)], said)
    return CompletedProcess(words, code, out.read_text(), said.read_text())


def command(*words: str, out: Path | None = None, env: dict[str, str] | None = None) -> None:
    os.environ.update(env or {})
    if out:
        os.dup2(os.open(out, os.O_CREAT | os.O_WRONLY), 1)
    sys.argv = ["hma", *words]
    sys.exit(main())


def run_ranks(work: Callable[[int], Any], said: Path, codes: Sequence[int] = (0, 0)) -> str:
    """Run work(rank) on a rank for each exit code, which it must end with; returns what the ranks said."""
    store = TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)  # torchrun's, outlives ranks
    places = [(rank, len(codes), store.port) for rank in range(len(codes))]
    processes = [start(partial(_rank, work, *place), said) for place in places]
    found, text = end(processes, said), said.read_text()
    assert found == list(codes), text
    return text


def _rank(work: Callable[[int], Any], rank: int, ranks: int, port: int) -> None:
    os.environ.update(
        RANK=str(rank), LOCAL_RANK=str(rank), WORLD_SIZE=str(ranks),
        MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port), TORCHELASTIC_USE_AGENT_STORE="True",
    )  # fmt: skip
    try:
        with report_once():
            work(rank)
    except HMAError as fault:  # as the command does
        os.kill(os.getpid(), signal.SIGTERM)  # torchrun's, which another rank's end has brought about
        print(f"error: {fault}", file=sys.stderr)
        sys.exit(fault.exit_code)


def errors(said: str) -> list[str]:
    return [line for line in said.splitlines() if line.startswith("error: ")]
