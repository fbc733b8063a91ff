"""Rollouts are written in the layout that WorldArena's own preprocessing reads."""

import argparse
import json
from pathlib import Path

import av
import numpy as np
import pytest

from hma_data.errors import UsageError
from hma_data.registry.embodiment import find
from hma_data.tokenizers.base import get_tokenizer
from hma_model.config import HMAConfig
from hma_model.network.model import HMA
from hma_model.worlds.world import World
from recipes.public.worldarena import export
from tests.model.public import look_alikes
from tests.model.true_world import _of_robot


@pytest.fixture(scope="module")
def world() -> World:
    tokenizer = get_tokenizer("fsq-8")
    config = HMAConfig(
        layers=1,
        width=32,
        heads=2,
        frames=3,
        grid=(8, 8),
        factored=(8,) * 6,
        tokenizer=tokenizer.spec.to_json(),
    )
    return World(_of_robot(HMA(config), find("iws_pusht"), False), tokenizer)


def asked(recording: Path, out: Path, **changes: object) -> argparse.Namespace:
    facts = {"recording": recording, "embodiment": "iws_pusht", "task": "push_t", "out": out, "name": "ours"}
    facts |= {"episodes": None, "frames": 4, "context": 2, "size": 64}
    return argparse.Namespace(**facts | changes)


def frames_of(path: Path) -> np.ndarray:
    with av.open(str(path)) as film:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)])


def test_each_episode_has_its_videos_where_worldarena_looks_for_them(world: World, tmp_path: Path) -> None:
    recording = look_alikes.iws(tmp_path / "published", episodes=4, frames=6) / "val"
    assert export(world, asked(recording, tmp_path / "out")) == 4
    rows = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert len(rows) == 4
    for row in rows:
        parts = Path(row["gt_path"]).parts
        task, episode = parts[-5], parts[-1].split(".")[0]  # as preprocess_datasets_diversity.py finds them
        assert task == "push_t" and Path(row["image"]).is_file() and row["prompt"][0]
        true = frames_of(Path(row["gt_path"]))
        assert true.shape == (4, 64, 64, 3)
        films = [f"{folder}_sort/{task}_{episode}.mp4" for folder in ("ours", "ours_1", "ours_2", "gt")]
        made, one, two, flat = (frames_of(tmp_path / "out" / film) for film in films)
        assert made.shape == one.shape == two.shape == true.shape and np.array_equal(flat, true)
        assert np.abs(made[:2].astype(int) - one[:2]).mean() < 2  # the given frames, but for the codec


def test_the_variants_have_the_actions_of_other_episodes(world: World, tmp_path: Path, monkeypatch) -> None:
    recording = look_alikes.iws(tmp_path / "published", episodes=3, frames=6) / "val"
    steps = []
    step = world.step
    monkeypatch.setattr(world, "step", lambda chunks: steps.append(chunks) or step(chunks))
    export(world, asked(recording, tmp_path / "out"))
    own, first, second = (np.stack(list(steps[2 * number].values())) for number in range(3))
    assert np.array_equal(first, own[[1, 2, 0]]) and np.array_equal(second, own[[2, 0, 1]])


def test_tasks_share_a_folder(world: World, tmp_path: Path) -> None:
    recording = look_alikes.iws(tmp_path / "published", episodes=3, frames=6) / "val"
    for task in ("push_t", "other"):
        export(world, asked(recording, tmp_path / "out", task=task, frames=2, context=1))
    assert len(json.loads((tmp_path / "out" / "summary.json").read_text())) == 6


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"task": "a/b"}, "--task.*no name of a folder"),
        ({"name": ".."}, "--name.*no name of a folder"),
        ({"frames": 7}, "has 0 of the chosen episodes with 7 frames; 3 are needed"),
        ({"episodes": [0, 1, 99, -1]}, "has 2 of the chosen"),
        ({"context": 0}, "--context: is 0, of 4 --frames"),
        ({"context": 4}, "--context: is 4, of 4 --frames"),
    ],
)
def test_what_cannot_be_written_is_refused(changes, said: str, world: World, tmp_path: Path) -> None:
    recording = look_alikes.iws(tmp_path / "published", episodes=3, frames=6) / "val"
    with pytest.raises(UsageError, match=said):
        export(world, asked(recording, tmp_path / "out", **changes))


def test_a_damaged_summary_is_named(world: World, tmp_path: Path) -> None:
    recording = look_alikes.iws(tmp_path / "published", episodes=3, frames=6) / "val"
    (tmp_path / "summary.json").write_text("[1]")
    with pytest.raises(UsageError, match="is no list of episodes"):
        export(world, asked(recording, tmp_path))
