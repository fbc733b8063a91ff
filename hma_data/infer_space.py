"""Action spaces and names of values, where keys, message types or a controller's name state them."""

import re
from collections.abc import Iterable, Mapping

from hma_data.infer_words import CARTESIAN, JOINT, MOTION, PLACE, ROTATION, dims, is_gripper, snake, words
from hma_data.sources.base import KeyInfo

_DELTA = frozenset(("delta", "deltas", "rel", "relative"))
_CONTROLLERS = {  # robosuite's, where they take changes; a gripper's value follows
    "OSC_POSE": ("eef_delta", ("dx", "dy", "dz", "drx", "dry", "drz")),
    "OSC_POSITION": ("eef_delta", ("dx", "dy", "dz")),
    "IK_POSE": ("eef_delta", ("dx", "dy", "dz", "drx", "dry", "drz")),
    "JOINT_POSITION": ("joint_delta", ()),
    "JOINT_VELOCITY": ("joint_velocity", ()),
}
_ABSOLUTE = {
    "OSC_POSE": ("eef_pose", ("x", "y", "z", "rx", "ry", "rz")),
    "OSC_POSITION": ("eef_pose", ("x", "y", "z")),
    "JOINT_POSITION": ("joint_position", ()),
}


def _controller(facts: Mapping[str, str]) -> tuple[str | None, tuple[str, ...]]:
    name, _, absolute = facts.get("controller", "").partition(" ")
    return (_ABSOLUTE if absolute else _CONTROLLERS).get(name, (None, ()))


def names_of(key: KeyInfo, facts: Mapping[str, str]) -> tuple[str, ...] | None:
    """Names of an action's values by the controller that takes them; None where it does not say."""
    names = _controller(facts)[1]
    if not names or snake(key.key) not in ("action", "actions"):
        return None
    return {len(names): names, len(names) + 1: (*names, "gripper")}.get(dims(key))


def space_of(keys: Iterable[KeyInfo], facts: Mapping[str, str]) -> str | None:
    """The action's space where it is stated; None where it would be a guess."""
    keys = list(keys)
    stated = _controller(facts)[0]
    if stated and all(snake(key.key) in ("action", "actions") for key in keys):
        return stated
    arms = [key for key in keys if not is_gripper(key.key)]
    moved = any(
        {"rotation", "delta"} <= set(words(key.key)) for key in keys
    )  # a world_vector beside it is a step
    spaces = {
        "eef_delta" if moved and snake(key.key).endswith("world_vector") else _space(key) for key in arms
    }
    if not spaces or None in spaces:
        return None
    return spaces.pop() if len(spaces) == 1 else "mixed"


def _space(key: KeyInfo) -> str | None:
    said, text = set(words(key.key)), snake(key.key)
    if key.topic and re.search(r"Joint(State|Trajectory)$", key.topic.type):
        said = said | {"joint"}
    if "cmd_vel" in text or "cmdvel" in text or "base_velocity" in text:
        return "base_velocity"
    if "base" in said:
        return "base_velocity" if said & MOTION else None
    if said & JOINT and not said & CARTESIAN:
        if said & _DELTA:
            return "joint_delta"
        return "joint_position" if said & PLACE else "joint_velocity" if said & MOTION else _by_names(key)
    if said & _DELTA and said & (ROTATION | CARTESIAN):
        return "eef_delta"
    if said & CARTESIAN and said & (PLACE | ROTATION):
        return "eef_pose"
    return _by_names(key)


def _by_names(key: KeyInfo) -> str | None:
    """By names such as shoulder_pan.pos and delta_x; grippers aside."""
    names = [name for name in key.names or () if not is_gripper(name)]
    if names and all(re.search(r"(delta_|(^|_)d)([xyz]|roll|pitch|yaw)$", name) for name in names):
        return "eef_delta"
    joints = {"shoulder", "elbow", "wrist", "waist", "forearm", "joint", "hip", "knee", "ankle"}
    if not names or not all(joints & set(words(name)) for name in names):
        return None
    for ending, space in ((".pos", "joint_position"), (".vel", "joint_velocity")):
        if all(name.endswith(ending) for name in names):
            return space
    return None
