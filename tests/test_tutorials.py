"""The tutorials, walked: each block of a page (commands, files, Python) runs, in order, in an empty folder.

Three things are made small: recordings have a few episodes, trainings two steps, and everything runs on the
processor. `sbatch` runs the tasks of its script one after another; `hma play` is opened and closed.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.command import ROOT

PAGES = sorted((ROOT / "docs/tutorials").glob("*.md"))
BLOCK = re.compile(r'^```(bash|python|yaml)(?: title="([^"]+)")?\n(.*?)^```', re.MULTILINE | re.DOTALL)
COMMANDS = {
    "hma": f"#!{sys.executable}\n"
    + """
import re, signal, subprocess, sys
from urllib.request import urlopen

words = ["cpu" if word == "cuda" else word for word in sys.argv[1:]]
small = ["steps=2", "warmup=1", "batch_size=2", "workers=0", "precision=fp32", "eval_windows=2", "pictures=0"]
if words[0] == "train":
    words += [*small, "model.layers=1", "model.width=32", "model.heads=2"]
if words[0] == "finetune":
    words += small
if words[0] == "evaluate":
    words += ["--windows", "2"]
if words[0] == "play":
    words += ["--no-browser"]
command = [sys.executable, "-m", "hma_model.cli", *words]
if words[0] != "play":
    sys.exit(subprocess.run(command).returncode)
page = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
address = re.search(r"http://\\S+", page.stdout.readline())[0]
assert b"<html" in urlopen(address).read()
page.send_signal(signal.SIGINT)
sys.exit(page.wait() not in (0, 130))
""",
    "python": f'#!/bin/bash\nexec {sys.executable} "$@"\n',
    "torchrun": f'#!/bin/bash\nexec {sys.executable} -m torch.distributed.run "$@"\n',
    "sbatch": """#!/bin/bash
last=$(sed -n 's/^#SBATCH --array=0-//p' "$1")
for task in $(seq 0 "$last"); do SLURM_ARRAY_TASK_ID=$task bash -e "$1" || exit 1; done
""",
}


def script(page: str) -> str:
    """Return the page as one script of the shell."""
    parts = ["set -eux"]
    for kind, title, text in BLOCK.findall(page):
        text = re.sub(r"episodes=\d+", "episodes=3", text).replace("--limit 10", "--limit 2")
        if title:
            parts.append(f"mkdir -p $(dirname {title}); cat > {title} <<'END'\n{text}END")
        elif kind == "python":
            parts.append(f"python - <<'END'\n{text}END")
        else:
            parts.append(text)
    return "\n".join(parts)


@pytest.mark.slow
@pytest.mark.timeout(580)
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_command_of_a_tutorial_runs(page: Path, tmp_path: Path) -> None:
    bin_, work = tmp_path / "bin", tmp_path / "work"
    bin_.mkdir()
    work.mkdir()
    for name, text in COMMANDS.items():
        (bin_ / name).write_text(text)
        (bin_ / name).chmod(0o755)
    env = {
        **os.environ,
        "PATH": f"{bin_}:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "HMA_CACHE": str(tmp_path / "cache"),
        "OMP_NUM_THREADS": "1",
    }
    done = subprocess.run(
        ["bash", "-c", script(page.read_text())],
        cwd=work,
        env=env,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_tutorial_has_no_command_that_the_test_passes_over(page: Path) -> None:
    text = page.read_text()
    fences = [fence for fence in re.findall(r"^```(\S.*)$", text, re.MULTILINE) if fence != "text"]
    assert len(fences) == len(BLOCK.findall(text)) >= 5


@pytest.mark.slow
def test_the_slurm_script_of_batch_jobs_runs_task_by_task(tmp_path: Path) -> None:
    from hma_data.lab import record

    page = (ROOT / "docs/batch-jobs.md").read_text()
    text = re.search(r"^```bash\n(#!/bin/bash\n.*?)^```", page, re.MULTILINE | re.DOTALL)[1]
    record("pendulum", tmp_path / "raw", episodes=4)
    here = {
        "-e my_arm": "-e pendulum --tokenizer fsq-8",
        "/shared/raw/my_arm": str(tmp_path / "raw/pendulum"),
        "/shared/shards/my_arm": str(tmp_path / "out"),
        "--shard-frames 50000": "--shard-frames 200",
        "--shard-count 64": "--shard-count 2",
        "--workers 4": "--workers 1",
        ".venv/bin/hma": f"{sys.executable} -m hma_model.cli",
    }
    for stated, small in here.items():
        assert text.count(stated) == 1, stated
        text = text.replace(stated, small)
    (tmp_path / "job.sh").write_text(text)
    stand_in = tmp_path / "srun"
    stand_in.write_text('#!/bin/bash\nwhile [[ $1 == --* ]]; do shift; done\nexec "$@"\n')
    stand_in.chmod(0o755)
    for task in (1, 0):
        slurm = {"SLURM_ARRAY_TASK_ID": str(task), "SLURM_CPUS_PER_TASK": "4", "SLURM_SUBMIT_DIR": str(ROOT)}
        env = {**os.environ, **slurm, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
        done = subprocess.run(
            ["bash", str(tmp_path / "job.sh")], env=env, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
    # the last task sums up the whole set
    assert "4 episodes (train 3, val 1)" in done.stdout and (tmp_path / "out" / "manifest.json").is_file()
