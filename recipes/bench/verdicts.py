"""Judge each robot of a bundled model on new recordings, and write the verdicts into its cards.

    python recipes/bench/verdicts.py embedded-lab  # what is finished in --work is kept

The laboratory records 40 episodes of each robot with another seed than those of the training. Those that the
recording holds out, at most eight, are judged as `hma evaluate --windows 8` does.
"""

import argparse
import shutil
from pathlib import Path

from hma_data.console import run_script
from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.lab import record
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import open_source
from hma_data.tokenizers.base import reopened
from hma_model.checkpoint.folder import BUNDLED, Checkpoint
from hma_model.checkpoint.io import record_evaluation
from hma_model.evaluation.suite import EvaluationSettings, evaluate_all

EPISODES, SEED, JUDGED, WINDOWS = 40, 20261126, 8, 8


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkpoint", choices=BUNDLED)
    parser.add_argument("--work", type=Path, default=Path("verdicts"))
    given = parser.parse_args()
    work, bundled = given.work / given.checkpoint, Checkpoint.open(given.checkpoint)
    copy, tokenizer = work / "model", reopened(bundled.config.tokenizer)
    if not copy.is_dir():
        shutil.copytree(bundled.folder, copy)
    for name in bundled.embodiments:
        card = Checkpoint.open(copy).card(name)
        if "evaluation" not in card or not (work / name).is_dir():
            shutil.rmtree(work / name, ignore_errors=True)
            shards = judged(name, copy, work / name, tokenizer)
            evaluate_all(
                [copy], [shards], EvaluationSettings("val", WINDOWS)
            )  # writes the verdict into the copy's card
            card = Checkpoint.open(copy).card(name)
        record_evaluation(bundled, name, card["evaluation"])
        print(f"{name} {card['evaluation']['verdict']}", flush=True)


def judged(name: str, checkpoint: Path, work: Path, tokenizer: object) -> Path:
    """Record a robot and convert the episodes that are judged; return the shard set."""
    robot = Embodiment.load(checkpoint / "embodiments" / name / "embodiment.yaml")
    uri = record(name, work, EPISODES, SEED)
    refs = open_source(robot.source.format).index(uri, robot)
    held_out = [ref.id for ref in refs if ref.split == "val"][:JUDGED]
    others = [ref.id for ref in refs if ref.split != "val"]
    # Some formats have no split of their own: then all but a few of ten are held out.
    plan = Settings(only=(*held_out, others[0])) if held_out else Settings(limit=10, val_fraction=0.8)
    convert(robot, uri, tokenizer, work / "shards", settings=plan)
    return work / "shards"


if __name__ == "__main__":
    run_script(main)
