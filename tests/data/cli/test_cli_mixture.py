"""`hma mixture`: its table, JSON, plot, and what it refuses."""

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from hma_data.errors import UsageError
from hma_model.cli import app
from recipes.bench.loader import make_set
from tests.data.loading.test_pools import SMALL


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """100 and 10 episodes of 60 frames: 3,700 and 370 windows of 12 frames, two rows apart."""
    folder = tmp_path_factory.mktemp("mixture")
    return [str(make_set(folder / str(i), i, SMALL | {"frames": n})) for i, n in enumerate((6_000, 600))]


def mixture(*words: str) -> Result:
    return CliRunner().invoke(app, ["mixture", *words], catch_exceptions=True)


def rows(*words: str) -> list[dict[str, Any]]:
    done = mixture(*words, "--json")
    assert done.exit_code == 0, done.output
    found: list[dict[str, Any]] = json.loads(done.stdout)["embodiments"]
    return found


def test_the_table_holds_counts_probabilities_and_passes(sets: list[str]) -> None:
    large, small = rows(*sets)
    assert (large["windows"], large["episodes"], large["frames"]) == (3_700, 100, 6_000)
    assert small["probability"] == pytest.approx(1 / (1 + 10 ** (1 / 3)))
    assert (small["proportional"], small["uniform"]) == (pytest.approx(1 / 11), 0.5)
    assert small["epochs"] == pytest.approx(small["probability"] * 4_070 / 370)
    shown = mixture(*sets).output
    assert "bench_0" in shown and "p at τ = 3" in shown and "4,070 samples" in shown


def test_proportional_sampling_passes_once_over_every_set(sets: list[str]) -> None:
    assert [row["epochs"] for row in rows(*sets, "--temperature", "1")] == pytest.approx([1, 1])


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
        (["--weight", "leg=2"], "name leg"),
        (["--plot", "m.jpeg2"], "must end in .png"),
        (["--temperature", "0"], "must be above 0"),
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


def test_the_plot_is_drawn(sets: list[str], tmp_path: Path) -> None:
    assert mixture(*sets, "--plot", str(tmp_path / "mixture.png")).exit_code == 0
    assert (tmp_path / "mixture.png").read_bytes().startswith(b"\x89PNG")
