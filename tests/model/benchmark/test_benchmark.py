"""The benchmark: a flawless and a frozen model, plain loops as the oracle, and stops at every part."""

import json
import math
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hma_data.errors import OutputError, UsageError
from hma_data.tokenizers.base import get_tokenizer
from hma_model.benchmark import planning
from hma_model.benchmark import run as running
from hma_model.benchmark.measures import REACHED_PX, decisions, no_inverse
from hma_model.benchmark.planning import difference, plan, verdict
from hma_model.benchmark.report import compared, digest, read_results, rows, write_report
from hma_model.benchmark.run import QUICK, RESULTS, WORK, benchmark
from hma_model.checkpoint import io as checkpoints
from hma_model.checkpoint.folder import BUNDLED, Checkpoint
from hma_model.cli import main
from hma_model.evaluation.agreement import Accuracy
from hma_model.evaluation.calibration import NO_UNCERTAINTY
from hma_model.evaluation.metrics import PSNR_LIMIT
from hma_model.policies.judge import StateJudge, task_of
from hma_model.simulate import World
from hma_model.worlds.scenes import Dimension
from tests.model.evaluation.test_calibration import loops, rollouts
from tests.model.policies.test_scores import ROBOT, FlawlessWorld, KnownPlaces
from tests.model.true_world import tiny_model

TINY = replace(
    QUICK, robots=("absent", ROBOT), scenes=3, frames=4, noises=(0.0,), episodes=3, policy_frames=4
)


class FrozenWorld(FlawlessWorld):
    def step(self, actions: Any, *, decoded: bool = True) -> Any:
        return {row: self.rows[row].picture() for row in actions}


def world_of(kind: type[FlawlessWorld]) -> Any:
    return kind(World(tiny_model(ROBOT), get_tokenizer("fsq-8")))


@pytest.fixture(autouse=True, scope="module")
def probe() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as monkeypatch:
        known: Any = KnownPlaces(monkeypatch)
        sure = Accuracy(1.0, 1.0, 1.0, 1.0, 48, 24)
        judge = StateJudge(task_of(ROBOT, "reached"), known, -12.0, sure)
        monkeypatch.setattr(planning, "ROUNDS", 1)
        monkeypatch.setattr(planning, "CANDIDATES", 5)
        monkeypatch.setattr(running, "train_probe", lambda *given: known)
        monkeypatch.setattr(running, "train_judge", lambda *given, **named: judge)
        yield


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    made = tmp_path_factory.mktemp("best"), tmp_path_factory.mktemp("frozen")
    for folder, kind in zip(made, (FlawlessWorld, FrozenWorld), strict=True):
        write_report(benchmark(folder.name, folder, TINY, world=world_of(kind)), folder)
    return made


def test_a_flawless_model_has_every_figure_at_its_best_and_a_frozen_one_guesses(folders) -> None:
    best, frozen = (read_results(folder)["measures"] for folder in folders)
    assert list(best) == [ROBOT]
    one, other = best[ROBOT], frozen[ROBOT]
    assert one["psnr"] == PSNR_LIMIT and one["error_px_last"] == 0 and one["decision"] == 1
    assert one["decision_95"][0] < 0.5  # three scenes make nothing certain
    for folder in folders:  # the decisions are recomputed from what is written
        written = read_results(folder)
        choices, right = written["by_choice"][ROBOT], written["by_scene"][ROBOT]["decision"]
        for goal, true, made, said in zip(*choices.values(), right, strict=True):
            assert true[int(goal)] == 0 and said == (true[made.index(min(made))] <= REACHED_PX)
    assert one["inverse"]["return_px"] == one["inverse"]["true_return_px"] < 2 < one["inverse"]["turn_px"]
    assert one["policies"]["paired"]["first_chunks_equal"] and one["frames_per_second"] > 0
    assert other["psnr"] == other["copy_psnr"] < one["psnr"] and other["error_px"] > 1
    assert one["planning"]["gap"] == 0 and one["planning"]["truth"] == one["planning"]["model"]
    assert one["planning"]["verdict"] == "undecided"  # three scenes tell nothing
    assert other["planning"]["truth"] == one["planning"]["truth"]  # the same planner and simulator
    assert one["calibration"] == {"missing": NO_UNCERTAINTY} and "policies" in one
    assert other["inverse"]["return_px"] == other["inverse"]["turn_px"] == 0 < one["inverse"]["true_turn_px"]


class Blind(KnownPlaces):
    own = loose = np.array([], np.int64)


def test_a_probe_that_reads_nothing_measures_no_decision_and_no_calibration(tmp_path, monkeypatch) -> None:
    blind: Any = Blind(monkeypatch)
    monkeypatch.setattr(running, "train_probe", lambda *given: blind)
    monkeypatch.setattr(running._Robot, "_policies", lambda self: json.dumps({"missing": "no judge"}))
    world = world_of(FrozenWorld)
    stated = running.choose

    def choose(*given: Any, **how: Any) -> Any:
        found = stated(*given, **how)
        return found | {"uncertainty": np.ones_like(found["uncertainty"])}

    monkeypatch.setattr(running, "choose", choose)
    told: list[tuple[int, str, int]] = []
    found = benchmark(
        "it", tmp_path, replace(TINY, scenes=8), world=world, on_progress=lambda *one: told.append(one)
    )
    write_report(found, tmp_path)
    assert [words for _, words, _ in told][:2] == [f"{ROBOT}, action sequence {n} of 5" for n in (1, 2)]
    assert [(done, total) for done, _, total in told] == sorted((done, 5) for done, *_ in told)
    one = found["measures"][ROBOT]
    assert one["decision"] is one["decision_95"] is one["chance"] is one["error_px"] is None
    assert one["calibration"] == {"missing": "the probe locates no part"}
    shown = {row[1]: row[2] for row in rows(found)}
    assert shown["decision fidelity, share of right choices among 5"] == "not measured"
    assert "nan" not in (tmp_path / "benchmark.md").read_text().lower()
    assert ">None<" not in (tmp_path / "benchmark.html").read_text()


def test_the_calibration_is_recomputed_from_what_is_written(tmp_path, monkeypatch) -> None:
    uncertainty, errors = rollouts(4.0, scenes=12)
    made = np.zeros((*errors.shape, 1, 2))
    made[..., 0, 0] = errors
    found = {"uncertainty": uncertainty, "true": 0 * made, "made": made}
    found |= {"psnr": 40 - errors, "copy_psnr": 0 * errors}
    monkeypatch.setattr(running, "choose", lambda *given, **how: found)
    none = {way: np.zeros(12, bool) for way in planning.WAYS}
    monkeypatch.setattr(running._Robot, "_planned", lambda self: none)
    monkeypatch.setattr(running._Robot, "_policies", lambda self: json.dumps({"missing": "no judge"}))
    monkeypatch.setattr(running, "turn_back", lambda *given: {"return_px": np.ones(12)})
    benchmark("it", tmp_path, replace(TINY, scenes=12), world=world_of(FlawlessWorld))
    written = json.loads((tmp_path / RESULTS).read_text())
    frames = {name: np.array(values) for name, values in written["by_frame"][ROBOT].items()}
    stated = np.cumsum(frames["uncertainty"] ** 4, axis=-1) ** 0.25
    meter, clock, *_ = loops(stated, frames["error_px"])
    figures = written["measures"][ROBOT]["calibration"]
    assert (figures["right"], figures["clock"]) == (
        pytest.approx(meter, abs=1e-4),
        pytest.approx(clock, abs=1e-4),
    )
    rmse = 255 * 10 ** (-(40 - errors) / 20)
    np.testing.assert_allclose(frames["pixel_rmse"], rmse, atol=1e-3)


def test_meters_are_recorded_in_the_cards_of_a_checkpoint_of_this_machine(tmp_path, monkeypatch) -> None:
    folder = tmp_path / "model"
    shutil.copytree(BUNDLED["embedded-fsq"], folder)
    source = Checkpoint.open(folder)
    meter = {"verdict": "uncertainty warns of a state error of 1.7 px", "limit": 2.0}
    checkpoints.record_locally("org/name", source, "mover_04", meter, "meter")  # a copy of what is on the hub
    assert source.card("mover_04").get("meter") != meter
    checkpoints.record_locally(folder, source, "mover_04", meter, "meter")
    assert source.card("mover_04")["meter"] == meter

    def refused(*given: Any) -> None:
        raise OutputError(tmp_path, "cannot be written: Permission denied")

    monkeypatch.setattr(checkpoints, "record_evaluation", refused)
    checkpoints.record_locally(folder, source, "mover_04", {}, "meter")  # no error
    assert "uncertainty warns of a state error of 1.7 px" in (folder / "README.md").read_text()


CHOICES = st.tuples(st.integers(1, 4), st.integers(2, 5)).flatmap(
    lambda shape: st.tuples(
        *(arrays(np.float64, (*shape, 2, 2), elements=st.integers(0, 4)) for _ in range(2)),
        st.integers(0, 9),
    )
)


@settings(max_examples=30, deadline=None)
@given(CHOICES)
def test_a_decision_is_what_plain_loops_compute(drawn: tuple[np.ndarray, np.ndarray, int]) -> None:
    true, made, seed = drawn
    goals = np.random.default_rng([seed, 53]).integers(true.shape[1], size=len(true))
    found = decisions(true, made, seed)

    def far(places: np.ndarray, goal: np.ndarray) -> float:
        return sum(float(np.hypot(*(a - b))) for a, b in zip(places, goal, strict=True)) / len(places)

    for scene, goal in enumerate(goals):
        there = true[scene, goal]
        distances = [far(one, there) for one in made[scene]]
        truly = [far(one, there) for one in true[scene]]
        assert found["goal"][scene] == goal
        assert found["made_px"][scene].tolist() == pytest.approx(distances, abs=6e-4)
        assert found["true_px"][scene].tolist() == pytest.approx(truly, abs=6e-4)
        nearest = [k for k, value in enumerate(distances) if value <= min(distances) + 1e-3]
        assert found["right"][scene] in {truly[k] <= REACHED_PX + 1e-3 for k in nearest}


def test_actions_without_an_inverse_are_refused_by_name() -> None:
    rate, target = Dimension("vx", "m/s", -1, 1, "rate"), Dimension("grip", "", 0, 1, "switch")
    assert no_inverse([rate]) == ""
    assert "grip are positions or switches" in no_inverse([rate, target])
    assert "vx only ever went one way" in no_inverse([replace(rate, low=0.0)])


def test_the_planner_finds_actions_near_a_target(monkeypatch: pytest.MonkeyPatch) -> None:
    target = np.array([0.6, -0.3])
    low, high = np.full(2, -1.0), np.ones(2)

    def costs(candidates: np.ndarray) -> np.ndarray:
        return np.square(candidates.sum(axis=2) / 5 - target).sum(axis=-1)

    monkeypatch.setattr(planning, "ROUNDS", 4)
    monkeypatch.setattr(planning, "CANDIDATES", 16)
    found = plan(costs, low, high, 3, np.random.default_rng(0))
    assert found.shape == (3, 5, 2) and np.abs(found).max() <= 1
    assert np.linalg.norm(found.mean(axis=1) - target, axis=-1).max() < 0.2


@pytest.mark.parametrize(
    ("truth", "model", "words"),
    [(30, 5, "model"), (5, 3, "planner"), (30, 29, "undecided"), (16, 12, "undecided")],
)
def test_a_planning_gap_with_its_interval_and_verdict(truth: int, model: int, words: str) -> None:
    one, other = np.arange(32) < truth, np.arange(32) < model
    value, (low, high) = difference(one, other)
    assert value == pytest.approx((truth - model) / 32) and -1 <= low <= value <= high <= 1
    back, ends = difference(other, one)
    assert back == -value and ends == pytest.approx([-high, -low])
    # Bonett and Price: a pair is added to each kind of discordant scenes.
    more, less = (truth - model + 1) / 34, 1 / 34
    half = 1.959964 * math.sqrt((more + less - (more - less) ** 2) / 34)
    assert [low, high] == pytest.approx([min(more - less - half, value), max(more - less + half, value)])
    figures = {"gap_95": [low, high], "truth_95": [0.0, 0.4 if truth < 16 else 1.0]}
    assert verdict(figures) == words


def test_the_results_of_other_settings_are_refused(folders: tuple[Path, Path]) -> None:
    with pytest.raises(OutputError, match="holds the results of other settings"):
        benchmark("it", folders[0], TINY, seed=1, world=world_of(FlawlessWorld))


def test_the_card_the_page_and_a_comparison(folders, tmp_path, capsys) -> None:
    for folder in folders:
        found = read_results(folder)
        (page,) = folder.glob("*.html")
        assert "hma-benchmark 2, quick" in page.read_text()
        card = (folder / "benchmark.md").read_text()
        assert card.count("\n| ") == len(rows(found)) + 2 and "share of right choices among 5" in card
        assert card.count("not measured: there are too few scenes with ") == 3  # correlations have no verdict
        assert "not measured: 3 of at least 8 episodes" in card
    one, other = map(read_results, folders)
    table = {row[1]: row[2:] for row in compared(one, other).rows}
    errors = np.array(other["by_scene"][ROBOT]["error_px"])
    assert table["state error, px of 128"][2].startswith(f"{errors.mean():.2f} (")
    same = {row[1]: row[4] for row in compared(one, one).rows}
    rare = {"0.00 (-0.55 to 0.55)"}  # outcomes that agree in so few scenes may differ in others
    assert same["decision fidelity, share of right choices among 5"] in rare
    assert set(same.values()) <= {"", "0.00 (0.00 to 0.00)"} | rare
    slow = compared(one, {**one, "unmask_steps": 8})  # the same checkpoint, decoded otherwise
    assert slow.columns[2:4] == tuple(f"{one['checkpoint']}, unmask steps {steps}" for steps in (2, 8))
    assert main(["benchmark", "--compare", *map(str, folders), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[0]["robot"] == ROBOT
    with pytest.raises(UsageError, match="differ in seed"):
        compared(one, {**other, "seed": 1})
    with pytest.raises(UsageError, match="none of the benchmark's robots: absent"):
        benchmark("it", tmp_path / "none", replace(TINY, robots=("absent",)), world=world_of(FlawlessWorld))
    assert main(["benchmark"]) == 2


def test_damaged_results_are_refused_with_what_to_do(folders: tuple[Path, Path], tmp_path: Path) -> None:
    path = tmp_path / RESULTS
    for damage in (None, b"", b"[1]", b"\xff", b"[" * 100_000, b"{}"):
        if damage is not None:
            path.write_bytes(damage)
        with pytest.raises(OutputError, match="benchmark.json: holds no results of the benchmark — give the"):
            read_results(path)
    with pytest.raises(OutputError, match="delete a damaged one to measure again"):
        benchmark("it", tmp_path, TINY, world=world_of(FlawlessWorld))
    whole = (folders[0] / RESULTS).read_text()
    without = {key: value for key, value in json.loads(whole).items() if key != "sha256"}
    for edited in (whole.replace('"decision": 1.0', '"decision": 0.9'), json.dumps(without)):
        path.write_text(edited)
        with pytest.raises(OutputError, match="is damaged or edited"):
            read_results(tmp_path)


def test_finished_results_of_a_killed_job_still_record_meters_and_remove_its_parts(
    folders: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(folders[0], tmp_path / "out")
    (tmp_path / "out" / WORK).mkdir()
    found = json.loads((tmp_path / "out" / RESULTS).read_text())
    (robot, one), *_ = found["measures"].items()
    assert all("missing" in other["calibration"] for other in found["measures"].values())
    one["calibration"]["meter"], recorded = {"limit": 2.0}, list[Any]()
    del found["sha256"]
    (tmp_path / "out" / RESULTS).write_text(json.dumps(found | {"sha256": digest(found)}))
    monkeypatch.setattr(running, "record_locally", lambda *given: recorded.append(given[2:]))
    benchmark("it", tmp_path / "out", TINY, world=world_of(FlawlessWorld))
    assert recorded == [(robot, {"limit": 2.0}, "meter")]
    assert not (tmp_path / "out" / WORK).exists()
