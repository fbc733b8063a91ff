"""`hma shards …`: exit codes, one line an error, JSON."""

import json
import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner, Result

from hma_data.cli.shards import shards_app
from hma_data.conversion.plan import Settings
from hma_data.errors import HMAError
from tests.conftest import toy_shards


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    settings = Settings(val_fraction=0.3, shard_frames=40)
    return toy_shards(tmp_path_factory.mktemp("made") / "set", [14, 15, 16, 17, 60], settings)


def run(*words: object, code: int = 0) -> Result:
    done = CliRunner().invoke(shards_app, [str(word) for word in words])
    assert done.exit_code == code, (done.output, done.exception)
    return done


def test_info_in_figures(made: Path) -> None:
    facts = json.loads(run("info", made, "--json").stdout)
    assert facts["totals"]["episodes"] == 5
    assert facts["totals"]["frames"] == 14 + 15 + 16 + 17 + 60
    assert facts["episodes"]["longest"] == 60
    assert facts["embodiment"]["stride"] == 2
    windows = sum(split["windows"] for split in facts["windows"].values())
    assert windows == 60 - 24 + 1
    assert {"plan", "source", "tokenizer", "splits", "stats"} < facts.keys()
    said = run("info", made).stdout
    for word in ("toy_arm", "122 frames", "q99", "windows"):
        assert word in said


def test_info_counts_episodes_with_an_instruction_and_different_ones_apart(made, tmp_path) -> None:
    path = Path(shutil.copytree(made, tmp_path / "set")) / "episodes.parquet"
    table = pq.read_table(path)
    place = table.column_names.index("instruction")
    words = pa.array(["push", "push", "", "lift", ""])
    pq.write_table(table.set_column(place, table.schema.field(place), words), path)
    episodes = json.loads(run("info", tmp_path / "set", "--json").stdout)["episodes"]
    assert (episodes["with_instruction"], episodes["instructions"]) == (3, 2)
    assert "3 with an instruction (2 different)" in run("info", tmp_path / "set").stdout


def test_verify_ends_with_1_when_it_finds_something(made: Path, tmp_path: Path) -> None:
    assert "no problems" in run("verify", made, "--workers", 2).stdout
    assert json.loads(run("verify", made, "--quick", "--json").stdout) == {str(made): []}
    assert "manifest.json" in run("verify", tmp_path, code=1).stdout
    (Path(shutil.copytree(made, tmp_path / "set")) / "\x1b[31m.txt").touch()
    assert r"\x1b[31m.txt: is not in the manifest" in run("verify", tmp_path / "set", code=1).stdout


def test_every_verb_that_makes_a_set_makes_a_sound_one(made: Path, tmp_path: Path) -> None:
    again = shutil.copytree(made, tmp_path / "again")
    facts = json.loads(run("merge", made, again, "--out", tmp_path / "m", "--json").stdout)
    twice = run("merge", made, made, "--out", tmp_path / "twice", code=1)
    assert "is given twice" in str(twice.exception)
    assert facts["episodes"] == 10
    said = run("split", tmp_path / "m", "--val-fraction", 0.4, "--seed", 2, "--out", tmp_path / "s").stdout
    assert "10 episodes" in said
    said = run("export", tmp_path / "s", "--to", "memmap", "--out", tmp_path / "flat").stdout
    assert str(tmp_path / "flat" / "train") in said
    run("restat", tmp_path / "s")
    run("verify", tmp_path / "m", tmp_path / "s")


@pytest.mark.parametrize(
    "words",
    [
        ["info", "nowhere"],
        ["merge", "nowhere", "--out", "x"],
        ["split", "nowhere", "--out", "x"],
        ["restat", "nowhere"],
        ["export", "nowhere", "--out", "x"],
        ["preview", "nowhere", "--out", "x"],
    ],
)
def test_a_folder_that_is_not_there_is_one_error(words, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(shards_app, words)
    assert isinstance(done.exception, HMAError)
    assert "nowhere" in str(done.exception)
    assert "\n" not in str(done.exception)
    assert list(tmp_path.iterdir()) == []
