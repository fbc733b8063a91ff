"""Calibrate how unsure a model is of its frames: what error to expect, and when to warn.

A frame builds on all generated frames before it, so what counts is the uncertainty since the last true frame:
the fourth root of the sum of fourth powers, because one very unsure frame may lose an object for good. It
only grows. A `Meter` maps it to the state error to expect, by isotonic regression, and warns from a limit on.

A rollout is warned rightly if the warning comes by the frame at which the state error doubles, and at most
LEAD_FRAMES before; one whose error does not double, if it is not warned. The error doubles when it reaches
twice the mean error of first generated frames. The reference is a clock: a warning at the same frame of all
rollouts. A meter that is no better is refused. All rates are of scenes on which neither the limit nor the map
was fitted.

N scenes, C rollouts of each, T generated frames. State errors are px of an image of 128 by 128.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from pydantic import FiniteFloat, TypeAdapter
from scipy.optimize import isotonic_regression

from hma_data.arrays import Bools, Floats, Ints
from hma_model.config import HMAConfig
from hma_model.evaluation.agreement import independent, share_interval
from hma_model.evaluation.intervals import LEVELS, NATURAL, resampled_means, rounded, summary

POWER = 4
LEAD_FRAMES = 5
MIN_SCENES = 8
BINS, KNOTS = 10, 20  # equally many frames in each
LIMITS = 100  # quantiles of the stated uncertainty that are tried as a limit
COVERAGES = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1)
NO_UNCERTAINTY = "the model has no uncertainty: with video_loss: regression, nothing is sampled"


@dataclass(frozen=True)
class Meter:
    """The calibrated uncertainty of one robot in one checkpoint, for one way of drawing frames.

    Attributes:
        unmask_steps, temperature: of the frames that it was measured on.
        stated: ascending uncertainty since the last true frame.
        error_px: the state error to expect at each of them.
        limit: the stated uncertainty from which on it warns.
        doubled_px: the state error that it warns of.
        right, clock: shares of rollouts that the meter, and a clock, warned rightly.
        misses: share of the rollouts whose error doubles that were not warned by then.
        false_alarms: share of the warnings after which the error did not double within LEAD_FRAMES.
        better: whether it is better than the clock: the interval of the difference is above 0.
        chooses: whether the surest half of rollouts of one length has a smaller error than all of them; its
            interval is above 0.
    """

    unmask_steps: int
    temperature: FiniteFloat
    stated: tuple[FiniteFloat, ...]
    error_px: tuple[FiniteFloat, ...]
    limit: FiniteFloat
    doubled_px: FiniteFloat
    right: FiniteFloat
    clock: FiniteFloat
    misses: FiniteFloat | None
    false_alarms: FiniteFloat | None
    better: bool
    chooses: bool

    @classmethod
    def of(cls, facts: Mapping[str, Any]) -> "Meter":
        """Return the meter of the values of `facts`; ValueError if they are none."""
        found = TypeAdapter(cls).validate_python(facts)
        if not found.stated or (np.diff([found.stated, found.error_px]) < 0).any():
            raise ValueError("the errors to expect do not grow with the stated uncertainty")
        return found

    def expected(self, stated: Floats) -> Floats:
        """Return the state error in px to expect at stated uncertainties (…); beyond the last, it is more."""
        return np.interp(stated, self.stated, self.error_px)

    @property
    def reach(self) -> float:
        """Return the stated uncertainty up to which frames were measured, as far as the means tell."""
        before = self.stated[-2:][0]
        return 2 * self.stated[-1] - before

    def expects_at_most(self, stated: Floats, px: float) -> Bools:
        """Return whether the error to expect at stated values (…) is at most `px`; not beyond `reach`."""
        return (self.expected(stated) <= px) & (stated <= self.reach)

    def warns(self, stated: Floats) -> Bools:
        """Return whether stated uncertainties (…) are worth a warning."""
        return np.asarray(stated) >= self.limit

    @property
    def verdict(self) -> str:
        """Return in a sentence how good it is."""
        rates = f"{self.right:.0%} of rollouts are warned in time, at a fixed time {self.clock:.0%}"
        if not self.better:
            return f"uncertainty may be no better than a warning at a fixed time: {rates}"
        shares = {"misses": self.misses, "false alarms": self.false_alarms}
        said = [f"{name} {value:.0%}" for name, value in shares.items() if value is not None]
        start = f"uncertainty warns of a state error of {self.doubled_px:.1f} px: {rates}"
        return ", ".join([start, *said])


def meter_of(
    config: HMAConfig, card: Mapping[str, Any], unmask_steps: int, temperature: float, order: str
) -> tuple[Meter | None, str]:
    """Return the meter that a robot's card holds, or None and why there is none for such frames.

    A meter that is no better than a clock is returned: what it is good for, `better` and `chooses` say.
    """
    if config.video_loss == "regression":
        return None, NO_UNCERTAINTY
    if "meter" not in card:
        return None, "uncertainty is not calibrated: hma benchmark calibrates it"
    try:
        meter = Meter.of(card["meter"])
    except ValueError:
        return None, "the card's calibration of uncertainty is damaged: hma benchmark rebuilds it"
    drawn = (meter.unmask_steps, "random") == (unmask_steps, order) or config.whole_frames  # of one pass
    if meter.temperature != temperature or not drawn:
        way = f"{meter.unmask_steps} passes at temperature {meter.temperature:g} in random order"
        return None, f"uncertainty is calibrated only for {way}"
    return meter, ""


def accumulated(uncertainty: Floats) -> Floats:
    """Return the uncertainty (…, T) since the last true frame, of that (…, T) of single frames."""
    return np.cumsum(uncertainty**POWER, axis=-1) ** (1 / POWER)


def missing(uncertainty: Floats, errors: Floats) -> str:
    """Say why uncertainty (N, C, T) cannot be calibrated to state errors (N, C, T); "" if it can."""
    if not np.isfinite(uncertainty).all():
        return NO_UNCERTAINTY
    if len(uncertainty) < MIN_SCENES:
        return f"{len(uncertainty)} of at least {MIN_SCENES} scenes"
    return "" if np.isfinite(errors).all() else "the probe locates no part"


def fit(stated: Floats, errors: Floats) -> tuple[Floats, Floats]:
    """Return ascending stated uncertainties and the error to expect at each, of pairs of any equal shape."""
    order = np.argsort(stated, axis=None, kind="stable")
    parts = [part for part in np.array_split(order, KNOTS) if len(part)]
    at = np.array([stated.ravel()[part].mean() for part in parts])
    means = np.array([errors.ravel()[part].mean() for part in parts])
    weights = np.array([len(part) for part in parts])
    return at, np.asarray(isotonic_regression(means, weights=weights).x)


def first_frame(seen: Bools) -> Ints:
    """Return the first frame (…) at which something is seen (…, T); T if it never is."""
    return np.where(seen.any(axis=-1), seen.argmax(axis=-1), seen.shape[-1])


def warned_rightly(warned: Ints, doubled: Ints, frames: int) -> Bools:
    """Return which warnings at frames (…) are right; errors double at frames (…), `frames` means never."""
    early = doubled - warned
    return np.where(doubled < frames, (early >= 0) & (early <= LEAD_FRAMES), warned >= frames)


def best_limit(stated: Floats, doubled: Ints) -> float:
    """Return the limit of stated uncertainties (…, T) that warns most rollouts rightly."""
    limits = np.quantile(stated, np.linspace(0, 1, LIMITS + 1))
    frames = stated.shape[-1]
    right = [warned_rightly(first_frame(stated >= one), doubled, frames).mean() for one in limits]
    return float(limits[int(np.argmax(right))])


def best_clock(doubled: Ints, frames: int) -> int:
    """Return the frame at which a warning of all rollouts is right most often; `frames` for never."""
    right = [
        warned_rightly(np.full_like(doubled, frame), doubled, frames).mean() for frame in range(frames + 1)
    ]
    return int(np.argmax(right))


def calibration(
    uncertainty: Floats,
    errors: Floats,
    pixels: Floats,
    *,
    unmask_steps: int,
    temperature: float,
    seed: int = 0,
) -> dict[str, Any]:
    """Return how well uncertainty tells errors, and the meter.

    Args:
        uncertainty: (N, C, T) of single generated frames, as of `Rollout`.
        errors: (N, C, T) state errors in px.
        pixels: (N, C, T) root mean squared errors of pixels, of 255.
        unmask_steps, temperature: of the frames.
        seed: of the intervals.

    Returns:
        Only `missing`, the reason, if it cannot be calibrated. Else figures with 95 % intervals over scenes:
        `reliability` by bins of equally many frames; `gap_px` and `gap_pixels`, the mean over bins of how far
        expected and measured errors are apart; `risk`, the mean error of the surest episodes and frames
        by the share that is kept; `half_gain_px`, by how much that of half the episodes is smaller than
        that of all; of warnings `right`, `clock`, `gain`, `misses` and `false_alarms`; and the `meter`.
    """
    if reason := missing(uncertainty, errors):
        return {"missing": reason}
    stated = accumulated(uncertainty)
    frames = stated.shape[-1]
    base = float(errors[..., 0].mean())
    doubled = first_frame(errors >= 2 * base)
    warned, clock = np.empty_like(doubled), np.empty_like(doubled)
    expected = {"px": np.empty_like(errors), "pixels": np.empty_like(pixels)}
    measured = {"px": errors, "pixels": pixels}
    for fold in (0, 1):
        tested = np.arange(len(stated)) % 2 == fold
        warned[tested] = first_frame(stated[tested] >= best_limit(stated[~tested], doubled[~tested]))
        clock[tested] = best_clock(doubled[~tested], frames)
        for name, values in measured.items():
            expected[name][tested] = np.interp(stated[tested], *fit(stated[~tested], values[~tested]))
    found = {"first_px": rounded(base), "doubled_px": rounded(2 * base)}
    found["reliability"] = {"stated": rounded(_by_bin(stated, stated)[0])}
    for name, values in measured.items():
        found |= _reliability(name, stated, expected[name], values, found["reliability"], seed)
    found |= _risk(stated, errors, seed)
    warnings = _warnings(warned, clock, doubled, frames, seed)
    knots, means = fit(stated, errors)
    meter = Meter(
        unmask_steps,
        temperature,
        tuple(rounded(knots)),
        tuple(rounded(means)),
        rounded(best_limit(stated, doubled)),
        found["doubled_px"],
        warnings["right"],
        warnings["clock"],
        warnings["misses"],
        warnings["false_alarms"],
        warnings["gain_95"][0] > 0,
        found["half_gain_px_95"][0] > 0,
    )
    return found | warnings | {"meter": asdict(meter) | {"verdict": meter.verdict}}


def _by_bin(stated: Floats, values: Floats, seed: int = 0) -> tuple[Floats, Floats]:
    """Return means (BINS,) of values (N, C, T) by bins of stated ones, and those of resamples (R, BINS)."""
    ranks = np.empty(stated.size, np.int64)
    ranks[np.argsort(stated, axis=None, kind="stable")] = np.arange(stated.size)
    own = (ranks * BINS // stated.size).reshape(len(stated), -1)
    inside = own[..., None] == np.arange(BINS)
    return _means_of((inside * values.reshape(len(values), -1, 1)).sum(axis=1), inside.sum(axis=1), seed)


def _means_of(sums: Floats, counts: Ints, seed: int) -> tuple[Floats, Floats]:
    """Return the means (…) of values with sums and counts (N, …) by scene, and those of resamples (R, …).

    The ratio is linearised: a resample may hold hardly any value of a bin, and nothing divides by its count.
    """
    means = sums.sum(axis=0) / counts.sum(axis=0)
    return means, means + resampled_means(sums - means * counts, seed) / counts.mean(axis=0)


def _reliability(
    name: str, stated: Floats, expected: Floats, measured: Floats, curve: dict[str, Any], seed: int
) -> dict[str, Any]:
    """Add a kind of error to the reliability curve, and return its gap."""
    means, drawn = _by_bin(stated, measured, seed)
    told, told_drawn = _by_bin(stated, expected, seed)
    curve |= {f"expected_{name}": rounded(told), f"measured_{name}": rounded(means)}
    curve[f"measured_{name}_95"] = rounded(np.percentile(drawn, LEVELS, axis=0).clip(*NATURAL).T)
    gaps = np.abs(drawn - told_drawn).mean(axis=1)
    gap = float(np.abs(means - told).mean())
    low, high = np.percentile(gaps, LEVELS)
    # Noise adds to a gap, in the figure and once more in the resamples: the true one is as far below.
    ends = np.array([max(min(low, 2 * gap - high), 0.0), max(high, gap)])
    return {f"gap_{name}": rounded(gap), f"gap_{name}_95": rounded(ends)}


def _risk(stated: Floats, errors: Floats, seed: int) -> dict[str, Any]:
    """Return the mean errors of what is kept when the least sure episodes, or frames, are left out."""
    scenes = np.arange(len(stated))[:, None, None]
    kinds = {
        "episodes": (stated[..., -1:], errors.mean(axis=-1, keepdims=True)),
        "frames": (stated, errors),
    }
    risk: dict[str, Any] = {"coverage": list(COVERAGES)}
    for name, (unsure, values) in kinds.items():
        order = np.argsort(unsure, axis=None, kind="stable")
        own = np.broadcast_to(scenes, values.shape).ravel()
        kept = [order[: max(1, round(share * order.size))] for share in COVERAGES]
        parts = [summary("px", values.ravel()[one], seed, episodes=own[one], within=NATURAL) for one in kept]
        risk[f"{name}_px"] = [part["px"] for part in parts]
        risk[f"{name}_px_95"] = [part["px_95"] for part in parts]
    found = {f"half_px{end}": risk[f"episodes_px{end}"][COVERAGES.index(0.5)] for end in ("", "_95")}
    found |= {"risk": risk, "all_px": risk["episodes_px"][0]}
    return found | _half_gain(stated[..., -1], errors.mean(axis=-1), seed)


def _half_gain(unsure: Floats, values: Floats, seed: int) -> dict[str, Any]:
    """Return by how much the mean error (N, C) of the surest half of episodes is smaller than that of all."""
    kept = np.zeros(unsure.size, bool)
    kept[np.argsort(unsure, axis=None, kind="stable")[: max(1, round(0.5 * unsure.size))]] = True
    among = kept.reshape(unsure.shape)
    half, halves = _means_of((among * values).sum(axis=1), among.sum(axis=1), seed)
    ends = np.percentile(resampled_means(values.mean(axis=1), seed) - halves, LEVELS)
    return {"half_gain_px": rounded(values.mean() - half), "half_gain_px_95": rounded(ends)}


def _warnings(warned: Ints, clock: Ints, doubled: Ints, frames: int, seed: int) -> dict[str, Any]:
    """Return the rates of warnings (N, C) of a meter and of a clock."""
    right = warned_rightly(warned, doubled, frames)
    timed = warned_rightly(clock, doubled, frames)
    found = {"lead_frames": LEAD_FRAMES, "doubling": rounded((doubled < frames).mean())}
    found |= summary("gain", (right.astype(float) - timed).mean(axis=1), seed)
    every = np.ones_like(warned, bool)
    rates = {
        "right": (every, right),
        "clock": (every, timed),
        "misses": (doubled < frames, warned > doubled),
        "false_alarms": (warned < frames, (doubled == frames) | (doubled - warned > LEAD_FRAMES)),
    }
    for name, (among, seen) in rates.items():
        found |= {name: None, f"{name}_95": None}
        if among.any():
            ends = share_interval(*independent(seen.T, among.T))  # a bootstrap of none of few is certain
            found |= {name: rounded(seen[among].mean()), f"{name}_95": rounded(np.array(ends))}
    return found
