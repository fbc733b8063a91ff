"""Windows and batches: right against the rows, the same whoever makes them and whenever they stopped."""

from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch

from hma_data.conversion.plan import Settings
from hma_data.errors import ShardError, UsageError
from hma_data.loading.dataset import Batch, MixtureDataset, WindowDataset, open_sets
from hma_data.loading.mixture import Mixture
from hma_data.shards import writer
from hma_data.shards.reader import ShardSet
from tests.conftest import ARM_YAML, toy_shards
from tests.data.cameras import SIZES, three_shards
from tests.data.conversion.test_cameras import ONE_CAMERA

FRAMES = 4


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two robots of different width and stride; row groups so small that windows cross them."""
    folder = tmp_path_factory.mktemp("sets")
    two = ARM_YAML.replace("toy_arm", "toy_two").replace("target_hz: 5", "target_hz: 10")
    two = two.replace("dims: 3, names: [a, b, c]", "dims: 2, slice: [0, 2]")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, "ROW_GROUP", 25)
        settings = Settings(val_fraction=0.1, shard_frames=130)
        return [
            toy_shards(folder / "one", range(5, 60, 3), settings),
            toy_shards(folder / "two", range(3, 20), settings, two),
        ]


def same(a: Batch, b: Batch) -> bool:
    return (
        a.embodiment == b.embodiment
        and torch.equal(a.actions, b.actions)
        and torch.equal(a.tokens, b.tokens)
        and torch.equal(a.episode, b.episode)
        and torch.equal(a.frame, b.frame)
    )


def test_every_window_is_its_rows_and_stays_in_its_episode(sets: list[Path]) -> None:
    shards = ShardSet(sets[0])
    windows = WindowDataset(shards, "train", FRAMES)
    lengths = {r["episode_index"]: r["length"] for r in shards.episodes.to_pylist() if r["split"] == "train"}
    span = FRAMES * 2
    assert len(windows) == sum(max(0, n - span + 1) for n in lengths.values())
    assert windows.index.short_episodes == sum(n < span for n in lengths.values())
    batch = windows.batch(range(len(windows)))
    expected = [(e, f) for e in sorted(lengths) for f in range(max(0, lengths[e] - span + 1))]
    assert sorted(zip(batch.episode.tolist(), batch.frame.tolist(), strict=True)) == expected
    rows = {e: shards.episode_rows(e) for e in lengths}
    for i in range(len(windows)):
        episode, frame = int(batch.episode[i]), int(batch.frame[i])
        np.testing.assert_array_equal(
            batch.tokens[i].reshape(FRAMES, -1),
            rows[episode]["tokens"][frame : frame + span : 2].astype(np.int64),
        )
        np.testing.assert_array_equal(
            batch.actions[i].reshape(span, 3), rows[episode]["action"][frame : frame + span]
        )


@pytest.mark.parametrize("stop", [5, 23])
def test_a_restart_goes_on_with_the_same_windows(sets: list[Path], stop: int) -> None:
    whole = list(islice(MixtureDataset(sets, 6, FRAMES, seed=3), 40))
    first = MixtureDataset(sets, 6, FRAMES, seed=3)
    begun = list(islice(first, stop))
    second = MixtureDataset(sets, 6, FRAMES, seed=3)
    second.load_state_dict(first.state_dict())
    rest = list(islice(second, 40 - stop))
    assert all(same(a, b) for a, b in zip(whole, begun + rest, strict=True))


def test_ranks_share_one_draw_of_the_mixture(sets: list[Path]) -> None:
    single = [batch.embodiment for batch in islice(MixtureDataset(sets, 8, FRAMES), 5)]
    ranks = [MixtureDataset(sets, 4, FRAMES, rank=rank, world=2) for rank in (0, 1)]
    halves = [[batch.embodiment for batch in islice(data, 5)] for data in ranks]
    assert [a + b for a, b in zip(*halves, strict=True)] == single


def test_narrow_actions_are_padded_with_zeros(sets: list[Path]) -> None:
    batch = next(iter(MixtureDataset(sets, 32, FRAMES, temperature=100)))
    assert batch.actions.shape == (32, FRAMES, 6)
    narrow = [i for i, name in enumerate(batch.embodiment) if name == "toy_two"]
    assert narrow
    assert (batch.actions[narrow, :, 2:] == 0).all()
    assert batch.tokens.dtype == torch.int64
    assert batch.action_mask.all()


def test_no_window_at_all_is_refused_with_what_to_do(sets: list[Path]) -> None:
    with pytest.raises(ShardError, match="fewer frames"):
        MixtureDataset(sets, 4, frames=200)


def test_one_embodiment_twice_is_refused(sets: list[Path]) -> None:
    with pytest.raises(ShardError, match="each embodiment once; hma shards merge makes one set of several"):
        MixtureDataset([sets[0], sets[0]], 4, FRAMES)


def test_strided_rows_give_the_windows_of_all_rows(tmp_path: Path) -> None:
    made = {}
    for frames in ("all", "strided"):
        settings = Settings(frames=frames, val_fraction=0)  # type: ignore[arg-type]
        windows = WindowDataset(toy_shards(tmp_path / frames, range(20, 31), settings), "train", FRAMES)
        made[frames] = windows.batch(range(len(windows)))
    of_all = {(int(e), int(f)): i for i, (e, f) in enumerate(zip(made["all"].episode, made["all"].frame))}
    grid = made["strided"]
    places = [of_all[int(e), 2 * int(f)] for e, f in zip(grid.episode, grid.frame, strict=True)]
    assert len(places) == sum((n // 2) - FRAMES + 1 for n in range(20, 31))
    assert torch.equal(grid.tokens, made["all"].tokens[places])
    assert torch.equal(grid.actions, made["all"].actions[places])
    mixed = next(iter(MixtureDataset([tmp_path / "strided"], 5, FRAMES)))
    assert mixed.actions.shape == (5, FRAMES, 6)


def test_short_episodes_are_padded_with_their_last_frame_and_masked(tmp_path: Path) -> None:
    out = toy_shards(tmp_path / "out", [2, 3, 5, 20], Settings(val_fraction=0))
    windows = WindowDataset(out, "train", FRAMES, short="pad")
    assert (windows.index.short_episodes, windows.index.padded_episodes) == (1, 2)
    batch = windows.batch([0, 1, 2])
    assert batch.episode.tolist() == [1, 2, 3]
    assert batch.frame_mask.tolist() == [[True, True, False, False], [True, True, True, False], [True] * 4]
    assert batch.action_mask.tolist() == [[True, False, False, False], [True, True, False, False], [True] * 4]
    rows = ShardSet(out).episode_rows(1, ["tokens", "action"])
    np.testing.assert_array_equal(batch.tokens[0].reshape(4, -1), rows["tokens"][[0, 2, 2, 2]])
    np.testing.assert_array_equal(batch.actions[0].reshape(8, 3)[:3], rows["action"])
    assert not batch.actions[0].reshape(8, 3)[3:].any()
    seen = list(islice(MixtureDataset([out], 5, FRAMES, short="pad", lanes=1), 6))
    assert {int(e) for b in seen for e in b.episode} == {1, 2, 3}
    assert WindowDataset(out, "train", FRAMES)[0].frame_mask is None


def test_windows_of_an_episode_longer_than_a_row_group_are_whole(tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, "ROW_GROUP", 16)
        shards = ShardSet(toy_shards(tmp_path / "out", [90], Settings(val_fraction=0)))
    rows = shards.episode_rows(0, ["tokens", "action"])
    windows = WindowDataset(shards, "train", 10)  # 20 rows: each window lies in two or three row groups
    batch = windows.batch(range(len(windows)))
    stream = next(iter(MixtureDataset([shards], 71, 10, lanes=1)))
    for found in (batch, stream):
        assert sorted(found.frame.tolist()) == list(range(71))
        for i, first in enumerate(found.frame.tolist()):
            np.testing.assert_array_equal(found.tokens[i].reshape(10, -1), rows["tokens"][first:][:20:2])
            np.testing.assert_array_equal(found.actions[i].reshape(20, 3), rows["action"][first : first + 20])


@pytest.mark.parametrize(("split", "temperature"), [("train", 3), ("val", 4)])
def test_each_split_has_the_papers_temperature(sets: list[Path], split: str, temperature: float) -> None:
    mixture = MixtureDataset(sets, 4, 1, split=split).mixture
    assert mixture.counts[0] != mixture.counts[1]
    np.testing.assert_allclose(mixture.p, Mixture.of(dict(zip("abcdefgh", mixture.counts)), temperature).p)


# -- several cameras


NAMES = list(SIZES)
VIEW_FRAMES = 3


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return three_shards(tmp_path_factory.mktemp("views"), val_fraction=0)


def every(folder: Path, cameras: object) -> object:
    windows = WindowDataset(folder, "train", VIEW_FRAMES, cameras=cameras)  # type: ignore[arg-type]
    return windows.batch(range(len(windows)))


def camera_of(tokens: torch.Tensor) -> torch.Tensor:
    """The camera of each sample by its colour, see `pictures`."""
    return (tokens[:, 0, 0, 0] % 16 - 1) // 4


@pytest.mark.parametrize("name", NAMES)
def test_a_named_camera_gives_its_own_column(made: Path, name: str) -> None:
    batch = every(made, name)
    assert set(batch.camera.tolist()) == set(camera_of(batch.tokens).tolist()) == {NAMES.index(name)}
    assert torch.equal(batch.tokens[:, :, 0, 0] // 256, batch.frame[:, None] + 2 * torch.arange(VIEW_FRAMES))


def test_views_are_stacked_along_the_height_in_the_order_named(made: Path) -> None:
    stacked = every(made, ["side", "top"])
    parts = torch.cat([every(made, "side").tokens, every(made, "top").tokens], dim=2)
    assert stacked.tokens.shape[2:] == (16, 8)
    assert torch.equal(stacked.tokens, parts)
    assert torch.equal(stacked.actions, every(made, "top").actions)


def test_stacked_latents_keep_their_channels(made: Path) -> None:
    from hma_data.loading.views import stacked
    from hma_data.tokenizers.base import TokenizerSpec

    spec = TokenizerSpec("l", 1, "continuous", 16, (2, 3), channels=4, dtype="float16")
    one, other = np.random.default_rng(0).normal(size=(2, 5, 6, 4, 2, 3))
    rows = np.stack([one.reshape(5, 6, -1), other.reshape(5, 6, -1)], axis=2)
    np.testing.assert_array_equal(stacked(rows, spec, 2), np.concatenate([one, other], axis=3))


def test_drawn_cameras_are_told_and_come_again_after_a_resume(made: Path) -> None:
    def stream() -> MixtureDataset:
        return MixtureDataset([made], 4, VIEW_FRAMES, cameras="drawn", lanes=2, seed=3)

    whole = stream()
    batches = [batch for batch, _ in zip(whole, range(12), strict=False)]
    for batch in batches:
        assert torch.equal(camera_of(batch.tokens), batch.camera)
    counts = torch.cat([batch.camera for batch in batches]).bincount(minlength=3)
    assert counts.min() > 5
    half, again = stream(), stream()
    for _ in zip(half, range(5), strict=False):
        pass
    again.load_state_dict(half.state_dict())
    for ours, theirs in zip(again, batches[half.state_dict()["step"] :], strict=False):
        assert torch.equal(ours.tokens, theirs.tokens)
    batch = every(made, "drawn")
    assert torch.equal(camera_of(batch.tokens), batch.camera)
    assert set(batch.camera.tolist()) == {0, 1, 2}
    with pytest.raises(UsageError, match="cameras"):
        MixtureDataset([made], 4, VIEW_FRAMES, lanes=2, seed=3).load_state_dict(half.state_dict())


def test_a_set_with_fewer_cameras_is_one_clear_error(made: Path) -> None:
    with pytest.raises(UsageError, match=r"toy_arm has the cameras top in .*, not side — .*--cameras all"):
        open_sets([ONE_CAMERA], ["top", "side"])
    with pytest.raises(UsageError, match="three_hdf5 has the cameras top, wrist, side in .*, not nose"):
        WindowDataset(made, "train", VIEW_FRAMES, cameras="nose")
