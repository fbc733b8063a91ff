"""The command line: exit codes, one-line errors, JSON, and that light verbs stay light."""

import json
import sys
from pathlib import Path

import pytest

from hma_data.errors import UsageError
from hma_model.cli import main
from tests.command import fails, hma, hma_process
from tests.conftest import ARM_YAML
from tests.data.fresh import run_fresh


def test_help_lists_the_verbs_and_every_verb_has_an_example() -> None:
    shown = hma("--help")
    assert shown.returncode == 0
    verbs = "demo play try recipe view registry inspect convert shards mixture train evaluate generate"
    verbs += " policy-eval augment label-actions hub"
    for verb in verbs.split():
        assert verb in shown.stdout
    explained = "play, view, convert, inspect, train, policy-eval, augment, label-actions, hub push"
    for verb in f"{explained}, shards verify, registry infer".split(", "):
        assert "Example: hma" in " ".join(hma(*verb.split(), "--help").stdout.replace("│", " ").split())


def test_help_shows_brackets_and_the_version() -> None:
    def shown(*verb: str) -> str:
        return " ".join(hma(*verb, "--help").stdout.replace("│", " ").split())

    assert "Example: hma train discrete_tiny shards/my_arm steps=500 --out" in shown("train")
    assert "org/name[@revision]" in shown("evaluate")
    assert hma("--version").stdout.startswith("hma 0.")


def test_what_the_command_line_shows_to_be_wrong_is_refused_before_torch_is_imported() -> None:
    code = """
import sys
from hma_model.cli import main
for words in (
    "convert -e pusht_fast --source nowhere.hdf5 --out o",
    "convert -e pusht_fast --source tests --tokenizer none --out o",
    "convert -e pusht_fast --source tests --val-fraction 7 --out o",
    "inspect nowhere",
    "train discrete_tiny data=[nowhere] --out o",
    "train nowhere --out o",
    "finetune --from nowhere --data nowhere --out o",
    "evaluate nowhere nowhere",
    "play nowhere",
    "play embedded nowhere",
    "generate nowhere nowhere --out film.avi",
    "mixture nowhere",
    "shards preview nowhere",
    "tokenizer eval none nowhere",
    "tokenizer train nowhere.yaml",
):
    assert main(words.split()), words
    assert "torch" not in sys.modules, words
"""
    said = run_fresh(code)
    assert said.count("error: ") == len(said.splitlines()) == 15


def test_light_verbs_import_nothing_heavy() -> None:
    code = """
import sys
from hma_model.cli import app
app(["registry", "list", "--json"], standalone_mode=False)
heavy = {"torch", "cv2", "av", "h5py", "rosbags", "pyarrow", "matplotlib", "numpy"} & set(sys.modules)
assert not heavy, heavy
"""
    run_fresh(code)


def test_tab_completes_verbs_robots_tokenizers_and_recipes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("_HMA_COMPLETE", "complete_bash")
    for typed, offered in (
        ("hma reg", {"registry"}),
        ("hma convert -e pusht_", {"pusht_fast", "pusht_slow"}),
        ("hma convert --tokenizer fsq-l", {"fsq-lab"}),
        ("hma train discrete_t", {"discrete_tiny"}),
        ("hma policy-eval rails_", {"rails_03", "rails_09"}),
    ):
        monkeypatch.setenv("COMP_WORDS", typed)
        monkeypatch.setenv("COMP_CWORD", str(typed.count(" ")))
        assert set(hma().stdout.split()) == offered


@pytest.mark.slow
def test_only_a_training_command_with_a_process_of_its_own_keeps_freed_memory(monkeypatch) -> None:
    asked: list[str] = []
    for verb in ("train", "convert", "finetune"):
        monkeypatch.setattr("hma_model.cli.keep_freed_memory", lambda verb=verb: asked.append(verb))
        monkeypatch.setattr(sys, "argv", ["hma", "--debug", verb, "--help"])
        assert main() == 0
        assert main([verb, "--help"]) == 0
    assert asked == ["train", "finetune"]


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ("inspect", 2, ["Missing argument"]),
        ("convert --nonsense", 2, ["--nonsense"]),
        ("registry infer . --id Not-An-Id", 2, ["Not-An-Id"]),
        ("convert -e pusht_fats --out /nonexistent/o", 1, ["pusht_fast", "registry list"]),
        ("convert -e toy_arm.yaml --source no.hdf5 --out o", 1, ["no.hdf5"]),
        ("inspect empty", 1, ["holds no files"]),
        ("shards info empty", 1, ["manifest.json"]),
        ("mixture none", 1, ["not a folder"]),
    ],
)
def test_what_is_wrong_is_one_line_and_wrong_usage_exit_code_two(toy_yaml, tmp_path, words, code, said):
    (tmp_path / "empty").mkdir()
    fails(hma(*words.split(), cwd=tmp_path), code, *said)


def test_a_wrong_yaml_lists_every_problem(toy_yaml: Path, tmp_path: Path) -> None:
    toy_yaml.write_text(ARM_YAML.replace("frequency_hz: 10", "frequency_hz: -3").replace("kind:", "kinds:"))
    done = hma("convert", "-e", toy_yaml, "--source", tmp_path / "toy.hdf5", "--out", tmp_path / "o")
    fails(done, 1, str(toy_yaml), "frequency_hz", "-3", "kinds: unknown key, did you mean 'kind'")
    assert not (tmp_path / "o").exists()


def test_debug_shows_the_traceback(tmp_path: Path) -> None:
    assert "Traceback" in hma_process("inspect", str(tmp_path / "no"), "--debug").stderr


def test_a_target_above_the_recorded_rate_is_noted(tmp_path: Path) -> None:
    path = tmp_path / "arm.yaml"
    text = hma("registry", "show", "pusht_fast").stdout.split("# derived")[0]
    assert "target_hz: 5" in text
    path.write_text(text.replace("target_hz: 5", "target_hz: 40"))
    done = hma("registry", "validate", str(path))
    assert done.returncode == 0 and "note: target_hz 40 is above the recorded rate" in done.stdout
    path.write_text(path.read_text().replace("target_hz: 40", "target_hz: 40\nstride: 4"))
    facts = json.loads(hma("registry", "validate", str(path), "--json").stdout)
    assert facts["problems"] == [] and facts["notes"][0]["file"] == str(path)
    assert facts["notes"][0]["note"].endswith("sees 2.5 frames per second with the stride 4 that is given")


def test_a_warning_is_one_line_without_its_place_in_the_code() -> None:
    code = (
        "import warnings; from hma_model.cli import main; main(['--version']); warnings.warn('two\\nlines')"
    )
    assert run_fresh(code) == "warning: two lines\n"


def test_a_recording_is_named_first_or_by_source_but_once(toy_yaml: Path, tmp_path: Path) -> None:
    words = ["-e", toy_yaml, "--out", str(tmp_path / "o"), "--tokenizer", "raw-64", "--dry-run", "--json"]
    recording = str(tmp_path / "toy.hdf5")
    first, named = hma("convert", recording, *words), hma("convert", "--source", recording, *words)
    assert first.returncode == named.returncode == 0, first.stderr + named.stderr
    assert json.loads(first.stdout)["shards"] == json.loads(named.stdout)["shards"]
    fails(hma("convert", recording, "--source", recording, *words), 2, "name the recording once")


def test_progress_names_the_robot_not_its_file(toy_yaml: Path, tmp_path: Path) -> None:
    renamed = toy_yaml.rename(tmp_path / "embodiment.yaml")
    words = ["-e", str(renamed), "--out", str(tmp_path / "o"), "--tokenizer", "raw-64", "--workers", "0"]
    done = hma("convert", str(tmp_path / "toy.hdf5"), *words)
    assert done.returncode == 0, done.stderr
    assert done.stderr.startswith("convert toy_arm: ")


@pytest.mark.parametrize("verb", ["train discrete_tiny nowhere", "finetune nowhere --from embedded"])
def test_a_key_written_as_an_option_is_answered_by_how_to_write_it(verb: str) -> None:
    fails(hma(*verb.split(), "--steps", "10"), 2, "write steps=VALUE")
    fails(hma(*verb.split(), "--batch-size=4"), 2, "write batch_size=VALUE")
    fails(hma(*verb.split(), "--nonsense", "1"), 2, "--help")


def test_train_and_finetune_take_shard_sets_as_words(monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[list[str]] = []

    def looked_at(folders: list[str]) -> None:
        read.append(list(folders))
        raise UsageError("enough", "seen")

    monkeypatch.setattr("hma_model.cli.train.refuse_early", looked_at)
    for words in ("train discrete_tiny a b steps=3", "finetune a b steps=3 --from embedded"):
        fails(hma(*words.split()), 2, "seen")
    fails(hma("finetune", "--from", "embedded", "--data", "a", "b"), 2, "seen")
    assert read == [["a", "b"]] * 3
    fails(hma("finetune", "--from", "embedded", "steps=3"), 2, "names no shard set")


def test_recipes_are_listed_and_shown() -> None:
    listed = json.loads(hma("recipe", "list", "--json").stdout)
    assert {"discrete_tiny", "finetune_tiny"} <= {one["recipe"] for one in listed}
    assert all(one["about"] for one in listed)
    shown = hma("recipe", "show", "discrete_tiny")
    assert "\nbatch_size: 2\n" in shown.stdout and "steps=10" in shown.stdout
    fails(hma("recipe", "show", "nowhere"), 1, "no such recipe")
