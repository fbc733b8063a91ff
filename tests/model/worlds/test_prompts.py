"""Prompts from everything that an episode may start from."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hma_data.episodes.sheets import write_png
from hma_data.errors import HMAError
from hma_data.lab import record
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import ShardSet
from hma_data.tokenizers.base import get_tokenizer
from hma_model.checkpoint.folder import Checkpoint
from hma_model.cli import main
from hma_model.network.model import HMA
from hma_model.simulate import read_prompt, starting_window
from hma_model.worlds import prompts
from hma_model.worlds.images import fitted
from tests.data import cameras as three
from tests.model.network_parts import small_model
from tests.model.shards import make_shards, state_pauses
from tests.model.true_world import trained_on

RAILS, MOVER, ARM, RECORDED = "rails_03", "mover_04", "planar_arm", "arm"


@pytest.fixture(scope="module")
def model() -> HMA:
    return HMA.from_pretrained("embedded-fsq", [RAILS, MOVER])


@pytest.fixture(scope="module")
def arm() -> HMA:
    return HMA.from_pretrained("embedded", [ARM])


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rails")
    yaml = folder / f"{RAILS}.yaml"
    yaml.write_text(Checkpoint.open("embedded").embodiment(RAILS).to_yaml())
    source = str(record(RAILS, folder, 2))
    words = ["convert", "-e", str(yaml), "--source", source, "--tokenizer", "fsq-lab", "--out"]
    assert main([*words, str(folder / "shards"), "--workers", "0"]) == 0
    return folder / "shards"


@pytest.mark.parametrize("name", [RAILS, MOVER])
def test_a_laboratory_robot_comes_with_a_prompt(model: HMA, name: str) -> None:
    frames, chunks = starting_window(model, name, seed=4)
    assert frames.shape == (4, 128, 128, 3) and frames.dtype == np.uint8 and frames.std() > 10
    assert chunks is not None and chunks.shape == (3, model.embodiments[name].chunk_dim)
    again, other = starting_window(model, name, seed=4), starting_window(model, name, seed=5)
    assert np.array_equal(frames, again[0]) and not np.array_equal(frames, other[0])


@pytest.mark.slow
def test_shards_give_the_tokens_and_chunks_of_the_recording(model: HMA, shards: Path) -> None:
    images, chunks = starting_window(model, RAILS)
    tokens = get_tokenizer("fsq-lab").encode(images)
    whole = read_prompt(model, RAILS, shards)
    later = read_prompt(model, RAILS, {"shards": str(shards), "episode": 0, "start": 5, "frames": 3})
    assert np.array_equal(whole[0], tokens) and np.array_equal(whole[1], chunks)
    assert np.array_equal(later[0], tokens[1:]) and np.array_equal(later[1], chunks[1:])
    assert not np.array_equal(read_prompt(model, RAILS, {"shards": shards, "episode": 1})[0], tokens)


def test_images_come_as_arrays_files_and_from_environments(model: HMA, tmp_path: Path) -> None:
    images, _ = starting_window(model, RAILS)
    for i in range(2):
        write_png(tmp_path / f"{i}.png", images[i])

    class Environment:
        def render(self) -> np.ndarray:
            return images[0]

    one = [images[0], tmp_path / "0.png", str(tmp_path / "0.png"), Environment()]
    several = [images[:2], [tmp_path / "0.png", tmp_path / "1.png"], {"frames": images[:2]}]
    for given, count in ((one, 1), (several, 2)):
        for prompt in given:
            frames, chunks = read_prompt(model, RAILS, prompt)
            assert np.array_equal(frames, images[:count])
            assert len(chunks) == count - 1 and np.isnan(chunks).all()


@pytest.mark.slow
def test_a_lerobot_episode_is_a_prompt_of_the_same_robot_recorded_elsewhere(arm, tmp_path) -> None:
    dataset = record("planar_arm_lerobot", tmp_path, 2)
    images, chunks = starting_window(arm, ARM)
    frames, found = read_prompt(arm, ARM, dataset)
    assert np.array_equal(found, chunks) and np.abs(frames.astype(int) - images).mean() < 8  # lossy video
    other, _ = read_prompt(arm, ARM, {"lerobot": dataset, "episode": 1, "start": 3})
    assert other.shape == frames.shape and np.abs(other.astype(int) - images).mean() > 8


def test_cameras_recorded_elsewhere_are_paired_by_name_and_the_primary_one_stays(monkeypatch) -> None:
    values = three.arm().to_dict() | {"sync": {"primary": "wrist"}}
    ends = ("front", "wrist", "side", "top", "other")
    keys = [SimpleNamespace(kind="camera", key=f"observation.images.{end}") for end in ends]
    source = SimpleNamespace(inspect=lambda folder, episodes: SimpleNamespace(keys=keys))
    monkeypatch.setattr(prompts, "open_source", lambda name: source)

    def paired(**names: str) -> dict[str, str]:
        cameras = [one | {"name": names.get(one["name"], one["name"])} for one in values["cameras"]]
        sync = {"primary": names.get("wrist", "wrist")}
        robot = Embodiment.from_values(values | {"cameras": cameras, "sync": sync}, "an arm")
        found = prompts._as_lerobot(robot, "a folder")
        assert found.primary_camera.name == sync["primary"]
        return {camera.name: camera.key.rpartition(".")[2] for camera in found.cameras}

    assert paired() == {"top": "top", "side": "side", "wrist": "wrist"}
    assert paired(top="above", wrist="hand") == {"above": "front", "side": "side", "hand": "wrist"}


@pytest.mark.parametrize(
    ("prompt", "message"),
    [
        ({"images": 3}, "has the keys images — give an image or images"),
        ({"lerobot": "data", "episde": 1}, "has the keys lerobot, episde"),
        (SimpleNamespace(render=lambda: None), 'returned no image — make it with render_mode="rgb_array"'),
        ([np.zeros((8, 8, 3), np.uint8), np.zeros((9, 8, 3), np.uint8)], "its images differ in size"),
        ("tests", "tests: is a folder, not an image — give an image or images"),
        ("README.md", "README.md: is not an image — give an image or images"),
        ("no/such.png", "cannot be read: No such file or directory — give an image"),
        ({"frames": np.zeros((3, 8, 8, 3), np.uint8), "chunks": "abc"}, "its chunks are no array of numbers"),
        ({"frames": [[1, 2], [1]]}, "its images differ in size"),
        ({"shards": 5}, "shards is 5, not a folder — give an image or images"),
    ],
)
def test_prompts_that_cannot_be_read_are_refused(model: HMA, prompt: Any, message: str) -> None:
    with pytest.raises(HMAError, match=message):
        read_prompt(model, RAILS, prompt)


@pytest.mark.parametrize("prompt", [5, {"frames": 5}])
def test_a_number_is_no_image(model: HMA, prompt: Any) -> None:
    with pytest.raises(HMAError, match="give images"):
        fitted(read_prompt(model, RAILS, prompt).frames, model.config, None)


@pytest.mark.slow
def test_windows_that_are_not_there_are_refused(model: HMA, shards: Path) -> None:
    with pytest.raises(HMAError, match="has no episode 7 — give 0 to 1, or an id"):
        read_prompt(model, RAILS, {"shards": shards, "episode": 7})
    with pytest.raises(HMAError, match="has no episode -1 — give 0 to 1, or an id"):
        read_prompt(model, RAILS, {"shards": shards, "episode": -1})
    with pytest.raises(HMAError, match="4 frames, 5 rows apart, from row 900 on do not fit an episode of"):
        read_prompt(model, RAILS, {"shards": shards, "start": 900})
    with pytest.raises(HMAError, match="5 actions of 2 values in a chunk — mover_04 takes 1 of 2"):
        read_prompt(model, MOVER, shards)


@pytest.mark.slow
def test_a_prompt_crosses_no_pause(model: HMA, shards: Path, tmp_path: Path) -> None:
    paused = shutil.copytree(shards, tmp_path / "paused")
    state_pauses(paused, {7: 90, 40: 4})  # the second is shorter than a step of the model, 5
    first, _ = read_prompt(model, RAILS, paused)
    assert np.array_equal(first, read_prompt(model, RAILS, {"shards": shards, "start": 8})[0])
    with pytest.raises(HMAError, match="from row 3 on do not fit an episode .* pauses after row 7"):
        read_prompt(model, RAILS, {"shards": paused, "start": 3})
    for start, frames in ((0, 2), (8, 4), (30, 4)):
        given = {"start": start, "frames": frames}
        whole, pausing = (read_prompt(model, RAILS, {"shards": s} | given) for s in (shards, paused))
        assert np.array_equal(whole[0], pausing[0]) and np.array_equal(whole[1], pausing[1])


def test_another_robot_needs_a_prompt() -> None:
    with pytest.raises(
        HMAError, match="no simulator here, and the shards of its training are not here — give an image"
    ):
        starting_window(small_model(), "arm")


@pytest.fixture
def recorded(tmp_path: Path) -> tuple[ShardSet, HMA]:
    shards = ShardSet(make_shards(tmp_path / "shards", RECORDED, episodes=6, held_out=2))
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "recipe.json").write_text(json.dumps({"data": [str(shards.folder)]}))
    return shards, trained_on("first", shards, tmp_path / "run/checkpoints/step-00000001").model


def test_a_recorded_robot_starts_from_no_episode_that_is_too_short(recorded: tuple[ShardSet, HMA]) -> None:
    shards, model = recorded
    names = [row["id"] for row in shards.episodes.to_pylist()]
    short = {7: 9, 15: 9}  # pauses that leave pieces of eight rows; a prompt takes eleven

    def started(seed: int) -> Any:
        return starting_window(model, RECORDED, seed).frames

    def first(name: str) -> Any:
        return read_prompt(model, RECORDED, {"shards": shards.folder, "episode": name}).frames

    state_pauses(shards.folder, {}, {}, {}, {}, short)
    assert all(np.array_equal(started(seed), first(names[5])) for seed in range(2))
    state_pauses(shards.folder, {}, short, {}, {}, short, short)
    assert all(np.array_equal(started(seed), first(names[n])) for seed, n in enumerate((0, 2, 3, 0)))
    state_pauses(shards.folder, *[short] * 6)
    with pytest.raises(HMAError, match="6 frames.* do not fit an episode of 24 rows"):
        started(0)


def test_a_recorded_robot_starts_from_the_held_out_episodes_of_its_training(recorded) -> None:
    shards, model = recorded
    held = [row["id"] for row in shards.episodes.to_pylist() if row["split"] == "val"]
    for seed, name in enumerate([*held, held[0]]):
        own = starting_window(model, RECORDED, seed)
        expected = read_prompt(model, RECORDED, {"shards": shards.folder, "episode": name})
        assert np.array_equal(own[0], expected[0]) and np.array_equal(own[1], expected[1])
    shutil.rmtree(shards.folder)
    with pytest.raises(HMAError, match="the shards of its training are not here"):
        starting_window(model, RECORDED)
