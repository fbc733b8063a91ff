"""A YAML edited after the conversion: the same command brings target_hz and stride into a finished set."""

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

from hma_data.conversion.job import Conversion
from hma_data.conversion.output import Share
from hma_data.conversion.report import Summary
from hma_data.errors import OutputError
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.storage.locks import LOCK
from tests.command import hma
from tests.conftest import ARM_YAML, SMALL, BlockTokenizer, contents, write_toy
from tests.conftest import convert_toy as run
from tests.hostile import at_once


def robot(target_hz: float = 5, more: str = "") -> Embodiment:
    """The toy arm of 10 Hz with another rate for the model: stride 10 / target_hz."""
    return Embodiment.from_yaml(ARM_YAML.replace("target_hz: 5", f"target_hz: {target_hz}") + more)


def shards(folder: Path) -> dict[str, tuple[bytes, int]]:
    """Bytes and time of change of each shard."""
    found = folder.glob("*/shard-*")
    return {str(path): (path.read_bytes(), path.stat().st_mtime_ns) for path in found}


def test_an_edited_target_hz_reaches_a_finished_set_and_its_shards_stay(toy_recording, tmp_path) -> None:
    out = tmp_path / "out"
    run(robot(1), toy_recording, out)
    before = shards(out)
    summary = run(robot(10), toy_recording, out)
    assert summary.changed == "stride 10 → 1: the model now sees 10 Hz"
    assert (summary.made_shards, shards(out)) == (0, before)
    assert ShardSet(out).embodiment.stride == ShardSet(out).row_stride == 1
    run(robot(10), toy_recording, tmp_path / "anew")
    assert contents(out) == contents(tmp_path / "anew"), "as if it had been converted so"
    again = run(robot(10), toy_recording, out)
    assert again.changed == "" and contents(out) == contents(tmp_path / "anew")


def test_a_stated_stride_and_texts_are_told_too(toy_recording, tmp_path) -> None:
    out = tmp_path / "out"
    run(robot(), toy_recording, out)
    noted = run(robot(more="notes: wash the table first\n"), toy_recording, out)
    assert noted.changed == "new from the YAML: notes"
    other = run(robot(more="stride: 5\n"), toy_recording, out)
    assert other.changed == "stride 2 → 5: the model now sees 2 Hz; also new from the YAML: notes"
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


@pytest.mark.slow
def test_hma_convert_prints_the_new_stride_in_one_line(toy_recording, tmp_path) -> None:
    args = ["convert", "-e", tmp_path / "toy_arm.yaml", "--source", toy_recording, "--out", tmp_path / "out"]
    args += ["--tokenizer", "fsq-8", "--workers", "0"]
    for target_hz, said in ((1, 0), (5, 1), (5, 0)):
        (tmp_path / "toy_arm.yaml").write_text(robot(target_hz).to_yaml())
        done = hma(*args)
        lines = done.stdout.splitlines()
        assert done.returncode == 0 and lines.count("stride 10 → 2: the model now sees 5 Hz") == said


def test_rows_of_another_stride_are_refused_and_nothing_is_touched(toy_recording, tmp_path) -> None:
    out, settings = tmp_path / "out", replace(SMALL, frames="strided")
    run(robot(), toy_recording, out, settings)
    before = contents(out)
    said = r"has rows of stride 2 \(--frames strided\), the YAML gives stride 10.*set stride: 2.*--overwrite"
    for options in ({}, {"extend": True}):
        with pytest.raises(OutputError, match=said):
            run(robot(1), toy_recording, out, settings, **options)
    with pytest.raises(OutputError, match=said):
        Conversion(robot(1), toy_recording, BlockTokenizer(), out, settings=settings).run_share(Share(0, 2))
    (out / LOCK).unlink()  # which shares leave; it locks nothing
    assert contents(out) == before
    kept = run(robot(1, "stride: 2\n"), toy_recording, out, settings)
    assert kept.changed == "new from the YAML: target_hz, stride" and verify(out) == []


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
    assert [item.changed for item in done if item.changed] == ["stride 10 → 2: the model now sees 5 Hz"]
    assert shards(out) == before and verify(out) == [] and ShardSet(out).embodiment.stride == 2


def test_a_share_of_a_finished_set_writes_nothing_where_nothing_has_changed(toy_recording, tmp_path) -> None:
    out, source = tmp_path / "out", str(toy_recording)
    run(robot(), toy_recording, out)
    before = (out / "manifest.json").stat().st_mtime_ns
    again = Conversion(robot(), source, BlockTokenizer(), out, settings=SMALL).run_share(Share(0, 2))
    assert isinstance(again, Summary) and (again.made_shards, again.changed) == (0, "")
    assert (out / "manifest.json").stat().st_mtime_ns == before


def first_day(folder: Path) -> Path:
    (folder / "recorded").mkdir()
    write_toy(folder / "recorded/monday.hdf5", range(20, 26))
    return folder / "recorded"


def test_an_extended_set_takes_the_stride_with_and_without_new_episodes(tmp_path) -> None:
    recording, out = first_day(tmp_path), tmp_path / "out"
    run(robot(1), recording, out)
    write_toy(recording / "tuesday.hdf5", range(20, 26))
    extended = run(robot(5), recording, out, extend=True)
    assert extended.made_shards and extended.changed.startswith("stride 10 → 2")
    before = shards(out)
    assert run(robot(10), recording, out).changed.startswith("stride 2 → 1")
    assert shards(out) == before and verify(out) == []
