"""Commands of minutes that end by SIGKILL: the same command continues, to the same bytes."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROBOTS = ("rails_03", "mover_04")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def run(words: list[str], folder: Path, until: str = "") -> None:
    """Run `hma` in a folder, to its end or until a file is there that matches a pattern."""
    process = subprocess.Popen([sys.executable, "-m", "hma_model.cli", *words], cwd=folder)
    while until and process.poll() is None and not list(folder.glob(until)):
        time.sleep(0.02)
    if until:
        assert process.poll() is None, "it ended before it could be killed"
        process.kill()
    assert process.wait(300) == (-9 if until else 0)


def test_killed_commands_continue_and_give_the_same_bytes(tmp_path: Path) -> None:
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    for folder in (whole, cut):
        folder.mkdir()
        for robot in ROBOTS:
            words = ["augment", robot, robot, "--episodes", "32", "--frames", "10", "--keep", "1"]
            if folder == cut:
                run(words, folder, until=f"{robot}/.augment/*.npz")
            run(words, folder)
        words = ["evaluate", "embedded", *ROBOTS, "--split", "train", "--windows", "2", "--out", "out"]
        if folder == cut:
            run(words, folder, until="out/parts/*.json")
        run(words, folder)
        words = ["policy-eval", ROBOTS[0], "still", "random", "--episodes", "8", "--frames", "8"]
        words += ["--out", "policies"]
        if folder == cut:
            run(words, folder, until="policies/.policies/*.npz")
        run(words, folder)
    assert contents(cut) == contents(whole)
