"""Rotations between samples, against spherical interpolation by another implementation."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hma_data.episodes.align import to_clip
from hma_data.episodes.episode import Episode, Pictures, Signal
from hma_data.episodes.rotations import between
from hma_data.registry.embodiment import Embodiment

SAMPLES = np.arange(6, dtype=float)
TARGETS = np.sort(np.concatenate([SAMPLES, np.linspace(0.1, 4.9, 23)]))


def matrix(quaternion: np.ndarray) -> np.ndarray:
    x, y, z, w = np.moveaxis(quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), [0, 1], [-2, -1])


def about(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    half = np.asarray(angle)[..., None] / 2
    return np.concatenate([axis * np.sin(half), np.cos(half) * np.ones_like(half)], axis=-1)


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    trace = np.trace(np.swapaxes(a, -1, -2) @ b, axis1=-2, axis2=-1)
    return np.arccos(np.clip((trace - 1) / 2, -1, 1))


@st.composite
def turning(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    """An axis (3,) and angles (6,) that change by at most 1 rad a sample."""
    seed = draw(st.integers(0, 10_000))
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    return axis / np.linalg.norm(axis), np.cumsum(rng.uniform(-1, 1, 6)) + rng.uniform(-6, 6)


@given(turning(), st.lists(st.sampled_from([-1.0, 1.0]), min_size=6, max_size=6), st.booleans())
def test_quaternions_turn_along_the_shorter_arc_whatever_their_signs(turn, signs, w_first) -> None:
    axis, angles = turn
    values = about(axis, angles) * np.array(signs)[:, None]
    name = "quaternion_wxyz" if w_first else "quaternion_xyzw"
    order = [3, 0, 1, 2] if w_first else [0, 1, 2, 3]
    found = between(SAMPLES, values[:, order].astype(np.float32), TARGETS, name)[:, np.argsort(order)]
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-6)
    true = matrix(about(axis, np.interp(TARGETS, SAMPLES, angles)))
    assert angle_between(matrix(found.astype(float)), true).max() < 2e-3
    assert ((found[1:] * found[:-1]).sum(axis=1) > 0).all()
    at = np.isin(TARGETS, SAMPLES)
    np.testing.assert_allclose(np.abs((found[at] * values).sum(axis=1)), 1, atol=1e-6)


@given(turning())
def test_axis_angle_turns_along_the_shorter_arc_and_keeps_its_samples(turn) -> None:
    axis, angles = turn
    wrapped = (angles + np.pi) % (2 * np.pi) - np.pi  # of length 0 to pi, jumping to the other end
    values = (axis * wrapped[:, None]).astype(np.float32)
    found = between(SAMPLES, values, TARGETS, "axis_angle").astype(float)
    length = np.linalg.norm(found, axis=1)
    direction = found / np.maximum(length, 1e-9)[:, None]
    true = matrix(about(axis, np.interp(TARGETS, SAMPLES, angles)))
    assert angle_between(matrix(about(direction, length)), true).max() < 2e-3
    np.testing.assert_allclose(found[np.isin(TARGETS, SAMPLES)], values, atol=1e-5)


@given(turning(), st.sampled_from([(-np.pi, "rad"), (0.0, "rad"), (-180.0, "deg"), (0.0, None)]))
def test_angles_go_over_the_seam_and_stay_in_their_range(turn, convention) -> None:
    low, unit = convention
    period = 360.0 if unit == "deg" else 2 * np.pi
    angles = turn[1][:, None] * np.array([1, -0.5, 0.3]) * period / (2 * np.pi)
    values = ((angles - low) % period + low).astype(np.float32)
    found = between(SAMPLES, values, TARGETS, "euler_xyz", unit)
    true = np.stack([np.interp(TARGETS, SAMPLES, column) for column in angles.T], axis=1)
    away = (found - true + period / 2) % period - period / 2
    np.testing.assert_allclose(away, 0, atol=1e-4 * period)
    in_half = -period / 2 - 1e-3 <= values.min() and values.max() <= period / 2 + 1e-3
    lowest = -period / 2 if in_half else low
    assert lowest - 1e-3 * period <= found.min() and found.max() <= lowest + period * 1.001
    np.testing.assert_allclose(found[np.isin(TARGETS, SAMPLES)], values, atol=1e-5 * period)


def test_angles_that_never_jump_are_interpolated_as_any_number() -> None:
    steps = np.linspace([0, -3, 2], [2.5, 0.4, 3], 6).astype(np.float32)
    plain = np.stack([np.interp(TARGETS, SAMPLES, column) for column in steps.T], axis=1)
    np.testing.assert_allclose(between(SAMPLES, steps, TARGETS, "euler_xyz"), plain, atol=1e-6)


def test_a_matrix_between_two_is_a_rotation() -> None:
    angles = np.array([0, 1, 1.9, 2.0, 1.0, 0.2])
    axis = np.array([0.6, 0.0, 0.8])
    values = matrix(about(axis, angles)).reshape(6, 9).astype(np.float32)
    found = between(SAMPLES, values, TARGETS, "rotation_matrix").reshape(-1, 3, 3).astype(float)
    np.testing.assert_allclose(
        found @ np.swapaxes(found, 1, 2), np.eye(3) * np.ones((len(found), 1, 1)), atol=1e-5
    )
    true = matrix(about(axis, np.interp(TARGETS, SAMPLES, angles)))
    assert angle_between(found, true).max() < 0.02  # of arcs up to 1 rad


@pytest.mark.parametrize("name", ["quaternion_xyzw", "euler_xyz", "axis_angle"])
def test_the_place_of_a_pose_is_interpolated_as_any_number(name: str) -> None:
    rng = np.random.default_rng(0)
    turned = about(np.array([0.0, 0, 1]), rng.uniform(-3, 3, 6))
    turned = turned if name == "quaternion_xyzw" else rng.uniform(-1, 1, (6, 3))
    places = rng.normal(size=(6, 3))
    pose = np.concatenate([places, turned], axis=1).astype(np.float32)
    found = between(SAMPLES, pose, TARGETS, name)
    plain = np.stack([np.interp(TARGETS, SAMPLES, column) for column in places.T], axis=1)
    np.testing.assert_allclose(found[:, :3], plain, atol=1e-6)
    np.testing.assert_allclose(
        found[:, 3:], between(SAMPLES, turned.astype(np.float32), TARGETS, name), atol=1e-6
    )


@pytest.mark.parametrize(
    "name", ["quaternion_xyzw", "euler_xyz", "axis_angle", "rotation_6d", "rotation_matrix"]
)
@pytest.mark.parametrize("width", [1, 2, 5, 8])
def test_a_component_of_another_width_is_taken_number_by_number(name: str, width: int) -> None:
    values = np.random.default_rng(1).normal(size=(6, width)).astype(np.float32)
    plain = np.stack([np.interp(TARGETS, SAMPLES, column) for column in values.T], axis=1)
    np.testing.assert_allclose(between(SAMPLES, values, TARGETS, name), plain, atol=1e-6)


@pytest.mark.parametrize("name", ["quaternion_xyzw", "euler_xyz", "axis_angle", "rotation_matrix"])
def test_zeros_and_a_single_sample_stay_what_they_are(name: str) -> None:
    width = {"quaternion_xyzw": 4, "rotation_matrix": 9}.get(name, 3)
    zeros = np.zeros((6, width), np.float32)
    np.testing.assert_array_equal(between(SAMPLES, zeros, TARGETS, name), np.zeros((len(TARGETS), width)))
    one = np.full((1, width), 0.5, np.float32)
    np.testing.assert_allclose(between(SAMPLES[:1], one, TARGETS, name), 0.5 * np.ones((len(TARGETS), width)))


def test_a_clip_interpolates_each_component_by_its_representation() -> None:
    robot = Embodiment.from_values(
        {
            "id": "turner",
            "kind": "real",
            "frequency_hz": 10,
            "action": {"space": "mixed", "components": [{"key": "/a.x", "dims": 1}]},
            "state": {
                "components": [
                    {"key": "/s.x", "dims": 1},
                    {"key": "/s.rpy", "dims": 3, "representation": "euler_xyz"},
                    {"key": "/s.other", "dims": 3},
                ]
            },
            "cameras": [{"name": "front", "key": "/front"}],
            "source": {"format": "rosbag"},
        },
        "test",
    )
    clock = np.array([0.0, 1.0])
    rpy = np.array([[3.1, 0, 0], [-3.1, 0, 0]], np.float32)
    grid = np.array([0.0, 0.25, 0.75, 1.0])
    picture = Pictures(grid, lambda i: np.zeros((2, 2, 3), np.uint8))
    parts = (Signal(clock, rpy[:, :1]), Signal(clock, rpy), Signal(clock, rpy))
    for states in (parts, (Signal(clock, np.concatenate([part.values for part in parts], axis=1)),)):
        run = Episode("e", {"front": picture}, (Signal(grid, np.zeros((4, 1), np.float32)),), states, False)
        found = to_clip(run, robot).states
        quarter = 3.1 + (np.pi - 3.1) / 2
        np.testing.assert_allclose(found[:, 1], [3.1, quarter, -quarter, -3.1], atol=1e-6)
        np.testing.assert_allclose(found[:, [0, 4]], [[x] * 2 for x in (3.1, 1.55, -1.55, -3.1)], atol=1e-6)
