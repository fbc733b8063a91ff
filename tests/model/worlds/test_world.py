"""Sessions in images: side by side as alone, as `HMA.generate` makes them, also of a U-Net."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from hma_data.episodes.images import resize
from hma_data.errors import HMAError
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.tokenizers.base import get_tokenizer
from hma_model.config import HMAConfig
from hma_model.generation.decode import decode
from hma_model.network.model import HMA
from hma_model.policies.acting import Follower
from hma_model.policies.arenas import Scenes, TrueArena
from hma_model.policies.planning import Cost
from hma_model.simulate import World, load_world, starting_window
from hma_model.synthetic.augment import Augmentation, augment
from tests.data import cameras as three
from tests.model.network.test_unet import COLORS, PIXELS
from tests.model.true_world import _of_robot, family, trained_on

ARM, OTHER = "gantry_04", "rails_03"
SURE: dict[str, Any] = {"unmask_steps": 1, "temperature": 0.0}  # draws nothing


@pytest.fixture(scope="module")
def model() -> HMA:
    return HMA.from_pretrained("embedded", [ARM, OTHER])


@pytest.fixture(scope="module")
def windows(model: HMA) -> dict[str, Any]:
    return {name: starting_window(model, name) for name in (ARM, OTHER)}


def make(model: HMA, **settings: Any) -> World:
    return World(model, get_tokenizer(model.config.tokenizer["name"]), **settings)


def drawn(model: HMA, name: str, count: int, seed: int = 0) -> np.ndarray:
    space, rng = model.embodiments[name], np.random.default_rng(seed)
    values = rng.uniform(-1, 1, (count, space.stride, space.action_dim)) * space.std + space.mean
    return values.reshape(count, -1).astype(np.float32)


def test_sessions_get_the_images_that_they_get_alone(model: HMA, windows: dict[str, Any]) -> None:
    world, made = make(model, temperature=0.5), {}
    names = [OTHER, ARM, ARM, OTHER]
    chunks = {seed: drawn(model, name, 5, seed) for seed, name in enumerate(names)}
    sessions: dict[int, int] = {}
    for seed, name in enumerate(names):  # one more in each step, beyond the rows that there are
        session = world.open(name, *windows[name], seed=seed)
        sessions[session], made[seed] = seed, []
        for number, image in world.step(
            {one: chunks[of][len(made[of])] for one, of in sessions.items()}
        ).items():
            made[sessions[number]].append(image)
        if seed == 1:
            world.close(session)
            del sessions[session]
    assert [len(made[seed]) for seed in range(4)] == [4, 1, 2, 1]
    for seed, name in enumerate(names):
        alone = make(model, temperature=0.5)
        session = alone.open(name, *windows[name], seed=seed)
        for chunk, image in zip(chunks[seed], made[seed]):
            assert np.array_equal(alone.step({session: chunk})[session], image)


def test_a_session_of_stored_tokens_goes_on_as_generation_does(model: HMA, windows: dict[str, Any]) -> None:
    world = make(model, **SURE)
    images, before = windows[OTHER]
    tokens, chunks = world.tokenizer.encode(images), drawn(model, OTHER, 3)
    session = world.open(OTHER, tokens, before)
    assert np.array_equal(world.image(session), world.tokenizer.decode(tokens[-1:])[0])
    made = [world.step({session: chunk.reshape(5, 2)})[session] for chunk in chunks]
    actions = torch.from_numpy(np.concatenate([before, chunks]))[None]
    stored = torch.from_numpy(tokens.astype(np.int64))[None]
    expected = decode(world.tokenizer, model.generate(stored, actions, OTHER, 3, **SURE))[0]
    assert np.array_equal(np.stack(made), expected)
    assert np.array_equal(world.image(session), made[-1])


def test_a_snapshot_brings_a_session_back(model: HMA, windows: dict[str, Any]) -> None:
    world = make(model, temperature=0.5)
    first, second = (world.open(name, *windows[name], seed=3) for name in (OTHER, ARM))
    chunks = drawn(model, ARM, 3)
    world.step({second: chunks[0], first: drawn(model, OTHER, 1)[0]})
    kept = world.snapshot(second)
    made = [world.step({second: chunk})[second] for chunk in chunks]
    world.restore(first, kept)
    world.restore(second, kept)
    for chunk, image in zip(chunks, made):
        assert all(
            np.array_equal(again, image) for again in world.step({first: chunk, second: chunk}).values()
        )
    assert world.sessions == {first: ARM, second: ARM}


def test_a_reset_gives_the_same_images_again_and_settings_count_at_once(model, windows) -> None:
    world = make(model)
    session = world.open(ARM, *windows[ARM], seed=5)
    (chunk,) = drawn(model, ARM, 1)
    first = world.step({session: chunk})[session]
    world.reset(session, *windows[ARM])
    assert np.array_equal(world.step({session: chunk})[session], first)
    world.decoding = replace(world.decoding, temperature=3.0)
    world.reset(session, *windows[ARM])
    assert not np.array_equal(world.step({session: chunk})[session], first)
    world.decoding = replace(world.decoding, order="spiral")
    with pytest.raises(HMAError, match="order"):
        world.step({session: chunk})


def test_a_action_of_nan_is_unknown_and_not_zero(model: HMA, windows: dict[str, Any]) -> None:
    world = make(model, **SURE)
    images, before = windows[OTHER]
    (chunk,) = drawn(model, OTHER, 1)
    hidden = np.where(np.arange(5)[:, None] == 2, np.nan, chunk.reshape(5, 2))
    cases = {"unknown": (hidden, before), "zero": (np.zeros(10), before), "no chunks": (hidden, None)}
    made = {}
    for name, (actions, chunks) in cases.items():
        session = world.open(OTHER, images, chunks)
        made[name] = world.step({session: actions})[session]
    stored = torch.from_numpy(world.tokenizer.encode(images).astype(np.int64))[None]
    actions = torch.from_numpy(np.concatenate([before, chunk[None]]))[None]
    for name, known in (("unknown", [True] * len(before) + [False]), ("no chunks", [False] * 4)):
        masks = torch.tensor([known])
        expected = model.generate(stored, actions, OTHER, 1, known=masks, **SURE)
        assert np.array_equal(decode(world.tokenizer, expected)[0, 0], made[name])
    assert not np.array_equal(made["unknown"], made["zero"])


def test_images_of_a_robot_are_cropped_as_those_of_the_camera_that_the_model_sees(tmp_path: Path) -> None:
    values = three.arm().to_dict()
    values["cameras"][-1] |= {"crop": [32, 0, 64, 64]}
    tokenizer = get_tokenizer("fsq-8")
    shards: Any = SimpleNamespace(spec=tokenizer.spec, embodiment=Embodiment.from_values(values, "an arm"))
    world = World(trained_on("side", shards, tmp_path / "model").model, tokenizer)
    images = np.random.default_rng(0).integers(0, 256, (1, 64, 96, 3), np.uint8)
    wanted = tokenizer.encode(resize(images[:, :, 32:], tokenizer.spec.image_size))
    assert np.array_equal(world.encoded("three_hdf5", images), wanted)


def test_images_of_another_size_are_resized_as_in_a_conversion(model: HMA, windows: dict[str, Any]) -> None:
    world = make(model)
    wide = np.zeros((2, 160, 200, 3), np.uint8)
    wide[:, ::7, ::5] = 200
    one, other = (world.open(OTHER, frames) for frames in (wide, resize(wide, 128)))
    assert np.array_equal(world.image(one), world.image(other))


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros(7), r"of rails_03 have the shape \(7,\) — give \(10,\) or \(5, 2\)"),
        (np.full(10, np.inf), "not finite"),
        (np.array([[0, np.nan]] * 5), "not finite"),
    ],
)
def test_actions_that_do_not_fit_are_refused(model, windows, actions, message) -> None:
    world = make(model)
    session, other = (world.open(OTHER, *windows[OTHER]) for _ in range(2))
    with pytest.raises(HMAError, match=message):
        world.step({session: actions, other: np.zeros(10)})


@pytest.mark.parametrize(
    ("frames", "chunks", "message"),
    [
        (np.zeros((2, 8, 8, 3), np.float32), None, r"frames are float32 of the shape \(2, 8, 8, 3\)"),
        (np.zeros((0, 8, 8, 3), np.uint8), None, "frames are uint8"),
        (np.zeros((3, 8, 8, 3), np.uint8), np.zeros((1, 10)), "has 1 chunks for 3 frames — give 2"),
        (np.zeros((2, 8, 8, 3), np.uint8), np.zeros((1, 6)), r"have the shape \(6,\)"),
        (np.zeros((3, 8, 8, 3), np.uint8), [[0, 0], [0]], "its chunks are no array of numbers"),
    ],
)
def test_prompts_that_do_not_fit_are_refused(model: HMA, frames: Any, chunks: Any, message: str) -> None:
    with pytest.raises(HMAError, match=message):
        make(model).open(OTHER, frames, chunks)


def test_tokens_that_the_tokenizer_does_not_have_are_refused(model: HMA) -> None:
    for token in (-1, model.config.vocab_size):
        frames = np.full((2, *model.config.frame_shape), token)
        with pytest.raises(HMAError, match=f"tokens from {token} to {token} — give those of the tokenizer"):
            make(model).open(OTHER, frames)


def test_what_is_not_there_is_said(model: HMA, windows: dict[str, Any]) -> None:
    world = make(model)
    with pytest.raises(HMAError, match="ur5: is not in the model, which has: gantry_04, rails_03"):
        world.open("ur5", windows[OTHER][0])
    session = world.open(OTHER, *windows[OTHER])
    world.close(session)
    with pytest.raises(HMAError, match=f"session {session}: is not open; open are: none"):
        world.step({session: np.zeros(10)})


def test_the_embedded_world_opens_without_arguments() -> None:
    world = load_world(unmask_steps=3)
    assert world.decoding.unmask_steps == 3 and len(world.model.embodiments) > 10


def test_a_robot_with_a_bundled_checkpoint_to_itself_is_found_by_the_name_embedded() -> None:
    world = load_world("embedded", ["pusht_fast"])
    actions = world.action_spec("pusht_fast")
    assert actions.names == ("x", "y") and actions.stride == 2 and actions.rate_hz == 10
    assert actions.low.tolist() == [0, 0] and actions.high.tolist() == [512, 512]
    assert actions.seen is not None and (actions.seen[0] >= 15).all() and (actions.seen[1] <= 497).all()
    assert world.one_pass and world.decoding.temperature == 0
    with pytest.raises(
        HMAError, match="embedded: pusht_fast is in embedded-pusht and gantry_04 is in embedded-lab3: no"
    ):
        load_world("embedded", ["pusht_fast", ARM])
    with pytest.raises(HMAError, match=r"embedded-fsq: '\.\.' is not an embodiment's id"):
        load_world("embedded", [".."])


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
