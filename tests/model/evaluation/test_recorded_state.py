"""The recorded state of any robot is read off pictures, and rollouts are compared with it."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import torch

from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.lab import truth
from hma_data.lab.family.look import SIZE
from hma_data.lab.simulator import LabSimulator
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import ShardSet
from hma_model.evaluation import probe as probe_module
from hma_model.evaluation import recorded_state
from hma_model.evaluation.losses import windows
from hma_model.evaluation.probe import Probe, TeeFinder, fit, state_errors
from hma_model.evaluation.recorded_state import Reader, learn, measure_recorded_state
from recipes.bench.drift import wholeness
from tests.conftest import BlockTokenizer

PROMPT = 2
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


@pytest.fixture(autouse=True, scope="module")
def short() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recorded_state, "TRAINING_STEPS", 100)
        patch.setattr(probe_module, "TRAINING_STEPS", 50)
        yield


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


def measured(disc: ShardSet, batches: Any, made: Any = None, tokenizer: Any = None) -> Any:
    """Measure predictions, which are the truth where none are given."""
    made = made or {"true": [batch.tokens[:, PROMPT:] for batch in batches]}
    given: Any = {"prompt": PROMPT, "cameras": "first"}
    return measure_recorded_state(tokenizer or BlockTokenizer(), disc, batches, made, **given)


@pytest.mark.slow
def test_what_is_in_the_picture_is_read_and_the_rest_is_left_out() -> None:
    pictures, parts = scenes(400, 0)
    noise = np.random.default_rng(1).normal(size=(len(parts), 1))
    states = np.concatenate([parts[:, 0] / 1000, noise, np.ones_like(noise)], axis=1)  # metres, say
    reader = learn(pictures, states, np.arange(len(parts)) // 20)
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
def test_errors_are_of_the_recorded_steps(disc: ShardSet) -> None:
    batches = list(windows(disc, "val", 8, 12))
    ahead = [batch.tokens[:, PROMPT:] for batch in batches]  # type: ignore[index]
    made = {"true": ahead, "shuffled": [tokens.roll(1, 0) for tokens in ahead]}
    found, last = measured(disc, batches, made)
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


@pytest.mark.parametrize(
    ("counts", "fitted"), [((9, 5, 5, 1), {0, 1}), ((10, 10, 10, 10, 10), {0, 1, 2, 3}), ((2, 40), {0})]
)
def test_the_error_is_of_whole_recordings_that_are_not_learned_from(counts, fitted, monkeypatch) -> None:
    own = np.arange(len(counts)).repeat(counts)
    seen = list[np.ndarray]()

    def trained(make: Any, small: np.ndarray, *_: Any) -> Any:
        seen.append(small)
        return make().eval()

    monkeypatch.setattr(recorded_state, "trained", trained)
    pictures = np.broadcast_to(own[:, None, None, None], (len(own), 64, 64, 3)).astype(np.uint8)
    learn(pictures, own[:, None] * 1.0, own)
    assert set(np.unique(seen)) == fitted and len(seen[0]) == sum(counts[: len(fitted)])


def test_the_reader_of_a_set_learns_from_some_of_its_recordings(disc, monkeypatch) -> None:
    given = list[np.ndarray]()

    def kept(pictures: np.ndarray, states: np.ndarray, recordings: np.ndarray, *_: Any, **__: Any) -> Reader:
        given.append(recordings)
        return exact()

    monkeypatch.setattr(recorded_state, "learn", kept)
    assert recorded_state.recorded_reader(BlockTokenizer(), disc, "first", 0) is not None
    assert len(np.unique(given[0])) == disc.manifest.splits["train"]["episodes"]
    monkeypatch.setattr(ShardSet, "recordings", lambda self, episodes: np.zeros(len(episodes), np.int64))
    assert recorded_state.recorded_reader(BlockTokenizer(), disc, "first", 0) is None  # all of one recording


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
    found, _ = measured(disc, batches, {"true": made}, plain)
    assert found["windows"] == 12 and found["copy"]["error_sd"] == 0
    assert found["true"]["error_sd_last"] is None and found["true"]["error_sd_by_frame"][0] == 0


def test_a_set_whose_states_are_all_unknown_in_part_has_no_reader(disc, monkeypatch) -> None:
    unknown = np.array([0.0, np.nan, 0.0, 0.0])
    monkeypatch.setattr(
        recorded_state, "_states", lambda _, batch, frames: np.full((len(batch), frames, 4), unknown)
    )
    assert recorded_state.recorded_reader(BlockTokenizer(), disc, "first", 0) is None
    batches = list(windows(disc, "val", 8, 4))
    found, last = measured(disc, batches)
    assert found["missing"] == "fewer than two recordings of the training split have known states"
    assert np.isnan(last).all()


def test_what_cannot_be_read_off_the_windows_own_pictures_is_left_out(disc, monkeypatch) -> None:
    monkeypatch.setattr(recorded_state, "learn", exact)
    monkeypatch.setattr(Reader, "errors", lambda self, pictures, states: 0 * states + [0.1, 0.6, 0.7, 0.8])
    batches = list(windows(disc, "val", 8, 12))
    found, _ = measured(disc, batches)
    assert [row["name"] for row in found["values"]] == ["x"] and found["copy"]["error_sd"] == pytest.approx(
        0.1
    )
    monkeypatch.setattr(Reader, "errors", lambda self, pictures, states: 0 * states + 0.6)
    found, last = measured(disc, batches)
    assert "no recorded state can be estimated" in found["missing"] and np.isnan(last).all()


def test_too_few_episodes_are_said(disc: ShardSet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorded_state, "EPISODES_NEEDED", 100)
    found, last = measured(disc, list(windows(disc, "val", 8, 12)))
    assert "too few to read their states, 100 are needed" in found["missing"]
    assert np.isnan(last).all() and last.shape == (12,)


# -- the probe


RED, BLUE, PAPER = (200, 30, 40), (40, 60, 200), (225, 225, 215)


def scene(places, colors=(RED, BLUE)):
    picture = np.full((SIZE, SIZE, 3), PAPER, np.uint8)
    for (x, y), color in zip(places, colors, strict=False):
        cv2.circle(picture, (round(x), round(y)), 9, color, -1, cv2.LINE_AA)
    return picture


def scenes(count, seed):
    parts = np.random.default_rng(seed).uniform(12, SIZE - 12, (4 * count, 2, 2))
    parts = parts[np.linalg.norm(parts[:, 0] - parts[:, 1], axis=-1) > 20][:count]
    return np.stack([scene(places) for places in parts]), parts


@pytest.fixture(scope="module")
def probe(short: None) -> Probe:
    return fit(*scenes(150, 0), driven=2)


def test_places_are_read_to_a_pixel_or_two_off_other_pictures(probe):
    pictures, parts = scenes(40, 1)
    errors = state_errors(probe, pictures, parts)
    assert errors.mean() < 2.0
    assert probe.error.mean() == pytest.approx(errors.mean(), abs=1.5)
    assert list(probe.own) == [0, 1] and list(replace(probe, driven=1).loose) == [1]


def test_what_does_not_move_or_cannot_be_read_is_no_part_of_the_state(monkeypatch):
    pictures, parts = scenes(100, 3)
    parts[:, 0] = (20, 30)  # as of a disc that stands still
    parts[:, 1] = np.random.default_rng(4).uniform(0, SIZE, (100, 2))  # as of one that is not in the picture
    monkeypatch.setattr(probe_module, "TRAINING_STEPS", 20)
    found = fit(pictures, parts, driven=1)
    assert not found.readable.any()


def test_wholeness_falls_with_what_is_lost_and_not_with_what_moves(probe):
    here, there = np.array([[30.0, 30], [90, 90]]), np.array([[90.0, 40], [30, 100]])
    truth = np.stack([scene(here)] * 3)
    found = wholeness(probe, np.stack([scene(here), scene(there), scene(here[:1])]), truth)
    np.testing.assert_allclose(found, [1.0, 1.0, 0.5], atol=0.07)


def test_the_same_seed_gives_the_same_probe(monkeypatch):
    monkeypatch.setattr(probe_module, "TRAINING_STEPS", 3)
    pictures, parts = scenes(60, 5)
    one, other = (fit(pictures, parts, driven=2, seed=7).read(pictures[:4]) for _ in range(2))
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("robot", truth.PUSHERS)
def test_the_tee_of_a_picture_is_found_to_a_pixel(robot: str) -> None:
    finder, simulator = TeeFinder.of(robot), LabSimulator(robot)
    assert finder is not None
    for number in range(12):
        simulator.reset(0, number)
        picture = simulator.picture().astype(np.float64)
        _, parts = truth.parts_of(simulator.simulation)
        x, y = (finder.within(parts[None])[0, 1] * len(picture) / truth.SIZE).astype(int)
        found = finder.find(np.linalg.norm(picture - picture[y, x], axis=-1) < 30)
        assert found is not None
        assert np.linalg.norm(found - parts[1:], axis=-1).max() < 1.5, number


def test_a_tee_of_few_pixels_is_not_found() -> None:
    finder = TeeFinder.of("pusht_fast")
    assert finder is not None and TeeFinder.of("rails_03") is None
    pixels = np.zeros((64, 64), bool)
    assert finder.find(pixels) is None
    pixels[20:24, 20:26] = True
    assert finder.find(pixels) is None
