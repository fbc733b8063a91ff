"""`hma bench scale` on few episodes: its steps go through the classes of a conversion and of the loader."""

from pathlib import Path

import pytest

from hma_data.loading.dataset import MixtureDataset
from hma_data.shards.reader import ShardSet
from recipes.bench import scale

SMALL = {"episodes": 120, "embodiments": 2, "folder": ""}


@pytest.mark.slow
def test_every_step_reports_its_time_and_memory() -> None:
    results = scale.run(SMALL)
    assert [one["step"] for one in results] == ["plan", "write", "read", "resume", "mixture"]
    assert all(one["episodes"] == 120 and one["peak_rss_mib"] > 0 for one in results)


def test_the_sets_hold_what_was_planned(tmp_path: Path) -> None:
    scale._make(str(tmp_path), SMALL)
    for step in scale.STEPS.values():
        step(tmp_path, SMALL)
    planned = {robot.id: plan for robot, _, plan in scale._planned(SMALL)}
    assert sum(plan.episodes for plan in planned.values()) == 120
    for name, plan in planned.items():
        shards = ShardSet(tmp_path / name)
        assert shards.manifest.plan == plan.facts
        assert sum(split["frames"] for split in shards.manifest.splits.values()) == plan.frames
        assert len(shards.episodes) == plan.episodes
    windows = MixtureDataset([tmp_path / name for name in planned], 32).mixture.counts
    assert len(windows) == 2 and all(count > 0 for count in windows)


def test_a_set_that_lacks_a_shard_is_not_whole(tmp_path: Path) -> None:
    one = SMALL | {"episodes": 40, "embodiments": 1}
    scale._make(str(tmp_path), one)
    scale._write(tmp_path, one)
    next(tmp_path.glob("robot_0/train/*.parquet")).unlink()
    with pytest.raises(RuntimeError, match="not whole"):
        scale._resume(tmp_path, one)
