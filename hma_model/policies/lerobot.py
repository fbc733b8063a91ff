"""Let a policy of lerobot act: its own loader, its own processors before and after it.

N scenes, S pixels a side, S' values of a state.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from hma_data.arrays import Float32s, Images
from hma_data.errors import HMAError
from hma_data.hub.repository import Repository
from hma_data.lab import imported
from hma_data.storage.paths import REPOSITORY
from hma_model.policies.arenas import Arena, Scenes

STATE, TASK = "observation.state", "task"
CONFIG = "config.json"


class LeRobotPolicy:
    """A policy of lerobot that sees one camera, and the robot's state where it is known.

    Args:
        source: its folder or hub repository.
        scenes: of the robot.

    Raises:
        HMAError: it cannot be loaded, or it takes inputs that a world model does not give.
    """

    def __init__(self, source: str, scenes: Scenes, device: str = "cpu") -> None:
        self.name = f"policy lerobot:{source}"
        hub_repository(source, self.name, "policy")
        with imported("lerobot"):
            from lerobot.configs.policies import PreTrainedConfig
            from lerobot.policies.factory import get_policy_class, make_pre_post_processors
        with loading(self.name, "give a folder or repository that lerobot itself loads"):
            config = PreTrainedConfig.from_pretrained(source)
            config.device = device
            config.pretrained_path = source
            self._policy: Any = get_policy_class(config.type).from_pretrained(source, config=config)
            self._before, self._after = make_pre_post_processors(
                config,
                source,
                preprocessor_overrides={"device_processor": {"device": device}},
                postprocessor_overrides={"device_processor": {"device": "cpu"}},
            )
        self._policy.eval()
        self._check(config, scenes)

    def _check(self, config: Any, scenes: Scenes) -> None:
        """Refuse a policy with other inputs than one camera and a state, or another action."""
        cameras = list(config.image_features)
        others = [key for key in config.input_features if key not in (*cameras, STATE)]
        if len(cameras) != 1 or others:
            wanted = ", ".join([*cameras, *others]) or "no camera"
            raise HMAError(self.name, f"takes {wanted}", "a world model gives the image of one camera")
        self._camera = cameras[0]
        self._size: tuple[int, ...] = tuple(config.input_features[self._camera].shape[1:])
        state = config.input_features.get(STATE)
        action = config.action_feature
        self._state = None if state is None else int(state.shape[0])
        if action.shape != (len(scenes.dimensions),):
            fault = f"gives actions of {action.shape[0]} values"
            raise HMAError(self.name, fault, f"{scenes.name} takes {len(scenes.dimensions)}")

    def begin(self, arena: Arena) -> None:
        if arena.images.shape[1] != arena.images.shape[2]:
            fault = "takes one camera, and the images show several side by side"
            raise HMAError(self.name, fault, "give a policy that sees the same cameras")
        self._policy.reset()

    def act(self, arena: Arena) -> Float32s:
        images = network_images(arena.images, self._size)
        batch = {self._camera: images, TASK: [arena.scenes.name] * len(images)}
        if self._state is not None:
            batch[STATE] = torch.from_numpy(self._observed(arena))
        with torch.inference_mode():
            action = self._after(self._policy.select_action(self._before(batch)))
        return np.asarray(action.cpu(), np.float32)

    def _observed(self, arena: Arena) -> Float32s:
        state = arena.observed()
        if state is None or state.shape[1] != self._state:
            have = "none" if state is None else f"one of {state.shape[1]}"
            fault = (
                f"takes a state of {self._state} values, but the images of {arena.scenes.name} give {have}"
            )
            raise HMAError(self.name, fault, "give a policy that acts from images alone")
        return state


@contextmanager
def loading(where: str, remedy: str) -> Iterator[None]:
    """Convert what lerobot raises while it loads something to an HMAError of one line."""
    try:
        with redirect_stdout(sys.stderr):  # it prints what it loads
            yield
    except HMAError:
        raise
    except Exception as fault:
        said = f"cannot be loaded: {type(fault).__name__}: {str(fault).strip().partition(chr(10))[0]}"
        raise HMAError(where, said, remedy) from fault


def network_images(images: Images, size: tuple[int, ...]) -> Tensor:
    """Return images (N, H, W, 3) as networks of lerobot take them: (N, 3, *size) of 0 to 1."""
    made = torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255
    return made if made.shape[2:] == size else interpolate(made, size, mode="bilinear", antialias=True)


def hub_repository(source: str, where: str, what: str) -> Repository | None:
    """Return the hub repository of what lerobot has saved; None of a folder.

    Raises:
        HMAError: there is no such folder or repository; lerobot's loader would ask the Hub even for a path.
    """
    if Path(source).is_dir():
        return None
    if not REPOSITORY.fullmatch(source):
        remedy = f"give the folder of a {what}, or ORGANISATION/NAME on the Hub"
        raise HMAError(where, "no such folder", remedy)
    repository = Repository(source, name=where)
    if CONFIG not in repository.files():
        raise HMAError(where, f"has no {CONFIG}", f"give a {what} that lerobot has saved")
    return repository
