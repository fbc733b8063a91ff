"""`hma bench quality`: bands are recorded and compared with; a figure outside them makes the command fail."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hma_data.errors import UsageError
from hma_model.cli import app
from recipes.bench import quality

TINY = ["cases=discrete", "steps=2", "windows=2", "episodes=0"]


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return quality.recorded("rails_03", "fsq-lab", tmp_path_factory.mktemp("quality") / "rails_03", 6)


@pytest.mark.slow
def test_the_same_code_is_inside_its_bands(shards: Path, tmp_path: Path) -> None:
    bands = tmp_path / "bands.json"
    words = ["bench", "quality", *TINY, f"data={shards}", f"bands={bands}"]
    done = CliRunner().invoke(app, [*words, "seeds=2", "record=true"])
    assert done.exit_code == 0, done.output
    kept = json.loads(bands.read_text())
    seeds = kept["discrete"]["seeds"]
    assert [set(one) for one in seeds] == [{"loss", "psnr_db", "gain_db"}] * 2
    again = CliRunner().invoke(app, [*words, "seeds=2", "--json"])
    assert again.exit_code == 0, again.output
    for row in json.loads(again.stdout)["results"]:  # the same seeds give the same figures
        middle = np.mean([one[row["figure"]] for one in seeds])
        assert (row["value"], row["verdict"]) == (pytest.approx(middle, abs=1e-4), "inside")
        assert row["other than the bands'"] is None


def test_a_figure_outside_its_band_makes_the_command_fail(tmp_path, monkeypatch) -> None:
    losses = iter((3.0, 3.1, 3.05, 3.6, 2.4))
    monkeypatch.setattr(quality, "measure", lambda *given: {"loss": next(losses)})
    monkeypatch.setattr(quality, "digest_of", lambda data: "d")
    words = ["bench", "quality", "cases=discrete", "data=shards", f"bands={tmp_path / 'bands.json'}"]
    assert CliRunner().invoke(app, [*words, "seeds=3", "record=true"]).exit_code == 0
    for verdict in ("worse", "better"):
        done = CliRunner().invoke(app, words)
        assert done.exit_code == 1 and f"outside the bands: discrete: loss, {verdict}" in done.output


def test_a_band_holds_the_next_run_in_95_of_100_cases() -> None:
    rng = np.random.default_rng(0)
    inside = 0
    for draws in rng.normal(3.0, 0.2, (2000, 4)):
        facts = {"data": "", "torch": ""}
        kept = {**facts, "seeds": [{"loss": float(value)} for value in draws[:3]]}
        (row,) = quality.judged("discrete", kept, [{"loss": float(draws[3])}], facts)
        inside += row["inside"]
    assert 0.93 < inside / 2000 < 0.97


def test_a_recording_that_was_stopped_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bands, measured = tmp_path / "bands.json", []

    def measure(name: str, data: Path, budget: dict[str, int], seed: int) -> dict[str, float]:
        if seed == 1 and len(measured) == 1:
            raise KeyboardInterrupt
        measured.append(seed)
        return {"loss": float(seed)}

    monkeypatch.setattr(quality, "measure", measure)
    monkeypatch.setattr(quality, "digest_of", lambda data: "d")
    asked = quality.BENCH.defaults | {"data": "shards", "bands": str(bands), "seeds": 3, "record": True}
    for _ in range(3):  # stopped at the second seed; continued; recorded anew
        try:
            quality.run(asked)
        except KeyboardInterrupt:
            measured.append(-1)
    assert measured == [0, -1, 1, 2, 0, 1, 2]


def test_bands_of_another_budget_are_refused(tmp_path: Path) -> None:
    bands = tmp_path / "bands.json"
    budget = {"steps": 300, "windows": 24, "episodes": 16}
    bands.write_text(json.dumps({"discrete": {"budget": budget, "seeds": [{}, {}]}}))
    asked = quality.BENCH.defaults | {"cases": "discrete", "steps": 20, "bands": str(bands)}
    with pytest.raises(UsageError, match="are of steps=300"):
        quality.run(asked)


@pytest.mark.parametrize("case", quality.CASES)
def test_every_case_is_a_recipe(case: str) -> None:
    recipe = quality.recipe_of(quality.CASES[case], Path("shards"), 5, 1)
    assert (recipe.steps, recipe.seed, recipe.frames) == (5, 1, quality.FRAMES)
