"""Policies scored twice: in a world without error both agree; faults of policies are one clear line."""

import random
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from hma_data.errors import HMAError, OutputError, UsageError
from hma_data.lab import truth
from hma_data.lab.simulator import LabSimulator
from hma_data.tokenizers.base import get_tokenizer
from hma_model.evaluation.agreement import Accuracy
from hma_model.evaluation.calibration import Meter
from hma_model.generation.commands import OutsideRangeWarning
from hma_model.network.model import HMA
from hma_model.policies import scores
from hma_model.policies.arenas import ModelArena, Scenes, TrueArena
from hma_model.policies.base import begin, checked
from hma_model.policies.catalog import read_policy
from hma_model.policies.judge import StateJudge, task_of
from hma_model.policies.recorded import ModelEvaluation, Played
from hma_model.policies.report import html, sentences, table
from hma_model.policies.scores import (
    MODEL,
    REPLAYED,
    TRUE,
    PolicyEvaluation,
    Scored,
    evaluate_policies,
    run,
    score_policy,
)
from hma_model.policies.scripted import Called, Still
from hma_model.simulate import World, load_world
from tests.model.true_world import TrueWorld, tiny_model

ROBOT = "rails_03"
POLICIES = ["scripted", "scripted:noise=0.5", "random", "still"]


class KnownPlaces:
    """A probe that knows the places in every image that a simulator drew."""

    own, loose, driven = np.array([0, 1]), np.array([2, 3]), 2

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.known: dict[bytes, np.ndarray] = {}
        draw = LabSimulator.picture

        def image(simulator: LabSimulator) -> np.ndarray:
            drawn = draw(simulator)
            self.known[drawn.tobytes()] = truth.parts_of(simulator.simulation)[1]
            return drawn

        monkeypatch.setattr(LabSimulator, "picture", image)

    def read(self, images: np.ndarray) -> np.ndarray:
        flat = images.reshape(-1, *images.shape[-3:])
        blank = np.full((4, 2), 64.0)
        found = np.stack([self.known.get(one.tobytes(), blank) for one in flat])
        return found.reshape(*images.shape[:-3], *found.shape[1:])

    def areas(self, images: np.ndarray) -> np.ndarray:
        return np.ones((*images.shape[:-3], 4))

    def __reduce__(self) -> Any:
        return KnownPlaces, ()  # what it has seen so far makes no other judge of it


def made_judge(patch: pytest.MonkeyPatch) -> StateJudge:
    known: Any = KnownPlaces(patch)
    return StateJudge(task_of(ROBOT, "moved=2"), known, 2.0, Accuracy(1.0, 1.0, 1.0, 1.0, 48, 24))


@pytest.fixture
def judge(monkeypatch: pytest.MonkeyPatch) -> StateJudge:
    return made_judge(monkeypatch)


@pytest.fixture(scope="module")
def still(model: HMA) -> PolicyEvaluation:
    with pytest.MonkeyPatch.context() as patch:
        given: Any = {"world": World(model, get_tokenizer("fsq-8")), "judge": made_judge(patch)}
        return evaluate_policies(ROBOT, ["still"], episodes=8, frames=4, **given)


class FlawlessWorld(TrueWorld):
    """Simulators in place of a model: its sessions do what truly happens."""

    def __init__(self, world: World) -> None:
        super().__init__()
        self.model, self.tokenizer, self.image_shape = world.model, world.tokenizer, world.image_shape
        self.action_spec, self.shown, self.precision = world.action_spec, world.shown, world.precision


def test_in_a_world_without_error_both_scores_agree(world: World, judge: StateJudge) -> None:
    flawless: Any = FlawlessWorld(world)
    found = evaluate_policies(ROBOT, POLICIES, world=flawless, judge=judge, episodes=4, frames=10)
    for one in found.policies:
        np.testing.assert_allclose(one.scores[MODEL], one.scores[REPLAYED], atol=1e-6)
        if one.policy != "scripted":  # it steers by places, whose pose is found to a few digits
            np.testing.assert_allclose(one.scores[MODEL], one.scores[TRUE], atol=1.0)
    assert (found.policies[2].scores[MODEL] == found.policies[2].scores[TRUE]).all()
    assert np.array_equal(found.policies[2].true_images, found.policies[2].model_images)
    assert found.policies[3].scores[TRUE].max() == 0 and found.policies[0].scores[TRUE].max() > 2
    assert found.generated.balanced == 1 and found.followed.reason == "4 of at least 8 episodes"
    assert found.precision.value == found.recall.value == 1
    assert "too few scenes with successes" in found.refusal  # of four scenes
    assert found.success["pearson"].reason == "4 of at least 8 episodes"


def test_policies_of_gym_pusht_are_told_where_the_disc_is(monkeypatch: pytest.MonkeyPatch) -> None:
    world = FlawlessWorld(load_world("embedded", ["pusht_fast"]))
    world.image_shape = 128, 128, 3  # as the simulator draws
    probe: Any = KnownPlaces(monkeypatch)
    true = TrueArena(Scenes.of(world, "pusht_fast", 2, 0), 128)  # type: ignore[arg-type]
    arena = ModelArena(world, true, probe)  # type: ignore[arg-type]
    for step in range(2 * arena.scenes.stride + 1):
        told = arena.observed()
        assert told is not None and told.shape == (2, 2)
        near = 1 if arena.fresh else 25  # of 512 px; between images it is estimated
        np.testing.assert_allclose(told, true.observed(), atol=near)
        for one in (true, arena):
            one.step(np.array([[100, 400], [250, 60 + 5 * step]], np.float32))
    arena.close()


def test_shares_have_exact_intervals_and_too_few_successes_are_said(still: PolicyEvaluation, judge) -> None:
    found = still
    (row,) = found.rows()
    assert row["true_success"] == 0 and row["true_success_interval"] == pytest.approx((0, 0.369), abs=1e-3)
    doubt = "there are too few scenes with successes to tell whether the judge is better"
    assert any(doubt in sentence for sentence in sentences(found))
    assert found.refusal.endswith("(about 4 with successes and 4 with failures are needed)")
    assert row["episodes_alike"] == 1 and row["episodes_alike_interval"][0] == pytest.approx(0.631, abs=1e-3)
    assert "100% (63%–100%)" in str(table(found))  # of eight episodes
    assert "recall: the model shows an unknown share (nothing truly succeeds)" in str(sentences(found))
    assert str(found.generated).startswith("not computed: all episodes have the same outcome (8 episodes")
    page = html(found)
    assert page.count(doubt) == 1 and page.index(doubt) < page.index("<table") and page.count("<img") >= 2
    for high, said in (
        (0.6, "the judge is no better than chance"),
        (0.9, "may be no better than chance; more"),
    ):
        generated = Accuracy(0.5, 0.4, high, share=0.5, count=32, successes=4)
        half = np.where(np.arange(24) < 12, 8.0, 2.0)
        assert said in replace(evaluation(judge, [scored_as("p", half, half)]), generated=generated).refusal


METER = Meter(2, 0.0, (0.0, 8.0), (1.0, 17.0), 2.0, 3.0, 0.8, 0.5, 0.1, 0.1, better=True, chooses=True)
UNABLE = replace(METER, chooses=False)


def scored_as(name: str, model: np.ndarray, replayed: np.ndarray, limit: float = 5.0) -> Scored:
    images = np.zeros((len(model), 1, 8, 8, 3), np.uint8)
    values = np.stack([replayed, model, replayed])
    return Scored(name, values, values >= limit, np.zeros(1, int), images, images, np.arange(len(model)) / 4)


def evaluation(judge: StateJudge, policies: list[Scored], **asked: Any) -> PolicyEvaluation:
    made = {one.policy: one for one in policies}
    with pytest.MonkeyPatch.context() as patch:
        arrays = {name: dict(vars(one)) for name, one in made.items()}
        for one in arrays.values():
            del one["policy"]
        patch.setattr(scores, "score_policy", lambda name, **given: arrays[name])
        patch.setattr(scores, "begin", lambda *given: None)
        patch.setattr(scores, "checked", lambda *given: None)
        world: Any = FlawlessWorld(World(tiny_model(ROBOT), get_tokenizer("fsq-8")))
        meters = (METER, "") if "max_error" in asked else (None, "")
        patch.setattr(FlawlessWorld, "meter", lambda self, robot: meters)
        given: Any = {"world": world, "judge": judge, "episodes": 24, "frames": 4} | asked
        return evaluate_policies(ROBOT, [(name, Still()) for name in made], **given)


def test_no_verdict_where_single_episodes_do_not_agree(judge: StateJudge) -> None:
    rng = np.random.default_rng(0)
    rates = (0.1, 0.3, 0.5, 0.7, 0.9)
    agreeing, unrelated = [], []
    for number, rate in enumerate(rates):
        true = np.where(rng.random(24) < rate, 8.0, 2.0) + rng.random(24)
        agreeing.append(scored_as(f"p{number}", true + rng.normal(0, 0.5, 24), true))
        unrelated.append(scored_as(f"p{number}", rng.permutation(24) % 9 + 0.0, true))
    found = evaluation(judge, agreeing)
    assert found.refusal == "" and found.precision.value == found.recall.value == 1
    assert any(sentence.startswith("success rates over policies: Pearson") for sentence in sentences(found))
    wrong = evaluation(judge, unrelated)
    assert wrong.refusal and wrong.to_json()["refused"] == wrong.refusal
    said = sentences(wrong)
    assert any("no verdict" in sentence for sentence in said) and not any("Pearson" in one for one in said)
    page = html(wrong)
    assert page.index("no verdict" if "no verdict" in page else "No verdict") < page.index("<table")
    assert "correlation of success rates" not in page and "correlation of success rates" in html(found)


def test_episodes_that_begin_alike_count_once() -> None:
    images, judged = np.zeros((32, 1, 8, 8, 3), np.uint8), np.ones(32, np.bool_)
    every: Any = [Played(name, made * 1.0, made, images) for name, made in (("a", judged), ("b", ~judged))]
    known: Any = SimpleNamespace(sentence="")
    found = ModelEvaluation("arm", "run", "", 0, 4, 2, known, tuple(every))
    assert found.rows()[0]["model_success_interval"] == pytest.approx((0.158, 1), abs=1e-3)
    assert "not distinguishable by success: a and b" in found.sentences()


def test_a_model_abstains_where_it_expects_a_large_error_of_its_own(judge, monkeypatch) -> None:
    true = np.where(np.arange(24) % 2 == 0, 8.0, 2.0)
    read = np.where(np.arange(24) < 12, true, 10 - true)  # the unsure half is wrong
    policies = [scored_as(f"p{number}", read, true) for number in range(3)]
    found = evaluation(judge, policies, max_error=6.5)
    assert found.precision.value == 0.5 and found.abstention is not None
    kept = sum(1 + 2 * number / 4 <= 6.5 for number in range(24))  # by the line of the meter
    assert (found.abstention.judged, found.abstention.count) == (3 * kept, 72) and kept == 12
    assert found.abstention.precision.value == found.abstention.recall.value == 1
    assert "36 of 72 episodes end with an expected state error of at most 6.5 px" in str(sentences(found))
    assert found.to_json()["outcomes"]["p0"]["stated_uncertainty"][4] == 1
    uncalibrated = replace(METER, stated=(0.0, 1.5))  # which says nothing beyond 3, where an error may be any
    monkeypatch.setattr(sys.modules[__name__], "METER", uncalibrated)
    beyond = evaluation(judge, policies, max_error=99.0).abstention
    assert beyond is not None and beyond.judged == 3 * sum(number / 4 <= 3 for number in range(24)) == 39
    none = evaluation(judge, policies, max_error=0.5)
    assert "nothing is judged" in str(sentences(none))
    assert evaluation(judge, policies).abstention is None
    for meter, said in (
        ((None, "it is not calibrated"), "not calibrated"),
        ((UNABLE, ""), "may err no less"),
    ):
        monkeypatch.setattr(FlawlessWorld, "meter", lambda self, robot, meter=meter: meter)
        world: Any = FlawlessWorld(World(tiny_model(ROBOT), get_tokenizer("fsq-8")))
        with pytest.raises(UsageError, match=f"--max-error: .*{said}"):
            evaluate_policies(ROBOT, ["still"], world=world, judge=judge, max_error=2.0)


def test_outcomes_alone_are_no_verdict_where_scores_say_nothing(judge: StateJudge) -> None:
    true = np.where(np.arange(24) < 6, 8.0, 2.0) + np.arange(24) / 24
    read = np.where(true >= 5, 8.0, 2.0) - np.arange(24) / 24  # of like outcomes, the better score less
    found = evaluation(judge, [scored_as(f"p{number}", read, true) for number in range(3)])
    assert found.generated.better_than_chance and found.precision.value == 1
    assert "no better than chance" in found.refusal and "Pearson" not in " ".join(sentences(found))


def test_a_few_lost_episodes_do_not_refuse_a_verdict(judge: StateJudge) -> None:
    true = np.where(np.arange(24) < 12, 8.0, 2.0) + np.arange(24) % 5
    read = true.copy()
    read[[0, 20]] = -900.0
    found = evaluation(judge, [scored_as(f"p{number}", read, true) for number in range(3)])
    assert found.refusal == "" and found.followed.low > 0.4


def test_policies_that_cannot_be_told_apart_are_named(judge: StateJudge) -> None:
    outcomes = np.zeros((4, 24))
    outcomes[1, :1] = outcomes[2, :2] = 9.0
    outcomes[3, :20] = 9.0
    names = ("none", "one", "two", "most")
    found = evaluation(judge, [scored_as(name, row, row) for name, row in zip(names, outcomes, strict=True)])
    apart = [("none", "one"), ("none", "two"), ("one", "two")]
    assert found.alike(TRUE) == found.alike(MODEL) == apart
    assert found.to_json()["alike"] == {"simulator": apart, "model": apart}
    (said,) = [one for one in sentences(found) if "not distinguishable by success in the model" in one]
    assert said.endswith("none and one; none and two; one and two")
    alike = evaluation(judge, [scored_as(name, outcomes[0], outcomes[0]) for name in names])
    assert "no two policies are distinguishable by success in the model" in sentences(alike)


@pytest.mark.slow
def test_a_policy_that_was_edited_is_scored_again(world, judge, tmp_path, monkeypatch) -> None:
    begun = list[str]()

    def score(name: str, **given: Any) -> dict[str, Any]:
        begun.append(name)
        return score_policy(name, **given)

    def written(value: int) -> list[str]:
        sys.modules.pop("mine", None)
        (tmp_path / "mine.py").write_text(f"act = lambda image: [{value}, 0]\n")
        before = len(begun)
        given: Any = {"world": world, "judge": judge, "episodes": 2, "frames": 4, "out": tmp_path / "out"}
        evaluate_policies(ROBOT, ["mine:act", "still"], **given)
        return begun[before:]

    monkeypatch.setattr(scores, "score_policy", score)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    assert written(1) == ["mine:act", "still"] and written(1) == []
    assert written(2) == ["mine:act"] and written(1) == []
    sys.modules.pop("mine")


def noisy(image: np.ndarray) -> np.ndarray:
    """Act on the image and on the global random numbers of three libraries."""
    drawn = random.random() + np.random.random() + float(torch.rand(1))  # noqa: NPY002
    DRAWN.append(drawn)
    return np.array([image.mean() / 100, drawn], np.float32)


def unseeded(image: np.ndarray) -> np.ndarray:
    return np.random.default_rng().random(2)


DRAWN: list[float] = []


@pytest.mark.parametrize("name", [f"{__name__}:noisy", "scripted:noise=0.5", "reach"])
def test_branches_share_start_state_and_the_random_numbers_of_every_step(world, judge, name) -> None:
    scenes = Scenes.of(world, ROBOT, 2, 0)
    true = TrueArena(scenes, 128)
    policy = read_policy(name, scenes)
    DRAWN.clear()
    before = random.getstate(), torch.get_rng_state()
    _, acted = run("it", policy, true, 3)
    model = ModelArena(world, true, judge.probe)
    images, made = run("it", policy, model, 3)
    stride = scenes.stride
    assert np.array_equal(acted[:stride], made[:stride])  # of the same image, though the model's is decoded
    assert not np.array_equal(images[0], true.first_images) and not np.array_equal(acted, made)
    assert DRAWN[: len(DRAWN) // 2] == DRAWN[len(DRAWN) // 2 :]
    assert len(set(DRAWN)) * 2 == len(DRAWN)  # other numbers at each step and in each scene
    assert before[0] == random.getstate() and torch.equal(before[1], torch.get_rng_state())
    model.close()


class LateUnseeded:
    """It draws from a generator of its own after its first chunk."""

    def __init__(self) -> None:
        self.calls, self.rng = 0, np.random.default_rng()

    def __call__(self, image: np.ndarray) -> np.ndarray:
        self.calls += 1
        return np.array([0.0, self.rng.normal() if self.calls > 9 else 0.0])


@pytest.mark.parametrize("name", ["unseeded", "LateUnseeded"])
def test_a_function_that_acts_otherwise_on_the_same_images_is_refused(world, judge, name) -> None:
    scenes = Scenes.of(world, ROBOT, 2, 0)
    assert scenes.stride < 9
    with pytest.raises(HMAError, match="is not deterministic: shown the same images again, its actions diff"):
        score_policy("it", read_policy(f"{__name__}:{name}", scenes), world, scenes, judge, 12)


@pytest.mark.parametrize("broken", ["image", "seed", "state"])
def test_branches_that_do_not_begin_alike_are_refused(world, judge, broken, monkeypatch) -> None:
    name = {"seed": "random", "state": "reach"}.get(broken, f"{__name__}:noisy")
    made = ModelArena.__init__

    def begun(self: ModelArena, *given: Any) -> None:
        made(self, *given)
        if broken == "image":
            self.images = self.made
        if broken == "seed":
            self.scenes = replace(self.scenes, seed=self.scenes.seed + 1)
        if broken == "state":
            self._first_states = []

    monkeypatch.setattr(ModelArena, "__init__", begun)
    scenes = Scenes.of(world, ROBOT, 2, 0)
    with pytest.raises(HMAError, match="is not deterministic: from the same image, its first actions differ"):
        score_policy("it", read_policy(name, scenes), world, scenes, judge, 4)


def test_a_random_action_is_held_for_a_chunk_and_stays_in_range(world: World) -> None:
    arena = TrueArena(Scenes.of(world, ROBOT, 3, 0), 128)
    policy = read_policy("random", arena.scenes)
    begin("random", policy, arena)
    actions = []
    for _ in range(2 * arena.scenes.stride):
        actions.append(checked("random", policy, arena))
        arena.step(actions[-1])
    chunks = np.array(actions).reshape(2, arena.scenes.stride, 3, -1)
    assert (chunks == chunks[:, :1]).all() and (chunks[0] != chunks[1]).all()
    high = np.array([dim.high for dim in arena.scenes.dimensions])
    assert (np.abs(chunks) <= high).all()


class Wild:
    def __call__(self, image: np.ndarray) -> list[float]:
        return [900, 0]


def test_a_policy_that_leaves_the_range_of_training_is_named_once(world: World, judge: StateJudge) -> None:
    seen = replace(world.action_spec(ROBOT), seen=np.array([[-50, -50], [50, 50]], np.float32))
    flawless: Any = FlawlessWorld(world)
    flawless.action_spec = lambda name: seen
    with pytest.warns(OutsideRangeWarning) as warned:
        found = evaluate_policies(
            ROBOT, [("wild", Called(Wild)), "still"], world=flawless, judge=judge, episodes=2, frames=4
        )
    (said,) = [str(one.message) for one in warned]
    assert found.followed.value is None  # of four episodes it would say nothing
    assert said.startswith("policy wild: rails_03: an action is outside") and "(action_0 -50 to 50)" in said


class Counter:
    """A policy with a memory: its action is the number of its calls in this episode."""

    def __init__(self) -> None:
        self.calls = -99

    def reset(self) -> None:
        self.calls = 0

    def __call__(self, image: np.ndarray) -> list[float]:
        assert image.shape == (128, 128, 3) and image.dtype == np.uint8
        self.calls += 1
        return [self.calls, 0]


SHARED = Counter()


def short(image: np.ndarray) -> np.ndarray:
    return np.zeros(3)


def nan(image: np.ndarray) -> np.ndarray:
    return np.array([0, np.nan])


def broken(image: np.ndarray) -> np.ndarray:
    raise KeyError("left")


@pytest.mark.parametrize("name", ["Counter", "SHARED"])
def test_what_a_policy_remembers_belongs_to_one_episode(world: World, name: str) -> None:
    arena = TrueArena(Scenes.of(world, ROBOT, 2, 0), 128)
    policy = read_policy(f"{__name__}:{name}", arena.scenes)
    for _ in range(2):
        begin(name, policy, arena)
        for calls in (1, 2):
            assert checked(name, policy, arena).tolist() == [[calls, 0]] * 2
    assert SHARED.calls == -99


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("short", "returns actions of the shape (3,) — rails_03 takes (2,): "),
        ("nan", "returns NaN or infinite values"),
        ("broken", "raised KeyError: 'left'"),
        ("missing", "cannot be imported: AttributeError"),
        ("ROBOT", "is 'rails_03', which cannot be called — name a function or class"),
    ],
)
def test_a_policy_that_fails_is_named_before_the_judge_is_trained(world: World, name: str, said: str) -> None:
    with pytest.raises(HMAError, match=re.escape(said)) as fault:
        evaluate_policies(ROBOT, [f"{__name__}:{name}"], world=world, episodes=2, frames=4)
    assert name in str(fault.value) and "\n" not in str(fault.value)


def test_a_module_that_is_not_there_is_said_with_where_it_is_looked_for(world: World) -> None:
    with pytest.raises(HMAError, match="No module named 'nowhere' . run hma in the folder of nowhere.py"):
        read_policy("nowhere:policy", Scenes.of(world, ROBOT, 1, 0))


def test_a_module_or_policy_that_exits_is_an_error(world: World, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "leaves.py").write_text("import sys\nsys.path[:] = sys.path[1:]\nraise SystemExit(0)")
    scenes = Scenes.of(world, ROBOT, 1, 0)
    with pytest.raises(HMAError, match="leaves:act: cannot be imported: SystemExit"):
        read_policy("leaves:act", scenes)
    arena, policy = TrueArena(scenes, 128), Called(sys.exit)
    begin("it", policy, arena)
    with pytest.raises(HMAError, match="policy it: raised SystemExit"):
        checked("it", policy, arena)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("scripted", "scripted:noise=0"),
        ("scripted:noise=.5", "scripted:noise=0.50"),
        ("random", "scripted:noise=1"),
        ("hma:model", "hma:./model,horizon=1"),
        ("lerobot:model", "lerobot:model/"),
        ("plan:cem,steps=3,horizon=6", "plan:cem"),
        ("still", "still"),
    ],
)
def test_two_spellings_of_one_policy_are_refused(one: str, other: str, tmp_path, monkeypatch) -> None:
    (tmp_path / "model").mkdir()
    monkeypatch.chdir(tmp_path)
    said = "is given twice" if one == other else f"is the same policy as {one}"
    with pytest.raises(UsageError, match=f"policy {re.escape(other)}: {re.escape(said)} — give each once"):
        scores.names_of(["scripted:noise=0.3", one, other])
    told = ["scripted", "reach", "scripted:noise=0.1", "hma:model,horizon=2", "hma:model", "plan:mppi"]
    assert scores.names_of([*told, ("mine", Still())]) == [*told, "mine"]
    with pytest.raises(UsageError, match="policy reach: is given twice"):
        scores.names_of([*told, ("reach", Still())])


@pytest.mark.parametrize("words", ["fly", "scripted:noise=2", "scripted:speed=1"])
def test_words_that_are_no_policy_are_refused(world: World, words: str) -> None:
    with pytest.raises(UsageError, match="is unknown"):
        read_policy(words, Scenes.of(world, ROBOT, 1, 0))


def test_a_robot_without_a_simulator_or_with_several_cameras_is_refused(world: World, monkeypatch) -> None:
    from hma_model.cli import app
    from tests.model.robots import make_model

    other = object.__new__(World)
    other.model, other._specs = make_model({"arm": 2}), {}
    with pytest.raises(HMAError, match="arm: has no simulator to compare"):
        Scenes.of(other, "arm", 1, 0)
    monkeypatch.setattr(world.model, "config", world.model.config.replace(views=2))
    with pytest.raises(UsageError, match="rails_03: the simulator shows one camera, and the model sees 2"):
        evaluate_policies(ROBOT, ["still"], world=world)
    assert "POLICY" in CliRunner().invoke(app, ["policy-eval", "--help"]).output


def test_a_file_in_place_of_the_folder_is_refused_before_the_work(tmp_path: Path) -> None:
    from hma_model.cli import app

    (tmp_path / "a file").write_text("")
    ran = CliRunner().invoke(app, ["policy-eval", ROBOT, "still", "--out", str(tmp_path / "a file")])
    assert isinstance(ran.exception, OutputError) and "a file: cannot be written: " in str(ran.exception)


@pytest.mark.slow
def test_a_narrow_window_shows_the_last_columns(world: World, judge: StateJudge) -> None:
    from playwright.sync_api import sync_playwright

    if not (chromium := shutil.which("chromium")):
        pytest.skip("no Chromium")
    found = evaluate_policies(ROBOT, ["random", "still"], world=world, judge=judge, episodes=8, frames=4)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 500, "height": 900})
        page.set_content(html(found))
        table = page.locator(".scroll").first
        assert table.evaluate("box => box.scrollWidth - box.clientWidth") == 0
        browser.close()


def test_policies_that_are_paths_go_by_short_names_with_a_legend(still: PolicyEvaluation) -> None:
    names = ("hma:build/runs/of/a/policy/few,memory=1", "hma:build/runs/of/a/policy/many,memory=1")
    (own,) = still.policies
    page = html(replace(still, policies=(*(replace(own, policy=name) for name in names), own)))
    for short, name in zip(("few,memory=1", "many,memory=1"), names, strict=True):
        assert f"<dt>{short}</dt><dd>{name}</dd>" in page and page.count(name) == 1
        assert page.index(name) < page.index("<table") < page.index(f">{short}<", page.index("<table"))
