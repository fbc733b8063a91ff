"""Films of rollouts: which windows they show, and how truth, prompt and prediction differ in them."""

from pathlib import Path

import numpy as np
import pytest
import torch

from hma_data.errors import UsageError
from hma_data.loading.dataset import WindowDataset
from hma_data.shards.reader import ShardSet
from hma_data.tokenizers.base import get_tokenizer
from hma_model.cli import main
from hma_model.evaluation import rollout_video as module
from hma_model.evaluation.rollout_video import lively_windows, rollout_video
from hma_model.generation.decode import decode
from hma_model.network.model import HMA
from tests.model.robots import Blocks, make_model, save
from tests.model.shards import make_shards

LENGTH, PROMPT = 6, 2


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> ShardSet:
    return ShardSet(make_shards(tmp_path_factory.mktemp("shards") / "arm", "arm", episodes=6, held_out=3))


def test_windows_with_motion_come_from_different_episodes_and_get_unlike_actions(shards: ShardSet) -> None:
    dataset = WindowDataset(shards, "val", LENGTH)
    chosen, others = lively_windows(shards, LENGTH, PROMPT, 3)
    batch, everything = dataset.batch(chosen), dataset.batch(range(len(dataset)))
    assert len(set(batch.episode.tolist())) == 3

    def motion(tokens: torch.Tensor) -> torch.Tensor:
        return (tokens[:, PROMPT:] != tokens[:, PROMPT - 1 : PROMPT]).float().mean(dim=(1, 2, 3))

    assert motion(batch.tokens)[0] == motion(everything.tokens).max()
    theirs = dataset.batch(others)
    for i in range(3):
        assert not torch.equal(batch.actions[i, PROMPT - 1 :], theirs.actions[i, PROMPT - 1 :])


def test_borders_tell_the_prompt_from_predictions_and_the_truth_has_none_of_those(shards: ShardSet) -> None:
    film = rollout_video(
        make_model({"arm": 2}), Blocks(), shards, window=[0, 9], other=[9, 0], frames=LENGTH - PROMPT,
        prompt=PROMPT,
    )  # fmt: skip
    held = round(module.HOLD_SECONDS * film.fps)
    assert len(film.frames) == 2 * (LENGTH + held)
    assert (film.frames[LENGTH - 1 : LENGTH + held] == film.frames[LENGTH - 1]).all()
    width = film.frames.shape[2]
    assert width >= 3 * module.PANEL_PX
    for t in range(LENGTH):
        row = film.frames[t, 43].reshape(3, width // 3, 3)  # in the upper borders of the three panels
        colours = [tuple(panel[width // 6]) for panel in row.tolist()]
        predicted = module.GIVEN_COLOUR if t < PROMPT else module.PREDICTED_COLOUR
        assert colours == [module.GIVEN_COLOUR, predicted, predicted]
    # three equal images with their borders, below the titles
    assert not film.images[: module.TITLE_PX].any() and film.images[43].reshape(3, -1).any(axis=1).all()
    shown = np.split(film.images, 3, axis=1)
    assert all((part == shown[0]).all() for part in shown)
    assert shown[0].any(axis=0).sum() == module.PANEL_PX + 2 * module.BORDER_PX
    panels = np.split(film.frames, 3, axis=2)
    picture = slice(46, 46 + module.PANEL_PX)
    assert (panels[0][:PROMPT, picture] == panels[1][:PROMPT, picture]).all()


def test_a_split_without_such_a_window_is_refused_with_what_to_do(shards: ShardSet, tmp_path: Path) -> None:
    alone = ShardSet(make_shards(tmp_path / "alone", "arm", episodes=1, held_out=0))
    for given, options, message in (
        (alone, {}, "has no episode in val — give --split train"),
        (shards, {"window": 900}, "none with number 900 — they are 0 to"),
    ):
        with pytest.raises(UsageError, match=message):
            rollout_video(make_model({"arm": 2}), Blocks(), given, **options)


def test_the_newest_sheet_of_each_robot_is_found(tmp_path: Path) -> None:
    (tmp_path / module.SHEETS).mkdir()
    for name, steps in (("arm", (2, 10)), ("big-arm", (2,)), ("hand", (10, 200))):
        for step in steps:
            (tmp_path / module.SHEETS / f"step-{step:08d}-{name}.png").touch()
    found = {name: path.name for name, path in module.newest_sheets(tmp_path).items()}
    assert found == {
        "arm": "step-00000010-arm.png",
        "big-arm": "step-00000002-big-arm.png",
        "hand": "step-00000200-hand.png",
    }


def test_the_verb_tells_of_actions_outside_the_range_seen_in_training(shards, tmp_path, monkeypatch, capsys):
    save(tmp_path / "model", {"arm": 2})
    model = HMA.from_pretrained(tmp_path / "model").eval()
    monkeypatch.setattr("hma_model.cli._opened", lambda *names: (model, Blocks(), shards))
    command = ["generate", "model", "shards", "--out", str(tmp_path / "film.webp")]
    for low, high, told in ((-1e9, 1e9, False), (5e8, 1e9, True)):
        ends = np.array([[low] * 2, [high] * 2], np.float32)
        monkeypatch.setattr("hma_model.generation.commands._seen", lambda *names, ends=ends: ends)
        assert main(command) == 0
        assert ("outside the range seen in training (" in capsys.readouterr().err) == told


class OnGPU(torch.Tensor):
    """A tensor that says that it is not on the CPU."""

    is_cpu = False


@pytest.mark.parametrize("name", ["fsq-8", "vae-8"])
def test_frames_on_a_gpu_are_decoded_there_to_the_same_pictures(name, monkeypatch) -> None:
    tokenizer = get_tokenizer(name)
    cells = tokenizer.spec.image_size // 16
    small = np.random.default_rng(0).integers(0, 256, (6, cells, cells, 3), np.uint8)
    pictures = small.repeat(16, axis=1).repeat(16, axis=2)
    stored = np.concatenate([tokenizer.encode(pictures), tokenizer.encode(255 - pictures)], axis=-2)
    values = torch.from_numpy(stored.astype(np.int64 if name == "fsq-8" else np.float32))
    frames = values.unflatten(0, (2, 3))
    wanted = decode(tokenizer, frames)
    monkeypatch.setattr(tokenizer, "decode", None)
    monkeypatch.setattr(tokenizer, "batch", 4)
    made = decode(tokenizer, frames.as_subclass(OnGPU))  # type: ignore[arg-type]
    assert made.shape == wanted.shape == (2, 3, 16 * cells, 32 * cells, 3)
    assert np.abs(made.astype(int) - wanted).max() <= 1
