"""Print what commands show: tables, lines and progress on a terminal, JSON for programs.

The data and the model verbs share this module. rich is imported when something is shown.
"""

import json
import os
import shutil
import sys
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from decimal import Decimal
from typing import Any, Protocol

from hma_data.errors import HMAError, Interrupted, escaped


class Update(Protocol):
    """A function that updates a progress display."""

    def __call__(self, done: float, extra: str = "", total: float | None = None) -> None:
        """Show the amount done so far, a few words beside the bar, and the total once it is known."""


def run_script(main: Callable[[], None]) -> None:
    """Run a script; an error of the toolkit, or of a file, becomes one line on stderr and an exit code.

    With HMA_DEBUG in the environment, errors show where they happened.
    """
    try:
        main()
    except HMAError as fault:
        if os.environ.get("HMA_DEBUG"):
            raise
        raise SystemExit(fail(str(fault), fault.exit_code)) from None
    except OSError as fault:
        if os.environ.get("HMA_DEBUG"):
            raise
        remedy = "free space or see to the permissions, and run the same command again"
        where = escaped(str(fault.filename or "a file"))
        raise SystemExit(fail(f"{where}: {fault.strerror or fault} — {remedy}", 1)) from None
    except KeyboardInterrupt:
        raise SystemExit(fail("interrupted", 130)) from None


def fail(text: str, code: int) -> int:
    """Print an error as one line to standard error; return the exit code."""
    say(f"error: {' '.join(text.split())}", err=True)
    return code


def say(text: str, err: bool = False, flush: bool = False) -> None:
    """Print one line, to standard error with `err`; control characters out of names are escaped."""
    print(escaped(text), file=sys.stderr if err else sys.stdout, flush=flush)


def print_json(values: Any) -> None:
    """Print plain values as JSON to standard output."""
    print(json.dumps(values, indent=1, ensure_ascii=False, default=str))


LONGEST_TITLE = 40  # letters in the column of titles; a longer title pushes its text to the right
LONGEST_NAME = 20  # letters of a path, beyond which `short_paths` shortens it
GAP = 3  # letters between columns
MANY_ROWS = 500  # laying out more than this with rich takes seconds
SECONDS_BETWEEN_LINES = 10  # of progress off a terminal


def print_table(columns: Sequence[str], rows: Sequence[Sequence[Any]], title: str = "") -> None:
    """Print a table to standard output: numbers aligned right, full width when it is not a terminal.

    Where a terminal is too narrow for it, each row becomes a paragraph.

    Args:
        columns: headings.
        rows: a cell for each column; a Decimal is a number whose digits are all shown.
        title: printed above.
    """
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    cells = [[escaped(cell_text(value)) for value in row] for row in rows]
    widths = [max(map(len, [name, *(row[i] for row in cells)])) for i, name in enumerate(columns)]
    if len(rows) > MANY_ROWS:
        for row in [list(columns), *cells]:
            print("  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip())
        return
    is_terminal, room = sys.stdout.isatty(), sum(widths) + GAP * len(columns)
    width = None if is_terminal else max(200, room)
    console = Console(width=width, soft_wrap=not is_terminal, highlight=False)
    if is_terminal and room > console.width:
        _print_paragraphs(console, columns, cells, title)
        return
    table = Table(title=Text(title) if title else None, title_justify="left", box=SIMPLE, pad_edge=False)
    for i, name in enumerate(columns):
        numeric = is_numeric([row[i] for row in rows])
        table.add_column(Text(name), justify="right" if numeric else "left", no_wrap=numeric)
    for row in cells:
        table.add_row(*map(Text, row))
    console.print(table)


def _print_paragraphs(console: Any, columns: Sequence[str], cells: list[list[str]], title: str) -> None:
    """Print each row as its first cell, which is never broken, with the others named below it."""
    from rich.padding import Padding
    from rich.text import Text

    if title:
        console.print(Text(title))
    for first, *others in cells:
        console.print(Text(first, "bold"), soft_wrap=True)
        named = Text("; ").join(
            Text.assemble((f"{name}: ", "dim"), cell)
            for name, cell in zip(columns[1:], others, strict=True)
            if cell not in ("", "-")
        )
        console.print(Padding(named, (0, 0, 0, 2)))


def is_numeric(values: Sequence[Any]) -> bool:
    """Check whether a column holds numbers and no words; "unknown" stands for a number."""
    words = [value for value in values if isinstance(value, str) and value != "unknown"]
    return not words and any(isinstance(value, int | float | Decimal) for value in values)


def cell_text(value: Any, digits: int = 4) -> str:
    """Return a cell of a table as text, floats with so many digits."""
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:,.{digits}g}" if abs(value) < 10**digits else f"{value:,.0f}"
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return str(value)


def print_lines(lines: Iterable[tuple[str, str]]) -> None:
    """Print pairs of a title and a text with the texts in one column, folded to a terminal's width."""
    pairs = [(escaped(title), escaped(text)) for title, text in lines]
    width = min(max((len(title) for title, _ in pairs), default=0), LONGEST_TITLE)
    room = shutil.get_terminal_size().columns - width - 2 if sys.stdout.isatty() else 0
    last = ""
    for title, text in pairs:
        folded = textwrap.wrap(text, room) if room > 20 else [text]
        for i, part in enumerate(folded or [""]):
            shown = title if i == 0 and title != last else ""
            print(f"{shown:{width}}  {part}")
        last = title


def short_paths(paths: Sequence[str]) -> dict[str, str]:
    """Return a short name for each path: without the folders that all have in common, before or after.

    A single path, and paths that are short, stay as they are.
    """
    if len(paths) < 2 or max(map(len, paths)) <= LONGEST_NAME:
        return {path: path for path in paths}
    parts = [path.rstrip("/").split("/") for path in paths]
    for _ in range(2):  # from the front, then from the back
        while min(map(len, parts)) > 1 and len({part[0] for part in parts}) == 1:
            parts = [part[1:] for part in parts]
        parts = [part[::-1] for part in parts]
    return {path: "/".join(part) for path, part in zip(paths, parts, strict=True)}


def human_number(value: float | None) -> str | None:
    """Return a number as text with three digits: 0.00123, 12.3, 1.23e+09."""
    if value is None:
        return None
    return f"{value:.0f}" if float(value).is_integer() and abs(value) < 1e6 else f"{value:.3g}"


def human_count(count: int, noun: str) -> str:
    """Return a number with its noun, in the plural where it is not one: 1 shard, 2,000 shards."""
    return f"{count:,} {noun}" + ("s" if count != 1 else "")


def human_bytes(count: float) -> str:
    """Return a number of bytes as text: 1234567 -> 1.2 MB."""
    from rich.filesize import decimal

    return f"{count:.0f} B" if count < 1000 else decimal(int(count))


def human_seconds(seconds: float) -> str:
    """Return a duration as text: 3725 -> 1 h 02 min."""
    if round(seconds, 1) < 60:
        return f"{seconds:.1f} s"
    whole = round(seconds)  # first, or 179.7 s would be 2 min 60 s
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02} min"


CONTINUE = "run the same command again to continue"


@contextmanager
def interruptible(words: Callable[[], str]) -> Iterator[None]:
    """Convert a Ctrl-C in the block to an error that says what is kept and how to go on.

    Args:
        words: returns that text; it is called after the Ctrl-C.

    Raises:
        Interrupted: the user pressed Ctrl-C.
    """
    try:
        yield
    except KeyboardInterrupt as stopped:
        raise Interrupted("", f"interrupted: {words()}") from stopped


@contextmanager
def progress(description: str, total: float = 0, unit: str = "frames") -> Iterator[Update]:
    """Show progress on standard error: a bar with rate and time left, or a line every 10 s off a terminal.

    Args:
        description: what is done.
        total: the amount in all; 0 where it is not known yet.
        unit: the unit of the amounts; "bytes" are shown in kB, MB or GB.
    """
    if not sys.stderr.isatty():
        lines = _Lines(description, total, unit)
        yield lines
        lines.close()
        return
    from rich.console import Console, Group, RenderableType
    from rich.live import Live
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.text import Text

    bar = Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=24),
        TextColumn("{task.fields[amount]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    words = Text(no_wrap=True, overflow="ellipsis")  # below the bar, which leaves no room in 80 columns
    number = bar.add_task(description, total=total or None, amount="")
    [task] = bar.tasks

    def update(done: float, extra: str = "", total: float | None = None) -> None:
        whole = total or task.total
        amount = _amount(done, whole or 0, task.speed or 0, unit)
        words.plain = extra
        bar.update(number, completed=done, total=whole, amount=amount)

    def shown() -> RenderableType:
        return Group(bar, words) if words.plain else bar

    with Live(get_renderable=shown, console=Console(stderr=True), refresh_per_second=5):
        yield update


def _amount(done: float, total: float, rate: float, unit: str) -> str:
    """Return the amount done, the total and the rate as text; an unknown total or rate is left out."""
    if unit == "bytes":
        text = human_bytes(done) + (f" of {human_bytes(total)}" if total else "")
        return text + (f", {human_bytes(rate)}/s" if rate > 0 else "")
    text = f"{done:,.0f}" + (f"/{total:,.0f}" if total else "") + f" {unit}"
    return text + (f", {_rate(rate)}/s" if rate > 0 else "")


def _rate(rate: float) -> str:
    """Return a rate with at least two digits: a step of a training may take a minute."""
    return f"{rate:.2g}" if rate < 1 else f"{rate:,.{1 if rate < 10 else 0}f}"


def _whole_seconds(seconds: float) -> str:
    return f"{seconds:.0f} s" if round(seconds) < 60 else human_seconds(seconds)


class _Lines:
    """Progress for logs: one line every ten seconds, and one at the end."""

    def __init__(self, description: str, total: float, unit: str) -> None:
        self._text, self._total, self._unit = description, total, unit
        self._start = self._shown = time.monotonic()
        self._begun: tuple[float, float] | None = None  # amount and time from which the rate counts
        self._done, self._extra = 0.0, ""
        self._is_told = False  # whether the last call has been shown

    def __call__(self, done: float, extra: str = "", total: float | None = None) -> None:
        self._done, self._extra, self._total = done, extra, total or self._total
        self._is_told = False
        if self._begun is None or done <= self._begun[0]:
            # Neither the work of an earlier run nor the preparation counts for the rate.
            self._begun = done, time.monotonic()
        if time.monotonic() - self._shown >= SECONDS_BETWEEN_LINES:
            self._show(*self._begun)

    def close(self) -> None:
        if self._begun is not None and not self._is_told:
            self._show(*self._begun)

    def _show(self, first: float, begun: float) -> None:
        self._shown, self._is_told = time.monotonic(), True
        rate = (self._done - first) / max(self._shown - begun, 1e-9)
        missing = self._total - self._done
        amount = _amount(self._done, self._total, rate, self._unit)
        words = f", {self._extra}" if self._extra else ""
        times = f"{_whole_seconds(self._shown - self._start)} so far"
        if rate > 0 and missing > 0:
            times += f", {_whole_seconds(missing / rate)} left"
        print(f"{self._text}: {amount}, {times}{words}", file=sys.stderr, flush=True)
