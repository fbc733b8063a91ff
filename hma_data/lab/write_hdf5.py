"""Write demonstrations to HDF5 in robomimic's layout.

    data                    attrs: env_args (JSON), total (frames in all)
      demo_0                attrs: num_samples, and plain facts of the episode
        actions             (T, A) float32
        obs/<key>           (T, …), pictures (T, H, W, 3) uint8, one compressed chunk a frame
        states rewards dones
    mask/train mask/valid   names of demos

`obs` at index t was observed before `actions[t]`; `rewards[t]` and `dones[t]` came after it.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Demo:
    """One episode of T frames.

    Attributes:
        actions: (T, A) float32.
        observations: key -> (T, …); uint8 (T, H, W, 3) are pictures.
            states: (T, S) float64, the states of the simulator.
            rewards: (T,) float64.
            success: whether the task was done at the end.
            facts: plain values that are stored as attributes.
    """

    actions: NDArray[np.float32]
    observations: Mapping[str, NDArray[Any]]
    states: NDArray[np.float64]
    rewards: NDArray[np.float64]
    success: bool
    facts: Mapping[str, str | int | float]


def write_demos(path: Path, demos: Iterable[Demo], env_args: Mapping[str, Any]) -> None:
    """Write one file; demos are read one by one, so that only one is in memory.

    Every tenth demo is for validation; with two to nine demos, the last one is.
    """
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        total, count = 0, 0
        for count, demo in enumerate(demos, start=1):
            _write_demo(data.create_group(f"demo_{count - 1}"), demo)
            total += len(demo.actions)
        data.attrs["total"] = total
        data.attrs["env_args"] = json.dumps(env_args, sort_keys=True)
        valid = set(range(9, count, 10)) or ({count - 1} if count > 1 else set())
        _write_mask(file, "train", [i for i in range(count) if i not in valid])
        _write_mask(file, "valid", sorted(valid))


def _write_demo(group: h5py.Group, demo: Demo) -> None:
    length = len(demo.actions)
    group.create_dataset("actions", data=demo.actions)
    for key, values in demo.observations.items():
        pictures = values.dtype == np.uint8 and values.ndim == 4
        packing = {"chunks": (1, *values.shape[1:]), "compression": "gzip", "compression_opts": 1}
        group.create_dataset(f"obs/{key}", data=values, **(packing if pictures else {}))
    group.create_dataset("states", data=demo.states)
    group.create_dataset("rewards", data=demo.rewards)
    dones = np.zeros(length, dtype=np.int64)
    dones[-1] = 1
    group.create_dataset("dones", data=dones)
    group.attrs["num_samples"] = length
    group.attrs["success"] = demo.success
    for name, value in demo.facts.items():
        group.attrs[name] = value


def _write_mask(file: h5py.File, name: str, demos: list[int]) -> None:
    file.create_dataset(f"mask/{name}", data=np.array([f"demo_{i}" for i in demos], dtype="S"))
