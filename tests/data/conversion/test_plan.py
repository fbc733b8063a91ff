"""Plans depend on the recording and the settings, and on nothing else."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hma_data.conversion.plan import Settings, choose_splits, make_plan, shard_size
from hma_data.errors import RegistryError, SourceError
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import EpisodeRef
from tests.conftest import BlockTokenizer


def refs(*frames: int) -> list[EpisodeRef]:
    return [EpisodeRef(f"demo_{i}", n, fingerprint=str(n)) for i, n in enumerate(frames)]


def plan(episodes: list[EpisodeRef], arm: Embodiment, settings: Settings | None = None):
    return make_plan(episodes, arm, BlockTokenizer.spec, settings or Settings(), "toy")


@given(st.lists(st.integers(0, 3000), min_size=1, max_size=40), st.integers(1, 5000))
def test_every_episode_is_in_one_shard_and_one_split(frames: list[int], size: int) -> None:
    arm = Embodiment.from_yaml(
        "{id: a, kind: real, frequency_hz: 5, action: {space: mixed, components: [{key: a, dims: 1}]},"
        " cameras: [{name: c, key: c}], source: {format: hdf5}}"
    )
    made = plan(refs(*frames), arm, Settings(shard_frames=size))
    placed = [index for unit in made.units for index, _ in unit.episodes]
    assert sorted(placed) == list(range(len(frames)))
    assert {unit.split for unit in made.units} == (
        {"train", "val"} if len(frames) > 1 else {made.units[0].split}
    )


def test_a_shard_is_closed_once_it_is_full(toy_arm: Embodiment) -> None:
    made = plan(refs(60, 60, 60, 60), toy_arm, Settings(val_fraction=0, shard_frames=100))
    assert [len(unit.episodes) for unit in made.units] == [2, 2]


def test_splits_follow_the_episodes_id_not_its_place(toy_arm: Embodiment) -> None:
    episodes = refs(*[10] * 200)
    by_id = dict(zip((e.id for e in episodes), choose_splits(episodes, 0.2, 0), strict=True))
    reverse = episodes[::-1]
    assert dict(zip((e.id for e in reverse), choose_splits(reverse, 0.2, 0), strict=True)) == by_id
    assert 20 <= sum(split == "val" for split in by_id.values()) <= 60


def test_the_sources_own_split_wins() -> None:
    episodes = [EpisodeRef("a", 5, "val"), EpisodeRef("b", 5, "train"), EpisodeRef("c", 5, "train")]
    assert choose_splits(episodes, 0.9, 0) == ["val", "train", "train"]


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


def test_an_unknown_camera_is_refused_with_the_known_ones(toy_arm: Embodiment) -> None:
    with pytest.raises(RegistryError, match="top, side"):
        plan(refs(5), toy_arm, Settings(cameras=("wrist",)))


def test_episodes_cut_from_one_recording_share_a_split() -> None:
    cut = [EpisodeRef(f"bag{i // 5}-{i % 5}", 10, group=f"bag{i // 5}") for i in range(100)]
    splits = choose_splits(cut, 0.3, seed=0)
    assert all(len(set(splits[start : start + 5])) == 1 for start in range(0, 100, 5))
    assert set(splits) == {"train", "val"}
