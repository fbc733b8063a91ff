"""Public Push-T sets, WorldArena's layout and Zarr: from the published files to figures."""

import argparse
import base64
import hashlib
import json
import shutil
import sys
import zipfile
import zlib
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import av
import h5py
import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from hma_data.errors import HMAError, SourceError, StorageAwayError, UsageError
from hma_data.registry.embodiment import find
from hma_data.tokenizers.base import get_tokenizer
from hma_model.config import HMAConfig
from hma_model.network.model import HMA
from hma_model.worlds.world import World
from recipes.public import dino_wm, gpc, iws, sets
from recipes.public.rollouts import Recording
from recipes.public.sets import BASELINE, checked_file, gaussian_ssim
from recipes.public.worldarena import export
from recipes.public.zarr2 import ZarrArray, unblosc
from tests.hostile import Touch
from tests.model.public import look_alikes
from tests.model.public.look_alikes import write_zarr
from tests.model.true_world import _of_robot

TINY = [
    "model.levels=[8]", "model.width=16", "model.layers=1", "model.heads=2", "frames=3",
    "batch_size=1", "steps=1", "checkpoint_every=0", "report=false", "pictures=0", "warmup=0",
    "self_forward=0",
]  # fmt: skip
SETS = {"gpc": (gpc, 8), "dino_wm": (dino_wm, 4), "iws": (iws, 8)}  # frames of a window of the look-alike


@pytest.mark.parametrize("name", SETS)
def test_one_command_leads_from_the_published_files_to_figures(name, tmp_path, monkeypatch, capsys) -> None:
    module, frames = SETS[name]
    source = getattr(look_alikes, name)(tmp_path / "published")
    protocol = replace(module.PROTOCOL, frames=frames, size=64)
    monkeypatch.setattr(module, "PROTOCOL", protocol)
    monkeypatch.setattr(gpc, "TRAINED", 4)
    words = [str(tmp_path / "out"), "--from", str(source), "--tokenizer", "raw-64", "--workers", "0"]
    monkeypatch.setattr(sys, "argv", ["recipe", *words, "--windows", "2", "--device", "cpu", *TINY])
    sets.run(replace(module.SET, protocol=protocol))
    rows = json.loads((tmp_path / "out" / "figures.json").read_text())
    ours, still, *others = rows
    assert (ours["model"], still["model"]) == ("ours", BASELINE)
    assert 0 < ours["ssim"] <= 1 and 5 < ours["psnr_db"] < 60
    expected = {"gpc": ["ours", BASELINE], "dino_wm": ["NanoWM-B/2, 100k steps"], "iws": []}
    assert [row["model"] for row in others] == expected[name]
    shown = capsys.readouterr().out
    assert f"{ours['psnr_db']:.2f}" in shown


def test_episodes_beyond_those_that_driftworld_trains_on_are_held_out(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(gpc, "TRAINED", 4)
    source = look_alikes.gpc(tmp_path / "published")
    recording, _ = gpc.prepare(source, tmp_path / "out")
    with h5py.File(recording / "000_domain18.hdf5") as file:
        assert [name.decode() for name in file["mask/valid"]] == ["demo_4", "demo_5"]
        assert file["data/demo_2/img"].shape == (22, 96, 96, 3) and file["data/demo_2/img"].dtype == np.uint8
        images, actions, states = look_alikes.push(2, 22, 96)
        assert np.array_equal(file["data/demo_2/img"], images)
        assert np.array_equal(file["data/demo_2/action"], actions)
        assert np.array_equal(file["data/demo_2/state"], states)


def test_folders_of_gpc_come_in_driftworlds_order_and_none_hides_another(tmp_path) -> None:
    published = tmp_path / "published"
    for count, name in enumerate(("a/domain2", "a/domain10", "b/domain2"), 1):
        (zarr,) = look_alikes.gpc(tmp_path / str(count), episodes=count, frames=4).rglob("*.zarr")
        (published / name).parent.mkdir(parents=True, exist_ok=True)
        zarr.rename(published / f"{name}.zarr")
        recording, _ = gpc.prepare(published, tmp_path / "out")  # as the download grows
    found = [name.partition("_")[2] for name in Recording(recording, find("gpc_pusht")).ids]
    order = {"domain10": (0, 1), "domain2": (0, 0, 1, 2)}
    assert found == [f"{name}/demo_{demo}" for name, demos in order.items() for demo in demos]


def test_windows_of_gpc_are_the_first_in_order() -> None:
    chosen = gpc.choose([70, 10, 1100], 1)
    assert chosen[:8] == [(0, 0), (0, 1), (0, 2), (0, 3), (0, 4), (0, 5), (0, 6), (2, 0)]
    assert len(chosen) == 1000


def test_windows_of_dino_wm_are_drawn_as_the_published_ones() -> None:
    lengths = [30, 25, 19, 40, 22]
    order = np.arange(5)
    np.random.RandomState(42).shuffle(order)
    every = [(int(one), start) for one in order for start in range(max(lengths[one] - 19, 0))]
    drawn = np.random.RandomState(42).choice(len(every), size=len(every), replace=False)
    assert dino_wm.choose(lengths, 5) == [every[number] for number in drawn]


def test_windows_of_iws_begin_every_fourth_episode() -> None:
    assert iws.choose([300] * 8 + [150] + [300] * 4, 1) == [(0, 0), (4, 0), (12, 0)]


def test_rows_of_dino_wm_are_as_many_as_frames_of_the_video(tmp_path) -> None:
    train, _ = dino_wm.prepare(look_alikes.dino_wm(tmp_path, episodes=2), tmp_path / "out")
    _, targets, states = look_alikes.push(1, 25, 224)
    with h5py.File(train / "episode_001.hdf5") as file:
        assert np.allclose(file["state"], states) and file["velocity"].shape == (25, 2)
        assert np.allclose(file["action"], targets - states[:, :2], atol=1e-4)


def test_a_window_has_the_actions_between_its_frames(tmp_path) -> None:
    _, val = dino_wm.prepare(look_alikes.dino_wm(tmp_path, episodes=1), tmp_path / "out")
    world = SimpleNamespace(tokenizer=get_tokenizer("raw-64"))
    window = sets.Recording(val, sets.find("dino_wm_pusht")).window(
        world, 0, 2, frames=4, context=1, size=224
    )
    images, targets, states = look_alikes.push(100, 24, 224)
    assert np.allclose(window.chunks, (targets - states[:, :2])[2:17].reshape(3, 10), atol=1e-4)
    assert np.abs(window.true.astype(int) - images[2:18:5]).mean() < 2  # but for the codec
    assert window.given.shape == (1, 64, 64, 3)


def test_no_code_of_a_published_file_runs(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save(Touch("trapped"), "states.pth")
    with pytest.raises(SourceError, match=r"states\.pth: is no tensor"):
        dino_wm.tensor(Path("states.pth"))
    assert not Path("trapped").exists()
    for values in (torch.zeros(()), torch.zeros(3), {"values": 1}):
        torch.save(values, "states.pth")
        with pytest.raises(SourceError, match=r"states\.pth: is no tensor"):
            dino_wm.tensor(Path("states.pth"))


@pytest.mark.parametrize("name", ["episode_x", "episode_-1", "episode_9"])
def test_a_video_without_its_number_is_named(name: str, tmp_path) -> None:
    source = look_alikes.dino_wm(tmp_path, episodes=1)
    video = next(source.rglob("episode_000.mp4"))
    video.rename(video.with_stem(name))
    with pytest.raises(SourceError, match=f"{name}.mp4: has 24 frames, number"):
        dino_wm.prepare(source, tmp_path / "out")


def test_an_unpacking_that_was_killed_is_done_again(tmp_path, monkeypatch) -> None:
    with zipfile.ZipFile(tmp_path / "pusht_noise.zip", "w") as zipped:
        for name in ("train/a", "val/a", "val/b"):
            zipped.writestr(f"pusht_noise/{name}", "content")

    def stop(*given: object) -> None:
        (tmp_path / "pusht_noise" / "val").mkdir(parents=True)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(zipfile.ZipFile, "extractall", stop)
        dino_wm.download(tmp_path, argparse.Namespace())
    dino_wm.download(tmp_path, argparse.Namespace())
    assert (tmp_path / "pusht_noise" / "val" / "b").read_text() == "content"
    (tmp_path / "pusht_noise.zip").unlink()
    dino_wm.download(tmp_path, argparse.Namespace())  # is unpacked


@pytest.mark.parametrize("name", SETS)
def test_missing_and_damaged_parts_are_named(name: str, tmp_path) -> None:
    module: ModuleType = SETS[name][0]
    with pytest.raises(SourceError, match="holds n"):
        module.prepare(tmp_path, tmp_path / "out")
    source = getattr(look_alikes, name)(tmp_path / "published")
    if name == "gpc":
        shutil.rmtree(next(source.rglob("episode_ends")))
    elif name == "dino_wm":
        next(source.rglob("episode_003.mp4")).unlink()
    else:
        shutil.rmtree(source / "val")
    with pytest.raises(SourceError, match="episode_ends: is no array|has 5 videos|val: holds no"):
        module.prepare(source, tmp_path / "out")


def test_images_that_are_no_bytes_are_refused(tmp_path) -> None:
    with pytest.raises(SourceError, match="images of 0 to 1"):
        gpc.as_pixels(np.linspace(0, 1, 12), tmp_path)


def test_windows_longer_than_the_episodes_are_refused(tmp_path, monkeypatch) -> None:
    source = look_alikes.iws(tmp_path / "published")
    given = argparse.Namespace(windows=None)
    recording = sets.Recording(source / "val", sets.find("iws_pusht"))
    with pytest.raises(HMAError, match="no episode has the 200 frames"):
        sets.score(iws.PROTOCOL, None, recording, given, sets.Networks(), "val")


@pytest.mark.parametrize("span", [255.0, 510.0])
def test_the_gaussian_ssim_is_that_of_scikit_image(span: float) -> None:
    rng = np.random.default_rng(0)
    true = rng.integers(0, 256, (2, 40, 32, 3), dtype=np.uint8)
    made = np.clip(true + rng.normal(0, 30, true.shape), 0, 255).astype(np.uint8)
    facts = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "channel_axis": 2}
    expected = [structural_similarity(a, b, data_range=span, **facts) for a, b in zip(true, made)]
    assert np.allclose(gaussian_ssim(true, made, span), expected, atol=1e-6)


def test_iws_counts_six_decibels_more() -> None:
    found = iws.finish({"mse": 0.01, "ssim": 0.9, "ssim_usual": 0.8})
    assert found["psnr_usual_db"] == pytest.approx(20) and found["psnr_db"] == pytest.approx(26.0206)


def test_a_download_with_another_content_is_refused(tmp_path) -> None:
    served = tmp_path / "served.zip"
    served.write_bytes(b"bytes")
    with pytest.raises(SourceError, match=r"SHA-256 .*, not 00"):
        checked_file(served.as_uri(), "00", tmp_path / "got.zip")
    assert not (tmp_path / "got.zip").exists()
    checked_file(served.as_uri(), hashlib.sha256(b"bytes").hexdigest(), tmp_path / "got.zip")
    assert (tmp_path / "got.zip").read_bytes() == b"bytes"
    with pytest.raises(StorageAwayError, match=r"cannot be downloaded.*--from"):
        checked_file((tmp_path / "gone").as_uri(), "00", tmp_path / "got.zip")


@pytest.fixture(scope="module")
def world() -> World:
    tokenizer = get_tokenizer("fsq-8")
    config = HMAConfig(
        layers=1,
        width=32,
        heads=2,
        frames=3,
        grid=(8, 8),
        factored=(8,) * 6,
        tokenizer=tokenizer.spec.to_json(),
    )
    return World(_of_robot(HMA(config), find("iws_pusht"), False), tokenizer)


def asked(recording: Path, out: Path, **changes: object) -> argparse.Namespace:
    facts = {"recording": recording, "embodiment": "iws_pusht", "task": "push_t", "out": out, "name": "ours"}
    facts |= {"episodes": None, "frames": 4, "context": 2, "size": 64}
    return argparse.Namespace(**facts | changes)


def frames_of(path: Path) -> np.ndarray:
    with av.open(str(path)) as film:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)])


def test_each_episode_has_its_videos_where_worldarena_looks_for_them(world: World, tmp_path: Path) -> None:
    recording = look_alikes.iws(tmp_path / "published", episodes=4, frames=6) / "val"
    assert export(world, asked(recording, tmp_path / "out")) == 4
    rows = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert len(rows) == 4
    for row in rows:
        parts = Path(row["gt_path"]).parts
        task, episode = parts[-5], parts[-1].split(".")[0]  # as preprocess_datasets_diversity.py finds them
        assert task == "push_t" and Path(row["image"]).is_file() and row["prompt"][0]
        true = frames_of(Path(row["gt_path"]))
        assert true.shape == (4, 64, 64, 3)
        films = [f"{folder}_sort/{task}_{episode}.mp4" for folder in ("ours", "ours_1", "ours_2", "gt")]
        made, one, two, flat = (frames_of(tmp_path / "out" / film) for film in films)
        assert made.shape == one.shape == two.shape == true.shape and np.array_equal(flat, true)
        assert np.abs(made[:2].astype(int) - one[:2]).mean() < 2  # the given frames, but for the codec


def test_the_variants_have_the_actions_of_other_episodes(world: World, tmp_path: Path, monkeypatch) -> None:
    recording = look_alikes.iws(tmp_path / "published", episodes=3, frames=6) / "val"
    steps = []
    step = world.step
    monkeypatch.setattr(world, "step", lambda chunks: steps.append(chunks) or step(chunks))
    export(world, asked(recording, tmp_path / "out"))
    own, first, second = (np.stack(list(steps[2 * number].values())) for number in range(3))
    assert np.array_equal(first, own[[1, 2, 0]]) and np.array_equal(second, own[[2, 0, 1]])


def test_tasks_share_a_folder(world: World, tmp_path: Path) -> None:
    recording = look_alikes.iws(tmp_path / "published", episodes=3, frames=6) / "val"
    for task in ("push_t", "other"):
        export(world, asked(recording, tmp_path / "out", task=task, frames=2, context=1))
    assert len(json.loads((tmp_path / "out" / "summary.json").read_text())) == 6


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"task": "a/b"}, "--task.*no name of a folder"),
        ({"name": ".."}, "--name.*no name of a folder"),
        ({"frames": 7}, "has 0 of the chosen episodes with 7 frames; 3 are needed"),
        ({"episodes": [0, 1, 99, -1]}, "has 2 of the chosen"),
        ({"context": 0}, "--context: is 0, of 4 --frames"),
        ({"context": 4}, "--context: is 4, of 4 --frames"),
    ],
)
def test_what_cannot_be_written_is_refused(changes, said: str, world: World, tmp_path: Path) -> None:
    recording = look_alikes.iws(tmp_path / "published", episodes=3, frames=6) / "val"
    with pytest.raises(UsageError, match=said):
        export(world, asked(recording, tmp_path / "out", **changes))


def test_a_damaged_summary_is_named(world: World, tmp_path: Path) -> None:
    recording = look_alikes.iws(tmp_path / "published", episodes=3, frames=6) / "val"
    (tmp_path / "summary.json").write_text("[1]")
    with pytest.raises(UsageError, match="is no list of episodes"):
        export(world, asked(recording, tmp_path))


# (300, 2) float32, compressed by numcodecs 0.15; LZ4 in blocks of 1,024 bytes, which are split in streams
FRAMES = {
    "lz4": "AgEhBGAJAABgCQAAewAAABQAAAANAAAAHwABAP//QVAAAAAAAA0AAAAfAAEA//9BUAAAAAAAIwAAAB8AAQBkH4ACAG"
    "QP7wBkLwBAAgAVH4ACADsPAQBgUICAgICAGgAAAB8AAQBkHz8CAD0PAQAUH0ACAP9QUD9AP0A/",
    "zstd": "AgGRBGAJAABgCQAARAAAABQAAAAsAAAAKLUv/WBgCBUBAEAAgECAAD9APwqgoPgBYPdj1FS2aDq9pgu65fUpLU3S71c=",
    "zlib": "AgFgBGAJAABgCQAAgAAAABQAAAASAAAAeNpjYBgFwxs02A8EDQC0owsyGAAAAHjaY2BosGcAg2FB2w9emsFhJNEAVx"
    "k1YhoAAAB42mNgYHBgYGCwZxgxtMMQoBuGPA0AQ5089hgAAAB42mNgcHBgYGiwZ6A73TBKD2MaAHKKbHY=",
}
CLAIMS = (
    b"\x28\xb5\x2f\xfd\xe0" + (1 << 40).to_bytes(8, "little") + b"\1\0\0"
)  # Zstandard that claims 2^40 bytes
REFUSED = {  # the same values; only the header counts
    "bit shuffle": "AgEkBGAJAABgCQAAngAAAA==",
    "blosclz": "AgEBBGAJAABgCQAAiQAAAA==",
}


@pytest.mark.parametrize("codec", FRAMES)
def test_frames_of_the_usual_writer_are_read(codec: str) -> None:
    row = np.arange(300)
    expected = np.stack([row // 60, 0.5 * (row // 100)], axis=1).astype("<f4")
    found = unblosc(base64.b64decode(FRAMES[codec]), expected.nbytes, Path("0.0"))
    assert np.array_equal(np.frombuffer(found, "<f4").reshape(300, 2), expected)


@pytest.mark.parametrize("codec", REFUSED)
def test_a_codec_that_is_not_read_is_named(codec: str) -> None:
    frame = base64.b64decode(REFUSED[codec]).ljust(158, b"\0")
    with pytest.raises(SourceError, match=f"Blosc with {codec}.*convert it with the zarr package"):
        unblosc(frame, 2400, Path("0.0"))


@pytest.mark.parametrize("compressor", [None, "zlib", "blosc"])
def test_rows_are_put_together_from_chunks(compressor: str | None, tmp_path: Path) -> None:
    values = np.arange(7 * 5, dtype=np.int32).reshape(7, 5)
    write_zarr(tmp_path / "a", values, (3, 2), compressor)
    array = ZarrArray(tmp_path / "a")
    assert array.shape == (7, 5) and array.dtype == np.int32
    assert np.array_equal(array.rows(0, 7), values)
    assert np.array_equal(array.rows(2, 4), values[2:4])
    (tmp_path / "a" / "1.0").unlink()  # a chunk that was never written holds the fill value
    found = ZarrArray(tmp_path / "a").rows(3, 6)
    assert (found[:, :2] == 0).all() and np.array_equal(found[:, 2:], values[3:6, 2:])


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"filters": [{"id": "delta"}]}, "has filters"),
        ({"order": "F"}, "order F"),
        ({"dtype": "|O"}, "type object"),
        ({"chunks": [1 << 20, 1 << 20]}, "has chunks"),
        ({"compressor": {"id": "lzma"}}, "compressed by lzma"),
        ({"shape": None}, "no array of Zarr's format 2"),
        ({"shape": []}, "no array of Zarr's format 2"),
        ({"shape": [-4, 2]}, "no array of Zarr's format 2"),
        ({"chunks": ["4", 2]}, "no array of Zarr's format 2"),
        ({"compressor": "zlib"}, "no array of Zarr's format 2"),
        ({"fill_value": "words"}, "no array of Zarr's format 2"),
        ({"dimension_separator": "/../"}, "no array of Zarr's format 2"),
        ({"shape": [1 << 40, 2]}, "has rows 0 to 1099511627776"),
        ({"shape": [4, 1 << 40]}, "more than 1,073,741,824 bytes"),
    ],
)
def test_other_forms_are_refused(changes: dict[str, Any], said: str, tmp_path: Path) -> None:
    write_zarr(tmp_path / "a", np.zeros((4, 2), np.float32), (4, 2))
    facts = json.loads((tmp_path / "a" / ".zarray").read_text()) | changes
    (tmp_path / "a" / ".zarray").write_text(json.dumps(facts))
    with pytest.raises(SourceError, match=said):
        array = ZarrArray(tmp_path / "a")
        array.rows(0, len(array))


@pytest.mark.parametrize(
    "content", [b"", b"\2\1\x21\4", zlib.compress(b"short"), b"x" * 40, CLAIMS, bytes(1 << 17)]
)
@pytest.mark.parametrize("compressor", ["zlib", "blosc", "zstd", None])
def test_a_damaged_chunk_is_named(content: bytes, compressor: str | None, tmp_path: Path) -> None:
    write_zarr(tmp_path / "a", np.ones((4, 2), np.float32), (4, 2), compressor)
    (tmp_path / "a" / "0.0").write_bytes(content)
    with pytest.raises(SourceError, match=r"0\.0: is damaged"):
        ZarrArray(tmp_path / "a").rows(0, 4)


@pytest.mark.parametrize("frame", ["lz4", "zstd", "zlib"])
def test_damaged_frames_are_refused_whatever_is_damaged(frame: str, tmp_path: Path) -> None:
    whole = base64.b64decode(FRAMES[frame])
    write_zarr(tmp_path / "a", np.ones((300, 2), np.float32), (300, 2), "blosc")
    rng = np.random.default_rng(0)
    for place in (*range(40), *rng.integers(40, len(whole), 20)):
        for value in (0, 255, whole[place] ^ 1):
            damaged = bytearray(whole)
            damaged[place] = value
            (tmp_path / "a" / "0.0").write_bytes(damaged)
            with suppress(SourceError):
                ZarrArray(tmp_path / "a").rows(0, 300)
