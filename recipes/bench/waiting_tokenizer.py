"""Stand in for a tokenizer on a GPU: wait so many milliseconds a frame (`hma bench convert wait_ms=…`).

The conversion then shows how everything else scales with the number of workers, also on few cores. Other
processes find the tokenizer by an entry point, which `offered` puts on their path.
"""

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.plugins import TOKENIZER_GROUP
from hma_data.tokenizers.base import TokenizerSpec
from hma_data.tokenizers.catalog import Entry

NAME = "waiting"
ROOT = str(Path(__file__).resolve().parents[2])  # from which this module is imported
MILLISECONDS = "HMA_BENCH_WAIT_MS"
SIZE, CELL = 128, 8
ENTRY = Entry(
    NAME, "discrete", SIZE, (SIZE // CELL, SIZE // CELL), "waits as for a GPU", "none", __name__, imports=()
)


class Waiting:
    """The tokens are the red values of every eighth pixel."""

    def __init__(self) -> None:
        side = SIZE // CELL
        self.spec = TokenizerSpec(NAME, 1, "discrete", SIZE, (side, side), 256, dtype="uint16")
        self._seconds = float(os.environ[MILLISECONDS]) / 1e3

    def encode(self, frames: NDArray[np.uint8]) -> NDArray[np.uint32]:
        """Return (N, 16, 16) ids of (N, 128, 128, 3) frames."""
        side = SIZE // CELL
        time.sleep(self._seconds * len(frames))
        return frames[:, ::CELL, ::CELL, 0].reshape(-1, side, side).astype(np.uint32)

    def decode(self, tokens: NDArray[Any]) -> NDArray[np.uint8]:
        """Return (N, 128, 128, 3) pictures of (N, 16, 16) ids."""
        grey = tokens.astype(np.uint8).repeat(CELL, axis=1).repeat(CELL, axis=2)
        return np.repeat(grey[..., None], 3, axis=3)


def load(name: str, *, weights: str | None, device: str) -> Waiting:
    """Return the tokenizer."""
    return Waiting()


@contextmanager
def offered(folder: Path, milliseconds: float) -> Iterator[None]:
    """Offer the tokenizer to this process and to those that it starts, until the end of the block."""
    info = folder / f"{NAME}-0.1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {NAME}\nVersion: 0.1\n")
    (info / "entry_points.txt").write_text(f"[{TOKENIZER_GROUP}]\n{NAME} = {__name__}:ENTRY\n")
    before = os.environ.get("PYTHONPATH")
    os.environ |= {
        MILLISECONDS: str(milliseconds),
        "PYTHONPATH": os.pathsep.join(filter(None, [str(folder), ROOT, before])),
    }
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))
        del os.environ[MILLISECONDS]
        if before is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = before
