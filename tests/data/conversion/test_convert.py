"""Conversion: what lands in shards is what was recorded, whole or not at all, the same every time."""

import json
import os
import re
import shutil
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hma_data.cli.convert import _report
from hma_data.conversion.plan import Settings
from hma_data.conversion.worker import Batches
from hma_data.errors import OutputError, RegistryError
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.manifest import Manifest
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from tests.command import fails, hma
from tests.conftest import BlockTokenizer, contents, write_toy
from tests.conftest import convert_toy as run
from tests.hostile import flip


def test_rows_are_the_recording(toy_set, toy_file, block_tokenizer) -> None:
    shards = ShardSet(toy_set)
    assert verify(toy_set) == []
    assert sum(split["episodes"] for split in shards.manifest.splits.values()) == 12
    with h5py.File(toy_file) as file:
        for row in shards.episodes.to_pylist():
            values = shards.episode_rows(row["episode_index"])
            recorded = file[f"data/{row['id']}"]
            decoded = block_tokenizer.decode(shards.tokens(values["tokens"]))
            np.testing.assert_array_equal(values["action"], recorded["actions"][()])
            np.testing.assert_array_equal(decoded, recorded["obs/image"][()])
            np.testing.assert_allclose(values["timestamp"], np.arange(row["length"]) / 10)


def test_shards_open_with_plain_pyarrow(toy_set) -> None:
    table = pq.read_table(toy_set / "train")
    assert table.column_names == ["episode_index", "frame_index", "timestamp", "tokens", "action"]
    metadata = pq.read_metadata(toy_set / "train" / "shard-00000.parquet").metadata
    assert metadata[b"hma.embodiment"] == b"toy_arm"
    assert metadata[b"hma.tokenizer"] == b"block"


def test_control_characters_in_a_path_are_escaped(toy_arm, toy_recording, tmp_path, capsys) -> None:
    out = tmp_path / "two\nlines \x1b[1m"
    run(toy_arm, toy_recording, out)
    _report(run(toy_arm, toy_recording, out), [], 0.01, False)
    (first, *_) = capsys.readouterr().out.splitlines()
    assert r"two\nlines \x1b[1m: 12 episodes" in first and "existed already" in first
    fails(hma("inspect", out / "none"), 1, r"two\nlines \x1b[1m/none: ")


def test_the_shards_of_one_file_or_another_path_are_the_same(toy_arm, toy_recording, tmp_path) -> None:
    run(toy_arm, toy_recording, tmp_path / "a")
    (tmp_path / "else where").mkdir()
    moved = tmp_path / "else where" / toy_recording.name
    shutil.copy(toy_recording, moved)
    run(toy_arm, moved, tmp_path / "b")
    first, second = contents(tmp_path / "a"), contents(tmp_path / "b")
    assert {k: v for k, v in first.items() if "shard-" in k} == {
        k: v for k, v in second.items() if "shard-" in k
    }


def test_a_repeated_conversion_says_what_it_did_not_check(toy_arm, toy_recording, tmp_path, capsys) -> None:
    out = tmp_path / "out"
    run(toy_arm, toy_recording, out)
    flip(20)(out / "train" / "shard-00000.parquet")
    _report(run(toy_arm, toy_recording, out), [], 0.01, False)
    said = f"only the footers were checked; this checks every byte: hma shards verify {out}\n"
    assert said in capsys.readouterr().out
    assert "sha256 differs" in verify(out)[0]


def test_a_bad_episode_goes_to_quarantine_and_the_rest_goes_on(toy_arm, toy_recording, tmp_path) -> None:
    with h5py.File(toy_recording, "a") as file:
        file["data/demo_3/actions"][4, 1] = np.nan
    summary = run(toy_arm, toy_recording, tmp_path / "out")
    line = json.loads((tmp_path / "out" / "quarantine.jsonl").read_text())
    (reason,) = summary.reasons
    assert reason == line["message"]
    assert line["id"] == "demo_3"
    assert "not finite at frame 4" in line["message"]
    assert summary.too_many
    assert summary.manifest.quarantined == 1
    assert verify(tmp_path / "out") == []
    assert not run(toy_arm, toy_recording, tmp_path / "out", max_quarantine=0.1).too_many


def test_another_embodiment_or_tokenizer_is_refused_untouched(toy_arm, toy_recording, tmp_path) -> None:
    run(toy_arm, toy_recording, tmp_path / "out")
    before = contents(tmp_path / "out")
    other = toy_arm.model_copy(update={"id": "other_arm"})
    with pytest.raises(OutputError, match="toy_arm there, other_arm now"):
        run(other, toy_recording, tmp_path / "out")
    from dataclasses import replace

    class Other(BlockTokenizer):
        spec = replace(BlockTokenizer.spec, name="blob")

    with pytest.raises(OutputError, match="tokenizer"):
        run(toy_arm, toy_recording, tmp_path / "out", tokenizer=Other())
    assert contents(tmp_path / "out") == before


@pytest.mark.parametrize(("limit", "empty"), [(2, True), (3, False), (1, False)])
def test_a_limit_that_leaves_val_empty_is_told(limit, empty, toy_arm, tmp_path) -> None:
    path = tmp_path / "split.hdf5"
    write_toy(path, [20, 20, 20])
    with h5py.File(path, "a") as file:  # robomimic's masks are a split of the recording's own
        file["mask/train"] = np.array(["demo_0", "demo_1"], "S")
        file["mask/valid"] = np.array(["demo_2"], "S")
    summary = run(toy_arm, path, tmp_path / "out", Settings(limit=limit))
    assert any("val is empty" in note and "--limit" in note for note in summary.notes) == empty


def test_it_is_said_how_many_episodes_are_held_out_and_why(toy_arm, tmp_path) -> None:
    path = tmp_path / "eight.hdf5"
    write_toy(path, [20] * 8)
    few = "fewer than 5 are too few to judge a model: record more episodes"
    for fraction, wanted in (
        (None, f"2 of 8 episodes held out for validation, 5%, at least 5 but at most a quarter; .*; {few}"),
        (0.2, r"\d of 8 episodes held out for validation, by --val-fraction 0.2"),
        (0.0, "0 of 8 episodes held out for validation, by --val-fraction 0$"),
    ):
        out = tmp_path / f"out-{fraction}"
        summary = run(toy_arm, path, out, Settings(val_fraction=fraction))
        assert re.match(wanted, summary.held_out), summary.held_out
    with h5py.File(path, "a") as file:
        file["mask/train"] = np.array([f"demo_{i}" for i in range(5)], "S")
        file["mask/valid"] = np.array([f"demo_{i}" for i in range(5, 8)], "S")
    summary = run(toy_arm, path, tmp_path / "masks", Settings(val_fraction=0.5))
    assert summary.held_out.startswith(
        "3 of 8 episodes held out for validation, by the recording's own split, which takes precedence over"
    )


def test_overwrite_starts_anew(toy_arm, toy_recording, tmp_path) -> None:
    run(toy_arm, toy_recording, tmp_path / "out")
    run(toy_arm, toy_recording, tmp_path / "out", Settings(limit=4), overwrite=True)
    assert Manifest.load(tmp_path / "out").plan["settings"]["limit"] == 4


def test_progress_reaches_its_total_in_encoded_frames(toy_arm, toy_file, tmp_path) -> None:
    seen = []
    settings = Settings(frames="strided", cameras=("top", "side"))

    def note(state) -> None:
        seen.append((state.frames, state.total_frames))

    run(toy_arm, toy_file, tmp_path / "out", settings, on_progress=note)
    rows = sum(length // 2 for length in range(20, 32)) * 2
    assert seen[0] == (0, rows)
    assert seen[-1] == (rows, rows)


def test_an_unknown_rate_is_refused_with_how_to_give_it(toy_arm, toy_recording, tmp_path) -> None:
    unknown = Embodiment.from_yaml(toy_arm.to_yaml().replace("frequency_hz: 10.0", "frequency_hz: unknown"))
    with pytest.raises(RegistryError, match="set frequency_hz"):
        run(unknown, toy_recording, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_an_unwritable_folder_is_one_clear_error(toy_arm, toy_recording, tmp_path) -> None:
    (tmp_path / "shut").mkdir(mode=0o500)
    with pytest.raises(OutputError, match="cannot be written"):
        run(toy_arm, toy_recording, tmp_path / "shut" / "out")


def frames(episode: int, start: int, count: int) -> NDArray[np.uint8]:
    values = np.zeros((count, 2, 2, 3), np.uint8)
    values[..., 0] = episode
    values[..., 1] = np.arange(start, start + count)[:, None, None]
    return values


@given(
    st.lists(st.lists(st.integers(1, 9), min_size=1, max_size=4), min_size=1, max_size=8),
    st.integers(1, 7),
    st.sets(st.integers(0, 7)),
)
def test_batches_are_full_and_tokens_come_back_to_their_frames(pieces, size, dropped) -> None:
    seen: list[int] = []

    def encode(batch: NDArray[np.uint8]) -> NDArray[Any]:
        seen.append(len(batch))
        return batch[:, 0, 0, :2].astype(np.uint32)

    batches = Batches(encode, size)
    episodes = [SimpleNamespace(waiting=0, tokens={"front": []}) for _ in pieces]
    added = encoded = 0
    for number, (episode, counts) in enumerate(zip(episodes, pieces)):
        at = 0
        for count in counts:
            encoded += batches.add(episode, "front", frames(number, at, count))
            at += count
        added += at
        if number in dropped:
            batches.drop(episode)
    assert all(count == size for count in seen)
    encoded += batches.flush()
    assert all(count == size for count in seen[:-1])
    for number, (episode, counts) in enumerate(zip(episodes, pieces)):
        if number in dropped:
            continue
        assert not episode.waiting
        tokens = np.concatenate(episode.tokens["front"])
        np.testing.assert_array_equal(tokens[:, 0], number)
        np.testing.assert_array_equal(tokens[:, 1], np.arange(sum(counts)))
    if not dropped:
        assert encoded == added
