"""Alignment against a reference that looks at one target time after the other."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from hma_data.episodes.align import hold, interpolate, nearest, to_clip
from hma_data.episodes.episode import Clip, Episode, Pictures, Signal
from hma_data.errors import AlignmentError, EpisodeError, RegistryError
from hma_data.registry.embodiment import Embodiment

TICK = 1 / 64  # a binary fraction: sums and differences of times are exact, ties are ties


@st.composite
def ticks(draw: st.DrawFn) -> np.ndarray:
    steps = draw(st.lists(st.integers(0, 40), min_size=0, max_size=25))
    return np.cumsum([draw(st.integers(0, 60)), *steps])


def times() -> st.SearchStrategy[np.ndarray]:
    return ticks().map(lambda counted: counted * TICK)


def one_nearest(source: np.ndarray, target: float) -> int:
    return min(range(len(source)), key=lambda i: (abs(source[i] - target), source[i], i))


def one_held(source: np.ndarray, target: float) -> int:
    return max((i for i in range(len(source)) if source[i] <= target), default=0)


def one_between(source: np.ndarray, values: np.ndarray, target: float) -> float:
    if target <= source[0]:
        return values[0]
    for i in range(len(source) - 1):
        if source[i] <= target < source[i + 1]:
            share = (target - source[i]) / (source[i + 1] - source[i])
            return values[i] + share * (values[i + 1] - values[i])
    return values[-1]


@given(source=times(), targets=times())
def test_nearest_is_the_nearest_and_of_two_the_earlier(source: np.ndarray, targets: np.ndarray) -> None:
    index, skew_ms = nearest(source, targets)
    expected = [source[one_nearest(source, t)] for t in targets]
    np.testing.assert_array_equal(source[index], expected)
    np.testing.assert_array_equal(skew_ms, np.abs(np.array(expected) - targets) * 1e3)


@given(source=times(), targets=times(), late=st.just(0) | st.integers(1, 50))
def test_hold_is_the_last_at_or_before_or_at_most_as_late_as_the_tolerance(source, targets, late) -> None:
    index, skew_ms = hold(source, targets, late * TICK)
    np.testing.assert_array_equal(index, [one_held(source, t + late * TICK) for t in targets])
    trimmed = targets + late * TICK < source[0]
    assert ((skew_ms < 0) == trimmed).all()
    assert late or ((targets - source[index]) * 1e3 == skew_ms).all()
    np.testing.assert_array_equal(skew_ms[~trimmed], np.abs(targets - source[index])[~trimmed] * 1e3)


@given(source=times(), targets=times(), seed=st.integers(0, 99))
def test_interpolate_is_linear_between_neighbours(source: np.ndarray, targets: np.ndarray, seed: int) -> None:
    assume((np.diff(source) > 0).all())
    values = np.random.default_rng(seed).normal(size=(len(source), 2)).astype(np.float32)
    found, skew_ms = interpolate(source, values, targets)
    expected = [[one_between(source, values[:, a].astype(float), t) for a in range(2)] for t in targets]
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(skew_ms, nearest(source, targets)[1])


def embodiment(**sync: object) -> Embodiment:
    return Embodiment.from_values(
        {
            "id": "two_clocks",
            "kind": "real",
            "frequency_hz": 10,
            "action": {"space": "mixed", "components": [{"key": "a", "dims": 1}, {"key": "b", "dims": 2}]},
            "state": {"components": [{"key": "s", "dims": 1}]},
            "cameras": [{"name": "front", "key": "/front"}, {"name": "wrist", "key": "/wrist"}],
            "sync": sync,
            "source": {"format": "rosbag"},
        },
        "test",
    )


def signal(stamps: np.ndarray, dims: int, seed: int) -> Signal:
    return Signal(stamps, np.random.default_rng(seed).normal(size=(len(stamps), dims)).astype(np.float32))


def episode(front: np.ndarray, wrist: np.ndarray, a: np.ndarray, b: np.ndarray, s: np.ndarray) -> Episode:
    return Episode(
        "run",
        {name: Pictures(stamps, lambda i: np.full((2, 2, 3), i, np.uint8)) for name, stamps in
         (("front", front), ("wrist", wrist))},
        (signal(a, 1, 1), signal(b, 2, 2)),
        (signal(s, 1, 3),),
        rate_stamped=False,
    )  # fmt: skip


def assert_is_reference(clip: Clip, grid: np.ndarray, actions: str, states: str, images: str) -> None:
    np.testing.assert_allclose(clip.timestamps, grid - grid[0], atol=1e-9)
    pick = {"nearest": one_nearest, "hold": one_held, "interpolate": one_nearest}
    for name, stream in clip.episode.streams.items():
        expected = [stream.timestamps[pick[images](stream.timestamps, t)] for t in grid]
        np.testing.assert_array_equal(stream.timestamps[clip.frame_indices[name]], expected)
    for found, signals, method in (
        (clip.actions, clip.episode.actions, actions),
        (clip.states, clip.episode.states, states),
    ):
        rows = []
        for t in grid:
            row: list[float] = []
            for part in signals:
                columns = part.values.T.astype(float)
                if method == "interpolate":
                    row += [one_between(part.timestamps, column, t) for column in columns]
                else:
                    row += [column[pick[method](part.timestamps, t)] for column in columns]
            rows.append(row)
        np.testing.assert_allclose(found, rows, rtol=1e-6, atol=1e-6)


METHODS = st.sampled_from(["nearest", "hold", "interpolate"])


@given(
    clocks=st.tuples(*[times() for _ in range(5)]),
    images=st.sampled_from(["nearest", "hold"]),
    actions=METHODS,
    states=METHODS,
    rate=st.sampled_from([None, 4.0, 16.0]),
)
def test_a_clip_is_the_lookup_of_every_frame_where_all_streams_run(clocks, images, actions, states, rate):
    for clock in clocks:
        assume((np.diff(clock) > 0).all())
    sync = {"images": images, "actions": actions, "states": states} | ({"rate_hz": rate} if rate else {})
    try:
        clip = to_clip(episode(*clocks), embodiment(**sync))
    except AlignmentError as fault:
        assert "do not overlap in time" in str(fault)
        return
    start, stop = reference_span(clocks, images, actions, states, rate)
    front = clocks[0]
    if rate:
        start, stop = max(start, front[0]), min(stop, front[-1])
        count = int((stop - start) * rate + 1e-9) + 1
        grid = start + np.arange(count) / rate
        assert clip.trimmed == 0
    else:
        grid = front[(front >= start) & (front <= stop)]
        assert clip.trimmed == len(front) - len(grid)
    assert_is_reference(clip, grid, actions, states, images)
    assert all((values >= 0).all() for values in clip.skew_ms.values())


def reference_span(
    clocks: tuple[np.ndarray, ...], images: str, actions: str, states: str, rate: float | None
) -> tuple[float, float]:
    """From when to when every stream has a value by its method."""
    start, stop = -np.inf, np.inf
    for i, (clock, method) in enumerate(zip(clocks, (images, images, actions, actions, states))):
        if i == 0 and not rate:
            continue
        reach = np.median(np.diff(clock)) / 2 if method == "nearest" and len(clock) > 1 else 0
        start = max(start, clock[0] - reach)
        stop = stop if method == "hold" else min(stop, clock[-1] + reach)
    return start, stop


STEADY = np.arange(20) * 0.1
FAST = np.arange(200) * 0.01


def test_a_command_within_the_tolerance_acts_at_the_frame_before_it_and_states_do_not_change() -> None:
    late = STEADY + 0.03
    run = episode(STEADY, STEADY, late, STEADY, late)
    clip = to_clip(run, embodiment(tolerance_ms=30, states="hold"))
    assert len(clip) == 19 and clip.trimmed == 1  # no state is known at the first frame
    np.testing.assert_array_equal(clip.actions[:, 0], run.actions[0].values[1:, 0])
    np.testing.assert_array_equal(clip.states, run.states[0].values[:-1])
    assert clip.skew_ms["a"].max() == pytest.approx(30) and clip.skew_ms["s"].max() == pytest.approx(70)
    with pytest.raises(RegistryError, match="tolerance_ms is for actions: hold, not for nearest"):
        embodiment(tolerance_ms=30, actions="nearest")


@given(limit=st.floats(1, 80), gap=st.integers(1, 12))
def test_an_episode_is_refused_exactly_when_a_stream_is_further_off_than_allowed(limit, gap) -> None:
    wrist = np.concatenate([FAST[:100], FAST[100 + gap :]])
    middle = episode(FAST[:180], wrist, FAST, FAST, FAST)
    worst = max(min(abs(w - t) for w in wrist) for t in FAST[:180]) * 1e3
    assume(abs(worst - limit) > 1e-6)
    if worst > limit:
        with pytest.raises(AlignmentError, match="wrist is .* ms off at 1"):
            to_clip(middle, embodiment(max_skew_ms=limit))
    else:
        clip = to_clip(middle, embodiment(max_skew_ms=limit))
        assert clip.skew_ms["wrist"].max() == pytest.approx(worst)


def test_a_held_command_ends_with_its_stream_where_a_limit_is_set() -> None:
    stops = episode(STEADY, STEADY, STEADY[:10], STEADY, STEADY)
    assert len(to_clip(stops, embodiment())) == 20
    assert len(to_clip(stops, embodiment(max_skew_ms=150))) == 11


@pytest.mark.parametrize("shift", [-2, 0, 1, 3])
def test_a_shifted_action_stands_beside_the_frame_it_was_issued_at(shift: int) -> None:
    ticks = np.arange(6) / 10
    counted = Signal(ticks, np.arange(6, dtype=np.float32)[:, None])
    picture = Pictures(ticks, lambda i: np.full((2, 2, 3), i, np.uint8))
    robot = embodiment().model_dump(mode="json", exclude_defaults=True, by_alias=True)
    robot |= {"source": {"format": "hdf5"}, "sync": {"action_shift": shift}, "state": None}
    names = [camera["name"] for camera in robot["cameras"]]
    run = Episode("e", dict.fromkeys(names, picture), (counted,), (), True)
    clip = to_clip(run, Embodiment.from_values(robot, "shifted"))
    shown = clip.frames_at(names[0], np.arange(len(clip)))[:, 0, 0, 0]
    assert len(clip) == 6 - abs(shift) and clip.trimmed == abs(shift) and clip.timestamps[0] == 0
    np.testing.assert_array_equal(clip.actions[:, 0], shown.astype(int) + shift)


def test_a_shift_in_steps_of_a_bag_is_refused() -> None:
    with pytest.raises(RegistryError, match="steps, which sync.action_shift counts"):
        Embodiment.from_values(
            {**embodiment().to_dict(), "sync": {"action_shift": 1}, "source": {"format": "rosbag"}}, "bag"
        )


@pytest.mark.parametrize(
    ("stamp", "format_name", "advised"),
    [("header", "rosbag", True), ("receive", "rosbag", False), ("header", "rh20t", False)],
)
def test_other_stamps_are_advised_only_where_there_are_others(stamp, format_name, advised) -> None:
    robot = embodiment(stamp=stamp).to_dict() | {"source": {"format": format_name}}
    with pytest.raises(AlignmentError) as fault:
        to_clip(episode(STEADY, STEADY[::-1], STEADY, STEADY, STEADY), Embodiment.from_values(robot, "other"))
    assert ("stamp: receive" in str(fault.value)) is advised


def test_values_that_are_not_finite_are_told_with_the_frame() -> None:
    bad = episode(STEADY, STEADY, STEADY, STEADY, STEADY)
    bad.actions[1].values[4, 0] = np.nan
    with pytest.raises(EpisodeError, match="actions are not finite at frame 4"):
        to_clip(bad, embodiment())


@given(
    source=ticks(),
    targets=ticks(),
    epoch=st.sampled_from([0.0, 3_600.0, 86_400.5, 1_700_000_000.0, 1_763_740_800.123456]),
    added=st.booleans(),
)
def test_hold_and_nearest_are_those_of_exact_times(source, targets, epoch, added) -> None:
    floats = epoch + source / 300
    if added and epoch < 1e6:  # near 1.7e9 each sum loses 0.1 µs, and times drift apart in earnest
        floats = np.cumsum([epoch + source[0] / 300, *(np.diff(source) * (1 / 300))])
    grid = epoch + targets[0] / 300 + (targets - targets[0]) / 300
    held, age_ms = hold(floats, grid)
    np.testing.assert_array_equal(
        held, [max((i for i, s in enumerate(source) if s <= t), default=0) for t in targets]
    )
    late = targets >= source[0]
    assert (age_ms[late] >= 0).all() and (age_ms[~late] < 0).all()
    np.testing.assert_allclose(age_ms, (targets - source[held]) / 0.3, atol=1e-2)
    near, skew_ms = nearest(floats, grid)
    np.testing.assert_array_equal(
        near, [min(range(len(source)), key=lambda i: (abs(source[i] - t), i)) for t in targets]
    )
    np.testing.assert_allclose(skew_ms, np.abs(targets - source[near]) / 0.3, atol=1e-2)


@pytest.mark.parametrize("epoch", [0.0, 100_000.1, 1_763_740_800.123456])
@pytest.mark.parametrize("hz", [10.0, 29.97, 30.0, 59.94])
def test_a_grid_of_the_recordings_own_rate_takes_every_command_in_turn(epoch: float, hz: float) -> None:
    clock = epoch + np.arange(300) / hz
    for rate in (None, hz):
        sync = {"actions": "hold", "states": "nearest"} | ({"rate_hz": rate} if rate else {})
        clip = to_clip(episode(*[clock] * 5), embodiment(**sync))
        assert len(clip) == 300 and clip.trimmed == 0
        np.testing.assert_array_equal(clip.actions[:, 0], clip.episode.actions[0].values[:, 0])
        np.testing.assert_array_equal(clip.states, clip.episode.states[0].values)
        assert all(0 <= skew.max() < 2e-3 for skew in clip.skew_ms.values())
        assert epoch or rate or not any(skew.any() for skew in clip.skew_ms.values())


def test_a_command_a_few_microseconds_late_is_not_in_force_yet() -> None:
    for epoch in (0.0, 1.7e9):
        index, _ = hold(np.array([epoch, epoch + 1 + 5e-6]), np.array([epoch + 1]))
        assert index.tolist() == [0]


def test_of_samples_with_one_stamp_hold_takes_the_last_nearest_the_first() -> None:
    source = np.array([0, 0, 1, 1, 1, 2.0])
    targets = np.array([0, 0.2, 0.9, 1, 1.2, 1.9, 2])
    assert hold(source, targets)[0].tolist() == [1, 1, 1, 4, 4, 4, 5]
    assert nearest(source, targets)[0].tolist() == [0, 0, 2, 2, 2, 5, 5]
    values = np.array([0, 10, 20, 50, 30, 40], np.float32)[:, None]
    between = interpolate(source, values, np.array([0, 0.5, 1, 1.5]))[0]
    assert between[:, 0].tolist() == [10, 15, 30, 35]  # a step at the stamp, from the first to the last


def test_a_camera_that_stamps_two_pictures_alike_gives_one_frame_of_them_and_it_is_counted() -> None:
    twice = np.sort(np.concatenate([STEADY, STEADY[[4, 9, 9]]]))
    clip = to_clip(episode(twice, STEADY, STEADY, STEADY, STEADY), embodiment())
    assert len(clip) == 20 and clip.repeated == 3 and clip.flags == {"repeated_frames": 3}
    assert (np.diff(clip.timestamps) > 0).all()
    shown = clip.frames_at("front", np.arange(20))[:, 0, 0, 0].tolist()
    assert shown == [i + (i > 4) + 2 * (i > 9) for i in range(20)]


def test_skew_is_told_by_the_key_of_the_component() -> None:
    clip = to_clip(episode(STEADY, STEADY, STEADY, STEADY + 0.01, STEADY), embodiment())
    assert list(clip.skew_ms) == ["front", "wrist", "a", "b", "s"]
    assert clip.skew_ms["b"].max() == pytest.approx(90)


def test_components_of_one_key_share_a_name_and_a_state_of_it_says_so() -> None:
    values = embodiment().to_dict()
    values["action"]["components"] = [
        {"key": "/arm.q", "dims": 1, "slice": [0, 1]},
        {"key": "/arm.q", "dims": 2, "slice": [1, 3]},
    ]
    values["state"] = {"components": [{"key": "/arm.q", "dims": 1, "slice": [0, 1]}]}
    values["cameras"][1]["name"] = "a"
    streams = dict.fromkeys(("front", "a"), Pictures(STEADY, lambda i: np.zeros((2, 2, 3), np.uint8)))
    clip = to_clip(
        replace(episode(STEADY, STEADY, FAST, STEADY + 0.02, FAST), streams=streams),
        Embodiment.from_values(values, "shared"),
    )
    assert list(clip.skew_ms) == ["front", "a", "/arm.q", "state /arm.q"]
    assert clip.skew_ms["/arm.q"].max() == pytest.approx(80)  # of the later one


GAP = np.delete(STEADY, np.arange(8, 12))  # nothing from 0.8 to 1.1 s


def test_masked_actions_are_those_whose_command_is_too_old() -> None:
    run = episode(STEADY, STEADY, GAP, STEADY, STEADY)
    with pytest.raises(AlignmentError, match="a is 400.0 ms off"):
        to_clip(run, embodiment(max_skew_ms=150))
    clip = to_clip(run, embodiment(max_skew_ms=150, beyond="mask"))
    assert len(clip) == 20 and clip.state_known is not None and clip.state_known.all()
    assert np.flatnonzero(~clip.action_known).tolist() == [9, 10, 11]
    assert not clip.actions[9:12].any() and len(clip.known_actions) == 17
    np.testing.assert_array_equal(clip.actions[8], [*run.actions[0].values[7], *run.actions[1].values[8]])
    assert clip.flags == {"masked_actions": 3} and clip.skew_ms["a"].max() == pytest.approx(400)


def test_masked_states_are_those_far_from_any_sample() -> None:
    clip = to_clip(episode(STEADY, STEADY, STEADY, STEADY, GAP), embodiment(max_skew_ms=150, beyond="mask"))
    assert np.flatnonzero(~clip.state_known).tolist() == [9, 10]
    assert clip.action_known.all() and clip.flags == {"masked_states": 2}


BACK = np.where(np.arange(20) == 7, 0.2, STEADY)
NEAR = {"max_skew_ms": 20, "beyond": "mask", "actions": "nearest"}


@pytest.mark.parametrize(
    ("clocks", "sync", "fault", "said"),
    [
        ({"a": STEADY + 100}, {}, AlignmentError, r"do not overlap in time: .*a 100\.000 to 101\.900"),
        ({"wrist": BACK}, {}, AlignmentError, r"wrist goes back in time at sample 7: 0\.6\d* then 0\.2"),
        ({"wrist": STEADY[:0]}, {}, EpisodeError, "wrist has no samples"),
        ({"front": np.floor(STEADY)}, {}, AlignmentError, "18 of 20 frames of front .*stamp: receive"),
        ({"wrist": GAP}, {"max_skew_ms": 150, "beyond": "mask"}, AlignmentError, "wrist is 200.0 ms off"),
        ({"a": STEADY + 0.05, "b": np.array([0.0, 1.93])}, NEAR, EpisodeError, "none of its .* is known"),
    ],
)
def test_clocks_that_cannot_be_aligned_are_refused(clocks, sync, fault, said) -> None:
    run = episode(**dict.fromkeys(("front", "wrist", "a", "b", "s"), STEADY) | clocks)
    with pytest.raises(fault, match=said):
        to_clip(run, embodiment(**sync))


def test_a_value_that_is_not_known_may_be_anything() -> None:
    clock = np.arange(20) / 10
    values = np.ones((20, 3), np.float32)
    values[4] = np.nan
    known = np.arange(20) != 4
    picture = Pictures(clock, lambda i: np.zeros((2, 2, 3), np.uint8))
    robot = Embodiment.from_values(
        embodiment().to_dict() | {"state": None, "source": {"format": "hdf5"}}, "one clock"
    )
    for rate_stamped in (True, False):
        run = Episode(
            "e", dict.fromkeys(("front", "wrist"), picture), (Signal(clock, values, known),), (), rate_stamped
        )
        clip = to_clip(run, robot)
        np.testing.assert_array_equal(clip.action_known, known)
        assert not clip.actions[4].any()
