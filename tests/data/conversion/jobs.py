"""A conversion in a process of its own that can be killed, and whose readers can fail."""

import os
import subprocess
import sys
from pathlib import Path

from hma_data.storage.remote import RemotePath
from tests.conftest import contents
from tests.data.fresh import ROOT

SCRIPT = """
import os, signal, sys, time
from pathlib import Path
import hma_data.conversion.job as job
from hma_data.conversion import worker
from hma_data.conversion.engines import Limits
from hma_data.conversion.plan import Settings
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.hdf5.source import Hdf5Source
from tests.conftest import ARM_YAML, BlockTokenizer

source, out, trouble, workers, seed = sys.argv[1:]
read = Hdf5Source.read
def troubled(self, uri, episode_id, embodiment):
    time.sleep(0.02)
    said = Path(trouble) / episode_id
    if said.exists():
        os.kill(os.getpid(), getattr(signal, said.read_text()))
    return read(self, uri, episode_id, embodiment)
Hdf5Source.read = troubled
worker.get_tokenizer = job.get_tokenizer = lambda *a, **k: BlockTokenizer()
job.get_spec = lambda *a, **k: BlockTokenizer.spec
if __name__ == "__main__":
    job.convert(
        Embodiment.from_yaml(ARM_YAML), source, "block", out, workers=int(workers), max_quarantine=1,
        settings=Settings(val_fraction=0.2, shard_frames=60, seed=int(seed)),
        limits=Limits(quiet_s=120, kills=50),
    )
"""


def start(
    folder: Path,
    recording: Path,
    out: Path,
    *,
    workers: int = 2,
    seed: int = 0,
    **trouble: str,
) -> subprocess.Popen[str]:
    """Start a conversion as `convert_toy` makes it.

    Args:
        folder: for its script and its troubles.
        trouble: episode -> the signal that ends the process of its reader.
    """
    (folder / "trouble").mkdir(exist_ok=True)
    for episode, kind in trouble.items():
        (folder / "trouble" / episode).write_text(kind)
    (folder / "job.py").write_text(SCRIPT)
    words = [folder / "job.py", recording, out, folder / "trouble", workers, seed]
    return subprocess.Popen(
        [sys.executable, *map(str, words)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def ends(process: subprocess.Popen[str]) -> None:
    _, errors = process.communicate(timeout=200)
    assert process.returncode == 0, errors


def files(out: Path) -> dict[str, bytes]:
    if isinstance(out, RemotePath):
        return {name: (out / name).read_bytes() for name in out.listing()}
    return contents(out)
