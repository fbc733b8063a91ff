"""What a run leaves to read: TensorBoard's files, trackio and wandb, pictures, the report."""

import io
import json
import math
import re
import shutil
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.tensorflow_stub.errors import OutOfRangeError
from tensorboard.compat.tensorflow_stub.pywrap_tensorflow import PyRecordReader_New

from hma_data.errors import MissingDependencyError, OutputError
from hma_model.checkpoint.folder import resolve
from hma_model.cli.train import _print
from hma_model.evaluation.plots import loss_curves
from hma_model.training import logging
from hma_model.training.logging import RunLog, read_metrics
from hma_model.training.loop import TrainResult, _result, train
from hma_model.training.recipe import make_recipe
from hma_model.training.report import write_report
from tests.model.robots import CONFIG, Blocks, make_model, save
from tests.model.runs import TINY, train_until

SEEN = {"report": True, "pictures": 2, "track": ["tensorboard"]}


@pytest.fixture
def painter(monkeypatch):
    monkeypatch.setattr("hma_model.evaluation.rollout_video.tokenizer_of", lambda shards: Blocks())


@pytest.fixture(scope="module")
def seen(data, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("seen") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hma_model.evaluation.rollout_video.tokenizer_of", lambda shards: Blocks())
        train(make_recipe({**TINY, **SEEN, "data": data}), out=out, show=False)
    return out


@pytest.fixture
def run(seen, painter, tmp_path) -> Path:
    return shutil.copytree(seen, tmp_path / "run")


def events(path: Path) -> list[Event]:
    reader, found = PyRecordReader_New(str(path)), []
    while True:
        try:
            reader.GetNext()
        except OutOfRangeError:
            return found
        found.append(Event.FromString(reader.record()))


def values(found: list[Event], tag: str) -> list[float]:
    return [v.simple_value for event in found for v in event.summary.value if v.tag == tag]


def test_event_files_have_a_version_every_step_and_every_evaluation(run):
    (path,) = (run / "tensorboard").iterdir()
    first, *rest = events(path)
    assert first.file_version == "brain.Event:2"
    losses = [line["loss"] for line in read_metrics(run) if line["kind"] == "train"]
    assert values(rest, "train/loss") == pytest.approx(losses, rel=1e-6)
    assert len(losses) == 6 and len(values(rest, "eval/loss")) == 2
    assert len(values(rest, "train_loss/arm")) == 6
    images = [v.image for event in rest for v in event.summary.value if v.HasField("image")]
    assert len(images) == 4
    for image in images:
        with Image.open(io.BytesIO(image.encoded_image_string)) as opened:
            assert opened.size == (image.width, image.height)


def test_a_resumed_run_supersedes_what_was_written_beyond_its_step(data, tmp_path):
    given = {**TINY, "data": data, "track": ["tensorboard"]}
    train_until(make_recipe(given), tmp_path / "run", 5)
    train(make_recipe(given), out=tmp_path / "run", show=False)
    first, second = sorted((tmp_path / "run" / "tensorboard").iterdir())
    assert len(values(events(first), "train/loss")) == 5
    start, *rest = events(second)[1:]
    assert (start.step, start.session_log.status) == (5, SessionLog.START)
    assert len(values(rest, "train/loss")) == 2


def test_an_event_file_that_cannot_be_written_is_one_error(data, tmp_path):
    plain = make_recipe({**TINY, "data": data, "steps": 1})
    out = train(plain, out=tmp_path / "run", show=False).out
    (out / "tensorboard").write_text("a file")
    with pytest.raises(OutputError, match="tensorboard: cannot be written"):
        train(plain.model_copy(update={"track": ("tensorboard",)}), out=out, show=False)


@pytest.fixture(params=["trackio", "wandb"])
def package(request, monkeypatch) -> ModuleType:
    module = ModuleType(request.param)
    module.calls = []
    module.init = lambda **given: module.calls.append(("init", given))
    module.log = lambda values, step: module.calls.append(("log", step, values))
    module.finish = lambda: module.calls.append(("finish",))
    module.Image = lambda path: ("image", path)
    monkeypatch.setitem(sys.modules, request.param, module)
    return module


def test_trackio_and_wandb_get_the_recipe_the_figures_and_the_pictures(package, data, painter, tmp_path):
    given = {**TINY, "data": data, "pictures": 1, "track": [package.__name__], "project": "arms"}
    train(make_recipe(given), out=tmp_path / "first", show=False)
    (_, init), *logged, last = package.calls
    assert (init["project"], init["name"], init["config"]["steps"]) == ("arms", "first", 6)
    assert [step for _, step, values in logged if "train/loss" in values] == [1, 2, 3, 4, 5, 6]
    assert sum(value[0] == "image" for _, _, v in logged for value in v.values() if type(value) is tuple) == 4
    assert last == ("finish",) and ("id" in init) == (package.__name__ == "wandb")


@pytest.mark.parametrize(
    ("name", "module", "install"),
    [
        ("trackio", "trackio", "pip install trackio"),
        ("wandb", "wandb", "pip install wandb"),
        ("tensorboard", "tensorboard.compat.proto.event_pb2", "uv sync --inexact --extra tensorboard"),
    ],
)
def test_a_package_that_is_missing_is_said_with_how_to_install_it(
    data, tmp_path, monkeypatch, name, module, install
):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingDependencyError, match=f"{name} is not installed — {install}"):
        train(make_recipe({**TINY, "data": data, "track": [name]}), out=tmp_path / "run", show=False)


def test_evaluations_leave_pictures_and_the_card_shows_the_last(run):
    names = sorted(path.name for path in (run / "pictures").iterdir())
    assert names == [f"step-{step:08d}-{name}.png" for step in (3, 6) for name in ("arm", "hand")]
    folder = resolve(run)
    sample = folder / "embodiments" / "arm" / "sample.png"
    assert sample.read_bytes() == (run / "pictures" / "step-00000006-arm.png").read_bytes()
    assert "embodiments/arm/sample.png" in (folder / "README.md").read_text()


@pytest.mark.parametrize(("share", "steps"), [(0.0, [6]), (1e9, [1, 2, 3, 4, 5, 6])])
def test_pictures_before_the_last_take_their_share_of_time(data, painter, tmp_path, share, steps):
    given = {"data": data[:1], "pictures": 1, "pictures_share": share, "eval_every": 1}
    train(make_recipe({**TINY, **given}), out=tmp_path / "run", show=False)
    names = sorted(path.name for path in (tmp_path / "run/pictures").iterdir())
    assert names == [f"step-{step:08d}-arm.png" for step in steps]


@pytest.mark.parametrize("objective", ["policy", "inverse"])
def test_a_model_that_predicts_no_frames_is_trained_without_pictures(data, painter, tmp_path, objective):
    given = {"data": data[:1], "pictures": 1, "eval_every": 2, "objectives": {objective: 1.0}}
    result = train(make_recipe({**TINY, **given}), out=tmp_path / "run", show=False)
    assert result.checkpoint.is_dir() and not (tmp_path / "run/pictures").exists()


def test_without_the_tokenizer_there_is_a_word_and_no_picture(data, tmp_path, capsys):
    train(make_recipe({**TINY, "data": data, "pictures": 1}), out=tmp_path / "run")
    assert "no pictures: " in capsys.readouterr().err and not (tmp_path / "run/pictures").exists()


def test_the_report_is_one_file_with_curves_samples_recipe_and_environment(run):
    page = (run / "report.html").read_text()
    assert not re.search(r"(src|href)=.?https?:", page)
    assert page.count("data:image/png") == 2 and page.count("data:image/svg+xml") == 4
    *_, last = read_metrics(run)
    for text in ("arm", "hand", "6 of 6", f"{last['loss']:.3f}", "temperature", "git_revision", "platform"):
        assert text in page, text


def test_the_report_of_a_run_without_a_step_or_with_losses_that_are_no_numbers_can_be_made(run):
    lines = list(read_metrics(run))
    lines[2]["loss"] = None
    lines[2]["loss_by_embodiment"] = {"arm": None}
    (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    write_report(run)
    (run / "metrics.jsonl").write_text("")
    write_report(run)


class Line(dict):
    alive = most = 0

    def __init__(self, text: str) -> None:
        super().__init__(json.loads(text))
        Line.alive += 1
        Line.most = max(Line.most, Line.alive)

    def __del__(self) -> None:
        Line.alive -= 1


@pytest.mark.parametrize("use", ["resume", "result", "report"])
def test_of_a_long_run_few_lines_are_in_memory_at_a_time(run, monkeypatch, use):
    steps = [line for line in read_metrics(run) if line["kind"] == "train"]
    lines = [{**steps[step % 6], "step": step + 1} for step in range(500)]
    (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    monkeypatch.setattr(logging, "json", SimpleNamespace(loads=Line, dumps=json.dumps))
    monkeypatch.setattr(Line, "most", 0)
    if use == "resume":
        RunLog(run, 500, 400, show=False)
        assert len((run / "metrics.jsonl").read_text().splitlines()) == 400
    elif use == "result":
        ended = SimpleNamespace(out=run, step=500, done=1.0, evaluation={}, skipped=0, seconds=1.0)
        assert _result(ended).losses == [(line["step"], line["loss"]) for line in lines]
    else:
        write_report(run)
        assert "500 of" in (run / "report.html").read_text()
    assert 1 <= Line.most <= 60


@pytest.mark.parametrize(("steps", "width"), [(1, 1), (39, 1), (100, 2), (121, 3), (1000, 25), (999, 24)])
def test_a_curve_is_the_mean_of_its_last_steps_also_after_a_huge_loss(monkeypatch, steps, width):
    losses, drawn = np.random.default_rng(steps).normal(size=steps), {}
    losses[steps // 2] = 1e30

    def plot(self, x, y, **look):
        drawn[look["label"]] = x, y

    monkeypatch.setattr("matplotlib.axes.Axes.plot", plot)
    monkeypatch.setattr("matplotlib.axes.Axes.legend", lambda self, **look: None)
    loss_curves({"arm": list(enumerate(losses))}, {}, "loss")
    windows = np.lib.stride_tricks.sliding_window_view(losses, width)
    np.testing.assert_array_equal(drawn["arm"][0], np.arange(width - 1, steps))
    np.testing.assert_allclose(drawn["arm"][1], windows.mean(1), rtol=1e-12, atol=1e-14)


def test_a_curve_takes_no_longer_for_its_width(monkeypatch):
    monkeypatch.setattr(np, "convolve", lambda *_: pytest.fail("a product for each value and each of width"))
    assert b"<svg" in loss_curves({"arm": [(step, 1.0) for step in range(100)]}, {}, "loss")


def facts(step: int, loss: float = 2.0, **given) -> dict:
    own = {"loss": loss, "loss_by_embodiment": {"arm": loss}, "lr": 1e-3, "skipped": 0}
    return {"step": step, **own, **given}


def test_cpu_seconds_may_end_a_run_sooner_than_its_steps(tmp_path, capsys):
    with RunLog(tmp_path, 1_000_000, 0) as log:
        for step in range(1, 11):
            log.step(facts(step, done=step / 40))
    assert "training: 10/40 steps" in capsys.readouterr().err.splitlines()[-1]
    with RunLog(tmp_path, 1_000_000, 0) as log:
        log.step(facts(10, done=1.01))  # the last step went beyond them
    assert "training: 10/10 steps" in capsys.readouterr().err.splitlines()[-1]


def test_a_loss_that_is_no_number_leaves_the_shown_mean_one(tmp_path, capsys):
    with RunLog(tmp_path, 9, 0) as log:
        log.step(facts(1))
        log.step(facts(2, loss=math.nan, skipped=1))
    last = capsys.readouterr().err.splitlines()[-1]
    assert "loss arm 2.000" in last and "1 steps skipped" in last


def test_the_last_line_has_the_last_evaluation(tmp_path, capsys):
    with RunLog(tmp_path, 2, 0) as log:
        log.evaluation(facts(1, loss=3.0))
        log.step(facts(2))
        log.evaluation(facts(2, loss=1.5))
    last = capsys.readouterr().err.splitlines()[-1]
    assert "training: 2/2 steps" in last and "validation 1.500" in last


@pytest.mark.parametrize(("merge", "unit"), [(1, "token"), (2, "square of 2×2 tokens")])
def test_the_held_out_loss_names_what_it_is_of(merge, unit, tmp_path, capsys) -> None:
    config = CONFIG.replace(grid=(2, 4), merge=merge, tokenizer={**CONFIG.tokenizer, "grid": [2, 4]})
    save(tmp_path / "made", {"arm": 2}, model=make_model({"arm": 2}, config=config))
    _print(
        TrainResult(
            tmp_path, tmp_path / "made", 3, [], [], masked_val_loss=2.0, baseline=4.0, interrupted=False,
            skipped=0, seconds=1.0,
        )
    )  # fmt: skip
    assert f"held-out loss 2.0000 nats per {unit}; baseline (token frequencies)" in capsys.readouterr().out
