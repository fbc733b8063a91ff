"""hma try: from a recording to a film of its robot in the model, each step a command of its own."""

import shutil
from pathlib import Path

import av
import h5py
import numpy as np
import pytest

from hma_data.lab import family, record
from hma_data.registry.embodiment import Embodiment
from hma_data.storage.yaml_io import read_yaml, write_yaml
from hma_model.cli import trial
from tests.command import fails, hma, hma_process
from tests.model.shards import make_shards

ANSWER = ("--answer", "action.space=joint_delta")


def recorded(folder: Path, episodes: int) -> Path:
    return shutil.move(record("mover_04", folder, episodes, 0), folder / "My Arm.hdf5")


def test_what_the_recording_cannot_say_is_asked_and_answered_by_flags(tmp_path, monkeypatch) -> None:
    recording = recorded(tmp_path, 2)
    ran = []

    def only_light_steps(words: list[str]) -> None:
        ran.append(words)
        if words[0] == "convert":
            raise SystemExit(3)
        assert hma(*words).returncode == 0

    monkeypatch.setattr(trial, "_run", only_light_steps)
    monkeypatch.setattr("sys.stdin.isatty", lambda: False)
    out = tmp_path / "out"
    asked = hma("try", str(recording), "--out", str(out))
    assert asked.returncode == 1 and "use --answer action.space=…" in asked.stderr
    fails(hma("try", str(recording), "--out", str(out), "--answer", "no.such=1"), 2, "no.such is not a key")
    assert hma("try", str(recording), "--out", str(out), *ANSWER).returncode == 3
    robot = Embodiment.load(out / "robot.yaml")
    assert (robot.id, robot.action.space) == ("my_arm", "joint_delta")
    assert [words[0] for words in ran].count("registry") == 1, "what was inferred is kept"
    fails(hma("try", "nowhere.hdf5"), 1, "does not exist")


def test_the_images_decide_the_tokenizer(tmp_path: Path) -> None:
    recording, yaml = recorded(tmp_path, 2), tmp_path / "robot.yaml"
    yaml.write_text(family.embodiment("mover_04").to_yaml())
    assert trial._tokenizer(str(recording), str(yaml)) == "palette-64"
    key = family.embodiment("mover_04").cameras[0].key
    with h5py.File(recording, "a") as file:
        for number, demo in enumerate(file["data"].values()):
            frames = demo[key][:]
            noise = np.random.default_rng(0).integers(0, 128, frames.shape, np.uint8)
            del demo[key]
            demo[key] = frames // 2 + noise if number else frames[:1]  # the first episode is damaged
    assert trial._tokenizer(str(recording), str(yaml)) == "fsq-lab"


@pytest.mark.parametrize(("said", "cropped"), [("", True), ("n", False)])
def test_a_proposed_crop_is_asked_about_in_a_terminal(said, cropped, tmp_path, monkeypatch) -> None:
    camera = {"name": "front", "key": "k", "crop": [0, 0, 9, 9]}
    path = tmp_path / "robot.yaml"
    path.write_text(write_yaml({"cameras": [camera], "provenance": {"crop": "TODO: does it hold all?"}}))
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("builtins.input", lambda question: said)
    trial._answer("unread", path, [])
    assert ("crop" in read_yaml(path)["cameras"][0]) is cropped


def test_a_rate_that_is_answered_decides_what_the_model_sees(tmp_path: Path) -> None:
    recording, path = recorded(tmp_path, 2), tmp_path / "robot.yaml"  # of 80 actions each
    for given, seen in (("24", 8), ("6", 2), (".inf", 2)):
        path.write_text(write_yaml({"frequency_hz": "TODO: at how many Hz?", "target_hz": 2}))
        trial._answer(str(recording), path, [f"frequency_hz={given}"])
        assert read_yaml(path)["target_hz"] == seen
    path.write_text(write_yaml({"frequency_hz": "TODO: at how many Hz?", "target_hz": 2}))
    trial._answer(str(recording), path, ["frequency_hz=24", "target_hz=4"])
    assert read_yaml(path)["target_hz"] == 4
    path.write_text(write_yaml({"frequency_hz": 24, "target_hz": 8}))
    trial._answer(str(recording), path, ["frequency_hz=6"])  # another answer to the same question
    assert read_yaml(path)["target_hz"] == 2


def test_of_a_single_episode_the_training_is_shown(tmp_path, monkeypatch) -> None:
    recording, out, ran = recorded(tmp_path, 1), tmp_path / "out", []

    def without_training(words: list[str]) -> None:
        ran.append(words)
        if words[0] == "convert":
            make_shards(out / "shards", "arm", episodes=1, held_out=0)
        if words[0] == "finetune":
            (out / "run" / "checkpoints").mkdir(parents=True)

    monkeypatch.setattr(trial, "_run", without_training)
    monkeypatch.setattr(trial, "_write_page", lambda *given: out)
    assert hma("try", str(recording), "-e", "mover_52", "--out", str(out)).returncode == 0
    assert [words[words.index("--split") + 1] for words in ran if "--split" in words] == ["train"] * 2


@pytest.mark.slow
def test_one_command_ends_with_a_film_and_a_page_and_continues(tmp_path: Path) -> None:
    recording = recorded(tmp_path, 12)
    words = ("try", str(recording), "--minutes", "0.1", "--out", str(tmp_path / "out"), *ANSWER)
    done = hma_process(*words)
    assert done.returncode == 0, done.stderr
    commands = [line.removeprefix("$ hma ") for line in done.stdout.splitlines() if line.startswith("$ hma ")]
    verbs = [line.split()[0] for line in commands]
    assert verbs == ["inspect", "registry", "convert", "finetune", "evaluate", "generate"]
    with av.open(str(tmp_path / "out" / "film.mp4")) as film:
        assert sum(1 for _ in film.decode(video=0)) > 10
    page = (tmp_path / "out" / "index.html").read_text()
    assert (
        "its actions" in page
        and "data:image/webp" in page
        and "hma finetune" in page
        and "decoded frames show" in page
    )
    again = hma_process(*words)
    assert again.returncode == 0, again.stderr
    assert "$ hma generate" not in again.stdout and "$ hma registry infer" not in again.stdout
