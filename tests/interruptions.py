"""Commands that promise to continue, and how to interrupt one at any operation that changes its folder.

A point is the number of such an operation: a rename, a deletion, a folder that is made, a change of a store.
Points are counted, never timed, so that each is met again exactly. What SIGKILL leaves at a point is what is
on the disk then: `disk`, with the file that is about to be renamed cut in half, as one that is being written.
"""

import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from dataclasses import replace as changed
from pathlib import Path
from subprocess import CompletedProcess
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from fsspec.implementations.memory import MemoryFileSystem

from hma_data.episodes.sheets import write_mp4
from hma_data.lab import family
from hma_data.tokenizers.training.train import train as train_tokenizer
from hma_model.benchmark import planning
from hma_model.benchmark import run as benchmarking
from hma_model.checkpoint import io as checkpoint
from hma_model.evaluation import report, suite
from hma_model.evaluation.agreement import Accuracy
from hma_model.policies import scores
from hma_model.policies.judge import StateJudge, task_of
from hma_model.synthetic import augment, labels
from tests.command import hma
from tests.conftest import ARM_YAML, convert_toy, write_toy
from tests.data import cameras, tokenizer_files
from tests.model import robots
from tests.model.runs import TINY
from tests.model.shards import make_shards
from tests.model.true_world import tiny_model

Disk = dict[str, bytes | None]  # path -> the bytes of a file, None of a folder
CHANGES = ("rename", "replace", "link", "mkdir", "remove", "unlink", "rmdir")
ENDED = 1 << 22  # a process id above the highest
ROBOT = "rails_03"
# What no two runs have in common: the time they took, and the hash of a training's state, which has it.
TIMES = re.compile(rb'"(\w*seconds|memory_mib)": [\d.e-]+|"sha256": "\w+"\n}\n$')


@dataclass(frozen=True)
class Command:
    """A command that promises to continue.

    Attributes:
        words: after `hma`; {data} is the folder of its input. It runs in a folder of its own, and {store} is
            a store of its own.
        make: makes its input in a folder.
        begin: given that folder and its own, makes what is there before.
        kept: what it says of how to go on after Ctrl-C.
        again: what it says when all is done already; empty where it makes the same result again.
        patch: makes it small.
        trusted: results whose content it does not read again.
    """

    words: str
    make: Callable[[Path], object]
    kept: str = "run the same command again to continue"
    again: str = ""
    begin: Callable[[Path, Path], object] = lambda data, folder: None
    patch: Callable[[pytest.MonkeyPatch], object] = lambda patch: None
    trusted: str = "nothing"

    def run(self, data: Path, folder: Path) -> CompletedProcess[str]:
        """Run it to its end in a folder, in this process, on one thread.

        The bytes of a training depend on the number of threads, and other tests leave other numbers.
        """
        before = torch.get_num_threads()
        with pytest.MonkeyPatch.context() as patch, ExitStack() as after:
            after.callback(torch.set_num_threads, before)
            torch.set_num_threads(1)
            if "{store}" in self.words:
                patch.setenv("HMA_CACHE", str(folder / "cache"))
            self.patch(patch)
            return hma(*self.words.format(data=data, store=f"memory:/{folder}").split(), cwd=folder)


# -- points


@contextmanager
def watched(
    folder: Path, at: Callable[[int, Path | None], object] = lambda number, moved: None
) -> Iterator[list[str]]:
    """Yield what changes the folder; call `at` before each with its number, and the file that it renames."""
    done: list[str] = []

    def counted(name: str, plain: Callable[..., Any]) -> Callable[..., Any]:
        def change(path: Any, *given: Any, **options: Any) -> Any:
            inside = options.get("dir_fd")
            parent = Path.cwd() if inside is None else Path(f"/proc/self/fd/{inside}").readlink()
            where = Path(parent, os.fsdecode(path))
            if where.is_relative_to(folder):
                done.append(f"{name} {where.relative_to(folder)}")
                at(len(done), where if "rename" in name or name == "replace" else None)
            return plain(path, *given, **options)

        return change

    def stored(name: str, plain: Callable[..., Any]) -> Callable[..., Any]:
        def change(files: MemoryFileSystem, *given: Any, **options: Any) -> Any:
            done.append(f"{name} {given[0]}")
            at(len(done), None)
            return plain(files, *given, **options)

        return change

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda handle: None)
        for name in CHANGES:
            patch.setattr(os, name, counted(name, getattr(os, name)))
        for name in ("pipe_file", "put_file", "cp_file", "rm_file"):
            patch.setattr(MemoryFileSystem, name, stored(name, getattr(MemoryFileSystem, name)))
        yield done


def disk(folder: Path, moved: Path | None = None) -> Disk:
    """Return what a kill leaves in a folder and its store, before the file `moved` is renamed."""
    own, at = f"{folder}/", len(str(folder))
    found: Disk = {
        name[at:]: file.getvalue() for name, file in MemoryFileSystem.store.items() if name.startswith(own)
    }
    for path in sorted(folder.rglob("*")):
        data = None if path.is_dir() else path.read_bytes()
        if data is not None and path == moved:
            data = data[: len(data) // 2]
        found[path.relative_to(folder).as_posix().replace(f"{os.getpid()}", f"{ENDED}")] = data
    return found


def put(there: Disk, folder: Path) -> None:
    """Give a folder and its store these contents, and no others."""
    shutil.rmtree(folder, ignore_errors=True)
    for name in [name for name in MemoryFileSystem.store if name.startswith(f"{folder}/")]:
        del MemoryFileSystem.store[name]
    folder.mkdir()
    for name, data in there.items():
        if name.startswith("/"):
            MemoryFileSystem().pipe_file(f"{folder}{name}", data)
        elif data is None:
            (folder / name).mkdir()
        else:
            (folder / name).write_bytes(data)


def result(folder: Path) -> Disk:
    """Return what a finished command must leave: every file and folder, without the time that it took."""
    found = {name: data and TIMES.sub(b"", data) for name, data in disk(folder).items()}
    uploads = {name for name, data in found.items() if name.startswith("cache/uploads") and data is not None}
    return {name: data for name, data in found.items() if name in uploads or not name.startswith("cache")}


# -- inputs


def toy(data: Path) -> None:
    write_toy(data / "toy.hdf5", [14, 15, 16, 17])
    (data / "arm.yaml").write_text(ARM_YAML)


def three(data: Path) -> None:
    cameras.write_hdf5(data / "three.hdf5")
    (data / "three.yaml").write_text(cameras.arm().to_yaml())


def two_sets(data: Path) -> None:
    for name in ("one", "other"):
        write_toy(data / f"{name}.hdf5", [14, 15, 16, 17])
        convert_toy(family.Embodiment.from_yaml(ARM_YAML), data / f"{name}.hdf5", data / name)


def first_day(data: Path, folder: Path) -> None:
    """Shards of one recording, beside which there is another one now."""
    (data / "days").mkdir()
    write_toy(data / "days/monday.hdf5", [14, 15, 16, 17])
    assert hma(*DAYS.format(data=data).split(), cwd=folder).returncode == 0
    write_toy(data / "days/tuesday.hdf5", [18, 19, 20, 21])


def run_recipe(data: Path) -> None:
    make_shards(data / "arm", "arm")
    values = {**TINY, "data": [str(data / "arm")], "steps": 3, "checkpoint_every": 1, "accumulate": 2}
    values |= {
        "ema": 0.9,
        "self_forward": 0.5,
        "self_forward_from": 2,
        "objectives": {"forward": 1, "full": 1},
    }
    (data / "tiny.yaml").write_text(json.dumps(values))


def finetuned(data: Path) -> None:
    make_shards(data / "leg", "leg", dims=3)
    robots.save(data / "model", {"arm": 2})


def rails(data: Path, *objectives: str) -> None:
    own = family.embodiment(ROBOT)
    ends = {"mean": 0.0, "std": 30.0, "min": -60.0, "max": 60.0}
    stats = {key: [value] * own.action_dim for key, value in ends.items()}
    checkpoint.save(
        tiny_model(ROBOT, *objectives), data / "rails", embodiment_yaml={ROBOT: own.to_yaml()},
        stats={ROBOT: {"action": {"count": 9} | stats}}, cards={ROBOT: {"data": {"cameras": "top"}}},
    )  # fmt: skip


def film(data: Path) -> None:
    (data / "film").mkdir()
    for number in range(3):
        write_mp4(data / f"film/{number}.mp4", [np.full((128, 128, 3), 60 * number, np.uint8)] * 8, 10)
    rails(data, "inverse")


def evaluated(data: Path) -> None:
    robots.save(data / "model", {"arm": 2, "hand": 3})
    make_shards(data / "arm", "arm", held_out=2)
    make_shards(data / "hand", "hand", dims=3, held_out=2)


def fsq(data: Path) -> None:
    network = {"width": [8, 8], "hidden": 8, "encoder_blocks": [1, 1], "decoder_blocks": [1, 1, 1]}
    tokenizer_files.write_recipe(data, network | {"fine_width": 4}, fall=[[4, 1], [6, 0]])


def vae(data: Path) -> None:
    """The noise of its latents differs by step."""
    network = {"width": 8, "hidden": 8, "encoder_blocks": 1, "decoder_blocks": [1, 1], "fine_width": 4}
    tokenizer_files.write_recipe(data, network, weight_decay=0.1, fall=[[2, 1], [6, 0]])


def published(data: Path) -> None:
    robots.save(data / "model", {"arm": 2, "hand": 3})
    make_shards(data / "arm", "arm")


# -- what makes commands small


class Colours:
    """A probe that takes the mean colours of an image for the places of the parts."""

    own, loose, driven = np.array([0, 1]), np.array([2, 3]), 2

    def read(self, images: np.ndarray) -> np.ndarray:
        means = images.reshape(*images.shape[:-3], -1, 3).mean(axis=-2) / 2
        return means[..., [[0, 1], [1, 2], [2, 0], [0, 0]]]

    def areas(self, images: np.ndarray) -> np.ndarray:
        return np.ones((*images.shape[:-3], 4))


def judge(*given: Any, **named: Any) -> StateJudge:
    """Stand for the training of a judge."""
    probe: Any = Colours()
    return StateJudge(task_of(ROBOT, "moved=2"), probe, 2.0, Accuracy(1.0, 1.0, 1.0, 1.0, 48, 24))


def small_batches(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(augment, "BATCH_EPISODES", 2)


def often(patch: pytest.MonkeyPatch) -> None:
    given: Any = train_tokenizer.__kwdefaults__
    patch.setitem(given, "report_every", 2)
    no_clock = SimpleNamespace(monotonic=lambda: 0.0)
    patch.setattr("hma_data.tokenizers.training.train.time", no_clock)


def no_state(patch: pytest.MonkeyPatch) -> None:
    small_batches(patch)
    patch.setattr(augment, "_stated", lambda *given: None)


def known_error(patch: pytest.MonkeyPatch) -> None:
    error = labels.LabelError("s", "val", ("a",), (0.1,), (1.0,), (None,), 9)
    patch.setattr(labels, "measure", lambda *given: error)
    patch.setattr(labels, "_check_set", lambda *given: None)


def blocks(patch: pytest.MonkeyPatch) -> None:
    for module in (suite, report):
        patch.setattr(module, "tokenizer_of", lambda shards, **_: robots.Blocks())
    suite._tokenizer.cache_clear()


def tiny_protocol(patch: pytest.MonkeyPatch) -> None:
    tiny: dict[str, Any] = {"robots": (ROBOT,), "scenes": 2, "frames": 4, "noises": (0.0,), "episodes": 2}
    patch.setattr(benchmarking, "QUICK", changed(benchmarking.QUICK, **tiny, policy_frames=4))
    patch.setattr(benchmarking, "train_probe", lambda *given: Colours())
    patch.setattr(benchmarking, "train_judge", judge)
    speed = dict.fromkeys(("frames_per_second", "frames_per_cpu_second"), np.array(1.0))
    patch.setattr(benchmarking, "speed", lambda *given: speed)
    patch.setattr(planning, "ROUNDS", 1)
    patch.setattr(planning, "CANDIDATES", 5)


CONVERT = "convert {data}/toy.hdf5 -e {data}/arm.yaml --tokenizer raw-64 --shard-frames 20 --workers 0"
DAYS = "convert {data}/days -e {data}/arm.yaml --tokenizer raw-64 --shard-frames 40 --workers 0 --out out"
DATASET = "convert {data}/three.hdf5 -e {data}/three.yaml --shard-frames 9 --workers 0 --out out"
TUNE = "steps=3 device=cpu report=false pictures=0 track=[] eval_every=0 batch_size=4 checkpoint_every=1"
TRAINED = "same command to continue|same command continues from the newest"
WEIGHTS = "nothing is saved before step 100|same command continues from there"
AUGMENT = f"augment {ROBOT} out --checkpoint {{data}}/rails --episodes 4 --frames 4 --keep 1"
TOKENIZER = "tokenizer train {data}/recipe.yaml --out w"
DONE = "finished already"
LOG, MADE, FACTS = "run/(metrics.jsonl|.*README.md|checkpoints/step-00000001)", "out/[^.]", r"out/\w+\."
QUICK = {
    "convert": Command(f"{CONVERT} --out out", toy, again="3 existed already"),
    "convert to a store": Command(
        f"{CONVERT} --out {{store}}/set", toy, "finished shards in .* kept|nothing more is written",
        again="3 existed already", trusted="cache/",
    ),
    "extend": Command(f"{DAYS} --extend", toy, again="4 existed already", begin=first_day),
    "split": Command(
        "shards split {data}/one --out out --seed 5 --val-fraction 0.4 --workers 1", two_sets, trusted=FACTS
    ),
    "merge": Command("shards merge {data}/one {data}/other --out out --workers 1", two_sets, trusted=FACTS),
    "train": Command("train {data}/tiny.yaml --out run", run_recipe, TRAINED, DONE, trusted=LOG),
    "finetune": Command(
        f"finetune {{data}}/leg --from {{data}}/model {TUNE} --out run", finetuned, TRAINED, DONE,
        trusted=LOG,
    ),
    "augment": Command(AUGMENT, rails, again=DONE, patch=small_batches, trusted=MADE),
    "label-actions": Command(
        f"label-actions {{data}}/film --checkpoint {{data}}/rails -e {ROBOT} --out out", film, again=DONE,
        patch=known_error, trusted=MADE,
    ),
    "evaluate": Command(
        "evaluate {data}/model {data}/arm {data}/hand --windows 1 --out out", evaluated, patch=blocks
    ),
    "hub push": Command("hub push {data}/model hub", published, trusted="hub/(env.py|trunk)"),
    "hub pull": Command("hub pull {data}/model -e arm --out out", published),
    "hub push-data": Command("hub push-data {data}/arm hub", published),
    "hub pull-data": Command("hub pull-data {data}/arm --out out", published),
}  # fmt: skip
SLOW = {
    "to lerobot": Command(f"{DATASET} --to lerobot", three, trusted=MADE),
    "to both": Command(
        f"{DATASET} --tokenizer raw-64 --cameras all --val-fraction 0.3 --lerobot set", three, trusted="set/"
    ),
    "policy-eval": Command(
        f"policy-eval {ROBOT} random still --checkpoint {{data}}/rails --episodes 2 --frames 4 --out out",
        rails, patch=lambda patch: patch.setattr(scores, "train_judge", judge),
    ),
    "benchmark": Command("benchmark {data}/rails --quick --out out", rails, patch=tiny_protocol),
    "tokenizer train": Command(TOKENIZER, fsq, WEIGHTS, DONE, patch=often, trusted="w$"),
    "tokenizer train vae": Command(TOKENIZER, vae, WEIGHTS, DONE, patch=often, trusted="w$"),
    "augment to lerobot": Command(
        f"{AUGMENT} --lerobot set", rails, again=DONE, patch=no_state, trusted=MADE
    ),
}  # fmt: skip
