"""Which cameras a window takes: one, a drawn one, or several stacked; against the columns themselves."""

from pathlib import Path

import numpy as np
import pytest
import torch

from hma_data.errors import UsageError
from hma_data.loading.dataset import MixtureDataset, WindowDataset, open_sets
from tests.data.cameras import SIZES, three_shards
from tests.data.conversion.test_cameras import ONE_CAMERA

NAMES = list(SIZES)
FRAMES = 3


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return three_shards(tmp_path_factory.mktemp("views"), val_fraction=0)


def every(folder: Path, cameras: object) -> object:
    windows = WindowDataset(folder, "train", FRAMES, cameras=cameras)  # type: ignore[arg-type]
    return windows.batch(range(len(windows)))


def camera_of(tokens: torch.Tensor) -> torch.Tensor:
    """The camera of each sample by its colour, see `pictures`."""
    return (tokens[:, 0, 0, 0] % 16 - 1) // 4


@pytest.mark.parametrize("name", NAMES)
def test_a_named_camera_gives_its_own_column(made: Path, name: str) -> None:
    batch = every(made, name)
    assert set(batch.camera.tolist()) == set(camera_of(batch.tokens).tolist()) == {NAMES.index(name)}
    assert torch.equal(batch.tokens[:, :, 0, 0] // 256, batch.frame[:, None] + 2 * torch.arange(FRAMES))


def test_the_first_is_taken_by_default(made: Path) -> None:
    windows = WindowDataset(made, "train", FRAMES)
    assert torch.equal(windows.batch(range(len(windows))).tokens, every(made, "top").tokens)


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
        return MixtureDataset([made], 4, FRAMES, cameras="drawn", lanes=2, seed=3)

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
        MixtureDataset([made], 4, FRAMES, lanes=2, seed=3).load_state_dict(half.state_dict())


def test_short_episodes_are_padded_with_every_view(made: Path) -> None:
    windows = WindowDataset(made, "train", 5, short="pad", cameras=["top", "wrist"])
    batch = windows.batch(range(len(windows)))
    assert batch.tokens.shape[2:] == (16, 8)
    assert not batch.frame_mask.all()


def test_a_set_with_fewer_cameras_is_one_clear_error(made: Path) -> None:
    with pytest.raises(UsageError, match=r"toy_arm has the cameras top in .*, not side — .*--cameras all"):
        open_sets([ONE_CAMERA], ["top", "side"])
    with pytest.raises(UsageError, match="three_hdf5 has the cameras top, wrist, side in .*, not nose"):
        WindowDataset(made, "train", FRAMES, cameras="nose")
