"""Write the YAML of a new robot from one of its recordings.

What the recording states is filled in; what it cannot know stands as `TODO: question`, and
`hma registry validate` lists those until they are answered.
"""

import re
from typing import Any

from hma_data.embodiment import ID_PATTERN, TODO
from hma_data.errors import SourceError, UsageError
from hma_data.sources.base import Inspection, KeyInfo, detect, open_source
from hma_data.yaml_io import write_yaml

_ACTION = re.compile(r"action|command|cmd|target|control", re.IGNORECASE)
_STATE = re.compile(r"state|qpos|proprio|joint|eef|agent_pos|robot0", re.IGNORECASE)
_WRIST = re.compile(r"wrist|hand|gripper", re.IGNORECASE)
_GENERIC = re.compile(r"compressed|image|image_raw|images|color|rgb|obs|observations?", re.IGNORECASE)
_NOT_ACTION = re.compile(
    r"image|depth|reward|discount|is_(first|last|terminal)|language|embedding", re.IGNORECASE
)


def infer(uri: str, embodiment_id: str) -> str:
    """The YAML of an embodiment that reads `uri`.

    Raises:
        UsageError: not an id.
        SourceError: the recording cannot be read, or has no camera or nothing that could be an action.
    """
    if not ID_PATTERN.fullmatch(embodiment_id):
        raise UsageError(
            "--id", f"{embodiment_id!r} is not an id", "use a-z 0-9 _ - . and begin with a letter or digit"
        )
    name = detect(uri)
    found = open_source(name).inspect(uri)
    cameras = [
        key for key in found.keys if key.kind == "camera" and len(key.shape) == 3 and key.shape[2] == 3
    ]
    vectors = [key for key in found.keys if key.kind == "vector" and not _NOT_ACTION.search(key.key)]
    actions = _actions(vectors, name)
    if not cameras:
        raise SourceError(uri, "has no colour camera", "hma inspect lists its keys")
    if not actions:
        listed = ", ".join(key.key for key in vectors) or "none"
        raise SourceError(uri, "has nothing that looks like an action", f"its vectors: {listed}")
    states = _states([key for key in vectors if key not in actions])
    return _text(found, uri, embodiment_id, cameras, actions, states)


def _actions(vectors: list[KeyInfo], source: str) -> list[KeyInfo]:
    """Keys that name an action; the plainest of them when one holds the whole vector."""
    named = [
        key
        for key in vectors
        if _ACTION.search(key.key) and not re.search(r"observation|/obs/|^obs/", key.key)
    ]
    whole = [key for key in named if _last(key.key) in ("action", "actions")]
    if whole:
        return whole[:1]
    if source == "rosbag":
        return named[:1]
    return named


def _states(vectors: list[KeyInfo]) -> list[KeyInfo]:
    """Keys that name the robot's own state; a simulator's raw state only where nothing better is recorded."""
    named = [key for key in vectors if _STATE.search(key.key) and not _ACTION.search(key.key)]
    return [key for key in named if key.key != "states"] or named


def _last(key: str) -> str:
    return re.split(r"[/.]", key)[-1]


def _text(
    found: Inspection,
    uri: str,
    embodiment_id: str,
    cameras: list[KeyInfo],
    actions: list[KeyInfo],
    states: list[KeyInfo],
) -> str:
    rate = found.hz or next((camera.hz for camera in cameras if camera.hz), None)
    ordered = sorted(cameras, key=lambda camera: bool(_WRIST.search(camera.key)))
    values: dict[str, Any] = {
        "id": embodiment_id,
        "description": f"{found.robot or 'robot'} as recorded in {uri.rstrip('/').rsplit('/', 1)[-1]}",
        "robot": found.robot or f"{TODO}: which robot is it?",
        "kind": f"{TODO}: real, simulation or human?",
        "frequency_hz": _rounded(rate) if rate else f"{TODO}: at how many Hz were actions recorded?",
        "target_hz": 2,
        "action": {
            "space": f"{TODO}: joint_position, joint_velocity, joint_delta, eef_pose, eef_delta, "
            "base_velocity or mixed?",
            "components": [_component(key) for key in actions],
        },
    }
    if states:
        values["state"] = {"components": [_component(key) for key in states]}
    values["cameras"] = [
        {"name": name, "key": camera.key}
        for name, camera in zip(_camera_names(ordered), ordered, strict=True)
    ]
    if found.format == "rosbag":
        primary = values["cameras"][0]["name"]
        values["sync"] = {"primary": primary, "images": "nearest", "actions": "hold", "states": "interpolate"}
    values["source"] = {"format": found.format, "uri": uri, "episodes": max(found.episodes, 1)}
    values["provenance"] = {
        "frequency_hz": "the recording's metadata or time stamps" if rate else f"{TODO}: who says so?"
    }
    return (
        f"# Inferred from {uri}; answer every {TODO}, then: hma registry validate FILE\n{write_yaml(values)}"
    )


def _component(key: KeyInfo) -> dict[str, Any]:
    dims = 1
    for side in key.shape:
        dims *= side
    component: dict[str, Any] = {"key": key.key, "dims": dims}
    if key.names and len(key.names) == dims and len(set(key.names)) == dims:
        component["names"] = list(key.names)
    return component


def _camera_names(cameras: list[KeyInfo]) -> list[str]:
    """Short names that stay apart: the last telling word of the key, or the whole key."""
    words = [[word for word in re.split(r"[/.]", camera.key) if word] for camera in cameras]
    telling = [[word for word in group if not _GENERIC.fullmatch(word)] for group in words]
    names = [re.sub(r"[^A-Za-z0-9_-]+", "_", (told or ["camera"])[-1]).strip("_") for told in telling]
    if len(set(names)) < len(names):
        names = [re.sub(r"[^A-Za-z0-9_.-]+", "_", camera.key).strip("_.") for camera in cameras]
    return names


def _rounded(rate: float) -> float | int:
    """29.97 stays, 9.9996 of jittering stamps becomes 10."""
    whole = round(rate)
    return whole if whole and abs(rate / whole - 1) < 5e-4 else round(rate, 3)
