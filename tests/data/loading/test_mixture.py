"""The mixture's probabilities and draws, against worked numbers; `hma mixture`."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner, Result

from hma_data.errors import UsageError
from hma_data.loading.mixture import Mixture, epoch_caps, plot_mixture
from hma_model.cli import app
from recipes.bench.loader import make_set
from tests.data.loading.test_pools import SMALL

COUNTS = [10**6, 10**5, 10**4, 10**3]


def probabilities(counts: Sequence[int], temperature: float = 3.0, **options: Sequence[Any]) -> np.ndarray:
    named = {key: {str(i): value for i, value in enumerate(values)} for key, values in options.items()}
    return Mixture.of({str(i): n for i, n in enumerate(counts)}, temperature, **named).p


@pytest.mark.parametrize(
    ("temperature", "expected"),
    [
        (1, [0.9001, 0.0900, 0.0090, 0.0009]),
        (3, [0.5619, 0.2608, 0.1211, 0.0562]),
        (4, [0.4863, 0.2735, 0.1538, 0.0865]),
        (float("inf"), [0.25] * 4),
    ],
)
def test_worked_numbers(temperature: float, expected: list[float]) -> None:
    np.testing.assert_allclose(probabilities(COUNTS, temperature), expected, atol=5e-5)


@given(st.lists(st.integers(0, 10**12), min_size=1, max_size=50), st.floats(0.1, 100))
def test_probabilities_sum_to_one_and_keep_the_order(counts: list[int], temperature: float) -> None:
    if max(counts) == 0:
        with pytest.raises(UsageError):
            probabilities(counts, temperature)
        return
    p = probabilities(counts, temperature)
    assert p.sum() == pytest.approx(1)
    assert (np.diff(p[np.argsort(counts, kind="stable")]) >= -1e-12).all()
    assert (p[np.array(counts) == 0] == 0).all()


def test_a_cap_gives_its_excess_to_the_others_in_proportion() -> None:
    p = probabilities([700, 200, 100], 1, caps=[0.4, 1, 1])
    np.testing.assert_allclose(p, [0.4, 0.4, 0.2])


def test_draws_depend_on_seed_and_step_alone() -> None:
    mixture = Mixture.of({"a": 1000, "b": 10}, seed=7)
    first = mixture.batch(12, 64)
    np.testing.assert_array_equal(first, Mixture.of({"a": 1000, "b": 10}, seed=7).batch(12, 64))
    assert (first != mixture.batch(13, 64)).any()


def test_per_batch_draws_one_embodiment_a_batch() -> None:
    mixture = Mixture.of({"a": 10, "b": 10}, draw="per_batch")
    batches = [mixture.batch(step, 8) for step in range(40)]
    assert all(len(set(batch)) == 1 for batch in batches)
    assert len({int(batch[0]) for batch in batches}) == 2


def test_sets_of_a_group_share_one_weight() -> None:
    counts = {"arm": 900, "left": 10, "right": 90}
    groups = {"left": "hands", "right": "hands"}
    equal = Mixture.of(counts, 1, groups=groups)
    np.testing.assert_allclose(equal.p, [0.5, 0.05, 0.45])
    heavier = Mixture.of(counts, 1, groups=groups, weights={"hands": 3})
    np.testing.assert_allclose(heavier.p, [0.25, 0.075, 0.675])
    within = Mixture.of(counts, 1, groups=groups, weights={"left": 9})
    np.testing.assert_allclose(within.p, [0.5, 0.25, 0.25])
    alone = Mixture.of(counts, 1, groups=groups, weights={"arm": 3})
    np.testing.assert_allclose(alone.p, [0.75, 0.025, 0.225])


def test_no_set_is_passed_over_more_often_than_allowed() -> None:
    counts = {"large": 1_000_000, "small": 1_000}
    free, capped = Mixture.of(counts), Mixture.of(counts, max_epochs=5, samples=500_000)
    assert free.p[1] * 500_000 / 1_000 > 40
    assert capped.p[1] * 500_000 / 1_000 == pytest.approx(5)
    assert capped.p.sum() == pytest.approx(1)


def test_more_samples_than_the_passes_give_are_refused_with_how_many_there_are() -> None:
    with pytest.raises(UsageError, match="plan 2,000 samples"):
        epoch_caps([600, 400], 2, 2_001)


@given(st.lists(st.integers(1, 10**6), min_size=2, max_size=12), st.floats(1.0, 5.0), st.floats(0.05, 1.0))
def test_capped_probabilities_hold_every_cap_and_sum_to_one(counts, max_epochs, used) -> None:
    samples = max(1, int(used * max_epochs * sum(counts)))
    caps = epoch_caps(counts, max_epochs, samples)
    p = probabilities(counts, 3, caps=caps.tolist())
    assert p.sum() == pytest.approx(1)
    assert (p <= caps + 1e-9).all()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        *(({"temperature": value}, "temperature: must be above 0") for value in (0, -1, float("nan"))),
        *(({what: {"leg": 1}}, f"{what}: name leg") for what in ("weights", "groups", "caps")),
        *(({"weights": {"a": value}}, "weights: must be") for value in (-1.0, float("nan"), float("inf"))),
        ({"caps": {"a": -1.0}}, "caps: must be"),
        ({"seed": -1}, "seed: must be at least 0"),
    ],
)
def test_what_no_mixture_can_have_is_refused(options: dict[str, Any], said: str) -> None:
    with pytest.raises(UsageError, match=f"mixture {said}"):
        Mixture.of({"a": 10, "b": 10}, **options)


@pytest.mark.parametrize("count", [1, 40])
def test_the_plot_names_every_robot(count: int, tmp_path: Path) -> None:
    names = [f"robot_{i}" for i in range(count - 1)] + ["a_dataset_with_a_name_too_long_for_the_axis_rlds"]
    plot_mixture(Mixture.of({name: 10 ** (i % 6) for i, name in enumerate(names)}), 3.0, tmp_path / "m.svg")
    drawn = (tmp_path / "m.svg").read_text()
    assert all(f"<!-- {name} -->" in drawn for name in names[:-1])
    assert "<!-- a_dataset_with_a_…" in drawn


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("mixture")
    return [str(make_set(folder / str(i), i, SMALL | {"frames": n})) for i, n in enumerate((6_000, 600))]


def mixture(*words: str) -> Result:
    return CliRunner().invoke(app, ["mixture", *words], catch_exceptions=True)


def rows(*words: str) -> list[dict[str, Any]]:
    done = mixture(*words, "--json")
    assert done.exit_code == 0, done.output
    found: list[dict[str, Any]] = json.loads(done.stdout)["embodiments"]
    return found


def test_the_table_holds_counts_probabilities_and_passes(sets: list[str], tmp_path: Path) -> None:
    large, small = rows(*sets, "--plot", str(tmp_path / "mixture.png"))
    assert (tmp_path / "mixture.png").read_bytes().startswith(b"\x89PNG")
    assert (large["windows"], large["episodes"], large["frames"]) == (3_700, 100, 6_000)
    assert small["probability"] == pytest.approx(1 / (1 + 10 ** (1 / 3)))
    assert (small["proportional"], small["uniform"]) == (pytest.approx(1 / 11), 0.5)
    assert small["epochs"] == pytest.approx(small["probability"] * 4_070 / 370)
    shown = mixture(*sets).output
    assert "bench_0" in shown and "p at τ = 3" in shown and "4,070 samples" in shown


def test_weights_groups_caps_and_passes_reach_the_mixture(sets: list[str]) -> None:
    weighted = rows(*sets, "--temperature", "inf", "--weight", "bench_1=3")
    assert weighted[1]["probability"] == pytest.approx(0.75)
    capped = rows(*sets, "--temperature", "inf", "--cap", "bench_1=0.2")
    assert capped[1]["probability"] == pytest.approx(0.2)
    passes = rows(*sets, "--max-epochs", "2", "--samples", "4000")
    assert passes[1]["epochs"] == pytest.approx(2)
    grouped = rows(*sets, "--group", "bench_0=both", "--group", "bench_1=both", "--temperature", "1")
    assert grouped[0]["probability"] == pytest.approx(10 / 11)


def test_short_episodes_are_counted_or_padded(sets: list[str]) -> None:
    dropped, padded = (rows(sets[1], "--frames", "30", *more) for more in ([], ["--short", "pad"]))
    assert (dropped[0]["windows"], dropped[0]["short_episodes"]) == (10, 0)
    assert padded == dropped
    assert rows(sets[1], "--frames", "40", "--short", "pad")[0]["windows"] == 10
    assert isinstance(mixture(sets[1], "--frames", "40").exception, UsageError)


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        (["--weight", "bench_0"], "must be like NAME=VALUE"),
        (["--weight", "bench_0=much"], "'much' is not a number"),
        (["--plot", "m.jpeg2"], "must end in .png"),
    ],
)
def test_words_that_cannot_be_are_refused(sets: list[str], words: list[str], fault: str) -> None:
    done = mixture(*sets, *words)
    assert isinstance(done.exception, UsageError)
    assert fault in str(done.exception)


@pytest.mark.parametrize("words", [["--split", "test"], ["--short", "cut"]])
def test_a_word_that_is_no_choice_is_wrong_usage(sets: list[str], words: list[str]) -> None:
    done = mixture(*sets, *words)
    assert done.exit_code == 2 and words[1] in done.output
