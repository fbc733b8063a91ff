"""Find the frames of an episode in which nothing moves, by its numbers.

A frame is idle where no value of its action or state has moved since the last frame that was kept. A command
that is a motion by itself (a delta, a velocity) has moved where it is not near zero. Where a mixed action
space leaves open whether a command is a place or a motion, it has moved in both cases: a frame too many is
kept.

A value has moved by more than `STILL` of the widest range that a value of its component has in the episode,
and by more than `NOISE` in its own unit; a motion is not near zero above `STILL` of the component's largest.
The first frame and frames with unknown numbers are kept. Frames are compared with the last one kept, so that
of slow motion every few frames are left instead of none.

T frames, A values.
"""

import numpy as np

from hma_data.arrays import Bools, Float32s, Floats, Ints
from hma_data.episodes.episode import Clip
from hma_data.registry.components import Action, Component, Vector
from hma_data.registry.embodiment import Embodiment

STILL = 0.005
NOISE = 0.001
# Action spaces whose commands are motions; in a mixed one, those in a unit a second are, and
# others may be; a torque moves a robot or holds it.
MOTIONS = ("eef_delta", "joint_delta", "joint_velocity", "base_velocity")


def idle_frames(clip: Clip, embodiment: Embodiment) -> Bools:
    """Return which frames (T,) of a clip are idle."""
    values, limits = _numbers(clip, embodiment)
    idle = np.zeros(len(clip), np.bool_)
    kept = values[0]
    for frame in range(1, len(clip)):
        idle[frame] = bool((np.abs(values[frame] - kept) <= limits).all())
        if not idle[frame]:
            kept = values[frame]
    asked = _motions(clip, embodiment.action)
    idle &= ~asked
    for known in (clip.action_known, clip.state_known):
        if known is not None:
            idle &= known
    return idle


def idle_rows(clip: Clip, embodiment: Embodiment, kept: Ints, stride: int) -> Bools:
    """Return which of the rows are idle: those whose `stride` frames from `kept` (N,) on are all idle."""
    idle = idle_frames(clip, embodiment)
    return np.asarray(idle[kept[:, None] + np.arange(stride)].all(axis=1), np.bool_)


def _is_motion(part: Component, action: Action) -> bool:
    if part.gripper is not None:
        return part.gripper in ("opening_is_high", "closing_is_high")
    return action.space in MOTIONS or (part.unit or "").endswith("/s")


def _may_be_motion(part: Component, action: Action) -> bool:
    """Return whether a command is a motion, or may be one; a switch (raw values) is none."""
    unknown = action.space in ("mixed", "joint_torque") and part.gripper is None and part.normalize
    return unknown or _is_motion(part, action)


def _numbers(clip: Clip, embodiment: Embodiment) -> tuple[Floats, Floats]:
    """Return the values (T, n) of action and state that are no motions, and by how much each may change."""
    action = embodiment.action
    found = [values for part, values in _parts(clip.actions, action) if not _is_motion(part, action)]
    if embodiment.state is not None and clip.states is not None:
        found += [values for _, values in _parts(clip.states, embodiment.state)]
    none = np.zeros((len(clip), 0))  # where all values are motions
    return np.concatenate([none, *found], axis=1), np.concatenate([none[0], *map(_limits, found)])


def _limits(values: Floats) -> Floats:
    widest = float(np.ptp(values, axis=0).max())
    return np.full(values.shape[1], max(STILL * widest, NOISE))


def _motions(clip: Clip, action: Action) -> Bools:
    """Return at which frames (T,) a command that may be a motion by itself is not near zero."""
    asked = np.zeros(len(clip), np.bool_)
    for part, values in _parts(clip.actions, action):
        if _may_be_motion(part, action):
            asked |= (np.abs(values) > STILL * np.abs(values).max()).any(axis=1)
    return asked


def _parts(values: Float32s, vector: Vector) -> list[tuple[Component, Floats]]:
    return [(part, values[:, span].astype(np.float64)) for part, span in vector.spans()]
