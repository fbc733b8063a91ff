"""`hma demo`, small and in this process."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hma_data.errors import OutputError
from hma_data.shards.verify import verify
from hma_model.demo import report
from hma_model.demo import run as demos
from hma_model.demo.results import DemoRun
from hma_model.evaluation.pages import Page
from hma_model.evaluation.rollout_video import RolloutVideo
from hma_model.evaluation.verdict import verdict
from hma_model.evaluation.wholeness import Left
from hma_model.training import loop
from tests.model.evaluation.test_evaluate import GAIN


@pytest.mark.slow
def test_a_demo_that_was_cut_goes_on_by_the_same_command(tmp_path, monkeypatch) -> None:
    def cut(made: DemoRun) -> None:
        raise KeyboardInterrupt

    out = tmp_path / "demo"
    monkeypatch.setattr(demos, "usable_cores", lambda: 1)
    monkeypatch.setattr(demos, "WINDOWS", 2)
    monkeypatch.setattr(demos, "LONGEST", 6)
    with monkeypatch.context() as first, pytest.raises(KeyboardInterrupt):
        first.setattr(demos, "publish", cut)
        demos.demo(out, episodes=4, steps=2)
    kept = {
        path: path.stat().st_mtime_ns
        for name in ("recordings", "shards", "run/checkpoints")
        for path in (out / name).rglob("*")
        if path.is_file() and not path.name.startswith(".")
    }
    assert not (out / "report.html").exists()

    page = demos.demo(out, episodes=4, steps=2).read_text()
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    results = json.loads((out / "results.json").read_text())
    assert results["seconds"] > 0 and set(results["embodiments"]) == set(demos.ROBOTS)
    for robot in demos.ROBOTS:
        assert verify(out / "shards" / robot) == []
        assert (out / "pulled" / robot / "embodiments" / robot / "head.safetensors").is_file()
        figures = results["embodiments"][robot]
        assert set(figures) == {"psnr_last", "psnr_last_shuffled", "psnr_last_copy", "left"}
        assert 0 <= figures["left"]["the robot"]["shape"] <= 1
        assert f'alt="{robot}: recorded"' in page and f"<h2>{robot}: " in page
    for title in ("The robots", "Recorded vs decoded frames", "Sizes and timings", "on your own data"):
        assert title in page
    assert "hma finetune shards/my_arm --from embedded" in page


def test_the_demo_trains_in_a_folder_of_any_name(tmp_path, monkeypatch) -> None:
    made = DemoRun(tmp_path, None, sets={"arm": SimpleNamespace(folder=tmp_path / "a: [1], #2")})
    monkeypatch.setattr(
        loop,
        "finetune",
        lambda _, data, **others: SimpleNamespace(data=data, interrupted=False, step=2, seconds=0.0),
    )
    demos.train(made, 2, 0)
    assert made.run.data == [str(tmp_path / "a: [1], #2")]


def test_a_folder_that_holds_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(OutputError, match=r"thesis\.tex"):
        demos.demo(tmp_path)


def test_other_settings_than_the_folder_was_begun_with_are_refused(tmp_path, monkeypatch) -> None:
    def begun(*given: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(demos, "record_and_convert", begun)
    for episodes, steps, seed, said in ((8, 2, 0, ""), (16, 2, 0, "--episodes 8"), (8, 2, 5, "--seed 0")):
        with pytest.raises(OutputError if said else KeyboardInterrupt, match=said or None):
            demos.demo(tmp_path / "demo", episodes=episodes, steps=steps, seed=seed)
    with pytest.raises(KeyboardInterrupt):
        demos.demo(tmp_path / "demo", episodes=8, steps=2)


FOUND = GAIN | {"episodes": 5, "recordings": 5, "against": "decoded tokens"}


def test_the_report_opens_with_decibels_and_time_under_the_rule_of_evaluate(tmp_path: Path) -> None:
    wide = FOUND | {"psnr_action_gain_last_95": [-0.4, 4.6]}
    page = Page("demo", "")
    made: Any = SimpleNamespace(
        figures={"arm3_55": FOUND, "mover_52": wide},
        films={name: film() for name in ("arm3_55", "mover_52")},
        left={
            "arm3_55": {"the robot": Left(0.65, 0.5, 0.48), "loose objects": Left(0.9, 0.8, 0.76)},
            "mover_52": {"the robot": Left(1.0, 1.0, 0.9)},
        },
        run=SimpleNamespace(seconds=158.0, step=620),
        seconds={"all": 200.0},
    )
    report._headline(page, made)
    report._films(page, made)
    shown = page.html()
    assert "<b>+2.1 dB</b>" in shown and "after 0.6 s" in shown and "2 min 38 s" in shown
    assert "nats" not in shown
    assert shown.count("; damaged after 20 frames: the robot<") == 1  # a gain does not stand bare
    assert "65% of the robot left (50% whole, shape overlap 48%)" in shown and "90%); intact." in shown
    for found in (FOUND, wide):
        assert f"The model {verdict(found)}." in shown
    assert "recorded vs shuffled actions, 0.6 s after the prompt" in shown and "may follow" in shown


def test_a_film_has_a_dark_version_for_dark_mode_with_the_same_images() -> None:
    light = film()
    dark = light.dark()
    assert (dark[:, light.images] == light.frames[:, light.images]).all()
    paper, ink = dark[0, 0, 0], dark[0, 0, 1]
    assert paper.max() < 50 and ink.min() > 200
    page = Page("demo", "")
    page.picture(b"light", "webp", "a film", b"dark")
    assert (
        '<source srcset="data:image/webp;base64,ZGFyaw==" media="(prefers-color-scheme: dark)">'
        in page.html()
    )


def film() -> RolloutVideo:
    """Two frames of 4 by 4 pixels, of which 2 by 2 are an image, with one letter of ink beside it."""
    frames = np.full((2, 4, 4, 3), 250, np.uint8)
    frames[:, 0, 1] = 30
    images = np.zeros((4, 4), np.bool_)
    images[1:3, 1:3] = True
    frames[:, images] = 90
    return RolloutVideo(frames, 10.0, 2, np.zeros((1, 2, 2), np.float32), images)
