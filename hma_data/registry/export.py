"""Export an embodiment to the formats of other projects: GR00T's modality.json, LeRobotDataset features.

For a LeRobot recording, the export names the recording's own features and the places in them. For any
other recording, it names the features of the LeRobotDataset that a conversion makes: one `action` and one
`observation.state`, in the order of the components, and `observation.images.<camera>`.
"""

from typing import Any

from hma_data.registry.components import Component, Vector
from hma_data.registry.embodiment import Embodiment

DELTA_SPACES = ("eef_delta", "joint_delta")
PICTURE = (256, 256)  # where a camera's recorded size is not stated: the size to which a shard decodes
_ROTATIONS = {
    "euler_xyz": "euler_angles_rpy",
    "quaternion_xyzw": "quaternion",
    "quaternion_wxyz": "quaternion",
    "axis_angle": "axis_angle",
    "rotation_6d": "rotation_6d",
    "rotation_matrix": "matrix",
}


def modality(embodiment: Embodiment) -> dict[str, Any]:
    """Return the content of GR00T's meta/modality.json.

    Returns:
        `state` and `action`: name -> start and end in the feature `original_key`, with rotation_type,
        absolute, dtype and range; `video`: name -> original_key; `annotation`.
    """
    own = embodiment.source.format == "lerobot"
    delta = embodiment.action.space in DELTA_SPACES
    values: dict[str, Any] = {
        "state": _modalities(embodiment.state, "observation.state", own, delta=False),
        "action": _modalities(embodiment.action, "action", own, delta=delta),
        "video": {name: {"original_key": key} for name, key in camera_features(embodiment).items()},
    }
    if own or embodiment.source.instruction:
        values["annotation"] = {"human.task_description": {"original_key": "task_index"}}
    return values


def _modalities(vector: Vector | None, feature: str, own: bool, delta: bool) -> dict[str, dict[str, Any]]:
    if vector is None:
        return {}
    found: dict[str, dict[str, Any]] = {}
    names = component_names(vector)
    for name, (component, span) in zip(names, vector.spans(), strict=True):
        start = (component.slice[0] if component.slice else 0) if own else span.start
        moves = (
            delta
            if component.gripper is None
            else component.gripper in ("opening_is_high", "closing_is_high")
        )
        entry: dict[str, Any] = {
            "start": start,
            "end": start + component.dims,
            "original_key": component.key if own else feature,
            "absolute": not moves,
            "dtype": "float32",
        }
        if component.representation:
            entry["rotation_type"] = _ROTATIONS[component.representation]
        if component.range:
            entry["range"] = list(component.range)
        found[name] = entry
    return found


def component_names(vector: Vector) -> list[str]:
    """Return a short name for each component: what it moves, if the YAML states it, or the end of its key."""
    plain = [_component_name(component) for component in vector.components]
    return [
        name if plain.count(name) == 1 else f"{name}_{plain[: i + 1].count(name)}"
        for i, name in enumerate(plain)
    ]


def _component_name(component: Component) -> str:
    if component.gripper or component.names == ("gripper",):
        return "gripper" if component.dims == 1 else "hand"
    if component.representation:
        return "rotation"
    if component.unit == "m":
        return "position"
    if component.unit == "rad":
        return "joints"
    return "".join(c if c.isalnum() else "_" for c in component.key.replace(".", "/").rsplit("/", 1)[-1])


def lerobot_features(embodiment: Embodiment) -> dict[str, dict[str, Any]]:
    """Return the `features` of a LeRobotDataset (v2.1 and v3.0) that holds this embodiment's episodes.

    Returns:
        feature -> dtype, shape and names, as `LeRobotDataset.create(features=…)` takes it.
    """
    keys = camera_features(embodiment)
    features = {"action": _vector_feature(embodiment.action)}
    if embodiment.state:
        features["observation.state"] = _vector_feature(embodiment.state)
    for camera in embodiment.cameras:
        features[keys[camera.name]] = {
            "dtype": "video",
            "shape": (*(camera.size or PICTURE), 3),
            "names": ["height", "width", "channels"],
        }
    return features


def camera_features(embodiment: Embodiment) -> dict[str, str]:
    """Return camera -> the feature of its pictures: of a LeRobot recording, the recording's own."""
    own = embodiment.source.format == "lerobot"
    return {one.name: one.key if own else f"observation.images.{one.name}" for one in embodiment.cameras}


def _vector_feature(vector: Vector) -> dict[str, Any]:
    return {"dtype": "float32", "shape": (vector.dims,), "names": vector.names()}


def packed_components(vector: dict[str, Any], key: str) -> list[dict[str, Any]]:
    """Return the components of a YAML's vector as slices of one feature that holds them in their order."""
    parts = []
    start = 0
    for part in vector["components"]:
        kept = ("names", "unit", "range", "normalize", "representation", "gripper")
        facts = {name: part[name] for name in kept if name in part}
        stop = start + part["dims"]
        parts.append({"key": key, "dims": part["dims"], "slice": [start, stop], **facts})
        start = stop
    return parts
