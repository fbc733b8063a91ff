"""A policy of lerobot, saved by lerobot, acts in scenes; inputs that nobody gives are refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from hma_data.errors import HMAError
from hma_data.lab import family
from hma_model.policies.arenas import Scenes, TrueArena
from hma_model.policies.base import begin, checked
from hma_model.policies.catalog import read_policy
from hma_model.worlds.scenes import LabRobot
from tests.hub_server import Hub

pytestmark = pytest.mark.slow
pytest_plugins = ["tests.hub_fixtures"]
ROBOT, CAMERA, STATE = "rails_03", "observation.images.top", "observation.state"


def scenes(count: int = 2) -> Scenes:
    own = family.embodiment(ROBOT)
    return Scenes(LabRobot(own, {"action": {"mean": [0, 0], "std": [30, 30]}}), tuple(range(count)), 0)


def saved(folder: Path, actions: int = 2, **inputs: int) -> Any:
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors

    cameras = {CAMERA: PolicyFeature(FeatureType.VISUAL, (3, 64, 64))}
    cameras |= {f"{CAMERA}_{i}": cameras[CAMERA] for i in range(inputs.get("cameras", 1) - 1)}
    state = {STATE: PolicyFeature(FeatureType.STATE, (inputs["state"],))} if "state" in inputs else {}
    outputs = {"action": PolicyFeature(FeatureType.ACTION, (actions,))}
    config = ACTConfig(
        input_features=cameras | state, output_features=outputs,
        device="cpu", chunk_size=4, n_action_steps=2, dim_model=32, n_heads=2, dim_feedforward=32,
        n_encoder_layers=1, use_vae=False, pretrained_backbone_weights=None,
    )  # fmt: skip
    torch.manual_seed(0)
    policy = ACTPolicy(config).eval()
    wide = {
        key: {"mean": torch.zeros(n), "std": torch.ones(n)} for key, n in ((STATE, 2), ("action", actions))
    }
    image = {"mean": torch.full((3, 1, 1), 0.5), "std": torch.full((3, 1, 1), 0.3)}
    wide["action"]["mean"] += 5
    before, after = make_pre_post_processors(config, dataset_stats=wide | dict.fromkeys(cameras, image))
    for part in (policy, before, after):
        part.save_pretrained(folder)
    return policy, before, after


def test_it_actions_what_lerobot_itself_does(tmp_path: Path) -> None:
    own, before, after = saved(tmp_path, state=2)
    policy, arena = read_policy(f"lerobot:{tmp_path}", scenes()), TrueArena(scenes(), 64)
    begin("it", policy, arena)
    given = {CAMERA: torch.from_numpy(arena.images).permute(0, 3, 1, 2) / 255}
    given[STATE] = torch.from_numpy(arena.observed())
    with torch.inference_mode():
        wanted = after(own.select_action(before(given))).numpy()
    np.testing.assert_allclose(checked("it", policy, arena), wanted, atol=1e-4)
    assert wanted.mean() == pytest.approx(5, abs=3)  # its own processors undo the scaling


@pytest.mark.parametrize(
    ("inputs", "said"),
    [
        ({"cameras": 2}, f"takes {CAMERA}, {CAMERA}_0 — a world model gives the image of one camera"),
        ({"actions": 3}, "gives actions of 3 values — rails_03 takes 2"),
    ],
)
def test_other_inputs_and_actions_are_refused(tmp_path: Path, inputs: dict[str, int], said: str) -> None:
    saved(tmp_path, **inputs)
    with pytest.raises(HMAError) as fault:
        read_policy(f"lerobot:{tmp_path}", scenes())
    assert said in str(fault.value)


def test_a_state_that_images_do_not_tell_is_refused(tmp_path: Path) -> None:
    saved(tmp_path, state=7)
    policy, arena = read_policy(f"lerobot:{tmp_path}", scenes()), TrueArena(scenes(), 64)
    begin("it", policy, arena)
    with pytest.raises(HMAError, match="takes a state of 7 values, but the images of rails_03 give one of 2"):
        checked("it", policy, arena)


def test_a_folder_without_a_policy_is_refused(tmp_path: Path) -> None:
    with pytest.raises(HMAError, match="cannot be loaded"):
        read_policy(f"lerobot:{tmp_path}", scenes())


@pytest.mark.parametrize("source", ["/nope", "./nope", "nope"])
def test_a_folder_that_is_not_there_is_not_asked_of_the_hub(source: str) -> None:
    with pytest.raises(HMAError, match=f"policy lerobot:{source}: no such folder — give the folder"):
        read_policy(f"lerobot:{source}", scenes())


def test_a_repository_that_is_not_there_is_one_line(server: Hub) -> None:
    with pytest.raises(HMAError, match="policy lerobot:someone/nope: no such repository, or no access"):
        read_policy("lerobot:someone/nope", scenes())
