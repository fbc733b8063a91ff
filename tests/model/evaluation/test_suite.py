"""Several checkpoints on several sets: parts that are kept, results that repeat, the page, refusals."""

import copy
import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hma_data.lab import record
from hma_data.lab.truth import episode
from hma_data.registry.embodiment import find
from hma_model.checkpoint.folder import Checkpoint
from hma_model.cli import main
from hma_model.evaluation import probe, report, suite
from hma_model.evaluation.report import difference, write_results
from hma_model.evaluation.simulated import PERTURBATION, perturbed
from hma_model.evaluation.suite import EvaluationSettings, Part, evaluate_all
from hma_model.evaluation.tables import MEAN, absences, comparison, means
from hma_model.evaluation.verdict import verdict
from tests.model.robots import CONFIG, SPEC, Blocks, make_model, save
from tests.model.shards import make_shards

SETTINGS = EvaluationSettings(windows=3, draws=1)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    for name, seed in (("one", 0), ("other", 1)):
        save(folder / name, {"arm": 2, "hand": 3}, seed)
    make_shards(folder / "arm", "arm", held_out=2)
    make_shards(folder / "hand", "hand", dims=3, seed=4, held_out=2)
    make_shards(folder / "alone", "arm", episodes=1, held_out=0)
    return folder


@pytest.fixture(autouse=True, scope="module")
def blocks() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for module in (suite, report):
            patch.setattr(module, "tokenizer_of", lambda shards, **_: Blocks())
        suite._tokenizer.cache_clear()
        yield


@pytest.fixture(scope="module")
def evaluated(made: Path, blocks: None) -> list[suite.Part]:
    """Both checkpoints on both sets; what a test changes is a copy."""
    return run(made, checkpoints=BOTH)


def run(
    made: Path,
    out: Path | None = None,
    settings: EvaluationSettings = SETTINGS,
    checkpoints: tuple[str, ...] = ("one",),
) -> list[suite.Part]:
    folders = [made / name for name in checkpoints]
    return evaluate_all(folders, [made / "arm", made / "hand"], settings, out=out)


BOTH, ROBOTS = ("one", "other"), ("arm", "hand")


def test_every_checkpoint_is_evaluated_on_every_set_and_the_mean_counts_sets_once(evaluated) -> None:
    parts = evaluated
    assert [(Path(p.checkpoint).name, p.found["embodiment"]) for p in parts] == [
        ("one", "arm"), ("one", "hand"), ("other", "arm"), ("other", "hand"),
    ]  # fmt: skip
    first, _ = means(parts)
    assert first["true.psnr"] == pytest.approx(
        np.mean([p.found["true"]["psnr"] for p in parts[:2]]), abs=1e-4
    )
    low, high = first["true.psnr_95"]
    assert low < first["true.psnr"] < high
    table = comparison(parts)
    names, lines = table.columns, table.rows
    assert [line[names.index("episodes")] for line in lines] == [2, 2, 4] * 2
    assert [line[1] for line in lines] == ["arm", "hand", "mean over sets"] * 2 and len(lines[0]) == len(
        names
    )


def test_a_loss_too_large_for_a_perplexity_is_no_error() -> None:
    found = {"embodiment": "arm", "windows": 2, "episodes": 2, "perplexity": 1e300}
    parts = [Part("run", "set", found, {"loss": np.array([700.0, 820.0]), "recording": np.arange(2)}, {})]
    assert means(parts)[0]["perplexity"] == np.inf


def test_a_verdict_reaches_the_cards_of_a_checkpoint(made: Path, evaluated: list[suite.Part]) -> None:
    arm = evaluated[0]
    found = Checkpoint.open(made / "one").card("arm")["evaluation"]
    assert found["verdict"] == verdict(arm.found) and found["episodes"] == 2
    assert found["follows"] is found["verdict"].startswith("follows")
    page = (made / "one" / "README.md").read_text()
    assert page.index("> **arm** ") < page.index("## Embodiments")


def test_what_holds_for_every_part_is_said_of_all_and_the_rest_of_its_own(made, evaluated) -> None:
    parts = copy.deepcopy(evaluated)
    for part in parts:
        part.found["notes"] = ["of each"]
    parts[1].found["notes"] = ["of each", "of one"]
    whose = {text: name for name, text in absences(parts)}
    assert whose["of each"] == "all" and whose["of one"] == f"{made / 'one'} on hand"
    assert {text: name for name, text in absences(parts[:1])}["of each"] == "arm"


def test_a_model_of_squares_is_compared_by_the_loss_of_a_stored_token(tmp_path, capsys) -> None:
    spec = replace(SPEC, grid=(2, 4))
    make_shards(tmp_path / "arm", "arm", held_out=2, spec=spec)
    for name, merge in (("single", 1), ("square", 2)):  # neither knows anything
        config = replace(CONFIG, grid=(2, 4), tokenizer=spec.to_json(), merge=merge)
        model = make_model({"arm": 2}, config=config)
        torch.nn.init.zeros_(model.readout.linear.weight)
        torch.nn.init.zeros_(model.readout.linear.bias)
        save(tmp_path / name, {"arm": 2}, model=model)
    parts = evaluate_all([tmp_path / "single", tmp_path / "square"], [tmp_path / "arm"], SETTINGS)
    single, square = (part.found for part in parts)
    assert square["loss"] == pytest.approx(4 * single["loss"], rel=1e-4)
    assert single["stored_loss"] == pytest.approx(square["stored_loss"], rel=1e-4)
    assert single["stored_loss"] == pytest.approx(np.log(64), rel=1e-4)
    assert {one: whose for whose, one in absences(parts) if "square of 2×2" in one}.popitem()[1] == (
        f"{tmp_path / 'square'} on arm"
    )
    assert "nats/token" in comparison(parts).columns
    assert main(["evaluate", str(tmp_path / "square"), str(tmp_path / "arm"), "--windows", "3"]) == 0
    said = capsys.readouterr().out
    assert "loss, perplexity and accuracy are per square of 2×2 tokens" in said and "nats/token" in said


def test_parts_of_another_seed_are_other_parts(made, tmp_path) -> None:
    for seed, count in ((0, 2), (0, 2), (1, 4)):
        run(made, tmp_path, replace(SETTINGS, seed=seed))
        assert len(list((tmp_path / "parts").glob("*.npz"))) == count


def test_the_page_is_one_file_that_shows_each_robot_and_checkpoint(made, evaluated, tmp_path) -> None:
    page = write_results(evaluated, tmp_path, "hma evaluate").read_text()
    assert not re.findall(r'(?:src|href)="(?!data:)', page)
    strips = re.findall(r'alt="(The \w+ window[^"]*)"', page)
    assert len(strips) == 2 * 3 * (1 + 2 * 3)  # robots, windows, and from the tokens and three a checkpoint
    assert "recorded images are not shown" in page and "--lpips FILE" in page
    table = (tmp_path / "results.md").read_text()
    assert table.count("mean over sets") == 2 and "ΔPSNR" in table
    said = verdict(evaluated[0].found)
    assert said in page and f"- {made / 'one'} on arm {said}" in table
    shown = re.sub(r"<h2>The command.*", "", page, flags=re.DOTALL)
    assert shown.count(str(made / "one")) == 1  # a legend, then short names
    heads = ["figure", *(f"{one}<br><small>{robot}</small>" for one in BOTH for robot in (*ROBOTS, MEAN))]
    assert "".join(f"<th>{head}</th>" for head in heads) in shown  # checkpoints stand side by side
    results = json.loads((tmp_path / "results.json").read_bytes())
    assert {row["checkpoint"] for row in results["means"]} == {str(made / name) for name in BOTH}


def test_the_difference_is_black_where_pictures_are_equal() -> None:
    one = np.full((2, 4, 4, 3), 100, np.uint8)
    other = one.copy()
    other[1] = 255
    found = difference(one, other)
    assert found[0].max() < 10 and found[1].min() > 100


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{made}/one", "{made}/arm", "--frames", "40"], "arm: has no window of 40 frames in val"),
        (
            ["{made}/one", "{made}/alone"],
            "alone: has no episode in val — give --split train, or convert more",
        ),
        (["{made}/one", "{made}/arm", "--prompt", "4"], "--prompt: 4 true frames leave none to predict"),
        (["{made}/one", "{made}/arm", "{made}/arm"], "arm: is the embodiment of two arguments"),
        (["{made}/one", "{made}/arm", "--compare", "{made}/one"], "is the checkpoint of two arguments"),
        (["{made}/narrow", "{made}/hand"], "hand"),
        (["{made}/one", "{made}/arm", "--compare", "{made}/foreign"], "was trained on tokenizer"),
        (
            ["{made}/one", "{made}/arm", "--cameras", "top,wrist"],
            "cameras: are 2 in a frame, but the model takes 1",
        ),
        (["{made}/one", "{made}/arm", "--state"], "arm: is not one of the toolkit's simulated robots"),
        (["{made}/one", "{made}/arm", "--fid", "nowhere.pt"], "--fid: nowhere.pt: no such file"),
        (["{made}/one", "{made}/arm", "--out", "{made}"], "holds something else than an evaluation"),
        (
            ["{made}/one", "{made}/arm", "--out", "{made}/one/config.json/out"],
            "config.json/out: cannot be written: Not a directory",
        ),
        (["{made}/edited", "{made}/arm"], "edited/trunk.safetensors: missing "),
    ],
)
def test_wrong_input_is_one_line(made, capsys, words, message) -> None:
    if not (made / "narrow").exists():
        save(made / "narrow", {"arm": 2})
        other = CONFIG.replace(tokenizer={**SPEC.to_json(), "version": 2})
        shutil.copytree(made / "one", made / "edited")
        config = json.loads((made / "edited" / "config.json").read_text())
        config["model"]["layers"] += 1
        (made / "edited" / "config.json").write_text(json.dumps(config))
        save(made / "foreign", {"arm": 2}, model=make_model({"arm": 2}, config=other))
    code = main(["evaluate", *(word.format(made=made) for word in words)])
    said = capsys.readouterr()
    assert code and not said.out and message in said.err and said.err.count("\n") == 1, said.err


def test_json_is_one_object_a_line(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, arm, hand = (str(made / name) for name in ("one", "arm", "hand"))
    assert main(["evaluate", one, arm, hand, "--windows", "3", "--json"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["embodiment"] for line in lines] == ["arm", "hand"]
    kept = {"split", "windows", "frames", "prompt", "draws", "against", "cameras", "loss", "shuffled_loss"}
    kept |= {"baseline_loss", "perplexity", "accuracy", "true", "shuffled", "copy", "psnr_action_gain_last"}
    assert kept <= set(lines[0])
    assert main(["evaluate", one, arm, "--windows", "3"]) == 0
    shown = capsys.readouterr().out
    assert "3 windows of 4 frames" in shown and "loss, shuffled" in shown and "not measured" in shown


def test_the_simulator_answers_commands_that_are_given() -> None:
    robot, frames, stride = "rails_03", 5, 2
    own = episode(robot, frames, stride, 0, 3)
    steps = own.chunks.reshape(frames * stride, -1)
    same = episode(robot, frames, stride, 0, 3, commands=steps)
    assert (same.pictures == own.pictures).all() and (same.chunks == own.chunks).all()
    other = steps.copy()
    other[2 * stride :] *= -1
    moved = episode(robot, frames, stride, 0, 3, commands=other)
    assert (moved.pictures[:3] == own.pictures[:3]).all() and (moved.parts[3:] != own.parts[3:]).any()


def test_perturbed_commands_keep_the_prompt() -> None:
    chunks = np.random.default_rng(0).normal(0, 4, (300, 6, 4)).astype(np.float32)
    noisy = perturbed(chunks, 2, 3, seed=0)
    assert (noisy[:, :2] == chunks[:, :2]).all()
    assert (noisy - chunks)[:, 2:].std() == pytest.approx(4 * PERTURBATION, rel=0.05)


@pytest.mark.slow
def test_recorded_pictures_are_those_of_the_windows_frames(tmp_path: Path) -> None:
    from hma_data.conversion.job import convert
    from hma_data.loading.dataset import WindowDataset
    from hma_data.shards.preview import tokenizer_of
    from hma_data.shards.reader import ShardSet
    from hma_model.generation.decode import decode

    recording = record("pendulum", tmp_path / "rec", 2, seed=1)
    convert(find("pendulum"), recording, "fsq-8", tmp_path / "shards")
    shards = ShardSet(tmp_path / "shards")
    batch = WindowDataset(shards, "train", 4).batch([7])
    seen = report.recorded_frames(shards, batch, 0)
    assert batch.tokens is not None
    shown = decode(tokenizer_of(shards), batch.tokens)[0]
    errors = [[np.abs(a.astype(int) - b).mean() for b in shown] for a in seen]
    assert np.argmin(errors, axis=1).tolist() == [0, 1, 2, 3] and np.diag(errors).max() < 12


@pytest.mark.parametrize("cameras", ["wrist", "drawn"])
def test_recorded_pictures_are_of_the_camera_that_the_window_takes(cameras: str, tmp_path: Path) -> None:
    from hma_data.loading.dataset import WindowDataset
    from hma_data.shards.reader import ShardSet
    from tests.data import cameras as three

    shards = ShardSet(three.three_shards(tmp_path, val_fraction=0))
    windows = WindowDataset(shards, "train", 3, cameras=cameras)
    batch = windows.batch(range(len(windows)))
    assert batch.camera is not None
    for row, camera in enumerate(batch.camera.tolist()):
        seen = report.recorded_frames(shards, batch, row)
        assert (seen[..., 0] == 17 * (1 + 4 * camera)).all()


@pytest.mark.slow
def test_the_state_of_a_laboratory_robot_is_read_beside_the_probes_error(monkeypatch) -> None:
    from hma_data.tokenizers.base import get_tokenizer
    from hma_model.evaluation.simulated import measure_state
    from hma_model.network.model import HMA

    monkeypatch.setattr(probe, "EPISODES", 16)
    robot = "rails_03"
    model = HMA.from_pretrained("embedded", embodiments=[robot]).eval()
    tokenizer = get_tokenizer(str(model.config.tokenizer["name"]))
    found = measure_state(model, tokenizer, robot, frames=6, prompt=2, episodes=4)
    assert len(found["true"]["error_px_by_frame"]) == 4
    errors = {kind: found[kind]["error_px_last"] for kind in ("reconstruction", "true", "shuffled", "copy")}
    assert errors["reconstruction"] < errors["true"] < min(errors["shuffled"], errors["copy"])
    assert found["reconstruction"]["error_px"] < 3 * found["probe_px"] + 1
    assert found["perturbed"]["psnr_star"] == pytest.approx(found["perturbed"]["psnr"], abs=3)
