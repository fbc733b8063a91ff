"""A bag whose commands and joints pause: masked on the whole road, by topic, checked when damaged."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.conversion.rewrite import merge, split
from hma_data.errors import SourceError
from hma_data.inspection.inspect import inspect_recording
from hma_data.loading.dataset import MixtureDataset, WindowDataset
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.memmap import export
from hma_data.shards.reader import ShardSet
from hma_data.shards.schema import flag_counts, flag_pauses, flag_totals, flags_text, mask_columns
from hma_data.shards.verify import check_shard, verify
from hma_data.storage.files import file_sha256
from tests.conftest import BlockTokenizer
from tests.data.bag_files import COMMAND, STATE, Recording, arm, as_json, make_recording, write_mcap

FRAMES = 40


def paused() -> Recording:
    """40 pictures at 10 Hz; no command from 1.0 to 1.6 s, no joints from 2.0 to 2.5 s."""
    whole = make_recording(FRAMES)
    began = whole.picture_ns[0]
    command = (whole.command_ns - began < 1_000_000_000) | (whole.command_ns - began >= 1_600_000_000)
    joint = (whole.joint_ns - began < 2_000_000_000) | (whole.joint_ns - began >= 2_500_000_000)
    return replace(
        whole,
        command_ns=whole.command_ns[command],
        commands=whole.commands[command],
        joint_ns=whole.joint_ns[joint],
        joints=whole.joints[joint],
    )


def robot(beyond: str) -> Embodiment:
    return arm(**{"max_skew_ms: 60": f"max_skew_ms: 60, beyond: {beyond}"})


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mcap(tmp_path_factory.mktemp("bag") / "run.mcap", paused(), as_json())


@pytest.fixture(scope="module")
def shards(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("set") / "out"
    convert(robot("mask"), str(bag), BlockTokenizer(), out)
    return out


def lacking(times_ns: np.ndarray) -> list[int]:
    """Pictures whose last sample is older than 60 ms: commands and joint commands are held."""
    pictures = make_recording(FRAMES).picture_ns
    ages = [t - times_ns[times_ns <= t].max() for t in pictures]
    return [i for i, age in enumerate(ages) if age > 60_000_000]


def test_an_episode_is_refused_or_its_old_commands_are_masked(bag, shards, tmp_path, block_tokenizer) -> None:
    with pytest.raises(SourceError, match="ms off at 1"):
        convert(robot("refuse"), str(bag), block_tokenizer, tmp_path / "out")
    rows = ShardSet(shards).episode_rows(0, ["action", "state", "action_known", "state_known"])
    recording = paused()
    gone = sorted({*lacking(recording.command_ns), *lacking(recording.joint_ns)})
    assert np.flatnonzero(~rows["action_known"]).tolist() == gone and len(gone) == 9
    assert not rows["action"][gone].any() and rows["action"][9].all()
    states = np.flatnonzero(~rows["state_known"])
    assert states.tolist() == [21, 22, 23, 24] and not rows["state"][states].any()
    assert verify(shards) == []


def test_masks_go_along_into_sets_made_of_the_set_and_into_flat_files(shards: Path, tmp_path: Path) -> None:
    merge([shards], tmp_path / "one")
    split(tmp_path / "one", tmp_path / "two", seed=1)
    columns = ShardSet(shards).columns()
    wanted = ShardSet(shards).episode_rows(0, columns)
    for name in ("one", "two"):
        assert verify(tmp_path / name) == []
        for column, values in ShardSet(tmp_path / name).episode_rows(0, columns).items():
            np.testing.assert_array_equal(values, wanted[column])
    (flat,) = export(tmp_path / "two", tmp_path / "flat")
    for mask in ("action_known", "state_known"):
        np.testing.assert_array_equal(np.fromfile(flat / f"hma/{mask}.bin", bool), wanted[mask])


def test_skew_is_told_by_topic(bag: Path, shards: Path) -> None:
    skew = json.loads(ShardSet(shards).episodes["skew"][0].as_py())
    assert list(skew) == ["front", f"{COMMAND}.data", f"{STATE}.position", f"{STATE}.position[0:2]"]
    assert skew[f"{COMMAND}.data"][2] == pytest.approx(540, abs=1)  # the last before 1.0 s is at 0.96 s
    yaml = bag.parent / "arm.yaml"
    yaml.write_text(robot("mask").to_yaml())
    facts = inspect_recording(str(bag), str(yaml))["embodiment"]
    assert {f"skew of {name}" for name in skew} <= set(facts)


def test_a_mixture_marks_the_same_chunks_as_its_windows(shards: Path) -> None:
    windows = WindowDataset(shards, "train", 3, stride=5)
    rows = ShardSet(shards).episode_rows(0, ["action_known"])["action_known"]
    batch = windows.batch(range(len(windows)))
    for first, mask in zip(batch.frame.tolist(), batch.action_mask.numpy()):
        np.testing.assert_array_equal(mask, rows[first : first + 15].reshape(3, 5).all(axis=1))
    stride = ShardSet(shards).row_stride
    mixed = next(iter(MixtureDataset([shards], 8, 3, seed=1)))
    for first, mask in zip(mixed.frame.tolist(), mixed.action_mask.numpy()):
        known = rows[first : first + 3 * stride].reshape(3, stride).all(axis=1)
        np.testing.assert_array_equal(mask, known)


def test_a_bag_of_which_no_command_is_known_is_refused(tmp_path: Path, block_tokenizer) -> None:
    whole = make_recording(10)
    late = replace(
        whole,
        command_ns=whole.command_ns[[0, -1]] - np.array([90_000_000, 130_000_000]),
        commands=whole.commands[[0, -1]],
    )
    path = write_mcap(tmp_path / "run.mcap", late, as_json())
    with pytest.raises(SourceError, match=r"none of its \d+ actions is known"):
        convert(robot("mask"), str(path), block_tokenizer, tmp_path / "out")


def test_only_embodiments_that_can_mask_have_the_columns() -> None:
    assert mask_columns(robot("refuse")) == ()
    assert mask_columns(robot("mask")) == ("action_known", "state_known")
    bare = Embodiment.from_values(robot("mask").to_dict() | {"state": None}, "bare")
    assert mask_columns(bare) == ("action_known",)


def test_flags_are_read_back_as_they_were_written() -> None:
    assert (
        flags_text(3, {"masked_actions": 12, "held_frames": 4}) == "trimmed,held_frames=4,masked_actions=12"
    )
    assert flag_counts("trimmed,held_frames=4,masked_actions=12") == {"held_frames": 4, "masked_actions": 12}
    both = flags_text(0, {"paused_frames": 2}, {7: 3, 40: 12})
    assert both == "paused_frames=2,pauses=7:3;40:12" and flag_pauses(both) == {7: 3, 40: 12}
    assert flag_counts(both) == {"paused_frames": 2} and flag_pauses("trimmed,pauses=x") == {}
    assert flag_counts("") == flag_counts("trimmed") == flag_counts("odd=,=,x=y,z=-1") == {}


def test_statistics_without_a_known_state_are_zeros(tmp_path: Path, block_tokenizer) -> None:
    whole = make_recording(10)
    far = replace(whole, joint_ns=whole.joint_ns[[0, -1]], joints=whole.joints[[0, -1]])
    values = robot("mask").to_dict()
    values["sync"] |= {"max_skew_ms": 15}
    del values["action"]["components"][1]
    values["target_hz"] = 10
    path = write_mcap(
        tmp_path / "run.mcap", replace(far, joint_ns=far.joint_ns - np.array([20_000_000, 0])), as_json()
    )
    values["sync"]["actions"] = "nearest"
    own = Embodiment.from_values(values, "far states")
    done = convert(own, str(path), block_tokenizer, tmp_path / "out", settings=Settings(val_fraction=0))
    said = done.manifest.stats["state"]
    assert said["count"] == 0 and not np.any([*said["mean"], *said["std"], *said["min"], *said["max"]])
    assert all(not any(values) for values in said["quantiles"].values())
    assert verify(tmp_path / "out") == []


@pytest.mark.parametrize(
    ("row", "known", "value", "fault"),
    [
        (12, False, 9.0, "action is not 0 where action_known is false"),
        (2, False, 0.0, "action statistics in its footer are not those of its rows"),
        (12, True, 0.0, "action statistics in its footer are not those of its rows"),
    ],
)
def test_marks_that_are_not_those_of_the_values_are_found(shards, tmp_path, row, known, value, fault) -> None:
    manifest = ShardSet(shards).manifest
    (shard,) = manifest.shards
    table = pq.read_table(shards / shard.path)
    for name, changed in (("action", [value] * 4), ("action_known", known)):
        values, field = table[name].to_pylist(), table.schema.field(name)
        values[row] = changed
        table = table.set_column(table.schema.get_field_index(name), field, pa.array(values, field.type))
    path = tmp_path / shard.path
    path.parent.mkdir()
    footer = pq.read_metadata(shards / shard.path).metadata
    pq.write_table(table.replace_schema_metadata(footer), path)
    listed = replace(shard, bytes=path.stat().st_size, sha256=file_sha256(path))
    (problem,), _ = check_shard(tmp_path, listed, manifest, quick=False)
    assert fault in problem


def test_totals_count_frames_and_add_up_no_measures():
    flags = pa.chunked_array([["masked_actions=2,millinats=9", "millilatents=11", "masked_actions=3", None]])
    assert flag_totals(flags) == {"masked_actions": 5}
