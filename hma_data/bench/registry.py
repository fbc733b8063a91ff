"""Measure commands that read every YAML of a large registry, with nothing or everything cached."""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from hma_data.bench import Bench

_YAML = """id: {id}
description: A generated arm for measuring
robot: arm {id}
kind: simulation
frequency_hz: {hz}
action:
  space: eef_delta
  components:
    - {{key: actions, slice: [0, 3], dims: 3, names: [dx, dy, dz], unit: m}}
    - {{key: actions, slice: [3, 6], dims: 3, names: [drx, dry, drz], unit: rad, representation: axis_angle}}
    - {{key: actions, slice: [6, 7], dims: 1, names: [gripper], normalize: false, gripper: open_is_low}}
state: {{components: [{{key: obs/joint_pos, dims: 7, unit: rad}}]}}
cameras:
  - {{name: front, key: obs/front_image, size: [480, 640]}}
  - {{name: wrist, key: obs/wrist_image, size: [480, 640]}}
source: {{format: hdf5, uri: data/{id}.hdf5, episodes: 10}}
provenance: {{frequency_hz: generated, action: generated}}
"""


def run(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Run each command once cold, then warm, each time in a new process, as a user starts it."""
    with tempfile.TemporaryDirectory() as folder:
        registry = Path(folder) / "registry"
        for i in range(settings["embodiments"]):
            place = registry / f"group_{i // 500}"
            place.mkdir(parents=True, exist_ok=True)
            (place / f"arm_{i}.yaml").write_text(_YAML.format(id=f"arm_{i}", hz=1 + i % 50))
        environment = {**os.environ, "HMA_CACHE": f"{folder}/cache", "HMA_REGISTRY": str(registry)}
        results = []
        for words in (["list", "--json"], ["list"], ["validate"], ["show", "arm_7"]):
            command, seconds = [sys.executable, "-m", "hma_model.cli", "registry", *words], list[float]()
            for _ in range(settings["runs"] + 1):
                start = time.perf_counter()
                subprocess.run(command, cwd=folder, env=environment, check=True, stdout=subprocess.DEVNULL)
                seconds.append(round(time.perf_counter() - start, 3))
            cold = seconds[0] if words == ["list", "--json"] else None
            about = {"command": f"registry {' '.join(words)}", "cold_seconds": cold}
            results.append({**about, "warm_seconds": min(seconds[1:])})
        return results


BENCH = Bench(
    "registry list over many generated YAMLs: seconds of the whole command",
    {"embodiments": 10_000, "runs": 3},
    run,
)
