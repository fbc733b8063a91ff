"""`hma demo`, small and in this process."""

import json
from pathlib import Path
from typing import Any

import pytest

from hma_data.errors import OutputError
from hma_data.shards.verify import verify
from hma_model.demo import report
from hma_model.demo import run as demos
from hma_model.demo.results import Demo
from tests.model.embedded import embedded


@pytest.mark.slow
def test_a_demo_that_was_cut_goes_on_by_the_same_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cut(made: Demo) -> None:
        raise KeyboardInterrupt

    out = tmp_path / "demo"
    embedded(tmp_path / "embedded", monkeypatch)
    monkeypatch.setattr(demos, "usable_cores", lambda: 1)
    monkeypatch.setattr(demos, "WINDOWS", 2)
    monkeypatch.setattr(demos, "LONGEST", 6)
    with monkeypatch.context() as first, pytest.raises(KeyboardInterrupt):
        first.setattr(demos, "publish", cut)
        demos.demo(out, episodes=4, steps=2)
    kept = {
        path: path.stat().st_mtime_ns
        for name in ("recordings", "shards", "run/checkpoints", "scratch/checkpoints")
        for path in _files(out / name)
    }
    assert not (out / "report.html").exists()

    page = demos.demo(out, episodes=4, steps=2).read_text()
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    results = json.loads((out / "results.json").read_text())
    assert results["seconds"] > 0 and set(results["embodiments"]) == set(demos.ROBOTS)
    for robot in demos.ROBOTS:
        assert verify(out / "shards" / robot) == []
        assert (out / "pulled" / robot / "embodiments" / robot / "head.safetensors").is_file()
        assert set(results["embodiments"][robot]) == {"psnr_last", "psnr_last_shuffled", "psnr_last_copy"}
        assert f"{robot}: recorded frames above" in page and f"<h2>{robot}: " in page
    assert page.count("data:image/webp") == 2 and page.index("data:image/webp") < page.index("held-out loss")
    for title in ("The robots", "The mixture", "Training", "Sizes and timings", "on your own data"):
        assert title in page
    assert "hma finetune --from embedded --data shards/my_arm" in page


def test_a_folder_that_holds_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(OutputError, match=r"thesis\.tex"):
        demos.demo(tmp_path)


def test_other_settings_than_the_folder_was_begun_with_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def begun(*given: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(demos, "record_and_convert", begun)
    for episodes, steps, seed, said in ((8, 2, 0, ""), (16, 2, 0, "--episodes 8"), (8, 2, 5, "--seed 0")):
        with pytest.raises(OutputError if said else KeyboardInterrupt, match=said or None):
            demos.demo(tmp_path / "demo", episodes=episodes, steps=steps, seed=seed)
    with pytest.raises(KeyboardInterrupt):
        demos.demo(tmp_path / "demo", episodes=8, steps=2)


@pytest.mark.parametrize(
    ("true", "shuffled", "copy", "begins"),
    [
        (30.0, 27.9, 28.4, "The model follows its actions: +2.1 dB over shuffled (bar: 2) and +1.6 dB over"),
        (30.0, 28.1, 20.0, "The bar is not reached: +1.9 dB over shuffled (bar: 2)"),
        (30.0, 20.0, 30.5, "The bar is not reached: +10.0 dB over shuffled (bar: 2) and -0.5 dB over copy"),
    ],
)
def test_the_report_says_plainly_whether_the_model_follows(
    true: float, shuffled: float, copy: float, begins: str
) -> None:
    last = {"true": true, "shuffled": shuffled, "copy": copy}
    found = {name: {"psnr_last": value} for name, value in last.items()} | {"windows": 24, "draws": 5}
    said = report.verdict(found)
    assert said.startswith(begins)
    assert "30.0 dB with true actions" in said and "24 held-out windows and 5 draws" in said


def _files(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file() and not path.name.startswith(".")]
