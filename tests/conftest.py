"""Fixtures shared by all tests."""

import gc
import os
import re
import shutil
import tempfile
from collections.abc import Generator, Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.cpu import take_ordinary_priority
from hma_data.registry.embodiment import Embodiment, judged
from hma_data.tokenizers.base import TokenizerSpec, check_frames, check_tokens

# The same few examples in every run, so that a red main means the change; HMA_FUZZ=1 draws many new ones.
ALWAYS = {"deadline": None, "suppress_health_check": [HealthCheck.function_scoped_fixture]}
settings.register_profile("same", derandomize=True, database=None, max_examples=20, **ALWAYS)
settings.register_profile("new", print_blob=True, max_examples=200, **ALWAYS)
settings.load_profile("new" if os.environ.get("HMA_FUZZ") else "same")


gc.disable()  # modules that are imported and rewritten are kept: looking for garbage among them takes a fifth


def pytest_collection_finish() -> None:
    """Collect garbage again, among what tests make alone."""
    gc.freeze()
    gc.enable()


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out modules of slow tests alone where those are not asked for: importing lerobot takes 7 s."""
    if config.option.markexpr != "not slow" or collection_path.suffix != ".py":
        return None
    return bool(re.search(r"^pytestmark = .*mark\.slow", collection_path.read_text(), re.MULTILINE)) or None


LONG = ("test_notebooks.py", "test_tutorials.py")  # and mypy: no worker waits for them at the end


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put some tests first."""
    items.sort(key=lambda item: item.path.name not in LONG and "mypy" not in item.name)


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup() -> Generator[None, Any, Any]:
    """Videos are encoded in fixtures too."""
    try:
        return (yield)
    finally:
        take_ordinary_priority()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Generator[None, Any, Any]:
    """A test that encodes AV1 leaves the others, and the processes that they start, their turns."""
    take_ordinary_priority()
    try:
        return (yield)
    finally:
        take_ordinary_priority()


def pytest_configure(config: pytest.Config) -> None:
    """Give all processes of this run a cache folder of their own, empty at first."""
    if not hasattr(config, "workerinput"):
        folder = tempfile.mkdtemp(prefix="hma-tests-")
        os.environ["HMA_CACHE"] = folder
        config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))


# Why a test may be skipped, by the words of its reason; any other skip fails a run of CI.
SKIPS = {
    "root": "root may",
    "no GPU": "needs a GPU",
    "no real recordings": "no real recordings",
    "no paper's code": "the paper's released code",
    "another platform": "this platform",
    "no Chromium": "no Chromium",
}
_skipped: list[str] = []


def _note_skip(report: pytest.TestReport | pytest.CollectReport) -> None:
    if report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        _skipped.append(reason.removeprefix("Skipped: "))


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    _note_skip(report)


def pytest_collectreport(report: pytest.CollectReport) -> None:
    _note_skip(report)


def _unexplained() -> list[str]:
    """Return the reasons that none of SKIPS allows, such as a package that is missing."""
    return sorted({r for r in _skipped if not any(words in r for words in SKIPS.values())})


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Count the skipped tests by reason, and name what must not be skipped in CI."""
    for kind, words in SKIPS.items():
        if count := sum(words in reason for reason in _skipped):
            terminalreporter.write_line(f"skipped, {kind}: {count}")
    for reason in _unexplained():
        terminalreporter.write_line(f"skipped without leave, an error in CI: {reason}", red=True)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail a run of CI in which a test was skipped for want of a package."""
    if os.environ.get("CI") and _unexplained() and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.fixture(autouse=True, scope="session")
def loaded_once() -> Iterator[None]:
    """Load the weights of each embedded tokenizer once: no test changes them."""
    from hma_data.tokenizers import embedded  # torch, which scripts that import this module may not need

    load = embedded.load
    kept = cache(load)

    def once(name: str, **given: Any) -> Any:
        return load(name, **given) if given["weights"] else kept(name, **given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(embedded, "load", once)
        yield


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real recordings, beside the checkout or named by HMA_REAL_DATA."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("HMA_REAL_DATA", beside))
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder}; set HMA_REAL_DATA to their folder")
    return folder


class BlockTokenizer:
    """A tokenizer for tests: 8×8 blocks of a 64-pixel picture, 4 bits a colour; exact on flat blocks."""

    spec = TokenizerSpec("block", 1, "discrete", 64, (8, 8), 4096, (64, 64), dtype="uint16")

    def encode(self, frames):
        check_frames(frames, self.spec)
        # Whole lines are added first: numpy's mean over both axes takes seven times as long.
        lines = frames.reshape(-1, 8, 8, 192).sum(axis=2, dtype=np.uint16)
        blocks = lines.reshape(-1, 8, 8, 8, 3).sum(axis=3, dtype=np.uint16) / np.float32(64)
        levels = np.clip(np.rint(blocks / 17), 0, 15).astype(np.uint32)
        return levels[..., 0] + 16 * levels[..., 1] + 256 * levels[..., 2]

    def decode(self, tokens):
        check_tokens(tokens, self.spec)
        levels = np.stack([tokens % 16, tokens // 16 % 16, tokens // 256], axis=-1)
        return np.repeat(np.repeat((levels * 17).astype(np.uint8), 8, axis=1), 8, axis=2)


@pytest.fixture(scope="session")
def block_tokenizer() -> BlockTokenizer:
    return BlockTokenizer()


ARM_YAML = """
id: toy_arm
kind: simulation
frequency_hz: 10
target_hz: 5
action:
  space: joint_delta
  components: [{key: actions, dims: 3, names: [a, b, c]}]
cameras: [{name: top, key: obs/image}, {name: side, key: obs/side}]
source: {format: hdf5}
"""


@pytest.fixture
def toy_arm() -> Embodiment:
    """A robot of three action dims, stride 2, two cameras, recorded in HDF5."""
    return Embodiment.from_yaml(ARM_YAML)


@pytest.fixture(scope="session")
def toy_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve episodes of 20 to 31 frames; the image's brightness is episode and frame, the action too."""
    path = tmp_path_factory.mktemp("toy") / "toy.hdf5"
    write_toy(path, range(20, 32))
    return path


@pytest.fixture
def toy_recording(toy_file: Path, tmp_path: Path) -> Path:
    """A copy of that file, which a test may change."""
    return Path(shutil.copy(toy_file, tmp_path))


@pytest.fixture
def toy_yaml(tmp_path: Path) -> Path:
    """The YAML of that robot beside `toy.hdf5`, a recording of three episodes of 14 to 16 frames."""
    write_toy(tmp_path / "toy.hdf5", [14, 15, 16])
    path = tmp_path / "toy_arm.yaml"
    path.write_text(ARM_YAML)
    return path


SMALL = Settings(val_fraction=0.2, shard_frames=60)  # several shards of each split


def convert_toy(
    arm: Embodiment, recording: Path | str, out: Path | str, settings: Settings = SMALL,
    tokenizer: Any = None, **options: Any,
) -> Any:  # fmt: skip
    return convert(arm, str(recording), tokenizer or BlockTokenizer(), out, settings=settings, **options)


def toy_shards(
    folder: Path, lengths: Iterable[int], settings: Settings = SMALL, arm: str = ARM_YAML, **options: Any
) -> Path:
    """Record episodes of these lengths beside a folder, and convert them into it; returns the folder."""
    write_toy(folder.with_suffix(".hdf5"), lengths)
    convert_toy(Embodiment.from_yaml(arm), folder.with_suffix(".hdf5"), folder, settings, **options)
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    """Return the bytes of every file in a folder, by path."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def problems(values: Any) -> list[str]:
    """Return all problems of a YAML's plain values, one line each."""
    return [str(problem) for problem in judged(values)[1]]


def write_toy(path: Path, lengths: Iterable[int]) -> None:
    """An HDF5 recording in robomimic's layout whose pictures and actions tell episode and frame."""
    with h5py.File(path, "w") as file:
        for i, length in enumerate(lengths):
            group = file.create_group(f"data/demo_{i}")
            frame = np.arange(length)
            group["actions"] = np.stack([np.full(length, i), frame, np.sin(frame / 3)], axis=1).astype(
                np.float32
            )
            picture = np.zeros((length, 64, 64, 3), np.uint8)
            picture[..., 0], picture[..., 1] = 17 * (i % 16), (17 * (frame % 16))[:, None, None]
            group["obs/image"] = picture
            group["obs/side"] = picture[..., ::-1]
