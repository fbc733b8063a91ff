"""Hold the results of the demo, from which its report is written."""

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hma_data.loading.mixture import Mixture
from hma_data.shards.reader import ShardSet
from hma_data.storage.files import write_atomic
from hma_model.checkpoint.folder import Checkpoint

if TYPE_CHECKING:
    from hma_model.evaluation.rollout_video import RolloutVideo
    from hma_model.evaluation.wholeness import Left
    from hma_model.training.loop import TrainResult

TIMINGS = "timings.json"
HELD = 20  # frames in closed loop after which it is measured what is left


@dataclass
class DemoRun:
    """The results of the demo so far."""

    out: Path  # the folder of the demo
    start: Checkpoint  # the pre-trained trunk
    recordings: dict[str, Path] = field(default_factory=dict)  # by robot, as all that follow
    sets: dict[str, ShardSet] = field(default_factory=dict)
    mixture: Mixture | None = None  # over the train windows
    result: "TrainResult | None" = None  # of the finetuning
    pulled: dict[str, Path] = field(default_factory=dict)  # checkpoints with one robot
    figures: dict[str, dict[str, Any]] = field(default_factory=dict)  # of `evaluate` on held-out windows
    films: dict[str, "RolloutVideo"] = field(default_factory=dict)  # held-out rollouts
    left: dict[str, dict[str, "Left"]] = field(default_factory=dict)  # after HELD frames
    seconds: dict[str, float] = field(default_factory=dict)  # stage -> wall time
    sizes: dict[str, int] = field(default_factory=dict)  # name of a file or folder -> bytes

    @property
    def run(self) -> "TrainResult":
        """Return the result of the finetuning, which later stages need."""
        assert self.result is not None
        return self.result

    @contextmanager
    def stage(self, number: int, name: str) -> Iterator[None]:
        """Print the name of a stage, and measure its time."""
        print(f"[{number}/5] {name}", file=sys.stderr, flush=True)
        begun = time.monotonic()
        yield
        path = self.out / TIMINGS  # a continued run keeps the larger of the times of its sessions
        known = json.loads(path.read_text()) if path.is_file() else {}
        self.seconds[name] = known[name] = max(time.monotonic() - begun, known.get(name, 0.0))
        write_atomic(path, json.dumps(known))
