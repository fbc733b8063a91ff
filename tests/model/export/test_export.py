"""Exported graphs: the frames are those of torch, and the folder says how to drive them."""

import hashlib
import json
import re
import shutil
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from numpy.typing import NDArray

from hma_data.errors import CheckpointError, UsageError
from hma_data.tokenizers.base import reopened
from hma_model.checkpoint.folder import BUNDLED, Checkpoint
from hma_model.checkpoint.io import load
from hma_model.cli.export import export_checkpoint
from hma_model.evaluation.metrics import psnr
from hma_model.export.files import rounded
from hma_model.export.folder import _meter, _require_own
from hma_model.export.graphs import require_exportable
from hma_model.export.truth import table_values
from hma_model.generation.decode import decode
from hma_model.generation.rollout import Rollout
from hma_model.worlds.scenes import LabRobot
from tests.command import hma
from tests.model.export.checkpoints import ROBOT, Driver, drawn_as_torch
from tests.model.play.test_stepper import METER
from tests.model.true_world import BlockLatents, latent_model

pytestmark = pytest.mark.slow  # exporting a graph takes a quarter of a minute
FRAMES, EXACT = 100, 40


def closed_loop(
    page: Path, checkpoint: Checkpoint, robot: str, count: int = FRAMES, exact: int = EXACT, led: bool = False
) -> list[tuple[Any, Any, float]]:
    """Return the frames of the page and of torch; `led`: the page sees torch's as those before."""
    model = rounded(load(checkpoint, [robot], "cpu").eval())
    tokenizer = reopened(model.config.tokenizer)
    driver = Driver(page, robot)
    rollout = Rollout(model, robot, temperature=0.0)
    rollout.decoding = replace(rollout.decoding, measure=True)
    frames, chunks = torch.from_numpy(unwrapped(driver.frames))[None], torch.from_numpy(driver.chunks)[None]
    rollout.prompt(frames, chunks, seeds=[7])
    draws = drawn_as_torch(driver, model.config, 7)
    low, high = np.transpose([(dim["low"], dim["high"]) for dim in driver.robot["dimensions"]])
    actions, found = np.random.default_rng(3), []
    for number in range(count):
        chunk = actions.uniform(low, high, (driver.robot["stride"], len(low))).astype(np.float32).reshape(-1)
        image = driver.advance(chunk, next(draws))
        frame = rollout.step(torch.from_numpy(chunk)[None])
        shown = decode(tokenizer, frame[None])[0, 0]
        if model.config.kind == "discrete":
            near = 1e-3 if number < exact else 1e-2
            assert driver.uncertainty == pytest.approx(rollout.uncertainty.item(), rel=near), (robot, number)
        found.append((unwrapped(driver.state["frame"]), frame[0].numpy(), psnr(image, shown)))
        if led:
            driver.put(frame[0].numpy())
    return found


def unwrapped(frame: NDArray[Any]) -> NDArray[Any]:
    return frame.view(np.uint32).astype(np.int64) if frame.dtype == np.int32 else frame


def test_a_u_net_makes_the_pixels_of_torch(pixels: Path) -> None:
    made = closed_loop(pixels, Checkpoint.open(pixels.with_name("model")), ROBOT)
    # later the roundings of an untrained model grow, on some processors sooner
    assert min(score for *_, score in made[:EXACT]) > 45
    assert len({own.tobytes() for own, *_ in made}) > FRAMES / 2


def test_a_u_net_makes_the_colours_of_torch(colors: Path) -> None:
    made = closed_loop(colors, Checkpoint.open(colors.with_name("model")), ROBOT, count=10, exact=0, led=True)
    equal = [float((own == expected).mean()) for own, expected, _ in made]
    assert min(equal) > 0.99, equal  # of an untrained model many scores are nearly equal, and may swap
    assert len({own.tobytes() for own, *_ in made}) > 5


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("name", [one for one in BUNDLED if one not in ("embedded-lab2", "embedded-lab3")])
def test_every_robot_of_each_bundled_network_makes_the_tokens_of_torch(name: str, tmp_path: Path) -> None:
    """embedded-lab2 and -lab3 have the graphs of embedded-lab."""
    manifest = export_checkpoint(name, [], tmp_path / "page", None)
    checkpoint = Checkpoint.open(name)
    assert {robot["id"] for robot in manifest["robots"]} == set(checkpoint.embodiments)
    assert manifest["weights"] == "float16" and manifest["step"]["bytes"] < 15e6
    made = []
    for number, robot in enumerate(checkpoint.embodiments):  # robots share the step; a stem is theirs
        # Two scores may be alike up to rounding, so frames that follow from one another may part.
        count = 2 if number else 30
        made += closed_loop(tmp_path / "page", checkpoint, robot, count=count, led=True)
        assert np.mean([own != theirs for own, theirs, _ in made[-count:]]) < 3e-3, robot
    assert np.mean([np.array_equal(own, theirs) for own, theirs, _ in made]) > 0.9
    assert np.mean([own != theirs for own, theirs, _ in made]) < 2e-4


def test_the_manifest_says_how_to_drive_and_its_digests_fit(tokens: Path) -> None:
    manifest = json.loads((tokens / "manifest.json").read_text())
    (robot,) = manifest["robots"]
    named = [(dim["name"], dim["unit"], keys) for dim, keys in zip(robot["dimensions"], robot["keys"])]
    assert named == [("slider_1", "px/s", ["w", "s"]), ("slider_2", "px/s", ["ArrowUp", "ArrowDown"])]
    assert all(dim["low"] < dim["high"] for dim in robot["dimensions"])
    assert robot["hz"] / robot["stride"] > 1
    assert robot["meter"] is None and "hma benchmark calibrates it" in robot["unmetered"]
    for part in (manifest["step"], *manifest["page"].values(), robot["stem"]):
        content = (tokens / part["file"]).read_bytes()
        assert (len(content), hashlib.sha256(content).hexdigest()) == (part["bytes"], part["sha256"])
    assert np.load(tokens / robot["frames"]).shape[:2] == (3, 4) and len(robot["held"]) == 3
    assert all((tokens / picture).is_file() for picture in robot["pictures"])
    _require_own(tokens)  # it may be exported again to the same folder


def test_a_page_whose_graphs_measure_no_uncertainty_has_no_meter() -> None:
    world: Any = SimpleNamespace(meter=lambda *_, **way: (METER, ""), model=latent_model(ROBOT))
    about = _meter(world, ROBOT, 2)
    assert about["meter"] is None and "hma play" in about["unmetered"]


def test_replays_hold_recorded_commands_and_the_page_begins_where_they_do(tokens: Path) -> None:
    (robot,) = json.loads((tokens / "manifest.json").read_text())["robots"]
    assert robot["replays"]["strips"] == []  # the page has the simulator
    checkpoint = Checkpoint.open(tokens.with_name("model"))
    lab = LabRobot(checkpoint.embodiment(ROBOT), checkpoint.stats(ROBOT), 128)
    recorded = np.load(tokens / robot["replays"]["chunks"])
    for number, (commands, table) in enumerate(zip(recorded, robot["simulator"]["tables"], strict=True)):
        scene = lab.scene(number)
        assert table == table_values(scene.simulator.simulation)
        assert all(np.array_equal(scene.advance(None)[0], command) for command in commands)


def test_shapes_are_fixed_and_no_operator_depends_on_data(tokens: Path, pixels: Path, colors: Path) -> None:
    for page in (tokens, pixels, colors):
        graph = onnx.load(page / "step.onnx").graph
        assert not {"Loop", "If", "Scan", "NonZero"} & {node.op_type for node in graph.node}
        shapes = [port.type.tensor_type.shape.dim for port in (*graph.input, *graph.output)]
        assert all(side.HasField("dim_value") for shape in shapes for side in shape)


def test_the_graphs_of_the_page_make_what_the_step_makes(tokens: Path, pixels: Path, colors: Path) -> None:
    for page in (tokens, pixels, colors):
        driver = Driver(page, ROBOT)
        parts = driver.about["page"]
        step, image, gpu_image = (
            onnxruntime.InferenceSession(page / parts[name]["file"])
            for name in ("step", "image", "gpu_image")
        )
        draws = driver.draws(np.random.default_rng(1))
        actions = np.zeros(next(one.shape for one in step.get_inputs() if one.name == "actions"), np.float32)
        inputs = {"actions": actions, **driver.state, **draws}
        shown, *whole = driver.step.run(None, inputs)
        for own, theirs in zip(step.run(None, inputs), whole, strict=True):
            assert np.array_equal(own, theirs)
        frame = {"next_frame": whole[1]}
        assert np.array_equal(*gpu_image.run(None, frame), shown)
        assert np.abs(image.run(None, frame)[0].astype(int) - shown).max() <= 1  # other products, same sums


def test_weights_are_stored_as_float16(tokens: Path) -> None:
    weights = onnx.load(tokens / "step.onnx").graph.initializer
    counts = dict.fromkeys((onnx.TensorProto.FLOAT, onnx.TensorProto.FLOAT16), 0)
    for one in weights:
        if one.data_type in counts:
            counts[one.data_type] += int(np.prod(one.dims))
    assert counts[onnx.TensorProto.FLOAT16] > 20 * counts[onnx.TensorProto.FLOAT]


def test_the_snippet_of_the_docs_drives_a_robot(tokens: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (Path(__file__).parents[3] / "docs" / "play.md").read_text()
    (snippet,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    monkeypatch.chdir(tokens.parent)
    found: dict[str, Any] = {}
    exec(snippet, found)
    assert found["image"].shape == tuple(found["about"]["image"]) and found["image"].dtype == np.uint8
    assert int(found["state"]["time"][0]) == 13


def test_a_wrong_runtime_is_refused_before_anything_is_computed(tokens: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="npm install onnxruntime-web@"):
        export_checkpoint(str(tokens.with_name("model")), [], tmp_path / "page", None, runtime=tmp_path)
    assert not (tmp_path / "page").exists()


def test_a_tokenizer_without_a_network_is_refused() -> None:
    with pytest.raises(CheckpointError, match="no network to export"):
        require_exportable(latent_model(ROBOT), BlockLatents())


def test_a_pushed_page_lies_beside_the_checkpoint_and_replaces_an_older_one(tokens, tmp_path, monkeypatch):
    def copy(checkpoint: str, data: list[Path], out: Path, *rest: Any) -> None:
        shutil.copytree(tokens, out)

    monkeypatch.setattr(import_module("hma_model.cli.export"), "export_checkpoint", copy)
    model, published = tokens.with_name("model"), tmp_path / "hub" / "model"
    assert hma("hub", "push", model, published, "--page").returncode == 0
    names = {path.relative_to(tokens) for path in tokens.rglob("*") if path.is_file()}
    assert {path.relative_to(published / "page") for path in (published / "page").rglob("*.*")} >= names
    assert "(page/index.html)" in (published / "README.md").read_text()
    (published / "page" / "old.js").write_text("old")
    assert hma("hub", "push", model, published, "--page").returncode == 0
    assert hma("hub", "push", model, published).returncode == 0  # without --page it stays
    assert (published / "page" / "index.html").is_file() and not (published / "page" / "old.js").exists()
    assert "(page/index.html)" in (published / "README.md").read_text()
