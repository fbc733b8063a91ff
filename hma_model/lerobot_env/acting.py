"""Offer a model that was trained to act to lerobot as a policy: `lerobot-eval --policy.type=hma`.

    lerobot-eval --policy.type=hma --policy.checkpoint=RUN --policy.embodiment=ID --env.type=pusht \\
        --policy.discover_packages_path=hma_model.lerobot_env

lerobot finds the policy and its processors in this module by their names. `--policy.path` does not work: it
reads a config.json of lerobot's own form, and a checkpoint has one of ours.

N environments, S pixels a side, V views side by side, A action dims.
"""

from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import (
    PolicyProcessorPipeline,
    policy_action_to_transition,
    transition_to_policy_action,
)
from torch import Tensor

from hma_data.errors import UsageError
from hma_model.lerobot_env import in_one_line, opened
from hma_model.lerobot_env.vector import camera_names
from hma_model.policies.acting import Acting
from hma_model.worlds.images import Prompt, fitted_view
from hma_model.worlds.world import load_world

NO_TRAINING = "is trained by hma train with objectives={policy: 1.0}, and not by lerobot"


@PreTrainedConfig.register_subclass("hma")
@dataclass
class WorldModelConfig(PreTrainedConfig):
    """A model as a policy.

    Attributes:
        checkpoint: as `HMA.from_pretrained` takes it.
        embodiment: an id of it; may be left out if it has one.
        unmask_steps, temperature: as of `load_world`.
    """

    checkpoint: str = ""
    embodiment: str = ""
    unmask_steps: int = 2
    temperature: float | None = None

    observation_delta_indices = action_delta_indices = reward_delta_indices = None

    def validate_features(self) -> None:
        """Check nothing: the images are found when they come."""

    def get_optimizer_preset(self) -> Any:
        """Refuse to train."""
        raise UsageError(self.checkpoint, NO_TRAINING)

    def get_scheduler_preset(self) -> None:
        """Return no scheduler."""


class WorldModelPolicy(PreTrainedPolicy):
    """A model with the objective `policy` or `full` as a policy in N environments."""

    config_class = WorldModelConfig
    name = "hma"

    def __init__(self, config: WorldModelConfig, **unused: Any) -> None:
        super().__init__(config)
        with in_one_line():
            checkpoint, name = opened(config.checkpoint, config.embodiment, "--policy.embodiment")
            self._where = f"policy {name}"
            self._cameras = camera_names(checkpoint, name)
            world = load_world(
                config.checkpoint, [name], device=config.device or "cpu",
                unmask_steps=config.unmask_steps, temperature=config.temperature,
            )  # fmt: skip
            robot, spec = checkpoint.embodiment(name), checkpoint.config.spec
            self._fits = [partial(fitted_view, spec=spec, camera=robot.camera(one)) for one in self._cameras]
            self._stride = robot.stride
            taken = (config.output_features or {}).get("action")
            if taken is not None and tuple(taken.shape) != (robot.action_dim,):
                fault = f"gives {robot.action_dim} values of action, the environment takes {taken.shape[0]}"
                raise UsageError(self._where, fault, "give a policy of this robot")
            # what the policy takes of the arena that it acts in: lerobot's environments, as they come
            scenes: Any = SimpleNamespace(name=name, seed=0, robot=SimpleNamespace(embodiment=robot))
            self._arena: Any = SimpleNamespace(scenes=scenes)
            self._policy = Acting(world, scenes, where=config.checkpoint)
        self.network = world.model  # lerobot moves it and counts its parameters
        self.reset()

    def reset(self) -> None:
        """Forget the episodes."""
        self._steps = 0

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **unused: Any) -> Tensor:
        """Return the next actions (N, A); the model looks once for the actions of a chunk."""
        self._arena.fresh = self._steps % self._stride == 0
        if self._arena.fresh:
            self._arena.images = images = self._images(batch)
        if self._steps == 0:
            width = len(self._policy.follower.spec.names) * self._stride
            self._arena.prompts = [Prompt(image[None], np.zeros((0, width), np.float32)) for image in images]
            self._policy.begin(self._arena)
        self._steps += 1
        return torch.from_numpy(self._policy.act(self._arena).astype(np.float32))

    def predict_action_chunk(self, batch: dict[str, Tensor], **unused: Any) -> Tensor:
        """Return the actions (N, stride, A) from the newest images on; the next call counts them as taken."""
        return torch.stack([self.select_action(batch) for _ in range(self._stride)], dim=1)

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, Any] | None]:
        """Refuse to train."""
        raise UsageError(self._where, NO_TRAINING)

    def get_optim_params(self) -> dict[str, Any]:
        """Refuse to train."""
        raise UsageError(self._where, NO_TRAINING)

    def _images(self, batch: dict[str, Tensor]) -> np.ndarray[Any, Any]:
        """Return the images (N, S, V·S, 3) uint8 of the model's cameras, side by side."""
        keys = [f"observation.images.{name}" for name in self._cameras]
        if len(keys) == 1 and keys[0] not in batch:
            keys = ["observation.image"]
        if missing := [key for key in keys if key not in batch]:
            there = ", ".join(key for key in batch if key.startswith("observation.image")) or "none"
            fault = f"needs {', '.join(missing)}; the images are {there}"
            with in_one_line():
                raise UsageError(self._where, fault, "rename them with --rename_map")
        views = [(batch[key] * 255).round().clamp(0, 255).to(torch.uint8) for key in keys]
        pixels = [view.permute(0, 2, 3, 1).numpy(force=True) for view in views]
        return np.concatenate([fit(view) for fit, view in zip(self._fits, pixels)], axis=2)


def make_hma_pre_post_processors(
    config: WorldModelConfig, **unused: Any
) -> tuple[PolicyProcessorPipeline[Any, Any], PolicyProcessorPipeline[Any, Any]]:
    """Return processors that change nothing: the model takes images and gives actions as recorded."""
    after: PolicyProcessorPipeline[Any, Any] = PolicyProcessorPipeline(
        steps=[], to_transition=policy_action_to_transition, to_output=transition_to_policy_action
    )
    return PolicyProcessorPipeline(steps=[]), after
