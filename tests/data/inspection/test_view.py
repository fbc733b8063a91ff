"""What `hma view` writes is what was recorded: read back by Rerun's own reader."""

from collections import defaultdict
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest

from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.errors import MissingDependencyError
from hma_data.inspection.view import _table, view_recording, view_shards
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import ShardSet
from tests.command import fails, hma
from tests.conftest import ARM_YAML, BlockTokenizer


def reader(path: Path) -> Any:
    from rerun.chunk import RrdReader

    return RrdReader(path)


def read(path: Path) -> dict[str, dict[str, list[Any]]]:
    found: dict[str, dict[str, list[Any]]] = defaultdict(lambda: defaultdict(list))
    for chunk in reader(path).stream().to_chunks():
        for name, values in chunk.to_record_batch().to_pydict().items():
            if not name.startswith("rerun.controls"):
                found[chunk.entity_path][name] += values
    return found


def seconds(entity: dict[str, list[Any]]) -> np.ndarray:
    return np.array([value.total_seconds() for value in entity["time"]])


def pictures(entity: dict[str, list[Any]]) -> np.ndarray:
    blobs = [np.array(blob, np.uint8).ravel() for blob in entity["EncodedImage:blob"]]
    return np.stack([cv2.imdecode(blob, cv2.IMREAD_COLOR)[..., ::-1] for blob in blobs])


def test_a_recording_is_shown_frame_by_frame(toy_yaml: Path, tmp_path: Path) -> None:
    view_recording(tmp_path / "toy.hdf5", toy_yaml, 1).save(tmp_path / "seen.rrd")
    found = read(tmp_path / "seen.rrd")
    with h5py.File(tmp_path / "toy.hdf5") as file:
        actions, image = file["data/demo_1/actions"][:], file["data/demo_1/obs/image"][:]
    assert {name for name in found if name != "/__properties"} == {
        "/about", "/actions", "/cameras/top", "/cameras/side",
        *(name for name in found if name.startswith("/skew_ms/")),
    }  # fmt: skip
    for name in ("/actions", "/cameras/top"):
        assert found[name]["frame"] == list(range(15))
        np.testing.assert_allclose(seconds(found[name]), np.arange(15) / 10, atol=1e-9)
    np.testing.assert_allclose(found["/actions"]["Scalars:scalars"], actions)
    assert found["/actions"]["SeriesLines:names"] == [["a", "b", "c"]]
    assert np.abs(pictures(found["/cameras/top"]).astype(int) - image).max() < 8
    assert "demo_1" in found["/about"]["TextDocument:text"][0][0]
    assert list(reader(tmp_path / "seen.rrd").blueprints())


def test_a_shard_set_is_shown_by_its_decoded_tokens(toy_yaml: Path, tmp_path: Path, monkeypatch) -> None:
    settings = Settings(val_fraction=0.3, cameras=("top", "side"))
    robot, tokenizer = Embodiment.from_yaml(ARM_YAML), BlockTokenizer()
    convert(robot, str(tmp_path / "toy.hdf5"), tokenizer, tmp_path / "set", settings=settings)
    monkeypatch.setattr("hma_data.inspection.view.tokenizer_of", lambda shards: tokenizer)
    view_shards(tmp_path / "set", 2).save(tmp_path / "seen.rrd")
    found, shards = read(tmp_path / "seen.rrd"), ShardSet(tmp_path / "set")
    row = shards.episodes.slice(2, 1).to_pylist()[0]
    columns = [*shards.columns()]
    values = shards.episode_rows(row["episode_index"], columns)
    assert len(found["/actions"]["frame"]) == row["length"]
    np.testing.assert_allclose(found["/actions"]["Scalars:scalars"], values["action"])
    np.testing.assert_allclose(seconds(found["/actions"]), values["timestamp"], atol=1e-6)
    for camera, column in shards.manifest.layout.token_columns.items():
        decoded = tokenizer.decode(shards.tokens(values[column]))
        shown = pictures(found[f"/decoded/{camera}"]).astype(int)
        assert shown.shape == decoded.shape and np.abs(shown - decoded).max() < 8


def test_unknown_actions_are_a_gap(toy_yaml: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from hma_data.inspection import view as module

    whole = module.to_clip

    def masked(*arguments: Any) -> Any:
        clip = whole(*arguments)
        object.__setattr__(clip, "action_known", np.arange(len(clip)) > 3)
        return clip

    monkeypatch.setattr(module, "to_clip", masked)
    view_recording(tmp_path / "toy.hdf5", toy_yaml).save(tmp_path / "seen.rrd")
    values = np.array(read(tmp_path / "seen.rrd")["/actions"]["Scalars:scalars"])
    assert np.isnan(values[:4]).all() and np.isfinite(values[4:]).all()


def test_what_cannot_be_shown_says_what_to_do(toy_yaml, tmp_path, monkeypatch) -> None:
    assert _table({"instruction": "a | b"}).splitlines()[-1] == r"| instruction | a \| b |"
    recording = tmp_path / "toy.hdf5"
    fails(hma("view", recording), 2, "add -e ROBOT")
    fails(hma("view", recording, "-e", toy_yaml, "--episode", 3), 2, "3 episodes")
    fails(hma("view", recording, "-e", toy_yaml, "--out", "seen.mp4"), 2, ".rrd")
    monkeypatch.setitem(__import__("sys").modules, "rerun", None)
    fails(hma("view", recording, "-e", toy_yaml), 1, "uv sync --inexact --extra view")
    with pytest.raises(MissingDependencyError):
        view_recording(recording, toy_yaml)
