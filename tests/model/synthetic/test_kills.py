"""`hma augment` and `hma evaluate` end by SIGKILL: the same command continues, to the same bytes."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.conftest import contents

pytestmark = pytest.mark.slow

ROBOTS = ("rails_03", "mover_04")


def run(words: list[str], folder: Path, until: str = "") -> None:
    """Run `hma` in a folder, to its end or until a file is there that matches a pattern."""
    process = subprocess.Popen([sys.executable, "-m", "hma_model.cli", *words], cwd=folder)
    while until and process.poll() is None and not list(folder.glob(until)):
        time.sleep(0.02)
    if until:
        assert process.poll() is None, "it ended before it could be killed"
        process.kill()
    assert process.wait(300) == (-9 if until else 0)


@pytest.mark.timeout(900)
def test_killed_actions_continue_and_give_the_same_bytes(tmp_path: Path) -> None:
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    for folder, killed in ((whole, False), (cut, True)):
        folder.mkdir()
        for robot in ROBOTS if folder == whole else ROBOTS[:1]:
            words = ["augment", robot, robot, "--episodes", "20", "--frames", "8", "--keep", "1"]
            if killed:
                run(words, folder, until=f"{robot}/.augment/*.npz")
            run(words, folder)
        words = ["evaluate", "embedded", *(str(whole / robot) for robot in ROBOTS), "--split", "train"]
        words += ["--windows", "2", "--out", "out"]
        if killed:
            run(words, folder, until="out/parts/*.npz")
        run(words, folder)
    assert contents(cut / ROBOTS[0]) == contents(whole / ROBOTS[0])
    assert contents(cut / "out") == contents(whole / "out")
