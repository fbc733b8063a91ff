"""Interpolate rotations between two samples, by their representation.

Interpolated number by number, a quaternion between q and -q would be no rotation, and an angle between 179°
and -179° would be 0°. This module first brings neighbours to the same side; each result then has the form of
the samples beside it.

S samples, T target times, A numbers of a component. A pose of 6 or 7 numbers is a position and a rotation.
"""

import numpy as np

from hma_data.arrays import Float32s, Floats, Ints

_WIDTHS = {
    "quaternion_xyzw": 4,
    "quaternion_wxyz": 4,
    "euler_xyz": 3,
    "axis_angle": 3,
    "rotation_6d": 6,
    "rotation_matrix": 9,
}
_DEGREES = ("deg", "degree", "degrees", "°")


def between(
    source_times: Floats, values: Float32s, target_times: Floats, representation: str, unit: str | None = None
) -> Float32s:
    """Return the values (T, A) of a component between its samples.

    Args:
        source_times: (S,) ascending.
        values: (S, A).
        target_times: (T,).
        representation: as in the YAML; a component of any other width is interpolated number by number.
        unit: of angles, rad unless it says degrees.
    """
    width = _WIDTHS[representation]
    place = 3 if values.shape[1] == width + 3 and representation != "rotation_matrix" else 0
    rows = values.astype(np.float64)
    found = linear(source_times, rows, target_times)
    if values.shape[1] - place == width:
        period = 360.0 if (unit or "").strip().lower() in _DEGREES else 2 * np.pi
        turned = rows[:, place:]
        if representation == "euler_xyz":
            found[:, place:] = _angles(source_times, turned, target_times, period)
        elif representation == "axis_angle":
            found[:, place:] = _axis_angle(source_times, turned, target_times, period)
        elif width == 4:
            found[:, place:] = _quaternions(source_times, turned, target_times)
        elif representation == "rotation_matrix":
            found = _nearest_rotation(found)
    return found.astype(np.float32)


def linear(source_times: Floats, values: Floats, target_times: Floats) -> Floats:
    """Return values (T, A) between samples (S, A), number by number."""
    return np.stack([np.interp(target_times, source_times, column) for column in values.T], axis=1)


def _quaternions(source_times: Floats, values: Floats, target_times: Floats) -> Floats:
    """Interpolate quaternions evenly along the shorter arc, with continuous sign.

    Their lengths are interpolated too; they are 1 where the samples have length 1.
    """
    # q and -q are one rotation: flip signs until each sample is on the side of the one before it.
    turns = np.where((values[1:] * values[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    steady = values * np.cumprod(np.concatenate([[1.0], turns]))[:, None]
    lengths = np.linalg.norm(values, axis=1)
    last = len(values) - 1
    before = np.clip(np.searchsorted(source_times, target_times, side="right") - 1, 0, last)
    after = np.minimum(before + 1, last)
    share = (
        linear(source_times, np.arange(len(values), dtype=np.float64)[:, None], target_times)[:, 0] - before
    )
    units = _directions(steady)
    arc = np.arccos(np.clip((units[before] * units[after]).sum(axis=1), -1, 1))
    # On a very short arc the sine vanishes; the straight line is as good there.
    bent = (arc > 1e-4) & (lengths[before] > 0) & (lengths[after] > 0)
    sine = np.where(bent, np.sin(arc), 1)
    one = np.where(bent, np.sin((1 - share) * arc) / sine, 1 - share)
    other = np.where(bent, np.sin(share * arc) / sine, share)
    mixed = _directions(one[:, None] * units[before] + other[:, None] * units[after])
    return mixed * ((1 - share) * lengths[before] + share * lengths[after])[:, None]


def _angles(source_times: Floats, values: Floats, target_times: Floats, period: float) -> Floats:
    """Interpolate angles along the shorter arc.

    Results lie in -half to half a period, or in 0 to one period, where all samples do.
    """
    steady: Floats = np.unwrap(values, period=period, axis=0).astype(np.float64)
    at = _index_of_nearest(source_times, target_times)
    # Unwrapping has added whole turns; those of the nearest sample are taken off again.
    found = linear(source_times, steady, target_times) - (steady - values)[at]
    lowest, highest = values.min(axis=0), values.max(axis=0)
    slack = 1e-3 * period
    for column in range(values.shape[1]):
        for low, high in ((-period / 2, period / 2), (0.0, period)):
            if low - slack <= lowest[column] and highest[column] <= high + slack:
                one = found[:, column]
                one[one > max(high, highest[column])] -= period
                one[one < min(low, lowest[column])] += period
                break
    return found


def _axis_angle(source_times: Floats, values: Floats, target_times: Floats, period: float) -> Floats:
    """Interpolate axis-angle vectors as quaternions.

    Of the vectors that stand for one rotation, return the one closest to the sample nearest in time.
    """
    scale = 2 * np.pi / period
    angle = np.linalg.norm(values, axis=1, keepdims=True) * scale
    half = np.sinc(angle / (2 * np.pi)) / 2  # sin(angle/2) / angle, 1/2 at 0
    quaternions = np.concatenate([values * scale * half, np.cos(angle / 2)], axis=1)
    mixed = _quaternions(source_times, quaternions, target_times)
    mixed = np.where(mixed[:, 3:] < 0, -mixed, mixed)  # so that the angle is at most half a turn
    sine = np.linalg.norm(mixed[:, :3], axis=1, keepdims=True)
    angle = 2 * np.arctan2(sine, mixed[:, 3:])
    beside = values[_index_of_nearest(source_times, target_times)]
    axis = np.where(sine > 1e-9, mixed[:, :3] / np.where(sine > 1e-9, sine, 1), _directions(beside))
    turns = np.round(((beside * scale * axis).sum(axis=1, keepdims=True) - angle) / (2 * np.pi))
    return axis * (angle + 2 * np.pi * turns) / scale


def _directions(vectors: Floats) -> Floats:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)


def _nearest_rotation(values: Floats) -> Floats:
    """Make matrices (T, 9) orthogonal again; matrices that are no rotations stay as they are."""
    matrices = values.reshape(-1, 3, 3)
    if not np.isfinite(matrices).all():
        return values
    left, sizes, right = np.linalg.svd(matrices)
    whole = (sizes[:, -1] > 1e-3) & (np.linalg.det(matrices) > 0)
    return np.where(whole[:, None, None], left @ right, matrices).reshape(-1, 9)


def _index_of_nearest(source_times: Floats, target_times: Floats) -> Ints:
    after = np.clip(np.searchsorted(source_times, target_times), 0, len(source_times) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(source_times[after] - target_times) <= np.abs(source_times[before] - target_times)
    return np.where(nearer, after, before)
