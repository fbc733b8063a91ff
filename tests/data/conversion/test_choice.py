"""Episodes chosen by id, by glob and by a file of ids: in the command and the YAML."""

import json
import os
from pathlib import Path

import pytest

from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.conversion.rewrite import merge, split
from hma_data.errors import OutputError, RegistryError, UsageError
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.preview import preview
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.sources.common.choice import chosen_ids
from tests.command import fails, hma
from tests.conftest import ARM_YAML, BlockTokenizer, write_toy

IDS = ["day_1", "day_2", "night/1", "night/2", "take[1]"]


@pytest.mark.parametrize(
    ("only", "exclude", "left"),
    [
        ([], [], IDS),
        (["day_2"], [], ["day_2"]),
        (["day_*", "night/1"], ["*1"], ["day_2"]),
        ([], ["night*", "take[1]"], ["day_1", "day_2"]),
        (["?????"], [], ["day_1", "day_2"]),
    ],
)
def test_ids_and_globs_choose(only: list[str], exclude: list[str], left: list[str]) -> None:
    assert chosen_ids(IDS, only, exclude) == left


def test_a_file_names_ids_and_globs(tmp_path: Path) -> None:
    (tmp_path / "bad.txt").write_text("# too dark\nnight/*\n\nday_1\r\n")
    assert chosen_ids(IDS, [], [f"@{tmp_path}/bad.txt"]) == ["day_2", "take[1]"]
    (tmp_path / "bad.txt").write_text("day_1\nday_9\n")
    with pytest.raises(UsageError, match=r"--exclude: 'day_9' in line 2 of .*bad.txt matches no episode"):
        chosen_ids(IDS, [], [f"@{tmp_path}/bad.txt"])
    with pytest.raises(UsageError, match="none.txt cannot be read"):
        chosen_ids(IDS, ["@none.txt"], [])


@pytest.mark.parametrize(
    ("only", "exclude", "words"),
    [
        (["dya_1"], [], "--only: 'dya_1' matches no episode — there are ids such as day_1"),
        ([], ["evening*"], "--exclude: 'evening*' matches no episode — there are ids such as day_1, day_2"),
        (["day_1"], ["day_*"], "--exclude: leaves none of 5 episodes"),
    ],
)
def test_a_choice_that_matches_nothing_is_one_error(only: list[str], exclude: list[str], words: str) -> None:
    with pytest.raises(UsageError) as fault:
        chosen_ids(IDS, only, exclude)
    assert words in str(fault.value)


@pytest.fixture
def arm_yaml(tmp_path: Path) -> Path:
    path = tmp_path / "toy_arm.yaml"
    path.write_text(ARM_YAML)
    return path


def run(robot: Embodiment, source: Path, out: Path, **settings):
    return convert(robot, source, BlockTokenizer(), out, settings=Settings(val_fraction=0, **settings))


def ids(folder: Path) -> list[str]:
    return sorted(ShardSet(folder).episodes["id"].to_pylist())


def test_command_and_yaml_choose_together(tmp_path, toy_recording) -> None:
    robot = Embodiment.from_yaml(ARM_YAML.replace("format: hdf5", "format: hdf5, exclude: [demo_1*]"))
    chosen = run(robot, toy_recording, tmp_path / "out", exclude=("demo_2",), limit=3)
    assert ids(tmp_path / "out") == ["demo_0", "demo_3", "demo_4"]
    assert chosen.left_out == 4
    assert verify(tmp_path / "out") == []
    with pytest.raises(RegistryError, match=r"embodiment toy_arm: source.only: 'demo_77' matches no episode"):
        wrong = Embodiment.from_yaml(ARM_YAML.replace("format: hdf5", "format: hdf5, only: [demo_77]"))
        run(wrong, toy_recording, tmp_path / "none")


def test_another_choice_is_another_plan_and_extend_adds_the_rest(tmp_path, toy_arm, toy_recording) -> None:
    first = run(toy_arm, toy_recording, tmp_path / "out", exclude=("demo_3", "demo_4"))
    again = run(toy_arm, toy_recording, tmp_path / "out", exclude=("demo_3", "demo_4"))
    assert (first.left_out, again.made_shards) == (2, 0)
    with pytest.raises(OutputError, match="--exclude demo_3, demo_4 there, demo_3 now"):
        run(toy_arm, toy_recording, tmp_path / "out", exclude=("demo_3",))
    settings = Settings(val_fraction=0)
    convert(toy_arm, toy_recording, BlockTokenizer(), tmp_path / "out", settings=settings, extend=True)
    assert len(ids(tmp_path / "out")) == 12


def test_a_set_of_chosen_episodes_can_be_split_and_merged(tmp_path, toy_arm, toy_recording) -> None:
    run(toy_arm, toy_recording, tmp_path / "a", only=("demo_1", "demo_2"))
    run(toy_arm, toy_recording, tmp_path / "b", exclude=("demo_1", "demo_2"))
    split(tmp_path / "a", tmp_path / "c", val_fraction=0.5)
    merge([tmp_path / "a", tmp_path / "b"], tmp_path / "d")
    assert ids(tmp_path / "c") == ["demo_1", "demo_2"]
    assert len(ids(tmp_path / "d")) == 12
    assert verify(tmp_path / "c") == verify(tmp_path / "d") == []
    shown = preview(tmp_path / "d", tmp_path / "p", tokenizer=BlockTokenizer(), only=["demo_1*"], frames=1)
    assert shown.episodes == ("demo_1", "demo_10", "demo_11")


def test_a_plan_without_a_choice_states_none(tmp_path, toy_arm, toy_recording) -> None:
    (tmp_path / "bad.txt").write_text("demo_1\n")
    run(toy_arm, toy_recording, tmp_path / "a")
    run(toy_arm, toy_recording, tmp_path / "b", exclude=(f"@{tmp_path}/bad.txt", "demo_2"))
    plain, chosen = (ShardSet(tmp_path / name).manifest.plan for name in "ab")
    assert list(plain["settings"]) == ["frames", "cameras", "val_fraction", "seed", "limit", "shard_frames"]
    assert chosen["settings"]["exclude"] == ["@bad.txt", "demo_2"]
    assert plain["hash"] != chosen["hash"]


def test_the_command_counts_what_it_leaves_out(tmp_path, arm_yaml) -> None:
    write_toy(tmp_path / "toy.hdf5", [8, 8, 8, 8])
    words = ["convert", "-e", arm_yaml, "--source", tmp_path / "toy.hdf5", "--tokenizer", "fsq-8"]
    words += ["--out", tmp_path / "out", "--workers", "0"]
    planned = hma(*words, "--dry-run", "--exclude", "demo_0", "--exclude", "demo_2")
    assert "2 episodes, about 16 recorded frames" in planned.stdout
    assert "left out by only and exclude: 2 episodes" in planned.stdout
    done = hma(*words, "--json", "--only", "demo_[12]", "--exclude", "demo_1")
    assert (json.loads(done.stdout)["episodes"], json.loads(done.stdout)["left_out"]) == (1, 3)
    fails(hma(*words, "--dry-run", "--only", "demo_9"), 2, "--only: 'demo_9' matches no episode", "demo_")


def test_inspect_and_doctor_take_the_episodes_that_a_yaml_chooses(tmp_path, toy_recording, arm_yaml) -> None:
    arm_yaml.write_text(ARM_YAML.replace("format: hdf5", "format: hdf5, only: [demo_5]"))
    report = json.loads(hma("inspect", toy_recording, "-e", arm_yaml, "--json").stdout)
    assert report["embodiment"]["first episode"].startswith("demo_5:")


def test_a_recording_whose_name_is_not_utf8_is_refused_before_the_work(
    tmp_path: Path, arm_yaml: Path, toy_recording: Path
) -> None:
    """Neither a YAML nor a shard can state such a name."""
    odd = tmp_path / os.fsdecode(b"r\xe9c.hdf5")
    try:
        toy_recording.rename(odd)
    except OSError:
        pytest.skip("this file system takes UTF-8 names only")
    words = [r"r\udce9c.hdf5: its name is not UTF-8 text — rename it"]
    fails(hma("registry", "infer", odd, "--id", "mine", "--out", tmp_path / "mine.yaml"), 1, *words)
    assert not (tmp_path / "mine.yaml").exists()
    start = ("convert", "-e", arm_yaml, "--tokenizer", "fsq-8")
    fails(hma(*start, "--source", odd, "--out", tmp_path / "out"), 1, *words)
    assert not (tmp_path / "out").exists()
