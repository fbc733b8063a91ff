"""Plans depend on the recording and the settings, and on nothing else."""

import re

import pytest

from hma_data.conversion.plan import (
    Settings,
    choose_splits,
    idle_workers,
    longest_work,
    make_plan,
    shard_size,
)
from hma_data.errors import SourceError
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import EpisodeRef
from tests.conftest import BlockTokenizer


def refs(*frames: int) -> list[EpisodeRef]:
    return [EpisodeRef(f"demo_{i}", n, fingerprint=str(n)) for i, n in enumerate(frames)]


def plan(episodes: list[EpisodeRef], arm: Embodiment, settings: Settings | None = None):
    return make_plan(episodes, arm, BlockTokenizer.spec, settings or Settings(), "toy")


def test_splits_follow_the_episodes_id_not_its_place(toy_arm: Embodiment) -> None:
    episodes = refs(*[10] * 200)
    by_id = dict(zip((e.id for e in episodes), choose_splits(episodes, 0.2, 0), strict=True))
    reverse = episodes[::-1]
    assert dict(zip((e.id for e in reverse), choose_splits(reverse, 0.2, 0), strict=True)) == by_id
    assert 20 <= sum(split == "val" for split in by_id.values()) <= 60


@pytest.mark.parametrize(("episodes", "held_out"), [(1, 0), (2, 1), (8, 2), (20, 5), (28, 5), (60, 5)])
def test_a_small_set_holds_out_five_episodes_or_a_quarter(episodes: int, held_out: int) -> None:
    known = [EpisodeRef(f"demo_{i}", 5) for i in range(episodes)]
    assert max(choose_splits(known, None, seed).count("val") for seed in range(4)) >= held_out
    assert min(choose_splits(known, None, seed).count("val") for seed in range(4)) >= held_out
    assert choose_splits(known, 0.0, 0).count("val") == 0
    if episodes == 28:  # a share that is asked for stays that share
        assert choose_splits(known, 0.01, 0).count("val") == 1


def test_a_large_set_holds_out_a_twentieth() -> None:
    known = [EpisodeRef(f"demo_{i}", 5) for i in range(4_000)]
    assert choose_splits(known, None, 0) == choose_splits(known, 0.05, 0)


def test_the_hash_tells_plans_apart(toy_arm: Embodiment) -> None:
    same = plan(refs(9, 9), toy_arm).facts["hash"]
    assert plan(refs(9, 9), toy_arm).facts["hash"] == same
    assert plan(refs(9, 8), toy_arm).facts["hash"] != same
    assert plan(refs(9, 9), toy_arm, Settings(seed=1)).facts["hash"] != same
    assert plan(refs(9, 9), toy_arm.model_copy(update={"description": "other words"})).facts["hash"] == same


def test_shards_are_many_enough_to_share_and_never_huge() -> None:
    assert shard_size(1_000) == 4_096
    assert shard_size(1_000_000) == 31_250
    assert shard_size(10**9) == 170_000


def test_no_episodes_or_two_with_one_id_are_refused(toy_arm: Embodiment) -> None:
    with pytest.raises(SourceError, match="no episodes"):
        plan([], toy_arm)
    with pytest.raises(SourceError, match="two episodes"):
        plan([EpisodeRef("x", 1), EpisodeRef("x", 1)], toy_arm)


@pytest.mark.parametrize(
    ("frames", "workers", "tasks", "longest"),
    [
        ([100, 100], 1, 1, 200),
        ([100, 100], 64, 1, 100),  # more workers than shards are no faster
        ([190, 10], 2, 1, 190),
        ([50, 50, 50], 2, 1, 100),
        ([50] * 8, 2, 4, 50),
        ([50] * 8, 4, 64, 50),
        ([50] * 8, 0, 1, 400),  # 0 works in this process
        ([], 4, 1, 0),
    ],
)
def test_a_job_takes_as_long_as_its_busiest_worker(frames, workers, tasks, longest) -> None:
    assert longest_work(frames, workers, tasks) == longest


@pytest.mark.parametrize(("workers", "tasks"), [(64, 1), (4, 16), (10, 1), (3, 64)])
def test_workers_without_a_shard_are_told_with_the_size_that_gives_them_one(workers, tasks, toy_arm) -> None:
    episodes = refs(*[50] * 400)
    few = plan(episodes, toy_arm)
    todo = len(few.units[::tasks])
    line = idle_workers(few, todo, workers, tasks)
    assert line.startswith(f"{todo} shards" if todo > 1 else "1 shard")
    assert f": {todo} of {workers} workers ha" in line
    assert ("in every task" in line) == (tasks > 1)
    size = re.search(r"--shard-frames (\d+)( in every task)? gives more$", line)
    assert size
    many = plan(episodes, toy_arm, Settings(shard_frames=int(size[1])))
    assert idle_workers(many, len(many.units[tasks - 1 :: tasks]), workers, tasks) == ""


def test_a_size_is_only_named_where_it_helps(toy_arm: Embodiment) -> None:
    alone = plan(refs(500, 500), toy_arm, Settings(shard_frames=100))  # a shard holds whole episodes
    assert idle_workers(alone, 2, 8) == "2 shards: 2 of 8 workers have work"
    few = plan(refs(*[50] * 100), toy_arm)
    assert idle_workers(few, 1, 8, begun=True) == "1 shard left: 1 of 8 workers has work"
    assert idle_workers(few, 2, 2) == idle_workers(few, 2, 0) == ""
