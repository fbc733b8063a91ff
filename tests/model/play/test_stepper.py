"""The stepper of `hma play`: clocks, batches, the truth beside the model, and sessions that end."""

import math
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hma_data.errors import UsageError
from hma_data.lab.simulator import LabSimulator
from hma_model.evaluation.calibration import Meter
from hma_model.generation.unmask import Decoding
from hma_model.play.session import DivergenceDetector, Session
from hma_model.play.stepper import Stepper
from hma_model.worlds.scenes import PROMPT_FRAMES, SCENE_SEED
from tests.model.true_world import TrueWorld, Watcher, lab_robots

ROBOTS = ("mover_04", "arm3_04", "pendulum")


class Bench:
    def __init__(self, **settings: Any) -> None:
        self.world = TrueWorld()
        robots = lab_robots(*ROBOTS)
        self.stepper = Stepper(dict.fromkeys(robots, self.world), robots, **settings)

    def open(self, robot: str = "mover_04", scene: int = 0) -> tuple[Session, Watcher]:
        session, viewer = self.stepper.open(robot, scene), Watcher()
        self.stepper.attach(session.name, viewer)
        session.paused = False
        return session, viewer

    def step(self, count: int = 1) -> None:
        for _ in range(count):
            for session in self.stepper.sessions.values():
                session.due = 0.0
            self.stepper.step()


def test_sessions_that_are_due_share_a_pass_and_hold_their_own_actions() -> None:
    bench = Bench()
    sessions = [bench.open(robot)[0] for robot in ROBOTS]
    for number, session in enumerate(sessions):
        session.held = np.full_like(session.held, 0.25 * (number + 1))
    bench.step()
    (chunks,) = bench.world.steps
    for number, session in enumerate(sessions):
        expected = np.full(session.robot.embodiment.chunk_dim, 0.25 * (number + 1), np.float32)
        np.testing.assert_array_equal(chunks[session.row], expected)


def test_sessions_of_two_models_are_stepped_by_their_own() -> None:
    worlds = {"mover_04": TrueWorld(), "pendulum": TrueWorld()}
    worlds["pendulum"].one_pass = True
    worlds["pendulum"].decoding = Decoding(1, 0.0)
    stepper = Stepper(worlds, lab_robots(*worlds))
    for robot, one_pass in (("mover_04", False), ("pendulum", True)):
        session = stepper.open(robot, 0)
        stepper.attach(session.name, Watcher())
        session.paused, session.due = False, 0.0
        assert session.status()["one_pass"] == one_pass
    stepper.step()
    assert [len(world.steps) for world in worlds.values()] == [1, 1]
    assert [world.sampling[0][0] for world in worlds.values()] == [2, 1]


def test_a_session_steps_at_the_rate_of_its_robot_or_as_fast_as_it_can() -> None:
    bench = Bench()
    session, viewer = bench.open("mover_04")  # 10 frames a second
    image = bench.world.image(session.row)
    due = []
    for now in (100.02, 100.15, 105.0):  # the third is late; what was missed is not made up for
        session.due = due[-1] if due else 100.0
        session.next_chunk()
        session.take(image, now, 0.0)
        due.append(session.due)
    assert due == pytest.approx([100.1, 100.2, 105.0])
    assert not session.ready(104.9) and session.ready(105.0)
    session.fast, session.due = True, 0.0
    bench.stepper.step()
    bench.stepper.step()
    assert len(viewer.frames) == 5
    viewer.behind = 2  # its page has not shown the last two
    bench.stepper.step()
    assert len(viewer.frames) == 5


def test_a_paused_session_makes_single_frames_and_one_without_viewer_none() -> None:
    bench = Bench()
    session, viewer = bench.open()
    session.paused = True
    bench.step(3)
    session.steps = 1
    bench.step(3)
    assert [frame.number for frame in viewer.frames] == [1]
    session.paused = False
    bench.stepper.detach(viewer)
    bench.step(3)
    assert session.count == 1


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_simulator_runs_beside_under_the_same_actions(robot: str) -> None:
    bench = Bench()
    session, viewer = bench.open(robot, scene=1)
    rng = np.random.default_rng(0)
    for _ in range(6):
        session.held = rng.uniform([d.low for d in session.robot.dimensions]).astype(np.float32)
        bench.step()
    assert [frame.psnr for frame in viewer.frames] == [60.0] * 6  # the world is the simulator too
    assert session.parted is None


def test_replay_gives_the_actions_of_the_recorded_episode() -> None:
    bench = Bench()
    session, viewer = bench.open("arm3_04", scene=2)
    session.replays = True
    bench.step(5)
    simulator = LabSimulator("arm3_04")
    simulator.reset(SCENE_SEED, 2)
    actions = []
    for _ in range((PROMPT_FRAMES - 1 + 5) * session.robot.embodiment.stride):
        actions.append(simulator.recorded())
        simulator.advance(actions[-1])
    driven = np.concatenate([frame.actions for frame in viewer.frames])
    np.testing.assert_array_equal(driven, actions[-len(driven) :])


def test_they_part_when_for_a_second_a_still_is_as_near_to_the_truth_as_the_model() -> None:
    bench = Bench()
    session, _ = bench.open()
    bench.step(7)
    bench.world.blind.add(session.row)
    bench.step(9)
    assert session.parted is None  # ten frames are a second
    bench.step(2)
    assert session.parted == 8
    session.sync()
    assert session.parted is None and session.status()["parted"] is None


METER = Meter(2, 0.0, (0.0, 4.0), (1.0, 9.0), 2.0, 3.0, 0.8, 0.5, 0.1, 0.1, better=True, chooses=True)


def test_the_meter_of_uncertainty_warns_until_a_sync_and_is_refused_if_no_better_than_a_clock() -> None:
    bench = Bench()
    session, _ = bench.open()
    assert session.metered is None and session.status()["unmetered"] == "it is never unsure"
    known: dict[int, tuple[Meter | None, str]] = {2: (METER, ""), 3: (replace(METER, better=False), "")}
    bench.world.meter = lambda robot, **way: known[way["unmask_steps"]]  # type: ignore[method-assign]
    session.sample(session.sampling)
    session.sync()
    bench.world.uncertainty[session.row] = 1.5
    found = []
    for _ in range(4):
        bench.step()
        found.append(session.metered)
    assert bench.world.decoding.measure
    roots = [1.5 * count**0.25 for count in (1, 2, 3, 4)]
    assert found == [{"px": round(1 + 2 * root, 1), "beyond": False, "warns": root >= 2} for root in roots]
    bench.world.uncertainty[session.row] = 5.0
    bench.step()
    assert session.metered == {"px": 9.0, "beyond": True, "warns": True}
    session.sync()
    assert session.metered == {"px": 1.0, "beyond": False, "warns": False}
    session.sample(replace(session.sampling, unmask_steps=3))
    assert session.metered is None and "may be no better" in session.status()["unmetered"]
    bench.step()
    session.sample(replace(session.sampling, unmask_steps=2))
    assert session.metered is None  # a frame was not measured
    session.begin(0)
    assert session.metered == {"px": 1.0, "beyond": False, "warns": False}


def test_sync_restarts_the_model_from_the_true_frames_and_their_actions() -> None:
    bench = Bench()
    session, _ = bench.open()
    bench.world.blind.add(session.row)
    session.held = np.array([30, -20], np.float32)
    bench.step(6)
    session.sync()
    frames, chunks = bench.world.begun[-1]
    np.testing.assert_array_equal(frames[-1], bench.world.rows[session.row].picture())
    np.testing.assert_array_equal(chunks[-6:], np.tile(session.held, (6, 1)))
    assert len(frames) == len(chunks) + 1 and frames.max() > 0


def test_a_step_that_still_waits_at_a_sync_is_not_made_from_the_true_frames() -> None:
    bench = Bench()
    session, viewer = bench.open()
    bench.step(2)
    bench.world.blind.add(session.row)
    session.paused, session.steps = True, 1
    session.sync()
    bench.stepper.step()
    assert session.count == len(viewer.frames) == 2 and not session.ready(session.due)


def test_sessions_of_another_sampling_have_a_pass_of_their_own() -> None:
    bench = Bench()
    one, other, third = (bench.open()[0] for _ in range(3))
    other.sample(Decoding(4, 0.5, "random"))
    bench.step()
    assert bench.world.sampling == [(2, 0.0, "random"), (4, 0.5, "random")]
    assert [set(step) for step in bench.world.steps] == [{one.row, third.row}, {other.row}]


def test_a_new_scene_begins_anew_and_the_same_scene_is_the_same() -> None:
    bench = Bench()
    session, _ = bench.open()
    first = session.start.model
    bench.step(3)
    session.begin(1)
    assert session.count == 0 and session.start.model != first
    session.begin(0)
    assert session.start.model == first


def test_an_idle_session_is_paused_and_keeps_its_frames_but_is_closed_if_nobody_watches() -> None:
    bench = Bench(idle_s=60.0)
    (idle, viewer), (busy, _), (left, away) = bench.open(), bench.open(), bench.open()
    bench.step()
    for session in (idle, left):
        session.touched -= 61
    bench.stepper.detach(away)
    bench.step(3)
    assert list(bench.stepper.sessions) == [idle.name, busy.name]
    assert list(bench.world.rows) == [idle.row, busy.row]
    assert idle.paused and len(idle.frames) == 1 and len(busy.frames) == 4
    assert [told["kind"] for told in viewer.told] == ["status", "error"]
    assert "without input" in viewer.told[-1]["text"]


def test_an_idle_session_gives_its_place_to_a_new_page() -> None:
    bench = Bench(most=1, idle_s=60.0)
    idle, viewer = bench.open()
    idle.touched -= 61
    bench.open()
    assert idle.name not in bench.stepper.sessions and "another page" in viewer.told[-1]["text"]


def test_a_full_engine_refuses_and_gives_the_places_of_those_who_left() -> None:
    bench = Bench(most=2)
    (first, viewer), _ = bench.open(), bench.open()
    with pytest.raises(UsageError, match="all 2 sessions are in use"):
        bench.stepper.open("mover_04", 0)
    bench.stepper.detach(viewer)
    bench.open()
    assert first.name not in bench.stepper.sessions


def test_a_session_that_fails_is_closed_and_the_others_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    (wrong, viewer), (right, other) = bench.open(), bench.open()
    monkeypatch.setattr(wrong, "scene", None)
    bench.step(2)
    assert list(bench.stepper.sessions) == [right.name]
    assert "simulator failed" in viewer.told[-1]["text"] and len(other.frames) == 2


def test_a_second_page_takes_over_and_tells_the_first() -> None:
    bench = Bench()
    session, first = bench.open()
    second = Watcher()
    bench.stepper.attach(session.name, second)
    bench.step()
    assert "another page" in first.told[-1]["text"] and len(second.frames) == 1 and not first.frames


def test_the_thread_runs_calls_and_hands_back_their_errors() -> None:
    bench = Bench()
    bench.stepper.start()
    try:
        session = bench.stepper.call(lambda: bench.stepper.open("mover_04", 0)).result(10)
        assert session.name in bench.stepper.sessions
        with pytest.raises(UsageError, match="no 'nobody'"):
            bench.stepper.call(lambda: bench.stepper.open("nobody", 0)).result(10)
        begun = threading.Event()
        bench.stepper.call(lambda: begun.wait(10))
        assert bench.stepper.call(lambda: bench.stepper.open("mover_04", 0)).cancel()  # its page has left
        begun.set()
        assert bench.stepper.call(lambda: len(bench.stepper.sessions)).result(10) == 1
    finally:
        bench.stepper.stop()


# -- when model and truth have parted


SECOND = 10  # frames


def pendulum(angle: float, blur: float = 0.0) -> np.ndarray:
    """Return an image (64, 64, 3) of a pendulum; its pixels are a share `blur` of grey."""
    image = np.full((64, 64, 3), 230.0)
    for step in np.linspace(0, 26, 40):
        x, y = 32 + step * math.sin(angle), 32 + step * math.cos(angle)
        image[int(y) - 2 : int(y) + 3, int(x) - 2 : int(x) + 3] = (180, 40, 40)
    return ((1 - blur) * image + blur * 200).astype(np.uint8)


def parted(made: Callable[[int], np.ndarray], frames: int, true: Callable[[int], np.ndarray]) -> int | None:
    detector = DivergenceDetector(true(0), true(0), SECOND)
    for number in range(1, frames + 1):
        detector.look(number, made(number), true(number))
    return detector.parted


def swing(number: int) -> np.ndarray:
    return pendulum(2.5 * math.sin(0.21 * number))


def test_a_model_that_moves_unrelated_to_the_truth_has_parted() -> None:
    """No still is as near to the truth for a second: only other moments show it."""
    found = parted(lambda number: pendulum(2.5 * math.sin(0.34 * number + 1)), 200, swing)
    assert found is not None and found < 60


def test_a_model_that_is_wrong_from_a_frame_on_has_parted_soon_after() -> None:
    found = parted(lambda number: swing(number if number < 40 else 2 * number), 120, swing)
    assert found is not None and 40 <= found < 80


def test_a_model_that_follows_has_not_parted_though_it_is_blurred_or_late() -> None:
    assert parted(lambda number: pendulum(2.5 * math.sin(0.21 * number), blur=0.5), 300, swing) is None
    assert parted(lambda number: swing(number - 2), 300, swing) is None
    assert parted(lambda number: swing(0), 100, lambda number: swing(0)) is None  # nothing moves


def test_a_model_that_moves_while_nothing_happens_has_parted() -> None:
    assert parted(swing, 60, lambda number: swing(0)) is not None
