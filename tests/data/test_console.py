"""Progress off a terminal: amounts in their unit, elapsed and remaining time; tables as they are."""

import re
from decimal import Decimal

import pytest

from hma_data import console
from hma_data.errors import Interrupted, SourceError, UsageError
from hma_data.tables import Table


@pytest.mark.parametrize(
    ("begun_s", "ended_s", "shown"),
    [(0.0, 12.0, "12 s so far, 36 s left, 3/9 episodes"), (50.0, 62.0, "1 min 02 s so far, 36 s left")],
    ids=["at once", "after preparation"],
)
def test_progress_tells_elapsed_from_remaining_time(monkeypatch, capsys, begun_s, ended_s, shown) -> None:
    clock = [0.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: clock[0])
    with console.progress("convert arm", unit="frames") as update:
        update(0, "training the judge", total=400)
        clock[0] = begun_s
        update(0, total=400)
        capsys.readouterr()
        clock[0] = ended_s
        update(100, shown.partition("left, ")[2], total=400)
        assert capsys.readouterr().err == f"convert arm: 100/400 frames, 8.3/s, {shown}\n"
    assert capsys.readouterr().err == ""  # what has been shown is not shown again at the end


def test_a_rate_below_one_a_second_is_not_rounded_to_nothing(monkeypatch, capsys) -> None:
    clock = [0.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: clock[0])
    with console.progress("training", unit="steps") as update:
        update(1000, total=1100)
        clock[0] = 1200.0
        update(1030, total=1100)
    line = "training: 1,030/1,100 steps, 0.025/s, 20 min 00 s so far, 46 min 40 s left\n"
    assert capsys.readouterr().err == line


def test_words_of_progress_fit_a_terminal_of_80_columns(monkeypatch, capsys) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    losses = "loss arm1_02 2.200, rails_03 2.000, validation 1.500"
    with console.progress("training", 1200, "steps") as update:
        update(1007, losses)
        update(1008, losses)
    shown = re.sub(r"\x1b\[[\d;?]*[A-Za-z]", "", capsys.readouterr().err).splitlines()
    assert any("1,008/1,200 steps" in line for line in shown) and losses in map(str.strip, shown)


def test_bytes_have_their_own_unit_and_an_unknown_total_is_left_out(capsys) -> None:
    with console.progress("verify", unit="bytes") as update:
        update(0, total=45_400)
        update(45_400, total=45_400)
    assert "verify: 45.4 kB of 45.4 kB" in capsys.readouterr().err
    with console.progress("verify", unit="bytes") as update:
        update(0)
    assert capsys.readouterr().err == "verify: 0 B, 0 s so far\n"


def test_brackets_in_tables_are_text(capsys: pytest.CaptureFixture[str]) -> None:
    console.print_table(["key [unit]", "n"], [["pose[rad]", 1]], title="in [a]")
    out = capsys.readouterr().out
    assert all(words in out for words in ("key [unit]", "pose[rad]", "in [a]"))


def test_a_table_too_wide_for_a_terminal_shows_all_its_figures(monkeypatch, capsys) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    figures = [f"figure {i}" for i in range(14)]
    row = ["runs/first/checkpoints/step-00000620", "arm", *(1000.5 + i for i in range(14))]
    console.print_table(["checkpoint", "robot", *figures], [row])
    out = re.sub(r"\x1b\[\d*m", "", capsys.readouterr().out)  # bold names
    assert max(map(len, out.splitlines())) <= 80
    words = " ".join(out.split())
    assert all(f"figure {i}: {1000.5 + i:,.4g}" in words for i in range(14))


def test_a_table_off_a_terminal_cuts_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    path, figures = "runs/" + 30 * "long-name/", [1000.5 + i for i in range(30)]
    console.print_table(
        ["checkpoint", *(f"figure {i}" for i in range(30)), "words"], [[path, *figures, "w " * 90]]
    )
    (row,) = [line for line in capsys.readouterr().out.splitlines() if path in line]
    assert row.split() == [path, *(f"{one:,.4g}" for one in figures), *90 * ["w"]]


def test_a_ctrl_c_becomes_an_error_with_the_words() -> None:
    with (
        pytest.raises(Interrupted, match="interrupted: 3 shards kept"),
        console.interruptible(lambda: "3 shards kept"),
    ):
        raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("fault", "said", "code"),
    [
        (UsageError("x", "is wrong", "give y"), "error: x: is wrong — give y\n", 2),
        (SourceError("x", "is not\nthere"), "error: x: is not there\n", 1),
        (KeyboardInterrupt(), "error: interrupted\n", 130),
        (OSError(28, "No space left on device", "a.mp4"), "error: a.mp4: No space left on device — free", 1),
    ],
)
def test_a_script_tells_an_error_in_one_line(fault, said, code, capsys, monkeypatch):
    def main():
        raise fault

    monkeypatch.delenv("HMA_DEBUG", raising=False)
    with pytest.raises(SystemExit) as ended:
        console.run_script(main)
    assert ended.value.code == code and capsys.readouterr().err.startswith(said)
    if not isinstance(fault, KeyboardInterrupt):
        monkeypatch.setenv("HMA_DEBUG", "1")
        with pytest.raises(type(fault)):
            console.run_script(main)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (9.94, "9.9 s"),
        (59.96, "1 min 00 s"),
        (179.7, "3 min 00 s"),
        (3599.7, "1 h 00 min"),
        (3725.0, "1 h 02 min"),
    ],
)
def test_a_duration_never_has_sixty_seconds(seconds: float, text: str) -> None:
    assert console.human_seconds(seconds) == text


def test_a_row_of_words_too_wide_for_a_terminal_becomes_a_paragraph(monkeypatch, capsys) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    name = "a_robot_with_a_name_that_alone_is_wider_than_the_terminal_is"
    console.print_table(["id", "robot", "Hz", "licence"], [[name, "an arm [left]", 30.0, None]])
    out = re.sub(r"\x1b\[\d*m", "", capsys.readouterr().out)
    assert [line.rstrip() for line in out.splitlines()] == [name, "  robot: an arm [left]; Hz: 30"]


@pytest.mark.parametrize(
    ("paths", "short"),
    [
        (["runs/first", "runs/second"], ["runs/first", "runs/second"]),
        (["runs/an_arm_of_ours/checkpoints/step-10"], ["runs/an_arm_of_ours/checkpoints/step-10"]),
        (["runs/ablations/w64/seed_1/", "runs/ablations/w64/seed_2"], ["seed_1", "seed_2"]),
        (
            ["runs/width_64/checkpoints/step-10", "runs/width_32/checkpoints/step-10"],
            ["width_64", "width_32"],
        ),
        (["runs/ablations/width_64", "runs/ablations/width_64/ema"], ["width_64", "width_64/ema"]),
        (["embedded", "/somewhere/else/runs/first"], ["embedded", "/somewhere/else/runs/first"]),
    ],
)
def test_short_paths_leave_out_what_all_have_in_common(paths: list[str], short: list[str]) -> None:
    assert console.short_paths(paths) == dict(zip(paths, short, strict=True))


def test_a_decimal_is_a_number_that_keeps_its_digits(capsys: pytest.CaptureFixture[str]) -> None:
    console.print_table(
        ["set", "SSIM"], [["one", Decimal("0.960")], ["two", Decimal("12.947")], ["three", None]]
    )
    lines = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    (one,) = (line for line in lines if "one" in line)
    (two,) = (line for line in lines if "two" in line)
    assert one.endswith(" 0.960") and two.endswith("12.947") and len(one) == len(two)


HOSTILE = "<img src=x onerror=alert(1)> | b\nsmall"
TABLE = Table(["robot", "frames", "loss"], [[HOSTILE, 12_000, 2.5], ["arm", 3, None]])


def test_markdown_keeps_each_cell_in_its_column() -> None:
    assert TABLE.markdown().splitlines() == [
        "| robot | frames | loss |",
        "| --- | --- | --- |",
        r"| <img src=x onerror=alert(1)> \| b small | 12,000 | 2.5 |",
        "| arm | 3 | – |",
    ]
    escaped = Table(["a"], [[r"x \| y"]]).markdown()  # as the cards of the hub come
    assert escaped.splitlines()[-1] == r"| x \| y |"


def test_html_escapes_texts_and_aligns_numbers() -> None:
    shown = TABLE.html()
    assert "<th class=n>frames</th>" in shown and "<th class=n>loss</th>" in shown
    assert "<td>&lt;img src=x onerror=alert(1)&gt; | b<br><small>small</small></td>" in shown
    assert "<td class=n>12,000</td>" in shown and "<td class=n>–</td>" in shown


def test_text_is_printed_with_its_title(capsys: pytest.CaptureFixture[str]) -> None:
    TABLE.print("totals")
    shown = capsys.readouterr().out
    assert "totals" in shown and "12,000" in shown and "arm" in shown
