"""Scenes in RH20T's layout, made for tests with numpy's own writer."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.registry.embodiment import Embodiment
from tests.data.videos import encode

BEGIN = 1_631_270_645_000  # ms since 1970
CAMERAS = ("750612070851", "043322070878")
LATE_MS = 30  # of the second camera


def stamps(camera: int, length: int) -> list[int]:
    return [BEGIN + 100 * i + i % 3 + LATE_MS * camera for i in range(length)]


def pose(camera: int, row: int) -> np.ndarray:
    """(7,) that names its camera and row, with a unit quaternion."""
    return np.array([row, 10 * camera, 0.5, 1.0, 0.0, 0.0, 0.0])


def tables(length: int) -> dict[str, dict[str, Any]]:
    """The content of transformed/: lists of dictionaries, and dictionaries by time, as RH20T has them."""
    found: dict[str, dict[str, Any]] = {"tcp_base": {}, "gripper": {}, "joint": {}}
    for camera, serial in enumerate(CAMERAS):
        times = stamps(camera, length)
        found["tcp_base"][serial] = [
            {"timestamp": t, "tcp": pose(camera, i), "robot_ft": np.full(6, i, np.float64)}
            for i, t in reversed(list(enumerate(times)))  # not by time
        ]
        found["gripper"][serial] = {
            t: {"gripper_command": [110 - i, 20, 30], "gripper_info": np.array([100 - i, 1, 0])}
            for i, t in enumerate(times)
        }
        found["joint"][serial] = {t: np.arange(14) + np.float64(i) for i, t in enumerate(times)}
    return found


def write_scene(
    folder: Path,
    task: int = 1,
    length: int = 12,
    films: int | None = None,
    rating: int = 5,
    content: Mapping[str, Any] | None = None,
) -> Path:
    """A scene below `folder`; `films` is the number of frames of its films, if not the number of times."""
    scene = folder / f"task_{task:04d}_user_0001_scene_0001_cfg_0001"
    for camera, serial in enumerate(CAMERAS):
        place = scene / f"cam_{serial}"
        encode(place / "color.mp4", range(length if films is None else films))
        times = stamps(camera, length)
        np.save(place / "timestamps.npy", {"color": times, "depth": times})  # type: ignore[arg-type]
    (scene / "transformed").mkdir()
    for name, table in (tables(length) if content is None else content).items():
        np.save(scene / "transformed" / f"{name}.npy", table)
    facts = {"rating": rating, "finish_time": BEGIN + 1000, "calib": 1631270000000, "calib_quality": 3}
    (scene / "metadata.json").write_text(json.dumps(facts))
    return scene


def robot(**changes: Any) -> Embodiment:
    values: dict[str, Any] = {
        "id": "test_rh20t",
        "kind": "real",
        "frequency_hz": 10,
        "action": {
            "space": "eef_pose",
            "components": [
                {"key": "tcp_base/tcp/next", "dims": 7},
                {"key": "gripper/gripper_info/next", "slice": [0, 1], "dims": 1},
            ],
        },
        "state": {"components": [{"key": "tcp_base/tcp", "dims": 7}, {"key": "joint", "dims": 14}]},
        "cameras": [{"name": f"c{i}", "key": f"cam_{serial}"} for i, serial in enumerate(CAMERAS)],
        "source": {"format": "rh20t"},
    }
    return Embodiment.from_values(values | changes, "test_rh20t")
