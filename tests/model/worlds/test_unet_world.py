"""A U-Net of pixels in the places where people use a model: none of them knows of its trunk."""

from pathlib import Path

import numpy as np
import pytest
import torch

from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.tokenizers.base import get_tokenizer
from hma_model.checkpoint import io as checkpoint
from hma_model.config import HMAConfig
from hma_model.network.model import HMA
from hma_model.policies.acting import Follower
from hma_model.policies.arenas import Scenes, TrueArena
from hma_model.policies.planning import Cost
from hma_model.simulate import World, WorldModelEnv
from hma_model.synthetic.augment import Augmentation, augment
from tests.model.network.test_unet import COLORS, PIXELS
from tests.model.true_world import _of_robot, family

ROBOT = "rails_03"


@pytest.fixture
def world() -> World:
    raw = get_tokenizer("raw-64")
    values = {**PIXELS, "grid": (64, 64), "patch": 8, "tokenizer": raw.spec.to_json()}
    return World(_of_robot(HMA(HMAConfig(**values)), family.embodiment(ROBOT), False), raw)


@pytest.fixture
def colored() -> World:
    palette = get_tokenizer("palette-64")
    spec = palette.spec
    values = {**COLORS, "grid": spec.grid, "factored": spec.factored, "tokenizer": spec.to_json()}
    return World(_of_robot(HMA(HMAConfig(**values)), family.embodiment(ROBOT), False), palette)


def test_an_environment_steps_and_resets(world: World, tmp_path: Path) -> None:
    yaml = family.embodiment(ROBOT).to_yaml()
    space = world.model.embodiments[ROBOT]
    stats = {ROBOT: {"action": {"mean": list(space.mean), "std": list(space.std)}}}
    checkpoint.save(world.model, tmp_path / "model", embodiment_yaml={ROBOT: yaml}, stats=stats, cards={})
    arena = TrueArena(Scenes.of(world, ROBOT, 1, 0), 64)
    begin = {"frames": arena.prompts[0].frames, "chunks": arena.prompts[0].chunks}
    env = WorldModelEnv(tmp_path / "model", embodiment=ROBOT, prompt=begin, horizon=3)
    first, _ = env.reset(seed=0)
    image, *_ = env.step(env.action_space.sample())
    assert np.array_equal(image, first)  # untrained, it repeats the frame


def test_stored_pixels_of_a_prompt_are_shown_as_images(world: World) -> None:
    images = np.random.default_rng(0).integers(0, 256, (2, 64, 64, 3), dtype=np.uint8)
    stored = world.tokenizer.encode(images)
    assert stored.dtype == np.uint8
    assert np.array_equal(world.shown(stored), images) and world.shown(images) is images


def test_a_frame_beyond_black_and_white_is_stored_as_it_is_shown(world: World) -> None:
    drawn = world.model.config.replace(
        trunk="transformer", video_loss="diffusion", told_noise=False, copy_previous=False, action_waves=0
    )
    torch.manual_seed(0)
    other = World(_of_robot(HMA(drawn), family.embodiment(ROBOT), False), world.tokenizer)
    session = other.open(ROBOT, np.full((2, 64, 64, 3), 128, np.uint8))
    shown = other.step({session: np.zeros(other.model.embodiments[ROBOT].chunk_dim)})[session]
    values = other._newest(session)
    assert values.min() < 0 and values.max() > 255
    assert np.array_equal(world.tokenizer.decode(other.stored(session)[None])[0], shown)


def test_how_unsure_it_is_is_not_measured_rather_than_nothing(world: World) -> None:
    arena = TrueArena(Scenes.of(world, ROBOT, 1, 0), 64)
    session = world.open(ROBOT, arena.prompts[0].frames, arena.prompts[0].chunks)
    with world.drawing(measure=True):
        world.step({session: np.zeros(world.model.embodiments[ROBOT].chunk_dim, np.float32)})
    assert np.isnan(world.uncertainty[session])


def test_how_unsure_a_model_of_colours_is_is_measured(colored: World) -> None:
    arena = TrueArena(Scenes.of(colored, ROBOT, 1, 0), 64)
    session = colored.open(ROBOT, arena.prompts[0].frames, arena.prompts[0].chunks)
    with colored.drawing(measure=True):
        made = colored.step({session: np.zeros(colored.model.embodiments[ROBOT].chunk_dim, np.float32)})
    assert colored.uncertainty[session] > 0
    colors = np.frombuffer(bytes.fromhex(colored.tokenizer.spec.colors), np.uint8).reshape(-1, 3)
    assert {*map(tuple, made[session].reshape(-1, 3))} <= {*map(tuple, colors)}


def test_a_policy_of_few_images_follows_scenes_of_the_worlds_size(world: World) -> None:
    arena = TrueArena(Scenes.of(world, ROBOT, 2, 0), 64)
    assert {prompt.frames.shape[1:] for prompt in arena.prompts} == {world.image_shape}
    follower = Follower(world, arena.scenes, "it", memory=2)
    follower.begin(arena)
    for _ in range(arena.scenes.stride):
        arena.step(follower.take(arena.held))
    follower.look(arena)
    assert np.array_equal(follower._prompts[0].frames[-1], arena.images[0])


def test_synthetic_episodes_are_all_kept_without_an_uncertainty(world: World, tmp_path: Path) -> None:
    augment(tmp_path / "out", Augmentation(ROBOT, episodes=2, frames=3, keep=0.5), world=world)
    assert verify(tmp_path / "out") == []
    rows = ShardSet(tmp_path / "out").episodes.to_pylist()
    assert len(rows) == 2 and not any("milli" in row["flags"] for row in rows)


def test_plans_imagine_images(world: World) -> None:
    arena = TrueArena(Scenes.of(world, ROBOT, 2, 0), 64)
    cost = Cost(world, ROBOT)
    cost.open([(prompt.frames, prompt.chunks) for prompt in arena.prompts])
    candidates = np.zeros((2, 3, 2, 2), np.float32)
    assert cost.imagine(cost.sessions, candidates).shape == (2, 3, 2, 64, 64, 3)
