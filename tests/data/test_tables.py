"""One table in three renderings; names out of strangers' files stay in their cells."""

import pytest

from hma_data.tables import Table

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
