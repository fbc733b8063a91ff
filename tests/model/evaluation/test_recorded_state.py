"""The recorded state of any robot is read off pictures, and rollouts are compared with it."""

from functools import partial
from typing import Any

import h5py
import numpy as np
import pytest
import torch

from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import ShardSet
from hma_model.evaluation import recorded_state
from hma_model.evaluation.losses import windows
from hma_model.evaluation.recorded_state import Reader, learn, measure_recorded_state
from tests.conftest import BlockTokenizer
from tests.model.evaluation.test_probe import scenes

PROMPT, STEPS = 2, 100
YAML = """
id: disc
kind: simulation
frequency_hz: 10
target_hz: 5
action: {space: base_velocity, components: [{key: actions, dims: 2}]}
state:
  components:
    - {key: obs/place, dims: 2, names: [x, y], unit: px}
    - {key: obs/noise, dims: 1, names: [unseen]}
    - {key: obs/still, dims: 1, names: [still]}
cameras: [{name: top, key: obs/image}]
source: {format: hdf5}
"""


@pytest.fixture(scope="module")
def disc(tmp_path_factory: pytest.TempPathFactory) -> ShardSet:
    """A square of 16 px that goes over a picture of 64, with its place, a random value and a constant."""
    folder, rng = tmp_path_factory.mktemp("disc"), np.random.default_rng(0)
    with h5py.File(folder / "disc.hdf5", "w") as file:
        for number in range(30):
            places = np.cumsum(
                np.concatenate([rng.integers(0, 7, (1, 2)), rng.integers(-1, 2, (39, 2))]), axis=0
            )
            places = np.abs((places + 6) % 12 - 6)  # reflected at the walls, in blocks of 8 px
            pictures = np.full((40, 64, 64, 3), 34, np.uint8)
            for picture, (x, y) in zip(pictures, 8 * places, strict=True):
                picture[y : y + 16, x : x + 16] = (255, 51, 51)
            demo = file.create_group(f"data/demo_{number}")
            demo["actions"] = np.diff(places, axis=0, append=places[-1:]).astype(np.float32)
            demo["obs/image"], demo["obs/place"] = pictures, 8 * places + 8.0
            demo["obs/noise"], demo["obs/still"] = rng.normal(size=(40, 1)), np.ones((40, 1))
    robot = Embodiment.from_yaml(YAML)
    convert(
        robot, folder / "disc.hdf5", BlockTokenizer(), folder / "shards", settings=Settings(val_fraction=0.2)
    )
    return ShardSet(folder / "shards")


@pytest.mark.slow
def test_what_is_in_the_picture_is_read_and_the_rest_is_left_out() -> None:
    pictures, parts = scenes(400, 0)
    noise = np.random.default_rng(1).normal(size=(len(parts), 1))
    states = np.concatenate([parts[:, 0] / 1000, noise, np.ones_like(noise)], axis=1)  # metres, say
    reader = learn(pictures, states, steps=STEPS)
    assert reader.readable.tolist() == [0, 1]
    assert (reader.error[:2] < 0.25).all() and reader.error[2] > 0.6
    moved = states + np.array([reader.std[0], 0, 0, 0])
    grown = (reader.errors(pictures, moved) - reader.errors(pictures, states)).mean(axis=0)
    assert grown[0] == pytest.approx(1, abs=0.3) and grown[1] == 0  # errors are in standard deviations
    read = reader.read(pictures)
    assert np.abs(read[:, 0] - states[:, 0]).mean() < 0.25 * reader.std[0]  # in the unit of the value
    assert (read[:, 2:] == reader.mean[2:]).all()  # of what is not seen the mean
    assert (read <= states.max(axis=0)).all() and (read >= states.min(axis=0)).all()


@pytest.mark.slow
def test_errors_are_of_the_recorded_steps(disc: ShardSet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorded_state, "learn", partial(learn, steps=STEPS))
    batches = list(windows(disc, "val", 8, 12))
    ahead = [batch.tokens[:, PROMPT:] for batch in batches]  # type: ignore[index]
    made = {"true": ahead, "shuffled": [tokens.roll(1, 0) for tokens in ahead]}
    found, last = measure_recorded_state(
        BlockTokenizer(), disc, batches, made, prompt=PROMPT, cameras="first"
    )
    assert (found["read"], found["of"]) == (2, 4)
    assert [(row["name"], row["unit"]) for row in found["values"]] == [("x", "px"), ("y", "px")]
    assert found["true"] == found["reconstruction"]  # the prediction is the truth
    assert found["true"]["error_sd"] < 0.4 < found["copy"]["error_sd_last"]
    assert found["true"]["error_sd"] == pytest.approx(found["reader_sd"], abs=0.15)
    assert found["shuffled"]["error_sd"] > found["true"]["error_sd"] + 0.4
    assert len(found["true"]["error_sd_by_frame"]) == 6 and last.shape == (12,)
    assert last.mean() == pytest.approx(found["true"]["error_sd_last"], abs=1e-3)
    # the error of a copy grows with the steps since the prompt, so states and pictures are of one time
    assert found["copy"]["error_sd_by_frame"][0] < found["copy"]["error_sd_by_frame"][-1]


def exact(*_: Any, **__: Any) -> Reader:
    one = np.ones(4)
    return Reader(recorded_state.StateNetwork(len(one)), one, one, one, one, 0 * one, one)


def test_a_prediction_that_is_not_finite_has_no_error(disc, monkeypatch) -> None:
    monkeypatch.setattr(recorded_state, "learn", exact)
    monkeypatch.setattr(Reader, "errors", lambda self, pictures, states: 0 * states)
    batches = list(windows(disc, "val", 8, 12))
    made = [batch.tokens[:, PROMPT:].double() for batch in batches]  # type: ignore[index]
    made[0][0, -1] = torch.nan
    plain = BlockTokenizer()
    plain.decode = lambda tokens: BlockTokenizer().decode(tokens.astype(np.uint32))  # type: ignore[method-assign]
    found, _ = measure_recorded_state(plain, disc, batches, {"true": made}, prompt=PROMPT, cameras="first")
    assert found["windows"] == 12 and found["copy"]["error_sd"] == 0
    assert found["true"]["error_sd_last"] is None and found["true"]["error_sd_by_frame"][0] == 0


def test_a_set_whose_states_are_all_unknown_in_part_has_no_reader(disc, monkeypatch) -> None:
    unknown = np.array([0.0, np.nan, 0.0, 0.0])
    monkeypatch.setattr(
        recorded_state._States, "of", lambda _, batch, frames: np.full((len(batch), frames, 4), unknown)
    )
    assert recorded_state.recorded_reader(BlockTokenizer(), disc, "first", 0) is None
    batches = list(windows(disc, "val", 8, 4))
    made = {"true": [batch.tokens[:, PROMPT:] for batch in batches]}  # type: ignore[index]
    found, last = measure_recorded_state(
        BlockTokenizer(), disc, batches, made, prompt=PROMPT, cameras="first"
    )
    assert found["missing"] == "the states of the training split are unknown in part"
    assert np.isnan(last).all()


def test_what_cannot_be_read_off_the_windows_own_pictures_is_left_out(disc, monkeypatch) -> None:
    monkeypatch.setattr(recorded_state, "learn", exact)
    monkeypatch.setattr(Reader, "errors", lambda self, pictures, states: 0 * states + [0.1, 0.6, 0.7, 0.8])
    batches = list(windows(disc, "val", 8, 12))
    made = {"true": [batch.tokens[:, PROMPT:] for batch in batches]}  # type: ignore[index]
    found, _ = measure_recorded_state(BlockTokenizer(), disc, batches, made, prompt=PROMPT, cameras="first")
    assert [row["name"] for row in found["values"]] == ["x"] and found["copy"]["error_sd"] == pytest.approx(
        0.1
    )
    monkeypatch.setattr(Reader, "errors", lambda self, pictures, states: 0 * states + 0.6)
    found, last = measure_recorded_state(
        BlockTokenizer(), disc, batches, made, prompt=PROMPT, cameras="first"
    )
    assert "no recorded state can be estimated" in found["missing"] and np.isnan(last).all()


def test_too_few_episodes_are_said(disc: ShardSet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorded_state, "EPISODES_NEEDED", 100)
    found, last = measure_recorded_state(
        BlockTokenizer(), disc, list(windows(disc, "val", 8, 12)), {}, prompt=PROMPT, cameras="first"
    )
    assert "too few to read their states, 100 are needed" in found["missing"]
    assert np.isnan(last).all() and last.shape == (12,)
