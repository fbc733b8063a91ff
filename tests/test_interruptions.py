"""Every command that promises to continue: killed, stopped by Ctrl-C, its files damaged, given again."""

import io
import os
import random
import re
import signal
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path

import av
import numpy as np
import pytest

from tests.command import fails
from tests.interruptions import QUICK, SLOW, Disk, disk, put, result, watched
from tests.model.processes import run

ALL = QUICK | SLOW
SAME_LEVELS = 2.0  # of 255, between two encodings of the same frames
MOST = 40 if os.environ.get("HMA_FUZZ") else 12  # points of a command in a sweep


class Case:
    """A command, its input, and an undisturbed run of it.

    Attributes:
        begun: what was there before.
        done: the operations of the run.
        moments: what a kill before each of them would have left.
        end: what the run left, and `whole`, what of it every other run must leave.
    """

    def __init__(self, name: str, folder: Path) -> None:
        self.command, self.data, self.place = ALL[name], folder / "data", folder / "work"
        self.data.mkdir()
        self.command.make(self.data)
        self.moments: list[Disk] = []
        put({}, self.place)
        self.command.begin(self.data, self.place)
        self.begun = disk(self.place)
        with watched(self.place, lambda at, moved: self.moments.append(disk(self.place, moved))) as self.done:
            ended = self.command.run(self.data, self.place)
        assert ended.returncode == 0, ended.stderr
        self.end, self.whole = disk(self.place), result(self.place)

    def goes_on(self, there: Disk, where: object) -> int:
        """Give the command where this is there: it ends like an undisturbed run; return its operations."""
        put(there, self.place)
        with watched(self.place) as done:
            ended = self.command.run(self.data, self.place)
        assert ended.returncode == 0, (where, ended.stderr)
        self.check(where)
        return len(done)

    def check(self, where: object) -> None:
        found = result(self.place)
        names = found | self.whole
        unlike = [name for name in names if not alike(found.get(name, 0), self.whole.get(name, 0))]
        assert not unlike, (where, unlike)


def alike(one: object, other: object) -> bool:
    """Check whether two files are equal; of videos, which are rarely encoded to other bytes, the frames."""
    if one == other or not (isinstance(one, bytes) and isinstance(other, bytes) and b"ftyp" in one[:12]):
        return one == other
    shown = []
    for data in (one, other):
        with av.open(io.BytesIO(data)) as file:
            shown.append(np.stack([frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]))
    first, second = shown
    return first.shape == second.shape and np.abs(first.astype(int) - second).mean() < SAME_LEVELS


@pytest.fixture(scope="session")
def cases(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Case]:
    return cache(lambda name: Case(name, tmp_path_factory.mktemp("case")))


def spread(points: Sequence[int], most: int) -> list[int]:
    """Return at most so many of the points, the last one among them."""
    return [points[i] for i in sorted({*np.linspace(0, len(points) - 1, most + 1).round().astype(int)[1:]})]


def each(quick: int, slow: int = MOST) -> pytest.MarkDecorator:
    """Take every command with a number of points, and with more where slow tests are run."""
    few = [(name, quick) for name in QUICK]
    more = [(name, slow) for name in QUICK] + [(name, quick + 2) for name in SLOW]
    many = [pytest.param(*one, marks=pytest.mark.slow) for one in more]
    return pytest.mark.parametrize(("name", "most"), [*few, *many])


def signalled(at: int, number: int) -> Callable[[int, object], None]:
    def send(point: int, moved: object) -> None:
        if point == at:
            os.kill(os.getpid(), number)

    return send


@each(2)
def test_a_killed_command_given_again_ends_with_the_same_bytes(name, most, cases) -> None:
    case = cases(name)
    did = [case.goes_on(case.moments[at], case.done[at]) for at in spread(range(len(case.moments)), most)]
    assert min(did) < len(case.moments)  # what was there was not made again


def killed(name: str, data: Path, place: Path, at: int) -> None:
    with watched(place, signalled(at, signal.SIGKILL)):
        ALL[name].run(data, place)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in ALL if "store" not in name])  # this one is in memory
def test_a_process_killed_again_and_again_ends_with_the_same_bytes(name, cases, tmp_path) -> None:
    case, draws = cases(name), random.Random(name)
    put(case.begun, case.place)
    for most in (len(case.moments) // 2, 3, 3):  # a run that goes on has fewer points
        work = partial(killed, name, case.data, case.place, draws.randint(1, most))
        run(work, tmp_path / "said", code=-signal.SIGKILL)
    case.goes_on(disk(case.place), name)


@each(1, 4)
def test_ctrl_c_says_how_to_go_on(name, most, cases) -> None:
    case = cases(name)
    for at in spread(range(1, len(case.moments) + 1), most):
        put(case.begun, case.place)
        with watched(case.place, signalled(at, signal.SIGINT)):
            ended = case.command.run(case.data, case.place)
        where = (at, case.done[at - 1], ended.stderr)
        assert "Traceback" not in ended.stderr, where
        if ended.returncode:  # it may come when all is done
            assert ended.returncode == 130 and re.search(case.command.kept, ended.stderr), where
        case.goes_on(disk(case.place), where)


DAMAGES = (lambda data: b"", lambda data: data[: len(data) // 2], lambda data: b"\xff" * 99)


@each(1, 4)
def test_a_file_that_was_damaged_in_between_is_made_again_or_one_error(name, most, cases) -> None:
    case = cases(name)
    for at in spread(range(len(case.moments) - 1), most):
        moment = case.moments[at]
        read = [n for n, data in moment.items() if data and not re.match(case.command.trusted, n)]
        for number, file in enumerate(read if most > 3 else read[-2:]):
            left = DAMAGES[(at + number) % 3](moment[file])
            put(moment | {file: left}, case.place)
            ended = case.command.run(case.data, case.place)
            where = (at, case.done[at], file, len(left), ended.stderr)
            if ended.returncode:
                assert "unexpected" not in ended.stderr, where
                fails(ended, ended.returncode)
            else:
                case.check(where)


@pytest.mark.parametrize("name", [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)])
def test_a_finished_command_changes_nothing_and_says_so(name, cases) -> None:
    case = cases(name)
    put(case.end, case.place)
    ended = case.command.run(case.data, case.place)
    assert ended.returncode == 0 and case.command.again in ended.stdout + ended.stderr
    case.check("again")
