"""The T of a pusher, found in its recorder's pictures."""

import numpy as np
import pytest

from hma_data.lab import pusht, truth
from hma_data.lab.simulator import LabSimulator
from hma_model.evaluation.probe import TeeFinder


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
