"""The checkpoint that comes along with the package, by its name."""

import re

import pytest

from hma_data.errors import CheckpointError
from hma_data.lab.family import HELD_OUT
from hma_data.shards.reader import ShardSet
from hma_data.tokenizers.shapes import get_spec
from hma_model.checkpoint import folder
from hma_model.cli import main
from tests.model.shards import make_shards


def test_for_a_robot_that_it_lacks_the_command_that_adds_one_is_named(tmp_path, capsys) -> None:
    shards = make_shards(tmp_path / "shards", "my_arm")
    assert main(["evaluate", "embedded", str(shards)]) == 1
    said = capsys.readouterr().err
    assert "embedded-fsq: has no embodiment 'my_arm' — it has: arm1_02, " in said and "pusht_fast" in said
    assert "hma finetune SHARDS --from embedded --out RUN" in said
    assert "hma convert --tokenizer palette-64 (drawn images) or fsq-lab" in said


def test_a_robot_with_a_checkpoint_to_itself_is_published_by_the_name_embedded(tmp_path) -> None:
    assert main(["hub", "push", "embedded", str(tmp_path / "hub"), "-e", "pusht_fast"]) == 0
    assert folder.Checkpoint.open(tmp_path / "hub").embodiments == ("pusht_fast",)


def test_of_a_bundled_checkpoint_with_its_own_colours_the_option_that_takes_them_is_named(tmp_path) -> None:
    shards = ShardSet(make_shards(tmp_path / "shards", "pusht_fast"))
    own = folder.Checkpoint.open("embedded", ["pusht_fast"])
    option = f"--tokenizer palette-64 --weights {own.folder / folder.CONFIG}"
    with pytest.raises(CheckpointError, match=re.escape(option)):
        folder.require_tokenizer(own.config, shards.spec, "shards")
    own = folder.Checkpoint.open("embedded-lab")  # of the default colours
    with pytest.raises(CheckpointError, match="--tokenizer palette-64$"):
        folder.require_tokenizer(own.config, shards.spec, "shards")


@pytest.mark.slow
def test_the_name_embedded_stands_for_the_network_of_the_tokenizer_of_the_shards(tmp_path) -> None:
    shards = make_shards(tmp_path / "shards", "my_arm", spec=get_spec("palette-64"))
    given = ["--data", str(shards), "steps=1", "batch_size=1", "--out", str(tmp_path / "run")]
    assert main(["finetune", "--from", "embedded", *given]) == 0
    assert main(["finetune", "--from", "embedded", *given]) == 0  # it goes on
    begun = folder.Checkpoint.open(tmp_path / "run" / ".start")
    assert begun.trunk_sha256 == folder.Checkpoint.open("embedded-lab").trunk_sha256


ROBOTS = {
    *("arm1_02", "arm1_03", "arm2_02", "arm2_07", "arm3_04", "arm4_01", "crane_04", "gantry_04", "mover_04"),
    *("mover_10", "rails_03", "rails_09", "pendulum", "planar_arm", "pusht_slow"),
}


@pytest.mark.parametrize("name", folder.BUNDLED)
def test_every_bundled_checkpoint_is_whole_and_small(name) -> None:
    own = folder.Checkpoint.open(name)
    assert own.trunk().stat().st_size < 4e6
    for robot in own.embodiments:
        own.check(robot)


@pytest.mark.parametrize(
    ("robots", "tokenizer", "part"),
    [
        ([], None, "embedded-fsq"),
        ([], "palette-64", "embedded-lab"),
        ([], "fsq-lab", "embedded-fsq"),
        ([], "vae-8", "embedded-fsq"),
        (["arm2_02", "planar_arm"], None, "embedded-lab"),
        (["arm2_02", "planar_arm"], "fsq-lab", "embedded-fsq"),
        (["arm2_02", "planar_arm"], "vae-8", "embedded-lab"),
        (["rails_03"], "palette-64", "embedded-lab2"),
        (["rails_09", "arm1_03"], None, "embedded-lab3"),
        (["arm2_02", "rails_03"], None, "embedded-fsq"),
        (["fetch"], None, "embedded-fetch"),
        (["pusht_fast"], None, "embedded-pusht"),
        (["pusht_fast"], "fsq-lab", "embedded-pusht"),
        (["nobody"], "palette-64", "embedded-fsq"),
    ],
)
def test_the_best_network_that_has_all_robots_is_found_by_the_name_embedded(robots, tokenizer, part) -> None:
    assert folder.resolve("embedded", robots, tokenizer) == folder.BUNDLED[part]


def test_no_network_has_seen_the_robots_of_the_demo() -> None:
    known = {one for name in folder.BUNDLED for one in folder.Checkpoint.open(name).embodiments}
    assert known == {*ROBOTS, "fetch", "pusht_fast"} and not known & set(HELD_OUT)
