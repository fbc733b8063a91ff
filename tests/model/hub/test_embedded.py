"""The checkpoint that comes along with the package, by its name."""

import re

import pytest

from hma_data.errors import CheckpointError
from hma_data.lab.family import HELD_OUT
from hma_data.shards.reader import ShardSet
from hma_model.checkpoint import folder
from hma_model.cli import main
from hma_model.network.model import HMA
from tests.model.shards import make_shards


def test_it_is_loaded_by_its_name() -> None:
    model = HMA.from_pretrained("embedded")
    assert sorted(model.embodiments) == sorted(
        path.name for path in (folder.EMBEDDED / "embodiments").iterdir()
    )


def test_for_a_robot_that_it_lacks_the_command_that_adds_one_is_named(tmp_path, capsys) -> None:
    shards = make_shards(tmp_path / "shards", "my_arm")
    assert main(["evaluate", "embedded", str(shards)]) == 1
    said = capsys.readouterr().err
    assert "embedded: has no embodiment 'my_arm' — it has: arm1_02, " in said and "pusht_fast" in said
    assert "hma finetune SHARDS --from embedded --out RUN" in said
    assert f"hma convert --tokenizer {HMA.from_pretrained('embedded', []).config.tokenizer['name']}" in said

    assert main(["evaluate", "embedded-pusht", str(shards)]) == 1
    assert "with shards of hma convert --tokenizer fsq-lab" in capsys.readouterr().err


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


ROBOTS = {
    *("arm1_02", "arm1_03", "arm2_02", "arm2_07", "arm3_04", "arm4_01", "crane_04", "gantry_04", "mover_04"),
    *("mover_10", "rails_03", "rails_09", "pendulum", "planar_arm", "pusht_slow"),
}
LAB = {"arm2_02", "arm2_07", "arm3_04", "arm4_01", "crane_04", "mover_10", "planar_arm", "pusht_slow"}


@pytest.mark.parametrize("name", folder.BUNDLED)
def test_every_bundled_checkpoint_is_whole_and_small(name) -> None:
    own = folder.Checkpoint.open(name)
    assert own.trunk().stat().st_size < 8e6
    for robot in own.embodiments:
        own.check(robot)


@pytest.mark.parametrize(
    ("robots", "part"),
    [
        ([], "embedded"),
        (["arm2_02"], "embedded-lab"),
        (["arm2_02", "planar_arm"], "embedded-lab"),
        (["arm2_02", "rails_03"], "embedded"),
        (["pusht_fast"], "embedded-pusht"),
        (["nobody"], "embedded"),
    ],
)
def test_the_best_network_that_has_all_robots_is_found_by_the_name_embedded(robots, part) -> None:
    assert folder.resolve("embedded", robots) == folder.BUNDLED[part]
    assert set(folder.embodiments_in(folder.BUNDLED["embedded-lab"])) == LAB < ROBOTS


def test_the_embedded_trunk_is_the_one_of_the_recipe() -> None:
    # `hma train world`, carried over to the present fsq-lab, trained on in six parts, the last two averaged,
    # and trained on in a seventh, on a GPU: see docs/results.md
    own = folder.Checkpoint.open("embedded")
    own.trunk()
    assert own.trunk_sha256 == "0dbaf3ccf33b191e75fce74be7d36d0a0af175063303d57488ff5c8df70d1634"
    assert set(own.embodiments) == ROBOTS
    assert not set(own.embodiments) & set(HELD_OUT)
    for embodiment in own.embodiments:
        own.check(embodiment)
    assert sum(path.stat().st_size for path in own.folder.rglob("*") if path.is_file()) <= 8_000_000
