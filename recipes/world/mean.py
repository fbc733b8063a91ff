"""Average two checkpoints, of which one was trained on from the other, robot by robot.

    python recipes/world/mean.py BEFORE AFTER SHARE OUT --data build/world/shards/arm1_02 …

The weights of OUT lie SHARE of the way from BEFORE to AFTER; its cards are those of AFTER, with losses
measured anew on the data. What was trained on mostly for one robot so keeps more of what it knew of the
others, often at a lower loss than either.
"""

import argparse
from pathlib import Path

import torch
from save_like import save_like

from hma_data.console import run_script
from hma_data.shards.reader import ShardSet
from hma_model.checkpoint.folder import Checkpoint
from hma_model.evaluation.losses import validation_losses, windows
from hma_model.network.model import HMA

WINDOWS = 48  # of each set, for the losses on the cards


def main() -> None:
    """Write the mean of the checkpoints."""
    parser = argparse.ArgumentParser(description="Average two checkpoints, one trained on from the other")
    parser.add_argument("before")
    parser.add_argument("after")
    parser.add_argument("share", type=float, help="of the way to the second, 0 to 1")
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", nargs="*", default=[], help="shard sets with a val split, one a robot")
    given = parser.parse_args()
    first, stored = Checkpoint.open(given.before), Checkpoint.open(given.after)
    robots = stored.embodiments
    before, after = (HMA.from_pretrained(one, embodiments=robots) for one in (given.before, given.after))
    if before.config != after.config:
        parser.error(f"{given.before} and {given.after} are different networks")
    for name in robots:
        if first.stats(name) != stored.stats(name):
            parser.error(f"{name} has other statistics in {given.before} than in {given.after}")
    earlier = before.state_dict()
    after.load_state_dict(
        {
            name: torch.lerp(earlier[name], value, given.share) if value.is_floating_point() else value
            for name, value in after.state_dict().items()
        }
    )
    cards = {name: {**stored.card(name), "metrics": {}} for name in robots}
    for data in map(ShardSet, given.data):
        found = windows(data, "val", after.config.frames, WINDOWS)
        losses, accuracy = (one.by_embodiment() for one in validation_losses(after.eval(), found))
        for name, loss in losses.items():
            cards[name]["metrics"] = {"val_loss": loss, "accuracy": accuracy[name]}
    save_like(after, given.out, stored, cards)


if __name__ == "__main__":
    run_script(main)
