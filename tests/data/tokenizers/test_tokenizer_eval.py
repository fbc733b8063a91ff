"""Measuring and listing tokenizers: which frames are taken, what is reported, what is missing."""

import json
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from hma_data.cli.tokenizer import tokenizer_app
from hma_data.conversion.job import convert
from hma_data.episodes.align import to_clip
from hma_data.episodes.images import prepare
from hma_data.episodes.sheets import write_png
from hma_data.errors import MissingDependencyError, SourceError, TokenizerError
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import open_source
from hma_data.tokenizers.base import get_tokenizer
from hma_data.tokenizers.catalog import CATALOG, EMBEDDED, Entry
from hma_data.tokenizers.training.eval import (
    BACKBONE,
    LatentMoments,
    evaluate,
    open_lpips,
    to_markdown,
    write_report,
)
from hma_data.tokenizers.training.frames import films_of, read_films
from tests.data.tokenizer_files import draw_scene

RUNNER = CliRunner()


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    rng = np.random.default_rng(3)
    for index in range(3):
        write_png(tmp_path / "pictures" / f"{index}.png", draw_scene(rng, 160))
    return tmp_path / "pictures"


@pytest.fixture
def arm(toy_yaml: Path) -> tuple[Embodiment, Path]:
    return Embodiment.load(toy_yaml), toy_yaml.with_name("toy.hdf5")


def test_a_recording_gives_every_camera_as_a_conversion_would(arm, block_tokenizer):
    robot, path = arm
    found = list(films_of(path, block_tokenizer.spec, embodiment=robot, frames=2))
    assert [len(film) for film in found] == [2] * len(found)
    source = open_source("hdf5")
    expected = []
    for name in source.episode_ids(str(path)):
        clip = to_clip(source.read(str(path), name, robot), robot)
        for camera in robot.cameras:
            raw = clip.frames_at(camera.name, np.array([0, len(clip) - 1]))
            expected.append(prepare(raw, camera, 64, "area"))
    assert np.array_equal(np.concatenate(found), np.concatenate(expected))


def test_a_shard_set_is_measured_on_what_it_was_made_of(arm, block_tokenizer, tmp_path):
    robot, path = arm
    convert(robot, str(path), block_tokenizer, tmp_path / "shards")
    spec = block_tokenizer.spec
    from_shards = list(films_of(tmp_path / "shards", spec, frames=3))
    assert np.array_equal(from_shards, list(films_of(path, spec, embodiment=robot, frames=3)))


def test_a_file_that_cannot_be_decoded_is_told_and_left_out(pictures):
    (pictures / "1.png").write_bytes(b"junk")
    (pictures / "film.mp4").write_bytes(b"junk")
    skipped: list[str] = []
    assert len(list(read_films(pictures, 64, on_skip=skipped.append))) == 2
    assert [text.split(": ")[0] for text in skipped] == [str(pictures / n) for n in ("1.png", "film.mp4")]


@pytest.mark.parametrize("name", ["a.png", "a.mp4", "a.gif"])
def test_a_file_that_cannot_be_decoded_is_refused_where_it_is_all_there_is(tmp_path, name):
    (tmp_path / name).write_bytes(b"junk")
    for path in (tmp_path, tmp_path / name):
        with pytest.raises(TokenizerError, match=name):
            list(read_films(path, 64))
    with pytest.raises(TokenizerError, match="gone: no such file or folder"):
        list(read_films(tmp_path / "gone", 64))


def test_an_episode_that_cannot_be_read_is_told_and_left_out(arm, block_tokenizer, monkeypatch):
    robot, path = arm
    source = open_source("hdf5")
    read = source.read

    def broken(uri, episode, embodiment):
        if episode == source.episode_ids(uri)[0]:
            raise SourceError(episode, "is broken")
        return read(uri, episode, embodiment)

    monkeypatch.setattr(source, "read", broken)
    monkeypatch.setattr("hma_data.sources.base.open_source", lambda name: source)
    told: list[str] = []
    frames = list(films_of(path, block_tokenizer.spec, embodiment=robot, frames=2, on_skip=told.append))
    read_well = len(source.episode_ids(str(path))) - 1
    assert sum(map(len, frames)) == 4 * read_well and "is broken" in told[0]


def test_moments_of_latents_are_those_of_all_batches_together():
    spec = get_tokenizer("raw").spec
    moments, rng = LatentMoments(spec), np.random.default_rng(0)
    parts = [rng.integers(0, 256, (count, 3, 4, 4)).astype(np.uint8) for count in (1, 5)]
    for part in parts:
        moments.add(part)
    whole = np.concatenate(parts) / 255
    assert moments.result() == {
        "latent_mean_scaled": pytest.approx(whole.mean(), abs=1e-4),
        "latent_std_scaled": pytest.approx(whole.std(), abs=1e-4),
    }


def test_what_moves_is_measured_by_itself(block_tokenizer):
    rng = np.random.default_rng(1)
    films = [np.full((count, 64, 64, 3), 90, np.uint8) for count in (40, 3)]  # one is of two batches
    for film in films:
        for at, frame in enumerate(film):
            frame[10:20, at : at + 9] = rng.integers(0, 256, (10, 9, 3))
    found = evaluate(block_tokenizer, [*films, films[0][0]])  # a lone picture does not move
    error, moved = 0.0, 0
    for film in films:
        made = block_tokenizer.decode(block_tokenizer.encode(film))
        for at in range(len(film)):
            beside = [film[other].astype(int) for other in (at - 1, at + 1) if 0 <= other < len(film)]
            mask = np.any([np.abs(film[at] - other).max(-1) > 24 for other in beside], axis=0)
            error += float(np.square(film[at][mask] - made[at][mask].astype(float)).sum())
            moved += int(mask.sum())
    assert found["psnr_moving_db"] == pytest.approx(-10 * np.log10(error / 3 / moved / 255**2), abs=1e-3)
    assert found["moving_share"] == pytest.approx(moved / (44 * 64 * 64), abs=1e-4)
    assert "| where it moves dB | moves |" in to_markdown({"x": found})
    assert "psnr_moving_db" not in evaluate(block_tokenizer, films[0][:1])


def test_without_its_package_lpips_is_named_with_the_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "lpips", None)
    with pytest.raises(MissingDependencyError, match="pip install lpips"):
        open_lpips(download=True)


class _Distance(torch.nn.Module):
    """Stands for LPIPS: the mean of what it is given, in its shapes."""

    def __init__(self, net: str, verbose: bool) -> None:
        super().__init__()

    def forward(self, first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
        assert first.shape[1] == 3 and first.min() == -1 and second.max() == 1
        return (second - first).mean(dim=(1, 2, 3), keepdim=True)


@pytest.fixture
def lpips(monkeypatch, tmp_path) -> Path:
    module = ModuleType("lpips")
    module.__spec__ = ModuleSpec("lpips", None)
    module.LPIPS = _Distance  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "lpips", module)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    return tmp_path / "checkpoints"


def test_lpips_is_not_downloaded_unasked(lpips):
    with pytest.raises(MissingDependencyError, match="--lpips downloads"):
        open_lpips(download=False)
    lpips.mkdir()
    (lpips / BACKBONE).touch()
    assert callable(open_lpips(download=False))


def test_lpips_is_given_pixels_from_minus_one_to_one(lpips):
    black, white = np.zeros((2, 8, 8, 3), np.uint8), np.full((2, 8, 8, 3), 255, np.uint8)
    assert open_lpips(download=True)(black, white).tolist() == [2.0, 2.0]


def test_lpips_is_reported_as_the_mean_over_frames(block_tokenizer):
    frames = np.zeros((3, 64, 64, 3), np.uint8)
    result = evaluate(block_tokenizer, frames, perceptual=lambda true, made: np.array([0.0, 0.5, 1.0]))
    assert result["lpips"] == 0.5
    assert "| 0.500 |" in to_markdown({"x": result})


def test_a_report_holds_table_numbers_and_the_worst_frames(tmp_path, block_tokenizer):
    frames = np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3)).astype(np.uint8)
    result = evaluate(block_tokenizer, frames, worst=2)
    paths = write_report(tmp_path, "block", {"noise": result}, ["a note"])
    assert sorted(path.name for path in paths) == ["eval.json", "eval.md", "worst.png"]
    text = (tmp_path / "eval.md").read_text()
    assert text.startswith("# block") and "| noise | 3 |" in text and "a note" in text
    assert json.loads((tmp_path / "eval.json").read_text())["noise"]["frames"] == 3


def test_eval_prints_json_and_writes_a_report(pictures, tmp_path):
    done = RUNNER.invoke(
        tokenizer_app,
        ["eval", "fsq-8", str(pictures), "--json", "--no-lpips", "--out", str(tmp_path / "out")],
    )
    assert done.exit_code == 0, done.output
    printed = json.loads(done.stdout)
    assert printed == json.loads((tmp_path / "out" / "eval.json").read_text())
    assert printed[str(pictures)]["frames"] == 3


def test_eval_measures_a_recording_by_its_robot(arm, tmp_path):
    robot = str(arm[1].with_name("toy_arm.yaml"))
    done = RUNNER.invoke(
        tokenizer_app, ["eval", "fsq-8", str(arm[1]), "-e", robot, "--frames", "1", "--json", "--no-lpips"]
    )
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)[str(arm[1])]["frames"] == 6


def test_every_tokenizer_of_the_catalogue_has_a_licence_and_a_description():
    for name, entry in CATALOG.items():
        assert entry.name == name and entry.licence and entry.description


@pytest.mark.parametrize("name", [name for name, entry in CATALOG.items() if entry.weights == "embedded"])
def test_the_catalogue_says_what_the_embedded_tokenizers_are(name):
    entry, spec = CATALOG[name], get_tokenizer(name).spec
    assert (entry.kind, entry.image_size, entry.grid) == (spec.kind, spec.image_size, spec.grid)
    assert entry.size() == (EMBEDDED / entry.file).stat().st_size
    assert entry.state() == "ready"


def test_embedded_weights_take_at_most_fifteen_megabytes():
    assert sum(path.stat().st_size for path in EMBEDDED.iterdir()) <= 15_000_000


def _entry(weights, **values) -> Entry:
    return Entry("x", "discrete", 8, (1, 1), "a test", weights, "json", **values)


def test_the_state_says_what_is_in_the_way(monkeypatch):
    assert _entry("none").state() == "ready"
    assert _entry("path").state() == "needs --weights PATH"
    lacking = _entry("none", imports=("torch", "no_such_module"), extra="pip install no-such")
    assert lacking.state() == "needs no_such_module: pip install no-such"
    assert lacking.to_json()["usable"] is False
    entry = _entry("download", repo="a/b", file="w.safetensors", bytes=5)
    monkeypatch.setattr("huggingface_hub.try_to_load_from_cache", lambda *args, **kwargs: None)
    assert entry.state() == "downloads on first use" and entry.size() == 5
    monkeypatch.setattr("huggingface_hub.try_to_load_from_cache", lambda *args, **kwargs: "/cache/w")
    assert entry.state() == "ready"


def test_the_list_names_every_tokenizer_with_its_state():
    done = RUNNER.invoke(tokenizer_app, ["list", "--json"])
    listed = {item["name"]: item for item in json.loads(done.stdout)}
    assert set(listed) == set(CATALOG)
    assert listed["fsq-16"]["usable"] and listed["fsq-16"]["bytes"] > 1_000_000
    assert all({"state", "licence", "bytes", "grid"} <= set(item) for item in listed.values())
