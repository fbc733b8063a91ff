"""Judges of episodes: scores of places, the limit, and the refusal of a judge that knows nothing."""

from typing import Any

import numpy as np
import pytest
from torch import nn

from hma_data.errors import HMAError, UsageError
from hma_data.lab import truth
from hma_model.evaluation.agreement import Accuracy
from hma_model.policies import judge
from hma_model.policies.judge import StateJudge, best_limit, last_seen, moved, reached, task_of, train_judge

SIDE = 8


class WrittenPlaces:
    """A probe of images that hold the places of the parts in their first pixels."""

    driven, own, loose, network = 1, np.array([0]), np.array([1, 2]), nn.Identity()

    def __init__(self, blind: bool = False) -> None:
        self.rng = np.random.default_rng(0) if blind else None
        self.count = 0  # images that were read

    def read(self, images: np.ndarray) -> np.ndarray:
        self.count += int(np.prod(images.shape[:-3]))
        places = images[..., :3, 0, :2].astype(float)
        return places if self.rng is None else self.rng.normal(64, 5, places.shape)

    def areas(self, images: np.ndarray) -> np.ndarray:
        return np.ones((*images.shape[:-3], 3))


def written(parts: np.ndarray) -> np.ndarray:
    images = np.zeros((len(parts), SIDE, SIDE, 3), np.uint8)
    images[:, :3, 0, :2] = parts.round()
    return images


@pytest.fixture
def episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    def episode(
        robot: str, frames: int, stride: int, seed: int, number: int, drawn: Any, wander: bool
    ) -> truth.TrueEpisode:
        rng = np.random.default_rng(number)
        parts = np.repeat(rng.uniform(30, 90, (1, 3, 2)), frames, axis=0)
        parts[-4:, 1] += (8 * (number % 2), 0)
        return truth.TrueEpisode(
            written(parts)[sorted(drawn)], np.zeros((frames, 1), np.float32), parts, parts[:, 0], 1
        )

    monkeypatch.setattr(truth, "episode", episode)
    monkeypatch.setattr(judge, "EXAMPLES", 40)
    for name in ("as_seen", "as_shown"):
        monkeypatch.setattr(judge, name, lambda *given: given[-1])


def test_scores_are_of_the_loose_part_that_moves_most_and_of_the_nearest_approach() -> None:
    parts = np.tile([[10.0, 10], [50, 50], [90, 20]], (1, 6, 1, 1))
    parts[0, 3:, 2] += (3, 4)
    parts[0, 2, 0] = (50, 44)
    assert moved(parts, 1) == pytest.approx([5]) and reached(parts, 1) == pytest.approx([-6])
    assert reached(parts[:, :1], 1) == pytest.approx([-(3200**0.5)])  # of an episode that has just begun


def test_the_goal_is_where_a_planned_push_of_the_simulator_ends() -> None:
    made = truth.episode("pusht_fast", 20, 4, 0, 0, {0}, wander=False)
    task = task_of("pusht_fast", "placed")
    assert made.parts.shape == (20, 3, 2) and task.limit == -5
    assert (
        task.score(made.parts[None], made.driven)[0] > -2 > task.score(made.parts[None, :4], made.driven)[0]
    )


def test_a_robot_without_a_goal_is_told_so() -> None:
    with pytest.raises(UsageError, match="rails_03 has no goal .* robots with one: pusht_fast, pusht_slow"):
        task_of("rails_03", "placed")


def test_a_part_that_is_gone_stays_where_it_was_last_seen() -> None:
    places = np.arange(10.0).reshape(1, 5, 1, 2)
    areas = np.array([[[20.0], [18], [3], [12], [0]]])
    assert last_seen(places, areas)[0, :, 0, 0].tolist() == [0, 2, 2, 6, 6]


def test_the_limit_is_the_nearest_of_those_that_tell_about_best() -> None:
    rng = np.random.default_rng(1)
    success = rng.random(200) < 0.4
    read = rng.normal(5, 2, 200) + 3 * success

    def balanced(limit: float) -> float:
        said = read >= limit
        return float(said[success].mean() + (~said[~success]).mean()) / 2

    tried = np.linspace(0, 15, 3001)
    top = max(tried, key=balanced)
    right, wrong = (read >= top)[success].mean(), (read >= top)[~success].mean()
    error = (right * (1 - right) / success.sum() + wrong * (1 - wrong) / (~success).sum()) ** 0.5 / 2
    found = best_limit(read, success, 2.0)
    assert balanced(found) >= balanced(top) - error
    gap = 0.2  # limits lie between what was read
    nearer = [one for one in tried if abs(one - 2.0) < abs(found - 2.0) - gap]
    assert nearer and all(balanced(one) < balanced(top) - error for one in nearer)
    assert best_limit(read, np.ones(200, bool), 5.0) == 5.0


def test_a_judge_tells_its_accuracy_on_episodes_that_it_was_not_fitted_to(episodes: None) -> None:
    told: list[str] = []
    made = train_judge(
        "rails_03",
        None,
        2,
        12,
        probe=WrittenPlaces(),
        tell=told.append,  # type: ignore[arg-type]
    )
    assert made.held_out.balanced == 1 and made.held_out.count == 20
    assert told == [f"training the judge: episode {count} of 40" for count in range(1, 41)]
    parts = np.full((12, 3, 2), 40.0)
    reward, ended = made.begun()(written(parts), None)
    assert reward == 0 and not ended
    parts[5:, 2] += 9
    assert made.success(made.score(written(parts)[None])).tolist() == [True]


def test_a_judge_reads_each_image_of_an_episode_once() -> None:
    sure = Accuracy(1.0, 1.0, 1.0, 1.0, 20, 10)
    made = StateJudge(task_of("rails_03"), WrittenPlaces(), 5.0, sure)  # type: ignore[arg-type]
    parts = np.cumsum(np.random.default_rng(0).uniform(0, 3, (12, 3, 2)), axis=0) + 20
    images = written(parts)
    in_turn, other = made.begun(), made.begun()
    rewards = [in_turn(images[:count], None)[0] for count in range(2, 13)]
    assert made.probe.count == 12  # type: ignore[attr-defined]
    assert rewards == [made.score(images[None, :count])[0] for count in range(2, 13)]
    assert other(images[6:8], None)[0] == made.score(images[None, 6:8])[0]  # another episode


def test_a_judge_that_is_no_better_than_chance_is_refused(episodes: None) -> None:
    with pytest.raises(HMAError, match="judge of rails_03: may be no better than chance: balanced"):
        train_judge("rails_03", None, 2, 12, probe=WrittenPlaces(True))  # type: ignore[arg-type]
    with pytest.raises(HMAError, match="no better than chance: .*all episodes have the same outcome"):
        train_judge("rails_03", None, 2, 12, task_of("rails_03", "moved=60"), probe=WrittenPlaces())  # type: ignore[arg-type]


@pytest.mark.parametrize("words", ["fly", "moved=far", "moved=0", "reached=999"])
def test_words_that_are_no_task_are_refused(words: str) -> None:
    with pytest.raises(UsageError, match="is not a task"):
        task_of("rails_03", words)
    assert task_of("pusht_fast").limit == 10 and task_of("arm1_02", "reached=9").limit == -9
