"""The flags of steps: is_last, whose action is undefined, and is_first, which begins an episode."""

from pathlib import Path

import numpy as np
import pytest

from hma_data.episodes.align import to_clip
from hma_data.errors import EpisodeError
from hma_data.inspection.infer import infer
from hma_data.inspection.inspect import examine
from hma_data.sources.base import open_source
from hma_data.storage.yaml_io import parse_yaml
from tests.data.rlds_files import tensor
from tests.data.sources.rlds.test_rlds import STEPS, embodiment, read, record, write

COUNT = 8
FLAGS = {"is_first": tensor((), "bool"), "is_last": tensor((), "bool")}


def flagged(last_action: tuple[float, float] | None = None, first=(0,), last=(COUNT - 1,)) -> dict:
    """A record whose flags are 1 at those steps, and whose last action is another if given."""
    found = record(0, COUNT)
    found["steps/action/move"] = np.arange(1, 2 * COUNT + 1, dtype=np.float32)
    if last_action is not None:
        found["steps/action/move"][-2:] = last_action
    found["steps/is_first"] = [int(i in first) for i in range(COUNT)]
    found["steps/is_last"] = [int(i in last) for i in range(COUNT)]
    return found


def folder_of(path: Path, *records: dict) -> Path:
    return write(path / "toy", {"toy-train.tfrecord-00000-of-00001": list(records)}, STEPS | FLAGS)


@pytest.mark.parametrize("padding", [(0.0, 0.0), (np.nan, np.nan), (np.inf, 1.0)])
def test_the_padding_of_the_last_step_is_left_out_and_said(padding, tmp_path: Path) -> None:
    folder = folder_of(tmp_path, flagged(padding))
    clip = to_clip(read(folder, "train/000000"), embodiment())
    assert len(clip) == COUNT - 1 and clip.flags["padded_steps"] == 1
    np.testing.assert_array_equal(clip.actions[:, :2].ravel(), np.arange(1, 2 * COUNT - 1))
    assert clip.frames_at("primary" if "primary" in clip.frame_indices else "top", np.arange(7)).shape[0] == 7
    found = open_source("rlds").inspect(folder)
    assert found.problems == ()
    (said,) = [one.message for one in found.findings if one.check == "padding"]
    assert "action/move" in said and "is_last" in said
    assert not [one for one in examine(folder) if one.severity == "error"]
    assert "is_last" in parse_yaml(infer(str(folder), "x"), "x")["provenance"]["last_step"]


@pytest.mark.parametrize(
    "item",
    [
        flagged(),  # a last action of its own
        flagged((0.0, 3.0)),
        flagged((0.0, 0.0), last=()),  # zeros that no flag calls padding
    ],
)
def test_a_last_action_that_is_no_padding_is_kept(item: dict, tmp_path: Path) -> None:
    clip = to_clip(read(folder_of(tmp_path, item), "train/000000"), embodiment())
    assert len(clip) == COUNT and "padded_steps" not in clip.flags


def test_nan_within_an_episode_is_no_padding(tmp_path: Path) -> None:
    item = flagged((np.nan, np.nan))
    item["steps/action/move"][4] = np.nan
    with pytest.raises(EpisodeError, match="not finite at frame 2"):
        to_clip(read(folder_of(tmp_path, item), "train/000000"), embodiment())


def test_a_record_of_two_episodes_is_refused_with_the_step(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, flagged(first=(0, 5), last=(4, 7)), flagged())
    with pytest.raises(EpisodeError, match="is_first again at step 5: the record holds 2 episodes"):
        read(folder, "train/000000")
    assert len(to_clip(read(folder, "train/000001"), embodiment())) == COUNT
    assert any("is_first again at step 5" in one for one in open_source("rlds").inspect(folder).problems)


def test_flags_that_are_set_at_every_step_say_nothing(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, flagged(first=range(COUNT)))
    assert len(to_clip(read(folder, "train/000000"), embodiment())) == COUNT
