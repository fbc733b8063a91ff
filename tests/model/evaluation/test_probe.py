"""The probe reads places off pictures whose state is known, and wholeness tells what is missing."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from hma_data.lab import pusht, truth
from hma_data.lab.family.look import SIZE
from hma_data.lab.simulator import LabSimulator
from hma_model.evaluation.probe import Probe, TeeFinder, fit, state_errors
from recipes.bench.drift import wholeness

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
def probe() -> Probe:
    return fit(*scenes(150, 0), driven=2, steps=50)


def test_places_are_read_to_a_pixel_or_two_off_other_pictures(probe):
    pictures, parts = scenes(40, 1)
    errors = state_errors(probe, pictures, parts)
    assert errors.mean() < 2.0
    assert probe.error.mean() == pytest.approx(errors.mean(), abs=1.5)
    assert list(probe.own) == [0, 1] and list(replace(probe, driven=1).loose) == [1]


def test_an_error_is_the_distance_from_the_true_place(probe):
    pictures, parts = scenes(8, 2)
    moved = parts.reshape(2, 4, 2, 2) + np.array([30, 40])
    errors = state_errors(probe, pictures.reshape(2, 4, *pictures.shape[1:]), moved)
    assert errors.shape == (2, 4, 2)
    assert errors.mean() == pytest.approx(50, abs=3)


def test_what_does_not_move_or_cannot_be_read_is_no_part_of_the_state():
    pictures, parts = scenes(100, 3)
    parts[:, 0] = (20, 30)  # as of a disc that stands still
    parts[:, 1] = np.random.default_rng(4).uniform(0, SIZE, (100, 2))  # as of one that is not in the picture
    found = fit(pictures, parts, driven=1, steps=20)
    assert not found.readable.any()


def test_wholeness_falls_with_what_is_lost_and_not_with_what_moves(probe):
    here, there = np.array([[30.0, 30], [90, 90]]), np.array([[90.0, 40], [30, 100]])
    truth = np.stack([scene(here)] * 3)
    found = wholeness(probe, np.stack([scene(here), scene(there), scene(here[:1])]), truth)
    np.testing.assert_allclose(found, [1.0, 1.0, 0.5], atol=0.07)


def test_the_same_seed_gives_the_same_probe():
    pictures, parts = scenes(60, 5)
    one, other = (fit(pictures, parts, driven=2, steps=3, seed=7).read(pictures[:4]) for _ in range(2))
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("robot", truth.PUSHERS)
@pytest.mark.parametrize("seed", [0, 1])
def test_the_tee_of_a_picture_is_found_to_a_pixel(robot: str, seed: int) -> None:
    finder, simulator = TeeFinder.of(robot), LabSimulator(robot)
    assert finder is not None
    for number in range(12):
        simulator.reset(seed, number)
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


def test_the_middles_of_the_bars_lie_within_the_tee() -> None:
    finder = TeeFinder.of("pusht_slow")
    assert finder is not None
    simulator = LabSimulator("pusht_slow")
    simulator.reset(3, 2)
    _, parts = truth.parts_of(simulator.simulation)
    (within,) = finder.within(parts[None])
    np.testing.assert_allclose(within[0], parts[0])
    pose = pusht.tee_pose(parts[1:])
    arena = within[1:] / pusht.PX - pose[:2]
    c, s = np.cos(pose[2]), np.sin(pose[2])
    assert (pusht.tee().distance(arena @ np.array([[c, -s], [s, c]])) < -10).all()
