"""Report the error that ends a distributed run exactly once.

A rank that fails writes its error into the store of the run. A rank that has only lost the others finds it
there. The first failing rank to claim the report prints its error; the others exit silently. A rank exits
only after the report is claimed, and the reporting rank ignores the signal by which torchrun then ends it.

The claim needs a store that outlives the ranks; torchrun has one. Ranks that are started in another way each
print their own error.
"""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING

from hma_data.errors import TrainingError

if TYPE_CHECKING:
    from torch.distributed import Store

PREFIX, ERROR, REPORTS = "errors", "error", "reports"  # of the keys in the store
ANSWER = timedelta(seconds=30)  # the time limit for an answer of torchrun's store


def write_error(store: "Store | None", rank: int, error: Exception) -> None:
    """Write the error that ends a rank into the store, unless another rank has written one."""
    kind = "" if hasattr(error, "exit_code") else f"{type(error).__name__}: "
    try:
        if store is not None:
            store.compare_set(ERROR, "", f"{rank} {kind}{error}")
    except RuntimeError:  # the store is gone with the process that kept it
        return


def read_error(store: "Store | None") -> TrainingError | None:
    """Return the error that another rank has written, or None."""
    try:
        if store is None or not store.check([ERROR]):
            return None
        rank, _, text = store.get(ERROR).decode().partition(" ")
    except RuntimeError:
        return None
    return TrainingError(f"rank {rank}", text)


@contextmanager
def report_once() -> Iterator[None]:
    """Let one rank of a failed run raise its error; end the others silently with its exit code.

    Raises:
        SystemExit: another rank reports its error.
    """
    try:
        yield
    except Exception as error:
        if int(os.environ.get("WORLD_SIZE", "1")) == 1:
            raise
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if _claim_report():
            raise
        raise SystemExit(getattr(error, "exit_code", 1)) from error


def _claim_report() -> bool:
    """Check whether this rank must report: it is the first to claim it, or there is no store."""
    if os.environ.get("TORCHELASTIC_USE_AGENT_STORE") != "True":
        return True
    import torch.distributed as dist

    host, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
    try:
        store = dist.TCPStore(host, port, is_master=False, wait_for_workers=False, timeout=ANSWER)
        attempt = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")
        return bool(store.add(f"{PREFIX}/{REPORTS} {attempt}", 1) == 1)
    except RuntimeError:  # torchrun has ended
        return True
