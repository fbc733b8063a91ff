"""Say how long each robot of a checkpoint stays with the truth, so that people choose one that does.

The robots of bundled checkpoints were measured by `recipes/bench/holding.py`. Whether a robot follows its
actions, the verdict of `hma evaluate` in its card says.
"""

import json
from dataclasses import dataclass
from importlib.resources import files

from hma_model.checkpoint.folder import Checkpoint, value_of

MEASURED = "holding.json"  # by the trunk's SHA-256


@dataclass(frozen=True)
class Holding:
    """How long a robot stays with the truth.

    Attributes:
        seconds: until model and truth part, the lower median over scenes; None if nobody measured it.
        at_least: whether they had not parted when the measurement ended.
        follows: whether the robot follows its actions; None if nobody knows.
    """

    seconds: float | None
    at_least: bool
    follows: bool | None

    @property
    def words(self) -> str:
        """Return what the list of robots says of it; "" if nobody knows."""
        if self.follows is False:
            return "does not follow its actions"
        if self.seconds is None:
            return ""
        return f"holds {self.seconds:.0f} s" + " or more" * self.at_least

    @property
    def rank(self) -> tuple[bool, float]:
        """Return its place in the list: those that hold longest come first, those that do not follow last."""
        return self.follows is False, -(self.seconds or 0.0)


UNKNOWN = Holding(None, False, None)


def holdings(checkpoint: Checkpoint) -> dict[str, Holding]:
    """Return what is known of each robot of a checkpoint."""
    measured = json.loads(files("hma_model.play").joinpath(MEASURED).read_text("utf-8"))
    known = measured.get(checkpoint.trunk_sha256, {})
    found = {}
    for name in checkpoint.embodiments:
        verdict = str(value_of(checkpoint.card(name).get("evaluation"), "verdict"))
        says = {"follows": True, "does not follow": False}
        follows = next((value for words, value in says.items() if verdict.startswith(words)), None)
        own = known.get(name, {})
        found[name] = Holding(own.get("seconds"), own.get("at_least", False), follows)
    return found
