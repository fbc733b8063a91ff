"""The list of robots says how long each stays with the truth, best first."""

import json
from importlib.resources import files

import pytest

from hma_model.checkpoint.folder import BUNDLED, Checkpoint
from hma_model.checkpoint.io import record_evaluation
from hma_model.play.holding import MEASURED, Holding, holdings
from tests.model.robots import save


def test_the_bundled_models_robots_were_measured() -> None:
    """A new bundled model needs a new measurement: python recipes/bench/holding.py CHECKPOINT."""
    measured = json.loads(files("hma_model.play").joinpath(MEASURED).read_text("utf-8"))
    found = dict[str, Holding]()
    for part in map(Checkpoint.open, BUNDLED.values()):
        assert measured[part.trunk_sha256].keys() == set(part.embodiments)
        found |= holdings(part)
    assert len(measured) == len(BUNDLED)
    assert all(one.follows for one in found.values())


@pytest.mark.parametrize(
    ("verdict", "follows"),
    [
        ("follows its actions: last-frame PSNR gain +4.1 dB", True),
        ("does not follow its actions yet: last-frame PSNR gain +0.1 dB", False),
        ("", None),
    ],
)
def test_of_other_checkpoints_the_verdict_of_evaluate_counts(verdict, follows, tmp_path) -> None:
    save(tmp_path / "model", {"arm": 2})
    checkpoint = Checkpoint.open(tmp_path / "model")
    if verdict:
        record_evaluation(checkpoint, "arm", {"verdict": verdict})
    assert holdings(Checkpoint.open(tmp_path / "model")) == {"arm": Holding(None, False, follows)}


def test_those_that_hold_longest_come_first_and_those_that_do_not_follow_last() -> None:
    known = [
        Holding(1.5, False, False),
        Holding(None, False, None),
        Holding(60, True, True),
        Holding(7.4, False, True),
    ]
    words = [one.words for one in sorted(known, key=lambda one: one.rank)]
    assert words == ["holds 60 s or more", "holds 7 s", "", "does not follow its actions"]
