"""Calibration of uncertainty, with plain loops as the oracle: map, warnings, reliability and risk."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hma_model.config import HMAConfig
from hma_model.evaluation import calibration as calibrating
from hma_model.evaluation.calibration import (
    BINS,
    COVERAGES,
    LEAD_FRAMES,
    NO_UNCERTAINTY,
    Meter,
    accumulated,
    best_limit,
    calibration,
    fit,
    meter_of,
)

WAY: Any = {"unmask_steps": 2, "temperature": 0.5}


def rollouts(told: float, scenes: int = 40, frames: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """Return uncertainty and errors (N, 3, T); `told` is how much of a jump of the error it announces."""
    rng = np.random.default_rng(3)
    jump = rng.integers(3, frames - 2, (scenes, 3, 1))
    jumped = np.arange(frames) >= jump
    errors = 1 + 0.1 * rng.random(jumped.shape) + 6 * jumped
    return 1 + 0.2 * rng.random(jumped.shape) + told * (np.arange(frames) == jump), errors


def loops(stated: np.ndarray, errors: np.ndarray) -> tuple[float, float, list[float], list[float]]:
    """Return what plain loops compute: rates of right warnings by meter and clock, misses, false alarms."""
    scenes, count, frames = stated.shape
    base = sum(float(errors[n, c, 0]) for n in range(scenes) for c in range(count)) / (scenes * count)

    def first(values: Any, limit: float) -> int:
        return next((t for t, value in enumerate(values) if value >= limit), frames)

    def right(warned: int, doubled: int) -> bool:
        return warned == frames if doubled == frames else 0 <= doubled - warned <= LEAD_FRAMES

    meter, clock, misses, false_alarms = [], [], [], []
    for n in range(scenes):
        fitted = [(m, c) for m in range(scenes) if m % 2 != n % 2 for c in range(count)]
        doubled = {(m, c): first(errors[m, c], 2 * base) for m, c in fitted}
        limits = np.quantile(np.stack([stated[one] for one in fitted]), np.linspace(0, 1, 101))
        rates = [sum(right(first(stated[one], x), doubled[one]) for one in fitted) for x in limits]
        limit = limits[rates.index(max(rates))]
        timed = [sum(right(t, doubled[one]) for one in fitted) for t in range(frames + 1)]
        for c in range(count):
            warned, truly = first(stated[n, c], limit), first(errors[n, c], 2 * base)
            meter.append(right(warned, truly))
            clock.append(right(timed.index(max(timed)), truly))
            if truly < frames:
                misses.append(warned > truly)
            if warned < frames:
                false_alarms.append(truly == frames or truly - warned > LEAD_FRAMES)
    return float(np.mean(meter)), float(np.mean(clock)), misses, false_alarms


@pytest.mark.parametrize("told", [0.0, 4.0])
def test_warnings_are_what_plain_loops_compute_and_a_meter_that_knows_nothing_is_refused(told: float) -> None:
    uncertainty, errors = rollouts(told)
    found = calibration(uncertainty, errors, 3 * errors, **WAY)
    stated = np.array(
        [[[(one[: t + 1] ** 4).sum() ** 0.25 for t in range(16)] for one in two] for two in uncertainty]
    )
    meter, clock, misses, false_alarms = loops(stated, errors)
    assert found["right"] == pytest.approx(meter, abs=1e-4)
    assert found["clock"] == pytest.approx(clock, abs=1e-4)
    assert found["misses"] == pytest.approx(np.mean(misses), abs=1e-4)
    assert found["false_alarms"] == pytest.approx(np.mean(false_alarms), abs=1e-4)
    assert found["gain_95"][0] <= found["right"] - found["clock"] <= found["gain_95"][1]
    kept = Meter.of(found["meter"])
    assert kept.better == (told > 0) and ("may be no better" in kept.verdict) == (told == 0)
    if told:
        assert found["right"] > 0.95 and found["misses"] == 0 < found["misses_95"][1]
        assert kept.expected(np.array([1.0, 9.0])) == pytest.approx([1.05, 7.05], abs=0.2)
        assert 0 <= (errors[0, 0] > 2).argmax() - kept.warns(stated[0, 0]).argmax() <= LEAD_FRAMES


def test_reliability_and_risk_are_what_plain_loops_compute() -> None:
    uncertainty, errors = rollouts(0.6)
    found = calibration(uncertainty, errors, 3 * errors, **WAY)
    stated = accumulated(uncertainty)
    order = np.argsort(stated.ravel(), kind="stable")
    curve = found["reliability"]
    for number in range(BINS):
        own = [i for rank, i in enumerate(order) if rank * BINS // len(order) == number]
        assert curve["stated"][number] == pytest.approx(np.mean([stated.ravel()[i] for i in own]), abs=1e-4)
        mean = np.mean([errors.ravel()[i] for i in own])
        assert curve["measured_px"][number] == pytest.approx(mean, abs=1e-4)
        assert curve["measured_pixels"][number] == pytest.approx(3 * mean, abs=2e-4)
        low, high = curve["measured_px_95"][number]
        assert low <= mean + 1e-4 and mean - 1e-4 <= high
    gaps = np.abs(np.subtract(curve["expected_px"], curve["measured_px"]))
    assert found["gap_px"] == pytest.approx(gaps.mean(), abs=1e-4) and found["gap_px"] < 0.5
    risk = found["risk"]
    ends, means = stated[..., -1].ravel(), errors.mean(axis=-1).ravel()
    for share, kept, frames in zip(COVERAGES, risk["episodes_px"], risk["frames_px"], strict=True):
        surest = sorted(range(len(ends)), key=lambda i: ends[i])[: round(share * len(ends))]
        assert kept == pytest.approx(np.mean([means[i] for i in surest]), abs=1e-4)
        surest = [int(i) for i in order[: round(share * len(order))]]
        assert frames == pytest.approx(np.mean([errors.ravel()[i] for i in surest]), abs=1e-4)
    assert found["half_gain_px"] == pytest.approx(risk["episodes_px"][0] - risk["episodes_px"][5], abs=2e-4)


def test_intervals_of_bins_stay_within_the_errors_and_that_of_the_gap_holds_the_true_one() -> None:
    """Each scene has its own level of uncertainty, so a bin is of few scenes; the errors follow it."""
    rng = np.random.default_rng(2)
    uncertainty = np.exp(rng.normal(0, 1, (16, 1, 1)) + rng.normal(0, 0.1, (16, 5, 12)))
    stated = accumulated(uncertainty)
    errors = stated * rng.gamma(4, 1 / 4, (16, 1, 1)) * rng.gamma(4, 1 / 4, stated.shape)
    found = calibration(uncertainty, errors, errors, **WAY)
    assert np.max(found["reliability"]["measured_px_95"]) < errors.max()
    assert found["gap_px_95"][0] == 0 < found["gap_px"] < found["gap_px_95"][1] < errors.max()


PAIRS = st.integers(1, 60).flatmap(
    lambda count: st.tuples(*(arrays(np.float64, count, elements=st.floats(0, 9)) for _ in range(2)))
)


@settings(max_examples=50, deadline=None)
@given(PAIRS)
def test_the_map_is_monotone_and_keeps_the_mean(pairs: tuple[np.ndarray, np.ndarray]) -> None:
    stated, errors = pairs
    at, expected = fit(stated, errors)
    sizes = [len(part) for part in np.array_split(np.arange(len(stated)), calibrating.KNOTS) if len(part)]
    assert (np.diff(at) >= 0).all() and (np.diff(expected) >= -1e-9).all()
    assert np.average(expected, weights=sizes) == pytest.approx(errors.mean(), abs=1e-6)
    # Pooling adjacent violators, by loops: blocks of means that never fall.
    blocks: list[tuple[float, int]] = []
    order = np.argsort(stated, kind="stable")
    for part in np.array_split(errors[order], calibrating.KNOTS):
        if len(part):
            blocks.append((float(part.sum()), len(part)))
        while len(blocks) > 1 and blocks[-2][0] / blocks[-2][1] >= blocks[-1][0] / blocks[-1][1]:
            (a, n), (b, m) = blocks.pop(-2), blocks.pop(-1)
            blocks.append((a + b, n + m))
    pooled = np.concatenate([np.full(size, total / size) for total, size in blocks])
    assert np.repeat(expected, sizes) == pytest.approx(pooled, abs=1e-6)


def test_what_cannot_be_calibrated_says_why() -> None:
    uncertainty, errors = rollouts(1.0, scenes=7)
    found = calibration(uncertainty, errors, errors, **WAY)
    assert found == {"missing": "7 of at least 8 scenes"}
    found = calibration(np.full_like(uncertainty, np.nan), errors, errors, **WAY)
    assert found == {"missing": NO_UNCERTAINTY}


def test_errors_that_never_double_are_warned_of_never() -> None:
    uncertainty, errors = rollouts(1.0)
    found = calibration(uncertainty, np.ones_like(errors), errors, **WAY)
    assert found["doubling"] == 0 and found["misses"] is None and not found["meter"]["better"]
    assert best_limit(accumulated(uncertainty), np.full(errors.shape[:2], 16)) > 1


def test_a_card_gives_a_meter_for_the_frames_that_it_was_measured_on_or_says_why_not() -> None:
    uncertainty, errors = rollouts(4.0)
    card = {"meter": calibration(uncertainty, errors, errors, **WAY)["meter"]}
    tokens = HMAConfig(layers=1, width=32, heads=2)
    meter, reason = meter_of(tokens, card, 2, 0.5, "random")
    assert meter is not None and reason == "" and meter.better
    for way, said in (
        ((1, 0.5, "random"), "calibrated only for 2 passes at temperature 0.5 in random order"),
        ((2, 0.5, "confidence"), "in random order"),
    ):
        assert said in meter_of(tokens, card, *way)[1]
    whole = HMAConfig(layers=1, width=32, heads=2, training_pass="pairs", whole_share=1.0)
    assert whole.whole_frames and meter_of(whole, card, 5, 0.5, "confidence")[1] == ""  # one pass in any case
    assert "hma benchmark calibrates it" in meter_of(tokens, {}, *way)[1]
    for damage in ({"limit": 1}, *(card["meter"] | one for one in ({"limit": "x"}, {"right": np.nan}))):
        assert "is damaged" in meter_of(tokens, {"meter": damage}, *way)[1]
    regression = SimpleNamespace(video_loss="regression")
    assert meter_of(regression, card, *way) == (None, NO_UNCERTAINTY)  # type: ignore[arg-type]
