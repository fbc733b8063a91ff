"""`hma bench`: its settings and the form of what it prints. No figure is asserted."""

import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hma_data.episodes.align import to_clip
from hma_data.errors import UsageError
from hma_data.loading.dataset import MixtureDataset
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.sources.base import open_source
from recipes.bench import harness as bench
from recipes.bench import loader, peers, scale, sources
from recipes.bench.sources import CASES, actions, scene
from tests.data.loading.test_pools import SMALL

TOY = bench.Bench(
    "a toy",
    {"frames": 4, "share": 0.5, "name": "x", "kinds": ["a"], "workers": 0},
    lambda settings: [settings],
    choices={"kinds": ("a", "b", "c")},
)


def test_settings_keep_the_type_of_their_default() -> None:
    settings = bench.settings_of(TOY, "toy", ["frames=7", "share=1", "name=two", "kinds=[b, c]", "workers=0"])
    assert settings == {"frames": 7, "share": 1.0, "name": "two", "kinds": ["b", "c"], "workers": 0}
    assert type(settings["share"]) is float


@pytest.mark.parametrize(
    "word",
    ["frames", "speed=3", "frames=many", "frames=0", "share=-1", "kinds=a", "kinds=[a, d]", "frames=[", "=3"],
)
def test_a_word_that_is_no_setting_is_refused(word: str) -> None:
    with pytest.raises(UsageError, match="bench toy"):
        bench.settings_of(TOY, "toy", [word])


def test_a_bench_that_is_not_there_names_those_that_are() -> None:
    with pytest.raises(UsageError, match="known: "):
        bench.load("nothing")


def test_the_report_has_the_promised_form() -> None:
    said = json.loads(json.dumps(bench.report("toy", TOY.defaults, TOY.run({"frames": 1}))))
    assert list(said) == ["bench", "machine", "settings", "results"]
    assert said["machine"]["cores"] >= 1 and said["results"] == [{"frames": 1}]


@pytest.mark.parametrize("name", ["rlds-png-256", "hdf5-gzip-256", "mcap-jpeg-640x480"])
def test_a_generated_recording_shows_what_was_drawn(name: str, tmp_path: Path) -> None:
    case = CASES[name]
    robot, uri = case.embodiment(), str(case.write(tmp_path, 2, 12, 5))
    source = open_source(robot.source.format)
    names = source.episode_ids(uri)
    clip = to_clip(source.read(uri, names[1], robot), robot)
    drawn = np.stack(list(scene(*case.size, 12, 6)))
    assert len(names) == 2 and len(clip) == 12
    error = np.abs(clip.frames_at("main", np.arange(12)).astype(int) - drawn).mean()
    assert error < 6
    np.testing.assert_allclose(clip.actions, actions(12, 1), atol=1e-6)


def test_every_generated_recording_has_an_embodiment() -> None:
    assert [case.embodiment().source.format for case in CASES.values()] == [c.format for c in CASES.values()]


@pytest.mark.slow
def test_sources_are_measured_with_units() -> None:
    settings = sources.BENCH.defaults | {"formats": ["rlds-jpeg-256"], "frames": 8, "episodes": 2}
    results = sources.run(settings)
    assert {one["processes"] for one in results} <= {1, 2} and results[0]["frames"] == 8
    units = ("frames_per_second", "frames_per_cpu_second", "peak_rss_mib", "recorded_bytes_per_frame")
    assert all(one[unit] > 0 for one in results for unit in units)


def test_a_conversion_is_measured_beside_its_tokenizer() -> None:
    small = {"episodes": 4, "frames": 4, "pixels": 32, "workers": 0, "tokenizer": "raw"}
    (found,) = bench.load("convert").run(bench.load("convert").defaults | small)
    assert (found["episodes"], found["workers"]) == (4, 0)
    assert found["frames_per_second"] > 0 and found["tokenizer_cpu_seconds"] >= 0


@pytest.mark.parametrize("workers", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_a_tokenizer_that_waits_limits_the_frames_a_second(workers: int) -> None:
    small = {"episodes": 4, "frames": 4, "pixels": 32, "workers": workers, "wait_ms": 1.0, "shard_frames": 8}
    before = dict(os.environ), list(sys.path)
    (found,) = bench.load("convert").run(bench.load("convert").defaults | small)
    assert (dict(os.environ), list(sys.path)) == before
    assert (found["tokenizer"], found["episodes"]) == ("waiting", 4)
    assert found["frames_per_second_limit"] == 1_000 * max(workers, 1) and found["overhead_cpu_share"] is None
    with pytest.raises(UsageError, match="wait_ms: stands for a tokenizer"):
        bench.load("convert").run(bench.load("convert").defaults | small | {"tokenizer": "raw"})


def test_a_format_that_is_not_there_is_refused() -> None:
    with pytest.raises(UsageError, match="known: rlds-jpeg-256"):
        sources.run(sources.BENCH.defaults | {"formats": ["vhs"]})


@pytest.mark.slow
def test_our_reader_is_measured_beside_lerobots() -> None:
    results = sources.run_lerobot({"episodes": 2, "frames": 8, "height": 48, "width": 64, "seed": 0})
    assert [(one["reader"], one["order"], one["frames"]) for one in results] == [
        ("hma", "in order", 8), ("hma", "random", 2), ("lerobot", "in order", 8), ("lerobot", "random", 2),
    ]  # fmt: skip
    assert all(one["frames_per_cpu_second"] > 0 and one["start_cpu_s"] > 0 for one in results)


@pytest.mark.slow
def test_every_case_reports_speed_opening_and_memory() -> None:
    settings = SMALL | {"embodiments": 2, "windows": 64, "runs": 1}
    results = loader.run(settings)
    assert [one["case"] for one in results] == ["mixture", "random"]
    figures = (
        "windows_per_second",
        "windows_per_cpu_second",
        "open_seconds",
        "first_batch_seconds",
        "peak_rss_mib",
    )
    assert all(one[figure] > 0 for one in results for figure in figures)
    assert results[0]["frames"] == 12_000


def test_a_generated_set_of_one_shard_is_sound(tmp_path: Path) -> None:
    folder = loader.make_set(tmp_path / "set", 0, SMALL | {"frames": 1_500})
    assert verify(folder) == []
    assert ShardSet(folder).manifest.splits["train"] == {
        "episodes": 25,
        "frames": 1_500,
        "rows": 1_500,
        "shards": 1,
    }


@pytest.mark.parametrize(("frames", "shards"), [(6_000, 4), (6_060, 5)])
def test_a_generated_set_has_as_many_frames_as_asked(tmp_path: Path, frames: int, shards: int) -> None:
    splits = ShardSet(loader.make_set(tmp_path / "set", 0, SMALL | {"frames": frames})).manifest.splits
    assert splits["train"]["shards"] == shards
    assert splits["train"]["frames"] >= frames


def test_a_peer_must_give_our_windows_and_a_missing_one_is_named(tmp_path, monkeypatch) -> None:
    settings = SMALL | {"frames": 1_500, "peer_windows": 8}
    folder = loader.make_set(tmp_path / "set", 0, settings)

    def missing(store: Path, rows: Any) -> Any:
        raise ImportError("no", name="lance")

    (tmp_path / "set-whole").mkdir()
    right = {"whole": lambda store, rows: lambda numbers: (rows[0][numbers], rows[1][numbers])}
    wrong = {"shifted": lambda store, rows: lambda numbers: (rows[0][numbers - 1], rows[1][numbers])}
    monkeypatch.setattr(peers, "PEERS", {**right, **wrong, "lance": missing})
    assert peers.run_peer("whole", folder, settings)["windows_per_second"] > 0
    assert (
        peers.run_peer("lance", folder, settings)["left_out"] == "lance is not installed: pip install pylance"
    )
    with pytest.raises(RuntimeError, match="shifted gives other windows"):
        peers.run_peer("shifted", folder, settings)


FEW = {"episodes": 120, "embodiments": 2, "folder": ""}


@pytest.mark.slow
def test_every_step_reports_its_time_and_memory() -> None:
    results = scale.run(FEW)
    assert [one["step"] for one in results] == ["plan", "write", "read", "resume", "mixture"]
    assert all(one["episodes"] == 120 and one["peak_rss_mib"] > 0 for one in results)


def test_the_sets_hold_what_was_planned(tmp_path: Path) -> None:
    scale._make(str(tmp_path), FEW)
    for step in scale.STEPS.values():
        step(tmp_path, FEW)
    planned = {robot.id: plan for robot, _, plan in scale._planned(FEW)}
    assert sum(plan.episodes for plan in planned.values()) == 120
    for name, plan in planned.items():
        shards = ShardSet(tmp_path / name)
        assert shards.manifest.plan == plan.facts
        assert sum(split["frames"] for split in shards.manifest.splits.values()) == plan.frames
        assert len(shards.episodes) == plan.episodes
    windows = MixtureDataset([tmp_path / name for name in planned], 32).mixture.counts
    assert len(windows) == 2 and all(count > 0 for count in windows)


def test_a_set_that_lacks_a_shard_is_not_whole(tmp_path: Path) -> None:
    one = FEW | {"episodes": 40, "embodiments": 1}
    scale._make(str(tmp_path), one)
    scale._write(tmp_path, one)
    next(tmp_path.glob("robot_0/train/*.parquet")).unlink()
    with pytest.raises(RuntimeError, match="not whole"):
        scale._resume(tmp_path, one)
