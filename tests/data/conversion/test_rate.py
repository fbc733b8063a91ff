"""Rates and strides: recordings of another rate are flagged, an edited stride reaches a finished set."""

import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml

from hma_data.cli.convert import _report
from hma_data.conversion.job import Conversion, convert
from hma_data.conversion.output import Share
from hma_data.conversion.plan import Settings
from hma_data.conversion.report import Summary
from hma_data.episodes.align import pause_remedy, rate_flags, to_clip
from hma_data.errors import OutputError
from hma_data.inspection.infer import infer
from hma_data.inspection.inspect import examine
from hma_data.loading.dataset import WindowDataset
from hma_data.registry.embodiment import Embodiment, find
from hma_data.shards.memmap import export
from hma_data.shards.reader import ShardSet
from hma_data.shards.schema import flag_pauses
from hma_data.shards.verify import verify
from hma_data.storage.locks import LOCK
from tests.command import hma
from tests.conftest import ARM_YAML, SMALL, BlockTokenizer, contents, write_toy
from tests.conftest import convert_toy as run
from tests.data import bag_files
from tests.data.episodes.test_align import STEADY, embodiment, episode
from tests.hostile import at_once

TIMED_YAML = ARM_YAML.replace("{format: hdf5}", "{format: hdf5, layout: {timestamps: t}}")


def timed(folder: Path, rates: list[float]) -> Path:
    path = folder / "toy.hdf5"
    write_toy(path, [30] * len(rates))
    with h5py.File(path, "a") as file:
        for i, hz in enumerate(rates):
            file[f"data/demo_{i}/t"] = 5 + np.arange(30) / hz
    return path


def made(path: Path, out: Path, settings: Settings = SMALL, yaml: str = TIMED_YAML):
    return convert(Embodiment.from_yaml(yaml), path, BlockTokenizer(), out, settings=settings)


def rate_findings(out: Path) -> list:
    return [one for one in examine(out) if one.check == "rate"]


@pytest.mark.parametrize(("hz", "flags"), [(10, {}), (9.3, {}), (10.9, {}), (5, {"off_rate_frames": 60})])
def test_only_a_rate_that_is_more_than_a_tenth_off_is_flagged(hz: float, flags: dict, tmp_path: Path) -> None:
    summary = made(timed(tmp_path, [hz, hz]), tmp_path / "out")
    assert summary.flags == flags and bool(summary.warning) == bool(flags)
    assert len(rate_findings(tmp_path / "out")) == len(flags)


def test_a_pause_is_told_and_is_not_another_rate(tmp_path: Path) -> None:
    path = timed(tmp_path, [10, 10])
    with h5py.File(path, "a") as file:
        file["data/demo_1/t"][20:] += 0.1  # one frame that is missing
        file["data/demo_0/t"][15:] += 20
    summary = made(path, tmp_path / "out")
    assert summary.flags == {"paused_frames": 1}
    assert rate_findings(tmp_path / "out") == []
    (finding,) = [one for one in examine(tmp_path / "out") if one.check == "gaps"]
    assert finding.severity == "info" and "1 of 2 episodes" in finding.message and "demo_0" in finding.message


def paused_bag(path: Path, pause_s: int, frames: int = 90) -> Path:
    """A bag at 10 Hz of which all topics pause in the middle, the camera for 0.1 s longer."""
    whole = bag_files.make_recording(frames)
    middle = bag_files.START_NS + frames // 2 * 100_000_000

    def late(times: np.ndarray) -> np.ndarray:
        return np.where(times >= middle, times + pause_s * 1_000_000_000, times)

    names = ("picture_ns", "joint_ns", "command_ns")
    moved = replace(whole, **{name: late(getattr(whole, name)) for name in names})
    moved.picture_ns[frames // 2 :] += 100_000_000
    return bag_files.write_mcap(path, moved, bag_files.as_cdr())


@pytest.mark.parametrize("frames", ["all", "strided"])
def test_no_window_crosses_a_pause(frames, tmp_path: Path) -> None:
    path, out = paused_bag(tmp_path / "run.mcap", 20), tmp_path / "out"
    robot = Embodiment.from_values(bag_files.arm().to_dict() | {"target_hz": 5}, "arm")
    settings = Settings(val_fraction=0, frames=frames)
    summary = convert(robot, path, BlockTokenizer(), out, settings=settings)
    (row,) = ShardSet(out).episodes.to_pylist()
    assert row["flags"] == "trimmed,paused_frames=1,pauses=44:202" and flag_pauses(row["flags"]) == {44: 202}
    step, rows, cut = (1, 89, 45) if frames == "all" else (2, 44, 23)
    windows = WindowDataset(out, "train", 5, short="pad")
    span = 5 * 2 // step
    first = windows.index.first_rows(np.arange(len(windows)))
    wanted = [*range(cut - span + 1), *range(cut, rows - span + 1)]
    assert first.tolist() == wanted
    assert windows.batch(range(len(windows))).frame.tolist() == wanted
    export(out, tmp_path / "flat", split="train")
    ids = np.fromfile(tmp_path / "flat/segment_ids.bin", "<i4")
    assert np.bincount(ids).tolist() == [cut, rows - cut]
    (note,) = summary.notes
    assert "training windows would cross one and are left out" in note
    assert verify(out) == [] and [one.severity for one in examine(out)] == ["warn", "warn", "info"]


def test_a_bag_with_pauses_is_told_how_to_be_divided_and_the_line_divides_it(tmp_path: Path) -> None:
    path = paused_bag(tmp_path / "run.mcap", 20)
    (found,) = [one for one in examine(path) if one.check == "gaps" and one.key == bag_files.CAMERA]
    line = "source.segments: {gap_s: 1} in the YAML makes the parts episodes of their own"
    assert found.remedy == f"no window crosses it; {line}"
    values = yaml.safe_load(infer(path, "arm"))
    assert values["frequency_hz"] == 10 and values["sync"]["max_skew_ms"] == 60
    assert values["provenance"]["segments"].endswith(line)
    robot = bag_files.arm().to_dict()
    robot["source"] = robot["source"] | {"segments": {"gap_s": 1}}
    made = convert(Embodiment.from_values(robot, "arm"), path, BlockTokenizer(), tmp_path / "out")
    assert made.flags == {} and ShardSet(tmp_path / "out").episodes["length"].to_pylist() == [45, 44]


def test_the_line_follows_the_step_of_the_model() -> None:
    for stride, gap_s in ((1, 0.083), (15, 0.48)):
        robot = Embodiment.from_values(find("mover_52").to_dict() | {"stride": stride}, "mover")
        assert f"{{gap_s: {gap_s}}}" in pause_remedy(robot, 30)
    assert pause_remedy(find("pusht_fast"), 30) == ""


STRIDE_5 = ARM_YAML.replace("frequency_hz: 10", "frequency_hz: 10\nstride: 5")


@pytest.mark.parametrize(
    ("lengths", "yaml", "said"),
    [
        (
            [14] * 2,
            ARM_YAML,
            "no window to train on: 12 frames need 24 rows, the longest episode has 14 — set target_hz: "
            "10 in its YAML and convert again with --overwrite, or train with windows of fewer frames "
            "(frames=7)",
        ),
        (
            [59] * 2 + [25] * 18,
            STRIDE_5,
            "the longest episode has 59 — set target_hz: 5 ",
        ),  # fits nine of ten
        ([8] * 2, ARM_YAML, "has 8 — train with windows of fewer frames (frames=4)"),
    ],
)
def test_a_set_without_a_window_is_told_with_what_gives_one(lengths, yaml, said, tmp_path: Path) -> None:
    write_toy(tmp_path / "toy.hdf5", lengths)
    (note,) = made(tmp_path / "toy.hdf5", tmp_path / "out", yaml=yaml).notes
    assert said in note


@pytest.mark.parametrize("frames", ["all", "strided"])
def test_the_warning_has_both_rates_and_what_to_do(frames, tmp_path: Path) -> None:
    settings = replace(SMALL, frames=frames)
    summary = made(timed(tmp_path, [10, 5, 5, 5]), tmp_path / "out", settings)
    said = "3 of 4 episodes have another rate than the stated 10 Hz, such as demo_1 with 5 Hz"
    remedy = "correct frequency_hz, and convert again with --overwrite"
    assert summary.warning == f"{tmp_path / 'out'}: {said} — {remedy}"
    (finding,) = rate_findings(tmp_path / "out")
    assert (finding.severity, finding.message, finding.remedy) == ("error", said, remedy)
    assert finding.numbers == {"episodes": 3, "hz": pytest.approx(5), "stated_hz": 10}
    assert verify(tmp_path / "out") == []


def test_a_few_such_episodes_are_a_warning_of_doctor(tmp_path: Path) -> None:
    made(timed(tmp_path, [10, 10, 10, 20]), tmp_path / "out")
    assert [one.severity for one in rate_findings(tmp_path / "out")] == ["warn"]


def test_hma_convert_prints_one_line_and_again_when_it_keeps_all_shards(tmp_path: Path) -> None:
    path, out = timed(tmp_path, [5, 5, 5]), tmp_path / "out"
    (tmp_path / "toy_arm.yaml").write_text(TIMED_YAML)
    args = ["convert", "-e", tmp_path / "toy_arm.yaml", "--source", path, "--out", out]
    args += ["--tokenizer", "raw-64", "--workers", "0"]
    done = hma(*args)
    lines = [line for line in done.stderr.splitlines() if line.startswith("warning: ")]
    assert done.returncode == 0 and len(lines) == 1, done.stderr
    assert "3 of 3 episodes have another rate than the stated 10 Hz, such as demo_0 with 5 Hz" in lines[0]
    told = json.loads(hma(*args, "--json").stdout)
    assert "such as demo_0 with 5 Hz" in told["warning"] and told["flags"] == {"off_rate_frames": 90}


def test_a_bag_is_measured_by_its_primary_camera(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    bag_files.write_mcap(tmp_path / "run" / "run.mcap", bag_files.make_recording(20), bag_files.as_cdr())
    values = bag_files.arm().to_dict()
    slow = Embodiment.from_values(values | {"frequency_hz": 20}, "slow")
    settings = Settings(val_fraction=0)
    summary = convert(slow, tmp_path / "run", BlockTokenizer(), tmp_path / "out", settings=settings)
    assert summary.warning.endswith("frequency_hz, or sync.rate_hz, and convert again with --overwrite")
    assert "10 Hz" in summary.warning and "stated 20 Hz" in summary.warning
    sync = values.get("sync", {}) | {"rate_hz": 20}
    resampled = Embodiment.from_values(values | {"frequency_hz": 20, "sync": sync}, "resampled")
    other = convert(resampled, tmp_path / "run", BlockTokenizer(), tmp_path / "other", settings=settings)
    assert other.flags == {} and other.warning == ""


def test_a_rate_that_nobody_states_is_not_compared() -> None:
    run = episode(STEADY, STEADY, STEADY, STEADY, STEADY)
    robot = embodiment()
    unstated = Embodiment.from_values(robot.to_dict() | {"frequency_hz": None, "stride": 2}, "unstated")
    assert rate_flags(to_clip(run, unstated), unstated) == {}


def robot(target_hz: float = 5, more: str = "") -> Embodiment:
    """The toy arm of 10 Hz with another rate for the model: stride 10 / target_hz."""
    return Embodiment.from_yaml(ARM_YAML.replace("target_hz: 5", f"target_hz: {target_hz}") + more)


def shards(folder: Path) -> dict[str, tuple[bytes, int]]:
    found = folder.glob("*/shard-*")
    return {str(path): (path.read_bytes(), path.stat().st_mtime_ns) for path in found}


def test_an_edited_target_hz_reaches_a_finished_set_and_its_shards_stay(toy_recording, tmp_path) -> None:
    out = tmp_path / "out"
    run(robot(1), toy_recording, out)
    before = shards(out)
    summary = run(robot(10), toy_recording, out)
    assert summary.changed == "new from the YAML: target_hz"
    assert (summary.made_shards, shards(out)) == (0, before)
    assert ShardSet(out).embodiment.stride == ShardSet(out).row_stride == 1
    run(robot(10), toy_recording, tmp_path / "anew")
    assert contents(out) == contents(tmp_path / "anew"), "as if it had been converted so"
    again = run(robot(10), toy_recording, out)
    assert again.changed == "" and contents(out) == contents(tmp_path / "anew")


def test_a_stated_stride_and_texts_are_told_too(toy_recording, tmp_path, capsys) -> None:
    out = tmp_path / "out"
    run(robot(), toy_recording, out)
    noted = run(robot(more="notes: wash the table first\n"), toy_recording, out)
    _report(noted, [], 0.01, False)
    assert "new from the YAML: notes" in capsys.readouterr().out.splitlines()
    other = run(robot(more="stride: 5\n"), toy_recording, out)
    assert other.changed == "new from the YAML: notes, stride"
    assert verify(out) == [] and ShardSet(out).embodiment.notes is None


def test_shards_are_not_hashed_again(toy_recording, tmp_path, monkeypatch) -> None:
    run(robot(), toy_recording, tmp_path / "out")

    def hashed(path: Path) -> str:
        assert "shard-" not in path.name
        return real(path)

    from hma_data.shards import manifest

    real = manifest.file_sha256
    monkeypatch.setattr(manifest, "file_sha256", hashed)
    assert run(robot(1), toy_recording, tmp_path / "out").changed


def test_rows_of_another_stride_are_refused_and_nothing_is_touched(toy_recording, tmp_path) -> None:
    out, settings = tmp_path / "out", replace(SMALL, frames="strided")
    run(robot(), toy_recording, out, settings)
    before = contents(out)
    said = r"recorded steps per row \(with --frames strided, the YAML's stride\) \(2 there, 10 now\) — "
    for options in ({}, {"extend": True}):
        with pytest.raises(OutputError, match=said):
            run(robot(1), toy_recording, out, settings, **options)
    with pytest.raises(OutputError, match=said):
        Conversion(robot(1), toy_recording, BlockTokenizer(), out, settings=settings).run_share(Share(0, 2))
    (out / LOCK).unlink()  # which shares leave; it locks nothing
    assert contents(out) == before
    kept = run(robot(1, "stride: 2\n"), toy_recording, out, settings)
    assert kept.changed == "new from the YAML: target_hz, stride" and verify(out) == []
    (out / "manifest.json").unlink()  # as of a job that was killed
    with pytest.raises(OutputError, match=said):
        run(robot(1), toy_recording, out, settings)


def test_other_settings_are_refused_before_the_stride_is_written(toy_recording, tmp_path) -> None:
    out = tmp_path / "out"
    run(robot(), toy_recording, out)
    before = contents(out)
    with pytest.raises(OutputError, match="--seed 0 there, 3 now"):
        run(robot(1), toy_recording, out, replace(SMALL, seed=3))
    assert contents(out) == before


def test_shares_that_find_a_finished_set_bring_the_stride_once(toy_recording, tmp_path) -> None:
    out, done = tmp_path / "out", list[Summary]()
    run(robot(1), toy_recording, out)
    before = shards(out)

    def work(index: int) -> None:
        source, share = str(toy_recording), Share(index, 3)
        with suppress(OutputError):  # one that begins while another writes the manifest
            job = Conversion(robot(5), source, BlockTokenizer(), out, settings=SMALL)
            if isinstance(summary := job.run_share(share), Summary):
                done.append(summary)

    at_once(work, range(3))
    assert [item.changed for item in done if item.changed] == ["new from the YAML: target_hz"]
    assert shards(out) == before and verify(out) == [] and ShardSet(out).embodiment.stride == 2


def test_a_share_of_a_finished_set_writes_nothing_where_nothing_has_changed(toy_recording, tmp_path) -> None:
    out, source = tmp_path / "out", str(toy_recording)
    run(robot(), toy_recording, out)
    before = (out / "manifest.json").stat().st_mtime_ns
    again = Conversion(robot(), source, BlockTokenizer(), out, settings=SMALL).run_share(Share(0, 2))
    assert isinstance(again, Summary) and (again.made_shards, again.changed) == (0, "")
    assert (out / "manifest.json").stat().st_mtime_ns == before


def test_an_extended_set_takes_the_stride_with_and_without_new_episodes(tmp_path) -> None:
    recording, out = tmp_path / "recorded", tmp_path / "out"
    recording.mkdir()
    write_toy(recording / "monday.hdf5", range(20, 26))
    run(robot(1), recording, out)
    write_toy(recording / "tuesday.hdf5", range(20, 26))
    extended = run(robot(5), recording, out, extend=True)
    assert extended.made_shards and extended.changed == "new from the YAML: target_hz"
    before = shards(out)
    assert run(robot(10), recording, out).changed == "new from the YAML: target_hz"
    assert shards(out) == before and verify(out) == []
