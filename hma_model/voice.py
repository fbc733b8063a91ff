"""What ends the ranks of a run is said once: by rank 0, or by the rank that alone knows.

A rank that fails leaves word in the store that the ranks have met by. Rank 0 says its own fault, or where it
has only lost the others the one that was left for it. The others are silent once rank 0 has spoken; where it
does not, because it waits for them or is gone, they speak, and it is silent. Before they have met, a fault is
most likely everybody's: the others give rank 0 a moment, in which torchrun ends them.
"""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from hma_data.errors import HMAError, TrainingError

if TYPE_CHECKING:
    from torch.distributed import Store

MOMENT, GLANCE = 3.0, 0.5  # seconds that rank 0 is given to speak, and that word of others is waited for
_SAID, _OWN = "another rank has said so", "this rank says so"


class Voice:
    """The word that ranks leave each other.

    Args:
        store: the one they have met by; None where there is none.
        rank: of this process.
        size: how many there are.
    """

    def __init__(self, store: "Store | None", rank: int, size: int) -> None:
        self._store, self._rank, self._size = store, rank, size

    def leave(self, fault: HMAError, what: str = "fault") -> None:
        """Leave word of the fault that ends this rank."""
        try:
            if self._store:
                self._store.set(f"{what} {self._rank}", str(fault))
        except RuntimeError:  # the store is gone with the rank that kept it
            self._store = None

    def heard(self) -> HMAError | None:
        """The fault of another rank, which has ended it and so this one."""
        for rank in range(self._size):
            if rank != self._rank and (text := self._word("fault", rank, GLANCE / self._size)):
                fault = TrainingError(f"rank {rank}", text)
                if self._word("said", rank):
                    fault.add_note(_SAID)
                return fault
        return None

    def settle(self, fault: HMAError) -> None:
        """Agree with rank 0 on who says why the run ends, and note on this rank's fault what came of it."""
        if self._rank:
            heard = self._word("fault", 0, MOMENT)
            fault.add_note(_SAID if heard else _OWN)
            self.leave(fault, "heard" if heard else "said")
        elif os.environ.get("TORCHELASTIC_USE_AGENT_STORE") != "True":  # the store goes with rank 0
            end = time.monotonic() + MOMENT
            for rank in range(1, self._size):
                while not self._word("heard", rank) + self._word("said", rank) and time.monotonic() < end:
                    time.sleep(0.02)

    def _word(self, what: str, rank: int, patience: float = 0.0) -> str:
        """What a rank has left; nothing where it does not in this many seconds."""
        key, end = f"{what} {rank}", time.monotonic() + patience
        try:
            while self._store:
                if self._store.check([key]):
                    return self._store.get(key).decode()
                if time.monotonic() >= end:
                    return ""
                time.sleep(0.02)
        except RuntimeError:
            self._store = None
        return ""


@contextmanager
def one_voice() -> Iterator[None]:
    """Around a command that every rank runs: ends silently on a rank whose fault rank 0 has said.

    Raises:
        SystemExit: with the fault's exit code, in the place of the fault.
    """
    try:
        yield
    except HMAError as fault:
        notes = getattr(fault, "__notes__", [])
        if _SAID in notes:
            raise SystemExit(fault.exit_code) from fault
        if os.environ.get("RANK", "0") != "0" and _OWN not in notes:
            time.sleep(MOMENT)
        raise
