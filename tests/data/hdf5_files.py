"""HDF5 episodes made for tests, and the embodiment that reads them."""

from typing import Any

import h5py
import numpy as np

from hma_data.registry.embodiment import Embodiment

T, H, W = 9, 12, 16


def embodiment(**changes: Any) -> Embodiment:
    values: dict[str, Any] = {
        "id": "test_arm",
        "kind": "simulation",
        "frequency_hz": 20,
        "action": {"space": "eef_delta", "components": [{"key": "actions", "dims": 3}]},
        "cameras": [{"name": "front", "key": "obs/agentview_image"}],
        "source": {"format": "hdf5"},
    }
    for path, value in changes.items():
        *parents, last = path.split("__")
        holder = values
        for part in parents:
            holder = holder[part]
        holder[last] = value
    return Embodiment.from_values(values, "test")


def pictures(length: int = T, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (length, H, W, 3), dtype=np.uint8)


def fill(group: h5py.Group, length: int = T, seed: int = 0) -> None:
    group["actions"] = np.random.default_rng(seed).normal(size=(length, 3))
    group["rewards"] = np.zeros(length)
    group["dones"] = np.arange(length) == length - 1
    group.create_dataset(
        "obs/agentview_image", data=pictures(length, seed), chunks=(4, H, W, 3), compression="gzip"
    )
